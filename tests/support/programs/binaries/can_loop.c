/* An event loop on epoll: a timer sends a SYNC message, two sockets hear it.
 *
 * Prints each message with the time and the flags that recvmsg() tells, in ms.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <linux/net_tstamp.h>
#include <net/if.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

static int open_socket(const char *name, int hears_own, int stamps)
{
    int fd = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
    int value = stamps == SO_TIMESTAMPING ? SOF_TIMESTAMPING_SOFTWARE : 1;
    struct sockaddr_can address = {.can_family = AF_CAN,
                                   .can_ifindex = name ? if_nametoindex(name) : 0};
    if (fd < 0 || (name && !address.can_ifindex)) return -1;
    if (setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &hears_own, sizeof hears_own)) return -1;
    if (setsockopt(fd, SOL_SOCKET, stamps, &value, sizeof value)) return -1;
    return bind(fd, (struct sockaddr *)&address, sizeof address) ? -1 : fd;
}

static void print_frame(const char *who, int fd)
{
    struct can_frame frame;
    struct sockaddr_can from;
    char control[128], name[IF_NAMESIZE];
    struct iovec part = {&frame, sizeof frame};
    struct msghdr message = {.msg_name = &from,
                             .msg_namelen = sizeof from,
                             .msg_iov = &part,
                             .msg_iovlen = 1,
                             .msg_control = control,
                             .msg_controllen = sizeof control};
    while (recvmsg(fd, &message, 0) == sizeof frame) {
        struct cmsghdr *head = CMSG_FIRSTHDR(&message);
        struct timeval time = {0, 0};
        if (head && head->cmsg_level == SOL_SOCKET && head->cmsg_type == SO_TIMESTAMP)
            memcpy(&time, CMSG_DATA(head), sizeof time);
        if (head && head->cmsg_level == SOL_SOCKET && head->cmsg_type == SO_TIMESTAMPING) {
            struct timespec stamps[3];
            memcpy(stamps, CMSG_DATA(head), sizeof stamps);
            time = (struct timeval){stamps[0].tv_sec, stamps[0].tv_nsec / 1000};
        }
        printf("%s %s %X %ld%s%s\n", who, if_indextoname(from.can_ifindex, name), frame.can_id,
               time.tv_sec * 1000 + time.tv_usec / 1000,
               message.msg_flags & MSG_CONFIRM ? " own" : "",
               message.msg_flags & MSG_DONTROUTE ? " local" : "");
        message.msg_controllen = sizeof control;
        message.msg_namelen = sizeof from;
    }
}

int main(void)
{
    int own = open_socket("can0", 1, SO_TIMESTAMPING), all = open_socket(NULL, 0, SO_TIMESTAMP),
        copy = dup(all);
    int timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    int epoll = epoll_create1(EPOLL_CLOEXEC), fds[3] = {own, all, timer};
    struct itimerspec setting = {.it_value = {0, 5000000}, .it_interval = {0, 10000000}};
    struct can_frame sync = {.can_id = 0x80};
    if (own < 0 || all < 0 || timer < 0) return 1;
    close(all); /* the copy keeps the socket */
    fds[1] = copy;
    for (int i = 0; i < 3; i++) {
        struct epoll_event event = {.events = EPOLLIN, .data.fd = fds[i]};
        if (epoll_ctl(epoll, EPOLL_CTL_ADD, fds[i], &event)) return 2;
    }
    if (timerfd_settime(timer, 0, &setting, NULL)) return 3;
    for (int sent = 0;;) {
        struct epoll_event event;
        int ready = epoll_wait(epoll, &event, 1, 50);
        if (ready < 0) return 4;
        if (!ready) break;
        uint64_t count = 0;
        if (event.data.fd == own) print_frame("own", own);
        if (event.data.fd == copy) print_frame("all", copy);
        if (event.data.fd != timer || read(timer, &count, sizeof count) != sizeof count) continue;
        if (count != 1) return 5;
        if (write(own, &sync, sizeof sync) != sizeof sync) return 6;
        if (++sent == 3) {
            struct itimerspec none = {0};
            if (timerfd_settime(timer, 0, &none, &setting)) return 7;
            printf("next in %ld ms\n", setting.it_value.tv_nsec / 1000000);
        }
    }
    struct ifreq query = {.ifr_name = "can0"}; /* on a socket of another family */
    int other = socket(AF_UNIX, SOCK_DGRAM, 0);
    if (ioctl(other, SIOCGIFINDEX, &query) || query.ifr_ifindex != (int)if_nametoindex("can0"))
        return 9;
    if (ioctl(other, SIOCGIFMTU, &query) || query.ifr_mtu != CAN_MTU) return 10;
    struct sockaddr_can nowhere = {.can_family = AF_CAN, .can_ifindex = 77};
    if (bind(own, (struct sockaddr *)&nowhere, sizeof nowhere) == 0 || errno != ENODEV) return 8;
    return 0;
}
