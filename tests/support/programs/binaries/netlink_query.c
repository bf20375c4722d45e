/* Asks for the CAN interface can0 by NETLINK_ROUTE, and sets it; prints the answers. */
#include <net/if.h> /* before those of Linux, which repeat it */

#include <linux/if_arp.h>
#include <linux/rtnetlink.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

struct request {
    struct nlmsghdr head;
    struct ifinfomsg link;
};

static struct nlmsghdr *ask(int fd, int type, char *text, size_t size)
{
    struct request request = {
        .head = {.nlmsg_len = sizeof request,
                 .nlmsg_type = type,
                 .nlmsg_flags = NLM_F_REQUEST,
                 .nlmsg_seq = 7},
        .link = {.ifi_index = if_nametoindex("can0")},
    };
    struct iovec part = {&request, sizeof request};
    struct sockaddr_nl kernel = {.nl_family = AF_NETLINK};
    struct msghdr message = {
        .msg_name = &kernel, .msg_namelen = sizeof kernel, .msg_iov = &part, .msg_iovlen = 1};
    if (sendmsg(fd, &message, 0) != sizeof request) return NULL;
    ssize_t whole = recv(fd, NULL, 0, MSG_PEEK | MSG_TRUNC);
    struct nlmsghdr *head = (struct nlmsghdr *)text;
    if (whole < 0 || (size_t)whole > size || recv(fd, text, size, 0) != whole) return NULL;
    return NLMSG_OK(head, (unsigned)whole) && head->nlmsg_seq == 7 ? head : NULL;
}

int main(void)
{
    char text[1024] __attribute__((aligned(4)));
    int fd = socket(AF_NETLINK, SOCK_RAW, NETLINK_ROUTE);
    sleep(1);
    struct nlmsghdr *head = ask(fd, RTM_GETLINK, text, sizeof text);
    if (!head || head->nlmsg_type != RTM_NEWLINK) return 1;
    struct ifinfomsg *link = NLMSG_DATA(head);
    int left = (int)IFLA_PAYLOAD(head);
    printf("type %s\n", link->ifi_type == ARPHRD_CAN ? "CAN" : "other");
    for (struct rtattr *one = IFLA_RTA(link); RTA_OK(one, left); one = RTA_NEXT(one, left)) {
        if (one->rta_type == IFLA_IFNAME) printf("name %s\n", (char *)RTA_DATA(one));
        if (one->rta_type == IFLA_MTU) printf("MTU %u\n", *(unsigned *)RTA_DATA(one));
        if (one->rta_type == IFLA_LINKINFO)
            printf("kind %s\n", (char *)RTA_DATA(one) + RTA_LENGTH(0));
    }
    head = ask(fd, RTM_NEWLINK, text, sizeof text);
    if (!head || head->nlmsg_type != NLMSG_ERROR) return 2;
    printf("error %d\n", ((struct nlmsgerr *)NLMSG_DATA(head))->error);
    return 0;
}
