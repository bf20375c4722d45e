/* The broadcast manager (CAN_BCM): frames that the kernel sends by itself, and content filters.
 *
 * A message to the socket sets an operation up: frames to send in an interval, or an identifier
 * whose changes and absence are told. An operation has its own alarms. Messages to the program pass
 * through the pair of sockets, as frames of CAN_RAW do.
 *
 * Source: Linux Documentation/networking/can.rst, "Broadcast Manager protocol sockets";
 * include/uapi/linux/can/bcm.h.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/bcm.h>
#include <stdlib.h>
#include <string.h>

enum { FRAMES_MAX = 256, NS_PER_US = 1000 };
enum { RECEIVED = 1, THROTTLED = 2 }; /* of a frame's last content */

struct operation {
    struct operation *next;
    struct can_socket *socket;
    bool receives;
    int index, from; /* interfaces: its own, 0 for each; that of the last frame */
    struct bcm_msg_head head;
    size_t frame_size;
    uint32_t current;   /* the frame that is sent next */
    uint8_t *frames;    /* to send; or masks of the bits that matter */
    uint8_t *last;      /* contents that were received, of each mask */
    uint8_t *states;    /* RECEIVED | THROTTLED, of each */
    int64_t told_ns;    /* last message that a throttled operation has sent; NEVER: none */
    struct alarm alarm; /* next frame; or its absence */
    struct alarm throttle;
};

static struct operation *operations;

#define OF_ALARM(member, alarm_) \
    ((struct operation *)((char *)(alarm_) - offsetof(struct operation, member)))

static int failed(int error)
{
    errno = error;
    return -1;
}

static int64_t ns_of(struct bcm_timeval time)
{
    return time.tv_sec * (int64_t)NS_PER_S + time.tv_usec * NS_PER_US;
}

static uint8_t *frame_at(const struct operation *operation, uint32_t number)
{
    return operation->frames + number * operation->frame_size;
}

/* Send a message to the program. */
static void tell_program(const struct operation *operation, uint32_t opcode, const void *frames,
                         uint32_t count)
{
    size_t size = count * operation->frame_size;
    struct bcm_msg_head *message = malloc(sizeof *message + size);
    if (!message) refuse("program '%s': no memory for a message of CAN_BCM", rig.name);
    *message = operation->head;
    message->opcode = opcode;
    message->nframes = count;
    if (size) memcpy(message + 1, frames, size);
    queue_message(operation->socket, operation->from, message, sizeof *message + size);
    free(message);
}

/* ---- frames that are sent -------------------------------------------------------------------- */

static void send_next(struct operation *operation)
{
    send_frame(operation->socket, operation->index, frame_at(operation, operation->current),
               operation->frame_size);
    if (operation->head.count) operation->head.count--;
    if (++operation->current >= operation->head.nframes) operation->current = 0;
}

/* Set the alarm for the next frame: in the first interval while frames of it are left. */
static void await_next(struct operation *operation)
{
    const struct bcm_msg_head *head = &operation->head;
    bool is_first = head->count && ns_of(head->ival1);
    int64_t next_ns = ns_of(is_first ? head->ival1 : head->ival2);
    if (operation->alarm.number && operation->alarm.period_ns == next_ns &&
        operation->alarm.interval_ns == next_ns)
        return; /* it rings on */
    if (next_ns > 0)
        start_alarm(&operation->alarm, next_ns, next_ns);
    else
        stop_alarm(&operation->alarm);
}

static void ring_sending(struct alarm *alarm)
{
    struct operation *operation = OF_ALARM(alarm, alarm);
    const struct bcm_msg_head *head = &operation->head;
    bool is_counted = head->count && ns_of(head->ival1);
    send_next(operation);
    if (is_counted && !head->count && head->flags & TX_COUNTEVT)
        tell_program(operation, TX_EXPIRED, NULL, 0);
    await_next(operation);
}

/* ---- frames that are received ---------------------------------------------------------------- */

static void tell_change(struct operation *operation, uint32_t number)
{
    operation->states[number] &= ~THROTTLED;
    tell_program(operation, RX_CHANGED, operation->last + number * operation->frame_size, 1);
}

/* Tell the changes that were held back; return whether there were any. */
static bool tell_throttled(struct operation *operation)
{
    bool were_some = false;
    uint32_t count = operation->head.nframes ? operation->head.nframes : 1;
    for (uint32_t i = 0; i < count; i++)
        if (operation->states[i] & THROTTLED) {
            tell_change(operation, i);
            were_some = true;
        }
    return were_some;
}

static void ring_throttle(struct alarm *alarm)
{
    struct operation *operation = OF_ALARM(throttle, alarm);
    if (tell_throttled(operation)) return;
    operation->told_ns = NEVER;
    stop_alarm(alarm);
}

static void ring_absence(struct alarm *alarm)
{
    struct operation *operation = OF_ALARM(alarm, alarm);
    uint32_t count = operation->head.nframes ? operation->head.nframes : 1;
    if (operation->head.flags & RX_ANNOUNCE_RESUME) memset(operation->states, 0, count);
    tell_program(operation, RX_TIMEOUT, NULL, 0);
}

/* Keep a content that has changed; tell it now, or when the throttle allows. */
static void note_change(struct operation *operation, uint32_t number, const void *frame)
{
    int64_t least_ns = ns_of(operation->head.ival2);
    memcpy(operation->last + number * operation->frame_size, frame, operation->frame_size);
    operation->states[number] = RECEIVED | THROTTLED;
    if (least_ns && operation->throttle.number) return;
    if (least_ns && operation->told_ns != NEVER && rig.now_ns - operation->told_ns < least_ns) {
        start_alarm(&operation->throttle, operation->told_ns + least_ns - rig.now_ns, least_ns);
        return;
    }
    tell_change(operation, number);
    operation->told_ns = rig.now_ns;
}

/* Return whether two contents differ in the bits of a mask. */
static bool differ(const uint8_t *mask, const uint8_t *one, const uint8_t *other, size_t size)
{
    for (size_t i = 0; i < size; i++)
        if ((one[i] ^ other[i]) & mask[i]) return true;
    return false;
}

static void compare(struct operation *operation, uint32_t number, const struct canfd_frame *frame)
{
    const struct canfd_frame *mask = (void *)frame_at(operation, number);
    const struct canfd_frame *last = (void *)(operation->last + number * operation->frame_size);
    bool has_changed = !(operation->states[number] & RECEIVED) ||
                       differ(mask->data, frame->data, last->data, frame->len) ||
                       (operation->head.flags & RX_CHECK_DLC && frame->len != last->len);
    if (has_changed) note_change(operation, number, frame);
}

static void receive(struct operation *operation, const struct canfd_frame *frame)
{
    const struct bcm_msg_head *head = &operation->head;
    stop_alarm(&operation->alarm);
    if (head->flags & RX_RTR_FRAME) {
        send_frame(operation->socket, operation->from, operation->frames, operation->frame_size);
        return;
    }
    if (head->flags & RX_FILTER_ID) {
        note_change(operation, 0, frame);
    } else if (head->nframes == 1) {
        compare(operation, 0, frame);
    } else {
        const struct canfd_frame *selector = (void *)operation->frames;
        for (uint32_t i = 1; i < head->nframes; i++) {
            const struct canfd_frame *one = (void *)frame_at(operation, i);
            if (differ(selector->data, frame->data, one->data, CAN_MAX_DLEN)) continue;
            compare(operation, i, frame);
            break;
        }
    }
    if (!(head->flags & RX_NO_AUTOTIMER) && ns_of(head->ival1))
        start_alarm(&operation->alarm, ns_of(head->ival1), 0);
}

/* Let the operations of a socket hear a frame of an interface. */
void hear_broadcast(struct can_socket *socket, int index, const void *frame, size_t size)
{
    struct canfd_frame own = {0};
    memcpy(&own, frame, size);
    for (struct operation *operation = operations; operation; operation = operation->next) {
        if (operation->socket != socket || !operation->receives || operation->frame_size != size)
            continue;
        if (operation->head.can_id != own.can_id) continue;
        if (operation->index && operation->index != index) continue;
        operation->from = index;
        receive(operation, &own);
    }
}

/* ---- messages of the program ----------------------------------------------------------------- */

static struct operation **place_of(const struct can_socket *socket, bool receives, int index,
                                   const struct bcm_msg_head *head)
{
    struct operation **place = &operations;
    for (; *place; place = &(*place)->next) {
        const struct operation *one = *place;
        if (one->socket == socket && one->receives == receives && one->index == index &&
            one->head.can_id == head->can_id &&
            !((one->head.flags ^ head->flags) & CAN_FD_FRAME))
            break;
    }
    return place;
}

static void delete(struct operation **place)
{
    struct operation *operation = *place;
    *place = operation->next;
    stop_alarm(&operation->alarm);
    stop_alarm(&operation->throttle);
    free(operation->frames);
    free(operation->last);
    free(operation->states);
    free(operation);
}

void close_broadcast(struct can_socket *socket)
{
    for (struct operation **place = &operations; *place;)
        if ((*place)->socket == socket)
            delete (place);
        else
            place = &(*place)->next;
}

/* Return the operation that a message sets up, with its frames; NULL with errno. */
static struct operation *operation_for(struct can_socket *socket, bool receives, int index,
                                       const struct bcm_msg_head *head, size_t frame_size)
{
    struct operation **place = place_of(socket, receives, index, head), *operation = *place;
    uint32_t count = head->nframes ? head->nframes : 1;
    if (operation && head->nframes > operation->head.nframes) {
        errno = E2BIG;
        return NULL;
    }
    if (!operation) {
        operation = calloc(1, sizeof *operation);
        if (!operation) return NULL;
        *operation = (struct operation){
            .socket = socket, .receives = receives, .index = index, .from = index,
            .frame_size = frame_size, .told_ns = NEVER,
            .frames = calloc(count, frame_size), .last = calloc(count, frame_size),
            .states = calloc(count, 1),
            .alarm.ring = receives ? ring_absence : ring_sending,
            .throttle.ring = ring_throttle,
            .next = operations};
        operation->head.can_id = head->can_id;
        if (!operation->frames || !operation->last || !operation->states)
            refuse("program '%s': no memory for an operation of CAN_BCM", rig.name);
        operations = operation;
    }
    if (head->nframes) {
        memcpy(operation->frames, head->frames, head->nframes * frame_size);
        memset(operation->states, 0, count);
    }
    if (operation->head.nframes != head->nframes) operation->current = 0;
    operation->head.nframes = head->nframes;
    operation->head.flags = head->flags;
    return operation;
}

static void set_intervals(struct operation *operation, const struct bcm_msg_head *head)
{
    operation->head.count = head->count;
    operation->head.ival1 = head->ival1;
    operation->head.ival2 = head->ival2;
}

static int set_up_sending(struct can_socket *socket, int index, const struct bcm_msg_head *head,
                          size_t frame_size)
{
    int length_max = frame_size == CANFD_MTU ? CANFD_MAX_DLEN : CAN_MAX_DLEN;
    if (!index) return failed(ENODEV);
    if (frame_size == CANFD_MTU && !bus_at(index)->is_fd) return failed(EINVAL);
    if (!head->nframes || head->nframes > FRAMES_MAX) return failed(EINVAL);
    for (uint32_t i = 0; i < head->nframes; i++) {
        const struct canfd_frame *frame = (void *)((char *)head->frames + i * frame_size);
        if (frame->len > length_max) return failed(EINVAL);
    }
    struct operation *operation = operation_for(socket, false, index, head, frame_size);
    if (!operation) return -1;
    for (uint32_t i = 0; i < head->nframes && head->flags & TX_CP_CAN_ID; i++)
        memcpy(frame_at(operation, i), &head->can_id, sizeof head->can_id);
    if (head->flags & TX_RESET_MULTI_IDX) operation->current = 0;
    if (head->flags & SETTIMER) {
        set_intervals(operation, head);
        if (!ns_of(head->ival1) && !ns_of(head->ival2)) stop_alarm(&operation->alarm);
    }
    if (head->flags & STARTTIMER) {
        stop_alarm(&operation->alarm);
        operation->head.flags |= TX_ANNOUNCE;
    }
    if (operation->head.flags & TX_ANNOUNCE) send_next(operation);
    if (head->flags & STARTTIMER) await_next(operation);
    return 0;
}

static int set_up_receiving(struct can_socket *socket, int index, struct bcm_msg_head *head,
                            size_t frame_size)
{
    if (head->flags & RX_FILTER_ID || !head->nframes) {
        head->flags |= RX_FILTER_ID;
        head->nframes = 0;
    }
    if (head->nframes > FRAMES_MAX + 1) return failed(EINVAL);
    bool answers = head->flags & RX_RTR_FRAME;
    if (answers && (head->nframes != 1 || !(head->can_id & CAN_RTR_FLAG))) return failed(EINVAL);
    struct operation *operation = operation_for(socket, true, index, head, frame_size);
    if (!operation) return -1;
    if (answers) {
        canid_t *id = (canid_t *)operation->frames;
        if (head->flags & TX_CP_CAN_ID || *id == head->can_id) *id = head->can_id & ~CAN_RTR_FLAG;
        stop_alarm(&operation->alarm);
        stop_alarm(&operation->throttle);
        return 0;
    }
    if (head->flags & SETTIMER) {
        set_intervals(operation, head);
        if (!ns_of(head->ival1)) stop_alarm(&operation->alarm);
        operation->told_ns = NEVER;
        stop_alarm(&operation->throttle);
        tell_throttled(operation);
    }
    if (head->flags & STARTTIMER && ns_of(operation->head.ival1))
        start_alarm(&operation->alarm, ns_of(operation->head.ival1), 0);
    return 0;
}

static int delete_operation(struct operation **place)
{
    if (!*place) return failed(EINVAL);
    delete (place);
    return 0;
}

static int read_operation(struct operation *operation, uint32_t opcode)
{
    if (!operation) return failed(EINVAL);
    tell_program(operation, opcode, operation->frames, operation->head.nframes);
    return 0;
}

/* Carry out a message of the program; return 0, or -1 with errno. */
static int carry_out(struct can_socket *socket, int index, struct bcm_msg_head *head, size_t size)
{
    size_t frame_size = head->flags & CAN_FD_FRAME ? CANFD_MTU : CAN_MTU;
    bool receives = head->opcode >= RX_SETUP;
    bool has_frames = head->opcode == TX_SETUP || head->opcode == RX_SETUP;
    if ((size - sizeof *head) % frame_size) return failed(EINVAL);
    if (has_frames && size < sizeof *head + head->nframes * frame_size) return failed(EINVAL);
    switch (head->opcode) {
    case TX_SETUP: return set_up_sending(socket, index, head, frame_size);
    case RX_SETUP: return set_up_receiving(socket, index, head, frame_size);
    case TX_DELETE:
    case RX_DELETE: return delete_operation(place_of(socket, receives, index, head));
    case TX_READ: return read_operation(*place_of(socket, receives, index, head), TX_STATUS);
    case RX_READ: return read_operation(*place_of(socket, receives, index, head), RX_STATUS);
    case TX_SEND:
        if (head->nframes != 1 || size != sizeof *head + frame_size) return failed(EINVAL);
        if (!index) return failed(ENODEV);
        if (frame_size == CANFD_MTU && !bus_at(index)->is_fd) return failed(EINVAL);
        send_frame(socket, index, head->frames, frame_size);
        return 0;
    default: return failed(EINVAL);
    }
}

ssize_t send_broadcast(struct can_socket *socket, int index, const void *data, size_t size)
{
    if (size < sizeof(struct bcm_msg_head)) return failed(EINVAL);
    struct bcm_msg_head *head = malloc(size);
    if (!head) return failed(ENOMEM);
    memcpy(head, data, size);
    int result = carry_out(socket, index, head, size);
    int error = errno;
    free(head);
    errno = error;
    return result < 0 ? -1 : (ssize_t)size;
}
