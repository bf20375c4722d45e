/* The rig's time in an unmodified program: what the files of this library share.
 *
 * The library is preloaded into a program that a rig has started. Its functions take the place of
 * those of the C library that look at a clock, wait, or use CAN sockets.
 *
 *   connection.c   the connection to the rig, its records, and the turns of the program's threads
 *   clocks.c       clocks and sleeps
 *   timers.c       timers that are descriptors, signals or threads
 *   signals.c      signals of the program to itself
 *   threads.c      threads, and waits of one thread for another
 *   c11_threads.c threads of C11, by those of POSIX
 *   descriptors.c  waits for file descriptors
 *   can.c          CAN sockets
 *   broadcast.c    the broadcast manager of CAN
 *   netlink.c     questions for CAN interfaces
 *   lines.c        gateways and serial ports
 *   streams.c      streams of stdio on descriptors of the rig
 *   syscalls.c     system calls by number
 *   refusals.c     what is not supported, told by name
 *
 * Rules of turn, as in motorhil/harness/virtual_time/runtime.py:
 *   1. One thread of the program runs at a time, and only while the rig has given the program the
 *      turn. All other threads stand in `wait_turn`.
 *   2. The turn changes only in `wait_turn`, and where a thread ends.
 *   3. The thread that waits last serves the rig's calls for all of them. It examines the
 *      conditions of all waits in the order in which they began.
 * So the library needs no locks: its state belongs to the thread that has the turn.
 */
#ifndef MOTORHIL_CLOCK_H
#define MOTORHIL_CLOCK_H

#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>
#include <time.h>

#define EXPORT __attribute__((visibility("default")))
#define PRINTF(text) __attribute__((format(printf, text, text + 1)))

/* The function of the C library that ours stands before. */
#define REAL(name)                                                   \
    ({                                                               \
        static __typeof__(&name) real_;                              \
        if (!real_) real_ = (__typeof__(&name))real_function(#name); \
        real_;                                                       \
    })

enum { NS_PER_S = 1000000000, REFUSED_STATUS = 3, BUSES_MAX = 64, DESCRIPTORS_MAX = 65536 };
enum { NEVER = -1 };
enum state {
    OFF,      /* not started by a rig: every function is that of the C library */
    AWAITING, /* the first wait joins the rig; the time is 0 until then */
    JOINED,
    LEFT,  /* the program ends */
    CHILD, /* a forked child: it has the wall's time */
};
/* Flags of a wait; the first two are the rig's. */
enum { ON_PARTIES = 1, ON_PROCESSES = 2, CANCELLABLE = 256, RESTARTS = 512 };
enum result { EXPIRED = 0, HOLDS = 1, REFUSED = 2, INTERRUPTED = 3 };

struct wait;
struct sent;
struct posix_timer;
typedef bool condition(void *subject);

struct thread {
    struct thread *next;
    pthread_t id;
    pid_t task;     /* its number in the kernel */
    uint16_t party; /* its number on the connection */
    bool waits, has_begun, has_finished, is_cancelled;
    struct sent *sent;                   /* signals that it handles when it has the turn */
    const sigset_t *mask, *awaited;      /* of ppoll(); of sigwait() */
    sem_t baton;                         /* posted when it gets the turn */
    int64_t looked_ns, owed_ns, read_ns; /* last look at a clock: when, unpaid cost, value */
    void *(*start)(void *);
    void *argument;
    struct wait *first_wait; /* for its first turn */
    int rounds;              /* of destructors of its values, when it ends */
};

struct wait {
    struct wait *next;
    uint32_t number;
    struct thread *thread;
    condition *holds;
    void *subject;
    bool is_cancellable;
    enum result result;
};

struct bus {
    char name[16];
    bool is_fd;
};

/* The only shared state of the library, beside the tables of descriptors.c and can.c. */
struct rig {
    enum state state;
    bool has_begun; /* the environment has been read */
    pid_t pid;
    int fd;
    int64_t now_ns;
    char path[108], name[64];
    struct bus buses[BUSES_MAX];
    int bus_count;
    struct wait *waits; /* the longest first */
    uint32_t next_wait;
    char reason[2048]; /* why the last turn was refused */
};
extern struct rig rig;
extern struct thread first_thread;
extern __thread struct thread *thread_here __attribute__((tls_model("initial-exec")));

/* connection.c */
void *real_function(const char *name);
void tell(const char *text, ...) PRINTF(1);
_Noreturn void refuse(const char *text, ...) PRINTF(1);
bool in_rig(void);
void require_open_rig(void);
void join_rig(void);
void leave_rig(void);
void hold_record(const void *record, size_t size);
void send_record(const void *record, size_t size);
size_t receive_record(uint8_t *record, size_t size);
void name_party(uint16_t party);
void begin_wait(struct wait *wait, int64_t deadline_ns, int flags);
void await_baton(struct thread *thread);
void hand_on(void);
enum result wait_turn(condition *holds, void *subject, int64_t deadline_ns, int flags);
enum result wait_point(condition *holds, void *subject, int64_t deadline_ns, int flags);
bool at_once(void *subject);
bool never(void *subject);

/* clocks.c */
int64_t base_ns(clockid_t clock);
int64_t look(void);
bool is_duration(const struct timespec *duration);
int64_t duration_ns(const struct timespec *duration);
int64_t deadline_after(int64_t duration_ns);
int64_t deadline_at(clockid_t clock, const struct timespec *instant);
struct timespec timespec_of(int64_t time_ns);

/* timers.c */
struct alarm {
    struct alarm *next;
    uint32_t number; /* of its period in the rig; 0: it does not run */
    int64_t next_ns, period_ns, interval_ns; /* the period is that in the rig */
    void (*ring)(struct alarm *alarm);
};
struct timer;
void start_alarm(struct alarm *alarm, int64_t first_ns, int64_t interval_ns);
void stop_alarm(struct alarm *alarm);
void expire_alarm(uint32_t number);
void close_timer(struct timer *timer);
void note_handling(struct posix_timer *timer, siginfo_t *info);
void note_taking(siginfo_t *info);

/* signals.c */
void send_signal(struct thread *to, siginfo_t *info, struct posix_timer *timer);
bool is_signal_pending(const struct posix_timer *timer, const struct thread *to, int number);
void drop_signals(const struct posix_timer *timer);
bool handle_signals(bool *restarts);

/* threads.c */
extern struct thread *threads;
void note_main_thread(void);
struct thread *thread_of(pthread_t id);
struct thread *thread_of_task(pid_t task);
long futex(uint32_t *word, int operation, uint32_t value, const struct timespec *time,
           uint32_t bits);

/* descriptors.c */
enum kind { OWN, CAN, TIMER, LINE };
struct descriptor {
    enum kind kind;
    int references; /* descriptors of the program */
    int inner;      /* the library's end or copy; -1: none */
};
struct descriptor *descriptor_of(int fd);
void keep(int fd, struct descriptor *descriptor);
int set_apart(int fd);
bool is_blocking(int fd, int flags);
enum result wait_for_input(int fd, int64_t deadline_ns);
bool await_input(int fd, int flags);
void look_at(int fd);
ssize_t charged(ssize_t result);

/* can.c */
struct can_socket;
void hear(unsigned port, int64_t time_ns, bool is_transmitted, bool is_error, const void *frame,
          size_t size);
void close_can(struct can_socket *socket);
bool is_can(int fd);
ssize_t can_receive(int fd, void *data, size_t size, int flags, void *address, void *address_size);
ssize_t can_send(int fd, const void *data, size_t size, const void *address, size_t address_size);
struct bus *bus_at(int index);
int can_ioctl(int fd, unsigned long request, void *argument, bool *is_known);

void send_frame(struct can_socket *socket, int index, const void *frame, size_t size);
void queue_message(struct can_socket *socket, int index, const void *message, size_t size);

/* broadcast.c */
ssize_t send_broadcast(struct can_socket *socket, int index, const void *data, size_t size);
void hear_broadcast(struct can_socket *socket, int index, const void *frame, size_t size);
void close_broadcast(struct can_socket *socket);

/* netlink.c */
struct msghdr;
bool answer_netlink(int fd, const struct msghdr *message);
ssize_t take_netlink(int fd, void *data, size_t size, int flags, void *address, void *address_size);

/* lines.c */
struct line_end;
struct sockaddr;
struct iovec;
struct epoll_event;
bool is_line(int fd);
bool note_member(int epoll, int operation, int fd, const struct epoll_event *event);
void forget_members(int fd);
bool connect_line(int fd, const struct sockaddr *address, unsigned size, int *result);
void close_line(struct line_end *end);
bool is_option_of_line(int fd, int level);
bool hear_line(unsigned port, int64_t time_ns, bool is_transmitted, const void *data, size_t size);
ssize_t send_line(int fd, const void *data, size_t size, int flags);
ssize_t send_parts(int fd, const struct iovec *parts, int count, int flags);
bool open_serial(const char *path, int flags, int *fd);
bool is_serial(const char *path);
bool await_characters(int fd, ssize_t *result);
int line_ioctl(int fd, unsigned long request, void *argument, bool *is_known);

#endif
