"""Hosts on a medium that loses, delays, repeats, cuts and alters what devices say.

The plants know the truth. A value that a call returns is true, within the tolerance of its kind,
at a time no longer ago than what the medium may delay; or the call raises a MotorError. Every call
ends. A motion that is reported done has reached its target. After the trouble the motor can be used
again. An attempt is a rig, in which several programs meet trouble, one after another.

The medium alters only what the protocol can detect: the header of an SDO response and lengths on
CAN, any bit on a serial line with its CRC, the headers on TCP; of other protocols on CAN, what
`liars` lists. A foreign node sends malformed frames. Other alterations are true lies, of which no
host can know; on a line also an answer sent twice, if the protocol does not number its requests.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, Final, final

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness import conformance
from motorhil.harness.rig.config.rig_file import MotorDescription, RigDescription, parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    Motor,
    MotorError,
    PluginError,
    TrapezoidalTrajectory,
)
from tests.attack import liars
from tests.attack.campaign import Attack, Attempt, Done
from tests.attack.liars import Liar, Lies
from tests.support.motors.kinds import EVERY, Kind

CONFORMANCE: Final = Path(conformance.__file__).parent / "rigs"
MS: Final = 1_000_000
DELAY_MAX_NS: Final = 300 * MS
TROUBLE_BEGIN_S: Final = 0.4
"""The latest begin of a rule [s]: the calls of a program take 0.2 to 1 s without trouble."""
TROUBLE_S: Final = (0.2, 1.5)
"""The shortest and the longest time that a rule lasts [s]."""
SAMPLE_NS: Final = 10 * MS
"""The period of the truth: an extreme between two samples differs by 4 rad/s^2 (10 ms)^2 / 8."""
STREAMED_NS: Final = 2 * MS
"""The same for drives whose steps nothing rounds: 300 rad/s^2 were seen after a late set-point."""
CALL_MAX_S: Final = 12.0
"""The longest time of any call [s]: its own timeouts, and those of what it asks first."""
LOOK_S: Final = 0.0037
"""The period at which the last measurement is judged: a lie is replaced by the next answer."""
EXTRAPOLATED_S: Final = 0.02
"""The longest time by which a host continues a position with a velocity, to begin there [s]."""
LIE_PERIODS_S: Final = (0.0047, 0.0203, 0.0971, 0.0)
"""Periods of the foreign node [s]; 0: it is silent. None is a multiple of a drive's: two senders of
one identifier at the same time only become error passive, at much cost."""
CALLS: Final = 10
RUNS: Final = 10
"""Programs in one rig: a start costs as much as a program on CiA 402."""
_ALONE: Final = 0.75
"""The probability of a rig with the left motor alone: the right one adds only frames."""
_LIFTED: Final = 0.75
"""The probability that the rules end with the calls; else time passes until their own end."""
_REPLY_S: Final = 0.1  # the time of an exchange without trouble
_TRIES: Final = 3  # a call may find out only now what the trouble has done
_RECONNECTED_S: Final = 2.0  # a connection without an answer for so long is opened anew
_ROUNDING_RAD: Final = 0.001
_VELOCITY_RAD_S: Final = 0.15
_CAN: Final = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE, FaultKind.CORRUPT)
_SERIAL: Final = tuple(SerialFaultKind)
# An answer sent twice may be heard as that to the next request, which RTU does not number.
_RTU: Final = tuple(kind for kind in _SERIAL if kind is not SerialFaultKind.REPEAT)
_TIMED: Final = (SerialFaultKind.DELAY, SerialFaultKind.PAUSE, SerialFaultKind.REPEAT)
_PLACED: Final = (SerialFaultKind.TRUNCATE, SerialFaultKind.PAUSE)

_FINISHED: Final = (0.0, 0.0, -(10**18))
"""Lowest and highest target, and begin, of a move whose end is not known: there is none."""


class SilentlyWrong(AssertionError):  # noqa: N818 -- it says what happened
    """A call returned a value that was not true, or reported a motion done that was not."""


@final
@dataclass(frozen=True)
class Conforming:
    """A kind whose rig is that of its conformance tests.

    position_tolerance: that of its motors [rad], if the host finds the end of a motion by it.
    sample_ns: the period of the truth [ns].
    """

    name: str
    window: float
    position_tolerance: float = 0.01
    sample_ns: int = STREAMED_NS
    heard_s: float = 0.1

    def rig(self) -> str:
        """Return the rig file."""
        return (CONFORMANCE / f"{self.name}.toml").read_text()


CONFORMING: Final = (
    Conforming("mit", 0.006),
    Conforming("robstride", 0.006),
    Conforming("moteus", 0.002, sample_ns=SAMPLE_NS),
    Conforming("vesc", 0.003, 0.006),
    Conforming("rmd", 0.003, 0.006),
    Conforming("dynamixel", 0.004),
    Conforming("dryve", 0.003, sample_ns=SAMPLE_NS),
)


def _on_tcp(kind: Kind) -> Kind:
    line = '[bus.line]\nkind = "modbus_tcp"\n'
    rest = kind.hardware[kind.hardware.index("[controller") :]
    return replace(kind, name=f"{kind.name} on TCP", hardware=line + rest)


def kinds() -> dict[str, Kind | Conforming]:
    """Return the kinds of hardware with a medium."""
    found = [kind for kind in EVERY.values() if kind.hardware]
    found += [_on_tcp(kind) for kind in found if "modbus_rtu" in kind.hardware]
    return {kind.name: kind for kind in (*found, *CONFORMING)}


@cache
def _description(name: str, alone: bool) -> RigDescription:
    """Return the rig of this kind; `alone`: with the left motor and its controller only."""
    kind = kinds()[name]
    whole = parse_rig(Source(Path(f"{name}.toml"), kind.rig()), installed_plugins())
    motors = {
        name: motor if isinstance(kind, Kind) else _with_tolerance(motor, kind.position_tolerance)
        for name, motor in whole.motors.items()
    }
    if not alone:
        return replace(whole, motors=motors)
    left = motors["left"]
    assert left.bus is not None
    assert left.controller is not None
    return replace(
        whole,
        buses={left.bus: whole.buses[left.bus]},
        controllers={left.controller: whole.controllers[left.controller]},
        motors={"left": left},
        groups={},
        conformance=replace(whole.conformance, motors=("left",)),
    )


def _with_tolerance(motor: MotorDescription, tolerance: float) -> MotorDescription:
    assert isinstance(motor.model, Mapping)
    return replace(motor, model={**motor.model, "position_tolerance_rad": tolerance})


@final
class Truth:
    """The true state of one motor during the time that a reading may be old.

    Attributes:
        calm_ns: that time without trouble [ns].
        trouble_ns: the same in trouble.
        age_ns: the same now.
    """

    def __init__(self, rig: Rig, kind: Kind | Conforming) -> None:
        motor = rig.description.motors["left"]
        assert motor.controller is not None
        self._controller = motor.controller
        self._rig = rig
        self.calm_ns: Final = round((kind.heard_s + _REPLY_S) * 1e9)
        self.trouble_ns: Final = 2 * DELAY_MAX_NS + self.calm_ns
        self.age_ns = self.trouble_ns
        self._seen: deque[tuple[int, float, float]] = deque()
        period_ns = SAMPLE_NS if isinstance(kind, Kind) else kind.sample_ns
        rig.world.tap_samples(period_ns, self._sample)

    def _sample(self, now_ns: int, controller: str, truth: Mapping[str, float]) -> None:
        if controller == self._controller:
            self._seen.append((now_ns, truth["position_rad"], truth["velocity_rad_s"]))
            while len(self._seen) > 1 and self._seen[1][0] < now_ns - 2 * self.trouble_ns:
                self._seen.popleft()

    def position(self) -> float:
        """Return the position now [rad]."""
        return self._rig.world.snapshot(self._controller)["position_rad"]

    def positions_since(self, since_ns: int) -> tuple[float, float]:
        """Return the lowest and the highest position from then to now [rad]."""
        seen = [one[1] for one in self._seen if one[0] >= since_ns] + [self.position()]
        return min(seen), max(seen)

    def speed(self) -> float:
        """Return the highest speed of late [rad/s]."""
        since_ns = self._rig.runtime.now_ns() - self.age_ns
        return max((abs(one[2]) for one in self._seen if one[0] >= since_ns), default=0.0)

    def require(self, what: str, value: float, at_ns: int, place: int, tolerance: float) -> None:
        """Raise SilentlyWrong if the value has not been true since `at_ns` less the age.

        Args:
            what: the value, for the message.
            value: [rad] or [rad/s].
            at_ns: the time for which it is reported [ns].
            place: 1: position; 2: velocity.
            tolerance: in the unit of the value.
        """
        truth = self._rig.world.snapshot(self._controller)
        seen = [one for one in self._seen if one[0] >= at_ns - self.age_ns]
        before = [one for one in self._seen if one[0] < at_ns - self.age_ns]
        values = [one[place] for one in before[-1:] + seen]
        values.append(truth["position_rad" if place == 1 else "velocity_rad_s"])
        if not min(values) - tolerance <= value <= max(values) + tolerance:
            raise SilentlyWrong(
                f"{what} {value:.5f} at {at_ns / 1e9:.6f} s; true since "
                f"{self.age_ns / 1e6:.0f} ms before: {min(values):.5f} to {max(values):.5f}"
            )


@final
class Trouble:
    """The rules of one run on a medium, and the lies of a foreign node.

    Args:
        rig: the rig.
        dice: decides everything.
        name: of the run, for its rules.
        bus: the bus or line.
        lies: those of its protocol.
        liar: the foreign node; None: there is none.
    """

    def __init__(
        self, rig: Rig, dice: Random, name: str, bus: str, lies: Lies, liar: Liar | None
    ) -> None:
        self._rig, self._dice, self._bus = rig, dice, bus
        self._lies, self._liar = lies, liar
        self._rules: list[str] = []
        self._delay_ns = 0
        self.ends_ns = 0
        for number in range(dice.randrange(1, 5)):
            begin_ns = rig.runtime.now_ns() + round(dice.uniform(0.0, TROUBLE_BEGIN_S) * 1e9)
            until_ns = begin_ns + round(dice.uniform(*TROUBLE_S) * 1e9)
            self.ends_ns = max(self.ends_ns, until_ns)
            rule_name = f"{name} {number}"
            common: dict[str, Any] = {
                "sender": dice.choice([*rig.description.controllers, None]),
                "from_ns": begin_ns,
                "until_ns": until_ns,
                "probability": dice.choice((0.02, 0.1, 0.3, 0.8, 1.0)),
            }
            self._rules.append(rule_name)
            make = self._serial if rig.description.buses[bus].is_line else self._can
            rig.faults.inject(bus, make(rule_name, common))
        period_s = dice.choice(LIE_PERIODS_S)
        if liar is not None and period_s:
            # A line delays answer after answer: more of them would outlast the trouble.
            liar.begin(max(period_s, self._delay_ns / 1e9), self.ends_ns)

    def end(self) -> None:
        """Remove the rules; sometimes only after the last one has ended."""
        if self._dice.random() >= _LIFTED:
            left_ns = self.ends_ns - self._rig.runtime.now_ns()
            self._rig.runtime.run_for(max(0.0, left_ns / 1e9))
        if self._liar is not None:
            self._liar.end()
        for name in self._rules:
            self._rig.faults.lift(self._bus, name)

    def _can(self, name: str, common: dict[str, Any]) -> FaultRule:
        dice, lies = self._dice, self._lies
        kind = dice.choice(_CAN if lies.checked else _CAN[:-1])  # the last one alters
        more: dict[str, Any] = {}
        if kind is FaultKind.DELAY:
            more = {"delay_ns": dice.randrange(1, DELAY_MAX_NS)}
        elif kind is FaultKind.CORRUPT:
            identifier, flip = lies.turned(dice)
            more = {"flip": flip, "identifier": identifier}
            common = {**common, "sender": dice.choice([*self._rig.description.controllers])}
        elif common["sender"] is None and lies.answers:
            more = {"identifier": dice.choice(lies.answers)}
        return FaultRule(name, kind, **common, **more)

    def _serial(self, name: str, common: dict[str, Any]) -> SerialFaultRule:
        dice, is_tcp = self._dice, self._rig.description.buses[self._bus].kind == "modbus_tcp"
        kind = dice.choice(_SERIAL if is_tcp else _RTU)
        more: dict[str, Any] = {}
        if kind in _TIMED:
            more["delay_ns"] = dice.randrange(1, DELAY_MAX_NS)
            self._delay_ns = max(self._delay_ns, more["delay_ns"])
        if kind in _PLACED:
            more["after"] = dice.randrange(1, 20)
        if kind is SerialFaultKind.NOISE:
            more["noise"] = dice.randbytes(dice.randrange(1, 6))
        if kind is SerialFaultKind.CORRUPT and is_tcp:  # all that is not a value
            more["flip"] = self._lies.turned_on_tcp(dice)
            common = {**common, "sender": dice.choice([*self._rig.description.controllers])}
        return SerialFaultRule(name, kind, **common, **more)


@final
class Program:
    """A program with a motor under trouble: random calls, and what they must not do."""

    def __init__(self, rig: Rig, kind: Kind | Conforming, dice: Random) -> None:
        self.motor: Motor = rig.motors["left"]
        self.bus: str = rig.description.motors["left"].bus or ""
        self.reached: Counter[str] = Counter()
        self._rig, self._kind, self._dice = rig, kind, dice
        self._truth = Truth(rig, kind)
        self._tolerance = kind.window + _ROUNDING_RAD
        self._seen_ns = -1
        self._unfinished = _FINISHED
        rig.runtime.every(LOOK_S, self._latest)
        self._calls = (
            *(self._position,) * 3,
            *(self._velocity, self._move, self._move, self._turn),
            *(self.motor.state, self._fault, self.motor.torque, self.motor.is_referenced),
            *(self.motor.stop, self.motor.quick_stop, self.motor.enable, self.motor.disable),
            *(self.motor.reset_fault, self._pause),
        )

    def call(self, call: Callable[[], object]) -> None:
        """Make a call, which may raise a MotorError other than PluginError, within CALL_MAX_S."""
        begun_ns = self._rig.runtime.now_ns()
        name = getattr(call, "__name__", "").strip("_")
        try:
            call()
            self.reached[f"{name} returned"] += 1
        except PluginError:  # an error of the adaptation itself
            raise
        except MotorError as error:
            self.reached[f"{type(error).__name__}"] += 1
        took_s = (self._rig.runtime.now_ns() - begun_ns) / 1e9
        if took_s > CALL_MAX_S:
            raise SilentlyWrong(f"{name} took {took_s:.1f} s; expected {CALL_MAX_S} s at most")

    def run(self) -> None:
        """Make random calls."""
        self._truth.age_ns = self._truth.trouble_ns
        for _ in range(CALLS):
            self.call(self._dice.choice(self._calls))

    def _pause(self) -> None:
        self._rig.runtime.run_for(0.15)

    def _position(self) -> None:
        value = self.motor.position()
        self._truth.require("position", value, self._rig.runtime.now_ns(), 1, self._tolerance)

    def _velocity(self) -> None:
        value = self.motor.velocity()
        self._truth.require("velocity", value, self._rig.runtime.now_ns(), 2, _VELOCITY_RAD_S)

    def _fault(self) -> None:
        fault, lies = self.motor.fault(), liars.LIES.get(self._kind.name, liars.NONE)
        if fault is not None and fault.code == lies.fault:
            raise SilentlyWrong(f"fault {fault.code:X}h, which only a foreign node has reported")

    def _latest(self) -> None:
        """Judge the last measurement, once; without one of late, it says that it is old."""
        latest, truth = self.motor.latest(), self._truth
        if latest is None or latest.time_ns == self._seen_ns:
            return
        self._seen_ns = latest.time_ns
        if latest.time_ns < self._rig.runtime.now_ns() - truth.age_ns:
            return
        if latest.position is not None:
            what = "latest position"
            truth.require(what, latest.position, latest.time_ns, 1, self._tolerance)
        if latest.velocity is not None:
            what = "latest velocity"
            truth.require(what, latest.velocity, latest.time_ns, 2, _VELOCITY_RAD_S)

    def _move(self) -> None:
        distance = self._dice.choice((-0.4, -0.05, 0.05, 0.4))
        asked_ns = self._rig.runtime.now_ns()
        # The host begins from a position that is as old as any other, continued by its velocity,
        # or at the target of a move that began of late, whose end it did not see.
        lowest, highest = self._truth.positions_since(asked_ns - self._truth.age_ns)
        ahead = self._truth.speed() * EXTRAPOLATED_S
        lowest, highest = lowest - ahead, highest + ahead
        if asked_ns - self._unfinished[2] < self._truth.age_ns:
            lowest = min(lowest, self._unfinished[0])
            highest = max(highest, self._unfinished[1])
        self.motor.set_control_mode(ControlMode.TRAJECTORY)
        self.motor.set_trajectory(TrapezoidalTrajectory(distance))
        self.motor.start()
        # It may have been slowing down until it began; by now it has begun.
        least, most = self._truth.positions_since(asked_ns)
        begun = self._truth.position()
        low = min(lowest, least if distance > 0.0 else begun) + distance
        high = max(highest, most if distance < 0.0 else begun) + distance
        self._unfinished = low, high, self._rig.runtime.now_ns()
        self.motor.wait_until_done(5)
        self._unfinished = _FINISHED
        now = self._truth.position()
        # A late command may have moved it back since: that it was there is as old as any value.
        seen = self._truth.positions_since(self._rig.runtime.now_ns() - self._truth.age_ns)
        near = 2 * self._tolerance
        is_beyond = now < low - near if distance < 0.0 else now > high + near
        if is_beyond or seen[1] < low - near or seen[0] > high + near:
            raise SilentlyWrong(
                f"done at {now:.5f} rad, of late {seen[0]:.5f} to {seen[1]:.5f} rad; expected "
                f"{low:.5f} to {high:.5f} rad"
            )

    def _turn(self) -> None:
        self.motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        self.motor.set_setpoint(self._dice.choice((-1.0, 0.5)))
        self.motor.start()
        self._rig.runtime.run_for(0.2)
        self._position()
        self.motor.stop()

    def require_usable(self) -> None:
        """Raise SilentlyWrong if the motor cannot move in one of few tries."""
        truth = self._truth
        rest_s = (DELAY_MAX_NS + truth.calm_ns) / 1e9  # late frames come, and are too old then
        for last in (False,) * (_TRIES - 1) + (True,):
            self._rig.runtime.run_for(rest_s)
            rest_s = _RECONNECTED_S
            truth.age_ns = truth.calm_ns
            try:
                self.motor.stop()
                if self.motor.fault() is not None:
                    self.motor.reset_fault()
                self.motor.enable()
                self.motor.wait_until_done(5)  # the stop may take longer than the rest
                self._rig.runtime.run_for(truth.calm_ns / 1e9)
                self._position()
                self._move()
                self._position()
            except PluginError:
                raise
            except MotorError as error:
                if last:
                    raise SilentlyWrong(f"unusable after the trouble: {error}") from error
                self.reached["not usable at once"] += 1
            else:
                return


def attack(name: str, seed: str) -> Done:
    """Run programs under trouble on this kind of hardware, in one rig."""
    kind, dice = kinds()[name], Random(seed)
    with Rig(_description(name, dice.random() < _ALONE), seed=dice.getrandbits(32)) as rig:
        program = Program(rig, kind, dice)
        program.motor.enable()
        lies = liars.LIES.get(name, liars.NONE)
        bus = program.bus
        liar = None if lies.forge is None else Liar(rig, bus, lies.forge, dice)
        for run in range(RUNS):
            trouble = Trouble(rig, dice, f"run {run}, trouble", bus, lies, liar)
            program.run()
            trouble.end()
            program.require_usable()
            program.reached[name] += 1
        return Done(RUNS, f"{name} {rig.runtime.now_ns()}".encode(), program.reached)


def begin(seed: int) -> Attempt:
    """Return the attempts: one kind after another."""
    names = list(kinds())
    return lambda number: attack(names[number % len(names)], f"{seed}:{number}")


LIES: Final = Attack("lies", "runs", begin)
