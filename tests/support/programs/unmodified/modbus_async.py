"""Polls two PR drives by pymodbus's asynchronous client: `tcp HOST PORT` or `rtu PORT BAUD`."""

import asyncio
import sys
import time

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient


def client_of(kind, where, number):
    if kind == "tcp":
        return AsyncModbusTcpClient(where, port=int(number), timeout=0.5, retries=0)
    return AsyncModbusSerialClient(where, baudrate=int(number), parity="N", timeout=0.5, retries=0)


async def poll(client, unit):
    for _ in range(3):
        answer = await client.read_holding_registers(0x1003, count=1, device_id=unit)
        print(f"{time.monotonic() - 100_000:.3f} s: unit {unit}: {answer.registers}")
        await asyncio.sleep(0.1)


async def main():
    client = client_of(*sys.argv[1:])
    await asyncio.sleep(1.0)  # the drives boot
    assert await client.connect()
    await asyncio.gather(poll(client, 1), poll(client, 2))
    try:
        print((await client.read_holding_registers(0, count=1, device_id=9)).exception_code)
    except Exception as error:
        print(f"{time.monotonic() - 100_000:.3f} s: {type(error).__name__}")
    client.close()


asyncio.run(main())
