"""Two Modbus units with every table, on TCP and pseudo-terminal.

Tests exchange raw bytes. The waiting code steps the loop, so there is no thread. The absence of a
response is shown by the next one.
"""

import os
import socket
import time
import tty
from collections.abc import Callable
from pathlib import Path
from select import select

from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.gateways.modbus_pty import ModbusPty
from motorhil.emulators.gateways.modbus_tcp import ModbusSocket
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.registers import Access, BitBank, Register, RegisterBank
from motorhil.emulators.modbus.rtu import RtuUnit, with_crc
from motorhil.emulators.modbus.server import Diagnostics, ModbusServer
from motorhil.emulators.modbus.tcp import adu
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from tests.unit.emulators.simulation.test_lines import Registers

LONG_S = 20.0
COUNT = 300
CLIENTS_MAX = 4


class AllTables(Registers):
    """Unit n: registers and bits 0 to 299; register r holds 1000 n + r, register 200 is missing."""

    def __init__(self, unit: int, on_a_line: bool) -> None:
        def rows(access: Access) -> list[Register]:
            return [
                Register(place, f"r{place}", default=1000 * unit + place, access=access)
                for place in range(COUNT)
                if place != 200
            ]

        self.unit = unit
        server = ModbusServer(
            holding=RegisterBank(rows(Access.READ_WRITE)),
            inputs=RegisterBank(rows(Access.READ)),
            coils=BitBank([f"c{place}" for place in range(COUNT)]),
            discretes=BitBank([f"d{place}" for place in range(COUNT)]),
            diagnostics=Diagnostics() if on_a_line else None,
        )
        self.rtu = RtuUnit(unit, server, 0)


class Served:
    """The world, its two interfaces, and a client's end of each.

    Attributes: socket (ModbusSocket), pty (ModbusPty), tcp and terminal (the clients' descriptors).
    """

    def __init__(self, link: Path) -> None:
        queue = EventQueue()
        world = World(queue)
        world.add_tcp(BytePipe("plant", 0), None)
        world.add_serial_line(SerialLine("rs485", 115_200, "N", 1), None)
        for unit in (1, 2):
            world.add_controller(f"t{unit}", AllTables(unit, False), "plant")
            world.add_controller(f"s{unit}", AllTables(unit, True), "rs485")
        self.world = world
        self.loop = WallLoop(queue)
        self.socket = ModbusSocket("127.0.0.1", 0, world, "plant", clients_max=CLIENTS_MAX)
        self.loop.add(self.socket)
        self.pty = ModbusPty(link, world, "rs485")
        self.loop.add(self.pty)
        self.loop.start()
        self.tcp = socket.create_connection(self.socket.address)
        self.tcp.setblocking(False)
        self.terminal = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.terminal)
        self._transaction = 0

    def until(self, done: Callable[[], bool]) -> None:
        """Run the loop until the condition holds."""
        end_s = time.monotonic() + LONG_S
        while not done():
            assert time.monotonic() < end_s, "it has not come"
            self.loop.step(0.05)

    def heard(self, descriptor: int, count: int) -> bytes:
        """Return the next `count` bytes."""
        data = b""

        def read() -> bool:
            nonlocal data
            while select([descriptor], [], [], 0)[0] and len(data) < count:
                piece = os.read(descriptor, count - len(data))
                assert piece, "the connection was closed"
                data += piece
            return len(data) >= count

        self.until(read)
        return data

    def ask_tcp(self, unit: int, pdu: bytes) -> bytes:
        """Send a request on TCP and return the response PDU."""
        self._transaction += 1
        os.write(self.tcp.fileno(), adu(self._transaction, unit, pdu))
        return self.answer_tcp(self._transaction, unit)

    def answer_tcp(self, transaction: int, unit: int) -> bytes:
        """Return the PDU of the next response, which must match this request."""
        head = self.heard(self.tcp.fileno(), 7)
        length = int.from_bytes(head[4:6], "big")
        assert head == adu(transaction, unit, bytes(length - 1))[:7]
        return self.heard(self.tcp.fileno(), length - 1)

    def ask_rtu(self, unit: int, pdu: bytes) -> bytes:
        """Send a request in RTU and return the response PDU; its length follows from its head."""
        self.write(with_crc(bytes((unit,)) + pdu))
        return self.answer_rtu(unit)

    def write(self, data: bytes) -> None:
        """Write bytes to the terminal."""
        assert os.write(self.terminal, data) == len(data)

    def answer_rtu(self, unit: int) -> bytes:
        """Return the PDU of the next response, which must be this unit's."""
        frame = self.heard(self.terminal, 5)  # no response is shorter
        assert frame[0] == unit
        if not frame[1] & 0x80:
            reads = frame[1] in (0x01, 0x02, 0x03, 0x04, 0x17)
            rest = frame[2] if reads else {0x16: 5}.get(frame[1], 3)
            frame += self.heard(self.terminal, rest)
        assert with_crc(frame[:-2]) == frame
        return frame[1:-2]

    def close(self) -> None:
        """Close everything."""
        self.tcp.close()
        os.close(self.terminal)
        self.loop.close()
