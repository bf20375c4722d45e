/* Answers for the rig's buses on sockets of NETLINK_ROUTE, as lely-core and libsocketcan ask.
 *
 * A request for an interface of the rig is not sent to the kernel, which does not know it. The
 * answer waits here until the program receives on that socket.
 *
 * Source: rtnetlink(7), Linux include/uapi/linux/can/netlink.h.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <sys/socket.h>
#include <errno.h>
#include <linux/can.h>
#include <linux/can/netlink.h>
#include <linux/if.h>
#include <linux/if_arp.h>
#include <linux/netlink.h>
#include <linux/rtnetlink.h>
#include <string.h>

static struct {
    int fd;
    size_t size; /* 0: no answer waits */
    char text[512] __attribute__((aligned(NLMSG_ALIGNTO)));
} answer;

static struct rtattr *add(int type, const void *data, size_t size)
{
    struct rtattr *attribute = (struct rtattr *)(answer.text + answer.size);
    *attribute = (struct rtattr){.rta_len = RTA_LENGTH(size), .rta_type = type};
    if (size) memcpy(RTA_DATA(attribute), data, size);
    answer.size += RTA_ALIGN(attribute->rta_len);
    return attribute;
}

/* Describe an interface: its name and MTU, and that it is an active CAN controller. */
static void describe(const struct bus *bus, int index)
{
    struct ifinfomsg *head = NLMSG_DATA((struct nlmsghdr *)answer.text);
    uint32_t mtu = bus->is_fd ? CANFD_MTU : CAN_MTU, state = CAN_STATE_ERROR_ACTIVE;
    uint32_t queue = 65536; /* frames that the rig lets wait: python_can/send_limit.py */
    *head = (struct ifinfomsg){
        .ifi_type = ARPHRD_CAN, .ifi_index = index, .ifi_flags = IFF_UP | IFF_RUNNING | IFF_NOARP};
    answer.size = NLMSG_SPACE(sizeof *head);
    add(IFLA_IFNAME, bus->name, strlen(bus->name) + 1);
    add(IFLA_MTU, &mtu, sizeof mtu);
    add(IFLA_TXQLEN, &queue, sizeof queue);
    struct rtattr *information = add(IFLA_LINKINFO, NULL, 0);
    add(IFLA_INFO_KIND, "can", 4);
    struct rtattr *data = add(IFLA_INFO_DATA, NULL, 0);
    add(IFLA_CAN_STATE, &state, sizeof state);
    data->rta_len = answer.text + answer.size - (char *)data;
    information->rta_len = answer.text + answer.size - (char *)information;
}

/* Answer a request for a bus of the rig; return false if it is for the kernel. */
bool answer_netlink(int fd, const struct msghdr *message)
{
    struct {
        struct nlmsghdr head;
        struct ifinfomsg link;
        char rest[256];
    } request;
    size_t size = 0;
    int domain = 0;
    socklen_t domain_size = sizeof domain;
    if (rig.state != JOINED) return false;
    if (REAL(getsockopt)(fd, SOL_SOCKET, SO_DOMAIN, &domain, &domain_size) < 0) return false;
    if (domain != AF_NETLINK) return false;
    for (size_t i = 0; i < message->msg_iovlen && size < sizeof request; i++) {
        const struct iovec *part = &message->msg_iov[i];
        size_t length =
            sizeof request - size < part->iov_len ? sizeof request - size : part->iov_len;
        if (length) memcpy((char *)&request + size, part->iov_base, length);
        size += length;
    }
    if (size < NLMSG_LENGTH(sizeof request.link)) return false;
    int type = request.head.nlmsg_type;
    const struct bus *bus = bus_at(request.link.ifi_index);
    if (!bus || (type != RTM_GETLINK && type != RTM_NEWLINK && type != RTM_SETLINK)) return false;
    struct nlmsghdr *head = (struct nlmsghdr *)answer.text;
    memset(&answer, 0, sizeof answer);
    answer.fd = fd;
    if (type == RTM_GETLINK) {
        describe(bus, request.link.ifi_index);
    } else { /* the rig's file alone sets a bus: acknowledged, and nothing changes */
        struct nlmsgerr *error = NLMSG_DATA(head);
        error->msg = request.head;
        answer.size = NLMSG_SPACE(sizeof *error);
    }
    head->nlmsg_len = answer.size;
    head->nlmsg_type = type == RTM_GETLINK ? RTM_NEWLINK : NLMSG_ERROR;
    head->nlmsg_seq = request.head.nlmsg_seq;
    head->nlmsg_pid = request.head.nlmsg_pid;
    return true;
}

/* Receive an answer that waits on this socket; -1: none does. */
ssize_t take_netlink(int fd, void *data, size_t size, int flags, void *address, void *address_size)
{
    const struct sockaddr_nl kernel = {.nl_family = AF_NETLINK};
    socklen_t *space = address_size;
    size_t whole = answer.size;
    if (!whole || answer.fd != fd) return -1;
    if (size) memcpy(data, answer.text, size < whole ? size : whole);
    if (address && space) {
        memcpy(address, &kernel, *space < sizeof kernel ? *space : sizeof kernel);
        *space = sizeof kernel;
    }
    if (!(flags & MSG_PEEK)) answer.size = 0;
    return size < whole && !(flags & MSG_TRUNC) ? (ssize_t)size : (ssize_t)whole;
}
