/* System calls by number: of programs that go round the functions of the C library.
 *
 * A call that waits or looks at a clock is that of the function with its name. One without such a
 * function ends the program.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <stdarg.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <unistd.h>

int epoll_pwait2(int, struct epoll_event *, int, const struct timespec *, const sigset_t *);

/* The last argument of pselect6(). */
struct sized_mask {
    const sigset_t *mask;
    size_t size;
};

static _Noreturn void refuse_call(const char *name)
{
    refuse("program '%s' makes the system call %s: not supported in the rig's time; expected a"
           " function of the C library; joins = false lets the program run beside the rig",
           rig.name, name);
}

/* Calls that wait for descriptors. */
static long wait_by_number(long number, const long a[6], bool *is_known)
{
    *is_known = true;
    switch (number) {
#ifdef SYS_poll
    case SYS_poll: return poll((void *)a[0], a[1], a[2]);
    case SYS_select:
        return select(a[0], (void *)a[1], (void *)a[2], (void *)a[3], (void *)a[4]);
    case SYS_epoll_wait: return epoll_wait(a[0], (void *)a[1], a[2], a[3]);
#endif
    case SYS_ppoll: return ppoll((void *)a[0], a[1], (void *)a[2], (void *)a[3]);
    case SYS_pselect6: {
        const struct sized_mask *sized = (void *)a[5];
        return pselect(a[0], (void *)a[1], (void *)a[2], (void *)a[3], (void *)a[4],
                       sized ? sized->mask : NULL);
    }
    case SYS_epoll_pwait: return epoll_pwait(a[0], (void *)a[1], a[2], a[3], (void *)a[4]);
#ifdef SYS_epoll_pwait2
    case SYS_epoll_pwait2:
        return epoll_pwait2(a[0], (void *)a[1], a[2], (void *)a[3], (void *)a[4]);
#endif
    case SYS_read: return read(a[0], (void *)a[1], a[2]);
    case SYS_write: return write(a[0], (void *)a[1], a[2]);
    case SYS_timerfd_create: return timerfd_create(a[0], a[1]);
    case SYS_timerfd_settime: return timerfd_settime(a[0], a[1], (void *)a[2], (void *)a[3]);
    case SYS_timerfd_gettime: return timerfd_gettime(a[0], (void *)a[1]);
    default: *is_known = false; return 0;
    }
}

/* Calls that look at a clock, sleep, or wait for threads and signals. */
static long clock_by_number(long number, const long a[6], bool *is_known)
{
    *is_known = true;
    switch (number) {
    case SYS_futex: return futex((uint32_t *)a[0], a[1], a[2], (void *)a[3], a[5]);
    case SYS_clock_gettime: return clock_gettime(a[0], (void *)a[1]);
    case SYS_gettimeofday: return gettimeofday((void *)a[0], (void *)a[1]);
    case SYS_nanosleep: return nanosleep((void *)a[0], (void *)a[1]);
    case SYS_clock_nanosleep:
        return (errno = clock_nanosleep(a[0], a[1], (void *)a[2], (void *)a[3])) ? -1 : 0;
    case SYS_sched_yield: return sched_yield();
    case SYS_setitimer: return setitimer(a[0], (void *)a[1], (void *)a[2]);
    case SYS_getitimer: return getitimer(a[0], (void *)a[1]);
#ifdef SYS_time
    case SYS_time: return time((void *)a[0]);
    case SYS_alarm: return alarm(a[0]);
    case SYS_pause: return pause();
#endif
    case SYS_rt_sigtimedwait: return sigtimedwait((void *)a[0], (void *)a[1], (void *)a[2]);
    case SYS_rt_sigsuspend: return sigsuspend((void *)a[0]);
    case SYS_timer_create: refuse_call("timer_create");
    case SYS_io_getevents: refuse_call("io_getevents");
#ifdef SYS_io_uring_enter
    case SYS_io_uring_enter: refuse_call("io_uring_enter");
#endif
#ifdef SYS_futex_waitv
    case SYS_futex_waitv: refuse_call("futex_waitv");
#endif
    default: *is_known = false; return 0;
    }
}

EXPORT long syscall(long number, ...)
{
    long a[6];
    bool is_known = false;
    va_list values;
    va_start(values, number);
    for (int i = 0; i < 6; i++) a[i] = va_arg(values, long);
    va_end(values);
    if (in_rig()) {
        long result = wait_by_number(number, a, &is_known);
        if (!is_known) result = clock_by_number(number, a, &is_known);
        if (is_known) return result;
    }
    return REAL(syscall)(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}
