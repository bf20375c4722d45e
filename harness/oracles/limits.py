"""Oracles of limits: of commands by the motor's model, of measured values by others.

A model's limits apply to commands. A torque-controlled motion may exceed its velocity, and a load
may push a motor anywhere. The model is therefore compared with targets, profile velocities and
accelerations written by hosts. With `MARGIN`, it is also compared with the velocity of a drive that
controls it. A file of limits (`--limits`) applies to all measured values, and so do the drive's own
limits: 607Dh, 607Fh, 6072h, 6073h.

Source: CiA 402-2: software position limit 607Dh, max profile velocity 607Fh, max torque 6072h, max
current 6073h, controlword in pp (bit 4: new set-point, bit 6: relative); the paper, 3.2.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    CONTROLWORD,
    ENABLED,
    MS,
    Axis,
    Oracle,
    Place,
    RecordingContext,
    Violation,
)
from motorhil.harness.oracles.facts import Subject

MARGIN: Final = 1.25
"""A factor for the overshoot of servos and the ripple of sampled velocity."""
_EXACT: Final = 1 + 1e-6
_OFF: Final = 0x7FFF_FFFF
_LOWERED_NS: Final = 500 * MS
_PP, _PV, _IP, _CSP, _CSV = 1, 3, 7, 8, 9
_POSITION_MODES: Final = (_PP, _IP, _CSP)
_NO_TORQUE_MODES: Final = (_PP, _PV, _IP, _CSP, _CSV)
_NEW_SET_POINT: Final = 0x10
_RELATIVE: Final = 0x40


class _Limit(Oracle, ABC):
    """Common base of limits; `quantity` is the start of the keys of a motor's limits."""

    quantity: ClassVar[str] = ""
    truth_key: ClassVar[str] = ""
    motion_key: ClassVar[str] = ""

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._by_controller = context.controllers()

    def compare(
        self,
        time_ns: int,
        axis: Axis | None,
        name: str,
        what: str,
        value: float,
        limits: tuple[float | None, float | None],
        unit: str,
        allowed: float = 0.0,
    ) -> None:
        """Examine a value; it breaks the promise if it exceeds a limit by more than `allowed`."""
        bus, node, number = axis.place if axis is not None else ("", 0, 1)
        low, high = limits
        if (low is None and high is None) or not self.examine(time_ns, bus):
            return
        limit = high
        if low is not None and value < low - allowed:
            limit = low
        elif high is None or value <= high + allowed:
            return
        self.broken(Violation(time_ns, what, bus, node, number, name, value, limit, unit))

    def limits_of(self, one: Subject, suffix: str) -> tuple[float | None, float | None]:
        """Return the limits in a file of limits: lowest and highest, symmetric except position."""
        high = one.limits.get(f"{self.quantity}_max_{suffix}")
        if self.quantity == "position":
            return one.limits.get(f"position_min_{suffix}"), high
        return None if high is None else -high, high

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine a snapshot against a file of limits."""
        for one in self._by_controller.get(controller, ()):
            value = values.get(one.truth_key(self.truth_key))
            if value is not None:
                self.measured(time_ns, None, one, "truth", value)
                self.modelled(time_ns, one, value, values)

    def motion(self, time_ns: int, motor: str, values: Mapping[str, float]) -> None:
        """Examine the value known to the application."""
        one = self.context.facts.motors.get(motor)
        value = values.get(self.motion_key) if self.motion_key else None
        if one is not None and value is not None:
            self.measured(time_ns, None, one, "as known to the application", value)

    def measured(
        self, time_ns: int, axis: Axis | None, one: Subject, what: str, value: float
    ) -> None:
        """Examine a value in SI units against a file of limits."""
        if not one.limits:
            return
        suffix, unit = self.si_unit_of(one)
        text = f"{self.quantity.replace('_', ' ')}, {what}"
        self.compare(time_ns, axis, one.name, text, value, self.limits_of(one, suffix), unit)

    @abstractmethod
    def si_unit_of(self, one: Subject) -> tuple[str, str]:
        """Return the suffix of this motor's keys, and the unit."""

    def modelled(
        self, time_ns: int, one: Subject, value: float, values: Mapping[str, float]
    ) -> None:
        """Examine a snapshot against the model; most quantities have no such limit."""


@final
class PositionLimit(_Limit):
    """The oracle `limit-position`."""

    id = "limit-position"
    promise = "No commanded target exceeds the model's limits, and no position exceeds the drive's"
    source = "the paper, 3.2; CiA 402-2, software position limit 607Dh"
    needs = "no position limit is known: none in a model, none heard (607Dh), no --limits FILE"
    quantity = "position"
    truth_key = "position_rad"
    motion_key = "position"
    objects: ClassVar[Mapping[int, bool]] = {
        **{CONTROLWORD: False, 0x607A: True, 0x607D: True, 0x6064: True, 0x6065: False},
        **{0x6060: True, 0x6061: True, 0x607C: True, 0x6041: False},
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._target: dict[Place, int] = {}
        self._word: dict[Place, int] = {}

    def si_unit_of(self, one: Subject) -> tuple[str, str]:
        """Return "rad" or "m"."""
        return one.unit or "rad", one.unit or "rad"

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a target, the controlword that activates it, or a position."""
        if index == 0x607A and is_written:
            self._target[axis.place] = value
            if axis.mode == _CSP and axis.state == ENABLED:
                self._commanded(time_ns, axis, value)
        elif index == CONTROLWORD and is_written:
            fresh = value & ~self._word.get(axis.place, 0) & _NEW_SET_POINT
            self._word[axis.place] = value
            target = self._target.get(axis.place)
            if fresh and not value & _RELATIVE and axis.mode == _PP and target is not None:
                self._commanded(time_ns, axis, target)
        elif index == 0x6064 and not is_written:
            self._actual(time_ns, axis, value)

    def _commanded(self, time_ns: int, axis: Axis, target: int) -> None:
        one = axis.subject
        if one is None or not one.increments_per_unit:
            return
        position = target / one.increments_per_unit
        low, high = one.commanded.get("position_min"), one.commanded.get("position_max")
        slack = 1.0 / abs(one.increments_per_unit)
        what = "target position 607Ah"
        self.compare(time_ns, axis, one.name, what, position, (low, high), one.unit, slack)

    def _actual(self, time_ns: int, axis: Axis, value: int) -> None:
        one = axis.subject
        if one is not None and one.limits:
            self.compare(
                *(time_ns, axis, one.name, "position actual value 6064h"),
                *(float(value), self.limits_of(one, "inc"), "inc"),
            )
            if one.increments_per_unit:
                what = "position actual value 6064h"
                self.measured(time_ns, axis, one, what, value / one.increments_per_unit)
        low, high = axis.objects.get((0x607D, 1)), axis.objects.get((0x607D, 2))
        if low is None or high is None or low >= high:
            return  # CiA 402-2: no limit in this case
        if axis.mode not in _POSITION_MODES or axis.state != ENABLED:
            return
        # A drive without a reference ignores it, and it may count from home or from zero.
        window = axis.objects.get((0x6065, 0), 0)
        slack = window if window < _OFF else 0
        slack += abs(axis.objects.get((0x607C, 0), 0)) + (high - low) // 100
        what = "position actual value 6064h beyond 607Dh"
        self.compare(time_ns, axis, axis.name, what, value, (low, high), "inc", slack)


@final
class VelocityLimit(_Limit):
    """The oracle `limit-velocity`."""

    id = "limit-velocity"
    promise = "No velocity beyond the model's is commanded, or reached under the drive's control"
    source = "the paper, 3.2; CiA 402-2, max profile velocity 607Fh"
    needs = "no velocity limit is known: none in a model, none heard (607Fh), no --limits FILE"
    quantity = "velocity"
    truth_key = "velocity_rad_s"
    motion_key = "velocity"
    objects: ClassVar[Mapping[int, bool]] = {
        **{0x6081: False, 0x60FF: True, 0x606C: True, 0x607F: False},
        **{0x6060: True, 0x6061: True, 0x6041: False},
    }

    def si_unit_of(self, one: Subject) -> tuple[str, str]:
        """Return the unit per second."""
        unit = one.unit or "rad"
        return f"{unit}_s", f"{unit}/s"

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a commanded or measured velocity."""
        one = axis.subject
        if is_written and (index == 0x6081 or (index == 0x60FF and axis.mode == _PV)):
            if one is not None and one.velocity_unit and "velocity_max" in one.commanded:
                limit, unit = one.commanded["velocity_max"], abs(one.velocity_unit)
                what = f"{'profile' if index == 0x6081 else 'target'} velocity {index:04X}h"
                slack = limit * (_EXACT - 1) + unit
                speed = abs(value) * unit
                name = f"{one.unit}/s"
                self.compare(time_ns, axis, one.name, what, speed, (None, limit), name, slack)
        elif index == 0x606C and not is_written:
            self._actual(time_ns, axis, value)

    def _actual(self, time_ns: int, axis: Axis, value: int) -> None:
        one, what = axis.subject, "velocity actual value 606Ch"
        if one is not None and one.limits:
            self.compare(
                time_ns, axis, one.name, what, value, self.limits_of(one, "raw"), "as 606Ch"
            )
            if one.velocity_unit:
                self.measured(time_ns, axis, one, what, value * one.velocity_unit)
        limit = axis.objects.get((0x607F, 0))
        if not limit or limit >= _OFF or axis.mode not in _NO_TORQUE_MODES:
            return
        if axis.state != ENABLED or not self.examine(time_ns, axis.place[0]):
            return
        if abs(value) > limit * MARGIN:
            numbers = (float(abs(value)), float(limit), "as 606Ch")
            found = axis.violation(time_ns, f"{what} beyond 607Fh", *numbers)
            if abs(value) > 2 * limit:
                self.doubt(found, "606Ch may have another unit than 607Fh")
            else:
                self.broken(found)

    def modelled(
        self, time_ns: int, one: Subject, value: float, values: Mapping[str, float]
    ) -> None:
        """Examine the velocity of a drive that is in control without a torque command."""
        limit = one.commanded.get("velocity_max")
        if limit is None or one.place is None:
            return
        state, axis = values.get("state"), self.context.axes.get(one.place)
        if state is not None:
            steady = axis is not None and time_ns - axis.state_ns > _LOWERED_NS
            if state != ENABLED or values.get("mode") not in _NO_TORQUE_MODES or not steady:
                return
        if not self.examine(time_ns) or abs(value) <= limit * MARGIN:
            return
        found = Violation(
            *(time_ns, "velocity, truth", "", 0, 1, one.name),
            *(abs(value), limit * MARGIN, f"{one.unit}/s"),
        )
        if state is None:
            self.doubt(
                found, "the recording does not show whether it had a torque command or was pushed"
            )
        else:
            self.broken(found)


@final
class AccelerationLimit(_Limit):
    """The oracle `limit-acceleration`."""

    id = "limit-acceleration"
    promise = "No acceleration beyond the model's is commanded, and none exceeds a file of limits"
    source = "the paper, 3.2; CiA 402-2, profile acceleration 6083h, profile deceleration 6084h"
    needs = "no profile acceleration with known unit and limit was commanded, no --limits FILE"
    quantity = "acceleration"
    objects: ClassVar[Mapping[int, bool]] = {0x6083: False, 0x6084: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._before: dict[str, tuple[int, float]] = {}

    def si_unit_of(self, one: Subject) -> tuple[str, str]:
        """Return the unit per second squared."""
        unit = one.unit or "rad"
        return f"{unit}_s2", f"{unit}/s2"

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a commanded profile acceleration or deceleration."""
        one = axis.subject
        if not is_written or one is None or not one.acceleration_unit:
            return
        limit = one.commanded.get("acceleration_max")
        if index == 0x6084:
            limit = one.commanded.get("deceleration_max", limit)
        if limit is None:
            return
        what = f"profile {'acceleration' if index == 0x6083 else 'deceleration'} {index:04X}h"
        unit = abs(one.acceleration_unit)
        slack = limit * (_EXACT - 1) + unit
        name = f"{one.unit}/s2"
        self.compare(time_ns, axis, one.name, what, value * unit, (None, limit), name, slack)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine the mean between two snapshots, which never exceeds the maximum."""
        for one in self._by_controller.get(controller, ()):
            velocity = values.get(one.truth_key("velocity_rad_s"))
            if velocity is None or "acceleration_max_rad_s2" not in one.limits:
                continue
            before = self._before.get(one.name)
            self._before[one.name] = time_ns, velocity
            if before is not None and time_ns > before[0]:
                mean = (velocity - before[1]) / ((time_ns - before[0]) / 1e9)
                self.measured(time_ns, None, one, "truth, mean of two snapshots", mean)


@final
class TorqueLimit(_Limit):
    """The oracle `limit-torque`."""

    id = "limit-torque"
    promise = "Torque and current stay within the drive's limits 6072h, 6073h and a limits file's"
    source = "CiA 402-2, max torque 6072h, max current 6073h [0.1 % of rated]"
    needs = "no torque is known with its limit: no 6077h with 6072h, no --limits FILE"
    quantity = "torque"
    truth_key = "torque_n_m"
    motion_key = "effort"
    objects: ClassVar[Mapping[int, bool]] = {
        0x6072: False,
        0x6073: False,
        0x6077: True,
        0x6078: True,
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._lowered: dict[tuple[Place, int], tuple[int, int]] = {}  # end of validity, old limit
        self._limit: dict[tuple[Place, int], int] = {}

    def si_unit_of(self, one: Subject) -> tuple[str, str]:
        """Return the suffix and unit of torque, or of force."""
        return ("n", "N") if one.unit == "m" else ("n_m", "N m")

    def limits_of(self, one: Subject, suffix: str) -> tuple[float | None, float | None]:
        """Return the limits; a force has its own key."""
        high = one.limits.get("force_max_n" if suffix == "n" else f"torque_max_{suffix}")
        return None if high is None else -high, high

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine a snapshot, including the current."""
        super().truth(time_ns, controller, values)
        for one in self._by_controller.get(controller, ()):
            current = values.get(one.truth_key("current_a"))
            limit = one.limits.get("current_max_a")
            if current is not None and limit is not None:
                self.compare(
                    time_ns, None, one.name, "current, truth", current, (-limit, limit), "A"
                )

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a limit, or examine a limited value."""
        key = (axis.place, index)
        if index in (0x6072, 0x6073):
            before = self._limit.get(key, 0)
            if value < before:  # the old limit may still apply for a while
                self._lowered[key] = time_ns + _LOWERED_NS, before
            self._limit[key] = value
            return
        if is_written:
            return
        one, what = axis.subject, f"{'torque' if index == 0x6077 else 'current'} {index:04X}h"
        if one is not None and index == 0x6077:
            limits = self.limits_of(one, "permille")
            self.compare(time_ns, axis, one.name, what, value, limits, "permille")
        key = (axis.place, index - 5)  # 6072h limits 6077h, 6073h limits 6078h
        limit = self._limit.get(key)
        if not limit:
            return
        until_ns, old = self._lowered.get(key, (0, 0))
        if time_ns < until_ns:
            limit = max(limit, old)
        slack = 0.05 * limit + 20
        self.compare(time_ns, axis, axis.name, what, value, (-limit, limit), "permille", slack)
