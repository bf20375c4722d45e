/* Asks a CiA 402 drive for its device type by SDO, and prints the answer; then waits in vain. */
#include <linux/sockios.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

int main(void)
{
    int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct ifreq query = {.ifr_name = "can0"};
    if (fd < 0 || ioctl(fd, SIOCGIFINDEX, &query) < 0) return 1;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = query.ifr_ifindex};
    struct can_filter filter = {.can_id = 0x581, .can_mask = CAN_SFF_MASK};
    struct timeval limit = {.tv_sec = 1}, stamp;
    if (setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, &filter, sizeof filter) < 0) return 1;
    if (setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit) < 0) return 1;
    if (bind(fd, (struct sockaddr *)&address, sizeof address) < 0) return 1;
    sleep(1);
    struct can_frame frame = {.can_id = 0x601, .can_dlc = 8, .data = {0x40, 0x00, 0x10, 0x00}};
    if (write(fd, &frame, sizeof frame) != sizeof frame) return 1;
    if (read(fd, &frame, sizeof frame) != sizeof frame) return 1;
    ioctl(fd, SIOCGSTAMP, &stamp);
    printf("%X:", frame.can_id);
    for (int i = 0; i < frame.can_dlc; i++) printf(" %02X", frame.data[i]);
    printf(" %s\n", stamp.tv_sec == 1 && stamp.tv_usec < 5000 ? "within 5 ms" : "late");
    ssize_t more = read(fd, &frame, sizeof frame);
    printf("%zd, %ld s\n", more, (long)time(NULL));
    return 0;
}
