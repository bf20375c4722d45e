/* A Modbus client on plain descriptors: `line_client ACT tcp HOST PORT` or `... rtu PORT 0`.
 *
 * It asks unit 1 for register 1003h after 1 s, waits for the answer as ACT says, and prints it with
 * the time in us since the question.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static const unsigned char tcp[] = {0, 7, 0, 0, 0, 6, 1, 3, 0x10, 3, 0, 1},
                           rtu[] = {1, 3, 0x10, 3, 0, 1, 0x70, 0xCA};

static int early;

static long now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

static void limit_reading(int fd)
{
    struct timeval limit = {0, 200000};
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
}

static void *rest(void *unused)
{
    sleep(1);
    return unused;
}

static int connected(const char *host, const char *port, const char *act)
{
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found;
    int one = 1;
    if (getaddrinfo(host, port, &hints, &found)) return -1;
    int fd = socket(found->ai_family, found->ai_socktype | SOCK_CLOEXEC, found->ai_protocol);
    if (!strcmp(act, "epoll")) fcntl(fd, F_SETFL, O_NONBLOCK);
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    if (!strcmp(act, "limited")) limit_reading(fd);
    if (!strcmp(act, "early")) { /* as event loops that know a socket before it is connected */
        struct epoll_event event = {.events = EPOLLIN | EPOLLET};
        fcntl(fd, F_SETFL, O_NONBLOCK);
        epoll_ctl(early = epoll_create1(EPOLL_CLOEXEC), EPOLL_CTL_ADD, fd, &event);
    }
    if (connect(fd, found->ai_addr, found->ai_addrlen)) {
        printf("connect: %s\n", strerror(errno));
        exit(4);
    }
    freeaddrinfo(found);
    struct sockaddr_in peer;
    socklen_t size = sizeof peer;
    if (setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one)) return -1;
    if (getpeername(fd, (struct sockaddr *)&peer, &size) || ntohs(peer.sin_port) != atoi(port))
        return -1;
    return fd;
}

static int opened(const char *path, const char *act)
{
    struct termios settings;
    int fd = open(path, O_RDWR | O_NOCTTY | O_CLOEXEC | (strcmp(act, "epoll") ? 0 : O_NONBLOCK));
    if (fd < 0) {
        printf("open: %s\n", strerror(errno));
        exit(4);
    }
    if (!isatty(fd) || tcgetattr(fd, &settings)) return -1;
    cfmakeraw(&settings);
    cfsetspeed(&settings, strcmp(act, "slow") ? B115200 : B9600);
    if (!strcmp(act, "vtime")) settings.c_cc[VMIN] = 0, settings.c_cc[VTIME] = 2;
    return tcsetattr(fd, TCSAFLUSH, &settings) ? -1 : fd;
}

/* Wait until there is something to read. */
static int ready(int fd, const char *act)
{
    if (!strcmp(act, "poll")) {
        struct pollfd input = {.fd = fd, .events = POLLIN};
        return poll(&input, 1, 500);
    }
    if (!strcmp(act, "select")) {
        fd_set set;
        struct timeval limit = {0, 500000};
        FD_ZERO(&set);
        FD_SET(fd, &set);
        return select(fd + 1, &set, NULL, NULL, &limit);
    }
    if (!strcmp(act, "early")) {
        struct epoll_event event;
        return epoll_wait(early, &event, 1, 500);
    }
    if (!strcmp(act, "epoll")) {
        struct epoll_event event = {.events = EPOLLIN};
        int loop = epoll_create1(EPOLL_CLOEXEC);
        epoll_ctl(loop, EPOLL_CTL_ADD, fd, &event);
        int count = epoll_wait(loop, &event, 1, 500);
        close(loop);
        return count;
    }
    return 1;
}

/* Connect a socket in a set of epoll to another socket of this program. */
static int connect_elsewhere(void)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(0x7F000001)};
    socklen_t size = sizeof address;
    struct epoll_event event = {.events = EPOLLIN};
    int server = socket(AF_INET, SOCK_STREAM, 0), client = socket(AF_INET, SOCK_STREAM, 0);
    int loop = epoll_create1(EPOLL_CLOEXEC);
    if (bind(server, (struct sockaddr *)&address, size) || listen(server, 1)) return 1;
    if (getsockname(server, (struct sockaddr *)&address, &size)) return 1;
    if (epoll_ctl(loop, EPOLL_CTL_ADD, client, &event)) return 1;
    printf("in a set\n");
    return connect(client, (struct sockaddr *)&address, size) ? 1 : 0;
}

/* Write the jog speed, close at once, and read it by another connection whose writing has ended. */
static int write_and_close(char **where)
{
    static const unsigned char set[] = {0, 7, 0, 0, 0, 6, 1, 6, 1, 0xE1, 0, 0x7B},
                               get[] = {0, 8, 0, 0, 0, 6, 1, 3, 1, 0xE1, 0, 1};
    unsigned char answer[64];
    int fd = connected(where[0], where[1], "");
    if (write(fd, set, sizeof set) != sizeof set || close(fd)) return 1;
    usleep(10000);
    fd = connected(where[0], where[1], "");
    if (write(fd, get, sizeof get) != sizeof get || shutdown(fd, SHUT_WR)) return 1;
    ssize_t size = read(fd, answer, sizeof answer);
    printf("%zd bytes, speed %d", size, answer[9] << 8 | answer[10]);
    signal(SIGPIPE, SIG_IGN);
    size = write(fd, get, sizeof get);
    printf(", write: %zd, %s\n", size, strerror(errno));
    return 0;
}

int main(int argc, char **argv)
{
    unsigned char answer[64];
    if (argc != 5) return 2;
    const char *act = argv[1];
    int is_tcp = !strcmp(argv[2], "tcp"), size = 0, wanted = is_tcp ? 11 : 7;
    sleep(1);
    if (!strcmp(act, "elsewhere")) return connect_elsewhere();
    if (!strcmp(act, "close")) return write_and_close(argv + 3);
    int fd = is_tcp ? connected(argv[3], argv[4], act) : opened(argv[3], act);
    for (int i = 0; i < 300 && !strcmp(act, "reopen"); i++) { /* more than a program may have */
        int copy = dup(fd);
        close(fd);
        close(copy);
        fd = is_tcp ? connected(argv[3], argv[4], act) : opened(argv[3], act);
    }
    if (fd < 0) return 1;
    struct iovec parts[2] = {{(void *)(is_tcp ? tcp : rtu), 4},
                             {(void *)((is_tcp ? tcp : rtu) + 4), is_tcp ? 8 : 4}};
    long from_us = now_us();
    if (!strcmp(act, "foreign")) {
        signal(SIGPIPE, SIG_IGN);
        if (write(fd, "GET / HTTP/1.1\r\n\r\n", 18) != 18) return 1;
        printf("read: %zd", read(fd, answer, sizeof answer));
        printf(", write: %zd", write(fd, tcp, sizeof tcp));
        printf(", %s\n", strerror(errno));
        return 0;
    }
    if (!strcmp(act, "thread")) { /* many characters in the turn in which a thread begins */
        static char zeros[5000];
        pthread_t thread;
        if (pthread_create(&thread, NULL, rest, NULL)) return 1;
        printf("written: %zd\n", write(fd, zeros, sizeof zeros));
        return pthread_join(thread, NULL);
    }
    if (!strcmp(act, "flood")) { /* until the rig refuses to queue more */
        static char zeros[65536];
        for (int i = 0; i < 10000; i++)
            if (write(fd, zeros, sizeof zeros) < 0) return 1;
        return 0;
    }
    if (writev(fd, parts, 2) != (is_tcp ? 12 : 8)) return 1;
    if (!strcmp(act, "kill")) raise(SIGKILL);
    if (!strcmp(act, "drain")) {
        int unsent;
        if (ioctl(fd, TIOCOUTQ, &unsent) || tcdrain(fd)) return 1;
        printf("%d characters sent after %ld us\n", unsent, now_us() - from_us);
        from_us = now_us();
    }
    while (size < wanted) {
        if (ready(fd, act) <= 0) return 1;
        ssize_t count = read(fd, answer + size, sizeof answer - size);
        if (count <= 0) return 1;
        size += count;
    }
    for (int i = 0; i < size; i++) printf("%02X ", answer[i]);
    printf("after %ld us\n", now_us() - from_us);
    if (!strcmp(act, "vtime")) {
        from_us = now_us();
        printf("read: %zd", read(fd, answer, 1));
        printf(" after %ld us\n", now_us() - from_us);
    }
    if (!strcmp(act, "timeout")) limit_reading(fd);
    if (!strcmp(act, "timeout") || !strcmp(act, "limited")) {
        from_us = now_us();
        printf("recv: %zd", recv(fd, answer, 1, 0));
        printf(", %d after %ld us\n", errno == EAGAIN, now_us() - from_us);
    }
    close(fd);
    return 0;
}
