"""A Modbus drive on a line with a client's raw bytes."""

from collections.abc import Mapping
from pathlib import Path

from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

MS = 1_000_000


class Refused(Exception):  # noqa: N818 -- it says what happened
    """An exception response."""


class ModbusBench:
    """One booted drive of unit 1, and a client that sends one request after another."""

    def __init__(self, build, table: Mapping[str, object] | None = None, boot: bool = True) -> None:
        self.world = World(EventQueue())
        self.world.add_serial_line(SerialLine("line", 115_200, "N", 1), None)
        self.events: list[tuple[str, str]] = []
        self.world.tap_events(lambda _, level, name, text: self.events.append((level, text)))
        context = ControllerContext("drive", Path(), 1)
        drive = build({"unit": 1, **(table or {})}, context)
        self.world.add_controller("drive", drive, "line")
        self._heard: list[bytes] = []
        self._host = self.world.add_line_host("line", "host", self._hear)
        if boot:
            self.run_ms(600)

    def _hear(self, data: bytes, now_ns: int, transmitted: bool) -> None:
        if not transmitted:
            self._heard.append(data)

    def run_ms(self, time_ms: float) -> None:
        self.world.queue.run_until(self.world.queue.now_ns + round(time_ms * MS))

    def ask(self, pdu: str) -> bytes:
        """Return the response PDU."""
        self._heard.clear()
        self._host.send(with_crc(b"\x01" + bytes.fromhex(pdu)))
        self.run_ms(20)
        (answer,) = self._heard
        assert with_crc(answer[:-2]) == answer
        if answer[1] & 0x80:
            raise Refused(f"{answer[2]:02X}h")
        return answer[1:-2]

    def read(self, address: int, words: int = 1) -> int:
        data = self.ask(f"03 {address:04X} {words:04X}")[2:]
        return int.from_bytes(data, "big", signed=words == 2)

    def write(self, address: int, *values: int) -> None:
        if len(values) == 1:
            self.ask(f"06 {address:04X} {values[0] & 0xFFFF:04X}")
            return
        data = "".join(f"{value & 0xFFFF:04X}" for value in values)
        self.ask(f"10 {address:04X} {len(values):04X} {2 * len(values):02X} {data}")

    def write_32(self, address: int, value: int) -> None:
        self.write(address, value >> 16, value)

    def truth(self) -> Mapping[str, float]:
        return self.world.snapshot("drive")

    def stimulate(self, name: str, value: float) -> None:
        self.world.stimulate("drive", name, value)

    def told(self) -> list[str]:
        return [text for _, text in self.events]
