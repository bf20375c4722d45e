/* Signals of the program to itself: by kill() and the like, and by its timers.
 *
 * A signal ends the wait of its thread, which handles it once it has the turn. So a handler has the
 * rig's time, may wait, and may send frames. One for the process goes to the first thread that does
 * not block it, the main thread before all others. One that all block waits in the kernel, where
 * sigwait(), signalfd and ppoll() find it.
 *
 * Signals of other processes are not seen here. The kernel runs their handlers at once.
 *
 * Source: signal(7), Linux kernel/signal.c.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

/* A signal that its thread handles when it has the turn. */
struct sent {
    struct sent *next; /* a later one */
    siginfo_t info;
    struct posix_timer *timer; /* NULL: of none */
};

static const struct timespec no_time = {0, 0};

static int failed(int error)
{
    errno = error;
    return -1;
}

/* ---- what the kernel knows ------------------------------------------------------------------- */

static uint64_t bit_of(int number)
{
    return (uint64_t)1 << (number - 1);
}

/* Return a set of signals of a thread, by its name in /proc/PID/status. */
static uint64_t set_of(pid_t task, const char *name)
{
    char path[64], text[4096];
    snprintf(path, sizeof path, "/proc/self/task/%d/status", task);
    int fd = REAL(syscall)(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) return 0;
    ssize_t size = REAL(read)(fd, text, sizeof text - 1);
    REAL(close)(fd);
    text[size > 0 ? size : 0] = 0;
    const char *place = strstr(text, name);
    return place ? strtoull(place + strlen(name), NULL, 16) : 0;
}

static bool blocks(const struct thread *thread, int number)
{
    if (thread->mask) return sigismember(thread->mask, number) == 1; /* that of ppoll() */
    return set_of(thread->task, "\nSigBlk:\t") & bit_of(number);
}

static bool is_ignored(int number)
{
    struct sigaction action;
    if (sigaction(number, NULL, &action) < 0) return false;
    if (action.sa_handler == SIG_IGN) return true;
    bool by_default = number == SIGCHLD || number == SIGURG || number == SIGWINCH;
    return action.sa_handler == SIG_DFL && (by_default || number == SIGCONT);
}

/* Give a signal to the kernel, for a thread or, with NULL, for the process. Threads other than the
 * main one cannot say that it comes from kill(), a thread or the kernel. */
static void give(const struct thread *to, siginfo_t *info)
{
    pid_t process = getpid();
    int number = info->si_signo;
    long result;
    if (to)
        result = REAL(syscall)(SYS_rt_tgsigqueueinfo, process, to->task, number, info);
    else
        result = REAL(syscall)(SYS_rt_sigqueueinfo, process, number, info);
    if (result < 0 && errno == EPERM) {
        if (to)
            REAL(syscall)(SYS_tgkill, process, to->task, number);
        else
            REAL(kill)(process, number);
    }
}

/* ---- sending --------------------------------------------------------------------------------- */

static bool takes(const struct thread *thread, int number)
{
    return !thread->has_finished && thread->has_begun && !blocks(thread, number);
}

/* Return the thread that handles a signal of the process; NULL if all block it. */
static struct thread *receiver(int number)
{
    if (takes(&first_thread, number)) return &first_thread;
    for (struct thread *thread = threads; thread; thread = thread->next)
        if (thread != &first_thread && takes(thread, number)) return thread;
    return NULL;
}

/* Send a signal to a thread or, with NULL, to the process. */
void send_signal(struct thread *to, siginfo_t *info, struct posix_timer *timer)
{
    int number = info->si_signo;
    struct thread *thread = !to ? receiver(number) : takes(to, number) ? to : NULL;
    if (!thread || (thread == thread_here && !thread->waits)) {
        if (thread && timer) note_handling(timer, info);
        give(thread ? thread : to, info);
        return;
    }
    if (is_ignored(number)) return;
    struct sent **place = &thread->sent, *sent = malloc(sizeof *sent);
    while (*place && number < SIGRTMIN && (*place)->info.si_signo != number)
        place = &(*place)->next;
    if (*place && number < SIGRTMIN) { /* it waits already: standard signals do not queue */
        free(sent);
        return;
    }
    if (!sent) refuse("program '%s': no memory for a signal", rig.name);
    while (*place) place = &(*place)->next;
    *sent = (struct sent){NULL, *info, timer};
    *place = sent;
}

/* Return whether the last signal of a timer is not yet handled. */
bool is_signal_pending(const struct posix_timer *timer, const struct thread *to, int number)
{
    for (const struct thread *thread = threads; thread; thread = thread->next)
        for (const struct sent *sent = thread->sent; sent; sent = sent->next)
            if (sent->timer == timer) return true;
    const struct thread *thread = to ? to : &first_thread;
    const char *name = to ? "\nSigPnd:\t" : "\nShdPnd:\t";
    return set_of(thread->has_finished ? getpid() : thread->task, name) & bit_of(number);
}

/* Forget the signals of a timer that is deleted. */
void drop_signals(const struct posix_timer *timer)
{
    for (struct thread *thread = threads; thread; thread = thread->next)
        for (struct sent **place = &thread->sent; *place;) {
            struct sent *sent = *place;
            if (sent->timer != timer) {
                place = &sent->next;
                continue;
            }
            *place = sent->next;
            free(sent);
        }
}

/* Handle the signals of this thread, which has the turn. Return whether there were some; set
 * *restarts to false if one of them ends a call that would begin again (SA_RESTART). */
bool handle_signals(bool *restarts)
{
    struct thread *me = thread_here;
    bool are_some = me->sent != NULL;
    while (me->sent) {
        struct sent *sent = me->sent, taken = *sent;
        struct sigaction action;
        me->sent = sent->next;
        free(sent);
        if (sigaction(taken.info.si_signo, NULL, &action) < 0 || !(action.sa_flags & SA_RESTART))
            *restarts = false;
        if (taken.timer) note_handling(taken.timer, &taken.info);
        give(me, &taken.info); /* its handler runs before this returns */
    }
    return are_some;
}

/* ---- kill() and the like --------------------------------------------------------------------- */

static bool is_ours(int number)
{
    return number > 0 && number <= SIGRTMAX && number != SIGKILL && number != SIGSTOP &&
           rig.state == JOINED && in_rig() && thread_here;
}

static siginfo_t own_signal(int number, int code)
{
    siginfo_t info = {.si_signo = number, .si_code = code};
    info.si_pid = getpid();
    info.si_uid = getuid();
    return info;
}

EXPORT int pthread_kill(pthread_t id, int number)
{
    struct thread *thread = is_ours(number) ? thread_of(id) : NULL;
    if (!thread || thread == thread_here) return REAL(pthread_kill)(id, number);
    siginfo_t info = own_signal(number, SI_TKILL);
    send_signal(thread, &info, NULL);
    return 0;
}

EXPORT int pthread_sigqueue(pthread_t id, int number, const union sigval value)
{
    struct thread *thread = is_ours(number) ? thread_of(id) : NULL;
    if (!thread || thread == thread_here) return REAL(pthread_sigqueue)(id, number, value);
    siginfo_t info = own_signal(number, SI_QUEUE);
    info.si_value = value;
    send_signal(thread, &info, NULL);
    return 0;
}

EXPORT int kill(pid_t process, int number)
{
    if (!is_ours(number) || process != rig.pid) return REAL(kill)(process, number);
    siginfo_t info = own_signal(number, SI_USER);
    send_signal(NULL, &info, NULL);
    return 0;
}

EXPORT int sigqueue(pid_t process, int number, const union sigval value)
{
    if (!is_ours(number) || process != rig.pid) return REAL(sigqueue)(process, number, value);
    siginfo_t info = own_signal(number, SI_QUEUE);
    info.si_value = value;
    send_signal(NULL, &info, NULL);
    return 0;
}

/* ---- waits for signals ----------------------------------------------------------------------- */

EXPORT int pause(void)
{
    if (!in_rig()) return REAL(pause)();
    while (wait_point(never, NULL, NEVER, 0) != INTERRUPTED) continue;
    return failed(EINTR);
}

/* Return whether a signal that waits in the kernel is not in this mask. */
static bool is_released(const sigset_t *mask)
{
    pid_t task = thread_here->task;
    uint64_t pending = set_of(task, "\nSigPnd:\t") | set_of(task, "\nShdPnd:\t");
    for (int number = 1; number <= SIGRTMAX; number++)
        if (pending & bit_of(number) && !sigismember(mask, number)) return true;
    return false;
}

EXPORT int sigsuspend(const sigset_t *mask)
{
    if (rig.state != JOINED || !in_rig()) return REAL(sigsuspend)(mask); /* of a shell */
    thread_here->mask = mask;
    enum result result = HOLDS;
    if (!is_released(mask)) result = wait_point(never, NULL, NEVER, 0);
    thread_here->mask = NULL;
    return result == INTERRUPTED && !is_released(mask) ? failed(EINTR) : REAL(sigsuspend)(mask);
}

static bool has_arrived(void *subject)
{
    const struct thread *thread = subject;
    uint64_t pending = set_of(thread->task, "\nSigPnd:\t") | set_of(thread->task, "\nShdPnd:\t");
    for (int number = 1; number <= SIGRTMAX; number++)
        if (pending & bit_of(number) && sigismember(thread->awaited, number) == 1) return true;
    return false;
}

static int take_signal(const sigset_t *set, siginfo_t *info)
{
    siginfo_t own;
    int number = REAL(sigtimedwait)(set, &own, &no_time);
    if (number > 0) note_taking(&own);
    if (number > 0 && info) *info = own;
    return number;
}

static int await_signal(const sigset_t *set, siginfo_t *info, int64_t deadline_ns)
{
    if (rig.state == AWAITING) join_rig();
    for (;;) {
        int number = take_signal(set, info);
        if (number > 0 || errno != EAGAIN) return number;
        if (deadline_ns != NEVER && deadline_ns <= rig.now_ns) {
            look();
            return failed(EAGAIN);
        }
        thread_here->awaited = set;
        enum result result = wait_point(has_arrived, thread_here, deadline_ns, 0);
        if (result != INTERRUPTED) continue;
        number = take_signal(set, info);
        return number > 0 ? number : failed(EINTR);
    }
}

EXPORT int sigtimedwait(const sigset_t *restrict set, siginfo_t *restrict info,
                        const struct timespec *restrict timeout)
{
    if (!in_rig() || (timeout && !is_duration(timeout)))
        return REAL(sigtimedwait)(set, info, timeout);
    return await_signal(set, info, timeout ? deadline_after(duration_ns(timeout)) : NEVER);
}

EXPORT int sigwaitinfo(const sigset_t *restrict set, siginfo_t *restrict info)
{
    return in_rig() ? await_signal(set, info, NEVER) : REAL(sigwaitinfo)(set, info);
}

EXPORT int sigwait(const sigset_t *restrict set, int *restrict number)
{
    int found;
    if (!in_rig()) return REAL(sigwait)(set, number);
    do found = await_signal(set, NULL, NEVER);
    while (found < 0 && errno == EINTR);
    if (found < 0) return errno;
    *number = found;
    return 0;
}
