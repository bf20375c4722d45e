"""Frames and bytes at every kind of emulated controller.

A controller must raise nothing, ask for no call in the past, send a bounded number of frames for
one input, and answer afterwards. The digest covers all that it sent, with its times: pure and
compiled cores must have the same one.
"""

import hashlib
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from random import Random
from typing import Final, final

from motorhil.emulators.can.frame import EFF_FLAG, FD_LENGTHS, RTR_FLAG, data_of, pack, pack_fd
from motorhil.emulators.cia401.node import IoNode
from motorhil.emulators.cia401.node import build as build_io_node
from motorhil.emulators.cia402.drive import build as build_drive
from motorhil.emulators.controller import STUCK, Controller, ControllerContext
from motorhil.emulators.dryve.drive import build as build_dryve
from motorhil.emulators.dynamixel.packets import BROADCAST, HEADER, Instruction, packet
from motorhil.emulators.dynamixel.servo import Servo
from motorhil.emulators.dynamixel.servo import build as build_servo
from motorhil.emulators.leadshine_pr.drive import build as build_leadshine
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.mit.classical import build as build_mit
from motorhil.emulators.mit.robstride import build as build_robstride
from motorhil.emulators.mit.settings import MODELS as MIT_MODELS
from motorhil.emulators.mit.settings import ROBSTRIDES
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.modbus.tcp import adu
from motorhil.emulators.moteus.drive import build as build_moteus
from motorhil.emulators.oriental_az.drive import build as build_oriental
from motorhil.emulators.rmd.drive import build as build_rmd
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.emulators.vesc.drive import build as build_vesc
from motorhil.harness.replay.device_node import build as build_recorded
from tests.attack.campaign import Attack, Attempt, Done
from tests.properties.fuzz.__main__ import OUT
from tests.properties.fuzz.frames import Frames, frame, line_of
from tests.properties.fuzz.target import Reached, endure, episode, shrunk
from tests.support.checkout import CHECKOUT
from tests.support.cia402.stranger import LIGHT, OBJECTS

EPISODE: Final = 1_000
"""Number of inputs to one controller."""
ANSWERS_MAX: Final = 300
"""Frames for one input: a block upload of SDO has 127 segments, a queue of TPDOs and EMCYs more."""
GOLDEN: Final = CHECKOUT / "traces" / "golden"
MS: Final = 1_000_000
NODE: Final = 5
UNIT: Final = 1
REPLY_BY_NS: Final = 50 * MS
_PAUSES_NS: Final = (0, 0, 1, 300_000, 2 * MS, 5 * MS, 20 * MS)
_FUNCTIONS: Final = (0x03, 0x03, 0x06, 0x06, 0x10, 0x10, 0x17, 0x08, 0x2B, 0x01, 0x04)
_VALUES: Final = tuple(one.to_bytes(2) for one in (0, 1, 2, 5, 0x10, 0x7FFF, 0x8000, 0xFFFF))
_MIT_FRAMES: Final = (
    *(b"\xff" * 7 + bytes((code,)) for code in (0xFC, 0xFD, 0xFE, 0xFB, 0xFF)),
    *(bytes((NODE, 0, code, one, 0, 0, 0x80, 0x3F)) for code in (0x33, 0x55) for one in (9, 21)),
    bytes((NODE, 0, 0xCC, 0, 0, 0, 0, 0)),
    *(bytes.fromhex(f"{i}7000000000C03F") for i in ("05", "06", "0A", "16", "17", "18", "19")),
)
_INPUTS: Final = (
    *(("fault", 0x2310), ("alarm", 0x30), ("load_torque_n_m", 3.0), ("load_torque_n_m", 0.0)),
    *(("supply_v", 24.0), ("supply_v", 5.0), ("power", 0.0), ("power", 1.0), ("encoder", 0.0)),
)

_ITEMS: Final = (  # addresses of a servo
    *(0, 7, 8, 9, 10, 11, 12, 20, 24, 31, 36, 38, 44, 48, 52, 60, 63, 64, 64, 68, 98, 98, 100),
    *(102, 104, 104, 108, 112, 116, 116, 122, 132, 168, 170, 208, 224, 9999),
)
_GATEWAY_OBJECTS: Final = (  # of a dryve: index, sub-index, bytes
    *((index, 0, 1) for index in (0x1001, 0x6060, 0x6060, 0x6061, 0x6098)),
    *((index, 0, 2) for index in (0x2014, 0x6040, 0x6040, 0x6040, 0x6040, 0x6041)),
    *((index, 0, 4) for index in (0x6064, 0x607A, 0x607A, 0x6081, 0x6083, 0x6084, 0x60A8, 0x60FF)),
    *((index, 1, 4) for index in (0x607B, 0x6092, 0x6099)),
)
_TO_ALL: Final = tuple(one for one in Instruction if one >= Instruction.SYNC_READ)


@final
class Bare:
    """A controller alone: its medium sends every frame at once."""

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self.now_ns = 0
        self.sent: list[bytes] = []
        self.digest = hashlib.sha256()
        controller.start(0)
        self._drain()

    def tell(self, data: bytes) -> None:
        """Pass a frame to the controller now."""
        self.controller.receive(data, self.now_ns)
        self._drain()

    def stimulate(self, name: str, value: float) -> None:
        """Set an input, if the controller has it and accepts the value."""
        with suppress(ValueError):
            self.controller.stimulate(name, value, self.now_ns)
        self._drain()

    def run(self, duration_ns: int) -> None:
        """Let time pass, deadline by deadline."""
        end_ns = self.now_ns + duration_ns
        due_ns = self.controller.next_deadline_ns()
        calls = 0
        while due_ns is not None and due_ns <= end_ns:
            calls = 0 if due_ns > self.now_ns else calls + 1
            assert calls < STUCK, f"expire at {self.now_ns} ns does not advance its deadline"
            self.now_ns = max(due_ns, self.now_ns)
            self.controller.expire(self.now_ns)
            self._drain()
            due_ns = self.controller.next_deadline_ns()
        self.now_ns = end_ns

    def _drain(self) -> None:
        count = 0
        frames = self.controller.take_output()
        while frames:
            for one in frames:
                count += 1
                assert count <= ANSWERS_MAX, f"more than {ANSWERS_MAX} frames for one input"
                self.sent.append(one)
                self.digest.update(b"%d " % self.now_ns + one)
                self.controller.sent(one, self.now_ns)
            frames = self.controller.take_output()
        for level, text in self.controller.take_events():
            self.digest.update(f"{level}{text}".encode())
        due_ns = self.controller.next_deadline_ns()
        assert due_ns is None or due_ns >= self.now_ns, (
            f"the deadline {due_ns} ns is before now, {self.now_ns} ns"
        )


def _context() -> ControllerContext:
    return ControllerContext("it", GOLDEN, 1)


def _drive() -> Controller:
    table = {"node_id": NODE, "objects": OBJECTS, "timing": {"boot_up_s": 0.01}, "plant": LIGHT}
    return build_drive(table, _context())


def _io_node() -> IoNode:
    node = build_io_node({"node_id": NODE, "channels": 2, "plant": LIGHT}, _context())
    assert isinstance(node, IoNode)
    return node


def _recorded(file: str, **settings: object) -> Controller:
    return build_recorded({"recording": file, **settings}, _context())


def _to(node: int, can_id: int, data: bytes) -> bytes:
    """Return the frame, which is for NODE, for this node."""
    if node != NODE and can_id & 0x7F == NODE:
        can_id = can_id & ~0x7F | node
    if node != NODE and can_id == 0 and data[1:] == bytes((NODE,)):
        data = data[:1] + bytes((node,))
    return frame(can_id, data)


def attack_node(build: Callable[[], Controller], seed: str, own: int = NODE) -> Done:
    """Send CAN frames to a node; then reset it and ask for its device type."""
    bare = Bare(build())
    dictionary = getattr(bare.controller, "od", None) or _io_node().od
    bare.run(400 * MS)
    bare.tell(frame(0x000, b"\x01\x00"))
    for pause_ns, can_id, what in Frames(seed, dictionary).take(EPISODE):
        bare.run(pause_ns)
        if isinstance(what, bytes):
            bare.tell(_to(own, can_id, what))
        else:
            name, _, value = str(what).partition(" ")
            bare.stimulate(name, float(value))
    reached = Counter(answers=len(bare.sent))
    bare.run(1_000 * MS)
    bare.sent.clear()
    bare.tell(frame(0x000, b"\x81\x00"))
    bare.run(1_000 * MS)
    heard = [struct.unpack("<IB3x8s", one) for one in bare.sent]
    node = next((can_id & 0x7F for can_id, _, _ in heard if can_id >> 7 == 14), own)
    bare.sent.clear()
    bare.tell(frame(0x600 + node, struct.pack("<BHB4x", 0x40, 0x1000, 0)))
    bare.run(REPLY_BY_NS)
    answers = [one for one in bare.sent if one[:4] == struct.pack("<I", 0x580 + node)]
    assert len(answers) == 1, f"1000h has {len(answers)} answers after reset node"
    assert not any(one[3] & RTR_FLAG >> 24 for one in bare.sent)
    return Done(EPISODE, bare.digest.digest(), reached)


_SUBFRAMES: Final = tuple(
    map(
        bytes.fromhex,
        (
            *("01000a", "010000", "01000c", "01000f", "010009", "01000d", "0e20000000400000803f"),
            *("0d20", "0d270000c07f", "0f28000040400000004000000000", "04042000", "1100", "1f01"),
            *(
                "130d",
                "1d38",
                "1a8102",
                "14201e",
                "18ff7f20",
                "0db102",
                "01b30201",
                "09d402",
                "0d2900000000",
            ),
            *("400107642073746f700a", "420130", "30", "50", "43010000", "0e40000080bf0000803f"),
        ),
    )
)


def attack_moteus(seed: str) -> Done:
    """Send subframes, complete and damaged, to a moteus; then stop it and read its mode."""
    dice = Random(seed)
    bare = Bare(build_moteus({"node_id": NODE, "plant": LIGHT}, _context()))
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.01:
            bare.stimulate(*dice.choice((*_INPUTS, ("fault", 38.0))))
        data = b"".join(dice.choice(_SUBFRAMES) for _ in range(dice.randrange(6)))
        data = (damaged(dice, data) if data else dice.randbytes(5))[: FD_LENGTHS[-1]]
        length = min(one for one in FD_LENGTHS if one >= len(data))
        can_id = dice.choice((0x8000, 0x8000, 0x0000, 0x0300)) | dice.choice((NODE, NODE, 0x7F, 1))
        can_id |= EFF_FLAG if can_id > 0x7FF else 0
        is_classical = length <= 8 and dice.random() < 0.5
        bare.tell(pack(can_id, data) if is_classical else pack_fd(can_id, data.ljust(length, b"P")))
    reached = Counter(answers=len(bare.sent))
    bare.stimulate("power", 1.0)
    bare.run(1_000 * MS)
    bare.tell(pack(NODE, bytes.fromhex("010000")))
    bare.sent.clear()
    bare.tell(pack(EFF_FLAG | 0x8000 | NODE, bytes.fromhex("1100")))
    assert [data_of(one) for one in bare.sent] == [bytes.fromhex("210000")]
    return Done(EPISODE, bare.digest.digest(), reached)


def attack_mit(build: Callable[..., Controller], models: Sequence[str], seed: str) -> Done:
    """Send commands, special codes and parameters to a drive; then stop it and read its state."""
    dice = Random(seed)
    model = dice.choice(models)
    is_long = model in ROBSTRIDES
    table = {"node_id": NODE, "model": model, "plant": LIGHT, "watchdog_s": 0.01}
    bare = Bare(build(table, _context()))
    kinds = (1, 1, 1, 3, 3, 4, 6, 0, 17, 18, 18, 2, 21)
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.01:
            bare.stimulate(*dice.choice((*_INPUTS, ("fault", 2.0), ("fault", 10.0))))
        data = damaged(dice, dice.choice((dice.randbytes(8), dice.choice(_MIT_FRAMES))))[:8]
        can_id = dice.choice((NODE, NODE, NODE, 0x7FF, 0))
        if is_long and dice.random() < 0.95:
            can_id = EFF_FLAG | dice.choice(kinds) << 24 | dice.randrange(1 << 16) << 8 | can_id & 7
        bare.tell(pack(can_id, data))
    reached = Counter(answers=len(bare.sent))
    bare.stimulate("power", 0.0)
    bare.stimulate("power", 1.0)
    bare.run(3_000 * MS)
    bare.sent.clear()
    number = getattr(bare.controller, "node_id", NODE)  # a frame may have changed it
    bare.tell(pack(EFF_FLAG | 0x400AA00 | number if is_long else NODE, _MIT_FRAMES[1]))
    assert len(bare.sent) == 1, f"{model}: {len(bare.sent)} answers"
    return Done(EPISODE, bare.digest.digest(), reached)


def pdus(dice: Random, addresses: list[int]) -> Iterator[bytes]:
    """Yield requests around the addresses of a drive, valid ones and invalid ones."""
    while True:
        function = dice.choice(_FUNCTIONS) if dice.random() < 0.97 else dice.randrange(256)
        address = (dice.choice(addresses) + dice.choice((0, 0, 0, 1))) & 0xFFFF
        count = dice.choice((1, 1, 2, 4, 125))
        values = b"".join(_VALUES[byte & 7] for byte in dice.randbytes(count))
        head = bytes((function,)) + address.to_bytes(2, "big")
        if function == 0x06:
            yield head + values[:2]
        elif function == 0x10:
            yield head + count.to_bytes(2, "big") + bytes((2 * count & 0xFF,)) + values
        elif function == 0x17:
            writes = count.to_bytes(2, "big") + bytes((2 * count & 0xFF,)) + values
            yield head + b"\0\1" + address.to_bytes(2, "big") + writes
        elif function == 0x2B:
            yield bytes((function, 0x0E, dice.randrange(6), dice.randrange(8)))
        else:
            yield head + count.to_bytes(2, "big") + dice.randbytes(dice.choice((0, 0, 0, 3)))


def damaged(dice: Random, data: bytes) -> bytes:
    """Return data cut, extended, with a flipped bit, or quite different; mostly unchanged."""
    chance = dice.random()
    if chance < 0.02:
        return data[: dice.randrange(len(data))]
    if chance < 0.04:
        return data + dice.randbytes(9)
    if chance < 0.06:
        place = dice.randrange(8 * len(data))
        turned = int.from_bytes(data, "little") ^ 1 << place
        return turned.to_bytes(len(data), "little")
    if chance < 0.07:
        return dice.randbytes(dice.randrange(300))
    return data


def attack_unit(build: Callable[[], Controller], addresses: list[int], seed: str) -> Done:
    """Send serial frames to a unit, then read a register."""
    dice = Random(seed)
    bare = Bare(build())
    bare.run(600 * MS)
    requests = pdus(dice, addresses)
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.01:
            bare.stimulate(*dice.choice(_INPUTS))
        unit = bytes((dice.choice((UNIT, UNIT, UNIT, UNIT, 0, 2)),))
        bare.tell(damaged(dice, with_crc(unit + next(requests)[:253])))
    reached = Counter(answers=len(bare.sent))
    reached.update("refusals" for one in bare.sent if one[1] & 0x80)
    assert all(with_crc(one[:-2]) == one for one in bare.sent), "an answer has a wrong CRC"
    bare.stimulate("power", 1.0)
    bare.run(2_000 * MS)
    bare.sent.clear()
    bare.tell(with_crc(bytes((UNIT, 3)) + addresses[0].to_bytes(2, "big") + b"\0\1"))
    bare.run(REPLY_BY_NS)
    assert len(bare.sent) == 1, f"a read has {len(bare.sent)} answers"
    return Done(EPISODE, bare.digest.digest(), reached)


def instructions(dice: Random) -> Iterator[bytes]:
    """Yield packets for a servo and for others, valid ones and invalid ones, and statuses."""
    while True:
        address = dice.choice(_ITEMS) + dice.choice((0, 0, 0, 1))
        size = dice.choice((1, 1, 2, 4, 4, 4, 8, 80, 200))
        value = dice.choice((*range(16), 255, 0x7FFF, 1 << 31, (1 << 32) - 1))
        data = value.to_bytes(4, "little") * 64
        place, length = address.to_bytes(2, "little"), size.to_bytes(2, "little")
        units = bytes(dice.choice((UNIT, 2, 3, dice.randrange(256))) for _ in range(3))
        bodies = {
            Instruction.READ: place + length,
            Instruction.WRITE: place + data[:size],
            Instruction.REG_WRITE: place + data[:size],
            Instruction.FACTORY_RESET: bytes((dice.choice((1, 2, 255, 3)),)),
            Instruction.CLEAR: b"\x01DXL\x22",
            Instruction.BACKUP: bytes((dice.choice((1, 2)),)) + b"CTRL",
            Instruction.SYNC_READ: place + length + units,
            Instruction.FAST_SYNC_READ: place + length + units,
            Instruction.SYNC_WRITE: place + b"\4\0" + units[:1] + data[:4] + units[1:2] + data[:4],
            Instruction.BULK_READ: b"".join(bytes((one,)) + place + length for one in units),
            Instruction.FAST_BULK_READ: b"".join(bytes((one,)) + place + length for one in units),
            Instruction.BULK_WRITE: units[:1] + place + length + data[:size],
        }
        code = dice.choice(tuple(Instruction)) if dice.random() < 0.9 else dice.choice((0x55, 0x42))
        unit = BROADCAST if code in _TO_ALL else dice.choice((UNIT, UNIT, UNIT, BROADCAST, 2))
        yield packet(unit, code, bodies.get(code, b"" if dice.random() < 0.9 else data[:size]))


def attack_servo(seed: str) -> Done:
    """Send bytes of Dynamixel's protocol, split anywhere, to a servo; then ping it."""
    dice = Random(seed)
    servo = build_servo({"unit": UNIT, "boot_up_s": 0.01}, _context())
    bare = Bare(servo)
    bare.run(20 * MS)
    packets = instructions(dice)
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.01:
            bare.stimulate(*dice.choice((*_INPUTS, ("fault", 32), ("temperature_c", 99))))
        data = damaged(dice, next(packets))
        cut = dice.randrange(len(data) + 1) if dice.random() < 0.1 else len(data)
        for part in (data[:cut], data[cut:]):
            if part:
                bare.tell(part)
    reached = Counter(answers=len(bare.sent))
    reached.update("refusals" for one in bare.sent if one[:4] == HEADER and one[8] & 0x7F)
    bare.stimulate("power", 0.0)
    bare.stimulate("power", 1.0)
    bare.run(2_000 * MS)
    bare.sent.clear()
    assert isinstance(servo, Servo)
    bare.tell(packet(servo.memory["id"], Instruction.PING))
    bare.run(REPLY_BY_NS)
    assert len(bare.sent) == 1, f"a ping has {len(bare.sent)} answers"
    return Done(EPISODE, bare.digest.digest(), reached)


def telegrams(dice: Random) -> Iterator[bytes]:
    """Yield PDUs for a dryve: objects read and written, valid ones and invalid ones."""
    while True:
        index, subindex, size = dice.choice(_GATEWAY_OBJECTS)
        if dice.random() < 0.1:
            index, subindex, size = index + 1, dice.randrange(4), dice.randrange(6)
        value = dice.choice((*range(12), 0x0F, 0x1F, 0x3F, 0x80, 0x10F, 5400, 1 << 31))
        writes = 2 if dice.random() < 0.02 else dice.choice((0, 1, 1))
        data = value.to_bytes(8, "little")[:size] if writes else b""
        place = index.to_bytes(2, "big") + bytes((subindex, 0, 0, 0, size))
        yield bytes((0x2B, 0x0D, writes, 0, 0)) + place + data


def attack_dryve(seed: str) -> Done:
    """Send telegrams to a dryve, one before the answer to another; then read its statusword."""
    dice = Random(seed)
    bare = Bare(build_dryve({"unit": UNIT, "timing": {"boot_up_s": 0.01}}, _context()))
    bare.run(20 * MS)
    requests = telegrams(dice)
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.02:
            bare.stimulate(*dice.choice((*_INPUTS, ("di7", 0.0), ("di7", 1.0), ("di8", 1.0))))
        bare.tell(with_crc(bytes((UNIT,)) + (damaged(dice, next(requests)) or b"\x2b")))
    reached = Counter(answers=len(bare.sent))
    reached.update("refusals" for one in bare.sent if one[1] & 0x80)
    assert all(with_crc(one[:-2]) == one for one in bare.sent), "an answer has a wrong CRC"
    bare.run(2_000 * MS)
    bare.sent.clear()
    bare.tell(with_crc(bytes.fromhex("01 2B 0D 00 00 00 60 41 00 00 00 00 02")))
    bare.run(REPLY_BY_NS)
    assert len(bare.sent) == 1, f"a read has {len(bare.sent)} answers"
    assert bare.sent[0][:13].hex() == "012b0d00000060410000000002", "it is not the statusword"
    return Done(EPISODE, bare.digest.digest(), reached)


def attack_gateway(build: Callable[[], Controller], addresses: list[int], seed: str) -> Done:
    """Send bytes of Modbus/TCP, split anywhere, to a unit; then read one of its registers."""
    dice = Random(seed)
    world = World(EventQueue())
    world.add_tcp(BytePipe("line"), None)
    world.add_controller("it", build(), "line")
    digest = hashlib.sha256()
    reached: Counter[str] = Counter()
    is_closed = True

    def hear(data: bytes, now_ns: int, transmitted: bool) -> None:
        nonlocal is_closed
        digest.update(b"%d " % now_ns + data)
        reached["answers" if data else "disconnected"] += 1
        is_closed = is_closed or not data

    def run(duration_ns: int) -> None:
        world.queue.run_until(world.queue.now_ns + duration_ns)

    run(600 * MS)
    requests = pdus(dice, addresses)
    waiting = b""
    for number in range(EPISODE):
        if is_closed:
            is_closed, waiting = False, b""
            host = world.add_line_host("line", "host", hear)
        waiting += damaged(dice, adu(number, dice.choice((UNIT, UNIT, 0, 2)), next(requests)))
        size = len(waiting) if dice.random() < 0.8 else dice.randrange(len(waiting) + 1)
        if size:
            host.send(waiting[:size])
        waiting = waiting[size:]
        run(dice.choice(_PAUSES_NS))
    run(3_000 * MS)
    heard: list[bytes] = []
    host = world.add_line_host("line", "last", lambda data, now_ns, transmitted: heard.append(data))
    host.send(adu(7, UNIT, b"\x03" + addresses[0].to_bytes(2, "big") + b"\0\1"))
    run(2_000 * MS)
    assert len(heard) == 1, f"a read has {len(heard)} answers"
    assert heard[0][:2] == b"\0\7", "the answer is that to another request"
    return Done(EPISODE, digest.digest(), reached)


Ask = Callable[[int], tuple[bytes, bytes]]
"""Returns (question, answer) by the first identifier of a drive, which commands may change."""


def attack_identifiers(build: Callable[[], Controller], ask: Ask, seed: str) -> Done:
    """Send any data under the identifiers of a drive; then restart it, and ask it.

    It is asked twice: a drive that was interrupted does not obey the first request.
    """
    dice = Random(seed)
    bare = Bare(build())
    for _ in range(EPISODE):
        bare.run(dice.choice(_PAUSES_NS))
        if dice.random() < 0.01:
            bare.stimulate(*dice.choice(_INPUTS))
        if dice.random() < 0.1:
            bare.stimulate("power", 1.0)  # a command may switch it off
        size = dice.choice((8, 8, 6, 5, 4, 4, *range(9)))
        data = bytes(dice.choice((0, 0, 1, 0xFF, dice.randrange(256))) for _ in range(size))
        bare.tell(frame(dice.choice(list(bare.controller.identifiers() or (0,))), data))
    reached = Counter(answers=len(bare.sent))
    for power in (0.0, 1.0):
        bare.stimulate("power", power)
    bare.run(2_000 * MS)
    bare.sent.clear()
    question, answer = ask((bare.controller.identifiers() or (0,))[0])
    bare.tell(question)
    bare.tell(question)
    bare.run(REPLY_BY_NS)
    assert answer in bare.sent, "the question has no answer"
    return Done(EPISODE, bare.digest.digest(), reached)


def _ask_vesc(first: int) -> tuple[bytes, bytes]:
    """Return PING from 253, and PONG."""
    return frame(first & ~0xFF00 | 0x1100, b"\xfd"), frame(0x8000_12FD, bytes((first & 0xFF, 0)))


def _ask_rmd(first: int) -> tuple[bytes, bytes]:
    """Return a request for the phase currents (9Dh), and an answer without any, at 25 degrees."""
    return frame(first, b"\x9d" + bytes(7)), frame(first + 0x100, b"\x9d\x19" + bytes(6))


def _addresses(builder: object) -> list[int]:
    return [row.address for row in builder.registers()]  # type: ignore[attr-defined]  # a builder


def _kinds() -> dict[str, Callable[[str], Done]]:
    kinds: dict[str, Callable[[str], Done]] = {
        "cia402": partial(attack_node, _drive),
        "cia401": partial(attack_node, _io_node),
        "recorded": partial(attack_node, partial(_recorded, "cia402.mcap", node_id=1), own=1),
        "moteus": attack_moteus,
    }
    vesc = partial(build_vesc, {"node_id": NODE, "status_1": 63}, _context())
    kinds["vesc"] = partial(attack_identifiers, vesc, _ask_vesc)
    rmd = partial(build_rmd, {"node_id": NODE, "interruption_ms": 50}, _context())
    kinds["rmd"] = partial(attack_identifiers, rmd, _ask_rmd)
    for name, build in (("leadshine_pr", build_leadshine), ("oriental_az", build_oriental)):
        made = partial(build, {"unit": UNIT}, _context())
        kinds[name] = partial(attack_unit, made, _addresses(build))
        kinds[f"{name} on TCP"] = partial(attack_gateway, made, _addresses(build))
    kinds["dynamixel"] = attack_servo
    kinds["dryve"] = attack_dryve
    unit = partial(_recorded, "leadshine.mcap", unit=UNIT)
    kinds["recorded unit"] = partial(attack_unit, unit, _addresses(build_leadshine))
    kinds["mit"] = partial(attack_mit, build_mit, tuple(MIT_MODELS))
    kinds["robstride"] = partial(attack_mit, build_robstride, tuple(ROBSTRIDES))
    return kinds


KINDS: Final = _kinds()
"""The kinds of controllers, with the attack on each."""


def begin(seed: int) -> Attempt:
    """Return the attempts: one kind after another, each with its own inputs."""
    kinds = KINDS
    names = list(kinds)

    def attempt(number: int) -> Done:
        name = names[number % len(names)]
        done = kinds[name](f"{seed}:{number}")
        reached = Counter({f"{name}: {what}": count for what, count in done.reached.items()})
        reached[f"{name}: inputs"] = done.count
        return Done(done.count, done.heard, reached)

    return attempt


def begin_drive(seed: int) -> Attempt:
    """Return the attempts: a drive each, whose states are checked against CiA 402."""

    def attempt(number: int) -> Done:
        reached = Reached()
        steps = list(episode(seed, number))
        try:
            endure(steps, reached)
        except Exception:
            OUT.mkdir(exist_ok=True)
            file = OUT / f"fuzz-{seed}-{number}.txt"
            file.write_text("".join(line_of(step) + "\n" for step in shrunk(steps)))
            print(f"fewer steps: python -m tests.properties.fuzz --again {file}")
            raise
        counts = Counter({f"transition {k}": count for k, count in reached.transitions.items()})
        return Done(reached.frames, repr(sorted(counts.items())).encode(), counts)

    return attempt


FRAMES: Final = Attack("frames", "inputs", begin)
DRIVE: Final = Attack("drive", "frames", begin_drive)
