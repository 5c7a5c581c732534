// What a loop needs to keep its time: a clock, deadlines, a priority, memory that stays, and a queue without
// locks.
#pragma once

#include <pthread.h>
#include <sched.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <string>

namespace palpate {

inline std::int64_t now_ns() {
    timespec t{};
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1'000'000'000LL + t.tv_nsec;
}

// Deadlines one period apart, counted from the first: errors don't add up. One that is missed by a period or
// more is left out, so that no burst follows a pause.
class Deadlines {
 public:
    explicit Deadlines(std::int64_t period_ns) : period_ns_(period_ns), next_ns_(now_ns()) {}

    // Returns at the next deadline, or at a signal.
    void wait() {
        next_ns_ += period_ns_;
        const std::int64_t late = (now_ns() - next_ns_) / period_ns_;
        if (late > 0) {
            missed_ += late;
            next_ns_ += late * period_ns_;
        }
        const timespec t{static_cast<time_t>(next_ns_ / 1'000'000'000), static_cast<long>(next_ns_ % 1'000'000'000)};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, nullptr);
    }

    std::int64_t missed() const { return missed_; }

 private:
    std::int64_t period_ns_, next_ns_, missed_ = 0;
};

// Schedule the calling thread first in, first out; or say why not.
inline std::optional<std::string> raise_priority(int priority) {
    sched_param parameter{};
    parameter.sched_priority = priority;
    const int error = pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameter);
    if (!error) return std::nullopt;
    return std::string("no real-time scheduling (") + std::strerror(error) +
           "): expect missed deadlines on a busy machine; allow it with `ulimit -r " + std::to_string(priority) + "`";
}

// Keep the process's memory from being swapped out; or say why not.
inline std::optional<std::string> lock_memory() {
    rlimit limit{};
    getrlimit(RLIMIT_MEMLOCK, &limit);
    // With a limit a later allocation would fail.
    const bool limited = limit.rlim_cur != RLIM_INFINITY && geteuid() != 0;
    if (!limited && !mlockall(MCL_CURRENT | MCL_FUTURE)) return std::nullopt;
    return std::string("memory is not locked (") + std::strerror(limited ? EPERM : errno) +
           "): allow it with `ulimit -l unlimited`";
}

// From one thread to one other, neither of which ever waits for the other; what comes while it is full is
// lost.
template <class T, std::size_t capacity>
class Queue {
 public:
    // Whether there was room.
    bool push(const T& value) {
        const std::size_t written = written_.load(std::memory_order_relaxed);
        if (written - read_.load(std::memory_order_acquire) == capacity) return false;
        places_[written % capacity] = value;
        written_.store(written + 1, std::memory_order_release);
        return true;
    }

    // Whether there was one.
    bool pop(T& value) {
        const std::size_t read = read_.load(std::memory_order_relaxed);
        if (read == written_.load(std::memory_order_acquire)) return false;
        value = places_[read % capacity];
        read_.store(read + 1, std::memory_order_release);
        return true;
    }

 private:
    std::array<T, capacity> places_{};
    std::atomic<std::size_t> written_{0}, read_{0};
};

}  // namespace palpate
