/* Threads of C11, by those of POSIX: the C library's own do not pass through names that we replace.
 *
 * In glibc a mtx_t is a pthread_mutex_t, a cnd_t is a pthread_cond_t, and a thrd_t a pthread_t.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <sched.h>
#include <stdlib.h>
#include <threads.h>

_Static_assert(sizeof(mtx_t) == sizeof(pthread_mutex_t), "a mtx_t is a mutex");
_Static_assert(sizeof(cnd_t) == sizeof(pthread_cond_t), "a cnd_t is a condition variable");

struct start {
    thrd_start_t function;
    void *argument;
};

static int result_of(int error)
{
    switch (error) {
    case 0: return thrd_success;
    case EBUSY: return thrd_busy;
    case ENOMEM: return thrd_nomem;
    case ETIMEDOUT: return thrd_timedout;
    default: return thrd_error;
    }
}

static void *run(void *argument)
{
    struct start start = *(struct start *)argument;
    free(argument);
    return (void *)(intptr_t)start.function(start.argument);
}

EXPORT int thrd_create(thrd_t *id, thrd_start_t function, void *argument)
{
    if (!in_rig()) return REAL(thrd_create)(id, function, argument);
    struct start *start = malloc(sizeof *start);
    if (!start) return thrd_nomem;
    *start = (struct start){function, argument};
    int error = pthread_create(id, NULL, run, start);
    if (error) free(start);
    return result_of(error);
}

EXPORT int thrd_join(thrd_t id, int *status)
{
    void *value = NULL;
    if (!in_rig()) return REAL(thrd_join)(id, status);
    int error = pthread_join(id, &value);
    if (!error && status) *status = (intptr_t)value;
    return result_of(error);
}

EXPORT int thrd_sleep(const struct timespec *time, struct timespec *left)
{
    if (!in_rig()) return REAL(thrd_sleep)(time, left);
    int error = clock_nanosleep(CLOCK_REALTIME, 0, time, left);
    return error == EINTR ? -1 : error ? -2 : 0;
}

EXPORT void thrd_yield(void)
{
    sched_yield();
}

EXPORT int mtx_lock(mtx_t *mutex)
{
    if (!in_rig()) return REAL(mtx_lock)(mutex);
    return result_of(pthread_mutex_lock((pthread_mutex_t *)mutex));
}

EXPORT int mtx_trylock(mtx_t *mutex)
{
    if (!in_rig()) return REAL(mtx_trylock)(mutex);
    return result_of(pthread_mutex_trylock((pthread_mutex_t *)mutex));
}

EXPORT int mtx_timedlock(mtx_t *restrict mutex, const struct timespec *restrict until)
{
    if (!in_rig()) return REAL(mtx_timedlock)(mutex, until);
    return result_of(pthread_mutex_timedlock((pthread_mutex_t *)mutex, until));
}

EXPORT int cnd_wait(cnd_t *condition, mtx_t *mutex)
{
    if (!in_rig()) return REAL(cnd_wait)(condition, mutex);
    return result_of(pthread_cond_wait((pthread_cond_t *)condition, (pthread_mutex_t *)mutex));
}

EXPORT int cnd_timedwait(cnd_t *restrict condition, mtx_t *restrict mutex,
                         const struct timespec *restrict until)
{
    if (!in_rig()) return REAL(cnd_timedwait)(condition, mutex, until);
    return result_of(
        pthread_cond_timedwait((pthread_cond_t *)condition, (pthread_mutex_t *)mutex, until));
}

EXPORT int cnd_signal(cnd_t *condition)
{
    if (!in_rig()) return REAL(cnd_signal)(condition);
    return result_of(pthread_cond_signal((pthread_cond_t *)condition));
}

EXPORT int cnd_broadcast(cnd_t *condition)
{
    if (!in_rig()) return REAL(cnd_broadcast)(condition);
    return result_of(pthread_cond_broadcast((pthread_cond_t *)condition));
}
