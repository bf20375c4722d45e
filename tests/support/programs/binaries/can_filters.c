/* Sends frames with these identifiers and prints those that pass the filters of another socket:
 * can_filters JOIN ERROR_MASK ID:MASK,... ID... (all in hexadecimal) */
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

int main(int words, char **word)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex("can0")};
    struct can_filter filters[8];
    struct can_frame frame;
    int sender = socket(PF_CAN, SOCK_RAW, CAN_RAW), hearer = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    int joins = atoi(word[1]), count = 0;
    can_err_mask_t mask = strtoul(word[2], NULL, 16);
    for (char *pair = strtok(word[3], ","); pair; pair = strtok(NULL, ",")) {
        char *rest;
        filters[count].can_id = strtoul(pair, &rest, 16);
        filters[count++].can_mask = strtoul(rest + 1, NULL, 16);
    }
    if (setsockopt(hearer, SOL_CAN_RAW, CAN_RAW_FILTER, filters, count * sizeof *filters)) return 1;
    if (setsockopt(hearer, SOL_CAN_RAW, CAN_RAW_JOIN_FILTERS, &joins, sizeof joins)) return 2;
    if (setsockopt(hearer, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &mask, sizeof mask)) return 3;
    if (bind(hearer, (struct sockaddr *)&address, sizeof address)) return 4;
    if (bind(sender, (struct sockaddr *)&address, sizeof address)) return 5;
    for (int i = 4; i < words; i++) {
        memset(&frame, 0, sizeof frame);
        frame.can_id = strtoul(word[i], NULL, 16);
        if (send(sender, &frame, sizeof frame, 0) != sizeof frame) return 6;
        usleep(1000);
    }
    while (recv(hearer, &frame, sizeof frame, MSG_DONTWAIT) == sizeof frame)
        printf(" %X", frame.can_id);
    printf("\n");
    if (recv(sender, &frame, sizeof frame, MSG_DONTWAIT) >= 0)
        return 7; /* no own frames by default */
    return 0;
}
