// Threads that wait for work between steps, so that a step of a few microseconds can be shared.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace mapf {

class Pool {
public:
    explicit Pool(int threads) : parts_(threads), shares_(threads) {
        try {
            for (int part = 1; part < threads; ++part) workers_.emplace_back([this, part] { work(part); });
        } catch (...) {  // the system has no more threads for us
            end();
            throw;
        }
    }

    ~Pool() { end(); }

    Pool(const Pool&) = delete;
    Pool& operator=(const Pool&) = delete;

    // Calls job(i, part) once for every i in 0..count-1, part 0 in the caller's thread; rethrows the first exception.
    // Each part has a share of its own, for the sake of its cache, and takes from the others' once that is done. The
    // caller waits for nobody who has not begun: a thread that gets no processor holds up nothing.
    template <class Job>
    void for_each(std::size_t count, Job&& job) {
        for (int part = 0; part < parts_; ++part) {
            shares_[part].next.store(count * part / parts_, std::memory_order_relaxed);
            shares_[part].end = count * (part + 1) / parts_;
        }
        const std::function<void(int)> take_all = [&](int part) {
            for (int turn = 0; turn < parts_; ++turn) {
                Share& share = shares_[(part + turn) % parts_];
                for (std::size_t i; (i = share.next.fetch_add(1, std::memory_order_relaxed)) < share.end;) job(i, part);
            }
        };
        job_ = &take_all;
        open();
        attempt(0);
        gate_.fetch_or(closed, std::memory_order_acq_rel);
        const auto left = [&] { return (gate_.load(std::memory_order_acquire) & inside) == 0; };
        while (!spin(left)) std::this_thread::yield();
        if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
    }

private:
    struct alignas(64) Share {
        std::atomic<std::size_t> next{0};
        std::size_t end = 0;
    };

    // The gate: the number of the round, whether it is closed, and how many workers are inside.
    static constexpr std::uint64_t inside = 0xffff, closed = 0x10000, round = 0x20000;

    // Time that a thread spins before it sleeps: longer than Python takes between two steps.
    static constexpr std::chrono::microseconds patience{100};

    // Waits for `ready` at most so long; whether it is.
    template <class Ready>
    static bool spin(Ready&& ready) {
        const auto end = std::chrono::steady_clock::now() + patience;
        do {
            for (int turn = 0; turn < 256; ++turn)
                if (ready()) return true;
        } while (std::chrono::steady_clock::now() < end);
        return false;
    }

    void end() {
        job_ = nullptr;
        open();
        for (auto& worker : workers_) worker.join();
    }

    void open() {
        {
            const std::lock_guard lock(mutex_);
            gate_.store((gate_.load(std::memory_order_relaxed) / round + 1) * round, std::memory_order_release);
        }
        opened_.notify_all();
    }

    void attempt(int part) {
        try {
            (*job_)(part);
        } catch (...) {
            const std::lock_guard lock(mutex_);
            if (!failure_) failure_ = std::current_exception();
        }
    }

    void work(int part) {
        std::uint64_t done = 0;
        while (true) {
            const auto opened = [&] { return gate_.load(std::memory_order_acquire) / round != done; };
            if (!spin(opened)) {
                std::unique_lock lock(mutex_);
                opened_.wait(lock, opened);
            }
            std::uint64_t gate = gate_.load(std::memory_order_acquire);
            done = gate / round;
            while ((gate & closed) == 0 && gate / round == done)
                if (gate_.compare_exchange_weak(gate, gate + 1, std::memory_order_acq_rel)) {
                    if (job_ == nullptr) return;
                    attempt(part);
                    gate_.fetch_sub(1, std::memory_order_release);
                    break;
                }
        }
    }

    int parts_;
    std::vector<Share> shares_;
    std::mutex mutex_;
    std::condition_variable opened_;
    alignas(64) std::atomic<std::uint64_t> gate_{0};
    alignas(64) const std::function<void(int)>* job_ = nullptr;  // changes only while nobody is inside
    std::exception_ptr failure_;
    std::vector<std::thread> workers_;  // last: they use all the others
};

}  // namespace mapf
