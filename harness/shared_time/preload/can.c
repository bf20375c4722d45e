/* CAN sockets (AF_CAN) on the buses of the rig: CAN_RAW, and those of the broadcast manager.
 *
 * A socket is the program's end of a pair of UNIX sockets. Frames that the rig lets the program
 * hear pass the filters and are written to the pair with their time, so that the kernel itself
 * tells the program that they are there. Each socket is a port of its own on the bus.
 *
 * Source: Linux Documentation/networking/can.rst, net/can/raw.c.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/bcm.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <linux/net_tstamp.h>
#include <linux/sockios.h>
#include <net/if.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

enum { RECORD_OPEN = 17, RECORD_CLOSE, RECORD_SEND, RECORD_PORT = 29, RECORD_OPENED = 34 };
enum { QUIET = 1, OTHERS = 2 }; /* flags of a port: frames are kept; own ones are of no use */
enum { PORTS_MAX = 256, FILTERS_MAX = 512, FIRST_INDEX = 101, ALL_BUSES = 0 };

struct __attribute__((packed)) ported {
    uint8_t kind;
    uint16_t port;
    uint8_t data[CANFD_MTU];
};

/* A frame, or a message of the broadcast manager, in the pair of sockets. */
enum { MESSAGE_MAX = sizeof(struct bcm_msg_head) + 257 * CANFD_MTU };
struct heard {
    int64_t time_ns;
    int32_t index;
    int32_t flags; /* of recvmsg */
    uint8_t frame[MESSAGE_MAX];
};
enum { HEARD_HEAD = offsetof(struct heard, frame) };

struct can_socket {
    struct descriptor descriptor;
    int index; /* of the interface; ALL_BUSES */
    bool is_broadcast, is_bound, hears_own, has_fd, joins_filters, has_loopback;
    bool stamps_us, stamps_ns, counts_lost;
    unsigned timestamping; /* SOF_TIMESTAMPING_... */
    can_err_mask_t error_mask;
    struct can_filter *filters;
    int filter_count;
    int64_t timeout_ns, stamp_ns; /* SO_RCVTIMEO; time of the last frame */
    uint32_t lost;
};

static struct port {
    struct can_socket *socket; /* NULL: not open */
    uint16_t number;           /* the rig's */
    int bus;
} ports[PORTS_MAX];

static struct can_socket *can_of(int fd)
{
    struct descriptor *descriptor = descriptor_of(fd);
    if (!descriptor || descriptor->kind != CAN) return NULL;
    if (rig.state == CHILD)
        refuse(
            "a forked child of program '%s' uses its CAN socket; expected a child that opens none;"
            " let the program stay in the foreground",
            rig.name);
    return (struct can_socket *)descriptor;
}

bool is_can(int fd)
{
    return can_of(fd) != NULL;
}

static int failed(int error)
{
    errno = error;
    return -1;
}

/* ---- interfaces ------------------------------------------------------------------------------ */

static int index_of(const char *name)
{
    for (int i = 0; i < rig.bus_count; i++)
        if (!strncmp(rig.buses[i].name, name, IFNAMSIZ)) return FIRST_INDEX + i;
    return 0;
}

struct bus *bus_at(int index)
{
    int place = index - FIRST_INDEX;
    return place >= 0 && place < rig.bus_count ? &rig.buses[place] : NULL;
}

EXPORT unsigned if_nametoindex(const char *name)
{
    if (in_rig() && rig.state == AWAITING) join_rig(); /* which tells its buses */
    int index = rig.state == JOINED ? index_of(name) : 0;
    return index ? (unsigned)index : REAL(if_nametoindex)(name);
}

EXPORT char *if_indextoname(unsigned index, char name[IF_NAMESIZE])
{
    struct bus *bus = rig.state == JOINED ? bus_at(index) : NULL;
    return bus ? strcpy(name, bus->name) : REAL(if_indextoname)(index, name);
}

/* Answer a query for an interface, on any socket; set *is_known if it is for a bus of the rig. */
static int query_interface(unsigned long request, struct ifreq *query, bool *is_known)
{
    bool is_by_name = request != SIOCGIFNAME;
    struct bus *bus = bus_at(is_by_name ? index_of(query->ifr_name) : query->ifr_ifindex);
    if (!bus) return failed(ENODEV);
    *is_known = true;
    switch (request) {
    case SIOCGIFINDEX: query->ifr_ifindex = index_of(bus->name); break;
    case SIOCGIFNAME: strcpy(query->ifr_name, bus->name); break;
    case SIOCGIFMTU: query->ifr_mtu = bus->is_fd ? CANFD_MTU : CAN_MTU; break;
    default: query->ifr_flags = IFF_UP | IFF_RUNNING | IFF_NOARP;
    }
    return 0;
}

int can_ioctl(int fd, unsigned long request, void *argument, bool *is_known)
{
    struct can_socket *socket = can_of(fd);
    bool is_query = request == SIOCGIFINDEX || request == SIOCGIFNAME || request == SIOCGIFMTU ||
                    request == SIOCGIFFLAGS;
    if (is_query && in_rig()) {
        if (rig.state == AWAITING) join_rig(); /* which tells its buses */
        int result = query_interface(request, argument, is_known);
        *is_known |= socket != NULL;
        return result;
    }
    if (!socket) return 0;
    *is_known = true;
    switch (request) {
    case SIOCGSTAMP:
        if (!socket->stamp_ns) return failed(ENOENT);
        *(struct timeval *)argument =
            (struct timeval){socket->stamp_ns / NS_PER_S, socket->stamp_ns % NS_PER_S / 1000};
        return 0;
    case SIOCGSTAMPNS:
        if (!socket->stamp_ns) return failed(ENOENT);
        *(struct timespec *)argument = timespec_of(socket->stamp_ns);
        return 0;
    default: *is_known = false; return 0;
    }
}

/* ---- ports ----------------------------------------------------------------------------------- */

/* Tell the rig what the program does with the frames of a port, so that it calls less often. */
static void tell_use(const struct port *port)
{
    uint8_t flags = QUIET | (port->socket->hears_own ? 0 : OTHERS);
    if (port->socket->is_broadcast) flags = 0; /* its operations act at the times of frames */
    struct ported record = {RECORD_PORT, port->number, {flags}};
    hold_record(&record, offsetof(struct ported, data) + 1);
}

static struct port *open_port(struct can_socket *socket, int bus)
{
    struct ported record = {.kind = RECORD_OPEN, .port = rig.buses[bus].is_fd};
    size_t size = strlen(rig.buses[bus].name);
    struct port *port = ports;
    while (port < ports + PORTS_MAX && port->socket) port++;
    if (port == ports + PORTS_MAX) {
        errno = ENOBUFS;
        return NULL;
    }
    memcpy(record.data, rig.buses[bus].name, size);
    send_record(&record, offsetof(struct ported, data) + size);
    receive_record((uint8_t *)&record, sizeof record);
    if (record.kind != RECORD_OPENED) refuse("%s: not opened by the rig", rig.buses[bus].name);
    *port = (struct port){socket, record.port, bus};
    tell_use(port);
    return port;
}

static void close_ports(struct can_socket *socket)
{
    for (struct port *port = ports; port < ports + PORTS_MAX; port++) {
        struct ported record = {.kind = RECORD_CLOSE, .port = port->number};
        if (port->socket != socket) continue;
        port->socket = NULL;
        if (rig.state == JOINED) send_record(&record, offsetof(struct ported, data));
    }
}

/* Return the port of a socket on a bus; it is opened for a socket that sends without bind(). */
static struct port *port_on(struct can_socket *socket, int bus)
{
    for (struct port *port = ports; port < ports + PORTS_MAX; port++)
        if (port->socket == socket && port->bus == bus) return port;
    return open_port(socket, bus);
}

void close_can(struct can_socket *socket)
{
    if (socket->is_broadcast) close_broadcast(socket);
    close_ports(socket);
    free(socket->filters);
    free(socket);
}

/* ---- frames that are heard ------------------------------------------------------------------- */

/* Return whether one of the filters lets the frame pass; all of them with CAN_RAW_JOIN_FILTERS. */
static bool passes(const struct can_socket *socket, canid_t id)
{
    if (id & CAN_ERR_FLAG) return socket->error_mask & id & CAN_ERR_MASK;
    int matches = 0;
    for (int i = 0; i < socket->filter_count; i++) {
        struct can_filter filter = socket->filters[i];
        bool is_inverted = filter.can_id & CAN_INV_FILTER;
        canid_t wanted = filter.can_id & ~CAN_INV_FILTER;
        matches += ((id & filter.can_mask) == (wanted & filter.can_mask)) != is_inverted;
    }
    return socket->joins_filters ? matches == socket->filter_count : matches != 0;
}

/* Return the open port of this number, or NULL. */
static const struct port *port_of(unsigned number)
{
    for (const struct port *port = ports; port < ports + PORTS_MAX; port++)
        if (port->socket && port->number == number) return port;
    return NULL;
}

/* Write what the program receives to the pair. */
static void put_heard(struct can_socket *socket, const struct heard *heard, size_t size)
{
    if (REAL(send)(socket->descriptor.inner, heard, HEARD_HEAD + size,
                   MSG_DONTWAIT | MSG_NOSIGNAL) >= 0)
        return;
    if (!socket->lost++)
        tell("program '%s': a socket on %s is full; frames are lost, as in the kernel", rig.name,
             bus_at(heard->index) ? bus_at(heard->index)->name : "all buses");
}

void queue_message(struct can_socket *socket, int index, const void *message, size_t size)
{
    struct heard heard;
    heard.time_ns = rig.now_ns;
    heard.index = index;
    heard.flags = 0;
    memcpy(heard.frame, message, size);
    put_heard(socket, &heard, size);
}

void hear(unsigned number, int64_t time_ns, bool is_transmitted, bool is_error, const void *frame,
          size_t size)
{
    const struct port *port = port_of(number);
    struct can_socket *socket = port ? port->socket : NULL;
    struct heard heard;
    canid_t id;
    (void)is_error; /* its identifier says so */
    if (!socket || !socket->is_bound || size > CANFD_MTU) return;
    if (socket->is_broadcast) {
        hear_broadcast(socket, FIRST_INDEX + port->bus, frame, size);
        return;
    }
    memcpy(&id, frame, sizeof id);
    if ((is_transmitted && !socket->hears_own) || (size == CANFD_MTU && !socket->has_fd)) return;
    if (!passes(socket, id)) return;
    heard.time_ns = time_ns;
    heard.index = FIRST_INDEX + port->bus;
    heard.flags = is_transmitted ? MSG_DONTROUTE | MSG_CONFIRM : 0;
    memcpy(heard.frame, frame, size);
    put_heard(socket, &heard, size);
}

/* Take the next frame out of the pair; wait for it if the socket blocks. Return its size. */
static ssize_t take(int fd, struct can_socket *socket, struct heard *heard, int flags)
{
    int64_t deadline_ns = socket->timeout_ns ? deadline_after(socket->timeout_ns) : NEVER;
    ssize_t size;
    while ((size = REAL(recv)(fd, heard, sizeof *heard, MSG_DONTWAIT | (flags & MSG_PEEK))) < 0) {
        if (errno != EAGAIN) return -1;
        if (!is_blocking(fd, flags)) {
            look();
            return failed(EAGAIN);
        }
        enum result result = wait_for_input(fd, deadline_ns);
        if (result != HOLDS) return failed(result == EXPIRED ? EAGAIN : EINTR);
    }
    if (size < HEARD_HEAD) return 0; /* the socket is shut down */
    socket->stamp_ns = heard->time_ns;
    return size - HEARD_HEAD;
}

ssize_t can_receive(int fd, void *data, size_t size, int flags, void *address, void *address_size)
{
    struct heard heard;
    ssize_t taken = take(fd, can_of(fd), &heard, flags);
    if (taken <= 0) return taken;
    memcpy(data, heard.frame, (size_t)taken < size ? (size_t)taken : size);
    if (address && address_size) {
        struct sockaddr_can from = {.can_family = AF_CAN, .can_ifindex = heard.index};
        socklen_t *space = address_size;
        memcpy(address, &from, *space < sizeof from ? *space : sizeof from);
        *space = sizeof from;
    }
    return (size_t)taken < size || flags & MSG_TRUNC ? taken : (ssize_t)size;
}

static void add_message(struct msghdr *message, size_t *used, int type, const void *data,
                        size_t size)
{
    if (*used + CMSG_SPACE(size) > message->msg_controllen) {
        message->msg_flags |= MSG_CTRUNC;
        return;
    }
    struct cmsghdr *head = (struct cmsghdr *)((char *)message->msg_control + *used);
    *head =
        (struct cmsghdr){.cmsg_len = CMSG_LEN(size), .cmsg_level = SOL_SOCKET, .cmsg_type = type};
    memcpy(CMSG_DATA(head), data, size);
    *used += CMSG_SPACE(size);
}

EXPORT ssize_t recvmsg(int fd, struct msghdr *message, int flags)
{
    struct can_socket *socket = can_of(fd);
    struct heard heard;
    size_t done = 0, used = 0;
    if (!socket && message->msg_iovlen) {
        struct iovec *part = message->msg_iov;
        ssize_t taken = take_netlink(fd, part->iov_base, part->iov_len, flags, message->msg_name,
                                     &message->msg_namelen);
        if (taken >= 0) return taken;
    }
    if (!socket) return await_input(fd, flags) ? charged(REAL(recvmsg)(fd, message, flags)) : -1;
    ssize_t size = take(fd, socket, &heard, flags);
    if (size < 0) return -1;
    for (size_t i = 0; i < message->msg_iovlen && done < (size_t)size; i++) {
        struct iovec *part = &message->msg_iov[i];
        size_t length = size - done < part->iov_len ? size - done : part->iov_len;
        memcpy(part->iov_base, heard.frame + done, length);
        done += length;
    }
    message->msg_flags = heard.flags | (done < (size_t)size ? MSG_TRUNC : 0);
    if (message->msg_name) {
        struct sockaddr_can from = {.can_family = AF_CAN, .can_ifindex = heard.index};
        memcpy(message->msg_name, &from,
               message->msg_namelen < sizeof from ? message->msg_namelen : sizeof from);
        message->msg_namelen = sizeof from;
    }
    struct timespec time = timespec_of(heard.time_ns);
    struct timeval time_us = {time.tv_sec, time.tv_nsec / 1000};
    if (socket->stamps_us) add_message(message, &used, SO_TIMESTAMP, &time_us, sizeof time_us);
    if (socket->stamps_ns) add_message(message, &used, SO_TIMESTAMPNS, &time, sizeof time);
    struct timespec stamps[3] = {time}; /* by the software; the controller's are zero */
    if (socket->timestamping & SOF_TIMESTAMPING_SOFTWARE)
        add_message(message, &used, SO_TIMESTAMPING, stamps, sizeof stamps);
    if (socket->counts_lost && socket->lost)
        add_message(message, &used, SO_RXQ_OVFL, &socket->lost, sizeof socket->lost);
    message->msg_controllen = used;
    return done;
}

/* Receive messages as the kernel does: the first as the flags say, the others without a wait if
 * MSG_WAITFORONE is set; the timeout is looked at after each. */
EXPORT int recvmmsg(int fd, struct mmsghdr *messages, unsigned count, int flags,
                    struct timespec *timeout)
{
    if (!in_rig()) return REAL(recvmmsg)(fd, messages, count, flags, timeout);
    if (timeout && !is_duration(timeout)) return failed(EINVAL);
    int64_t end_ns = timeout ? rig.now_ns + duration_ns(timeout) : 0;
    unsigned done = 0;
    while (done < count) {
        ssize_t size = recvmsg(fd, &messages[done].msg_hdr, flags & ~MSG_WAITFORONE);
        if (size < 0) break;
        messages[done++].msg_len = size;
        if (flags & MSG_WAITFORONE) flags |= MSG_DONTWAIT;
        if (timeout && rig.now_ns >= end_ns) break;
    }
    if (timeout) *timeout = timespec_of(end_ns > rig.now_ns ? end_ns - rig.now_ns : 0);
    return done || !count ? (int)done : -1;
}

/* ---- frames that are sent -------------------------------------------------------------------- */

/* Send a frame through the open port of a socket. */
void send_frame(struct can_socket *socket, int index, const void *frame, size_t size)
{
    const struct port *port = port_on(socket, index - FIRST_INDEX);
    struct ported record = {.kind = RECORD_SEND, .port = port->number};
    memcpy(record.data, frame, size);
    send_record(&record, offsetof(struct ported, data) + size);
}

static ssize_t can_broadcast(struct can_socket *socket, const void *data, size_t size, int index);

ssize_t can_send(int fd, const void *data, size_t size, const void *address, size_t address_size)
{
    struct can_socket *socket = can_of(fd);
    const struct sockaddr_can *to = address;
    int index = socket->index;
    if (thread_here && thread_here->waits)
        refuse("program '%s' sends a frame in a signal handler; expected a flag that its main loop"
               " looks at",
               rig.name);
    if (to) {
        if (address_size < offsetof(struct sockaddr_can, can_addr) || to->can_family != AF_CAN)
            return failed(EINVAL);
        index = socket->is_broadcast && index ? index : to->can_ifindex;
    }
    if (socket->is_broadcast) return can_broadcast(socket, data, size, index);
    struct bus *bus = bus_at(index);
    if (!bus) return failed(ENXIO);
    if (size != CAN_MTU && (size != CANFD_MTU || !socket->has_fd || !bus->is_fd))
        return failed(EINVAL);
    if (!port_on(socket, index - FIRST_INDEX)) return -1;
    send_frame(socket, index, data, size);
    return size;
}

/* Let the broadcast manager carry out a message; it has a bus of its own, or none. */
static ssize_t can_broadcast(struct can_socket *socket, const void *data, size_t size, int index)
{
    if (!socket->is_bound) return failed(ENOTCONN);
    if (index && !bus_at(index)) return failed(ENODEV);
    if (index && !port_on(socket, index - FIRST_INDEX)) return -1;
    return send_broadcast(socket, index, data, size);
}

EXPORT ssize_t sendmsg(int fd, const struct msghdr *message, int flags)
{
    uint8_t frame[MESSAGE_MAX];
    size_t size = 0;
    if (is_line(fd)) return send_parts(fd, message->msg_iov, message->msg_iovlen, flags);
    if (!is_can(fd)) {
        ssize_t whole = 0;
        if (!answer_netlink(fd, message)) return REAL(sendmsg)(fd, message, flags);
        for (size_t i = 0; i < message->msg_iovlen; i++) whole += message->msg_iov[i].iov_len;
        return whole;
    }
    for (size_t i = 0; i < message->msg_iovlen; i++) {
        struct iovec *part = &message->msg_iov[i];
        if (part->iov_len > sizeof frame - size) return failed(EINVAL);
        memcpy(frame + size, part->iov_base, part->iov_len);
        size += part->iov_len;
    }
    return can_send(fd, frame, size, message->msg_name, message->msg_namelen);
}

EXPORT int sendmmsg(int fd, struct mmsghdr *messages, unsigned count, int flags)
{
    if (!in_rig()) return REAL(sendmmsg)(fd, messages, count, flags);
    unsigned done = 0;
    while (done < count) {
        ssize_t size = sendmsg(fd, &messages[done].msg_hdr, flags);
        if (size < 0) break;
        messages[done++].msg_len = size;
    }
    return done || !count ? (int)done : -1;
}

/* ---- sockets --------------------------------------------------------------------------------- */

EXPORT int socket(int domain, int type, int protocol)
{
    const int kind = type & ~(SOCK_NONBLOCK | SOCK_CLOEXEC);
    const char *names[] = {"0",    "CAN_RAW", "CAN_BCM",   "TP16",
                           "TP20", "MCNET",   "CAN_ISOTP", "CAN_J1939"};
    int pair[2];
    if (!in_rig() || domain != PF_CAN) return REAL(socket)(domain, type, protocol);
    bool is_broadcast = kind == SOCK_DGRAM && protocol == CAN_BCM;
    if (!is_broadcast && (kind != SOCK_RAW || protocol != CAN_RAW)) {
        bool is_named = protocol >= 0 && protocol < (int)(sizeof names / sizeof *names);
        tell("program '%s': a socket of protocol %s (%d): not supported; expected CAN_RAW or"
             " CAN_BCM",
             rig.name, is_named ? names[protocol] : "unknown", protocol);
        return failed(EPROTONOSUPPORT);
    }
    if (rig.state == AWAITING) join_rig();
    struct can_socket *socket = calloc(1, sizeof *socket);
    struct can_filter *all = calloc(1, sizeof *all); /* mask 0: every frame */
    if (!socket || !all || socketpair(AF_UNIX, SOCK_SEQPACKET | (type & ~kind), 0, pair) < 0)
        return -1;
    *socket = (struct can_socket){
        .descriptor = {.kind = CAN, .inner = set_apart(pair[1])},
        .is_broadcast = is_broadcast,
        .has_loopback = true,
        .filters = all,
        .filter_count = 1,
    };
    keep(pair[0], &socket->descriptor);
    return pair[0];
}

/* Open the ports of a socket on an interface, or on all of them. */
static int bind_to(struct can_socket *socket, int index)
{
    socket->index = index;
    socket->is_bound = true;
    for (int bus = 0; bus < rig.bus_count; bus++)
        if (index == ALL_BUSES || index == FIRST_INDEX + bus)
            if (!open_port(socket, bus)) return -1;
    return 0;
}

/* Connect a socket of the broadcast manager, which cannot be bound. */
static int connect_broadcast(struct can_socket *socket, const struct sockaddr_can *own,
                             socklen_t size)
{
    if (size < offsetof(struct sockaddr_can, can_addr)) return failed(EINVAL);
    if (socket->is_bound) return failed(EISCONN);
    if (own->can_ifindex != ALL_BUSES && !bus_at(own->can_ifindex)) return failed(ENODEV);
    return bind_to(socket, own->can_ifindex);
}

EXPORT int bind(int fd, const struct sockaddr *address, socklen_t size)
{
    struct can_socket *socket = can_of(fd);
    const struct sockaddr_can *own = (const struct sockaddr_can *)address;
    if (!socket) return REAL(bind)(fd, address, size);
    if (socket->is_broadcast) return failed(EOPNOTSUPP);
    if (size < offsetof(struct sockaddr_can, can_addr) || own->can_family != AF_CAN)
        return failed(EINVAL);
    if (own->can_ifindex != ALL_BUSES && !bus_at(own->can_ifindex)) return failed(ENODEV);
    close_ports(socket);
    return bind_to(socket, own->can_ifindex);
}

EXPORT int connect(int fd, const struct sockaddr *address, socklen_t size)
{
    int result;
    bool is_local = address && size >= sizeof address->sa_family && address->sa_family == AF_UNIX;
    if (is_local && in_rig() && rig.state == AWAITING) join_rig(); /* the other end may be there */
    if (connect_line(fd, address, size, &result)) return result;
    struct can_socket *socket = can_of(fd);
    if (!socket) return REAL(connect)(fd, address, size);
    if (!socket->is_broadcast) return failed(EOPNOTSUPP);
    return connect_broadcast(socket, (const struct sockaddr_can *)address, size);
}

EXPORT int getsockname(int fd, struct sockaddr *restrict address, socklen_t *restrict size)
{
    struct can_socket *socket = can_of(fd);
    if (!socket) return REAL(getsockname)(fd, address, size);
    struct sockaddr_can own = {.can_family = AF_CAN, .can_ifindex = socket->index};
    memcpy(address, &own, *size < sizeof own ? *size : sizeof own);
    *size = sizeof own;
    return 0;
}

static int set_filters(struct can_socket *socket, const void *value, socklen_t size)
{
    if (size % sizeof(struct can_filter) || size / sizeof(struct can_filter) > FILTERS_MAX)
        return failed(EINVAL);
    struct can_filter *filters = malloc(size + 1);
    if (!filters) return failed(ENOMEM);
    if (size) memcpy(filters, value, size);
    free(socket->filters);
    socket->filters = filters;
    socket->filter_count = size / sizeof *filters;
    return 0;
}

static int set_option(struct can_socket *socket, int level, int option, const void *value,
                      socklen_t size)
{
    int number = 0;
    if (level == SOL_CAN_RAW && option == CAN_RAW_FILTER) return set_filters(socket, value, size);
    if (size < sizeof number) return failed(EINVAL);
    memcpy(&number, value, sizeof number);
    if (level == SOL_CAN_RAW) switch (option) {
        case CAN_RAW_ERR_FILTER: socket->error_mask = number & CAN_ERR_MASK; return 0;
        case CAN_RAW_RECV_OWN_MSGS:
            socket->hears_own = number;
            for (struct port *port = ports; port < ports + PORTS_MAX; port++)
                if (port->socket == socket) tell_use(port);
            return 0;
        case CAN_RAW_FD_FRAMES: socket->has_fd = number; return 0;
        case CAN_RAW_JOIN_FILTERS: socket->joins_filters = number; return 0;
        case CAN_RAW_LOOPBACK:
            if (!number && socket->has_loopback)
                tell(
                    "program '%s': CAN_RAW_LOOPBACK 0: not supported; other sockets on the bus hear"
                    " the frames",
                    rig.name);
            socket->has_loopback = number;
            return 0;
        default: return failed(ENOPROTOOPT);
        }
    if (level == SOL_SOCKET) switch (option) {
        case SO_TIMESTAMP: socket->stamps_us = number; return 0;
        case SO_TIMESTAMPNS: socket->stamps_ns = number; return 0;
        case SO_TIMESTAMPING: socket->timestamping = number; return 0;
        case SO_RXQ_OVFL: socket->counts_lost = number; return 0;
        case SO_RCVTIMEO:
            if (size < sizeof(struct timeval)) return failed(EINVAL);
            const struct timeval *limit = value;
            socket->timeout_ns = limit->tv_sec * (int64_t)NS_PER_S + limit->tv_usec * 1000;
            return 0;
        case SO_RCVBUF:
        case SO_RCVBUFFORCE: /* the space of a pair is that of its sender */
            return REAL(setsockopt)(socket->descriptor.inner, SOL_SOCKET, SO_SNDBUF, value, size);
        case SO_SNDBUF:
        case SO_SNDBUFFORCE:
        case SO_SNDTIMEO:
        case SO_PRIORITY:
        case SO_REUSEADDR: return 0;
        }
    return failed(ENOPROTOOPT);
}

EXPORT int setsockopt(int fd, int level, int option, const void *value, socklen_t size)
{
    struct can_socket *socket = can_of(fd);
    if (is_option_of_line(fd, level)) return 0;
    return socket ? set_option(socket, level, option, value, size)
                  : REAL(setsockopt)(fd, level, option, value, size);
}

EXPORT int getsockopt(int fd, int level, int option, void *restrict value, socklen_t *restrict size)
{
    struct can_socket *socket = can_of(fd);
    int number;
    if (is_option_of_line(fd, level)) {
        memset(value, 0, *size);
        return 0;
    }
    if (!socket) return REAL(getsockopt)(fd, level, option, value, size);
    if (level == SOL_CAN_RAW && option == CAN_RAW_FILTER) {
        socklen_t full = socket->filter_count * sizeof *socket->filters;
        *size = *size < full ? *size : full;
        memcpy(value, socket->filters, *size);
        return 0;
    }
    if (level == SOL_CAN_RAW) switch (option) {
        case CAN_RAW_ERR_FILTER: number = socket->error_mask; break;
        case CAN_RAW_RECV_OWN_MSGS: number = socket->hears_own; break;
        case CAN_RAW_FD_FRAMES: number = socket->has_fd; break;
        case CAN_RAW_JOIN_FILTERS: number = socket->joins_filters; break;
        case CAN_RAW_LOOPBACK: number = socket->has_loopback; break;
        default: return failed(ENOPROTOOPT);
        }
    else if (level == SOL_SOCKET && option == SO_DOMAIN)
        number = PF_CAN;
    else if (level == SOL_SOCKET && option == SO_TYPE)
        number = socket->is_broadcast ? SOCK_DGRAM : SOCK_RAW;
    else if (level == SOL_SOCKET && option == SO_PROTOCOL)
        number = socket->is_broadcast ? CAN_BCM : CAN_RAW;
    else
        return REAL(getsockopt)(fd, level, option, value, size);
    if (*size < sizeof number) return failed(EINVAL);
    memcpy(value, &number, sizeof number);
    *size = sizeof number;
    return 0;
}
