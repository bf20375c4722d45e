/* Sends a frame in the handler of a timer each 10 ms, and prints when another socket hears it. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <signal.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static int sender;

static long now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

static int opened(void)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex("can0")};
    int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bind(fd, (struct sockaddr *)&address, sizeof address)) perror("bind");
    return fd;
}

static void send_frame(int signal)
{
    struct can_frame frame = {.can_id = now_us() / 1000};
    if (signal == SIGALRM && write(sender, &frame, sizeof frame) < 0) perror("write");
}

int main(void)
{
    struct itimerval setting = {{0, 10000}, {0, 10000}};
    struct sigaction action = {.sa_handler = send_frame, .sa_flags = SA_RESTART};
    struct can_frame frame;
    sender = opened();
    int receiver = opened();
    sigaction(SIGALRM, &action, NULL);
    setitimer(ITIMER_REAL, &setting, NULL);
    for (int i = 0; i < 3; i++) {
        if (read(receiver, &frame, sizeof frame) < 0) perror("read");
        long late_us = now_us() - frame.can_id * 1000L;
        printf("%u %ld ms\n", frame.can_id, late_us / 1000 + 1);
    }
    return 0;
}
