/* Lines of the rig, as gateways (TCP) and serial ports.
 *
 * A connection to the address of a line, or a descriptor of its serial port, is the program's end
 * of a pair of UNIX sockets. The rig sends what the program writes, and the library writes what the
 * line delivers to the other end, so that the kernel itself tells what is readable. Each of them is
 * a port of its own on the line. motorhil/harness/virtual_time/stdlib/lines.py has the same rules.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <linux/serial.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

enum { RECORD_OPEN = 17, RECORD_CLOSE, RECORD_SEND, RECORD_OPENED = 34 };
enum { LINES_MAX = 64, PIECE = 4096, MODBUS_PORT = 502, VTIME_NS = 100000000, MEMBERS_MAX = 256 };

/* A line of MOTORHIL_LINES: name, address, bit rate, bits of a character, format, t3.5. */
struct line {
    char name[64], address[256], format[8];
    char host[64]; /* a numeric address; one of 127.77.0.0/24 for a name that no server knows */
    int port;      /* 0: a serial port */
    unsigned rate, bits;
    long silence_ns;
    int64_t silent_ns; /* when t3.5 has passed after the last characters of others */
};

struct line_end {
    struct descriptor descriptor;
    struct line_end *next;
    struct line *line;
    uint16_t number; /* of its port in the rig */
    bool has_ended, is_told;
    int64_t free_ns; /* when the last character of the program has been sent */
    struct termios settings;
    unsigned rate;    /* that has no name in termios; 0: one of those in the settings [bit/s] */
    int driver_flags; /* of TIOCSSERIAL */
    struct sockaddr_storage peer;
    socklen_t peer_size;
};

struct __attribute__((packed)) piece {
    uint8_t kind;
    uint16_t port;
    uint8_t data[PIECE];
};
enum { HEAD = offsetof(struct piece, data) };

/* Those of a terminal of Linux that no program has set. */
static const struct termios first_settings = {
    .c_iflag = ICRNL | IXON,
    .c_oflag = OPOST | ONLCR,
    .c_cflag = B9600 | CS8 | CREAD | CLOCAL,
    .c_lflag = ISIG | ICANON | ECHO | ECHOE | ECHOK | IEXTEN,
    .c_cc = {[VMIN] = 1},
};
static struct line lines[LINES_MAX];
static int line_count = NEVER; /* not yet read */
static struct line_end *ends;

static struct line_end *end_of(int fd);

static int failed(int error)
{
    errno = error;
    return -1;
}

static const char *usual(const char *host)
{
    return !strcmp(host, "localhost") || !strcmp(host, "::1") ? "127.0.0.1" : host;
}

/* Give a gateway the address that connections have. */
static void resolve(struct line *line)
{
    uint8_t address[sizeof(struct in6_addr)];
    char host[sizeof line->address];
    char *port = strrchr(strcpy(host, line->address + (*line->address == '[')), ':');
    if (!port) return;
    line->port = atoi(port + 1);
    *port = 0;
    if (port > host && port[-1] == ']') port[-1] = 0;
    if (inet_pton(AF_INET, usual(host), address) > 0 ||
        inet_pton(AF_INET6, usual(host), address) > 0)
        snprintf(line->host, sizeof line->host, "%.63s", usual(host));
    else {
        struct line *first = lines; /* of this name: its ports have one address */
        size_t size = strlen(host);
        while (first < line && (strncmp(first->address, host, size) || first->address[size] != ':'))
            first++;
        snprintf(line->host, sizeof line->host, "127.77.0.%d", (int)(first - lines) + 1);
    }
}

static void read_lines(void)
{
    if (line_count != NEVER) return;
    const char *text = getenv("MOTORHIL_LINES");
    line_count = 0;
    while (text && *text && line_count < LINES_MAX) {
        struct line *line = &lines[line_count];
        if (sscanf(text, "%63[^\t]\t%255[^\t]\t%u\t%u\t%7[^\t]\t%ld", line->name, line->address,
                   &line->rate, &line->bits, line->format, &line->silence_ns) == 6) {
            line_count++;
            if (*line->address != '/') resolve(line);
        }
        text = strchr(text, '\n');
        if (text) text++;
    }
}

static struct line *find_line(const char *host, int port)
{
    read_lines();
    for (int i = 0; i < line_count; i++)
        if (lines[i].port == port && !strcmp(port ? lines[i].host : lines[i].address, host))
            return &lines[i];
    return NULL;
}

/* Tell of hardware that no line of the rig stands for. */
static void tell_hardware(const char *call, const char *place)
{
    char known[1024] = "";
    for (int i = 0; i < line_count && strlen(known) < sizeof known - 512; i++)
        snprintf(known + strlen(known), sizeof known - strlen(known), "%s%.63s at %.255s",
                 i ? ", " : "", lines[i].name, lines[i].address);
    tell("program '%s': %s %s: hardware cannot be reached, and no line of the rig is there (its"
         " lines: %s); write address = \"%s\" in its [bus.NAME]",
         rig.name, call, place, *known ? known : "none", place);
}

/* ---- sets of epoll ------------------------------------------------------------------------ */

/* Unconnected sockets in sets of epoll, which a connection to a line would leave. */
static struct member {
    int epoll, fd; /* fd -1: free */
    struct epoll_event event;
} members[MEMBERS_MAX];
static int member_count;

static void forget_member(int epoll, int fd)
{
    for (int i = 0; i < member_count; i++)
        if (members[i].fd == fd && (epoll < 0 || members[i].epoll == epoll)) members[i].fd = -1;
}

/* Return whether a TCP socket may yet connect to a gateway. */
static bool is_unconnected(int fd)
{
    int domain = 0, type = 0, listens = 0;
    socklen_t size = sizeof domain, peer_size = sizeof(struct sockaddr_storage);
    struct sockaddr_storage peer;
    return REAL(getsockopt)(fd, SOL_SOCKET, SO_DOMAIN, &domain, &size) == 0 &&
           (domain == AF_INET || domain == AF_INET6) &&
           REAL(getsockopt)(fd, SOL_SOCKET, SO_TYPE, &type, &size) == 0 && type == SOCK_STREAM &&
           REAL(getsockopt)(fd, SOL_SOCKET, SO_ACCEPTCONN, &listens, &size) == 0 && !listens &&
           REAL(getpeername)(fd, (struct sockaddr *)&peer, &peer_size) < 0;
}

/* Note a change of a set; return whether it is of a socket that may yet connect to a gateway. */
bool note_member(int epoll, int operation, int fd, const struct epoll_event *event)
{
    int place = 0;
    forget_member(epoll, fd);
    if (operation == EPOLL_CTL_DEL || is_line(fd) || !is_unconnected(fd)) return false;
    while (place < member_count && members[place].fd >= 0) place++;
    if (place == MEMBERS_MAX) return false;
    if (place == member_count) member_count++;
    members[place] = (struct member){epoll, fd, *event};
    return true;
}

void forget_members(int fd)
{
    if (member_count) forget_member(NEVER, fd);
}

/* Add a socket that has become the end of a line to the sets that it was in. */
static void rejoin_sets(int fd)
{
    for (int i = 0; i < member_count; i++)
        if (members[i].fd == fd) {
            members[i].fd = -1;
            REAL(epoll_ctl)(members[i].epoll, EPOLL_CTL_ADD, fd, &members[i].event);
        }
}

static struct line_end *end_of(int fd)
{
    struct descriptor *descriptor = descriptor_of(fd);
    if (!descriptor || descriptor->kind != LINE) return NULL;
    if (rig.state == CHILD)
        refuse("a forked child of program '%s' uses its connection to a line; expected a child that"
               " opens none",
               rig.name);
    return (struct line_end *)descriptor;
}

static struct line_end *serial_end_of(int fd)
{
    struct line_end *end = end_of(fd);
    return end && !end->line->port ? end : NULL;
}

bool is_line(int fd)
{
    return end_of(fd) != NULL;
}

/* ---- connections ----------------------------------------------------------------------------- */

/* Open a port on the line; return the program's end of a pair of sockets, or -1. */
static int open_end(struct line *line, struct line_end **opened)
{
    struct piece record = {.kind = RECORD_OPEN};
    size_t size = strlen(line->name);
    int pair[2];
    if (rig.state == AWAITING) join_rig();
    struct line_end *end = calloc(1, sizeof *end);
    if (!end || socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, pair) < 0) {
        free(end);
        return -1;
    }
    memcpy(record.data, line->name, size);
    send_record(&record, HEAD + size);
    receive_record((uint8_t *)&record, sizeof record);
    if (record.kind != RECORD_OPENED) refuse("%s: not opened by the rig", line->name);
    end->descriptor = (struct descriptor){.kind = LINE, .inner = set_apart(pair[1])};
    end->line = line;
    end->number = record.port;
    end->settings = first_settings;
    cfsetspeed(&end->settings, B9600);
    end->next = ends;
    ends = *opened = end;
    return pair[0];
}

void close_line(struct line_end *end)
{
    struct piece record = {.kind = RECORD_CLOSE, .port = end->number};
    struct line_end **place = &ends;
    while (*place != end) place = &(*place)->next;
    *place = end->next;
    if (rig.state == JOINED) send_record(&record, HEAD);
    free(end);
}

static int port_of(const struct sockaddr *address, socklen_t size, char *host, size_t space)
{
    const struct sockaddr_in *v4 = (const void *)address;
    const struct sockaddr_in6 *v6 = (const void *)address;
    const char *text = NULL;
    if (address->sa_family == AF_INET && size >= sizeof *v4)
        text = inet_ntop(AF_INET, &v4->sin_addr, host, space);
    else if (address->sa_family == AF_INET6 && size >= sizeof *v6)
        text = inet_ntop(AF_INET6, &v6->sin6_addr, host, space);
    if (!text) return 0;
    if (text != usual(text)) strcpy(host, usual(text));
    return ntohs(address->sa_family == AF_INET ? v4->sin_port : v6->sin6_port);
}

/* Give the socket of a line the timeouts that the program has set before it connects. */
static void keep_timeouts(int fd, int own)
{
    static const int options[] = {SO_RCVTIMEO, SO_SNDTIMEO};
    for (size_t i = 0; i < sizeof options / sizeof *options; i++) {
        struct timeval timeout;
        socklen_t size = sizeof timeout;
        if (!REAL(getsockopt)(fd, SOL_SOCKET, options[i], &timeout, &size))
            REAL(setsockopt)(own, SOL_SOCKET, options[i], &timeout, size);
    }
}

/* Connect a TCP socket to the line at this address. Return false where there is none. */
bool connect_line(int fd, const struct sockaddr *address, socklen_t size, int *result)
{
    char host[INET6_ADDRSTRLEN], place[INET6_ADDRSTRLEN + 8];
    int type = 0;
    socklen_t type_size = sizeof type;
    struct line_end *end;
    if (!in_rig() || !address || size < sizeof address->sa_family) return false;
    int port = port_of(address, size, host, sizeof host);
    if (!port || REAL(getsockopt)(fd, SOL_SOCKET, SO_TYPE, &type, &type_size) < 0 ||
        type != SOCK_STREAM)
        return false;
    struct line *line = find_line(host, port);
    if (!line && port != MODBUS_PORT) {
        for (int i = 0; i < member_count; i++)
            if (members[i].fd == fd) look_at(fd);
        return false;
    }
    *result = -1;
    if (!line) {
        snprintf(place, sizeof place, "%s:%d", host, port);
        tell_hardware("connect to", place);
        errno = EHOSTUNREACH;
        return true;
    }
    int modes = REAL(fcntl)(fd, F_GETFL), is_kept = REAL(fcntl)(fd, F_GETFD) & FD_CLOEXEC;
    int own = open_end(line, &end);
    if (own < 0) return true;
    keep_timeouts(fd, own);
    int copied = REAL(dup3)(own, fd, is_kept ? O_CLOEXEC : 0);
    REAL(close)(own);
    if (copied < 0) return true;
    REAL(fcntl)(fd, F_SETFL, modes & O_NONBLOCK);
    rejoin_sets(fd);
    keep(fd, &end->descriptor);
    end->peer_size = size < sizeof end->peer ? size : sizeof end->peer;
    memcpy(&end->peer, address, end->peer_size);
    *result = 0;
    return true;
}

EXPORT int getpeername(int fd, struct sockaddr *restrict address, socklen_t *restrict size)
{
    struct line_end *end = end_of(fd);
    if (!end) return REAL(getpeername)(fd, address, size);
    memcpy(address, &end->peer, *size < end->peer_size ? *size : end->peer_size);
    *size = end->peer_size;
    return 0;
}

EXPORT int shutdown(int fd, int how)
{
    struct line_end *end = end_of(fd);
    if (end && how != SHUT_RD) end->has_ended = true; /* for writing */
    return REAL(shutdown)(fd, how);
}

/* Options of TCP and IP have no effect on a line. */
bool is_option_of_line(int fd, int level)
{
    return (level == IPPROTO_TCP || level == IPPROTO_IP || level == IPPROTO_IPV6) && is_line(fd);
}

EXPORT int getaddrinfo(const char *restrict name, const char *restrict service,
                       const struct addrinfo *restrict hints, struct addrinfo **restrict found)
{
    size_t size = name ? strlen(name) : 0;
    if (size && in_rig()) {
        read_lines();
        for (int i = 0; i < line_count; i++)
            if (lines[i].port && !strncmp(lines[i].address, name, size) &&
                lines[i].address[size] == ':')
                name = lines[i].host;
    }
    return REAL(getaddrinfo)(name, service, hints, found);
}

/* ---- characters ------------------------------------------------------------------------------ */

static void tell_end(struct line_end *end, const char *text)
{
    if (!end->is_told) tell("program '%s': %s: %s", rig.name, end->line->address, text);
    end->is_told = true;
}

/* Take what the line delivers. Return false if the port is not one of a line. */
bool hear_line(unsigned number, int64_t time_ns, bool is_transmitted, const void *data, size_t size)
{
    struct line_end *end = ends;
    while (end && end->number != number) end = end->next;
    if (!end || is_transmitted) return end != NULL;
    if (!size) {
        end->has_ended = true;
        REAL(shutdown)(end->descriptor.inner, SHUT_WR);
        return true;
    }
    end->line->silent_ns = time_ns + end->line->silence_ns;
    if (REAL(send)(end->descriptor.inner, data, size, MSG_DONTWAIT | MSG_NOSIGNAL) < 0 &&
        errno != EPIPE) /* the program reads no more */
        tell_end(end, "too many characters are not read; the others are lost");
    return true;
}

ssize_t send_line(int fd, const void *data, size_t size, int flags)
{
    struct line_end *end = end_of(fd);
    struct line *line = end->line;
    if (thread_here && thread_here->waits)
        refuse("program '%s' writes to a line in a signal handler; expected a flag that its main"
               " loop looks at",
               rig.name);
    if (end->has_ended) {
        if (!(flags & MSG_NOSIGNAL)) raise(SIGPIPE);
        return failed(EPIPE);
    }
    if (line->silent_ns > rig.now_ns) wait_turn(never, NULL, line->silent_ns, 0);
    for (size_t done = 0; done < size;) {
        struct piece record = {.kind = RECORD_SEND, .port = end->number};
        size_t length = size - done < PIECE ? size - done : PIECE;
        memcpy(record.data, (const uint8_t *)data + done, length);
        send_record(&record, HEAD + length);
        done += length;
    }
    if (line->rate) {
        int64_t from_ns = end->free_ns > rig.now_ns ? end->free_ns : rig.now_ns;
        end->free_ns = from_ns + (int64_t)size * line->bits * NS_PER_S / line->rate;
    }
    return size;
}

/* Send the parts of a message as one. */
ssize_t send_parts(int fd, const struct iovec *parts, int count, int flags)
{
    size_t size = 0;
    for (int i = 0; i < count; i++) size += parts[i].iov_len;
    uint8_t *whole = malloc(size + 1), *place = whole;
    if (!whole) return failed(ENOMEM);
    for (int i = 0; i < count; i++) place = mempcpy(place, parts[i].iov_base, parts[i].iov_len);
    ssize_t sent = send_line(fd, whole, size, flags);
    free(whole);
    return sent;
}

/* Wait as a terminal with VMIN and VTIME does. Return false for a descriptor that is none, and for
 * one that waits as other descriptors do; set *result where the read ends without characters. */
bool await_characters(int fd, ssize_t *result)
{
    struct line_end *end = serial_end_of(fd);
    if (!end || end->settings.c_cc[VMIN] || !is_blocking(fd, 0)) return false;
    int64_t limit_ns = end->settings.c_cc[VTIME] * (int64_t)VTIME_NS;
    int ready = 0;
    if (limit_ns) ready = wait_for_input(fd, deadline_after(limit_ns)) == HOLDS;
    if (!ready) ready = REAL(ioctl)(fd, FIONREAD, &ready) < 0 ? 0 : ready;
    if (!ready && !limit_ns) look();
    *result = 0;
    return !ready;
}

/* ---- serial ports ---------------------------------------------------------------------------- */

static bool is_hardware(const char *path)
{
    return (!strncmp(path, "/dev/tty", 8) && path[8] >= 'A' && path[8] <= 'Z') ||
           !strncmp(path, "/dev/serial/", 12) || !strncmp(path, "/dev/rfcomm", 11);
}

/* Return whether a path is the serial port of a line, or of hardware. */
bool is_serial(const char *path)
{
    return path && *path == '/' && in_rig() && (find_line(path, 0) || is_hardware(path));
}

/* Open the serial port of a line. Return false for all other files. */
bool open_serial(const char *path, int flags, int *fd)
{
    struct line_end *end;
    if (!path || *path != '/' || !in_rig()) return false;
    struct line *line = find_line(path, 0);
    *fd = -1;
    if (!line) {
        if (!is_hardware(path)) return false;
        tell_hardware("open", path);
        errno = ENXIO;
        return true;
    }
    *fd = open_end(line, &end);
    if (*fd < 0) return true;
    if (flags & O_NONBLOCK) REAL(fcntl)(*fd, F_SETFL, O_NONBLOCK);
    if (!(flags & O_CLOEXEC)) REAL(fcntl)(*fd, F_SETFD, 0);
    keep(*fd, &end->descriptor);
    return true;
}

EXPORT int open(const char *path, int flags, ...)
{
    int fd;
    va_list values;
    va_start(values, flags);
    mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(values, mode_t) : 0;
    va_end(values);
    return open_serial(path, flags, &fd) ? fd : REAL(open)(path, flags, mode);
}

EXPORT int open64(const char *path, int flags, ...) __attribute__((alias("open")));

EXPORT int __open_2(const char *path, int flags)
{
    return open(path, flags);
}

EXPORT int __open64_2(const char *path, int flags)
{
    return open(path, flags);
}

EXPORT int openat(int folder, const char *path, int flags, ...)
{
    int fd;
    va_list values;
    va_start(values, flags);
    mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(values, mode_t) : 0;
    va_end(values);
    return open_serial(path, flags, &fd) ? fd : REAL(openat)(folder, path, flags, mode);
}

EXPORT int openat64(int folder, const char *path, int flags, ...) __attribute__((alias("openat")));

EXPORT int __openat_2(int folder, const char *path, int flags)
{
    return openat(folder, path, flags);
}

EXPORT int __openat64_2(int folder, const char *path, int flags)
{
    return openat(folder, path, flags);
}

EXPORT int isatty(int fd)
{
    return serial_end_of(fd) ? 1 : is_line(fd) ? failed(ENOTTY) + 1 : REAL(isatty)(fd);
}

EXPORT int tcgetattr(int fd, struct termios *settings)
{
    struct line_end *end = serial_end_of(fd);
    if (!end) return REAL(tcgetattr)(fd, settings);
    *settings = end->settings;
    return 0;
}

/* Return the bit rate of a speed; 0 if it is not known. */
static unsigned rate_of(speed_t speed)
{
    static const unsigned rates[] = {300,     600,     1200,    1800,    2400,    4800,    9600,
                                     19200,   38400,   57600,   115200,  230400,  460800,  500000,
                                     576000,  921600,  1000000, 1152000, 1500000, 2000000, 2500000,
                                     3000000, 3500000, 4000000};
    static const speed_t speeds[] = {B300,     B600,     B1200,    B1800,    B2400,    B4800,
                                     B9600,    B19200,   B38400,   B57600,   B115200,  B230400,
                                     B460800,  B500000,  B576000,  B921600,  B1000000, B1152000,
                                     B1500000, B2000000, B2500000, B3000000, B3500000, B4000000};
    for (size_t i = 0; i < sizeof speeds / sizeof *speeds; i++)
        if (speeds[i] == speed) return rates[i];
    return 0;
}

/* Tell of a bit rate or characters that differ from those of the line. */
static void compare(struct line_end *end, unsigned rate)
{
    tcflag_t flags = end->settings.c_cflag;
    const struct line *line = end->line;
    char format[8], text[256];
    int bits = 5 + ((flags & CSIZE) == CS6) + 2 * ((flags & CSIZE) == CS7) +
               3 * ((flags & CSIZE) == CS8);
    char parity = !(flags & PARENB) ? 'N' : flags & PARODD ? 'O' : 'E';
    snprintf(format, sizeof format, "%d%c%d", bits, parity, flags & CSTOPB ? 2 : 1);
    if (!rate || (rate == line->rate && !strcmp(format, line->format))) return;
    snprintf(text, sizeof text, "opened with %u bit/s, %s; line %s has %u bit/s, %s, which is used",
             rate, format, line->name, line->rate, line->format);
    tell_end(end, text);
}

static void drain(const struct line_end *end)
{
    if (end->free_ns > rig.now_ns) wait_turn(never, NULL, end->free_ns, 0);
}

static void flush_input(int fd)
{
    char dropped[PIECE];
    while (REAL(recv)(fd, dropped, sizeof dropped, MSG_DONTWAIT) > 0) continue;
}

EXPORT int tcsetattr(int fd, int when, const struct termios *settings)
{
    struct line_end *end = serial_end_of(fd);
    if (!end) return REAL(tcsetattr)(fd, when, settings);
    if (when != TCSANOW) drain(end);
    if (when == TCSAFLUSH) flush_input(fd);
    end->settings = *settings;
    if (settings->c_lflag != first_settings.c_lflag) /* else it restores them */
        compare(end, rate_of(cfgetospeed(settings)));
    return 0;
}

EXPORT int tcdrain(int fd)
{
    struct line_end *end = serial_end_of(fd);
    if (!end) return REAL(tcdrain)(fd);
    drain(end);
    return 0;
}

EXPORT int tcflush(int fd, int queue)
{
    if (!serial_end_of(fd)) return REAL(tcflush)(fd, queue);
    if (queue != TCOFLUSH) flush_input(fd);
    return 0;
}

EXPORT int tcsendbreak(int fd, int duration)
{
    return serial_end_of(fd) ? 0 : REAL(tcsendbreak)(fd, duration);
}

EXPORT int tcflow(int fd, int action)
{
    return serial_end_of(fd) ? 0 : REAL(tcflow)(fd, action);
}

/* Settings as the kernel has them. <asm/termbits.h> cannot be included beside <termios.h>. */
struct kernel_settings {
    tcflag_t iflag, oflag, cflag, lflag;
    cc_t line, cc[19];
    speed_t ispeed, ospeed; /* of the requests with a 2 [bit/s] */
};
enum { GETS2 = 0x802C542A, SETS2 = 0x402C542B, SETSW2, SETSF2, ANY_RATE = 010000 };

static void get_settings(const struct line_end *end, struct kernel_settings *own, size_t size)
{
    const struct termios *settings = &end->settings;
    struct kernel_settings found = {
        .iflag = settings->c_iflag,
        .oflag = settings->c_oflag,
        .cflag = settings->c_cflag,
        .lflag = settings->c_lflag,
        .line = settings->c_line,
    };
    memcpy(found.cc, settings->c_cc, sizeof found.cc);
    found.ispeed = found.ospeed = end->rate ? end->rate : rate_of(cfgetospeed(settings));
    memcpy(own, &found, size);
}

static int set_settings(int fd, struct line_end *end, unsigned long when,
                        const struct kernel_settings *own, bool has_rate)
{
    struct termios settings = end->settings;
    settings.c_iflag = own->iflag;
    settings.c_oflag = own->oflag;
    settings.c_cflag = own->cflag;
    settings.c_lflag = own->lflag;
    settings.c_line = own->line;
    memcpy(settings.c_cc, own->cc, sizeof own->cc);
    settings.c_ospeed = settings.c_ispeed = own->cflag & (CBAUD | CBAUDEX);
    int result = tcsetattr(fd, when, &settings);
    end->rate = has_rate && (own->cflag & CBAUD) == ANY_RATE ? own->ospeed : 0;
    if (end->rate) compare(end, end->rate);
    return result;
}

/* Requests to a serial port: settings, signals, and counts of characters. */
int line_ioctl(int fd, unsigned long request, void *argument, bool *is_known)
{
    struct line_end *end = serial_end_of(fd);
    if (!end || request == FIONREAD) return 0;
    *is_known = true;
    switch (request) {
    case TCGETS: get_settings(end, argument, offsetof(struct kernel_settings, ispeed)); return 0;
    case GETS2: get_settings(end, argument, sizeof(struct kernel_settings)); return 0;
    case TCSETS:
    case TCSETSW:
    case TCSETSF: return set_settings(fd, end, request - TCSETS, argument, false);
    case SETS2:
    case SETSW2:
    case SETSF2: return set_settings(fd, end, request - SETS2, argument, true);
    case TCSBRK: return argument ? tcdrain(fd) : 0;
    case TCFLSH: return tcflush(fd, (int)(intptr_t)argument);
    case TIOCGSERIAL:
        *(struct serial_struct *)argument = (struct serial_struct){.flags = end->driver_flags};
        return 0;
    case TIOCSSERIAL: {
        int flags = ((struct serial_struct *)argument)->flags;
        if ((flags & ASYNC_SPD_MASK) == ASYNC_SPD_CUST) return failed(EINVAL); /* a divisor */
        end->driver_flags = flags;
        return 0;
    }
    case TIOCMGET: *(int *)argument = TIOCM_DTR | TIOCM_RTS | TIOCM_CTS | TIOCM_DSR; return 0;
    case TIOCOUTQ: {
        int64_t left_ns = end->free_ns > rig.now_ns ? end->free_ns - rig.now_ns : 0;
        int64_t character_ps = end->line->bits * (int64_t)NS_PER_S * 1000 / end->line->rate;
        *(int *)argument = (left_ns * 1000 + character_ps - 1) / character_ps;
        return 0;
    }
    case TIOCMBIS:
    case TIOCMBIC:
    case TIOCMSET:
    case TIOCSBRK:
    case TIOCCBRK:
    case TIOCEXCL:
    case TIOCNXCL:
    case TIOCSRS485: return 0;
    default: return failed(ENOTTY);
    }
}
