/* Threads, and waits of one thread for another.
 *
 * Mutexes, semaphores and read-write locks are the C library's own: they are tried, and a thread
 * that would block waits in the rig's time. Nobody takes one meanwhile unseen, since one thread
 * runs at a time. Condition variables and futexes have queues here, by address; each wakes the
 * thread that waits longest.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <limits.h>
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

/* Functions that older C libraries do not declare. */
int sem_clockwait(sem_t *, clockid_t, const struct timespec *);
int pthread_cond_clockwait(pthread_cond_t *, pthread_mutex_t *, clockid_t, const struct timespec *);
int pthread_mutex_clocklock(pthread_mutex_t *, clockid_t, const struct timespec *);
int pthread_rwlock_clockrdlock(pthread_rwlock_t *, clockid_t, const struct timespec *);
int pthread_rwlock_clockwrlock(pthread_rwlock_t *, clockid_t, const struct timespec *);
int pthread_clockjoin_np(pthread_t, void **, clockid_t, const struct timespec *);

enum { PARTIES_MAX = 1024 };   /* of a program, in the rig */
enum { SHARED = 128 };         /* by processes: a mutex or semaphore of glibc */
struct thread *threads;        /* that have been started and not joined */
static uint16_t party_count = 1, free_parties[PARTIES_MAX];
static int free_count;
static pthread_key_t at_end;

/* ---- threads --------------------------------------------------------------------------------- */

/* Hand the turn on when a thread ends: as the last of its destructors, which may wait. */
static void end_thread(void *value)
{
    struct thread *me = value;
    if (++me->rounds < PTHREAD_DESTRUCTOR_ITERATIONS - 1) {
        pthread_setspecific(at_end, me);
        return;
    }
    if (!in_rig()) return;
    free_parties[free_count++] = me->party;
    me->has_finished = true;
    pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, NULL);
    hand_on();
}

void note_main_thread(void)
{
    first_thread.id = pthread_self();
    first_thread.task = REAL(syscall)(SYS_gettid);
    first_thread.has_begun = true;
    sem_init(&first_thread.baton, 0, 0);
    pthread_key_create(&at_end, end_thread);
    pthread_setspecific(at_end, &first_thread);
    threads = &first_thread;
}

static void *run_thread(void *argument)
{
    struct thread *me = thread_here = argument;
    me->task = REAL(syscall)(SYS_gettid);
    pthread_setspecific(at_end, me);
    await_baton(me);
    free(me->first_wait);
    me->waits = false;
    me->has_begun = true;
    return me->start(me->argument);
}

static struct thread **place_of(pthread_t id)
{
    struct thread **place = &threads;
    while (*place && !pthread_equal((*place)->id, id)) place = &(*place)->next;
    return place;
}

struct thread *thread_of(pthread_t id)
{
    return *place_of(id);
}

/* Return the thread with this number in the kernel, or NULL. */
struct thread *thread_of_task(pid_t task)
{
    struct thread *thread = threads;
    while (thread && (thread->task != task || thread->has_finished)) thread = thread->next;
    return thread;
}

static void forget(pthread_t id)
{
    struct thread **place = place_of(id), *thread = *place;
    if (!thread) return;
    *place = thread->next;
    if (thread != &first_thread && thread->has_finished) free(thread);
}

EXPORT int pthread_create(pthread_t *id, const pthread_attr_t *attributes, void *(*start)(void *),
                          void *argument)
{
    if (!in_rig()) return REAL(pthread_create)(id, attributes, start, argument);
    if (rig.state == AWAITING) join_rig();
    bool is_new = !free_count;
    struct thread *thread = calloc(1, sizeof *thread);
    struct wait *wait = calloc(1, sizeof *wait); /* for its first turn */
    if (!thread || !wait || (is_new && party_count == PARTIES_MAX)) {
        free(thread);
        free(wait);
        return EAGAIN;
    }
    *wait = (struct wait){.thread = thread, .holds = at_once};
    *thread =
        (struct thread){.start = start, .argument = argument, .waits = true, .first_wait = wait};
    thread->party = is_new ? party_count : free_parties[free_count - 1];
    sem_init(&thread->baton, 0, 0);
    int error = REAL(pthread_create)(&thread->id, attributes, run_thread, thread);
    if (error) {
        free(thread);
        free(wait);
        return error;
    }
    if (is_new)
        name_party(party_count++);
    else
        free_count--;
    *id = thread->id;
    forget(thread->id); /* of a detached thread, which has ended */
    thread->next = threads;
    threads = thread;
    begin_wait(wait, NEVER, 0);
    return 0;
}

static bool is_finished(void *thread)
{
    return ((struct thread *)thread)->has_finished;
}

static int join_until(pthread_t id, void **value, int64_t deadline_ns)
{
    struct thread *thread = *place_of(id);
    if (thread && thread != thread_here)
        while (!thread->has_finished)
            if (wait_point(is_finished, thread, deadline_ns, ON_PARTIES) == EXPIRED)
                return ETIMEDOUT;
    int error = REAL(pthread_join)(id, value);
    if (!error) forget(id);
    return error;
}

EXPORT int pthread_join(pthread_t id, void **value)
{
    return in_rig() ? join_until(id, value, NEVER) : REAL(pthread_join)(id, value);
}

EXPORT int pthread_clockjoin_np(pthread_t id, void **value, clockid_t clock,
                                const struct timespec *until)
{
    if (!in_rig()) return REAL(pthread_clockjoin_np)(id, value, clock, until);
    return join_until(id, value, deadline_at(clock, until));
}

EXPORT int pthread_timedjoin_np(pthread_t id, void **value, const struct timespec *until)
{
    if (!in_rig()) return REAL(pthread_timedjoin_np)(id, value, until);
    return join_until(id, value, deadline_at(CLOCK_REALTIME, until));
}

EXPORT int pthread_tryjoin_np(pthread_t id, void **value)
{
    struct thread *thread = in_rig() ? *place_of(id) : NULL;
    if (!thread) return REAL(pthread_tryjoin_np)(id, value);
    if (thread->has_finished) return join_until(id, value, NEVER);
    look();
    return EBUSY;
}

/* Wake the thread in its wait; it ends there once it has the turn. */
EXPORT int pthread_cancel(pthread_t id)
{
    struct thread *thread = in_rig() ? *place_of(id) : NULL;
    if (thread) thread->is_cancelled = true;
    return REAL(pthread_cancel)(id);
}

EXPORT int sched_yield(void)
{
    if (rig.state != JOINED || !in_rig() || !thread_here || thread_here->waits)
        return REAL(sched_yield)();
    look();
    wait_turn(never, NULL, rig.now_ns, 0);
    return 0;
}

/* Return the flags of a wait for other threads; also for those of other programs, if its object is
 * in memory that they share. */
static int on_peers(bool is_shared)
{
    return ON_PARTIES | (is_shared ? ON_PROCESSES : 0);
}

/* ---- mutexes --------------------------------------------------------------------------------- */

static bool is_free(void *mutex)
{
    return !(((pthread_mutex_t *)mutex)->__data.__lock & FUTEX_TID_MASK);
}

/* Return whether a thread holds the mutex that runs beside the turn, since it has ended but for
 * what the C library does then. It gives the mutex back without a turn. */
static bool is_held_beside(const pthread_mutex_t *mutex)
{
    pid_t owner = mutex->__data.__owner;
    for (struct thread *thread = threads; thread; thread = thread->next)
        if (thread->task == owner && !thread->has_finished) return false;
    return owner && REAL(syscall)(SYS_tgkill, getpid(), owner, 0) == 0;
}

static int lock_until(pthread_mutex_t *mutex, int64_t deadline_ns)
{
    int error, flags = on_peers(mutex->__data.__kind & SHARED);
    while ((error = REAL(pthread_mutex_trylock)(mutex)) == EBUSY)
        if (is_held_beside(mutex))
            REAL(sched_yield)();
        else if (wait_turn(is_free, mutex, deadline_ns, flags) == EXPIRED)
            return ETIMEDOUT;
    return error;
}

EXPORT int pthread_mutex_lock(pthread_mutex_t *mutex)
{
    if (rig.state != JOINED || !in_rig() || !thread_here) return REAL(pthread_mutex_lock)(mutex);
    if (thread_here->waits) refuse("program '%s' locks a mutex in a signal handler", rig.name);
    int type = mutex->__data.__kind & 3;
    if (type == PTHREAD_MUTEX_ERRORCHECK && mutex->__data.__owner == thread_here->task)
        return EDEADLK;
    return lock_until(mutex, NEVER);
}

EXPORT int pthread_mutex_trylock(pthread_mutex_t *mutex)
{
    int error = REAL(pthread_mutex_trylock)(mutex);
    if (error == EBUSY && in_rig()) look();
    return error;
}

EXPORT int pthread_mutex_clocklock(pthread_mutex_t *mutex, clockid_t clock,
                                   const struct timespec *until)
{
    if (!in_rig()) return REAL(pthread_mutex_clocklock)(mutex, clock, until);
    return lock_until(mutex, deadline_at(clock, until));
}

EXPORT int pthread_mutex_timedlock(pthread_mutex_t *restrict mutex,
                                   const struct timespec *restrict until)
{
    if (!in_rig()) return REAL(pthread_mutex_timedlock)(mutex, until);
    return lock_until(mutex, deadline_at(CLOCK_REALTIME, until));
}

/* ---- queues by address: condition variables, futexes, read-write locks ----------------------- */

struct sleeper {
    const void *address;
    uint32_t bits; /* of a futex */
    bool is_woken;
};

static bool is_woken(void *sleeper)
{
    return ((struct sleeper *)sleeper)->is_woken;
}

static int wake(const void *address, int count, uint32_t bits)
{
    int woken = 0;
    for (struct wait *wait = rig.waits; wait && woken < count; wait = wait->next) {
        struct sleeper *sleeper = wait->subject;
        if (wait->holds != is_woken || sleeper->address != address || sleeper->is_woken) continue;
        if (!(sleeper->bits & bits)) continue;
        sleeper->is_woken = true;
        woken++;
    }
    return woken;
}

_Noreturn static void refuse_shared(const char *call)
{
    refuse("program '%s' calls %s() for an object that processes share: not supported in the rig's"
           " time; expected a semaphore or a mutex; joins = false lets the program run beside the"
           " rig",
           rig.name, call);
}

/* Processes that share a condition variable count its signals in its memory. Each signal wakes all
 * that wait, as POSIX allows. */
struct listener {
    const unsigned *signals;
    unsigned before;
};

static bool is_cond_shared(const pthread_cond_t *cond)
{
    return cond->__data.__wrefs & 1;
}

static unsigned *signals_of(pthread_cond_t *cond)
{
    return &cond->__data.__g_size[0]; /* which glibc's functions use, that these replace */
}

static bool is_signalled(void *listener)
{
    return *((struct listener *)listener)->signals != ((struct listener *)listener)->before;
}

static int cond_until(pthread_cond_t *cond, pthread_mutex_t *mutex, int64_t deadline_ns)
{
    struct sleeper mine = {.address = cond, .bits = ~0u};
    struct listener shared = {signals_of(cond), *signals_of(cond)};
    bool is_shared = is_cond_shared(cond);
    int error = pthread_mutex_unlock(mutex);
    if (error) return error;
    enum result result = wait_turn(is_shared ? is_signalled : is_woken,
                                   is_shared ? (void *)&shared : &mine, deadline_ns,
                                   on_peers(is_shared) | CANCELLABLE);
    error = lock_until(mutex, NEVER);
    if (thread_here->is_cancelled) pthread_testcancel();
    return error ? error : result == EXPIRED ? ETIMEDOUT : 0;
}

EXPORT int pthread_cond_wait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex)
{
    return in_rig() ? cond_until(cond, mutex, NEVER) : REAL(pthread_cond_wait)(cond, mutex);
}

EXPORT int pthread_cond_timedwait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex,
                                  const struct timespec *restrict until)
{
    if (!in_rig() || !is_duration(until)) return REAL(pthread_cond_timedwait)(cond, mutex, until);
    bool is_monotonic = cond->__data.__wrefs & 2; /* by pthread_condattr_setclock */
    return cond_until(cond, mutex,
                      deadline_at(is_monotonic ? CLOCK_MONOTONIC : CLOCK_REALTIME, until));
}

EXPORT int pthread_cond_clockwait(pthread_cond_t *cond, pthread_mutex_t *mutex, clockid_t clock,
                                  const struct timespec *until)
{
    if (!in_rig() || !is_duration(until))
        return REAL(pthread_cond_clockwait)(cond, mutex, clock, until);
    return cond_until(cond, mutex, deadline_at(clock, until));
}

EXPORT int pthread_cond_signal(pthread_cond_t *cond)
{
    if (!in_rig()) return REAL(pthread_cond_signal)(cond);
    if (is_cond_shared(cond)) ++*signals_of(cond);
    wake(cond, 1, ~0u);
    return 0;
}

EXPORT int pthread_cond_broadcast(pthread_cond_t *cond)
{
    if (!in_rig()) return REAL(pthread_cond_broadcast)(cond);
    if (is_cond_shared(cond)) ++*signals_of(cond);
    wake(cond, INT_MAX, ~0u);
    return 0;
}

static int rwlock_until(pthread_rwlock_t *lock, int (*attempt)(pthread_rwlock_t *),
                        int64_t deadline_ns)
{
    int error;
    while ((error = attempt(lock)) == EBUSY) {
        struct sleeper mine = {.address = lock, .bits = ~0u};
        if (wait_turn(is_woken, &mine, deadline_ns, ON_PARTIES) == EXPIRED) return ETIMEDOUT;
    }
    return error;
}

#define RWLOCK(kind)                                                                          \
    EXPORT int pthread_rwlock_##kind##lock(pthread_rwlock_t *lock)                            \
    {                                                                                         \
        if (rig.state != JOINED || !in_rig()) return REAL(pthread_rwlock_##kind##lock)(lock); \
        return rwlock_until(lock, REAL(pthread_rwlock_try##kind##lock), NEVER);               \
    }                                                                                         \
    EXPORT int pthread_rwlock_clock##kind##lock(pthread_rwlock_t *lock, clockid_t clock,      \
                                                const struct timespec *until)                 \
    {                                                                                         \
        if (!in_rig()) return REAL(pthread_rwlock_clock##kind##lock)(lock, clock, until);     \
        return rwlock_until(lock, REAL(pthread_rwlock_try##kind##lock),                       \
                            deadline_at(clock, until));                                       \
    }                                                                                         \
    EXPORT int pthread_rwlock_timed##kind##lock(pthread_rwlock_t *restrict lock,              \
                                                const struct timespec *restrict until)        \
    {                                                                                         \
        if (!in_rig()) return REAL(pthread_rwlock_timed##kind##lock)(lock, until);            \
        return pthread_rwlock_clock##kind##lock(lock, CLOCK_REALTIME, until);                 \
    }
RWLOCK(rd)
RWLOCK(wr)

EXPORT int pthread_rwlock_init(pthread_rwlock_t *restrict lock,
                               const pthread_rwlockattr_t *restrict attributes)
{
    int is_shared = 0;
    if (attributes) pthread_rwlockattr_getpshared(attributes, &is_shared);
    if (is_shared && in_rig()) refuse_shared("pthread_rwlock_init");
    return REAL(pthread_rwlock_init)(lock, attributes);
}

EXPORT int pthread_rwlock_unlock(pthread_rwlock_t *lock)
{
    int error = REAL(pthread_rwlock_unlock)(lock);
    if (!error && in_rig()) wake(lock, INT_MAX, ~0u); /* each tries again, the longest first */
    return error;
}

/* ---- pthread_once ---------------------------------------------------------------------------- */

enum { ONCE_RUNS = 1, ONCE_DONE = 2 }; /* bits of a pthread_once_t in glibc */

static bool runs_no_more(void *once)
{
    return (*(pthread_once_t *)once & (ONCE_RUNS | ONCE_DONE)) != ONCE_RUNS;
}

/* Wait for a thread that runs the function, which may wait itself. */
EXPORT int pthread_once(pthread_once_t *once, void (*function)(void))
{
    if (rig.state == JOINED && !runs_no_more(once) && in_rig() && thread_here &&
        !thread_here->waits)
        wait_turn(runs_no_more, once, NEVER, ON_PARTIES);
    return REAL(pthread_once)(once, function);
}

/* ---- barriers -------------------------------------------------------------------------------- */

static struct barrier {
    struct barrier *next;
    const void *address;
    unsigned count, waiting;
} *barriers;

static struct barrier **barrier_at(const void *address)
{
    struct barrier **place = &barriers;
    while (*place && (*place)->address != address) place = &(*place)->next;
    return place;
}

EXPORT int pthread_barrier_init(pthread_barrier_t *restrict address,
                                const pthread_barrierattr_t *restrict attributes, unsigned count)
{
    int is_shared = 0, error = REAL(pthread_barrier_init)(address, attributes, count);
    if (error || !in_rig()) return error;
    if (attributes) pthread_barrierattr_getpshared(attributes, &is_shared);
    if (is_shared) refuse_shared("pthread_barrier_init");
    struct barrier *barrier = *barrier_at(address);
    if (!barrier) barrier = malloc(sizeof *barrier);
    if (!barrier) return ENOMEM;
    if (!*barrier_at(address)) {
        barrier->next = barriers;
        barriers = barrier;
    }
    barrier->address = address;
    barrier->count = count;
    barrier->waiting = 0;
    return 0;
}

EXPORT int pthread_barrier_destroy(pthread_barrier_t *address)
{
    struct barrier **place = barrier_at(address), *barrier = *place;
    if (barrier) {
        *place = barrier->next;
        free(barrier);
    }
    return REAL(pthread_barrier_destroy)(address);
}

EXPORT int pthread_barrier_wait(pthread_barrier_t *address)
{
    struct barrier *barrier = in_rig() ? *barrier_at(address) : NULL;
    struct sleeper mine = {.address = address, .bits = ~0u};
    if (!barrier) return REAL(pthread_barrier_wait)(address);
    if (++barrier->waiting == barrier->count) {
        barrier->waiting = 0;
        wake(address, INT_MAX, ~0u);
        return PTHREAD_BARRIER_SERIAL_THREAD;
    }
    wait_turn(is_woken, &mine, NEVER, ON_PARTIES);
    return 0;
}

/* ---- semaphores ------------------------------------------------------------------------------ */

static bool has_count(void *semaphore)
{
    int value = 0;
    sem_getvalue(semaphore, &value);
    return value > 0;
}

static int sem_until(sem_t *semaphore, int64_t deadline_ns)
{
    int flags = RESTARTS | on_peers(((const int *)semaphore)[sizeof(long) / sizeof(int)] & SHARED);
    while (REAL(sem_trywait)(semaphore) < 0) {
        if (errno != EAGAIN) return -1;
        enum result result = wait_point(has_count, semaphore, deadline_ns, flags);
        if (result == HOLDS) continue;
        errno = result == EXPIRED ? ETIMEDOUT : EINTR;
        return -1;
    }
    return 0;
}

EXPORT int sem_wait(sem_t *semaphore)
{
    return in_rig() ? sem_until(semaphore, NEVER) : REAL(sem_wait)(semaphore);
}

EXPORT int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until)
{
    if (!in_rig() || !is_duration(until)) return REAL(sem_timedwait)(semaphore, until);
    return sem_until(semaphore, deadline_at(CLOCK_REALTIME, until));
}

EXPORT int sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *until)
{
    if (!in_rig() || !is_duration(until)) return REAL(sem_clockwait)(semaphore, clock, until);
    return sem_until(semaphore, deadline_at(clock, until));
}

EXPORT int sem_trywait(sem_t *semaphore)
{
    int result = REAL(sem_trywait)(semaphore);
    if (result < 0 && errno == EAGAIN && in_rig()) {
        look();
        errno = EAGAIN;
    }
    return result;
}

/* ---- futexes: of std::future, static variables, Rust ----------------------------------------- */

long futex(uint32_t *word, int operation, uint32_t value, const struct timespec *time,
           uint32_t bits)
{
    bool is_absolute = (operation & FUTEX_CMD_MASK) == FUTEX_WAIT_BITSET;
    struct sleeper mine = {.address = word, .bits = is_absolute ? bits : ~0u};
    int64_t deadline_ns = NEVER;
    switch (operation & FUTEX_CMD_MASK) {
    case FUTEX_WAKE: return wake(word, value, ~0u);
    case FUTEX_WAKE_BITSET: return wake(word, value, bits);
    case FUTEX_WAIT:
    case FUTEX_WAIT_BITSET: break;
    default:
        refuse("program '%s': futex operation %d: not supported; expected FUTEX_WAIT or FUTEX_WAKE;"
               " joins = false lets the program run beside the rig",
               rig.name, operation);
    }
    if (__atomic_load_n(word, __ATOMIC_SEQ_CST) != value) {
        errno = EAGAIN;
        return -1;
    }
    clockid_t clock = operation & FUTEX_CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC;
    if (time)
        deadline_ns = is_absolute ? deadline_at(clock, time) : deadline_after(duration_ns(time));
    enum result result = wait_turn(is_woken, &mine, deadline_ns, ON_PARTIES);
    if (result == HOLDS) return 0;
    errno = result == EXPIRED ? ETIMEDOUT : EINTR;
    return -1;
}
