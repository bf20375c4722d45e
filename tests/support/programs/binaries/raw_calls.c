/* Makes system calls by number: each waits for 100 ms, and the time since the last is printed. */
#define _GNU_SOURCE
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum { TENTH_NS = 100000000, TENTH_US = 100000 };

static void note(const char *what, long result)
{
    static long before_ms;
    struct timeval now;
    syscall(SYS_gettimeofday, &now, NULL);
    long now_ms = now.tv_sec * 1000 + now.tv_usec / 1000;
    printf("%s: %ld after %ld ms\n", what, result, now_ms - before_ms);
    before_ms = now_ms;
}

int main(int words, char **argument)
{
    struct timespec tenth = {0, TENTH_NS};
    struct timeval tenth_us = {0, TENTH_US};
    struct itimerspec setting = {.it_value = tenth};
    struct epoll_event event;
    uint64_t count = 0;
    if (words > 1) return syscall(SYS_timer_create, CLOCK_MONOTONIC, NULL, argument);
    int set = epoll_create1(0), timer = syscall(SYS_timerfd_create, CLOCK_MONOTONIC, 0);
    note("nanosleep", syscall(SYS_nanosleep, &tenth, NULL));
    note("poll", syscall(SYS_poll, NULL, 0, 100));
    note("ppoll", syscall(SYS_ppoll, NULL, 0, &tenth, NULL, 8));
    note("select", syscall(SYS_select, 0, NULL, NULL, NULL, &tenth_us));
    note("pselect6", syscall(SYS_pselect6, 0, NULL, NULL, NULL, &tenth, NULL));
    note("epoll_wait", syscall(SYS_epoll_wait, set, &event, 1, 100));
    note("epoll_pwait", syscall(SYS_epoll_pwait, set, &event, 1, 100, NULL, 8));
    note("epoll_pwait2", syscall(SYS_epoll_pwait2, set, &event, 1, &tenth, NULL, 8));
    syscall(SYS_timerfd_settime, timer, 0, &setting, NULL);
    note("read", syscall(SYS_read, timer, &count, sizeof count));
    note("clock_nanosleep", syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &tenth, NULL));
    return 0;
}
