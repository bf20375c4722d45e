/* A Modbus client on a serial port that is opened in several ways: `line_streams WAY PATH`.
 *
 * It asks unit 1 for register 1003h after 1 s, and prints the answer.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/serial.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

/* Linux, asm-generic/termbits.h, which cannot be included beside <termios.h>. */
struct termios2 {
    tcflag_t c_iflag, c_oflag, c_cflag, c_lflag;
    cc_t c_line, c_cc[19];
    speed_t c_ispeed, c_ospeed;
};
#define GETS2 _IOR('T', 0x2A, struct termios2)
#define SETS2 _IOW('T', 0x2B, struct termios2)
#define ANY_RATE 010000

static const unsigned char request[] = {1, 3, 0x10, 3, 0, 1, 0x70, 0xCA};

static int checked(int fd, const char *what)
{
    if (fd >= 0) return fd;
    printf("%s: %s\n", what, strerror(errno));
    exit(4);
}

static void make_raw(int fd)
{
    struct termios settings;
    if (tcgetattr(fd, &settings)) perror("tcgetattr");
    cfmakeraw(&settings);
    cfsetspeed(&settings, B115200);
    if (tcsetattr(fd, TCSANOW, &settings)) perror("tcsetattr");
}

static void set_rate(int fd)
{
    struct termios2 settings;
    struct serial_struct driver;
    if (ioctl(fd, GETS2, &settings)) perror("TCGETS2");
    settings.c_cflag = (settings.c_cflag & ~CBAUD) | ANY_RATE;
    settings.c_lflag = 0;
    settings.c_ispeed = settings.c_ospeed = 250000;
    if (ioctl(fd, SETS2, &settings) || ioctl(fd, GETS2, &settings)) perror("TCSETS2");
    if (ioctl(fd, TIOCGSERIAL, &driver)) perror("TIOCGSERIAL");
    driver.flags |= ASYNC_LOW_LATENCY;
    if (ioctl(fd, TIOCSSERIAL, &driver) || ioctl(fd, TIOCGSERIAL, &driver)) perror("TIOCSSERIAL");
    printf("%u bit/s, low latency %d\n", settings.c_ospeed, driver.flags == ASYNC_LOW_LATENCY);
}

static void ask(int fd)
{
    if (write(fd, request, sizeof request) != sizeof request) perror("write");
}

static void print_answer(const unsigned char *answer)
{
    for (int i = 0; i < 7; i++) printf("%02X ", answer[i]);
    printf("\n");
}

static void use_stream(FILE *file)
{
    unsigned char answer[7];
    checked(file ? 0 : -1, "fopen");
    make_raw(fileno(file));
    printf("line buffered: %d\n", fwrite("", 0, 0, file) == 0 && isatty(fileno(file)));
    if (fwrite(request, sizeof request, 1, file) != 1 || fflush(file)) perror("fwrite");
    if (fread(answer, sizeof answer, 1, file) != 1) perror("fread");
    print_answer(answer);
    int fd = fileno(file);
    if (fclose(file)) perror("fclose");
    printf("closed: %d\n", fcntl(fd, F_GETFD) < 0);
}

int main(int words, char **argument)
{
    const char *way = words > 1 ? argument[1] : "", *path = argument[2];
    unsigned char answer[64];
    int fd = -1, size = 0;
    sleep(1);
    if (!strcmp(way, "fopen")) {
        use_stream(fopen(path, "r+"));
        return 0;
    }
    if (!strcmp(way, "fdopen")) {
        use_stream(fdopen(checked(open(path, O_RDWR), "open"), "r+"));
        return 0;
    }
    if (!strcmp(way, "openat")) {
        fd = checked(openat(AT_FDCWD, path, O_RDWR), "openat");
        make_raw(fd);
        ask(fd);
    } else if (!strcmp(way, "dprintf")) {
        const unsigned char *r = request;
        make_raw(fd = checked(open(path, O_RDWR), "open"));
        dprintf(fd, "%c%c%c%c%c%c%c%c", r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7]);
    } else {
        set_rate(fd = checked(open(path, O_RDWR), "open"));
        ask(fd);
    }
    while (size < 7) {
        ssize_t count = read(fd, answer + size, sizeof answer - size);
        if (count <= 0) return 1;
        size += count;
    }
    print_answer(answer);
    return 0;
}
