/* Three threads wait for one thing, which is given one at a time; prints who has had it, in order.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/futex.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER, held = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t cond = PTHREAD_COND_INITIALIZER;
static pthread_rwlock_t lock = PTHREAD_RWLOCK_INITIALIZER;
static sem_t semaphore;
static uint32_t word;
static int events;
static const char *kind;

static void *take(void *number)
{
    uint64_t count;
    usleep(1000 * (3 - (long)number)); /* the last begins to wait first */
    if (!strcmp(kind, "cond")) {
        pthread_mutex_lock(&mutex);
        pthread_cond_wait(&cond, &mutex);
        pthread_mutex_unlock(&mutex);
    }
    if (!strcmp(kind, "semaphore")) sem_wait(&semaphore);
    if (!strcmp(kind, "futex"))
        syscall(SYS_futex, &word, FUTEX_WAIT_BITSET, 0, NULL, NULL, 1u << (long)number);
    if (!strcmp(kind, "mutex")) pthread_mutex_lock(&held);
    if (!strcmp(kind, "rwlock")) pthread_rwlock_wrlock(&lock);
    if (!strcmp(kind, "eventfd") && read(events, &count, sizeof count) < 0) return NULL;
    printf(" %ld", (long)number);
    if (!strcmp(kind, "mutex")) pthread_mutex_unlock(&held);
    if (!strcmp(kind, "rwlock")) pthread_rwlock_unlock(&lock);
    return NULL;
}

static void give(void)
{
    uint64_t one = 1;
    if (!strcmp(kind, "cond")) pthread_cond_signal(&cond);
    if (!strcmp(kind, "semaphore")) sem_post(&semaphore);
    if (!strcmp(kind, "futex")) syscall(SYS_futex, &word, FUTEX_WAKE_BITSET, 1, NULL, NULL, 3);
    if (!strcmp(kind, "eventfd") && write(events, &one, sizeof one) < 0) return;
    usleep(100);
    printf(",");
}

static void run(const char *name)
{
    pthread_t threads[3];
    kind = name;
    printf("%s:", name);
    pthread_mutex_lock(&held);
    pthread_rwlock_wrlock(&lock);
    for (long i = 0; i < 3; i++) pthread_create(&threads[i], NULL, take, (void *)i);
    usleep(10000);
    for (int i = 0; i < 3; i++) give();
    pthread_mutex_unlock(&held);
    pthread_rwlock_unlock(&lock);
    if (!strcmp(name, "futex")) syscall(SYS_futex, &word, FUTEX_WAKE, 3);
    for (int i = 0; i < 3; i++) pthread_join(threads[i], NULL);
    printf("\n");
}

static void clean_up(void *what)
{
    printf("%s", (const char *)what);
    pthread_mutex_unlock(&mutex);
}

static void *wait_for_ever(void *unused)
{
    pthread_mutex_lock(&mutex);
    pthread_cleanup_push(clean_up, "cancelled");
    for (;;) pthread_cond_wait(&cond, &mutex);
    pthread_cleanup_pop(1);
    return unused;
}

int main(void)
{
    const char *names[] = {"cond", "semaphore", "futex", "mutex", "rwlock", "eventfd"};
    struct timespec until;
    pthread_t thread;
    void *value;
    sem_init(&semaphore, 0, 0);
    events = eventfd(0, EFD_SEMAPHORE);
    for (unsigned i = 0; i < sizeof names / sizeof *names; i++) run(names[i]);
    pthread_create(&thread, NULL, wait_for_ever, NULL);
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += 2;
    printf("%d %d ", pthread_tryjoin_np(thread, NULL) == EBUSY,
           pthread_timedjoin_np(thread, NULL, &until) == ETIMEDOUT);
    pthread_cancel(thread);
    pthread_join(thread, &value);
    printf(" %d\n", value == PTHREAD_CANCELED && !pthread_mutex_trylock(&mutex));
    pthread_rwlock_wrlock(&lock);
    until.tv_sec += 2;
    int error = pthread_rwlock_timedrdlock(&lock, &until);
    printf("%d %ld s\n", error == ETIMEDOUT || error == EDEADLK, (long)time(NULL));
    return 0;
}
