/* Timers of a program: descriptors, signals, and threads.
 *
 * Each is an alarm: a period in the rig, which calls the library when it has passed. A timer of
 * POSIX counts as overrun what passes before its last signal is handled.
 *
 * Source: timerfd_create(2), timer_create(2), setitimer(2), POSIX.1-2017 timer_getoverrun().
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <limits.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <unistd.h>

#ifndef sigev_notify_thread_id
#define sigev_notify_thread_id _sigev_un._tid
#endif

enum { RECORD_EVERY = 21, RECORD_CANCEL };
enum { US_PER_S = 1000000, NS_PER_US = 1000 };
static const int64_t PERIOD_NS_MAX = 1000000000 * (int64_t)NS_PER_S;

struct __attribute__((packed)) every {
    uint8_t kind;
    uint32_t number;
    int64_t period_ns;
};
struct __attribute__((packed)) cancel {
    uint8_t kind;
    uint32_t number;
};

/* A timer that is a descriptor. */
struct timer {
    struct descriptor descriptor;
    struct alarm alarm;
    clockid_t clock;
};

/* A timer of timer_create(), or that of setitimer(). */
struct posix_timer {
    struct posix_timer *next;
    struct alarm alarm;
    clockid_t clock;
    struct sigevent event;
    struct thread *thread; /* that SIGEV_THREAD_ID names; NULL: any */
    int code;              /* of its signals */
    bool is_sent, is_deleted;
    int number;   /* in the information of its signals */
    int overruns; /* since its signal was sent */
    uint64_t due; /* calls of its function that have not begun */
};

static struct alarm *alarms; /* that run */
static uint32_t next_period = 1;
static struct posix_timer *posix_timers;

#define HOLDER(kind, alarm_) ((struct kind *)((char *)(alarm_) - offsetof(struct kind, alarm)))

static int failed(int error)
{
    errno = error;
    return -1;
}

/* ---- alarms ---------------------------------------------------------------------------------- */

void stop_alarm(struct alarm *alarm)
{
    struct cancel record = {RECORD_CANCEL, alarm->number};
    struct alarm **place = &alarms;
    if (!alarm->number) return;
    if (rig.state == JOINED) hold_record(&record, sizeof record);
    alarm->number = 0;
    while (*place != alarm) place = &(*place)->next;
    *place = alarm->next;
}

/* Let an alarm ring after a duration, and then in this interval; 0: once. */
void start_alarm(struct alarm *alarm, int64_t first_ns, int64_t interval_ns)
{
    stop_alarm(alarm);
    if (first_ns > PERIOD_NS_MAX) first_ns = PERIOD_NS_MAX;
    struct every record = {RECORD_EVERY, alarm->number = next_period++, first_ns};
    alarm->interval_ns = interval_ns;
    alarm->period_ns = first_ns;
    alarm->next_ns = rig.now_ns + first_ns;
    alarm->next = alarms;
    alarms = alarm;
    hold_record(&record, sizeof record);
}

void expire_alarm(uint32_t number)
{
    struct alarm *alarm = alarms;
    while (alarm && alarm->number != number) alarm = alarm->next;
    if (!alarm) return;
    if (alarm->period_ns == alarm->interval_ns)
        alarm->next_ns += alarm->interval_ns;
    else if (alarm->interval_ns) /* its first period had another length */
        start_alarm(alarm, alarm->interval_ns, alarm->interval_ns);
    else
        stop_alarm(alarm);
    alarm->ring(alarm);
}

/* Set an alarm as timer_settime() does; return how often it has expired by now. */
static uint64_t set_alarm(struct alarm *alarm, clockid_t clock, bool is_absolute,
                          const struct itimerspec *setting)
{
    uint64_t passed = 0;
    int64_t first_ns = duration_ns(&setting->it_value);
    int64_t interval_ns = duration_ns(&setting->it_interval);
    stop_alarm(alarm);
    alarm->interval_ns = interval_ns;
    if (!first_ns) return 0;
    first_ns = is_absolute ? first_ns - base_ns(clock) : deadline_after(first_ns);
    first_ns -= rig.now_ns;
    if (first_ns <= 0) { /* an instant that has passed: expirations since, the next in the grid */
        passed = interval_ns ? 1 - first_ns / interval_ns : 1;
        if (!interval_ns) return passed;
        first_ns = interval_ns - -first_ns % interval_ns;
    }
    start_alarm(alarm, first_ns, interval_ns);
    return passed;
}

static struct itimerspec setting_of(const struct alarm *alarm)
{
    int64_t left_ns = alarm->number ? alarm->next_ns - rig.now_ns : 0;
    return (struct itimerspec){timespec_of(alarm->interval_ns), timespec_of(left_ns)};
}

static bool is_setting(const struct itimerspec *setting)
{
    return is_duration(&setting->it_value) && is_duration(&setting->it_interval);
}

/* ---- descriptors ----------------------------------------------------------------------------- */

static void count_expiries(struct timer *timer, uint64_t count)
{
    if (REAL(write)(timer->descriptor.inner, &count, sizeof count) < 0 && errno != EAGAIN)
        refuse("program '%s': a timer has lost its descriptor", rig.name);
}

static void ring_descriptor(struct alarm *alarm)
{
    count_expiries(HOLDER(timer, alarm), 1);
}

EXPORT int timerfd_create(clockid_t clock, int flags)
{
    if (!in_rig()) return REAL(timerfd_create)(clock, flags);
    if (rig.state == AWAITING) join_rig();
    struct timer *timer = calloc(1, sizeof *timer);
    int fd = timer ? eventfd(0, flags & (TFD_NONBLOCK | TFD_CLOEXEC)) : -1;
    if (fd < 0) return -1;
    timer->clock = clock;
    timer->alarm.ring = ring_descriptor;
    timer->descriptor = (struct descriptor){.kind = TIMER, .inner = set_apart(dup(fd))};
    keep(fd, &timer->descriptor);
    return fd;
}

void close_timer(struct timer *timer)
{
    stop_alarm(&timer->alarm);
    free(timer);
}

static struct timer *timer_of(int fd)
{
    struct descriptor *descriptor = descriptor_of(fd);
    return descriptor && descriptor->kind == TIMER ? (struct timer *)descriptor : NULL;
}

EXPORT int timerfd_gettime(int fd, struct itimerspec *setting)
{
    struct timer *timer = timer_of(fd);
    if (!timer) return REAL(timerfd_gettime)(fd, setting);
    look();
    *setting = setting_of(&timer->alarm);
    return 0;
}

EXPORT int timerfd_settime(int fd, int flags, const struct itimerspec *setting,
                           struct itimerspec *old)
{
    struct timer *timer = timer_of(fd);
    struct pollfd input = {.fd = fd, .events = POLLIN};
    uint64_t count;
    if (!timer) return REAL(timerfd_settime)(fd, flags, setting, old);
    if (!is_setting(setting)) return failed(EINVAL);
    if (old) *old = setting_of(&timer->alarm);
    if (REAL(poll)(&input, 1, 0) > 0 && REAL(read)(fd, &count, sizeof count) < 0) return -1;
    uint64_t passed =
        set_alarm(&timer->alarm, timer->clock, flags & TFD_TIMER_ABSTIME, setting);
    if (passed) count_expiries(timer, passed);
    return 0;
}

/* ---- timers of POSIX ------------------------------------------------------------------------- */

static void ring_posix(struct alarm *alarm)
{
    struct posix_timer *timer = HOLDER(posix_timer, alarm);
    siginfo_t info = {.si_signo = timer->event.sigev_signo, .si_code = timer->code};
    switch (timer->event.sigev_notify) {
    case SIGEV_NONE: return;
    case SIGEV_THREAD: timer->due++; return;
    }
    if (timer->is_sent && is_signal_pending(timer, timer->thread, info.si_signo)) {
        timer->overruns += timer->overruns < INT_MAX;
        return;
    }
    timer->is_sent = true;
    timer->overruns = 0;
    if (timer->code == SI_TIMER) {
        info.si_value = timer->event.sigev_value;
        info.si_timerid = timer->number;
    }
    send_signal(timer->thread, &info, timer);
}

/* Note that the signal of a timer is handled now. */
void note_handling(struct posix_timer *timer, siginfo_t *info)
{
    timer->is_sent = false;
    if (timer->code == SI_TIMER) info->si_overrun = timer->overruns;
}

/* Note that a program takes a signal from the kernel, perhaps that of a timer. */
void note_taking(siginfo_t *info)
{
    struct posix_timer *timer = info->si_code == SI_TIMER ? posix_timers : NULL;
    while (timer && timer->number != info->si_timerid) timer = timer->next;
    if (timer) note_handling(timer, info);
}

static struct posix_timer *posix_timer_of(timer_t id)
{
    struct posix_timer *timer = rig.state == JOINED ? posix_timers : NULL;
    while (timer && (timer_t)timer != id) timer = timer->next;
    return timer;
}

/* ---- their threads */

struct call {
    void (*function)(union sigval);
    union sigval value;
};

static void *run_call(void *argument)
{
    struct call call = *(struct call *)argument;
    sigset_t none;
    free(argument);
    sigemptyset(&none);
    pthread_sigmask(SIG_SETMASK, &none, NULL);
    call.function(call.value);
    return NULL;
}

static bool is_due(void *timer)
{
    return ((struct posix_timer *)timer)->due || ((struct posix_timer *)timer)->is_deleted;
}

/* Start a thread for each expiry of a timer, as glibc does, until the timer is deleted. */
static void *start_calls(void *argument)
{
    struct posix_timer *timer = argument;
    sigset_t every;
    sigfillset(&every);
    pthread_sigmask(SIG_BLOCK, &every, NULL);
    for (;;) {
        if (!is_due(timer)) wait_turn(is_due, timer, NEVER, 0);
        if (timer->is_deleted) break;
        timer->due--;
        pthread_t id;
        struct call *call = malloc(sizeof *call);
        if (!call) refuse("program '%s': no memory for a call of a timer", rig.name);
        *call = (struct call){timer->event.sigev_notify_function, timer->event.sigev_value};
        int error = pthread_create(&id, timer->event.sigev_notify_attributes, run_call, call);
        if (error)
            refuse("program '%s': a call of a timer: no thread: %s", rig.name, strerror(error));
        pthread_detach(id);
    }
    free(timer);
    return NULL;
}

static int start_thread_of(struct posix_timer *timer)
{
    pthread_t id;
    int error = pthread_create(&id, NULL, start_calls, timer);
    if (!error) pthread_detach(id);
    return error;
}

/* ---- functions of timers */

static bool is_running_clock(clockid_t clock)
{
    return clock == CLOCK_REALTIME || clock == CLOCK_TAI || base_ns(clock);
}

EXPORT int timer_create(clockid_t clock, struct sigevent *event, timer_t *id)
{
    if (!in_rig()) return REAL(timer_create)(clock, event, id);
    if (!is_running_clock(clock) && clock != CLOCK_REALTIME_ALARM)
        refuse("program '%s' calls timer_create() with clock %d: not supported in the rig's time;"
               " expected CLOCK_MONOTONIC or CLOCK_REALTIME; joins = false lets the program run"
               " beside the rig",
               rig.name, clock);
    if (rig.state == AWAITING) join_rig();
    struct posix_timer *timer = calloc(1, sizeof *timer);
    if (!timer) return failed(EAGAIN);
    *timer = (struct posix_timer){.alarm = {.ring = ring_posix}, .clock = clock, .code = SI_TIMER};
    timer->event = (struct sigevent){.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGALRM};
    timer->event.sigev_value.sival_ptr = timer;
    if (event) timer->event = *event;
    int how = timer->event.sigev_notify, number = timer->event.sigev_signo, error = 0;
    if (how == SIGEV_THREAD_ID) timer->thread = thread_of_task(timer->event.sigev_notify_thread_id);
    if (how == SIGEV_THREAD)
        error = start_thread_of(timer);
    else if (how != SIGEV_NONE && (number < 1 || number > SIGRTMAX))
        error = EINVAL;
    else if (how == SIGEV_THREAD_ID ? !timer->thread : how != SIGEV_SIGNAL && how != SIGEV_NONE)
        error = EINVAL;
    if (error) {
        free(timer);
        return failed(error);
    }
    timer->number = posix_timers ? posix_timers->number + 1 : 0;
    timer->next = posix_timers;
    posix_timers = timer;
    *id = timer;
    return 0;
}

EXPORT int timer_settime(timer_t id, int flags, const struct itimerspec *setting,
                         struct itimerspec *old)
{
    struct posix_timer *timer = posix_timer_of(id);
    if (!in_rig()) return REAL(timer_settime)(id, flags, setting, old);
    if (!timer || !is_setting(setting)) return failed(EINVAL);
    if (old) *old = setting_of(&timer->alarm);
    timer->is_sent = false;
    uint64_t passed = set_alarm(&timer->alarm, timer->clock, flags & TIMER_ABSTIME, setting);
    if (!passed) return 0;
    ring_posix(&timer->alarm);
    timer->overruns = passed - 1 < INT_MAX ? passed - 1 : INT_MAX;
    return 0;
}

EXPORT int timer_gettime(timer_t id, struct itimerspec *setting)
{
    struct posix_timer *timer = posix_timer_of(id);
    if (!in_rig()) return REAL(timer_gettime)(id, setting);
    if (!timer) return failed(EINVAL);
    look();
    *setting = setting_of(&timer->alarm);
    return 0;
}

EXPORT int timer_getoverrun(timer_t id)
{
    struct posix_timer *timer = posix_timer_of(id);
    if (!in_rig()) return REAL(timer_getoverrun)(id);
    return timer ? timer->overruns : failed(EINVAL);
}

EXPORT int timer_delete(timer_t id)
{
    struct posix_timer *timer = posix_timer_of(id), **place = &posix_timers;
    if (!in_rig()) return REAL(timer_delete)(id);
    if (!timer) return failed(EINVAL);
    while (*place != timer) place = &(*place)->next;
    *place = timer->next;
    stop_alarm(&timer->alarm);
    drop_signals(timer);
    timer->is_deleted = true; /* its thread frees it */
    if (timer->event.sigev_notify != SIGEV_THREAD) free(timer);
    return 0;
}

/* ---- setitimer() ----------------------------------------------------------------------------- */

static struct posix_timer real_timer = {
    .alarm = {.ring = ring_posix},
    .clock = CLOCK_MONOTONIC,
    .event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGALRM},
    .code = SI_KERNEL,
};

static struct timeval timeval_of(struct timespec time)
{
    return (struct timeval){time.tv_sec, time.tv_nsec / NS_PER_US};
}

static struct timespec of_timeval(struct timeval time)
{
    return (struct timespec){time.tv_sec, time.tv_usec * NS_PER_US};
}

static void require_real(const char *call, int which)
{
    if (which != ITIMER_REAL)
        refuse("program '%s' calls %s() with a clock of the processor: not supported in the rig's"
               " time; expected ITIMER_REAL; joins = false lets the program run beside the rig",
               rig.name, call);
    if (rig.state == AWAITING) join_rig();
}

EXPORT int getitimer(__itimer_which_t which, struct itimerval *setting)
{
    if (!in_rig()) return REAL(getitimer)(which, setting);
    require_real("getitimer", which);
    look();
    struct itimerspec own = setting_of(&real_timer.alarm);
    *setting = (struct itimerval){timeval_of(own.it_interval), timeval_of(own.it_value)};
    return 0;
}

EXPORT int setitimer(__itimer_which_t which, const struct itimerval *restrict setting,
                     struct itimerval *restrict old)
{
    struct itimerspec own = {0};
    if (!in_rig()) return REAL(setitimer)(which, setting, old);
    require_real("setitimer", which);
    if (setting)
        own = (struct itimerspec){of_timeval(setting->it_interval), of_timeval(setting->it_value)};
    if (!is_setting(&own)) return failed(EINVAL);
    if (old) getitimer(which, old);
    set_alarm(&real_timer.alarm, real_timer.clock, false, &own);
    return 0;
}

EXPORT unsigned alarm(unsigned seconds)
{
    struct itimerval setting = {.it_value = {seconds, 0}}, old;
    if (!in_rig()) return REAL(alarm)(seconds);
    setitimer(ITIMER_REAL, &setting, &old);
    bool is_more = old.it_value.tv_usec >= US_PER_S / 2 || /* as Linux: never 0 for one that runs */
                   (!old.it_value.tv_sec && old.it_value.tv_usec);
    return old.it_value.tv_sec + is_more;
}

EXPORT useconds_t ualarm(useconds_t us, useconds_t interval_us)
{
    struct itimerval old, setting = {
        .it_interval = {interval_us / US_PER_S, interval_us % US_PER_S},
        .it_value = {us / US_PER_S, us % US_PER_S},
    };
    if (!in_rig()) return REAL(ualarm)(us, interval_us);
    setitimer(ITIMER_REAL, &setting, &old);
    return old.it_value.tv_sec * US_PER_S + old.it_value.tv_usec;
}
