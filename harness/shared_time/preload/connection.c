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

enum { VERSION = 2, RECORD_MAX = 65536, WELCOME_S = 12 };
enum {
    RECORD_BATCH = 15,
    RECORD_JOIN,
    RECORD_PARTY = 23,
    RECORD_WAIT,
    RECORD_IDLE = 26,
    RECORD_LEAVE,
    RECORD_TAKEN = 30
};
enum { DEAF = 4 }; /* a wait that no frame ends */
enum { RECORD_WELCOME = 32, RECORD_REFUSED, RECORD_HEARD = 35, RECORD_TOLD, RECORD_EXPIRED };
enum { RECORD_CHECK = 38, RECORD_GRANT, RECORD_TRY = 41 };

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

static struct {
    uint8_t batch[4096]; /* records that go with the next one, each after its length */
    size_t size;
} held;

static void send_message(const void *message, size_t size)
{
    while (REAL(send)(rig.fd, message, size, MSG_NOSIGNAL) < 0)
        if (errno != EINTR) {
            rig.state = LEFT;
            refuse("the rig has ended, and with it the time of this program");
        }
}

static void send_held(void)
{
    size_t size = held.size;
    held.size = 0;
    if (size) send_message(held.batch, size);
}

/* Send a record together with the next one. */
void hold_record(const void *record, size_t size)
{
    uint16_t length = size;
    if (held.size + sizeof length + size > sizeof held.batch) send_held();
    if (!held.size) held.batch[held.size++] = RECORD_BATCH;
    memcpy(held.batch + held.size, &length, sizeof length);
    memcpy(held.batch + held.size + sizeof length, record, size);
    held.size += sizeof length + size;
}

void send_record(const void *record, size_t size)
{
    if (held.size && held.size + sizeof(uint16_t) + size <= sizeof held.batch) {
        hold_record(record, size);
        send_held();
        return;
    }
    send_held();
    send_message(record, size);
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

/* Return the size of a record of a number and a text. */
static size_t pack_text(uint8_t record[128], uint8_t kind, uint16_t number, const char *text)
{
    struct numbered *head = (struct numbered *)record;
    head->kind = kind;
    head->number = number;
    size_t size = strlen(text), most = 128 - sizeof *head;
    if (size > most) size = most;
    memcpy(head->text, text, size);
    return sizeof *head + size;
}

void name_party(uint16_t party)
{
    char name[32];
    uint8_t record[128];
    snprintf(name, sizeof name, "thread %u", party);
    hold_record(record, pack_text(record, RECORD_PARTY, party, party ? name : "main"));
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
    send_record(record, pack_text(record, RECORD_JOIN, VERSION, rig.name));
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
    hold_record(&record, sizeof record);
    REAL(send)(rig.fd, held.batch, held.size, MSG_NOSIGNAL);
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
    bool is_deaf = flags & ON_PARTIES || wait->holds == never;
    struct waiting record = {RECORD_WAIT, wait->number, wait->thread->party,
                             (flags & (ON_PARTIES | ON_PROCESSES)) | (is_deaf ? DEAF : 0),
                             deadline_ns};
    hold_record(&record, sizeof record);
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

/* Return the number of the first wait that has ended, or 0. */
static uint32_t first_ready(void)
{
    for (struct wait *wait = rig.waits; wait; wait = wait->next)
        if (wait->holds(wait->subject) || wait->thread->sent ||
            (wait->is_cancellable && wait->thread->is_cancelled))
            return wait->number;
    return 0;
}

static void send_idle(uint32_t ready)
{
    struct counted record = {RECORD_IDLE, ready};
    send_record(&record, sizeof record);
}

/* Take the turn, if the frames before this record have ended the wait that it asks for. */
static struct wait *try_wait(const struct period *asked)
{
    uint8_t taken = RECORD_TAKEN;
    uint32_t ready = first_ready();
    if (ready != asked->number) {
        send_idle(ready);
        return NULL;
    }
    hold_record(&taken, sizeof taken);
    struct wait *wait = take_wait(ready);
    wait->result = HOLDS;
    return wait;
}

static struct wait *granted(const struct turn *turn)
{
    struct wait *wait = take_wait(turn->wait);
    if (!wait) {
        send_idle(first_ready());
        return NULL;
    }
    wait->result = turn->result;
    snprintf(rig.reason, sizeof rig.reason, "%s", turn->reason);
    return wait;
}

/* Serve a record of the rig; return true if it asks for an answer of its own. */
static bool serve(uint8_t *record, size_t size, struct wait **wait)
{
    struct delivery *delivery = (struct delivery *)record;
    struct period *period = (struct period *)record;
    struct turn *turn = (struct turn *)record;
    switch (record[0]) {
    case RECORD_HEARD:
    case RECORD_TOLD:
        rig.now_ns = delivery->time_ns;
        if (hear_line(delivery->port, delivery->time_ns, delivery->is_transmitted, delivery->frame,
                      size - sizeof *delivery))
            return false;
        hear(delivery->port, delivery->time_ns, delivery->is_transmitted, record[0] == RECORD_TOLD,
             delivery->frame, size - sizeof *delivery);
        return false;
    case RECORD_EXPIRED:
        rig.now_ns = period->time_ns;
        expire_alarm(period->number);
        return false;
    case RECORD_CHECK: rig.now_ns = ((struct call *)record)->time_ns; return false;
    case RECORD_TRY:
        rig.now_ns = period->time_ns;
        *wait = try_wait(period);
        return true;
    case RECORD_GRANT:
        rig.now_ns = turn->time_ns;
        *wait = granted(turn);
        return true;
    default:
        refuse("record %u of the rig: unknown; expected the same version on both sides", record[0]);
    }
}

/* Serve the records of a message; return whether the last one has been answered. */
static bool serve_message(uint8_t *message, size_t size, struct wait **wait)
{
    bool is_answered = false;
    if (message[0] != RECORD_BATCH) return serve(message, size, wait);
    for (size_t at = 1; at + sizeof(uint16_t) < size;) {
        uint16_t length;
        memcpy(&length, message + at, sizeof length);
        at += sizeof length;
        is_answered = serve(message + at, length, wait);
        at += length;
    }
    return is_answered;
}

/* Give the turn back; serve the rig's calls until a wait of this program has ended; return it. */
static struct wait *next_turn(void)
{
    static uint8_t message[RECORD_MAX + 1]; /* of the thread that has the turn */
    struct wait *wait = NULL;
    send_idle(first_ready());
    for (;;) {
        size_t size = receive_record(message, sizeof message);
        bool is_answered = serve_message(message, size, &wait);
        if (wait) return wait;
        if (!is_answered) send_idle(first_ready());
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

/* Wait until the condition holds, a signal is sent, or for the deadline, by the rules of turn. */
static enum result wait_once(condition *holds, void *subject, int64_t deadline_ns, int flags)
{
    struct thread *me = thread_here;
    int state;
    if (rig.state == AWAITING) join_rig();
    if (!me)
        refuse("thread %ld was not started by pthread_create and has no turn; expected"
               " pthread_create; joins = false lets the program run beside the rig",
               REAL(syscall)(SYS_gettid));
    if (me->waits)
        refuse("program '%s' waits in the handler of a signal from outside; expected a flag that"
               " its main loop looks at",
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
    return mine.result;
}

/* Handle the signals that have ended a wait. Return false if there were none; *result says how the
 * wait has ended then, INTERRUPTED if it may begin again. */
static bool is_disturbed(condition *holds, void *subject, int64_t deadline_ns, bool *restarts,
                         enum result *result)
{
    if (!handle_signals(restarts)) return false;
    *result = holds(subject)                                          ? HOLDS
              : deadline_ns != NEVER && deadline_ns <= rig.now_ns ? EXPIRED
                                                                      : INTERRUPTED;
    return true;
}

/* Wait until the condition holds, or for the deadline. Signals are handled, and end no wait. */
enum result wait_turn(condition *holds, void *subject, int64_t deadline_ns, int flags)
{
    int error = errno;
    bool restarts = true;
    enum result result;
    do result = wait_once(holds, subject, deadline_ns, flags);
    while (is_disturbed(holds, subject, deadline_ns, &restarts, &result) && result == INTERRUPTED);
    errno = error;
    return result;
}

/* As wait_turn, for a function that POSIX calls a cancellation point, and that signals end unless
 * the wait RESTARTS and their handlers allow it. */
enum result wait_point(condition *holds, void *subject, int64_t deadline_ns, int flags)
{
    int error = errno;
    bool restarts = flags & RESTARTS;
    enum result result;
    for (;;) {
        result = wait_once(holds, subject, deadline_ns, flags | CANCELLABLE);
        if (thread_here->is_cancelled) {
            pthread_testcancel();
            thread_here->is_cancelled = false; /* it has disabled cancellation */
        }
        if (!is_disturbed(holds, subject, deadline_ns, &restarts, &result)) break;
        if (result != INTERRUPTED || !restarts) break;
    }
    errno = error;
    return result;
}
