"""Oracles of a drive's motion: with power, without, and at rest.

A motor rests while its drive or its group reports the end of motion.

Source: CiA 402-2: statusword (following error, target reached, homing attained), following error
window 6065h and time-out 6066h, position window 6067h, states without power; the paper, 3.3.3
(waiting blocks until the motion is over) and Algorithm 2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    BIT_12,
    BIT_13,
    CONTROLWORD,
    DISABLED,
    ENABLED,
    FAULT,
    MS,
    NOT_READY,
    READY,
    SETTLE_NS,
    STATUSWORD,
    TARGET_REACHED,
    Axis,
    Oracle,
    Place,
    RecordingContext,
    Violation,
    forget,
)
from motorhil.traces.schema import LockAction

_POSITION: Final = 0x6064
_OFF: Final = 0xFFFF_FFFF
_PP, _HM, _IP, _CSP = 1, 6, 7, 8
_POWERLESS: Final = (NOT_READY, DISABLED, READY, FAULT)
_CURRENT_SETTLE_NS: Final = 50 * MS
_TRUTH_SHARE: Final = 0.01
_PERMILLE: Final = 50.0
_NEW_SET_POINT: Final = 0x0010
_LEAST_INC: Final = 4
_SHARE: Final = 0.02
"""The allowed share of the travelled distance if no window is known."""
_TAKES: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)


@final
class Following(Oracle):
    """The oracle `following-bounded`."""

    id = "following-bounded"
    promise = (
        "A following error beyond its window 6065h for longer than 6066h is reported (bit 13, "
        "or a fault); none exceeds the limit of --limits FILE"
    )
    source = "CiA 402-2, following error window 6065h, time-out 6066h, statusword bit 13"
    needs = "no following error (60F4h, or truth) is known with its window 6065h, or its limit"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, 0x60F4: True, 0x6062: True, _POSITION: True},
        **{0x6065: False, 0x6066: False, 0x6060: True, 0x6061: True},
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._since: dict[Place, int] = {}
        self._reported: dict[Place, bool] = {}
        self._by_controller = context.controllers()

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a following error, or a statusword that ends its excess."""
        if index == 0x60F4:
            self._error(time_ns, axis, value)
        elif index == STATUSWORD and (axis.state != ENABLED or value & BIT_13):
            self._since.pop(axis.place, None)
            self._reported.pop(axis.place, None)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine the true error of an emulated drive, which may be absent on the bus."""
        error = values.get("following_error_inc")
        if error is None:
            return
        for one in self._by_controller.get(controller, ()):
            if one.place is not None and one.channel == 1 and one.place in self.context.axes:
                self._error(time_ns, self.context.axes[one.place], error)

    def _error(self, time_ns: int, axis: Axis, error: float) -> None:
        if axis.state != ENABLED or axis.mode not in (_PP, _IP, _CSP):
            return
        self._held_to_file(time_ns, axis, error)
        window = axis.objects.get((0x6065, 0))
        if window is None or window >= _OFF or axis.word is None or axis.word & BIT_13:
            return
        if not self.examine(time_ns, axis.place[0]):
            return
        if abs(error) <= window:
            self._since.pop(axis.place, None)
            self._reported.pop(axis.place, None)
            return
        since_ns = self._since.setdefault(axis.place, time_ns)
        limit_ns = axis.objects.get((0x6066, 0), 0) * MS + SETTLE_NS
        if time_ns - since_ns > limit_ns and axis.place not in self._reported:
            self._reported[axis.place] = True
            text = f"following error since {since_ns / 1e9:.6f} s, not reported by the drive"
            numbers = (abs(error), float(window), "inc")
            self.broken(axis.violation(time_ns, text, *numbers))

    def _held_to_file(self, time_ns: int, axis: Axis, error: float) -> None:
        """Examine the error against a file of limits, in increments or in the motor's unit."""
        one = axis.subject
        if one is None:
            return
        limit, scale, unit = one.limits.get("following_error_max_inc"), 1.0, "inc"
        if limit is None and one.increments_per_unit is not None:
            limit = one.limits.get(f"following_error_max_{one.unit}")
            scale, unit = abs(one.increments_per_unit), one.unit
        bus = axis.place[0]
        if limit is None or not self.examine(time_ns, bus) or abs(error) <= limit * scale:
            return
        numbers = (abs(error) / scale, limit, unit)
        self.broken(axis.violation(time_ns, "following error", *numbers))


@final
class TorqueOff(Oracle):
    """The oracle `torque-off`."""

    id = "torque-off"
    promise = "A motor makes no torque after its power stage is off: STO, switched off, or a fault"
    source = "CiA 402-2, PDS FSA: drive power is disabled; IEC 61800-5-2, safe torque off"
    needs = "no drive without power was heard together with its torque (6077h, 6078h, or truth)"
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, 0x6077: True, 0x6078: True}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._off: dict[str, int] = {}  # start time, by controller
        self._peak: dict[str, float] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a measured torque or current [0.1 % of rated]."""
        if index == STATUSWORD or is_written or axis.state not in _POWERLESS:
            return
        if time_ns - axis.state_ns < SETTLE_NS:
            return
        bus = axis.place[0]
        if self.examine(time_ns, bus) and abs(value) > _PERMILLE:
            what = "torque" if index == 0x6077 else "current"
            text = f"{what} without power, since {axis.state_ns / 1e9:.6f} s"
            numbers = (abs(float(value)), _PERMILLE, "permille")
            self.broken(axis.violation(time_ns, text, *numbers))

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine the motor's true torque in the drive's true state."""
        torque, state = values.get("torque_n_m"), values.get("state")
        if torque is None or state is None:
            return
        peak = self._peak[controller] = max(self._peak.get(controller, 0.0), abs(torque))
        if state not in _POWERLESS:
            self._off.pop(controller, None)
            return
        since_ns = self._off.setdefault(controller, time_ns)
        if time_ns - since_ns < _CURRENT_SETTLE_NS or not self.examine(time_ns):
            return
        limit = peak * _TRUTH_SHARE
        if abs(torque) > max(limit, 1e-9):
            text = f"torque without power, since {since_ns / 1e9:.6f} s"
            numbers = (abs(torque), limit, "N m")
            self.broken(Violation(time_ns, text, "", 0, 1, controller, *numbers))


def says_rest(axis: Axis) -> bool:
    """Return True if the drive's last statusword reports standstill."""
    word, mode = axis.word, axis.mode
    if word is None or mode is None or axis.state != ENABLED:
        return False
    reached = bool(word & TARGET_REACHED)
    if mode == _HM:
        return reached and bool(word & BIT_12) and not word & BIT_13
    return mode == _PP and reached and not word & BIT_12


@final
@dataclass(slots=True)
class _Rest:
    """A time in which a drive reports standstill.

    Attributes:
        from_ns: its start [ns].
        low, high: range of 6064h after the settling time.
        moved_ns: when the range last grew [ns].
        sampled: True if there was a sample.
        confirmed, confirmed_ns: the range, and its time, when standstill was last reported.
    """

    from_ns: int
    low: int = 0
    high: int = 0
    moved_ns: int = 0
    sampled: bool = False
    confirmed: int = 0
    confirmed_ns: int = 0


@final
@dataclass(slots=True)
class _Motor:
    """A motor as known to its application.

    Attributes:
        is_free: True without an owner; None: handovers are not recorded.
        since_ns: start of the reported rest [ns].
        low, high: range of all positions.
        at: the position at rest.
        worst, worst_ns: the position farthest from there, and its time [ns].
    """

    is_free: bool | None = None
    since_ns: int | None = None
    low: float = float("inf")
    high: float = float("-inf")
    at: float = 0.0
    worst: float = 0.0
    worst_ns: int = 0


@final
class AtRest(Oracle):
    """The oracle `rest-when-told`."""

    id = "rest-when-told"
    promise = (
        "A motor stays at rest while its drive reports target reached (pp) or homing attained "
        "(hm), and after the end of its group's motion until it has a new owner"
    )
    source = "CiA 402-2, statusword bits 10 and 12, position window 6067h; the paper, 3.3.3"
    needs = "no drive with known mode and position (6064h) reported arrival, no group ended"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, CONTROLWORD: False, _POSITION: True},
        **{0x6060: True, 0x6061: True, 0x6067: False, 0x6068: False},
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._rests: dict[Place, _Rest] = {}
        self._travel: dict[Place, tuple[int, int]] = {}  # lowest and highest position so far
        self._motors: dict[str, _Motor] = {}

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the rest of a node that has booted."""
        forget(self._rests, bus, node)

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a controlword, a statusword, a mode, or a position."""
        place = axis.place
        if index == _POSITION:
            self._position(time_ns, place, value)
        elif index == CONTROLWORD:
            if is_written and value & (_NEW_SET_POINT | 0x0F) != 0x0F:
                self._close(time_ns, axis)  # it may begin to move before it reports so
        elif index in (STATUSWORD, 0x6060, 0x6061) and not (is_written and index == STATUSWORD):
            self._word(time_ns, axis)

    def _position(self, time_ns: int, place: Place, value: int) -> None:
        low, high = self._travel.get(place, (value, value))
        self._travel[place] = min(low, value), max(high, value)
        rest = self._rests.get(place)
        if rest is None or time_ns - rest.from_ns < SETTLE_NS:
            return
        if not rest.sampled:
            rest.sampled, rest.low, rest.high = True, value, value
        elif value < rest.low or value > rest.high:
            rest.low, rest.high, rest.moved_ns = (
                min(rest.low, value),
                max(rest.high, value),
                time_ns,
            )

    def _word(self, time_ns: int, axis: Axis) -> None:
        rest = self._rests.get(axis.place)
        if not says_rest(axis):
            self._close(time_ns, axis)
        elif rest is None:
            self._rests[axis.place] = _Rest(time_ns)
        else:  # it moved, and reported standstill afterwards
            rest.confirmed, rest.confirmed_ns = rest.high - rest.low, rest.moved_ns

    def _close(self, time_ns: int, axis: Axis) -> None:
        """Examine a rest that the drive no longer reports."""
        rest = self._rests.pop(axis.place, None)
        if rest is None or not rest.sampled or not self.examine(time_ns, axis.place[0]):
            return
        window = axis.objects.get((0x6067, 0), 0)
        low, high = self._travel[axis.place]
        bound = max(_LEAST_INC, 2 * window if 0 < window < _OFF else (high - low) * _SHARE)
        if rest.confirmed > bound:
            since = f"{rest.from_ns / 1e9:.6f} s"
            text = f"moves while it reports arrival, since {since}"
            numbers = (float(rest.confirmed), float(bound), "inc")
            self.broken(axis.violation(rest.confirmed_ns, text, *numbers))

    def end(self, time_ns: int) -> None:
        """Examine the rests that are still reported."""
        for place in list(self._rests):
            self._close(time_ns, self.context.axis(place))
        for name in self._motors:
            self._leave(time_ns, name)

    # ------------------------------------------------------------------------- motors of groups

    def lock(self, time_ns: int, motor: str, action: LockAction) -> None:
        """Take a handover: only an owner may move the motor."""
        one = self._motors.setdefault(motor, _Motor())
        if action in _TAKES:
            self._leave(time_ns, motor)
            one.is_free = False
        elif action is LockAction.RELEASED:
            one.is_free = True
            if one.since_ns is not None:
                one.since_ns = max(one.since_ns, time_ns)

    def group(self, time_ns: int, motors: Sequence[str], is_start: bool) -> None:
        """Begin the rest of a group's motors at its end, if their handovers are recorded."""
        for name in motors:
            one = self._motors.setdefault(name, _Motor())
            self._leave(time_ns, name)
            one.since_ns = None if is_start or one.is_free is None else time_ns

    def motion(self, time_ns: int, motor: str, values: Mapping[str, float]) -> None:
        """Take a position known to the application."""
        one, at = self._motors.get(motor), values.get("position")
        if at is None:
            return
        if one is None:
            one = self._motors[motor] = _Motor()
        one.low, one.high = min(one.low, at), max(one.high, at)
        resting = one.is_free and one.since_ns is not None
        if not resting or one.since_ns is None or time_ns - one.since_ns < SETTLE_NS:
            one.at, one.worst, one.worst_ns = at, at, 0
        elif abs(at - one.at) > max(abs(one.worst - one.at), 1e-9):
            one.worst, one.worst_ns = at, time_ns

    def _leave(self, time_ns: int, motor: str) -> None:
        """Examine a rest that has ended; a motor without recorded states does not change."""
        one = self._motors[motor]
        since_ns, one.since_ns = one.since_ns, None
        rested = since_ns is not None and one.is_free and time_ns - since_ns >= SETTLE_NS
        if rested and one.high >= one.low and self.examine(time_ns):
            moved, limit = abs(one.worst - one.at), max((one.high - one.low) * _SHARE, 1e-6)
            if one.worst_ns and moved > limit:
                text = "moves after the end of its group's motion, without an owner"
                subject = self.context.facts.motors.get(motor)
                unit = subject.unit if subject is not None else ""
                numbers = (moved, limit, unit or "rad or m")
                self.broken(Violation(one.worst_ns, text, "", 0, 1, motor, *numbers))
        one.worst, one.worst_ns = one.at, 0
