/* Functions that would wait or look at a clock, and are not supported: told by name.
 *
 * The library ends the program rather than let it run with two times. Before the program has
 * joined a rig, and without one, they are those of the C library.
 */
#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>

/* By a name of the assembler, since headers declare each with its own types. */
#define REFUSAL(call, remedy)                                                                    \
    EXPORT long refused_##call(long a, long b, long c, long d, long e, long f) __asm__(#call);   \
    EXPORT long refused_##call(long a, long b, long c, long d, long e, long f)                   \
    {                                                                                            \
        static long (*real)(long, long, long, long, long, long);                                 \
        if (in_rig())                                                                            \
            refuse("program '%s' calls %s(): not supported in the rig's time; %s; joins = false" \
                   " lets the program run beside the rig",                                       \
                   rig.name, #call, remedy);                                                     \
        if (!real) real = (__typeof__(real))real_function(#call);                                \
        if (real) return real(a, b, c, d, e, f);                                                 \
        errno = ENOSYS;                                                                          \
        return -1;                                                                               \
    }

REFUSAL(clock_settime, "expected a clock that the rig sets")
REFUSAL(settimeofday, "expected a clock that the rig sets")
REFUSAL(adjtime, "expected a clock that the rig sets")
REFUSAL(adjtimex, "expected a clock that the rig sets")
REFUSAL(clock_adjtime, "expected a clock that the rig sets")
REFUSAL(mq_receive, "expected a pipe")
REFUSAL(mq_timedreceive, "expected a pipe")
REFUSAL(mq_timedsend, "expected a pipe")
REFUSAL(semop, "expected sem_wait()")
REFUSAL(semtimedop, "expected sem_wait()")
REFUSAL(msgrcv, "expected a pipe")
REFUSAL(mq_send, "expected a pipe")
REFUSAL(msgsnd, "expected a pipe")
REFUSAL(aio_suspend, "expected a thread that reads")
REFUSAL(aio_suspend64, "expected a thread that reads")
REFUSAL(lio_listio, "expected a thread that reads")
REFUSAL(lio_listio64, "expected a thread that reads")
REFUSAL(gai_suspend, "expected getaddrinfo()")
REFUSAL(sigpause, "expected sigsuspend()")
REFUSAL(__xpg_sigpause, "expected sigsuspend()")
