// The threads behind threads.h: started once, woken for each call. They spin for some microseconds before they sleep,
// because the steps of one frame follow each other faster than a sleeping thread wakes.

#include "threads.h"

#include <condition_variable>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#ifndef _WIN32
#include <pthread.h>
#endif

namespace splash {
namespace {

inline void pause() {
#if defined(__x86_64__) || defined(_M_X64)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ __volatile__("yield");
#endif
}

constexpr int SPINS = 2000;

class Pool {
  public:
    // False where the pool is busy; nothing was done then.
    bool run(int workers, void (*work)(void*, int), void* argument) {
        std::unique_lock<std::mutex> mine(busy_, std::try_to_lock);
        if (!mine.owns_lock()) return false;
        start_threads(workers - 1);
        {
            std::lock_guard<std::mutex> lock(mutex_);
            work_ = work;
            argument_ = argument;
            workers_ = workers;
            failed_.store(false, std::memory_order_relaxed);
            running_.store(threads_, std::memory_order_relaxed);
            call_.fetch_add(1, std::memory_order_release);
        }
        wake_.notify_all();
        call(0);
        for (int worker = threads_ + 1; worker < workers; ++worker) call(worker);
        for (int spin = 0; spin < SPINS && running_.load(std::memory_order_acquire) != 0; ++spin) pause();
        if (running_.load(std::memory_order_acquire) != 0) {
            std::unique_lock<std::mutex> lock(mutex_);
            done_.wait(lock, [&] { return running_.load(std::memory_order_acquire) == 0; });
        }
        if (failed_.load(std::memory_order_relaxed)) throw std::bad_alloc();
        return true;
    }

  private:
    // Where the system gives no more threads, those that are there do all the work.
    void start_threads(int wanted) {
        while (threads_ < wanted) {
            try {
                std::thread(&Pool::loop, this, call_.load(std::memory_order_relaxed), threads_ + 1).detach();
            } catch (const std::system_error&) {
                break;
            }
            ++threads_;
        }
    }

    void call(int worker) {
        try {
            work_(argument_, worker);
        } catch (...) {
            failed_.store(true, std::memory_order_relaxed);
        }
    }

    void loop(uint64_t seen, int worker) {
        for (;;) {
            for (int spin = 0; spin < SPINS && call_.load(std::memory_order_acquire) == seen; ++spin) pause();
            if (call_.load(std::memory_order_acquire) == seen) {
                std::unique_lock<std::mutex> lock(mutex_);
                wake_.wait(lock, [&] { return call_.load(std::memory_order_acquire) != seen; });
            }
            seen = call_.load(std::memory_order_acquire);
            if (worker < workers_) call(worker);
            if (running_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
                std::lock_guard<std::mutex> lock(mutex_);
                done_.notify_one();
            }
        }
    }

    std::mutex busy_, mutex_;
    std::condition_variable wake_, done_;
    std::atomic<uint64_t> call_{0};
    std::atomic<int> running_{0};
    std::atomic<bool> failed_{false};
    void (*work_)(void*, int) = nullptr;
    void* argument_ = nullptr;
    int workers_ = 0;
    int threads_ = 0;
};

// Never freed: its threads run until the process ends. A forked child has no threads and begins with a new pool.
std::atomic<Pool*> pool{nullptr};

Pool* current_pool() {
    Pool* found = pool.load(std::memory_order_acquire);
    if (found != nullptr) return found;
    Pool* const made = new Pool;
    if (pool.compare_exchange_strong(found, made)) {
#ifndef _WIN32
        static std::once_flag once;
        std::call_once(once, [] { pthread_atfork(nullptr, nullptr, [] { pool.store(nullptr); }); });
#endif
        return made;
    }
    delete made;
    return found;
}

}  // namespace

void run_on_workers(int workers, void (*work)(void*, int), void* argument) {
    if (current_pool()->run(workers, work, argument)) return;
    for (int worker = 0; worker < workers; ++worker) work(argument, worker);
}

}  // namespace splash
