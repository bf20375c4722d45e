/* Two programs with a UNIX socket between them: `neighbours server PATH`, `neighbours client PATH`.
 *
 * The server answers each message 50 ms later. The client connects before any other wait.
 */
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

static long ms(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec % 100000 * 1000 + now.tv_nsec / 1000000;
}

static int serve(const struct sockaddr_un *address)
{
    char text[16];
    struct epoll_event event = {.events = EPOLLIN};
    usleep(1000); /* joins */
    int door = socket(AF_UNIX, SOCK_STREAM, 0), set = epoll_create1(0);
    unlink(address->sun_path);
    if (bind(door, (const struct sockaddr *)address, sizeof *address) || listen(door, 1)) return 1;
    event.data.fd = door;
    epoll_ctl(set, EPOLL_CTL_ADD, door, &event);
    while (epoll_wait(set, &event, 1, 10000) == 1) {
        int fd = event.data.fd;
        if (fd == door) {
            event.data.fd = accept(door, NULL, NULL);
            printf("accepted at %ld ms\n", ms());
            epoll_ctl(set, EPOLL_CTL_ADD, event.data.fd, &event);
            continue;
        }
        ssize_t size = read(fd, text, sizeof text);
        if (size <= 0) {
            printf("closed at %ld ms\n", ms());
            return 0;
        }
        usleep(50000);
        if (write(fd, text, size) != size) return 1;
    }
    printf("nothing until %ld ms\n", ms());
    return 1;
}

static int ask(const struct sockaddr_un *address)
{
    char text[16] = "";
    int fd = socket(AF_UNIX, SOCK_STREAM, 0);
    while (connect(fd, (const struct sockaddr *)address, sizeof *address)) usleep(3000);
    for (int i = 0; i < 2; i++) {
        if (write(fd, "abc", 3) != 3 || read(fd, text, sizeof text) != 3) return 1;
        printf("%s at %ld ms\n", text, ms());
        usleep(200000);
    }
    return 0;
}

int main(int argc, char **argv)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (argc != 3) return 2;
    snprintf(address.sun_path, sizeof address.sun_path, "%s", argv[2]);
    return strcmp(argv[1], "server") ? ask(&address) : serve(&address);
}
