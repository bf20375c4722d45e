"""Drives on a physical bus, and a host's port with handmade frames.

Frames are written as candump writes them, "601#4041600000000000"; a remote frame ends in "#R". This
module does not use the CANopen code under test: bytes are packed with struct.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.emulators.cia401.node import build as build_io_node
from motorhil.emulators.cia402.drive import build as build_drive
from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

US = 1_000
MS = 1_000_000
BOOT_UP = 300 * MS
RTR = 0x4000_0000

Heard = tuple[int, str, str]
"""A frame on the bus: (end of frame [ns], sender, frame)."""


def frame(text: str) -> bytes:
    """Return the can_frame of "id#data"."""
    head, _, tail = text.partition("#")
    can_id = int(head, 16) | (0x8000_0000 if len(head) > 3 else 0)
    if tail.startswith("R"):
        return struct.pack("<IB3x8s", can_id | RTR, int(tail[1:] or "0"), b"")
    data = bytes.fromhex(tail)
    return struct.pack("<IB3x8s", can_id, len(data), data)


def text_of(raw: bytes) -> str:
    """Return a can_frame in the notation of `frame`."""
    can_id, length, data = struct.unpack("<IB3x8s", raw)
    if can_id & RTR:
        return f"{can_id & 0x7FF:03X}#R{length}"
    return f"{can_id:03X}#{data[:length].hex().upper()}"


class Wire:
    """One bus with drives by node-ID, a host, and a log of all frames.

    A table with `kind` "cia401" describes an I/O node.
    """

    def __init__(self, *drives: dict, bitrate: int = 1_000_000, seed: int = 1) -> None:
        self.queue = EventQueue()
        self.world = World(self.queue)
        self.bus = CanBus("can0", bitrate, FaultPlan([], Random(f"{seed}:faults").random))
        self.world.add_bus(self.bus)
        self.log: list[Heard] = []
        self.events: list[tuple[int, str, str, str]] = []
        self.listeners: list[Callable[[bytes, int], None]] = []
        self.world.tap_frames(
            lambda bus, now_ns, sender, raw: self.log.append((now_ns, sender, text_of(raw)))
        )
        self.world.tap_events(lambda *event: self.events.append(event))
        for table in drives or ({"node_id": 5},):
            name = f"n{table['node_id']}"
            settings = {key: value for key, value in table.items() if key != "kind"}
            build = build_io_node if table.get("kind") == "cia401" else build_drive
            core = build(settings, ControllerContext(name=name, folder=Path(), seed=seed))
            self.world.add_controller(name, core, "can0")
        self.host = self.world.add_host("can0", "host", self._heard)

    def _heard(self, raw: bytes, now_ns: int, transmitted: bool) -> None:
        if not transmitted:
            for listener in self.listeners:
                listener(raw, now_ns)

    # --- time

    @property
    def now(self) -> int:
        return self.queue.now_ns

    def run(self, duration_ns: int) -> None:
        self.queue.run_until(self.now + duration_ns)

    def run_to(self, time_ns: int) -> None:
        self.queue.run_until(time_ns)

    def run_while(self, condition: Callable[[], object], timeout_ns: int = 20_000 * MS) -> bool:
        """Run event by event; return whether the condition ended before `timeout_ns`."""
        end = self.now + timeout_ns
        while condition():
            due = self.queue.next_time_ns()
            if due is None or due > end:
                self.queue.run_until(end)
                return False
            self.queue.run_next()
        return True

    # --- frames

    def send(self, *texts: str) -> None:
        for text in texts:
            self.host.send(frame(text))

    def tell(self, *texts: str) -> None:
        """Send a frame and wait until it is on the wire."""
        self.send(*texts)
        self.run_while(lambda: self.bus.pending(self.host.port), 100 * MS)

    def since(self, count: int = 0, sender: str | None = None) -> list[str]:
        """Return frames from number `count` of the log on; of all but the host, or of one."""
        return [
            text
            for _, who, text in self.log[count:]
            if (who != "host" if sender is None else who == sender)
        ]

    def times(self, can_id: int, since: int = 0) -> list[int]:
        """Return the end times of frames with this identifier."""
        return [time for time, _, text in self.log[since:] if text.startswith(f"{can_id:03X}#")]

    def ask(self, text: str, within_ns: int = 20 * MS) -> str:
        """Return the response to an SDO request, or "" without one."""
        answer = f"{int(text[:3], 16) - 0x80:03X}#"
        count = len(self.log)
        self.send(text)

        def found() -> list[str]:
            return [line for line in self.since(count) if line.startswith(answer)]

        self.run_while(lambda: not found(), within_ns)
        return found()[0] if found() else ""

    # --- handmade CANopen

    def boot(self) -> "Wire":
        self.run_to(BOOT_UP + MS)
        return self

    def operational(self, node: int = 5) -> "Wire":
        if self.now < BOOT_UP:
            self.boot()
        self.tell(f"000#01{node:02X}")
        return self

    def read(self, index: int, subindex: int = 0, node: int = 5, signed: bool = False) -> int:
        place = struct.pack("<HB", index, subindex).hex()
        answer = self.ask(f"{0x600 + node:03X}#40{place}00000000")
        data = bytes.fromhex(answer[4:])
        assert data[0] & 0xE3 == 0x43, f"{index:04X}h:{subindex}: {answer}"
        return int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little", signed=signed)

    def write(self, index: int, subindex: int, value: int, size: int, node: int = 5) -> int:
        """Write an object and return 0, or the abort code."""
        head = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        data = (value & ((1 << 8 * size) - 1)).to_bytes(4, "little")
        answer = bytes.fromhex(self.ask(f"{0x600 + node:03X}#{(head + data).hex()}")[4:])
        assert answer[1:4] == head[1:], answer.hex()
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def set(self, index: int, subindex: int, value: int, size: int, node: int = 5) -> None:
        code = self.write(index, subindex, value, size, node)
        assert code == 0, f"{index:04X}h:{subindex} := {value} refused: {code:08X}h"

    def statusword(self, node: int = 5) -> int:
        return self.read(0x6041, 0, node)

    def controlword(self, word: int, node: int = 5) -> None:
        self.tell(f"{0x200 + node:03X}#{word.to_bytes(2, 'little').hex()}")

    def enable(self, mode: int | None = None, node: int = 5) -> "Wire":
        self.operational(node)
        if mode is not None:
            self.set(0x6060, 0, mode, 1, node)
        for word in (0x06, 0x07, 0x0F):
            self.controlword(word, node)
        self.run(21 * MS)
        assert self.statusword(node) & 0x6F == 0x27
        return self

    def inject(self, rule: FaultRule) -> None:
        self.world.inject("can0", rule)

    def stimulate(self, name: str, value: float, node: int = 5) -> None:
        self.world.stimulate(f"n{node}", name, value)

    def truth(self, key: str, node: int = 5) -> float:
        return self.world.snapshot(f"n{node}")[key]
