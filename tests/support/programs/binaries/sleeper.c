/* Sleeps an hour, by each function that can, and prints the clocks before and after. */
#define _GNU_SOURCE
#include <poll.h>
#include <stdio.h>
#include <sys/select.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static void print_clocks(void)
{
    struct timespec monotonic;
    struct timeval real;
    clock_gettime(CLOCK_MONOTONIC, &monotonic);
    gettimeofday(&real, NULL);
    printf("%lld.%09ld %lld.%06ld %lld\n", (long long)monotonic.tv_sec, monotonic.tv_nsec,
           (long long)real.tv_sec, (long)real.tv_usec, (long long)time(NULL));
}

int main(void)
{
    struct timespec minutes = {600, 0}, until;
    struct timeval select_minutes = {600, 0};
    print_clocks();
    sleep(600);
    usleep(600000000);
    nanosleep(&minutes, NULL);
    poll(NULL, 0, 600000);
    select(0, NULL, NULL, NULL, &select_minutes);
    clock_gettime(CLOCK_MONOTONIC, &until);
    until.tv_sec += 600;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
    print_clocks();
    return 0;
}
