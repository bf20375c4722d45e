/* Waits for file descriptors.
 *
 * Descriptors stay real: a wait ends when the kernel says that one is ready, which is asked after
 * each event of the rig and each turn of a thread. A CAN socket is one end of a pair of sockets, a
 * timer is an eventfd, and the library writes to both when the rig calls it.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

/* Functions that older C libraries do not declare, or only for fortified programs. */
int epoll_pwait2(int, struct epoll_event *, int, const struct timespec *, const sigset_t *);
int close_range(unsigned, unsigned, int);
void closefrom(int);

enum { SET_APART_FD = 512 };

static struct descriptor own = {.kind = OWN, .inner = -1};
static struct descriptor *descriptors[DESCRIPTORS_MAX];
static bool is_told[DESCRIPTORS_MAX]; /* examined, and named if the other end has another time */
static bool has_neighbours; /* another program of the rig may end a wait for a descriptor */

/* ---- the table ------------------------------------------------------------------------------- */

struct descriptor *descriptor_of(int fd)
{
    return fd >= 0 && fd < DESCRIPTORS_MAX ? descriptors[fd] : NULL;
}

void keep(int fd, struct descriptor *descriptor)
{
    if (fd < 0) return;
    if (fd >= DESCRIPTORS_MAX)
        refuse("program '%s': descriptor %d: too large for a timer or a CAN socket; expected less"
               " than %d",
               rig.name, fd, DESCRIPTORS_MAX);
    descriptors[fd] = descriptor;
    is_told[fd] = false;
    if (descriptor) descriptor->references++;
}

/* Move a descriptor of the library to a number that programs do not expect to be theirs. */
int set_apart(int fd)
{
    int moved = REAL(fcntl)(fd, F_DUPFD_CLOEXEC, SET_APART_FD);
    if (moved >= 0) {
        REAL(close)(fd);
        fd = moved;
    }
    keep(fd, &own);
    return fd;
}

static void release(int fd)
{
    struct descriptor *descriptor = descriptor_of(fd);
    if (fd >= 0 && fd < DESCRIPTORS_MAX) is_told[fd] = false;
    forget_members(fd);
    if (!descriptor || getpid() != rig.pid) return; /* a child by vfork shares the table */
    descriptors[fd] = NULL;
    if (--descriptor->references) return;
    if (descriptor->inner >= 0) {
        descriptors[descriptor->inner] = NULL;
        REAL(close)(descriptor->inner);
    }
    if (descriptor->kind == CAN) close_can((struct can_socket *)descriptor);
    if (descriptor->kind == LINE) close_line((struct line_end *)descriptor);
    if (descriptor->kind == TIMER) close_timer((struct timer *)descriptor);
}

static bool is_own(int fd)
{
    struct descriptor *descriptor = descriptor_of(fd);
    if (!descriptor || descriptor->kind != OWN || rig.state != JOINED) return false;
    errno = EBADF;
    return true;
}

EXPORT int close(int fd)
{
    if (is_own(fd)) return -1; /* of a program that closes all that it did not open */
    release(fd);
    return REAL(close)(fd);
}

EXPORT int close_range(unsigned first, unsigned last, int flags)
{
    if (rig.state != JOINED || flags) return REAL(close_range)(first, last, flags);
    for (unsigned fd = first; fd <= last && fd < DESCRIPTORS_MAX; fd++) close(fd);
    if (last < DESCRIPTORS_MAX || !REAL(close_range)) return 0;
    return REAL(close_range)(DESCRIPTORS_MAX, last, 0);
}

EXPORT void closefrom(int first)
{
    close_range(first < 0 ? 0 : first, ~0u, 0);
}

static int duplicate(int fd, int copy)
{
    if (copy >= 0 && copy != fd && copy < DESCRIPTORS_MAX) keep(copy, descriptor_of(fd));
    return copy;
}

EXPORT int dup(int fd)
{
    return duplicate(fd, REAL(dup)(fd));
}

EXPORT int dup3(int fd, int copy, int flags)
{
    if (is_own(copy)) return -1;
    if (fd != copy && REAL(fcntl)(fd, F_GETFD) >= 0) release(copy);
    return duplicate(fd, REAL(dup3)(fd, copy, flags));
}

EXPORT int dup2(int fd, int copy)
{
    if (fd == copy) return REAL(dup2)(fd, copy);
    return dup3(fd, copy, 0);
}

/* A lock of a file that this or another program holds. */
struct file_lock {
    int fd, command; /* an operation of flock(), without a value */
    void *value;
    int error; /* 0: it is held now */
};

static bool takes_lock(void *subject)
{
    struct file_lock *lock = subject;
    if (!lock->error) return true;
    int result = lock->value ? REAL(fcntl)(lock->fd, lock->command, lock->value)
                             : REAL(flock)(lock->fd, lock->command);
    lock->error = result < 0 ? errno : 0;
    return lock->error != EAGAIN && lock->error != EACCES;
}

/* Lock a file; wait for the turns of others while they hold it. */
static int lock_file(int fd, int command, int attempt, void *value)
{
    struct file_lock lock = {fd, attempt, value, EAGAIN};
    enum result result = HOLDS;
    if (rig.state != JOINED || !in_rig() || !thread_here || thread_here->waits)
        return value ? REAL(fcntl)(fd, command, value) : REAL(flock)(fd, command);
    if (!takes_lock(&lock))
        result = wait_point(takes_lock, &lock, NEVER, ON_PARTIES | ON_PROCESSES | RESTARTS);
    errno = result == INTERRUPTED ? EINTR : lock.error;
    return errno ? -1 : 0;
}

EXPORT int flock(int fd, int operation)
{
    if (!(operation & (LOCK_NB | LOCK_UN)))
        return lock_file(fd, operation, operation | LOCK_NB, NULL);
    return charged(REAL(flock)(fd, operation));
}

EXPORT int lockf(int fd, int command, off_t size)
{
    struct flock lock = {.l_type = F_WRLCK, .l_whence = SEEK_CUR, .l_len = size};
    return command == F_LOCK ? fcntl(fd, F_SETLKW, &lock) : REAL(lockf)(fd, command, size);
}

EXPORT int lockf64(int fd, int command, off64_t size) __attribute__((alias("lockf")));

EXPORT int fcntl(int fd, int command, ...)
{
    va_list values;
    va_start(values, command);
    void *value = va_arg(values, void *);
    va_end(values);
    if (command == F_SETLKW) return lock_file(fd, command, F_SETLK, value);
    if (command == F_OFD_SETLKW) return lock_file(fd, command, F_OFD_SETLK, value);
    int result = REAL(fcntl)(fd, command, value);
    bool is_copy = command == F_DUPFD || command == F_DUPFD_CLOEXEC;
    return is_copy ? duplicate(fd, result) : result;
}

EXPORT int fcntl64(int fd, int command, ...) __attribute__((alias("fcntl")));

/* ---- waits ----------------------------------------------------------------------------------- */

bool is_blocking(int fd, int flags)
{
    return !(flags & MSG_DONTWAIT) && !(REAL(fcntl)(fd, F_GETFL) & O_NONBLOCK);
}

/* Return whether a pipe has its other end in this process. */
static bool is_inner_pipe(int fd, const struct stat *pipe)
{
    struct dirent *entry;
    struct stat other;
    bool is_inner = false;
    int way = REAL(fcntl)(fd, F_GETFL) & O_ACCMODE;
    DIR *folder = opendir("/proc/self/fd");
    if (!folder) return true;
    while (!is_inner && (entry = readdir(folder))) {
        int number = atoi(entry->d_name);
        if (number == fd || fstat(number, &other) < 0) continue;
        if (other.st_dev != pipe->st_dev || other.st_ino != pipe->st_ino) continue;
        is_inner = (REAL(fcntl)(number, F_GETFL) & O_ACCMODE) != way;
    }
    closedir(folder);
    return is_inner;
}

/* Return whether a process was started as a program of this rig, or has ended since. */
static bool is_of_rig(pid_t pid)
{
    char path[32], *variable = NULL, own[sizeof rig.path + 32];
    size_t space = 0, count = 0, length = 0;
    bool is_found = false;
    snprintf(path, sizeof path, "/proc/%d/environ", (int)pid);
    snprintf(own, sizeof own, "MOTORHIL_CLOCK=%s#", rig.path);
    length = strlen(own);
    FILE *environment = fopen(path, "r");
    if (!environment) return errno == ENOENT;
    for (; !is_found && getdelim(&variable, &space, '\0', environment) > 0; count++)
        is_found = !strncmp(variable, own, length);
    free(variable);
    fclose(environment);
    return is_found || !count;
}

/* Return the name of something whose other end has the time of the wall; NULL for all else. */
static const char *outsider(int fd)
{
    struct stat file;
    struct ucred peer;
    int domain = 0, is_listening = 0;
    socklen_t size = sizeof domain, peer_size = sizeof peer;
    if (fstat(fd, &file) < 0) return NULL;
    if (S_ISFIFO(file.st_mode)) return is_inner_pipe(fd, &file) ? NULL : "pipe of another process";
    if (!S_ISSOCK(file.st_mode)) return NULL;
    if (REAL(getsockopt)(fd, SOL_SOCKET, SO_DOMAIN, &domain, &size) < 0) return NULL;
    if (domain != AF_UNIX) return "socket of the network";
    if (REAL(getsockopt)(fd, SOL_SOCKET, SO_PEERCRED, &peer, &peer_size) < 0) return NULL;
    size = sizeof is_listening;
    REAL(getsockopt)(fd, SOL_SOCKET, SO_ACCEPTCONN, &is_listening, &size);
    bool is_inner = peer.pid == getpid() && !is_listening;
    if (!is_inner && peer.pid && !is_listening && !is_of_rig(peer.pid))
        return "socket of another process";
    has_neighbours |= !is_inner;
    return NULL;
}

/* Tell once of a descriptor whose other end has the time of the wall. */
void look_at(int fd)
{
    if (fd < 0 || fd >= DESCRIPTORS_MAX || is_told[fd] || descriptors[fd]) return;
    is_told[fd] = true;
    const char *what = outsider(fd);
    if (what)
        tell("program '%s' waits for descriptor %d, a %s, which has the time of the wall; the rig's"
             " time does not wait for it",
             rig.name, fd, what);
}

struct polled {
    struct pollfd *fds;
    nfds_t count;
};

static bool is_polled(void *subject)
{
    struct polled *polled = subject;
    return REAL(poll)(polled->fds, polled->count, 0) != 0;
}

/* Wait as ppoll does; INTERRUPTED if the rig or a signal ends the wait. */
static enum result wait_for(struct pollfd *fds, nfds_t count, int64_t deadline_ns,
                            const sigset_t *mask)
{
    struct polled polled = {fds, count};
    for (nfds_t i = 0; i < count; i++) look_at(fds[i].fd);
    struct thread *me = thread_here;
    if (me) me->mask = mask;
    enum result result =
        wait_point(is_polled, &polled, deadline_ns, has_neighbours ? ON_PROCESSES : 0);
    thread_here->mask = NULL;
    return result;
}

/* Wait as a read does, which begins again after signals unless it has a timeout. */
enum result wait_for_input(int fd, int64_t deadline_ns)
{
    struct pollfd input = {.fd = fd, .events = POLLIN};
    struct polled polled = {&input, 1};
    look_at(fd);
    int flags = (has_neighbours ? ON_PROCESSES : 0) | (deadline_ns == NEVER ? RESTARTS : 0);
    return wait_point(is_polled, &polled, deadline_ns, flags);
}

static int64_t deadline_in_ms(int ms)
{
    return ms < 0 ? NEVER : deadline_after(ms * (int64_t)1000000);
}

static int64_t deadline_in(const struct timespec *duration)
{
    return duration ? deadline_after(duration_ns(duration)) : NEVER;
}

static const struct timespec no_time = {0, 0};

static int interrupted(void)
{
    errno = EINTR;
    return -1;
}

/* poll() that has found nothing: wait, and ask again. `mask` is set where signals arrive. */
static int poll_again(struct pollfd *fds, nfds_t count, int64_t deadline_ns, bool may_wait,
                      const sigset_t *mask)
{
    if (!may_wait) {
        look();
        return 0;
    }
    enum result result = wait_for(fds, count, deadline_ns, mask);
    int ready = REAL(ppoll)(fds, count, &no_time, mask);
    return result == INTERRUPTED && !ready ? interrupted() : ready;
}

EXPORT int poll(struct pollfd *fds, nfds_t count, int timeout_ms)
{
    if (!in_rig()) return REAL(poll)(fds, count, timeout_ms);
    int ready = REAL(poll)(fds, count, 0);
    return ready ? ready
                 : poll_again(fds, count, deadline_in_ms(timeout_ms), timeout_ms != 0, NULL);
}

EXPORT int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *timeout,
                 const sigset_t *mask)
{
    if (!in_rig() || (timeout && !is_duration(timeout)))
        return REAL(ppoll)(fds, count, timeout, mask);
    int ready = REAL(ppoll)(fds, count, &no_time, mask);
    bool may_wait = !timeout || duration_ns(timeout) != 0;
    return ready ? ready : poll_again(fds, count, deadline_in(timeout), may_wait, mask);
}

EXPORT int __poll_chk(struct pollfd *fds, nfds_t count, int timeout_ms, size_t size)
{
    (void)size;
    return poll(fds, count, timeout_ms);
}

EXPORT int __ppoll_chk(struct pollfd *fds, nfds_t count, const struct timespec *timeout,
                       const sigset_t *mask, size_t size)
{
    (void)size;
    return ppoll(fds, count, timeout, mask);
}

/* select() by poll(): one entry for each descriptor in a set. */
static nfds_t polled_sets(int count, fd_set *const sets[3], struct pollfd *fds)
{
    static const short events[3] = {POLLIN, POLLOUT, POLLPRI};
    nfds_t used = 0;
    for (int fd = 0; fd < count; fd++) {
        fds[used] = (struct pollfd){.fd = fd};
        for (int i = 0; i < 3; i++)
            if (sets[i] && FD_ISSET(fd, sets[i])) fds[used].events |= events[i];
        if (fds[used].events) used++;
    }
    return used;
}

EXPORT int pselect(int count, fd_set *restrict in, fd_set *restrict out, fd_set *restrict urgent,
                   const struct timespec *restrict timeout, const sigset_t *restrict mask)
{
    if (!in_rig() || count < 0 || count > FD_SETSIZE || (timeout && !is_duration(timeout)))
        return REAL(pselect)(count, in, out, urgent, timeout, mask);
    fd_set *const sets[3] = {in, out, urgent};
    fd_set asked[3];
    struct pollfd fds[FD_SETSIZE];
    for (int i = 0; i < 3; i++)
        if (sets[i]) asked[i] = *sets[i];
    int ready = REAL(pselect)(count, in, out, urgent, &no_time, mask);
    if (ready) return ready;
    for (int i = 0; i < 3; i++)
        if (sets[i]) *sets[i] = asked[i];
    bool may_wait = !timeout || duration_ns(timeout) != 0;
    enum result result = HOLDS;
    if (may_wait)
        result = wait_for(fds, polled_sets(count, sets, fds), deadline_in(timeout), mask);
    else
        look();
    ready = REAL(pselect)(count, in, out, urgent, &no_time, mask);
    return result == INTERRUPTED && !ready ? interrupted() : ready;
}

EXPORT int select(int count, fd_set *restrict in, fd_set *restrict out, fd_set *restrict urgent,
                  struct timeval *restrict timeout)
{
    struct timespec time;
    if (!in_rig()) return REAL(select)(count, in, out, urgent, timeout);
    int64_t from_ns = rig.now_ns;
    if (timeout) /* with more than 10^6 us, as Linux allows */
        time = (struct timespec){timeout->tv_sec + timeout->tv_usec / 1000000,
                                 timeout->tv_usec % 1000000 * 1000};
    int ready = pselect(count, in, out, urgent, timeout ? &time : NULL, NULL);
    if (timeout) { /* Linux leaves what is left of it */
        int64_t left_ns = duration_ns(&time) - (rig.now_ns - from_ns);
        time = timespec_of(left_ns > 0 ? left_ns : 0);
        *timeout = (struct timeval){time.tv_sec, time.tv_nsec / 1000};
    }
    return ready;
}

EXPORT int epoll_pwait2(int epoll, struct epoll_event *events, int count,
                        const struct timespec *timeout, const sigset_t *mask)
{
    if (!in_rig() || (timeout && !is_duration(timeout)))
        return REAL(epoll_pwait2)(epoll, events, count, timeout, mask);
    int ready = REAL(epoll_pwait)(epoll, events, count, 0, mask);
    if (ready) return ready;
    if (timeout && !duration_ns(timeout)) {
        look();
        return 0;
    }
    struct pollfd input = {.fd = epoll, .events = POLLIN}; /* readable where an event is ready */
    enum result result = wait_for(&input, 1, deadline_in(timeout), mask);
    ready = REAL(epoll_pwait)(epoll, events, count, 0, mask);
    return result == INTERRUPTED && !ready ? interrupted() : ready;
}

EXPORT int epoll_pwait(int epoll, struct epoll_event *events, int count, int timeout_ms,
                       const sigset_t *mask)
{
    if (!in_rig()) return REAL(epoll_pwait)(epoll, events, count, timeout_ms, mask);
    struct timespec timeout = timespec_of(timeout_ms * (int64_t)1000000);
    return epoll_pwait2(epoll, events, count, timeout_ms < 0 ? NULL : &timeout, mask);
}

EXPORT int epoll_wait(int epoll, struct epoll_event *events, int count, int timeout_ms)
{
    if (!in_rig()) return REAL(epoll_wait)(epoll, events, count, timeout_ms);
    return epoll_pwait(epoll, events, count, timeout_ms, NULL);
}

EXPORT int epoll_ctl(int epoll, int operation, int fd, struct epoll_event *event)
{
    int result = REAL(epoll_ctl)(epoll, operation, fd, event);
    if (result || !in_rig()) return result;
    if (!note_member(epoll, operation, fd, event) && operation == EPOLL_CTL_ADD) look_at(fd);
    return 0;
}

/* ---- reads and writes ------------------------------------------------------------------------ */

/* Wait before a call that would block. Only a socket joins the rig, since shells read from pipes of
 * their children. Return false with errno if the wait ended without input. */
bool await_input(int fd, int flags)
{
    struct pollfd input = {.fd = fd, .events = POLLIN};
    struct timeval limit = {0};
    socklen_t size = sizeof limit;
    if (!in_rig() || !thread_here || thread_here->waits) return true;
    if (REAL(poll)(&input, 1, 0) || !is_blocking(fd, flags)) return true;
    bool is_socket = REAL(getsockopt)(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, &size) == 0;
    if (rig.state == AWAITING && !is_socket) return true;
    int64_t limit_ns = limit.tv_sec * (int64_t)NS_PER_S + limit.tv_usec * 1000;
    enum result result = wait_for_input(fd, limit_ns ? deadline_after(limit_ns) : NEVER);
    if (result == HOLDS) return true;
    errno = result == EXPIRED ? EAGAIN : EINTR;
    return false;
}

/* Charge a call that has found nothing, as a look at a clock: a loop of such calls ends. */
ssize_t charged(ssize_t result)
{
    if (result >= 0 || errno != EAGAIN || rig.state != JOINED || !in_rig()) return result;
    look();
    errno = EAGAIN;
    return result;
}

EXPORT ssize_t read(int fd, void *data, size_t size)
{
    ssize_t result;
    if (is_can(fd)) return can_receive(fd, data, size, 0, NULL, NULL);
    if (await_characters(fd, &result)) return result;
    return await_input(fd, 0) ? charged(REAL(read)(fd, data, size)) : -1;
}

EXPORT ssize_t readv(int fd, const struct iovec *parts, int count)
{
    if (is_can(fd))
        refuse("program '%s': readv() of a CAN socket: not supported; expected read()", rig.name);
    return await_input(fd, 0) ? charged(REAL(readv)(fd, parts, count)) : -1;
}

EXPORT ssize_t recvfrom(int fd, void *restrict data, size_t size, int flags,
                        struct sockaddr *restrict address, socklen_t *restrict address_size)
{
    if (is_can(fd)) return can_receive(fd, data, size, flags, address, address_size);
    ssize_t taken = take_netlink(fd, data, size, flags, address, address_size);
    if (taken >= 0) return taken;
    return await_input(fd, flags)
               ? charged(REAL(recvfrom)(fd, data, size, flags, address, address_size))
               : -1;
}

EXPORT ssize_t recv(int fd, void *data, size_t size, int flags)
{
    if (is_can(fd)) return can_receive(fd, data, size, flags, NULL, NULL);
    ssize_t taken = take_netlink(fd, data, size, flags, NULL, NULL);
    if (taken >= 0) return taken;
    return await_input(fd, flags) ? charged(REAL(recv)(fd, data, size, flags)) : -1;
}

EXPORT ssize_t __read_chk(int fd, void *data, size_t size, size_t space)
{
    if (size > space) abort();
    return read(fd, data, size);
}

EXPORT ssize_t __recv_chk(int fd, void *data, size_t size, size_t space, int flags)
{
    if (size > space) abort();
    return recv(fd, data, size, flags);
}

EXPORT ssize_t __recvfrom_chk(int fd, void *data, size_t size, size_t space, int flags,
                              struct sockaddr *address, socklen_t *address_size)
{
    if (size > space) abort();
    return recvfrom(fd, data, size, flags, address, address_size);
}

EXPORT int accept4(int fd, struct sockaddr *address, socklen_t *size, int flags)
{
    return await_input(fd, 0) ? charged(REAL(accept4)(fd, address, size, flags)) : -1;
}

EXPORT int accept(int fd, struct sockaddr *restrict address, socklen_t *restrict size)
{
    return accept4(fd, address, size, 0);
}

static bool has_room(int fd)
{
    struct pollfd output = {.fd = fd, .events = POLLOUT};
    return REAL(poll)(&output, 1, 0) != 0;
}

/* Return whether the reader of a descriptor is a thread that needs turns to make room. */
static bool has_inner_reader(int fd)
{
    struct stat file;
    if (rig.state != JOINED || !in_rig() || !thread_here || thread_here->waits) return false;
    if (fstat(fd, &file) < 0 || !is_blocking(fd, 0)) return false;
    return (S_ISFIFO(file.st_mode) || S_ISSOCK(file.st_mode)) && !outsider(fd);
}

/* Write in pieces that a pipe takes at once, and wait for room in between. */
static ssize_t write_inner(int fd, const char *data, size_t size)
{
    size_t done = 0;
    while (done < size) {
        struct pollfd output = {.fd = fd, .events = POLLOUT};
        size_t piece = size - done < PIPE_BUF ? size - done : PIPE_BUF;
        if (!has_room(fd) && wait_for(&output, 1, NEVER, NULL) == INTERRUPTED) {
            errno = EINTR;
            break;
        }
        ssize_t written = REAL(write)(fd, data + done, piece);
        if (written < 0) break;
        done += written;
    }
    return done || !size ? (ssize_t)done : -1;
}

EXPORT ssize_t write(int fd, const void *data, size_t size)
{
    if (is_line(fd)) return send_line(fd, data, size, 0);
    if (is_can(fd)) return can_send(fd, data, size, NULL, 0);
    bool may_block = size > PIPE_BUF || (rig.state == JOINED && !has_room(fd));
    if (may_block && has_inner_reader(fd)) return write_inner(fd, data, size);
    return REAL(write)(fd, data, size);
}

EXPORT ssize_t writev(int fd, const struct iovec *parts, int count)
{
    if (is_can(fd))
        refuse("program '%s': writev() to a CAN socket: not supported; expected write()", rig.name);
    return is_line(fd) ? send_parts(fd, parts, count, 0) : REAL(writev)(fd, parts, count);
}

EXPORT ssize_t send(int fd, const void *data, size_t size, int flags)
{
    if (is_line(fd)) return send_line(fd, data, size, flags);
    return is_can(fd) ? can_send(fd, data, size, NULL, 0) : REAL(send)(fd, data, size, flags);
}

EXPORT ssize_t sendto(int fd, const void *data, size_t size, int flags,
                      const struct sockaddr *address, socklen_t address_size)
{
    if (is_can(fd)) return can_send(fd, data, size, address, address_size);
    if (is_line(fd)) return send_line(fd, data, size, flags);
    return REAL(sendto)(fd, data, size, flags, address, address_size);
}

EXPORT int ioctl(int fd, unsigned long request, ...)
{
    bool is_known = false;
    va_list values;
    va_start(values, request);
    void *argument = va_arg(values, void *);
    va_end(values);
    int result = can_ioctl(fd, request, argument, &is_known);
    if (!is_known) result = line_ioctl(fd, request, argument, &is_known);
    return is_known ? result : REAL(ioctl)(fd, request, argument);
}
