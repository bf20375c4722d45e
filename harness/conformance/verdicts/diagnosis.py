"""Diagnosis of failures: the likely cause, from the error and from what the bench has observed.

The rules are ordered: a crash names its own place; then motion told and true is compared, then
motion asked and made, then the values of the message. Only the rest is told by its error.
"""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from math import isclose
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, final

import motorhil
from motorhil.harness.conformance.bench import Ability
from motorhil.harness.conformance.clause import Clause, Diagnosis, Violated, without_numbers
from motorhil.harness.conformance.verdicts.observation import (
    PERIOD_NS,
    Message,
    Observation,
    Sample,
)
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    MotionInterrupted,
    Motor,
    MotorError,
    PluginError,
)
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.physical_motor import ActiveMotion
from motorhil.traces.decoding.events import Kind

_PI: Final = 3.141592653589793
_FACTORS: Final = (
    (180.0 / _PI, "degrees for radians"),
    (_PI / 180.0, "radians for degrees"),
    (30.0 / _PI, "revolutions per minute for rad/s"),
    (_PI / 30.0, "rad/s for revolutions per minute"),
    (2.0 * _PI, "radians for turns"),
    (0.5 / _PI, "turns for radians"),
    (4.0, "increments for encoder lines, or a factor of 4"),
    (0.25, "encoder lines for increments, or a factor of 1/4"),
    (2.0, "twice the value"),
    (0.5, "half the value"),
    (1.024, "1024 for 1000, as an encoder of 2048 lines for one of 2000"),
    (1.0 / 1.024, "1000 for 1024, as an encoder of 2000 lines for one of 2048"),
    (10.0, "tenths"),
    (0.1, "tens"),
    (1e3, "thousandths"),
    (1e-3, "thousands"),
    (1e6, "millionths, as microseconds for seconds"),
    (1e-6, "millions"),
)
_COMMON: Final = (0.1, 0.25, 0.5, 2.0, 4.0, 10.0)
"""Factors that two values of a message may have for other reasons."""
_TIMES: Final = (1e3, 1e6, 1e-3, 1e-6)
"""Factors of two times that are mistakes; durations differ for many reasons."""
_NEAR: Final = 0.012
_STRAIGHT: Final = 0.999
_OFF: Final = 0.015
_LATE: Final = 0.08
"""Allowed deviation of the factor of values that are told late, while they change."""
_ABOUT: Final = 0.2
"""Allowed deviation of the size of a value with the wrong sign."""
_EXACT: Final = 0.004
"""Allowed deviation of the factor of distances, which are known to the motor's resolution."""
_WINDOWS: Final = 10.0
_REST_SAMPLES: Final = 10
_CURVE_POINTS: Final = 400
_VALUE: Final = re.compile(r"(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?) (rad/s|rad|m/s|m|N·m|N|A|s)(?![\w/·])")
_DISTURBS: Final = {
    *(Ability.CUT, Ability.LOSE, Ability.SILENCE_HOST, Ability.BUS_ERRORS),
    *(Ability.STOP_SYNC, Ability.CLOCK, Ability.OTHER_PROGRAM, Ability.RESTART),
    *(Ability.ONE_KIND, Ability.LATE),
}
_INTERRUPTS: Final = {*_DISTURBS, Ability.SEVERAL_USERS, Ability.LOAD, Ability.FAULT}
"""Abilities with which a clause may let something else end a motion."""
_TARGET: Final = "607Ah"
_ABSENT: Final = "object does not exist"
_PACKAGES: Final = Path(motorhil.__file__).parents[1]
_EMULATORS: Final = str(_PACKAGES / "motorhil" / "emulators") + os.sep
_NS: Final = 1e9


class _Hint(NamedTuple):
    """A likely cause; `key` is equal for failures of this cause."""

    key: str
    cause: str


def diagnose(
    one: Clause, error: BaseException, seen: str, home: str, observation: Observation | None
) -> Diagnosis:
    """Return the likely cause of the failure of a clause.

    Args:
        one: the clause.
        error: the error that ended its check.
        seen: the observation in the verdict.
        home: the folder of the adaptation (`home_of`).
        observation: of its bench, or None.
    """
    crash = _crash(error)
    evidence: list[str] = []
    hints: list[_Hint] = []
    curves: dict[str, tuple[tuple[float, float], ...]] = {}
    if observation is not None:
        views = [_View(motor, observation) for motor in observation.motors.values()]
        is_disturbed = bool(_DISTURBS.intersection(one.bench))
        may_be_pushed = bool({Ability.LOAD, Ability.SEVERAL_USERS}.intersection(one.bench))
        for view in views:
            hints += view.hints(is_disturbed=is_disturbed, may_be_pushed=may_be_pushed)
        shown = next((view for view in views if view.moved()), views[0])
        evidence += shown.evidence()
        curves = shown.curves()
        models = [view.motor.model.gear_ratio for view in views]
        hints += _in_message(seen, models[0])
        if not is_disturbed or isinstance(error, DeadlineExceeded):
            hints += [
                hint
                for view in views
                for hint in view.refusals(is_violated=isinstance(error, Violated))
            ]
    else:
        hints += _in_message(seen, None)
    chosen = [crash] if crash else [*hints, _of_error(error, seen, home, one)]
    evidence = [f"also: {hint.cause}" for hint in dict.fromkeys(chosen[1:-1])] + evidence
    return Diagnosis(chosen[0].cause, chosen[0].key, tuple(dict.fromkeys(evidence)), curves)


# --- from the error ----------------------------------------------------------------------------


def _frames(error: BaseException) -> Iterator[tuple[str, str, int]]:
    """Yield (file, function, line) of the error's first cause, the outermost first."""
    while error.__cause__ is not None:
        error = error.__cause__
    traceback: TracebackType | None = error.__traceback__
    while traceback is not None:
        code = traceback.tb_frame.f_code
        file = str(_PACKAGES / code.co_filename)  # compiled code names it from there
        yield file, code.co_qualname, traceback.tb_lineno
        traceback = traceback.tb_next


def _root(error: BaseException) -> BaseException:
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _crash(error: BaseException) -> _Hint | None:
    """Return the hint for an error that is not part of the motor interface."""
    root = _root(error)
    known = MotorError | Violated
    if isinstance(error, known) and not isinstance(error, PluginError):
        return None
    if not isinstance(root, Exception):
        return None
    frames = list(_frames(error))
    if not frames:
        return None
    file, function, line = frames[-1]
    of = "the emulator" if file.startswith(_EMULATORS) else "the code"
    cause = f"{of} raises {type(root).__name__}: {root}, in {function}, {file}:{line}"
    return _Hint(f"crash {type(root).__name__} {file} {function}", cause)


def _of_error(error: BaseException, seen: str, home: str, one: Clause) -> _Hint:
    """Return the hint for an error without other evidence: its message, and where it arose."""
    if isinstance(error, MotionInterrupted) and not _INTERRUPTS.intersection(one.bench):
        cause = f"{seen}; but nothing on this bench ended the motion: the drive was told another"
        cause += " target, or its position or status is read wrongly"
        return _Hint(f"interrupted by nothing {without_numbers(error.by)}", cause)
    if isinstance(error, Violated):
        return _Hint(f"violated {without_numbers(seen)}", seen)
    own = [frame for frame in _frames(error) if home and frame[0].startswith(home)]
    file, function, _ = (own or list(_frames(error)) or [("", "", 0)])[-1]
    if isinstance(error, DeadlineExceeded):
        cause = (
            f"awaited in vain for {error.timeout_s:g} s: {error.awaited}; "
            f"last heard: {error.last_heard}"
        )
        return _Hint(f"deadline {without_numbers(error.awaited)}", cause)
    used = [one[1] for one in _frames(error) if one[1].startswith("Motor.")]
    through = f" {used[-1]}() at" if used else ""
    message = without_numbers(f"{error}")
    key = f"{type(error).__name__} {message} {file} {function}"
    return _Hint(key, f"{seen}, in{through} {function}")


# --- from values -------------------------------------------------------------------------------


def name_of(factor: float, gear_ratio: float | None = None, within: float = _NEAR) -> str:
    """Return the usual mistake with this factor; "" if none is known."""
    named = [*_FACTORS]
    if gear_ratio is not None and abs(gear_ratio) > 1.0:
        gear = abs(gear_ratio)
        named[:0] = [
            (gear, "the gear ratio: motor side for output side"),
            (1.0 / gear, "the gear ratio: output side for motor side"),
        ]
    sign = "sign reversed" if factor < 0.0 else ""
    if isclose(abs(factor), 1.0, rel_tol=_NEAR):
        return sign
    for value, name in named:
        near = _NEAR if not isclose(value, 1.0, rel_tol=3.0 * _NEAR) else 0.5 * _NEAR
        if isclose(abs(factor), value, rel_tol=min(near, within)):
            return f"{sign}, {name}" if sign else name
    return sign if isclose(abs(factor), 1.0, rel_tol=_ABOUT) else ""


def _in_message(seen: str, gear_ratio: float | None) -> Iterator[_Hint]:
    """Yield the hint of two values with one unit in the message, if their factor is usual."""
    by_unit: dict[str, list[float]] = {}
    for value, unit in _VALUE.findall(seen):
        by_unit.setdefault(unit, []).append(float(value))
    usual = {name for value, name in _FACTORS if value in _COMMON}
    for unit, values in by_unit.items():
        if len(values) < 2 or not values[0] or not values[1]:
            continue
        first = values[0]
        if " after that of " in seen:  # a difference of two times
            first += values[1]
        factor = first / values[1]
        within = _EXACT if unit in ("rad", "m") else _NEAR
        name = name_of(factor, gear_ratio, within)
        if unit == "s" and not any(isclose(factor, one, rel_tol=0.1) for one in _TIMES):
            continue
        if name and name.removeprefix("sign reversed, ") not in usual:
            topic = seen.partition(":")[0] if ":" in seen else "value"
            told = f"{topic}: {first:g} {unit} is {factor:.6g} times {values[1]:g} {unit}"
            yield _Hint(f"values {topic} {name}", f"{told}: {name}")
            return


# --- from motion -------------------------------------------------------------------------------


@final
class _View:
    """The motion and the traffic of one motor."""

    def __init__(self, motor: Motor, observation: Observation) -> None:
        self.motor = motor
        self._observation = observation
        self._samples: Sequence[Sample] = tuple(observation.samples[motor.name])
        self._messages: list[Message] | None = None
        self._inc_per_unit = self._scale()

    @property
    def messages(self) -> list[Message]:
        """The messages of its controller."""
        if self._messages is None:
            self._messages = self._observation.messages(self.motor.name)
        return self._messages

    def _scale(self) -> float | None:
        """Return the drive's increments in one unit, from its truth; None without motion."""
        pairs = _pairs(self._samples, lambda one: one.truth, lambda one: one.position_inc)
        if len(pairs) < 2:
            return None
        low, high = min(pairs), max(pairs)
        is_enough = abs(high[1] - low[1]) > 50.0
        return (high[1] - low[1]) / (high[0] - low[0]) if is_enough else None

    def _demand(self, one: Sample) -> float | None:
        """Return the drive's position demand [U]."""
        scale = self._inc_per_unit
        if scale is None or one.truth is None:
            return None
        if one.demand_inc is None or one.position_inc is None:
            return None
        return one.truth + (one.demand_inc - one.position_inc) / scale

    def moved(self, window: float = 0.0) -> bool:
        """Return whether the motor has moved by more than `window` [U]."""
        places = [one.truth if one.truth is not None else one.told for one in self._samples]
        known = [place for place in places if place is not None]
        return bool(known) and max(known) - min(known) > window

    def hints(self, *, is_disturbed: bool, may_be_pushed: bool) -> Iterator[_Hint]:
        """Yield the likely causes that the motion shows."""
        if not is_disturbed:  # a value told before a loss gives any factor
            yield from self._told()
            yield from self._asked()
            if not may_be_pushed:
                yield from self._strange()

    def _told(self) -> Iterator[_Hint]:
        """Yield the hints from told and true values; told ones are late by some milliseconds."""
        position = _pairs(self._resting(), lambda one: one.truth, lambda one: one.told)
        slope, off = _slope(position), _OFF
        if slope is None:
            position = _pairs(self._samples, lambda one: one.truth, lambda one: one.told)
            slope, off = _slope(position), _LATE
        if slope == 0.0 and self._was_heard():
            text = "position told does not change while the motor moves: not read again"
            yield _Hint("told position frozen", f"{self.motor.name}: {text}")
        elif slope and abs(slope - 1.0) > off:
            yield self._factor("position told", "the truth", slope)
        velocity = _pairs(self._samples, lambda one: one.velocity, lambda one: one.told_velocity)
        slope = _slope(velocity)
        if slope and abs(slope - 1.0) > _LATE:
            yield self._factor("velocity told", "the truth", slope)

    def _was_heard(self) -> bool:
        """Return whether the motor told its position again and again, which costs no request."""
        return len({one.heard_ns for one in self._samples}) > _REST_SAMPLES

    def _resting(self) -> list[Sample]:
        """Return the samples after a time at rest."""
        found = []
        for before, one in zip(self._samples, self._samples[_REST_SAMPLES:], strict=False):
            if one.truth is None or before.truth is None:
                continue
            if abs(one.truth - before.truth) <= 5.0 * (self.motor.model.resolution or 1e-6):
                found.append(one)
        return found

    def _factor(self, what: str, of: str, factor: float) -> _Hint:
        name = name_of(factor, self.motor.model.gear_ratio)
        times = f"{self.motor.name}: {what} is {factor:.6g} times {of}"
        return _Hint(f"{what} {name or round(factor, 2)}", f"{times}: {name}" if name else times)

    def _asked(self) -> Iterator[_Hint]:
        """Yield the hints from the last motion: what was asked, sent and made."""
        run = self.motor.logical.physical.run
        motion = None if run is None else run.motion
        if run is None or motion is None:
            return
        if motion.variable is ControlVariable.POSITION:
            yield from self._way_made(run, motion)
        elif motion.variable is ControlVariable.TORQUE and motion.mode is ControlMode.SETPOINT:
            yield from self._torque_made(run, motion)

    def _way_made(self, run: ActiveMotion, motion: Motion) -> Iterator[_Hint]:
        """Yield the hints from a motion to a position."""
        way = motion.target - motion.start
        window = self._window()
        if motion.function is not None or abs(way) < window:
            return
        since = [one for one in self._samples if one.time_ns >= run.since_ns]
        known = [place for place in map(self._place, since) if place is not None]
        if run.interrupted_by is not None:
            if run.error is None:
                yield from self._stopped(run, known)
            return
        sent = self._sent()
        if sent is not None and self._inc_per_unit is not None:
            target = sent / self._inc_per_unit
            factor = (target - motion.start) / way
            is_distance = isclose(target, way, rel_tol=_OFF)  # a drive may take distances
            if not name_of(factor) and motion.target and name_of(target / motion.target):
                factor = target / motion.target  # a factor of positions, not of distances
            if (factor > 1.0 + _OFF or factor < -_OFF) and not is_distance:
                yield from self._wrong_way("target sent", motion, factor)
                return
        waited = self._previous_first(motion, known)
        if waited is not None:
            yield waited
            return
        last = known[-_REST_SAMPLES:]
        if len(known) < _REST_SAMPLES or (
            not run.finished and max(last) - min(last) > window / _WINDOWS
        ):
            return  # not at rest yet
        factor = (last[-1] - known[0]) / way
        if abs(factor) < _OFF:
            yield self._unmoved(run.since_ns)
        elif abs(factor - 1.0) > _OFF and abs(last[-1] - motion.target) > _OFF * abs(way):
            yield from self._wrong_way("distance made", motion, factor, last[-1])
        elif motion.duration_s is not None:
            yield from self._timed(since, motion, motion.duration_s)

    def _strange(self) -> Iterator[_Hint]:
        """Yield the hint of a motor that moves without any command."""
        if not self._observation.targets(self.motor.name) and self.moved(self._window()):
            text = "moved without a command: one for another motor has reached it"
            yield _Hint("strange command", f"{self.motor.name}: {text}")

    def _window(self) -> float:
        """Return the largest distance that does not count as a motion [U]."""
        return _WINDOWS * 2.0 * (self.motor.model.resolution or 1e-4)

    def _stopped(self, run: ActiveMotion, places: Sequence[float]) -> Iterator[_Hint]:
        """Yield the hint of a motion that a stop has not ended."""
        motion = run.motion
        if motion is None or not places:
            return
        way = motion.target - motion.start
        if abs(places[-1] - motion.target) <= _OFF * abs(way):
            text = f"the stop by {run.interrupted_by} did not end the motion: it reached its target"
            yield _Hint("stop ignored", f"{self.motor.name}: {text}")

    def _torque_made(self, run: ActiveMotion, motion: Motion) -> Iterator[_Hint]:
        """Yield the hint of a torque that is a usual factor of the one asked."""
        made = [one.torque for one in self._samples if one.time_ns > run.since_ns and one.torque]
        if len(made) < _REST_SAMPLES or not motion.target:
            return
        factor = sorted(made[-_REST_SAMPLES:])[_REST_SAMPLES // 2] / motion.target
        if name_of(factor, self.motor.model.gear_ratio):
            yield self._factor("torque made", "the torque asked", factor)

    def _previous_first(self, motion: Motion, known: Sequence[float]) -> _Hint | None:
        """Return the hint of a motor that reached its previous target before it went to this."""
        low, high = sorted((motion.start, motion.target))
        for one in self._observation.targets(self.motor.name)[:-1]:
            away = max(low - one, one - high)
            if away <= self._window():
                continue  # on the way
            if any(abs(place - one) <= self._window() for place in known):
                unit = self.motor.model.unit
                text = f"went on to its previous target {one:g} {unit}: the new target waited"
                return _Hint("previous target first", f"{self.motor.name}: {text}")
        return None

    def _timed(self, since: Sequence[Sample], motion: Motion, duration_s: float) -> Iterator[_Hint]:
        """Yield the hint of a motion that did not take its duration."""
        moving = [
            one.time_ns
            for before, one in pairwise(since)
            if self._place(one) is not None and self._place(one) != self._place(before)
        ]
        if len(moving) < _REST_SAMPLES:
            return
        took_s = (moving[-1] - moving[0] + PERIOD_NS) / _NS
        if took_s >= (1.0 - _LATE) * duration_s:
            return
        text = f"the motion took {took_s:.3f} s: its duration of {duration_s:.3f} s was not kept"
        ramps = self._ramps([one for one in since if moving[0] <= one.time_ns <= moving[-1]])
        steep = motion.deceleration * (1.0 + _LATE)
        if ramps and motion.deceleration < motion.acceleration and ramps[1] > steep:
            unit = f"{self.motor.model.unit}/s²"
            text += (
                f"; it slows down at {ramps[1]:.3g} {unit}, not {motion.deceleration:.3g} {unit}"
            )
        yield _Hint("duration", f"{self.motor.name}: {text}")

    @staticmethod
    def _ramps(moving: Sequence[Sample]) -> tuple[float, float] | None:
        """Return the mean acceleration and deceleration between 20 % and 80 % of the top speed."""
        speeds = [abs(one.velocity) for one in moving if one.velocity is not None]
        if len(speeds) < _REST_SAMPLES:
            return None
        top = max(speeds)
        begin = speeds.index(top)
        end = len(speeds) - 1 - speeds[::-1].index(top)
        counts = (
            sum(0.2 * top < speed < 0.8 * top for speed in part)
            for part in (speeds[:begin], speeds[end:])
        )
        rise, fall = counts
        period_s = PERIOD_NS / _NS
        return (
            (0.6 * top / (rise * period_s), 0.6 * top / (fall * period_s))
            if rise and fall
            else None
        )

    def _place(self, one: Sample) -> float | None:
        demand = self._demand(one)
        if demand is not None:
            return demand
        return one.told if one.truth is None else one.truth

    def _unmoved(self, since_ns: int) -> _Hint:
        name = self.motor.name
        if self._observation.has_bus(name) and not self._commands(since_ns):
            return _Hint("nothing sent", f"{name}: nothing was sent on the bus after start()")
        text = f"{name}: the motor did not move after start(): its target was not sent or not taken"
        return _Hint("did not move", text)

    def _commands(self, since_ns: int) -> list[Message]:
        return [one for one in self.messages if one.is_command and one.time_ns >= since_ns]

    def _wrong_way(
        self, what: str, motion: Motion, factor: float, place: float | None = None
    ) -> Iterator[_Hint]:
        """Yield the hint of a distance that is `factor` times the one asked; it ends at `place`."""
        start, target = motion.start, motion.target
        way, unit, gear = target - start, self.motor.model.unit, self.motor.model.gear_ratio
        before = [] if place is None else self._observation.targets(self.motor.name)[:-1]
        if isclose(factor * way, target, rel_tol=_OFF) and abs(start) > _OFF * abs(target):
            text = f"the absolute target {target:g} {unit} was taken as a distance"
        elif isclose(start + factor * way, way, rel_tol=_OFF):
            text = f"the distance {way:g} {unit} was taken as an absolute position"
        elif any(abs(one - (place or 0.0)) <= _OFF * abs(way) for one in before):
            text = "rests at its previous target: the new one was not sent, or not taken"
        elif place is not None and self._turns(place - target):
            turns = self._turns(place - target)
            text = f"rests {turns:+d} turns from its target {target:g} {unit}: reduced to a turn"
        elif place is not None and 0.0 < factor < 1.0 and not name_of(factor, gear, _EXACT):
            return  # it was stopped short, which is no mistake of units
        else:
            yield self._factor(what, "the distance asked", factor)
            return
        key = text.partition(" was ")[0] if place is None else text
        yield _Hint(f"way {without_numbers(key)}", f"{self.motor.name}: {text}")

    def _turns(self, distance: float) -> int:
        """Return the whole number of turns of a distance; 0 if it is not one, or not an angle."""
        if self.motor.model.unit != "rad":
            return 0
        turns = round(distance / (2.0 * _PI))
        return turns if abs(distance - turns * 2.0 * _PI) <= self._window() else 0

    def _sent(self) -> float | None:
        """Return the last target position that the host has sent [inc]."""
        found = None
        for one in self.messages:
            for fact in one.event.facts:
                if fact.told_to and fact.subject.startswith(_TARGET):
                    found = fact.value
        return float(found) if isinstance(found, int) else None

    def refusals(self, *, is_violated: bool) -> Iterator[_Hint]:
        """Yield the refusals of the drive: aborts, exceptions and emergencies."""
        for one in reversed(self.messages):
            event = one.event
            is_abort = event.kind is Kind.SDO_RESPONSE and ": abort" in event.text
            is_exception = event.kind is Kind.MODBUS_RESPONSE and "exception" in event.text
            is_error = event.kind is Kind.EMERGENCY and "no error" not in event.text
            if is_abort and is_violated and _ABSENT in event.text:
                continue  # asked for on trial: many drives lack an optional object
            if is_abort or is_exception or is_error:
                yield _Hint(
                    f"refused {without_numbers(event.text)}", f"the drive answered: {event.text}"
                )
                return

    def evidence(self) -> list[str]:
        """Return the last state and the last messages of the motor."""
        unit, lines = self.motor.model.unit, []
        if self._samples:
            last = self._samples[-1]
            values = [
                f"{what} {value:.6g} {unit}"
                for what, value in (
                    ("demand", self._demand(last)),
                    ("told", last.told),
                    ("truth", last.truth),
                )
                if value is not None
            ]
            if values:
                at = f"{last.time_ns / _NS:.3f} s"
                lines.append(f"position of {self.motor.name} at {at}: {', '.join(values)}")
        messages = self._observation.last_of(self.messages)
        return lines + [f"bus: {text}" for text in messages]

    def curves(self) -> dict[str, tuple[tuple[float, float], ...]]:
        """Return the position demand, told and true over time, with a bounded number of points."""
        step = max(1, len(self._samples) // _CURVE_POINTS)
        found: dict[str, list[tuple[float, float]]] = {"demand": [], "told": [], "truth": []}
        for one in self._samples[::step]:
            values = (self._demand(one), one.told, one.truth)
            for name, value in zip(found, values, strict=True):
                if value is not None:
                    found[name].append((one.time_ns / _NS, value))
        return {name: tuple(points) for name, points in found.items() if points}


_Get = Callable[[Sample], float | None]


def _pairs(samples: Sequence[Sample], x_of: _Get, y_of: _Get) -> list[tuple[float, float]]:
    found = ((x_of(one), y_of(one)) for one in samples)
    return [(x, y) for x, y in found if x is not None and y is not None]


def _slope(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Return the factor of y to x; 0.0 if y is constant, None if there is no straight line."""
    if len(pairs) < _REST_SAMPLES:
        return None
    count = len(pairs)
    mean_x = sum(x for x, _ in pairs) / count
    mean_y = sum(y for _, y in pairs) / count
    xx = sum((x - mean_x) ** 2 for x, _ in pairs)
    yy = sum((y - mean_y) ** 2 for _, y in pairs)
    xy = sum((x - mean_x) * (y - mean_y) for x, y in pairs)
    if xx <= 1e-6 * count:
        return None
    if yy == 0.0:
        return 0.0
    is_straight = xy * xy >= _STRAIGHT**2 * xx * yy
    return xy / xx if is_straight else None
