// The budget of a search: a deadline, and a request to stop that may come from outside at any moment.
#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <utility>

namespace mapf {

using Clock = std::chrono::steady_clock;

// A request to stop all searches of one call. Only the thread that made the call polls for it.
class Interrupt {
public:
    explicit Interrupt(std::function<bool()> outside) : outside_(std::move(outside)) {}

    bool requested() const { return requested_.load(std::memory_order_relaxed); }
    void request() { requested_.store(true, std::memory_order_relaxed); }

    // Polls for a request to stop, at most once in an interval.
    void poll(Clock::time_point now) {
        if (now < next_poll_) return;
        next_poll_ = now + interval;
        if (outside_()) request();
    }

    static constexpr auto interval = std::chrono::milliseconds(20);

private:
    std::function<bool()> outside_;
    std::atomic<bool> requested_{false};
    Clock::time_point next_poll_ = Clock::now() + interval;
};

// The time that one search may spend. Cheap enough to ask after every state.
class Budget {
public:
    // `seconds` may be infinite. `polls`: this thread made the call.
    Budget(double seconds, Interrupt& interrupt, bool polls) : interrupt_(interrupt), polls_(polls) {
        const auto left = std::chrono::duration<double>(Clock::time_point::max() - begin_);
        if (seconds < 0.5 * left.count())
            deadline_ = begin_ + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
    }

    // Returns true if the search has to stop; reads the clock on every 256th call only.
    bool spent() {
        if (++questions_ % 256 == 0) look();
        return spent_;
    }

    // Returns true if the search has to stop; reads the clock.
    bool look() {
        const auto now = Clock::now();
        if (polls_) interrupt_.poll(now);
        spent_ = now >= deadline_ || interrupt_.requested();
        return spent_;
    }

    double seconds() const { return std::chrono::duration<double>(Clock::now() - begin_).count(); }

private:
    Clock::time_point begin_ = Clock::now();
    Clock::time_point deadline_ = Clock::time_point::max();
    Interrupt& interrupt_;
    bool polls_;
    bool spent_ = false;
    unsigned questions_ = 0;
};

}  // namespace mapf
