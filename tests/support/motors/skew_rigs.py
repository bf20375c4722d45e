"""Random groups under declared and real traffic: predicted and measured skew.

All measurements are external. The frames in the bus record tell when a drive latched its command.
The true states of the plants tell when its motor began to move, and its profile tells when it
ended.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.emulators.firmware.clock import OwnTime
from motorhil.emulators.plant.oscillator import IDEAL
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.functions import Polynomial
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.synchronization.quality import SyncCapability
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors.skew_scenarios import Member, Message, Scenario, rig_text

_FRAME = struct.Struct("<IB3x8s")
_EFF = 0x8000_0000
AMPLIFIER_TICK_NS = 250_000  # of our own I/O nodes
LOOK_S = 0.000_2  # shorter than any drive's servo tick
_NEW_SET_POINT = 0x10
_STUFFED = (bytes((0x3C,)) * 8, bytes(8), bytes((0xFF,)) * 8)  # 131, 127, 126 bits at 078h


@dataclass(frozen=True)
class Outcome:
    """Predicted and measured skew [ns]; None: not all could be measured."""

    predicted: SyncCapability
    command_ns: int | None
    start_ns: int | None
    end_ns: int | None
    told_command_s: float | None
    sent: int


@dataclass
class Sender:
    """A node that sends one message, never sooner than declared.

    eager: it waits for the first frame with one of `hosts` identifiers, and then sends as often as
    permitted, with the burst that jitter allows; else it sends from `offset_ns` on, each frame
    delayed by a random part of the jitter.
    """

    message: Message
    random: Random
    hosts: Sequence[int]
    count: int = 0
    due_ns: int | None = None
    nominal_ns: int = 0
    output: list[bytes] = field(default_factory=list)

    def start(self, now_ns):
        if not self.message.eager:
            self.nominal_ns = self.message.offset_us * 1000
            self._plan(now_ns)

    def receive(self, data, now_ns):
        if self.due_ns is None:
            self.nominal_ns = now_ns - self.message.jitter_us * 1000
            self.due_ns = now_ns
            self.expire(now_ns)

    def expire(self, now_ns):
        message = self.message
        while self.due_ns is not None and self.due_ns <= now_ns:
            data = self.random.choice(_STUFFED)[: message.length]
            can_id = message.can_id | (_EFF if message.extended else 0)
            self.output.append(_FRAME.pack(can_id, message.length, data))
            self.count += 1
            self.nominal_ns += message.period_us * 1000
            self._plan(now_ns)

    def _plan(self, now_ns):
        jitter_ns = self.message.jitter_us * 1000
        late_ns = 0 if self.message.eager else self.random.randrange(jitter_ns + 1)
        self.due_ns = max(self.nominal_ns + late_ns, now_ns)

    def next_deadline_ns(self):
        return self.due_ns

    def take_output(self):
        output, self.output = self.output, []
        return output

    def wants_sent(self):
        return False

    def sent(self, data, now_ns):
        return False

    def take_events(self):
        return ()

    def snapshot(self, now_ns):
        return {}

    def identifiers(self):
        return self.hosts if self.message.eager else ()

    def identifiers_revision(self):
        return 0


def _set(motor: Motor, member: Member) -> None:
    if member.kind == "live":
        motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
        motor.set_trajectory(TrapezoidalTrajectory(10.0 * member.distance))
        return
    motor.set_control_mode(ControlMode.TRAJECTORY)
    if member.kind == "streamed":
        way = max(0.1, abs(member.distance))  # so that the first step is more than an increment
        function = Polynomial((0.0, 0.0, 3.0 * way, -2.0 * way)).scaled(0.3).restricted(0.0, 0.3)
        motor.set_trajectory(ComplexTrajectory(function, relative=True))
        return
    motor.set_trajectory(TrapezoidalTrajectory(member.distance))


class Record:
    """Times at which each drive latched its command, from the frames of all buses."""

    def __init__(self, rig: Rig, scenario: Scenario) -> None:
        self._ours: dict[tuple[str, int], int] = {}
        self.syncs: dict[str, list[int]] = {}
        self.seen: dict[int, list[int]] = {}  # by motor: its frames
        for number, member in enumerate(scenario.members, 1):
            bus = f"can{member.bus}"
            base = {"latched": 0x300, "streamed": 0x300, "alone": 0x200, "live": 0x600}
            if member.kind in base:
                self._ours[bus, base[member.kind] + number] = number
                self.seen[number] = []
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if can_id == 0x080:
            self.syncs.setdefault(bus, []).append(time_ns)
            return
        number = self._ours.get((bus, can_id))
        if number is None or sender != "host":
            return
        if can_id < 0x300 and not frame[8] & _NEW_SET_POINT:
            return
        if can_id >= 0x600 and (frame[8:12] != b"\x23\xff\x60\x00" or frame[12:16] == bytes(4)):
            return
        self.seen[number].append(time_ns)

    def latched_ns(self, number: int, member: Member, told_ns: int | None) -> int | None:
        """Return the latch time of motor `number`; `told_ns`: as reported, if necessary."""
        syncs = self.syncs.get(f"can{member.bus}", [])
        if member.kind == "ideal" or told_ns is None:
            return told_ns
        if member.kind == "software":  # outputs of the first count act at the next SYNC
            return next((one for one in syncs if one > told_ns), None)
        seen = self.seen[number]
        if member.kind in ("alone", "live"):
            return seen[0] if seen else None
        place = 1 if member.kind == "streamed" else 0  # after the initial position, the first step
        if len(seen) <= place:
            return None
        return next((one for one in syncs if one > seen[place]), None)


class Truth:
    """Times at which the plants began to move, and at which the profiles ended."""

    def __init__(self, rig: Rig, scenario: Scenario) -> None:
        self._rig = rig
        self._names: dict[int, str] = {}
        self._ticks_ns: dict[int, int] = {}
        self._drives: dict[int, Cia402Drive] = {}
        self._clocks = {}
        self._at: dict[int, float] = {}
        self.began_ns: dict[int, int] = {}
        self.ended_ns: dict[int, int] = {}
        for number, member in enumerate(scenario.members, 1):
            if member.kind == "ideal":
                continue
            name = f"io{number}" if member.kind == "software" else f"m{number}"
            core = rig.controllers[name].core
            self._clocks[number] = core.oscillator if isinstance(core, OwnTime) else IDEAL
            inner = core.inner if isinstance(core, OwnTime) else core
            self._ticks_ns[number] = AMPLIFIER_TICK_NS
            if isinstance(inner, Cia402Drive):
                self._drives[number] = inner
                self._ticks_ns[number] = inner.settings.tick_ns
            self._at[number] = rig.controllers[name].snapshot()["position_rad"]
            self._names[number] = name

    def look(self) -> None:
        """Sample the plants between any two ticks; the tick itself is computed."""
        now_ns = self._rig.runtime.now_ns()
        for number, name in self._names.items():
            drive = self._drives.get(number)
            if number in self.ended_ns or (drive is None and number in self.began_ns):
                continue
            where = self._rig.controllers[name].snapshot()["position_rad"]
            clock, tick_ns = self._clocks[number], self._ticks_ns[number]
            tick = clock.own_ns(now_ns) // tick_ns
            if number not in self.began_ns:
                if where != self._at[number]:
                    # The loops act on a demand one tick later, the plant on the current in the next
                    # tick.
                    self.began_ns[number] = clock.true_ns((tick - 1) * tick_ns)
            elif drive is not None and drive.axis.demand_velocity_inc_s() == 0.0:
                self.ended_ns[number] = clock.true_ns(tick * tick_ns)


def _spread(times: Sequence[int | None]) -> int | None:
    known = [one for one in times if one is not None]
    return max(known) - min(known) if known and len(known) == len(times) else None


def run(scenario: Scenario, path: Path) -> Outcome:
    """Start the group once, and sample it until the end."""
    path.write_text(rig_text(scenario))
    numbers = range(1, len(scenario.members) + 1)
    with Rig.open(path) as rig:
        senders = _add_senders(rig, scenario)
        record = Record(rig, scenario)
        motors = [rig.motors[f"m{number}"] for number in numbers]
        for motor, member in zip(motors, scenario.members, strict=True):
            _set(motor, member)
        group = MotorGroup(*motors)
        if scenario.enabled_before:
            group.for_each(Motor.enable)
        if scenario.idle_us:
            rig.runtime.run_for(scenario.idle_us / 1e6)
        predicted = group.sync_capability()
        truth = Truth(rig, scenario)
        looking = rig.runtime.every(LOOK_S, truth.look)
        group.start()
        times = dict(group.sync_quality().times)
        told_command_s = group.sync_quality().command_skew_s
        rig.runtime.run_for(0.6)
        looking.cancel()
        latched = []
        for number, member in zip(numbers, scenario.members, strict=True):
            its = times[f"m{number}"]
            told_ns = None if its is None else its.started_ns or its.latched_ns
            latched.append(record.latched_ns(number, member, told_ns))
        moving = [n for n in numbers if scenario.members[n - 1].kind != "ideal"]
        ending = [n for n in moving if scenario.members[n - 1].kind in ("latched", "alone")]
        return Outcome(
            predicted=predicted,
            command_ns=_spread(latched),
            start_ns=_spread([truth.began_ns.get(n) for n in moving]),
            end_ns=_spread([truth.ended_ns.get(n) for n in ending]),
            told_command_s=told_command_s,
            sent=sum(one.count for one in senders),
        )


def _add_senders(rig: Rig, scenario: Scenario) -> list[Sender]:
    """Add each sender on its own port: the sender of a declared message sends nothing else."""
    nodes = range(1, len(scenario.members) + 1)
    hosts = (0x080, *(0x200 + node for node in nodes))
    senders = []
    for place, message in enumerate(scenario.messages):
        sender = Sender(message, Random(f"{scenario.seed}:{place}"), hosts)
        rig.world.add_controller(f"sender{place}", sender, f"can{message.bus}")
        senders.append(sender)
    return senders
