"""Frames and bytes at every kind of emulated controller.

A controller must raise nothing, ask for no call in the past, send a bounded number of frames for
one input, and answer afterwards. The digest covers all that it sent, with its times: pure and
compiled cores must have the same one.
"""

import hashlib
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from itertools import islice
from random import Random
from typing import Any, Final, NamedTuple, final

from motorhil.emulators.can.frame import EFF_FLAG, RTR_FLAG, pack
from motorhil.emulators.cia401.node import IoNode
from motorhil.emulators.cia401.node import build as build_io_node
from motorhil.emulators.cia402.drive import build as build_drive
from motorhil.emulators.controller import STUCK, Controller, ControllerContext
from motorhil.emulators.dryve.drive import build as build_dryve
from motorhil.emulators.dynamixel.packets import HEADER, Instruction, packet
from motorhil.emulators.dynamixel.servo import Servo
from motorhil.emulators.dynamixel.servo import build as build_servo
from motorhil.emulators.dynamixel.table import MODELS as SERVOS
from motorhil.emulators.leadshine_pr.drive import build as build_leadshine
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.mit.classical import build as build_mit
from motorhil.emulators.mit.robstride import RobstrideDrive
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
from tests.attack import can_frames, serial_frames
from tests.attack.campaign import Attack, Attempt, Done
from tests.attack.can_frames import NODE, Group
from tests.attack.serial_frames import UNIT
from tests.properties.fuzz.__main__ import OUT
from tests.properties.fuzz.frames import Frames, frame, line_of
from tests.properties.fuzz.target import Reached, endure, episode, shrunk
from tests.support.checkout import CHECKOUT
from tests.support.cia402.stranger import LIGHT, OBJECTS

EPISODE: Final = 4_000
"""Number of inputs of an attempt."""
ROUND: Final = 500
"""Number of inputs after which a controller is restarted, or replaced if it never answered."""
BATCH: Final = 100
"""Number of inputs after which a physical input changes."""
DISTINCT: Final = 400
"""Number of different groups of inputs of an attempt: making one costs more than sending it."""
ANSWERS_MAX: Final = 300
"""Frames for one input: a block upload of SDO has 127 segments, a queue of TPDOs and EMCYs more."""
GOLDEN: Final = CHECKOUT / "traces" / "golden"
MS: Final = 1_000_000
REPLY_BY_NS: Final = 50 * MS
RESTART_NS: Final = 1_300 * MS
"""The longest time that one of these drives needs after power-on."""
_PAUSES_NS: Final = (0, 0, 0, 0, 1, 100_000, 300_000, 300_000, 1 * MS, 1 * MS, 2 * MS, 10 * MS)
_NORMAL: Final = (("power", 1.0), ("supply_v", 24.0), ("load_torque_n_m", 0.0))
_INPUTS: Final = (
    *(("fault", 2.0), ("fault", 10.0), ("fault", 32.0), ("fault", 38.0), ("fault", 0x2310)),
    *(("alarm", 0x30), ("load_torque_n_m", 3.0), ("load_torque_n_m", -0.2), ("temperature_c", 99)),
    *(("supply_v", 30.0), ("supply_v", 5.0), ("power", 0.0), ("encoder", 0.0), ("di7", 0.0)),
    *(("di7", 1.0), ("di8", 1.0), ("input_voltage_v", 3.0), ("input_voltage_v", 12.0)),
)


@final
class Bare:
    """A controller alone: its medium sends every frame at once."""

    def __init__(self, controller: Controller) -> None:
        self.now_ns = 0
        self.sent: list[bytes] = []
        self.digest = hashlib.sha256()
        self.replace(controller)

    def replace(self, controller: Controller) -> None:
        """Go on with this controller, which is switched on."""
        self.controller = controller
        controller.start(self.now_ns)
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
        calls = 0
        while self._due_ns is not None and self._due_ns <= end_ns:
            calls = 0 if self._due_ns > self.now_ns else calls + 1
            assert calls < STUCK, f"expire at {self.now_ns} ns does not advance its deadline"
            self.now_ns = self._due_ns
            self.controller.expire(self.now_ns)
            self._drain()
        self.now_ns = end_ns

    def _drain(self) -> None:
        frames = self.controller.take_output()
        count = 0
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
        due_ns = self._due_ns = self.controller.next_deadline_ns()
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


class Kind(NamedTuple):
    """A kind of drives.

    Attributes:
        build: return a new one, of a model that the dice choose.
        groups: yield inputs for it.
        ask: return questions, and how the answer to one of them begins.
    """

    build: Callable[[Random], Controller]
    groups: Callable[[Random], Iterator[Group]]
    ask: Callable[[Controller], tuple[Group, bytes]]


def attack_drive(kind: Kind, seed: str) -> Done:
    """Send inputs to a drive while its physical inputs change; restart it, and ask it."""
    dice = Random(seed)
    bare = Bare(kind.build(dice))
    bare.run(20 * MS)
    groups = list(islice(kind.groups(dice), DISTINCT))
    inputs = answers = 0
    while inputs < EPISODE:
        until = inputs + ROUND
        while inputs < until:
            inputs += _batch(bare, dice, groups)
        answers += len(bare.sent)
        is_lost = not bare.sent  # it has another address, or none
        _restart(bare)
        bare.run(20 * MS)
        if is_lost:
            bare.replace(kind.build(dice))
            bare.run(20 * MS)
        bare.sent.clear()
    _restart(bare)
    bare.run(RESTART_NS)
    bare.sent.clear()
    questions, beginning = kind.ask(bare.controller)
    for question in questions:
        bare.tell(question)
    bare.run(REPLY_BY_NS)
    count = sum(one.startswith(beginning) for one in bare.sent)
    assert 1 <= count <= len(questions), f"{count} answers to {len(questions)} questions"
    return Done(inputs, bare.digest.digest(), Counter(answers=answers))


def _batch(bare: Bare, dice: Random, groups: list[Group]) -> int:
    """Change a physical input or set all to normal, and send inputs; return their number."""
    changes = _NORMAL if dice.random() < 0.7 else (dice.choice(_INPUTS),)
    for name, value in changes:
        bare.stimulate(name, value)
    chosen = dice.choices(groups, k=BATCH)
    count = 0
    for pause_ns, group in zip(dice.choices(_PAUSES_NS, k=BATCH), chosen, strict=True):
        if pause_ns:
            bare.run(pause_ns)
        for data in group:
            bare.tell(data)
        count += len(group)
    return count


def _restart(bare: Bare) -> None:
    for name, value in (("power", 0.0), *_NORMAL):
        bare.stimulate(name, value)


def attack_gateway(build: Callable[[Random], Controller], addresses: list[int], seed: str) -> Done:
    """Send bytes of Modbus/TCP, split anywhere, to a unit; then read one of its registers."""
    dice = Random(seed)
    world = World(EventQueue())
    world.add_tcp(BytePipe("line"), None)
    world.add_controller("it", build(dice), "line")
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
    requests = list(islice(serial_frames.tcp(dice, addresses), DISTINCT))
    waiting = b""
    pauses = dice.choices(_PAUSES_NS, k=EPISODE)
    for request, pause_ns in zip(dice.choices(requests, k=EPISODE), pauses, strict=True):
        if is_closed:
            is_closed, waiting = False, b""
            host = world.add_line_host("line", "host", hear)
        waiting += request
        size = len(waiting) if dice.random() < 0.8 else dice.randrange(len(waiting) + 1)
        if size:
            host.send(waiting[:size])
        waiting = waiting[size:]
        run(pause_ns)
    for power in (0.0, 1.0):  # a request may have made it silent
        world.stimulate("it", "power", power)
    run(3_000 * MS)
    heard: list[bytes] = []
    host = world.add_line_host("line", "last", lambda data, now_ns, transmitted: heard.append(data))
    host.send(adu(7, UNIT, b"\x03" + addresses[0].to_bytes(2, "big") + b"\0\1"))
    run(2_000 * MS)
    assert len(heard) == 1, f"a read has {len(heard)} answers"
    assert heard[0][:2] == b"\0\7", "the answer is that to another request"
    return Done(EPISODE, digest.digest(), reached)


# ---------------------------------------------------------------------------- kinds of drives


def _of(build: Callable[..., Controller], **table: Any) -> Callable[[Random], Controller]:
    return lambda dice: build(table, _context())


def _of_models(
    build: Callable[..., Controller], models: Mapping[str, object], **table: Any
) -> Callable[[Random], Controller]:
    names = tuple(models)
    return lambda dice: build({**table, "model": dice.choice(names)}, _context())


def _ask_moteus(drive: Controller) -> tuple[Group, bytes]:
    """Return a read of the mode, and mode 0."""
    question = pack(EFF_FLAG | 0x8000 | NODE, bytes.fromhex("1100"))
    return (question,), pack(NODE << 8, bytes.fromhex("210000"))


def _ask_mit(drive: Controller) -> tuple[Group, bytes]:
    return (pack(NODE, b"\xff" * 7 + b"\xfd"),), b""


def _ask_robstride(drive: Controller) -> tuple[Group, bytes]:
    """Return a stop for the number that the drive has now."""
    assert isinstance(drive, RobstrideDrive)
    return (pack(EFF_FLAG | 0x400_AA00 | drive.node_id, bytes(8)),), b""


def _ask_servo(drive: Controller) -> tuple[Group, bytes]:
    """Return a ping to the id that the servo has now."""
    assert isinstance(drive, Servo)
    unit = drive.memory["id"]
    return (packet(unit, Instruction.PING),), HEADER + bytes((unit, 7, 0, 0x55))


def _ask_dryve(drive: Controller) -> tuple[Group, bytes]:
    """Return a read of the statusword."""
    question = with_crc(bytes.fromhex("01 2B 0D 00 00 00 60 41 00 00 00 00 02"))
    return (question,), bytes.fromhex("01 2B 0D 00 00 00 60 41 00 00 00 00 02")


def _ask_vesc(drive: Controller) -> tuple[Group, bytes]:
    """Return PING from 253, and PONG."""
    question = frame(EFF_FLAG | 0x1100 | NODE, b"\xfd")
    return (question,), frame(EFF_FLAG | 0x12FD, bytes((NODE, 0)))


def _ask_rmd(drive: Controller) -> tuple[Group, bytes]:
    """Return a request for the phase currents twice, and an answer without any, at 25 degrees.

    A drive that was interrupted does not obey the first request.
    """
    first = (drive.identifiers() or (0,))[0]
    question = frame(first, b"\x9d" + bytes(7))
    return (question, question), frame(first + 0x100, b"\x9d\x19" + bytes(6))


def _unit(build: Callable[[Random], Controller], addresses: list[int]) -> Kind:
    """Return a unit on a serial line, which is asked for its first register."""
    question = with_crc(bytes((UNIT, 3)) + addresses[0].to_bytes(2, "big") + b"\0\1")
    groups = partial(serial_frames.rtu, addresses=addresses)
    return Kind(build, groups, lambda drive: ((question,), bytes((UNIT,))))


def _addresses(builder: object) -> list[int]:
    return [row.address for row in builder.registers()]  # type: ignore[attr-defined]  # a builder


def _kinds() -> dict[str, Callable[[str], Done]]:
    kinds: dict[str, Callable[[str], Done]] = {
        "cia402": partial(attack_node, _drive),
        "cia401": partial(attack_node, _io_node),
        "recorded": partial(attack_node, partial(_recorded, "cia402.mcap", node_id=1), own=1),
    }
    on_can: Final = {"node_id": NODE, "plant": LIGHT}
    quick: Final = {"boot_up_s": 0.01, "watchdog_s": 0.01}
    moteus = _of(build_moteus, **on_can)
    vesc = _of(build_vesc, **on_can, status_1=63, status_rate_1_hz=20)
    rmd = _of(build_rmd, **on_can, interruption_ms=50, restart_s=0.01)
    mit = _of_models(build_mit, MIT_MODELS, **on_can, **quick)
    robstride = _of_models(build_robstride, ROBSTRIDES, **on_can, **quick)
    servo = _of_models(build_servo, SERVOS, unit=UNIT, boot_up_s=0.01, plant=LIGHT)
    dryve = _of(build_dryve, unit=UNIT, timing={"boot_up_s": 0.01}, plant=LIGHT)
    drives = {
        "moteus": Kind(moteus, can_frames.moteus, _ask_moteus),
        "vesc": Kind(vesc, can_frames.vesc, _ask_vesc),
        "rmd": Kind(rmd, can_frames.rmd, _ask_rmd),
        "mit": Kind(mit, can_frames.mit, _ask_mit),
        "robstride": Kind(robstride, can_frames.robstride, _ask_robstride),
        "dynamixel": Kind(servo, serial_frames.dynamixel, _ask_servo),
        "dryve": Kind(dryve, serial_frames.telegrams, _ask_dryve),
    }
    timing: Final = {"boot_up_s": 0.01, "reply_s": 0.0001}
    for name, build in (("leadshine_pr", build_leadshine), ("oriental_az", build_oriental)):
        made = _of(build, unit=UNIT, plant=LIGHT, timing=timing)
        drives[name] = _unit(made, _addresses(build))
        kinds[f"{name} on TCP"] = partial(attack_gateway, made, _addresses(build))
    recorded = _unit(
        lambda dice: _recorded("leadshine.mcap", unit=UNIT), _addresses(build_leadshine)
    )
    drives["recorded unit"] = recorded
    return kinds | {name: partial(attack_drive, kind) for name, kind in drives.items()}


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
