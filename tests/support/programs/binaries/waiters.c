/* Waits in four threads, each in its own way, until the times that a file names.
 *
 * Each line of the file is a case: four pairs KIND:MS. A kind in capitals has no deadline of its
 * own; another thread ends the wait at that time. The order of waking is printed with the times.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define THREADS 4
#define UPTIME_S 100000

struct waiter {
    char kind;
    long ms;
    int number;
    pthread_t thread, ender;
    pthread_mutex_t mutex, held;
    pthread_cond_t cond, monotonic;
    sem_t semaphore;
    uint32_t word;
    int is_set, pipe[2];
};

static long second; /* at which the case begins, in the rig's time */
static struct {
    int number;
    long us;
} woken[THREADS];
static int woken_count;

static void require(int holds, const char *what)
{
    if (holds) return;
    printf("failed: %s: %s\n", what, strerror(errno));
    exit(1);
}

static struct timespec at(const struct waiter *me, long base_s)
{
    return (struct timespec){base_s + second + me->ms / 1000, me->ms % 1000 * 1000000};
}

static void wait_timer(struct waiter *me, int is_relative, int how)
{
    struct itimerspec setting = {.it_value = at(me, UPTIME_S)};
    struct epoll_event event = {.events = EPOLLIN | EPOLLET};
    uint64_t count = 0;
    if (is_relative) setting.it_value = (struct timespec){me->ms / 1000, me->ms % 1000 * 1000000};
    int timer = timerfd_create(CLOCK_MONOTONIC, how == 'p' ? TFD_NONBLOCK : 0);
    require(!timerfd_settime(timer, is_relative ? 0 : TFD_TIMER_ABSTIME, &setting, NULL),
            "timerfd");
    if (how == 'p') {
        struct pollfd input = {.fd = timer, .events = POLLIN};
        require(poll(&input, 1, -1) == 1, "poll of a timer");
    } else if (how == 'e') {
        int epoll = epoll_create1(0);
        require(!epoll_ctl(epoll, EPOLL_CTL_ADD, timer, &event), "epoll_ctl");
        require(epoll_wait(epoll, &event, 1, 100000) == 1, "epoll_wait");
        close(epoll);
    }
    require(read(timer, &count, sizeof count) == sizeof count && count == 1, "read of a timer");
    close(timer);
}

static void wait_long(struct waiter *me)
{
    struct timespec real = at(me, 0), uptime = at(me, UPTIME_S);
    struct timespec left = {me->ms / 1000, me->ms % 1000 * 1000000};
    struct timeval left_us = {me->ms / 1000, me->ms % 1000 * 1000};
    pthread_mutex_lock(&me->mutex);
    switch (me->kind) {
    case 'c':
        require(pthread_cond_timedwait(&me->cond, &me->mutex, &real) == ETIMEDOUT, "cond");
        break;
    case 'm':
        require(pthread_cond_timedwait(&me->monotonic, &me->mutex, &uptime) == ETIMEDOUT,
                "monotonic cond");
        break;
    case 'w':
        require(pthread_cond_clockwait(&me->cond, &me->mutex, CLOCK_MONOTONIC, &uptime) ==
                    ETIMEDOUT,
                "clockwait");
        break;
    case 's':
        require(sem_timedwait(&me->semaphore, &real) < 0 && errno == ETIMEDOUT, "sem_timedwait");
        break;
    case 'k':
        require(sem_clockwait(&me->semaphore, CLOCK_MONOTONIC, &uptime) < 0 && errno == ETIMEDOUT,
                "sem_clockwait");
        break;
    case 'n': nanosleep(&left, NULL); break;
    case 'a': clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &uptime, NULL); break;
    case 'p': require(poll(NULL, 0, me->ms) == 0, "poll"); break;
    case 'l': require(select(0, NULL, NULL, NULL, &left_us) == 0, "select"); break;
    case 'x': require(pthread_mutex_timedlock(&me->held, &real) == ETIMEDOUT, "mutex"); break;
    case 'f':
        require(syscall(SYS_futex, &me->word, FUTEX_WAIT_BITSET, 0, &uptime, NULL, -1) < 0 &&
                    errno == ETIMEDOUT,
                "futex");
        break;
    case '1': wait_timer(me, 0, 'r'); break;
    case '2': wait_timer(me, 1, 'p'); break;
    case '3': wait_timer(me, 0, 'e'); break;
    case 'C':
        while (!me->is_set) pthread_cond_wait(&me->cond, &me->mutex);
        break;
    case 'S': require(!sem_wait(&me->semaphore), "sem_wait"); break;
    case 'F': require(!syscall(SYS_futex, &me->word, FUTEX_WAIT, 0, NULL), "futex wake"); break;
    case 'R': require(read(me->pipe[0], &me->is_set, 1) == 1, "pipe"); break;
    default: require(0, "kind");
    }
    pthread_mutex_unlock(&me->mutex);
}

static void *run(void *argument)
{
    struct waiter *me = argument;
    struct timespec now;
    wait_long(me);
    clock_gettime(CLOCK_MONOTONIC, &now);
    woken[woken_count].number = me->number;
    woken[woken_count++].us = (now.tv_sec - UPTIME_S - second) * 1000000 + now.tv_nsec / 1000;
    return NULL;
}

static void *end_wait(void *argument)
{
    struct waiter *me = argument;
    usleep(me->ms * 1000);
    me->is_set = 1;
    switch (me->kind) {
    case 'C': pthread_cond_broadcast(&me->cond); break;
    case 'S': sem_post(&me->semaphore); break;
    case 'F': require(syscall(SYS_futex, &me->word, FUTEX_WAKE, 1) == 1, "woken"); break;
    case 'R': require(write(me->pipe[1], "x", 1) == 1, "write"); break;
    }
    return NULL;
}

static void begin(struct waiter *me)
{
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_mutex_init(&me->mutex, NULL);
    pthread_mutex_init(&me->held, NULL);
    pthread_mutex_lock(&me->held);
    pthread_cond_init(&me->cond, NULL);
    pthread_cond_init(&me->monotonic, &attributes);
    sem_init(&me->semaphore, 0, 0);
    require(!pipe(me->pipe), "pipe");
    require(!pthread_create(&me->thread, NULL, run, me), "pthread_create");
    if (strchr("CSFR", me->kind))
        require(!pthread_create(&me->ender, NULL, end_wait, me), "ender");
}

static void finish(struct waiter *me)
{
    require(!pthread_join(me->thread, NULL), "join");
    if (strchr("CSFR", me->kind)) require(!pthread_join(me->ender, NULL), "join");
    close(me->pipe[0]);
    close(me->pipe[1]);
}

int main(int count, char **words)
{
    FILE *file = count > 1 ? fopen(words[1], "r") : NULL;
    struct waiter waiters[THREADS];
    require(file != NULL, "file");
    for (;;) {
        struct timespec start = {UPTIME_S + ++second, 0};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &start, NULL);
        memset(waiters, 0, sizeof waiters);
        woken_count = 0;
        for (int i = 0; i < THREADS; i++) {
            waiters[i].number = i;
            if (fscanf(file, " %c:%ld", &waiters[i].kind, &waiters[i].ms) != 2) return 0;
        }
        for (int i = 0; i < THREADS; i++) begin(&waiters[i]);
        for (int i = 0; i < THREADS; i++) finish(&waiters[i]);
        for (int i = 0; i < woken_count; i++)
            printf(" %d:%ld", woken[i].number, woken[i].us / 1000);
        printf("\n");
        struct timespec now;
        clock_gettime(CLOCK_MONOTONIC, &now);
        second = now.tv_sec - UPTIME_S;
    }
}
