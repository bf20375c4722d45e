/* Threads of C11: a worker is woken by a condition, and one waits until its deadline. */
#include <stdio.h>
#include <threads.h>
#include <time.h>

static mtx_t mutex;
static cnd_t condition;
static int is_set;

static int wait_for_flag(void *unused)
{
    (void)unused;
    mtx_lock(&mutex);
    while (!is_set) cnd_wait(&condition, &mutex);
    mtx_unlock(&mutex);
    printf("woken at %ld s\n", (long)time(NULL));
    return 7;
}

int main(void)
{
    thrd_t worker;
    struct timespec second = {1, 0}, until;
    int status = 0;
    mtx_init(&mutex, mtx_timed);
    cnd_init(&condition);
    if (thrd_create(&worker, wait_for_flag, NULL) != thrd_success) return 1;
    if (thrd_sleep(&second, NULL)) return 2;
    mtx_lock(&mutex);
    timespec_get(&until, TIME_UTC);
    until.tv_sec += 2;
    if (cnd_timedwait(&condition, &mutex, &until) != thrd_timedout) return 3;
    is_set = 1;
    cnd_signal(&condition);
    mtx_unlock(&mutex);
    if (thrd_join(worker, &status) != thrd_success || status != 7) return 4;
    printf("ended at %ld s\n", (long)time(NULL));
    return 0;
}
