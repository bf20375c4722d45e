/* The connection to the rig, and the turns of the program's threads.
 *
 * Records: motorhil/harness/shared_time/records.py. All numbers are little-endian, as is each
 * processor that this library is built for.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the records of a rig are little-endian"
#endif

enum { VERSION = 1, RECORD_MAX = 65536, WELCOME_S = 12 };
enum {
    RECORD_JOIN = 16,
    RECORD_PARTY = 23,
    RECORD_WAIT,
    RECORD_WITHDRAW,
    RECORD_IDLE,
    RECORD_LEAVE
};
enum { RECORD_WELCOME = 32, RECORD_REFUSED, RECORD_HEARD = 35, RECORD_TOLD, RECORD_EXPIRED };
enum { RECORD_CHECK = 38, RECORD_GRANT };

struct __attribute__((packed)) numbered {
    uint8_t kind;
    uint16_t number;
    char text[];
};
struct __attribute__((packed)) counted {
    uint8_t kind;
    uint32_t number;
};
struct __attribute__((packed)) waiting {
    uint8_t kind;
    uint32_t wait;
    uint16_t party;
    uint8_t flags;
    int64_t deadline_ns;
};
struct __attribute__((packed)) delivery {
    uint8_t kind;
    uint16_t port;
    int64_t time_ns;
    uint8_t is_transmitted;
    uint8_t frame[];
};
struct __attribute__((packed)) period {
    uint8_t kind;
    uint32_t number;
    int64_t time_ns;
};
struct __attribute__((packed)) call {
    uint8_t kind;
    int64_t time_ns;
};
struct __attribute__((packed)) turn {
    uint8_t kind;
    uint32_t wait;
    int64_t time_ns;
    uint8_t result;
    char reason[];
};
struct __attribute__((packed)) welcome {
    uint8_t kind;
    uint16_t version;
    int64_t now_ns, seed;
    char buses[];
};

struct rig rig = {.fd = -1, .next_wait = 1};
struct thread first_thread;
__thread struct thread *thread_here;

void *real_function(const char *name)
{
    void *found = NULL;
#ifdef __x86_64__ /* condition variables have a second, older version, which dlsym may return */
    if (!strncmp(name, "pthread_cond_", 13)) found = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2");
#endif
    return found ? found : dlsym(RTLD_NEXT, name);
}

/* ---- what is told ---------------------------------------------------------------------------- */

static void print(const char *text, va_list values)
{
    char line[1024];
    int size = snprintf(line, sizeof line - 1, "motorhil: ");
    size += vsnprintf(line + size, sizeof line - 1 - size, text, values);
    size = size < (int)sizeof line - 1 ? size : (int)sizeof line - 2;
    line[size++] = '\n';
    if (REAL(write)(STDERR_FILENO, line, size) < 0) return;
}

void tell(const char *text, ...)
{
    va_list values;
    va_start(values, text);
    print(text, values);
    va_end(values);
}

/* End the program, since it would otherwise run with a wrong time. */
void refuse(const char *text, ...)
{
    va_list values;
    va_start(values, text);
    print(text, values);
    va_end(values);
    leave_rig();
    REAL(_exit)(REFUSED_STATUS);
    __builtin_unreachable();
}

/* ---- records --------------------------------------------------------------------------------- */

void send_record(const void *record, size_t size)
{
    while (REAL(send)(rig.fd, record, size, MSG_NOSIGNAL) < 0)
        if (errno != EINTR) {
            rig.state = LEFT;
            refuse("the rig has ended, and with it the time of this program");
        }
}

size_t receive_record(uint8_t *record, size_t size)
{
    ssize_t received;
    do received = REAL(recv)(rig.fd, record, size - 1, 0);
    while (received < 0 && errno == EINTR);
    if (received <= 0) {
        rig.state = LEFT;
        refuse("the rig has ended, and with it the time of this program");
    }
    record[received] = 0; /* texts end here */
    return received;
}

static void send_text(uint8_t kind, uint16_t number, const char *text)
{
    uint8_t record[128];
    struct numbered *head = (struct numbered *)record;
    head->kind = kind;
    head->number = number;
    size_t size = strlen(text);
    if (size > sizeof record - sizeof *head) size = sizeof record - sizeof *head;
    memcpy(head->text, text, size);
    send_record(record, sizeof *head + size);
}

void name_party(uint16_t party)
{
    char name[32];
    snprintf(name, sizeof name, "thread %u", party);
    send_text(RECORD_PARTY, party, party ? name : "main");
}

/* ---- joining and leaving --------------------------------------------------------------------- */

/* Read the names of the buses: {"can0": null, "can1": 5000000}. Longer ones than Linux has cannot
 * be the name of an interface, and are left out. */
static void read_buses(const char *text)
{
    const char *name;
    while (rig.bus_count < BUSES_MAX && (name = strchr(text, '"')) != NULL) {
        const char *end = strchr(name + 1, '"');
        if (!end) return;
        struct bus *bus = &rig.buses[rig.bus_count];
        size_t size = end - name - 1;
        text = end + 1 + strspn(end + 1, ": ");
        if (size >= sizeof bus->name) continue;
        memcpy(bus->name, name + 1, size);
        bus->is_fd = *text != 'n';
        rig.bus_count++;
    }
}

/* Refuse a second process of the program: the rig has begun, and its socket is not writable. */
void require_open_rig(void)
{
    struct stat door;
    if (rig.state == AWAITING && !stat(rig.path, &door) && door.st_mode & S_IWUSR) return;
    rig.state = LEFT;
    refuse(
        "program '%s' has joined the rig already, in another process; expected one process; write"
        " exec before the command in a script",
        rig.name);
}

void join_rig(void)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    struct timeval limit = {.tv_sec = WELCOME_S}, none = {0};
    uint8_t record[RECORD_MAX];
    require_open_rig();
    rig.state = JOINED;
    rig.pid = getpid();
    unsetenv("MOTORHIL_CLOCK"); /* a child is another program */
    memcpy(address.sun_path, rig.path, sizeof address.sun_path);
    rig.fd = set_apart(REAL(socket)(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0));
    if (connect(rig.fd, (struct sockaddr *)&address, sizeof address) < 0) {
        rig.state = LEFT;
        refuse("%s: cannot join the rig: %s", rig.path, strerror(errno));
    }
    REAL(setsockopt)(rig.fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
    send_text(RECORD_JOIN, VERSION, rig.name);
    ssize_t size = REAL(recv)(rig.fd, record, sizeof record - 1, 0);
    record[size > 0 ? size : 0] = 0;
    struct welcome *welcome = (struct welcome *)record;
    if (size < (ssize_t)sizeof *welcome || welcome->kind != RECORD_WELCOME) {
        rig.state = LEFT;
        if (size > 0 && record[0] == RECORD_REFUSED)
            refuse("program '%s': refused by the rig: %s", rig.name, (char *)record + 1);
        require_open_rig();
    }
    REAL(setsockopt)(rig.fd, SOL_SOCKET, SO_RCVTIMEO, &none, sizeof none);
    rig.now_ns = welcome->now_ns;
    read_buses(welcome->buses);
    note_main_thread();
    name_party(0);
    wait_turn(at_once, NULL, NEVER, 0);
}

void leave_rig(void)
{
    uint8_t record = RECORD_LEAVE;
    if (rig.state != JOINED || getpid() != rig.pid) return; /* not of a child by vfork */
    rig.state = LEFT;
    REAL(send)(rig.fd, &record, 1, MSG_NOSIGNAL);
    REAL(close)(rig.fd);
}

static void become_child(void)
{
    if (rig.state != JOINED) return;
    rig.state = CHILD;
    REAL(close)(rig.fd);
}

static void begin(void);

/* Return whether the caller has the rig's time. */
bool in_rig(void)
{
    static bool is_told;
    if (!rig.has_begun) begin();
    if (rig.state == CHILD && !is_told) {
        is_told = true;
        tell("a forked child of program '%s' has the time of the wall", rig.name);
    }
    return (rig.state == AWAITING || rig.state == JOINED) &&
           (!thread_here || !thread_here->has_finished);
}

/* Python programs join by themselves, also where a script has started them. */
static bool is_python(void)
{
    char path[4096];
    ssize_t size = readlink("/proc/self/exe", path, sizeof path - 1);
    path[size > 0 ? size : 0] = 0;
    const char *name = strrchr(path, '/');
    return name && !strncmp(name + 1, "python", 6);
}

/* At the first call, since other libraries may begin before this one; but before main(). */
__attribute__((constructor)) static void begin(void)
{
    if (rig.has_begun) return;
    rig.has_begun = true;
    const char *channel = getenv("MOTORHIL_CLOCK");
    const char *name = channel ? strrchr(channel, '#') : NULL;
    thread_here = &first_thread;
    if (!name || is_python() || name - channel >= (ptrdiff_t)sizeof rig.path) return;
    memcpy(rig.path, channel, name - channel);
    snprintf(rig.name, sizeof rig.name, "%s", name + 1);
    rig.state = AWAITING;
    pthread_atfork(NULL, NULL, become_child);
    setvbuf(stdout, NULL, _IOLBF, 0); /* the rig prints lines in the order of the turns */
}

__attribute__((destructor)) static void end(void)
{
    if (rig.state == JOINED) fflush(NULL); /* before another program has the turn */
    leave_rig();
}

EXPORT void _exit(int status)
{
    leave_rig();
    REAL(_exit)(status);
    __builtin_unreachable();
}

EXPORT void _Exit(int status)
{
    _exit(status);
}

/* ---- turns ----------------------------------------------------------------------------------- */

bool at_once(void *subject)
{
    (void)subject;
    return true;
}

bool never(void *subject)
{
    (void)subject;
    return false;
}

/* Tell the rig of a wait; only the thread that has the turn does. */
void begin_wait(struct wait *wait, int64_t deadline_ns, int flags)
{
    struct wait **place = &rig.waits;
    while (*place) place = &(*place)->next;
    *place = wait;
    wait->next = NULL;
    wait->number = rig.next_wait++;
    wait->is_cancellable = flags & CANCELLABLE;
    struct waiting record = {RECORD_WAIT, wait->number, wait->thread->party, flags & ON_PARTIES,
                             deadline_ns};
    send_record(&record, sizeof record);
}

static struct wait *take_wait(uint32_t number)
{
    for (struct wait **place = &rig.waits; *place; place = &(*place)->next)
        if ((*place)->number == number) {
            struct wait *found = *place;
            *place = found->next;
            return found;
        }
    return NULL;
}

/* Withdraw a wait that gets no turn. */
void end_wait(struct wait *wait)
{
    struct counted record = {RECORD_WITHDRAW, wait->number};
    take_wait(wait->number);
    send_record(&record, sizeof record);
}

/* Return whether another thread of the program has ended the wait of this one. */
static bool is_disturbed(const struct thread *thread)
{
    return thread->is_cancelled || thread->is_interrupted;
}

static void send_idle(void)
{
    struct counted record = {RECORD_IDLE, 0};
    for (struct wait *wait = rig.waits; wait && !record.number; wait = wait->next)
        if (wait->holds(wait->subject) || (wait->is_cancellable && is_disturbed(wait->thread)))
            record.number = wait->number;
    send_record(&record, sizeof record);
}

/* Give the turn back; serve the rig's calls until a wait of this program has ended; return it. */
static struct wait *next_turn(void)
{
    static uint8_t record[RECORD_MAX]; /* of the one thread that serves the rig */
    for (;;) {
        send_idle();
        size_t size = receive_record(record, sizeof record);
        struct delivery *delivery = (struct delivery *)record;
        struct period *period = (struct period *)record;
        struct turn *turn = (struct turn *)record;
        switch (record[0]) {
        case RECORD_HEARD:
        case RECORD_TOLD:
            rig.now_ns = delivery->time_ns;
            if (hear_line(delivery->port, delivery->time_ns, delivery->is_transmitted,
                          delivery->frame, size - sizeof *delivery))
                break;
            hear(delivery->port, delivery->time_ns, delivery->is_transmitted,
                 record[0] == RECORD_TOLD, delivery->frame, size - sizeof *delivery);
            break;
        case RECORD_EXPIRED:
            rig.now_ns = period->time_ns;
            expire_timer(period->number);
            break;
        case RECORD_CHECK: rig.now_ns = ((struct call *)record)->time_ns; break;
        case RECORD_GRANT:
            rig.now_ns = turn->time_ns;
            struct wait *wait = take_wait(turn->wait);
            if (!wait) break;
            wait->result = turn->result;
            snprintf(rig.reason, sizeof rig.reason, "%.2000s", turn->reason);
            return wait;
        default:
            refuse("record %u of the rig: unknown; expected the same version on both sides",
                   record[0]);
        }
    }
}

void await_baton(struct thread *thread)
{
    while (REAL(sem_wait)(&thread->baton) < 0) continue; /* a signal */
}

/* Give the turn to another thread, or let it serve the rig's calls; this thread needs no more. */
void hand_on(void)
{
    if (!rig.waits) {
        leave_rig();
        return;
    }
    REAL(sem_post)(&next_turn()->thread->baton);
}

/* Wait until the condition holds, or for the deadline, by the rules of turn. */
enum result wait_turn(condition *holds, void *subject, int64_t deadline_ns, int flags)
{
    struct thread *me = thread_here;
    int state, error = errno;
    if (rig.state == AWAITING) join_rig();
    if (!me)
        refuse("thread %ld was not started by pthread_create and has no turn; expected"
               " pthread_create; joins = false lets the program run beside the rig",
               REAL(syscall)(SYS_gettid));
    if (me->waits)
        refuse("program '%s' waits in a signal handler; expected a flag that its main"
               " loop looks at",
               rig.name);
    pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, &state);
    me->waits = true;
    struct wait mine = {.thread = me, .holds = holds, .subject = subject};
    begin_wait(&mine, deadline_ns, flags);
    struct wait *granted = next_turn();
    if (granted != &mine) {
        REAL(sem_post)(&granted->thread->baton);
        await_baton(me);
    }
    me->waits = false;
    if (mine.result == REFUSED) refuse("program '%s': %s", rig.name, rig.reason);
    pthread_setcancelstate(state, &state);
    if (mine.result == INTERRUPTED) raise(SIGINT);
    errno = error;
    return mine.result;
}

/* As wait_turn, for a function that POSIX calls a cancellation point. */
enum result wait_point(condition *holds, void *subject, int64_t deadline_ns, int flags)
{
    enum result result = wait_turn(holds, subject, deadline_ns, flags | CANCELLABLE);
    if (thread_here->is_cancelled) {
        pthread_testcancel();
        thread_here->is_cancelled = false; /* it has disabled cancellation */
    }
    if (thread_here->is_interrupted) result = INTERRUPTED;
    thread_here->is_interrupted = false;
    return result;
}
