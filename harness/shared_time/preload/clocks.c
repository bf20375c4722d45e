/* Clocks and sleeps.
 *
 * CLOCK_REALTIME begins at 0, as frame stamps do; CLOCK_MONOTONIC at 100,000 s. A look at a clock
 * costs 1 us, so that a loop that looks at one until a time has come ends. Costs are paid by a wait
 * once they are 1 ms: motorhil/harness/virtual_time/stdlib/threads.py has the same rule.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <sys/time.h>
#include <sys/times.h>
#include <unistd.h>

static const int64_t UPTIME_NS = 100000 * (int64_t)NS_PER_S,
                     END_NS = 1000000000 * (int64_t)NS_PER_S;
enum {
    LOOK_NS = 1000,
    SPIN_LOOK_NS = 10000,
    BILL_NS = 1000000,
    SPIN_BILLS = 10,
    TOLD_BILLS = 1000
};

static int64_t ahead_ns, paid_ns = -1; /* last value of a clock; end of the last payment */
static int bills;                      /* consecutive payments with nothing in between */

int64_t base_ns(clockid_t clock)
{
    switch (clock) {
    case CLOCK_MONOTONIC:
    case CLOCK_MONOTONIC_RAW:
    case CLOCK_MONOTONIC_COARSE:
    case CLOCK_BOOTTIME:
    case CLOCK_BOOTTIME_ALARM: return UPTIME_NS;
    default: return 0;
    }
}

/* Return the rig's time [ns], a little more at each look; this may wait. */
int64_t look(void)
{
    struct thread *me = thread_here;
    int step_ns = bills < SPIN_BILLS ? LOOK_NS : SPIN_LOOK_NS;
    if (rig.state == AWAITING) require_open_rig();
    if (!me || me->waits) return rig.now_ns; /* of a signal handler */
    ahead_ns = (ahead_ns > rig.now_ns ? ahead_ns : rig.now_ns) + step_ns;
    if (me->looked_ns != rig.now_ns) {
        me->looked_ns = rig.now_ns;
        me->owed_ns = 0;
    }
    me->owed_ns += step_ns;
    int64_t read_ns = me->read_ns = ahead_ns;
    if (me->owed_ns < BILL_NS) return read_ns;
    bills = rig.now_ns == paid_ns ? bills + 1 : 0;
    if (bills == TOLD_BILLS)
        tell("program '%s' polls without sleeping; each poll takes %d us of the rig's time; add a"
             " sleep",
             rig.name, SPIN_LOOK_NS / 1000);
    wait_turn(never, NULL, ahead_ns, 0);
    paid_ns = rig.now_ns;
    return read_ns;
}

bool is_duration(const struct timespec *duration)
{
    return duration->tv_sec >= 0 && duration->tv_nsec >= 0 && duration->tv_nsec < NS_PER_S;
}

int64_t duration_ns(const struct timespec *duration)
{
    if (duration->tv_sec >= END_NS / NS_PER_S) return END_NS;
    return duration->tv_sec * (int64_t)NS_PER_S + duration->tv_nsec;
}

struct timespec timespec_of(int64_t time_ns)
{
    return (struct timespec){time_ns / NS_PER_S, time_ns % NS_PER_S};
}

/* Return the time at the end of a duration that begins at this thread's last look. */
int64_t deadline_after(int64_t duration_ns)
{
    int64_t from_ns = rig.now_ns;
    if (thread_here && thread_here->read_ns > from_ns) from_ns = thread_here->read_ns;
    return duration_ns >= END_NS - from_ns ? END_NS : from_ns + duration_ns;
}

/* Return the rig's time at an instant of a clock, at least now. */
int64_t deadline_at(clockid_t clock, const struct timespec *instant)
{
    int64_t time_ns = instant->tv_sec < 0 ? 0 : duration_ns(instant) - base_ns(clock);
    return time_ns > rig.now_ns ? time_ns : rig.now_ns;
}

EXPORT int clock_gettime(clockid_t clock, struct timespec *now)
{
    if (!in_rig() || clock < 0 || clock > CLOCK_TAI) return REAL(clock_gettime)(clock, now);
    *now = timespec_of(base_ns(clock) + look());
    return 0;
}

EXPORT int clock_getres(clockid_t clock, struct timespec *resolution)
{
    if (!in_rig() || clock < 0 || clock > CLOCK_TAI) return REAL(clock_getres)(clock, resolution);
    if (resolution) *resolution = timespec_of(1);
    return 0;
}

EXPORT int timespec_get(struct timespec *now, int base)
{
    if (base != TIME_UTC) return 0;
    clock_gettime(CLOCK_REALTIME, now);
    return base;
}

EXPORT int gettimeofday(struct timeval *restrict now, void *restrict zone)
{
    if (!in_rig()) return REAL(gettimeofday)(now, zone);
    struct timespec time = timespec_of(look());
    *now = (struct timeval){time.tv_sec, time.tv_nsec / 1000};
    return 0;
}

EXPORT time_t time(time_t *now)
{
    if (!in_rig()) return REAL(time)(now);
    time_t now_s = look() / NS_PER_S;
    if (now) *now = now_s;
    return now_s;
}

EXPORT clock_t clock(void)
{
    if (!in_rig()) return REAL(clock)();
    return look() / (NS_PER_S / CLOCKS_PER_SEC);
}

/* The clock of the processor is the rig's, as that of clock(). */
EXPORT clock_t times(struct tms *used)
{
    if (!in_rig()) return REAL(times)(used);
    clock_t now = look() / (NS_PER_S / sysconf(_SC_CLK_TCK));
    if (used) *used = (struct tms){.tms_utime = now};
    return now + UPTIME_NS / (NS_PER_S / sysconf(_SC_CLK_TCK));
}

static int sleep_until(int64_t deadline_ns, struct timespec *left)
{
    if (wait_point(never, NULL, deadline_ns, 0) != INTERRUPTED) return 0;
    if (left) *left = timespec_of(deadline_ns - rig.now_ns);
    return EINTR;
}

static int64_t sleep_deadline(int64_t ns)
{
    return deadline_after(ns > LOOK_NS ? ns : LOOK_NS);
}

EXPORT int clock_nanosleep(clockid_t clock, int flags, const struct timespec *time,
                           struct timespec *left)
{
    if (!in_rig() || !is_duration(time)) return REAL(clock_nanosleep)(clock, flags, time, left);
    if (flags & TIMER_ABSTIME) return sleep_until(deadline_at(clock, time), NULL);
    return sleep_until(sleep_deadline(duration_ns(time)), left);
}

EXPORT int nanosleep(const struct timespec *time, struct timespec *left)
{
    if (!in_rig() || !is_duration(time)) return REAL(nanosleep)(time, left);
    int error = clock_nanosleep(CLOCK_MONOTONIC, 0, time, left);
    if (error) errno = error;
    return error ? -1 : 0;
}

EXPORT int usleep(useconds_t us)
{
    struct timespec time = timespec_of(us * (int64_t)1000);
    return nanosleep(&time, NULL);
}

EXPORT unsigned sleep(unsigned seconds)
{
    struct timespec time = {seconds, 0}, left = {0};
    return nanosleep(&time, &left) < 0 ? left.tv_sec : 0;
}
