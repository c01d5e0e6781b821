#include "pool.h"

#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

namespace nerfvol {
namespace {

struct Pool {
    std::mutex call;  // one parallel_for at a time
    std::mutex m;
    std::condition_variable wake, done;
    std::vector<std::thread> workers;
    const std::function<void(int, int)>* task = nullptr;
    std::atomic<int> next{0};
    std::exception_ptr failure;  // what a task threw, for want of memory say: thrown again by the call
    int n = 0, running = 0;
    long epoch = 0;
    bool stop = false;

    void work(int thread) {
        try {
            for (int i; (i = next.fetch_add(1)) < n;) (*task)(i, thread);
        } catch (...) {
            std::lock_guard<std::mutex> lock(m);
            if (!failure) failure = std::current_exception();
            next = n;  // nobody begins another
        }
    }
    void loop(int thread) {
        long seen = 0;
        for (;;) {
            {
                std::unique_lock<std::mutex> lock(m);
                wake.wait(lock, [&] { return stop || epoch != seen; });
                if (stop) return;
                seen = epoch;
            }
            work(thread);
            std::lock_guard<std::mutex> lock(m);
            if (--running == 0) done.notify_one();
        }
    }
    void resize(int threads) {
        {
            std::lock_guard<std::mutex> lock(m);
            stop = true;
        }
        wake.notify_all();
        for (auto& w : workers) w.join();
        workers.clear();
        stop = false;
        epoch = 0;
        for (int t = 1; t < threads; ++t) workers.emplace_back([this, t] { loop(t); });
    }
    ~Pool() { resize(1); }
};

Pool* pool = nullptr;
int wanted = 0;

Pool& instance() {
    static std::once_flag once;
    std::call_once(once, [] {
        pool = new Pool;  // never freed: joining threads while the interpreter unloads can hang
#if defined(__unix__) || defined(__APPLE__)
        // A forked child has none of the parent's threads.
        pthread_atfork(nullptr, nullptr, [] { pool = new Pool; });
#endif
    });
    return *pool;
}

}  // namespace

int get_threads() {
    if (wanted > 0) return wanted;
    const int n = int(std::thread::hardware_concurrency());
    return n > 0 ? n : 1;
}

void set_threads(int n) {
    Pool& p = instance();
    std::lock_guard<std::mutex> call(p.call);
    wanted = n;
    p.resize(get_threads());
}

void parallel_for(int n, const std::function<void(int, int)>& task) {
    Pool& p = instance();
    std::lock_guard<std::mutex> call(p.call);
    const int threads = get_threads();
    if (int(p.workers.size()) + 1 != threads) p.resize(threads);
    p.task = &task;
    p.n = n;
    p.next = 0;
    if (threads > 1 && n > 1) {
        {
            std::lock_guard<std::mutex> lock(p.m);
            p.running = threads - 1;
            ++p.epoch;
        }
        p.wake.notify_all();
        p.work(0);
        std::unique_lock<std::mutex> lock(p.m);
        p.done.wait(lock, [&] { return p.running == 0; });
    } else {
        p.work(0);
    }
    if (p.failure) std::rethrow_exception(std::exchange(p.failure, nullptr));
}

}  // namespace nerfvol
