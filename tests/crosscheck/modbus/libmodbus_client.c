/* libmodbus as a program of its own: the same exchange on TCP and RTU; prints what it was told.
 *
 * libmodbus_client tcp HOST PORT | libmodbus_client rtu DEVICE BAUD
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void must(int done, int count, const char *what) {
    if (done != count) {
        printf("%s: %d, %s\n", what, done, modbus_strerror(errno));
        exit(1);
    }
}

int main(int argc, char **argv) {
    if (argc != 4) return 2;
    modbus_t *bus = strcmp(argv[1], "tcp") == 0 ? modbus_new_tcp(argv[2], atoi(argv[3]))
                                                : modbus_new_rtu(argv[2], atoi(argv[3]), 'N', 8, 1);
    uint16_t path[7] = {0x41, 0xFFFF, 0xFF9C, 321, 50, 60, 7}, read[7], swapped[2];
    uint16_t put[2] = {0xFFFF, 0xFFF6};
    uint8_t id[64];

    if (bus == NULL || modbus_connect(bus) != 0) return 1;
    modbus_set_response_timeout(bus, 10, 0);
    modbus_set_slave(bus, 1);
    must(modbus_write_register(bus, 0x620B, 123), 1, "06h");
    must(modbus_write_registers(bus, 0x6210, 7, path), 7, "10h");
    must(modbus_read_registers(bus, 0x6210, 7, read), 7, "03h");
    printf("%d\n", memcmp(path, read, sizeof path));
    must(modbus_read_registers(bus, 0x620B, 1, read), 1, "03h");
    printf("%d\n", read[0]);
    printf("%d\n", modbus_read_registers(bus, 0xF000, 1, read) == -1 && errno == EMBXILADD);
    printf("%d\n", modbus_read_bits(bus, 0, 1, id) == -1 && errno == EMBXILFUN);
    printf("%d\n", modbus_report_slave_id(bus, sizeof id, id) > 1);
    modbus_set_slave(bus, 2);
    must(modbus_write_and_read_registers(bus, 0x5C, 2, put, 0x5C, 2, swapped), 2, "17h");
    printf("%d\n", (int32_t)((uint32_t)swapped[0] << 16 | swapped[1]));
    modbus_close(bus);
    modbus_free(bus);
    return 0;
}
