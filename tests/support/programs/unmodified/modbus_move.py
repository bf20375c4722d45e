"""Moves a PR drive by pymodbus's synchronous client: `tcp HOST PORT` or `rtu PORT BAUD`."""

import sys
import time

from pymodbus.client import ModbusSerialClient, ModbusTcpClient

kind, where, number = sys.argv[1:]
if kind == "tcp":
    client = ModbusTcpClient(where, port=int(number), timeout=0.5)
else:
    client = ModbusSerialClient(where, baudrate=int(number), parity="N", timeout=0.5)
assert client.connect()
time.sleep(1.0)  # the drive boots
client.write_register(0x000F, 1, device_id=1)
client.write_registers(0x6200, [1, 0, 5000, 600, 100, 100, 0], device_id=1)
client.write_register(0x6002, 0x10, device_id=1)
start_s, place = time.monotonic(), 0
while place != 5000:
    time.sleep(0.1)
    high, low = client.read_holding_registers(0x1014, count=2, device_id=1).registers
    place = high << 16 | low
    print(f"{time.monotonic() - start_s:.4f} s: {place}")
client.close()
