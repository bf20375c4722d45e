/* Timers that send signals or start threads, and waits for signals, as the first argument says.
 *
 * Times are printed in tenths of a second since the start, so that a run without a rig prints the
 * same.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/signalfd.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define TENTH_NS 100000000L

static struct timespec start;
static timer_t timer;
static int ends[2];
static volatile sig_atomic_t count;
static sem_t posted;

static long now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return ((time.tv_sec - start.tv_sec) * 1000000000 + time.tv_nsec - start.tv_nsec +
            TENTH_NS / 2) / TENTH_NS;
}

static void note(int number)
{
    count++;
    printf("signal %d at %ld\n", number >= SIGRTMIN ? number - SIGRTMIN : number, now());
}

static void note_value(int number, siginfo_t *info, void *context)
{
    (void)context;
    printf("value %d, timer %d, overrun %d\n", info->si_value.sival_int, info->si_code == SI_TIMER,
           timer_getoverrun(timer));
    note(number);
}

static void sleep_once(int number)
{
    note(number);
    struct timespec time = {0, 5 * TENTH_NS / 2};
    if (count > 1) {
        printf("overrun %d\n", timer_getoverrun(timer));
        timer_delete(timer);
        return;
    }
    while (nanosleep(&time, &time)) continue;
    printf("slept at %ld\n", now());
}

static void handle(int number, void (*handler)(int), int flags)
{
    struct sigaction action = {.sa_handler = handler, .sa_flags = flags};
    sigaction(number, &action, NULL);
}

static void call(union sigval value)
{
    printf("call %d at %ld, main %d\n", value.sival_int, now(), getpid() == gettid());
    count++;
}

static struct itimerspec every(long tenths)
{
    struct timespec time = {tenths / 10, tenths % 10 * TENTH_NS};
    return (struct itimerspec){time, time};
}

static void start_timer(int how, int number, long tenths)
{
    struct sigevent event = {.sigev_notify = how, .sigev_signo = number};
    struct itimerspec setting = every(tenths);
    event.sigev_value.sival_int = 7;
    event.sigev_notify_function = call;
    if (timer_create(CLOCK_MONOTONIC, &event, &timer)) perror("timer_create");
    if (timer_settime(timer, 0, &setting, NULL)) perror("timer_settime");
}

static void start_itimer(long tenths, long interval)
{
    struct itimerval setting = {.it_interval = {interval / 10, interval % 10 * 100000},
                                .it_value = {tenths / 10, tenths % 10 * 100000}};
    if (setitimer(ITIMER_REAL, &setting, NULL)) perror("setitimer");
}

static void block(int number, sigset_t *set)
{
    sigemptyset(set);
    sigaddset(set, number);
    pthread_sigmask(SIG_BLOCK, set, NULL);
}

static void *write_later(void *unused)
{
    usleep(300000);
    if (write(ends[1], "x", 1) != 1) perror("write");
    sem_post(&posted);
    return unused;
}

static void sleep_with_itimer(void)
{
    struct timespec time = {1, 0};
    handle(SIGALRM, note, 0);
    start_itimer(2, 3);
    while (nanosleep(&time, &time)) printf("%ld left\n", (time.tv_nsec + TENTH_NS / 2) / TENTH_NS);
    printf("slept at %ld\n", now());
}

static void read_with_alarm(int flags)
{
    char data;
    pthread_t thread;
    handle(SIGALRM, note, flags);
    pthread_create(&thread, NULL, write_later, NULL);
    start_itimer(1, 0);
    ssize_t size = read(ends[0], &data, 1);
    printf("read: %zd%s at %ld\n", size, size < 0 && errno == EINTR ? " EINTR" : "", now());
    start_itimer(1, 0);
    int result = sem_wait(&posted);
    printf("sem_wait: %d%s at %ld\n", result, result && errno == EINTR ? " EINTR" : "", now());
    pthread_join(thread, NULL);
}

static void use_signal(void)
{
    struct sigaction action = {.sa_sigaction = note_value, .sa_flags = SA_SIGINFO};
    sigaction(SIGRTMIN + 1, &action, NULL);
    start_timer(SIGEV_SIGNAL, SIGRTMIN + 1, 1);
    while (count < 3) pause();
    timer_delete(timer);
    usleep(200000);
    printf("%d at %ld\n", count, now());
}

static void use_overrun(void)
{
    handle(SIGRTMIN, sleep_once, 0);
    start_timer(SIGEV_SIGNAL, SIGRTMIN, 1);
    while (count < 2) pause();
    printf("%d at %ld\n", count, now());
}

static void use_thread(void)
{
    struct timespec time = {0, 7 * TENTH_NS / 2};
    start_timer(SIGEV_THREAD, 0, 1);
    nanosleep(&time, NULL);
    timer_delete(timer);
    nanosleep(&time, NULL);
    printf("%d at %ld\n", count, now());
}

static void use_sigwait(void)
{
    sigset_t set;
    siginfo_t info;
    struct timespec limit = {0, TENTH_NS / 2};
    block(SIGRTMIN, &set);
    start_timer(SIGEV_SIGNAL, SIGRTMIN, 1);
    int number = sigtimedwait(&set, &info, &limit);
    printf("sigtimedwait: %d, EAGAIN %d\n", number, errno == EAGAIN);
    for (int i = 0; i < 3; i++) {
        number = sigwaitinfo(&set, &info);
        printf("%d, value %d at %ld\n", number - SIGRTMIN, info.si_value.sival_int, now());
    }
    if (sigwait(&set, &number)) perror("sigwait");
    printf("sigwait: %d at %ld\n", number - SIGRTMIN, now());
    usleep(350000);
    sigwaitinfo(&set, &info);
    printf("overrun %d at %ld\n", info.si_overrun, now());
}

static void use_masks(void)
{
    sigset_t set, none;
    struct timespec limit = {5, 0};
    struct pollfd input = {.fd = ends[0], .events = POLLIN};
    struct signalfd_siginfo info;
    handle(SIGALRM, note, SA_RESTART);
    block(SIGALRM, &set);
    sigemptyset(&none);
    start_itimer(1, 0);
    usleep(200000);
    printf("%d at %ld\n", count, now());
    sigsuspend(&none);
    start_itimer(1, 0);
    sigsuspend(&none);
    start_itimer(1, 0);
    printf("ppoll: %d\n", ppoll(&input, 1, &limit, &none));
    start_itimer(1, 0);
    printf("pselect: %d\n", pselect(0, NULL, NULL, NULL, &limit, &none));
    input.fd = signalfd(-1, &set, 0);
    start_itimer(1, 0);
    printf("poll: %d\n", poll(&input, 1, 1000));
    if (read(input.fd, &info, sizeof info) != sizeof info) perror("read");
    printf("signalfd: %d at %ld\n", info.ssi_signo, now());
}

static void use_threads_signals(void)
{
    struct sigevent event = {.sigev_notify = SIGEV_THREAD_ID, .sigev_signo = SIGUSR2};
    struct itimerspec setting = every(1);
    handle(SIGUSR1, note, 0);
    handle(SIGUSR2, note, 0);
    event._sigev_un._tid = gettid();
    if (timer_create(CLOCK_REALTIME, &event, &timer)) perror("timer_create");
    clock_gettime(CLOCK_REALTIME, &setting.it_value);
    setting.it_value.tv_sec++;
    if (timer_settime(timer, TIMER_ABSTIME, &setting, NULL)) perror("timer_settime");
    pause();
    timer_delete(timer);
    kill(getpid(), SIGUSR1);
    sigqueue(getpid(), SIGUSR1, (union sigval){0});
    raise(SIGUSR1);
    printf("%d at %ld\n", count, now());
}

int main(int words, char **argument)
{
    const char *act = words > 1 ? argument[1] : "";
    setvbuf(stdout, NULL, _IOLBF, 0);
    if (pipe(ends)) return 9;
    sem_init(&posted, 0, 0);
    usleep(100000); /* joins */
    clock_gettime(CLOCK_MONOTONIC, &start);
    if (!strcmp(act, "sleep")) {
        sleep_with_itimer();
    } else if (!strcmp(act, "restart")) {
        read_with_alarm(SA_RESTART);
    } else if (!strcmp(act, "interrupt")) {
        read_with_alarm(0);
    } else if (!strcmp(act, "signal")) {
        use_signal();
    } else if (!strcmp(act, "overrun")) {
        use_overrun();
    } else if (!strcmp(act, "thread")) {
        use_thread();
    } else if (!strcmp(act, "sigwait")) {
        use_sigwait();
    } else if (!strcmp(act, "masks")) {
        use_masks();
    } else if (!strcmp(act, "threads")) {
        use_threads_signals();
    } else if (!strcmp(act, "alarm")) {
        handle(SIGALRM, note, 0);
        unsigned before = alarm(3), left = alarm(2);
        usleep(500000);
        printf("before %u, left %u, sleep left %u\n", before, left, sleep(5));
        alarm(2);
        usleep(300000);
        printf("left %u\n", alarm(0));
    } else if (!strcmp(act, "default")) {
        alarm(1);
        pause();
    } else {
        return 8;
    }
    return 0;
}
