"""A bench for one drive: it advances time, keeps sent frames, and speaks plain CANopen.

Frames are packed and unpacked here with struct only. A test's bytes are thus those of the
standard, not those of the code under test.
"""

import struct
from collections.abc import Mapping
from pathlib import Path

from motorhil.emulators.cia402.drive import Cia402Drive, build
from motorhil.emulators.controller import ControllerContext

MS = 1_000_000
NODE = 5
BOOT_UP = 300 * MS
ENABLE = 20 * MS


def can_frame(can_id: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data), data)


def new_drive(folder: Path = Path(), **settings: object) -> Cia402Drive:
    table: Mapping[str, object] = {"node_id": NODE, **settings}
    drive = build(table, ControllerContext(name="drive", folder=folder, seed=1))
    assert isinstance(drive, Cia402Drive)
    return drive


class Bench:
    """A drive, the time `now` [ns], and `sent`: (time, identifier, data) of every sent frame."""

    def __init__(self, drive: Cia402Drive | None = None, **settings: object) -> None:
        self.drive = new_drive(**settings) if drive is None else drive
        self.now = 0
        self.sent: list[tuple[int, int, bytes]] = []
        self.events: list[tuple[str, str]] = []
        self.drive.start(0)
        self._drain()

    # --- time

    def run(self, duration_ns: int) -> None:
        self.run_until(self.now + duration_ns)

    def run_until(self, time_ns: int) -> None:
        due = self.drive.next_deadline_ns()
        while due is not None and due <= time_ns:
            self.now = max(due, self.now)  # a deadline in the past means now, as in the event queue
            self.drive.expire(self.now)
            self._drain()
            due = self.drive.next_deadline_ns()
            assert due is None or due > self.now, "expire did not advance its deadline"
        self.now = time_ns

    def run_while(self, condition, timeout_ns: int = 20_000 * MS) -> None:
        """Advance from one deadline to the next, until `condition` is false."""
        end = self.now + timeout_ns
        while condition():
            due = self.drive.next_deadline_ns()
            assert due is not None, "no deadline to wait for"
            assert due <= end, "timeout"
            self.run_until(due)

    def _drain(self) -> None:
        frames = self.drive.take_output()
        while frames:
            for frame in frames:
                can_id, size, data = struct.unpack("<IB3x8s", frame)
                self.sent.append((self.now, can_id, data[:size]))
                self.drive.sent(frame, self.now)
            frames = self.drive.take_output()
        self.events.extend(self.drive.take_events())

    # --- frames

    def send(self, can_id: int, data: bytes) -> None:
        self.drive.receive(can_frame(can_id, data), self.now)
        self._drain()

    def last(self, can_id: int) -> bytes:
        return next(data for _, sent_id, data in reversed(self.sent) if sent_id == can_id)

    def times(self, can_id: int) -> list[int]:
        return [time for time, sent_id, _ in self.sent if sent_id == can_id]

    def hex_since(self, count: int) -> list[str]:
        return [f"{can_id:03X}#{data.hex().upper()}" for _, can_id, data in self.sent[count:]]

    # --- CANopen, by hand

    def boot(self) -> None:
        self.run_until(BOOT_UP)

    def nmt(self, command: int, node: int = NODE) -> None:
        self.send(0x000, bytes((command, node)))

    def sync(self) -> None:
        self.send(0x080, b"")

    def _sdo(self, request: bytes) -> bytes:
        count = len(self.sent)
        self.send(0x600 + NODE, request)
        self.run_while(lambda: all(entry[1] != 0x580 + NODE for entry in self.sent[count:]))
        return next(data for _, can_id, data in self.sent[count:] if can_id == 0x580 + NODE)

    def read(self, index: int, subindex: int = 0, *, signed: bool = True) -> int:
        reply = self._sdo(struct.pack("<BHB4x", 0x40, index, subindex))
        assert reply[0] & 0xE3 == 0x43, f"{index:04X}h:{subindex} refused: {reply.hex()}"
        size = 4 - (reply[0] >> 2 & 3)
        return int.from_bytes(reply[4 : 4 + size], "little", signed=signed)

    def statusword(self) -> int:
        return self.read(0x6041, signed=False)

    def write(self, index: int, subindex: int, value: int, size: int) -> int:
        """Write an object; return 0, or the abort code."""
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        command = 0x23 | (4 - size) << 2
        reply = self._sdo(struct.pack("<BHB", command, index, subindex) + data)
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0

    def set(self, index: int, subindex: int, value: int, size: int) -> None:
        code = self.write(index, subindex, value, size)
        assert code == 0, f"{index:04X}h:{subindex} := {value} refused: {code:08X}h"

    def controlword(self, word: int) -> None:
        self.send(0x200 + NODE, struct.pack("<H", word))

    def operational(self) -> None:
        self.boot()
        self.nmt(0x01)

    def enable(self, mode: int | None = None) -> None:
        """Make the drive operational, select a mode and enable operation through RPDO 1."""
        if self.now < BOOT_UP:
            self.operational()
        if mode is not None:
            self.set(0x6060, 0, mode, 1)
        for word in (0x06, 0x07, 0x0F):
            self.controlword(word)
        self.run(ENABLE)
        assert self.drive.snapshot(self.now)["state"] == 4

    def truth(self, key: str) -> float:
        return self.drive.snapshot(self.now)[key]
