/* Uses the broadcast manager of CAN as its first argument says; another socket hears and sends. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/bcm.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { FRAMES_MAX = 4, ID = 0x123 };

static int manager, raw;

static struct message {
    struct bcm_msg_head head;
    struct can_frame frames[FRAMES_MAX];
} message;

static long now_ms(void)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

static void set(int opcode, int flags, long first_ms, long then_ms)
{
    memset(&message, 0, sizeof message);
    message.head.opcode = opcode;
    message.head.flags = flags;
    message.head.can_id = ID;
    message.head.ival1 = (struct bcm_timeval){first_ms / 1000, first_ms % 1000 * 1000};
    message.head.ival2 = (struct bcm_timeval){then_ms / 1000, then_ms % 1000 * 1000};
}

static void add(canid_t id, int length, int first, int second)
{
    struct can_frame *frame = &message.frames[message.head.nframes++];
    *frame = (struct can_frame){.can_id = id, .can_dlc = length, .data = {first, second}};
}

static void submit(void)
{
    size_t size = sizeof message.head + message.head.nframes * sizeof(struct can_frame);
    if (write(manager, &message, size) != (ssize_t)size) perror("write");
}

static void print_frame(const struct can_frame *frame)
{
    printf(" %X#", frame->can_id);
    for (int i = 0; i < frame->can_dlc; i++) printf("%02X", frame->data[i]);
}

/* Print what both sockets hear until this time. */
static void hear_until(long end_ms)
{
    static const char *names[] = {[TX_EXPIRED] = "expired",
                                  [TX_STATUS] = "tx status",
                                  [RX_STATUS] = "rx status",
                                  [RX_TIMEOUT] = "timeout",
                                  [RX_CHANGED] = "changed"};
    struct pollfd inputs[] = {{raw, POLLIN, 0}, {manager, POLLIN, 0}};
    while (now_ms() < end_ms) {
        struct message heard;
        if (!poll(inputs, 2, end_ms - now_ms())) continue;
        if (inputs[0].revents) {
            struct can_frame frame;
            if (read(raw, &frame, sizeof frame) != sizeof frame) perror("read");
            printf("%ld frame", now_ms());
            print_frame(&frame);
        } else {
            if (read(manager, &heard, sizeof heard) < 0) perror("read");
            printf("%ld %s %X count %u", now_ms(), names[heard.head.opcode], heard.head.can_id,
                   heard.head.count);
            for (unsigned i = 0; i < heard.head.nframes; i++) print_frame(&heard.frames[i]);
        }
        printf("\n");
    }
}

static void send_at(long ms, canid_t id, int length, int first, int second)
{
    struct can_frame frame = {.can_id = id, .can_dlc = length, .data = {first, second}};
    hear_until(ms);
    if (write(raw, &frame, sizeof frame) != sizeof frame) perror("write");
}

static void send_cyclic(void)
{
    set(TX_SETUP, SETTIMER | STARTTIMER | TX_COUNTEVT, 10, 20);
    message.head.count = 3;
    add(ID, 1, 0xA, 0);
    add(ID, 1, 0xB, 0);
    submit();
    hear_until(45);
    set(TX_SETUP, TX_CP_CAN_ID | TX_RESET_MULTI_IDX, 0, 0); /* other contents, the same times */
    add(0x7FF, 2, 0xC, 1);
    add(0x7FF, 2, 0xD, 1);
    submit();
    hear_until(85);
    set(TX_READ, 0, 0, 0);
    submit();
    set(TX_DELETE, 0, 0, 0);
    submit();
    set(TX_SEND, 0, 0, 0);
    add(0x7EE, 0, 0, 0);
    submit();
    hear_until(200);
}

static void hear_changes(void)
{
    set(RX_SETUP, SETTIMER | STARTTIMER | RX_ANNOUNCE_RESUME | RX_CHECK_DLC, 50, 0);
    add(ID, 8, 0xFF, 0); /* the first byte matters */
    submit();
    send_at(1, ID, 2, 1, 0);
    send_at(11, ID, 2, 1, 9);
    send_at(21, ID, 2, 2, 0);
    send_at(31, ID, 1, 2, 0);
    send_at(36, 0x124, 1, 7, 0);
    send_at(101, ID, 1, 2, 0);
    set(RX_READ, 0, 0, 0);
    submit();
    hear_until(110);
    set(RX_DELETE, 0, 0, 0);
    submit();
    send_at(111, ID, 1, 8, 0);
    hear_until(200);
}

static void hear_throttled(void)
{
    set(RX_SETUP, SETTIMER | RX_FILTER_ID, 0, 30);
    submit();
    for (int i = 0; i < 8; i++) send_at(10 * i + 1, ID, 1, i, 0);
    hear_until(200);
}

static void hear_multiplexed(void)
{
    set(RX_SETUP, 0, 0, 0);
    add(ID, 8, 0xFF, 0);    /* the selector */
    add(ID, 8, 0x01, 0xF0); /* its values, with the bits that matter for each */
    add(ID, 8, 0x02, 0x0F);
    submit();
    send_at(1, ID, 2, 1, 0x11);
    send_at(11, ID, 2, 1, 0x12);
    send_at(21, ID, 2, 2, 0x11);
    send_at(31, ID, 2, 2, 0x12);
    send_at(41, ID, 2, 1, 0x21);
    send_at(51, ID, 2, 3, 0x21);
    hear_until(200);
}

static void answer_requests(void)
{
    set(RX_SETUP, RX_RTR_FRAME, 0, 0);
    message.head.can_id |= CAN_RTR_FLAG;
    add(ID | CAN_RTR_FLAG, 2, 5, 6);
    submit();
    send_at(1, ID | CAN_RTR_FLAG, 0, 0, 0);
    hear_until(200);
}

static void make_mistakes(void)
{
    int other = socket(PF_CAN, SOCK_DGRAM, CAN_BCM), own = manager;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex("can0")};
    if (bind(manager, (struct sockaddr *)&address, sizeof address)) perror("bind");
    if (connect(manager, (struct sockaddr *)&address, sizeof address)) perror("connect");
    set(TX_DELETE, 0, 0, 0);
    submit();
    set(TX_SETUP, 0, 0, 0);
    submit();
    add(ID, 9, 0, 0);
    submit();
    set(TX_SETUP, 0, 0, 0);
    add(ID, 0, 0, 0);
    submit();
    add(ID, 0, 0, 0);
    submit();
    set(77, 0, 0, 0);
    submit();
    if (write(manager, &message, 20) != 20) perror("short");
    manager = other;
    set(TX_SEND, 0, 0, 0);
    add(ID, 0, 0, 0);
    submit();
    close(own);
}

int main(int words, char **argument)
{
    const char *act = words > 1 ? argument[1] : "";
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex("can0")};
    setvbuf(stdout, NULL, _IOLBF, 0);
    setvbuf(stderr, NULL, _IOLBF, 0);
    manager = socket(PF_CAN, SOCK_DGRAM, CAN_BCM);
    raw = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (connect(manager, (struct sockaddr *)&address, sizeof address)) return 9;
    if (bind(raw, (struct sockaddr *)&address, sizeof address)) return 9;
    if (!strcmp(act, "cyclic")) {
        send_cyclic();
    } else if (!strcmp(act, "changes")) {
        hear_changes();
    } else if (!strcmp(act, "throttle")) {
        hear_throttled();
    } else if (!strcmp(act, "multiplex")) {
        hear_multiplexed();
    } else if (!strcmp(act, "request")) {
        answer_requests();
    } else {
        make_mistakes();
    }
    return 0;
}
