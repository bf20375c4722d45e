/* Sleeps for 1 ms, as often as its argument says. */
#include <stdlib.h>
#include <time.h>

int main(int count, char **arguments)
{
    struct timespec pause = {.tv_nsec = 1000000};
    for (long left = count > 1 ? strtol(arguments[1], NULL, 10) : 0; left > 0; left--)
        nanosleep(&pause, NULL);
    return 0;
}
