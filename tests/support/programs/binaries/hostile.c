/* Does what its first argument names, against the rules of a program that shares a clock. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/msg.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static pthread_mutex_t one = PTHREAD_MUTEX_INITIALIZER, two = PTHREAD_MUTEX_INITIALIZER;
static atomic_int count;
static int ends[2];

static void *sleep_and_count(void *ms)
{
    usleep((long)ms * 1000);
    count++;
    return NULL;
}

static void *sleep_long(void *unused)
{
    sleep(5);
    printf("slept\n");
    return unused;
}

static void *leave(void *status)
{
    sleep(1);
    exit((int)(long)status);
}

static void *kill_process(void *unused)
{
    sleep(1);
    kill(getpid(), SIGKILL);
    return unused;
}

static void *lock_two_one(void *unused)
{
    pthread_mutex_lock(&two);
    sleep(1);
    pthread_mutex_lock(&one);
    return unused;
}

static void *signal_main(void *thread)
{
    sleep(1);
    pthread_kill(*(pthread_t *)thread, SIGUSR1);
    sleep(1);
    return NULL;
}

/* By a call that the library does not see, as a signal of another process. */
static void *signal_from_outside(void *unused)
{
    sleep(1);
    syscall(SYS_tgkill, getpid(), getpid(), SIGUSR1);
    sleep(1);
    return unused;
}

static void wait_in_handler(int signal)
{
    (void)signal;
    sleep(1);
}

static void send_in_handler(int signal)
{
    struct can_frame frame = {.can_id = 0x100 + signal};
    if (write(ends[0], &frame, sizeof frame) < 0) perror("write");
}

static void note_signal(int signal)
{
    (void)signal;
    count++;
}

static void *write_late(void *unused)
{
    usleep(100000);
    if (write(ends[1], "x", 1) == 1) count++;
    return unused;
}

static void *read_late(void *unused)
{
    static char data[50000];
    sleep(1);
    while (count < 400000) count += read(ends[0], data, sizeof data);
    return unused;
}

static void start(void *(*function)(void *), void *argument)
{
    pthread_t thread;
    if (pthread_create(&thread, NULL, function, argument)) exit(9);
}

static long now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec - 100000;
}

int main(int words, char **argument)
{
    const char *act = words > 1 ? argument[1] : "";
    pthread_t threads[200], self = pthread_self();
    pthread_barrierattr_t attributes;
    pthread_barrier_t barrier;
    timer_t timer;
    if (!strcmp(act, "spin-clock")) {
        while (now_s() < 20) continue;
    } else if (!strcmp(act, "spin-yield")) {
        start(sleep_and_count, (void *)100);
        while (!count) sched_yield();
    } else if (!strcmp(act, "spin-trylock")) {
        start(lock_two_one, NULL);
        sched_yield();
        while (pthread_mutex_trylock(&two) && now_s() < 2) continue;
    } else if (!strcmp(act, "spin")) {
        sleep(1);
        for (;;) continue;
    } else if (!strcmp(act, "exit-in-thread")) {
        start(leave, (void *)5);
        sleep(100);
    } else if (!strcmp(act, "exit-main-thread")) {
        start(sleep_long, NULL);
        pthread_exit(NULL);
    } else if (!strcmp(act, "kill")) {
        start(kill_process, NULL);
        sleep(100);
    } else if (!strcmp(act, "many-threads")) {
        for (long i = 0; i < 200; i++)
            if (pthread_create(&threads[i], NULL, sleep_and_count, (void *)(i * 7 % 200))) return 9;
        for (long i = 0; i < 200; i++) pthread_join(threads[i], NULL);
    } else if (!strcmp(act, "short-threads")) {
        for (long i = 0; i < 1500; i++) {
            if (pthread_create(&threads[0], NULL, sleep_and_count, (void *)1)) return 9;
            pthread_join(threads[0], NULL);
        }
    } else if (!strcmp(act, "cancel")) {
        pthread_create(&threads[0], NULL, leave, (void *)7);
        sched_yield();
        pthread_cancel(threads[0]);
        pthread_join(threads[0], NULL);
        sleep(2);
    } else if (!strcmp(act, "close-all")) {
        sleep(1);
        for (int fd = 3; fd < 4096; fd++) close(fd);
        closefrom(3);
        sleep(1);
    } else if (!strcmp(act, "close-all-raw")) {
        sleep(1);
        syscall(SYS_close_range, 3, ~0u, 0);
        sleep(1);
    } else if (!strcmp(act, "handler")) {
        signal(SIGUSR1, wait_in_handler);
        start(signal_from_outside, NULL);
        sleep(100);
    } else if (!strcmp(act, "handler-sends")) {
        struct sockaddr_can all = {.can_family = AF_CAN};
        ends[0] = socket(PF_CAN, SOCK_RAW, CAN_RAW);
        if (bind(ends[0], (struct sockaddr *)&all, sizeof all)) return 9;
        signal(SIGUSR1, send_in_handler);
        start(signal_from_outside, NULL);
        sleep(100);
    } else if (!strcmp(act, "fork")) {
        sleep(1);
        if (!fork()) {
            usleep(1);
            _exit(0);
        }
        wait(NULL);
        sleep(1);
    } else if (!strcmp(act, "fork-can")) {
        int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW), status = 0;
        if (!fork()) {
            if (read(fd, &status, sizeof status) < 0) perror("read");
            _exit(0);
        }
        wait(&status);
        printf("child: %d\n", WEXITSTATUS(status));
    } else if (!strcmp(act, "popen")) {
        sleep(1);
        FILE *child = popen("sleep 0.05; echo hello", "r");
        struct pollfd input = {.fd = fileno(child), .events = POLLIN};
        printf("poll: %d\n", poll(&input, 1, 1000));
        pclose(child);
    } else if (!strcmp(act, "no-sender")) {
        int fd = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
        while (now_s() < 1 && read(fd, threads, sizeof threads) < 0) continue;
        while (count++ < 1000000 && read(fd, threads, sizeof threads) < 0) continue;
    } else if (!strcmp(act, "spin-pipe")) {
        if (pipe2(ends, O_NONBLOCK)) return 9;
        start(write_late, NULL);
        while (read(ends[0], threads, 1) != 1) continue;
    } else if (!strcmp(act, "full-pipe") || !strcmp(act, "full-socket")) {
        static char data[400000];
        int is_pipe = !strcmp(act, "full-pipe");
        if (is_pipe ? pipe(ends) : socketpair(AF_UNIX, SOCK_STREAM, 0, ends)) return 9;
        start(read_late, NULL);
        printf("written: %zd\n", write(ends[1], data, sizeof data));
    } else if (!strcmp(act, "signals")) {
        signal(SIGUSR1, note_signal);
        start(signal_main, &self);
        int ready = poll(NULL, 0, -1);
        printf("poll: %d, interrupted: %d, signals: %d\n", ready, errno == EINTR, count);
        start(signal_main, &self);
        printf("sleep: %u s left\n", sleep(10));
    } else if (!strcmp(act, "socket-timeout")) {
        struct timeval limit = {.tv_sec = 2};
        if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends)) return 9;
        if (setsockopt(ends[0], SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit)) return 9;
        ssize_t size = recv(ends[0], threads, 1, 0);
        printf("recv: %zd, timeout: %d\n", size, errno == EAGAIN);
    } else if (!strcmp(act, "exec")) {
        sleep(1);
        execlp("true", "true", NULL);
    } else if (!strcmp(act, "leave-at-once")) {
        sleep(1);
        syscall(SYS_exit_group, 0);
    } else if (!strcmp(act, "deadlock")) {
        pthread_mutex_lock(&one);
        start(lock_two_one, NULL);
        sleep(1);
        pthread_mutex_lock(&two);
    } else if (!strcmp(act, "msgsnd")) {
        msgsnd(0, ends, sizeof ends, 0);
    } else if (!strcmp(act, "cpu-timer")) {
        timer_create(CLOCK_PROCESS_CPUTIME_ID, NULL, &timer);
    } else if (!strcmp(act, "cpu-itimer")) {
        setitimer(ITIMER_PROF, NULL, NULL);
    } else if (!strcmp(act, "shared-barrier")) {
        pthread_barrierattr_init(&attributes);
        pthread_barrierattr_setpshared(&attributes, PTHREAD_PROCESS_SHARED);
        pthread_barrier_init(&barrier, &attributes, 2);
    } else if (!strcmp(act, "isotp")) {
        sleep(1);
        if (socket(PF_CAN, SOCK_DGRAM, CAN_ISOTP) < 0) perror("socket");
    } else {
        return 8;
    }
    printf("%d at %ld s\n", count, now_s());
    return 0;
}
