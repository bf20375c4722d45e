/* Sends three frames by sendmmsg(), and receives them by recvmmsg() in three ways. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { COUNT = 3 };

static struct can_frame frames[COUNT];
static struct iovec parts[COUNT];
static struct mmsghdr messages[COUNT];

static int opened(void)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex("can0")};
    int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bind(fd, (struct sockaddr *)&address, sizeof address)) perror("bind");
    return fd;
}

static void receive(int fd, const char *what, int flags, struct timespec *timeout)
{
    struct timespec now;
    int count = recvmmsg(fd, messages, COUNT, flags, timeout);
    clock_gettime(CLOCK_REALTIME, &now);
    printf("%s: %d", what, count);
    for (int i = 0; i < count; i++) printf(" %X/%u", frames[i].can_id, messages[i].msg_len);
    if (count < 0) printf(" %s", errno == EAGAIN ? "EAGAIN" : strerror(errno));
    printf(" at %ld ms\n", now.tv_sec * 1000 + now.tv_nsec / 1000000);
}

int main(void)
{
    int sender = opened(), receiver = opened();
    struct timespec limit = {0, 1};
    for (int i = 0; i < COUNT; i++) {
        parts[i] = (struct iovec){&frames[i], sizeof frames[i]};
        messages[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1};
        frames[i].can_id = 0x100 + i;
    }
    printf("sent: %d\n", sendmmsg(sender, messages, COUNT, 0));
    receive(receiver, "all", 0, NULL);
    for (int i = 0; i < COUNT; i++) frames[i].can_id = 0x200 + i;
    sendmmsg(sender, messages, COUNT, 0);
    receive(receiver, "one", MSG_WAITFORONE, NULL);
    receive(receiver, "limited", 0, &limit);
    receive(receiver, "one", MSG_WAITFORONE, NULL);
    receive(receiver, "none", MSG_DONTWAIT, NULL);
    return 0;
}
