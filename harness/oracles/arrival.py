"""Oracle of target reached: where a drive says it has arrived, its motor has.

A sample is older than the message that brings it. So a drive has not arrived if the samples before
and after its statusword lie outside the window, on one side, or if the last one before it is too
young for the window time. A target is known from the edge of bit 4 of the controlword on (pp), or
from its confirmation (pv).

Source: CiA 402-2: statusword bit 10; pp: 607Ah, controlword bits 4 to 6, windows 6067h and 6068h;
pv: 60FFh, windows 606Dh and 606Eh.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    BIT_12,
    CONTROLWORD,
    ENABLED,
    MODE_DISPLAY,
    MS,
    STATUSWORD,
    TARGET_REACHED,
    Axis,
    Oracle,
    Place,
    RecordingContext,
    forget,
)
from motorhil.traces.decoding.events import DecodedEvent

_PP, _PV = 1, 3
_NEW, _AT_ONCE, _RELATIVE, _HALT = 0x10, 0x20, 0x40, 0x100
_LIMITED: Final = 0x0800
_POSITION, _TARGET = 0x6064, 0x607A
_VELOCITY, _TARGET_VELOCITY = 0x606C, 0x60FF
_ACTUAL: Final = {_PP: _POSITION, _PV: _VELOCITY}
_WINDOWS: Final = {_PP: (0x6067, 0x6068), _PV: (0x606D, 0x606E)}
_OFF: Final = 0xFFFF
_NEAR_NS: Final = 50 * MS
_LAG_NS: Final = 100 * MS
_SETTLE_NS: Final = 20 * MS


@final
@dataclass(slots=True)
class _Way:
    """The way of one axis to its target.

    Attributes:
        target, since_ns: the target in force, and since when; None: unknown.
        word: the last controlword.
        is_taken: True if a statusword without bit 10, or with bit 12, was heard since then.
        outside_ns, outside: the last sample outside the window, and its distance.
        claim_ns, claimed: the last claim of arrival after it, and the distance before it.
        said_ns: the last claim of arrival; `between`: a sample outside since then, by SDO.
        reached: the last statusword had bit 10.
    """

    target: int | None = None
    since_ns: int = 0
    word: int = 0
    is_taken: bool = False
    outside_ns: int | None = None
    outside: int = 0
    claim_ns: int | None = None
    claimed: int = 0
    said_ns: int | None = None
    between: int | None = None
    reached: bool = False

    def aim(self, time_ns: int, target: int | None) -> None:
        """Set the target in force."""
        self.target, self.since_ns, self.is_taken = target, time_ns, False
        self.outside_ns = self.claim_ns = self.said_ns = self.between = None


@final
class Arrival(Oracle):
    """The oracle `arrival-true`."""

    id = "arrival-true"
    promise = (
        "While a drive reports target reached in pp or pv, the actual value lies in its window, "
        "and has done so for the window time"
    )
    source = "CiA 402-2, statusword bit 10, windows 6067h, 6068h (pp), 606Dh, 606Eh (pv)"
    needs = "no target, window and actual value were heard together with a statusword in pp or pv"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, CONTROLWORD: False, MODE_DISPLAY: True, 0x6060: True},
        **{_TARGET: True, _POSITION: True, _TARGET_VELOCITY: True, _VELOCITY: True},
        **{0x6067: False, 0x6068: False, 0x606D: False, 0x606E: False},
        **{0x607D: True, 0x607E: False, 0x607F: False, 0x60F2: False, 0x6082: False},
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._ways: dict[Place, _Way] = {}
        self._answer_ns = -1

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Take the time of a message by SDO: its value is not older than the request."""
        self._answer_ns = time_ns

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the targets of a node that has booted."""
        forget(self._ways, bus, node)

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a command or a sample, or examine a statusword."""
        way = self._ways.setdefault(axis.place, _Way())
        if index == CONTROLWORD:
            if is_written:
                self._controlled(time_ns, axis, way, value)
        elif index == _TARGET_VELOCITY and is_written:
            if axis.mode == _PV:
                way.aim(time_ns, value)
        elif index == STATUSWORD and not is_written:
            self._status(time_ns, axis, way, value)
        elif index == _ACTUAL.get(axis.mode or 0) and not is_written:
            self._sample(time_ns, axis, way, value)
        elif index != _TARGET and (is_written or (index == MODE_DISPLAY and value not in _ACTUAL)):
            way.aim(time_ns, None)

    def _controlled(self, time_ns: int, axis: Axis, way: _Way, word: int) -> None:
        before, way.word = way.word, word
        if word & 0x0F != 0x0F or word & _HALT or before & _HALT:
            way.aim(time_ns, None)
            return
        if axis.mode != _PP or not word & ~before & _NEW:
            return
        at_rest = way.reached and way.target is not None
        offered = axis.objects.get((_TARGET, 0))  # that of the same PDO, wherever it is in it
        if offered is None or (way.target == offered and not word & _RELATIVE):
            way.aim(time_ns, None)  # nothing shows when an equal target is taken
        elif not word & _RELATIVE:
            is_first = at_rest or way.target is None or word & _AT_ONCE
            way.aim(time_ns, offered if is_first else None)
        else:  # counts from the target before, or from the position, which is there
            is_known = at_rest and way.target is not None
            way.aim(time_ns, (way.target or 0) + offered if is_known else None)

    def _status(self, time_ns: int, axis: Axis, way: _Way, word: int) -> None:
        was_reached, way.reached = way.reached, bool(word & TARGET_REACHED)
        window = self._window(axis, way)
        if window is None or axis.state != ENABLED or word & _LIMITED:
            way.claim_ns = None
            return
        way.is_taken = way.is_taken or not way.reached or bool(word & BIT_12)
        if not way.reached or not way.is_taken or time_ns - way.since_ns < _SETTLE_NS:
            way.claim_ns = way.said_ns = way.between = None
            return
        if way.between is not None:  # claims before and after it
            self._accuse(time_ns, axis, way, abs(way.between), window)
        way.said_ns, way.between = time_ns, None
        if way.outside_ns is None or not self.examine(time_ns, axis.place[0]):
            return
        asked_ns = axis.objects.get((_WINDOWS[axis.mode or 0][1], 0), 0) * MS
        age_ns = time_ns - way.outside_ns
        if not was_reached and age_ns < asked_ns - _LAG_NS:
            text = "target reached before the end of the window time"
            self.absent(axis.violation(time_ns, text, age_ns / 1e6, asked_ns / 1e6, "ms"))
        if age_ns <= _NEAR_NS and way.claim_ns is None:
            way.claim_ns, way.claimed = time_ns, way.outside

    def _sample(self, time_ns: int, axis: Axis, way: _Way, value: int) -> None:
        window = self._window(axis, way)
        if window is None or way.target is None:
            return
        away = value - way.target
        if abs(away) <= window + 1:
            way.claim_ns = way.between = None
            return
        way.outside_ns, way.outside = time_ns, away
        if way.said_ns is not None and time_ns == self._answer_ns:
            way.between = away
        claim_ns, way.claim_ns = way.claim_ns, None
        if claim_ns is not None and time_ns - claim_ns <= _NEAR_NS and away * way.claimed > 0:
            self._accuse(claim_ns, axis, way, min(abs(away), abs(way.claimed)), window)

    def _accuse(self, time_ns: int, axis: Axis, way: _Way, away: int, window: int) -> None:
        text = f"target {way.target} reported as reached, outside its window"
        numbers = (float(away), float(window), f"as {_ACTUAL[axis.mode or 0]:04X}h")
        self.absent(axis.violation(time_ns, text, *numbers))

    def _window(self, axis: Axis, way: _Way) -> int | None:
        """Return the window of the mode; None: unknown, or nothing is to be judged."""
        if axis.mode not in _WINDOWS or not axis.has_display or way.target is None:
            return None
        low, high = axis.objects.get((0x607D, 1)), axis.objects.get((0x607D, 2))
        is_limited = axis.mode == _PP and low is not None and high is not None and low < high
        if is_limited and not (low or 0) <= way.target <= (high or 0):
            return None
        limit = axis.objects.get((0x607F, 0))
        if axis.mode == _PV and limit and abs(way.target) > limit:
            return None
        window = axis.objects.get((_WINDOWS[axis.mode][0], 0))
        is_off = window is None or window >= (0xFFFF_FFFF if axis.mode == _PP else _OFF)
        return None if is_off else window
