// Threads that wait for work between steps, so that a step of a few microseconds can be shared.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace mapf {

class Pool {
public:
    explicit Pool(int threads) : parts_(threads) {
        for (int part = 1; part < threads; ++part) workers_.emplace_back([this, part] { work(part); });
    }

    ~Pool() {
        post(nullptr);
        for (auto& worker : workers_) worker.join();
    }

    Pool(const Pool&) = delete;
    Pool& operator=(const Pool&) = delete;

    int parts() const { return parts_; }

    // Calls job(part) for every part 0..parts()-1, part 0 in the caller's thread; rethrows the first exception.
    void run(const std::function<void(int)>& job) {
        if (parts_ == 1) return job(0);
        left_.store(parts_ - 1, std::memory_order_relaxed);
        post(&job);
        attempt(job, 0);
        for (int spins = 0; left_.load(std::memory_order_acquire) != 0; ++spins)
            if (spins > patience) std::this_thread::yield();
        if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
    }

private:
    static constexpr int patience = 4000;  // turns before a thread stops spinning: about 10 microseconds

    void post(const std::function<void(int)>* job) {
        {
            const std::lock_guard lock(mutex_);
            job_ = job;
            round_.fetch_add(1, std::memory_order_release);
        }
        posted_.notify_all();
    }

    void attempt(const std::function<void(int)>& job, int part) {
        try {
            job(part);
        } catch (...) {
            const std::lock_guard lock(mutex_);
            if (!failure_) failure_ = std::current_exception();
        }
    }

    void work(int part) {
        std::uint64_t done = 0;
        while (true) {
            for (int spins = 0; spins < patience && round_.load(std::memory_order_acquire) == done; ++spins) {}
            {
                std::unique_lock lock(mutex_);
                posted_.wait(lock, [&] { return round_.load(std::memory_order_relaxed) != done; });
                done = round_.load(std::memory_order_relaxed);
            }
            if (job_ == nullptr) return;
            attempt(*job_, part);
            left_.fetch_sub(1, std::memory_order_release);
        }
    }

    int parts_;
    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable posted_;
    std::atomic<std::uint64_t> round_{0};
    std::atomic<int> left_{0};
    const std::function<void(int)>* job_ = nullptr;
    std::exception_ptr failure_;
};

}  // namespace mapf
