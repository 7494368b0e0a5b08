// Independent jobs over a few threads, of which the calling thread is one.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#include "experts/native/budget.hpp"

namespace mapf {

// Calls work(job, workspace, polls) once for each job in 0..jobs-1, until an interrupt. Each thread owns a Workspace;
// `polls` is true in the calling thread. The first exception of a job stops the others and is thrown again here.
template <class Workspace, class Work>
void run_jobs(std::size_t jobs, int threads, Interrupt& interrupt, const Work& work) {
    std::atomic<std::size_t> next_job{0};
    std::mutex mutex;
    std::condition_variable finished;
    std::exception_ptr error;

    const auto serve = [&](bool polls) {
        try {
            Workspace workspace;
            for (std::size_t job; !interrupt.requested() && (job = next_job++) < jobs;) {
                work(job, workspace, polls);
                if (polls) interrupt.poll(Clock::now());
            }
        } catch (...) {
            const std::lock_guard lock(mutex);
            if (!error) error = std::current_exception();
            interrupt.request();
        }
    };

    std::size_t running = std::min<std::size_t>(static_cast<std::size_t>(threads), jobs);
    running = running > 0 ? running - 1 : 0;
    std::vector<std::jthread> helpers;
    helpers.reserve(running);
    try {
        for (std::size_t helper = running; helper > 0; --helper)
            helpers.emplace_back([&] {
                serve(false);
                const std::lock_guard lock(mutex);
                --running;
                finished.notify_one();
            });
    } catch (...) {  // the system has no more threads for us
        interrupt.request();
        throw;
    }
    serve(true);
    {
        std::unique_lock lock(mutex);
        while (!finished.wait_for(lock, Interrupt::interval, [&] { return running == 0; })) {
            lock.unlock();
            interrupt.poll(Clock::now());
            lock.lock();
        }
    }
    helpers.clear();
    if (error) std::rethrow_exception(error);
}

}  // namespace mapf
