// Waits of C++'s library: each ends after 100 ms more, and the total is printed.
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <future>
#include <mutex>
#include <thread>

using namespace std::chrono_literals;

static const auto start = std::chrono::steady_clock::now();

static void print(const char *what)
{
    auto passed = std::chrono::steady_clock::now() - start;
    std::printf("%s %lld\n", what,
                (long long)std::chrono::duration_cast<std::chrono::milliseconds>(passed).count());
}

int main()
{
    std::mutex mutex;
    std::condition_variable condition;
    std::unique_lock<std::mutex> lock(mutex);
    std::this_thread::sleep_for(100ms);
    print("sleep_for");
    condition.wait_for(lock, 100ms, [] { return false; });
    print("wait_for");
    condition.wait_until(lock, std::chrono::system_clock::now() + 100ms, [] { return false; });
    print("wait_until");
    std::promise<int> promise;
    auto future = promise.get_future();
    if (future.wait_for(100ms) != std::future_status::timeout) return 1;
    print("future");
    std::thread sender([&] {
        std::this_thread::sleep_for(100ms);
        promise.set_value(7);
    });
    if (future.get() != 7) return 2;
    sender.join();
    print("promise");
    std::timed_mutex timed;
    timed.lock();
    std::thread other([&] {
        if (timed.try_lock_for(100ms)) std::printf("not locked\n");
    });
    other.join();
    print("timed_mutex");
    if (std::async(std::launch::async, [] {
            std::this_thread::sleep_for(100ms);
            return 3;
        }).get() != 3)
        return 3;
    print("async");
}
