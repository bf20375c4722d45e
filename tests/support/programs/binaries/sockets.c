/* Opens 300 CAN sockets, one after the other; then hears frames that came while it slept.
 *
 * Each line: what the other socket hears of three frames, what the sender hears of its own, and
 * that again after CAN_RAW_RECV_OWN_MSGS.
 */
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static int opened(void)
{
    struct sockaddr_can address = {.can_family = AF_CAN};
    int fd = socket(AF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
    address.can_ifindex = if_nametoindex("can0");
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address)) {
        perror("socket");
        exit(1);
    }
    return fd;
}

static void send_frame(int fd, canid_t id)
{
    struct can_frame frame = {.can_id = id};
    struct timespec pause = {.tv_nsec = 1000000};
    if (write(fd, &frame, sizeof frame) != sizeof frame) perror("write");
    nanosleep(&pause, NULL);
}

static void print_heard(const char *who, int fd)
{
    struct can_frame frame;
    printf("%s:", who);
    while (read(fd, &frame, sizeof frame) == sizeof frame) printf(" %x", frame.can_id);
    printf("%s\n", errno == EAGAIN ? "" : strerror(errno));
}

int main(void)
{
    int yes = 1;
    for (int i = 0; i < 300; i++) close(opened());
    int sender = opened(), other = opened();
    for (canid_t id = 1; id <= 3; id++) send_frame(sender, id);
    print_heard("other", other);
    print_heard("sender", sender);
    setsockopt(sender, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &yes, sizeof yes);
    send_frame(sender, 4);
    print_heard("sender", sender);
    return 0;
}
