/* Waits of threads, at a barrier or for pthread_once(): `shared_waits barrier`, `... once`.
 *
 * Or waits of two programs for what they share in a file: `shared_waits first FILE` and
 * `shared_waits second FILE`; for its locks with `keeper` and `taker`.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

static struct shared {
    sem_t semaphore;
    pthread_mutex_t mutex;
    pthread_cond_t cond;
    int is_ready, is_set;
} *shared;

static pthread_barrier_t barrier;
static int serial_count;

static long now_ms(void)
{
    struct timespec time;
    clock_gettime(CLOCK_REALTIME, &time);
    return time.tv_sec * 1000 + time.tv_nsec / 1000000;
}

static void *meet(void *second)
{
    for (int round = 1; round <= 2; round++) {
        sleep((long)second);
        int result = pthread_barrier_wait(&barrier);
        serial_count += result == PTHREAD_BARRIER_SERIAL_THREAD;
        printf("%ld at %ld\n", (long)second, now_ms());
    }
    return NULL;
}

static void use_barrier(void)
{
    pthread_t threads[3];
    pthread_barrier_init(&barrier, NULL, 3);
    for (long i = 0; i < 3; i++) pthread_create(&threads[i], NULL, meet, (void *)(i + 1));
    for (int i = 0; i < 3; i++) pthread_join(threads[i], NULL);
    printf("serial: %d\n", serial_count);
    pthread_barrier_destroy(&barrier);
}

static pthread_once_t once = PTHREAD_ONCE_INIT;

static void sleep_once(void)
{
    sleep(1);
    serial_count++;
}

static void *call_once(void *unused)
{
    usleep(500000);
    pthread_once(&once, sleep_once);
    printf("thread at %ld\n", now_ms());
    return unused;
}

static void use_once(void)
{
    pthread_t thread;
    pthread_create(&thread, NULL, call_once, NULL);
    pthread_once(&once, sleep_once);
    printf("main at %ld\n", now_ms());
    pthread_join(thread, NULL);
    printf("once: %d\n", serial_count);
}

/* Hold both kinds of lock, one after the other; or take them. */
static void lock(int fd, int keeps)
{
    usleep(keeps ? 10 : 20); /* joins */
    if (flock(fd, LOCK_EX)) perror("flock");
    if (keeps)
        sleep(1);
    else
        printf("flock at %ld\n", now_ms());
    if (flock(fd, LOCK_UN)) perror("flock");
    if (lockf(fd, F_LOCK, 0)) perror("lockf");
    if (keeps)
        sleep(1);
    else
        printf("lockf at %ld\n", now_ms());
    if (lockf(fd, F_ULOCK, 0)) perror("lockf");
}

static void make_shared(void)
{
    pthread_mutexattr_t mutex;
    pthread_condattr_t cond;
    memset(shared, 0, sizeof *shared);
    pthread_mutexattr_init(&mutex);
    pthread_mutexattr_setpshared(&mutex, PTHREAD_PROCESS_SHARED);
    pthread_condattr_init(&cond);
    pthread_condattr_setpshared(&cond, PTHREAD_PROCESS_SHARED);
    sem_init(&shared->semaphore, 1, 0);
    pthread_mutex_init(&shared->mutex, &mutex);
    pthread_cond_init(&shared->cond, &cond);
    shared->is_ready = 1;
}

static void be_first(void)
{
    make_shared();
    sleep(1);
    sem_post(&shared->semaphore);
    sleep(1);
    pthread_mutex_lock(&shared->mutex);
    sleep(1);
    pthread_mutex_unlock(&shared->mutex);
    sleep(1);
    pthread_mutex_lock(&shared->mutex);
    shared->is_set = 1;
    pthread_cond_signal(&shared->cond);
    pthread_mutex_unlock(&shared->mutex);
    sleep(10);
}

static void be_second(void)
{
    do usleep(10); /* joins, when the first one has made them */
    while (!shared->is_ready);
    sem_wait(&shared->semaphore);
    printf("semaphore at %ld\n", now_ms());
    usleep(1500000);
    pthread_mutex_lock(&shared->mutex);
    printf("mutex at %ld\n", now_ms());
    while (!shared->is_set) pthread_cond_wait(&shared->cond, &shared->mutex);
    printf("cond at %ld\n", now_ms());
    pthread_mutex_unlock(&shared->mutex);
}

int main(int words, char **argument)
{
    if (words == 2) {
        strcmp(argument[1], "once") ? use_barrier() : use_once();
        return 0;
    }
    int fd = words > 2 ? open(argument[2], O_RDWR | O_CREAT, 0600) : -1;
    if (fd < 0 || ftruncate(fd, sizeof *shared)) return 9;
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (shared == MAP_FAILED) return 9;
    if (!strcmp(argument[1], "first")) {
        be_first();
    } else if (argument[1][0] == 'k' || argument[1][0] == 't') {
        lock(fd, argument[1][0] == 'k');
    } else {
        be_second();
    }
    return 0;
}
