"""Oracles of what a drive says of its motion: rest, following error, torque without power.

Source: CiA 402-2: statusword (target reached, following error, speed is 0, homing attained),
position window 6067h, following error window 6065h and time-out 6066h, states without power.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, final

from harness.oracles.finding import Violation
from harness.oracles.oracle import MS, Oracle
from harness.oracles.scene import (
    BIT_12,
    BIT_13,
    CONTROLWORD,
    DISABLED,
    ENABLED,
    FAULT,
    NOT_READY,
    READY,
    STATUSWORD,
    TARGET_REACHED,
    Axis,
    Place,
    Scene,
)

_POSITION: Final = 0x6064
_OFF: Final = 0xFFFF_FFFF
SETTLE_NS: Final = 100 * MS
"""A sample may be older than the word beside it by what a PDO waits; a servo settles."""
_PP, _HM, _IP, _CSP = 1, 6, 7, 8
_NEW_SET_POINT: Final = 0x0010
_LEAST_INC: Final = 4
_REST_SHARE: Final = 0.02


def says_rest(axis: Axis) -> bool:
    """Whether the drive tells by its last statusword that it stands still."""
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
    """A time in which a drive says that it stands still.

    Attributes: from_ns; low, high (of 6064h behind the settling); moved_ns (when it was largest);
    sampled (whether there was any); confirmed (the span when it last said so).
    """

    from_ns: int
    low: int = 0
    high: int = 0
    moved_ns: int = 0
    sampled: bool = False
    confirmed: int = 0
    confirmed_ns: int = 0


@final
class AtRest(Oracle):
    """`rest-when-told`."""

    id = "rest-when-told"
    promise = (
        "While a drive in pp tells target reached, or in hm homing attained, its position stays"
        " within its window"
    )
    source = "CiA 402-2, statusword bits 10 and 12, position window 6067h; the paper, 3.3.3"
    needs = "no drive told position (6064h), mode (6060h, 6061h) and that it had arrived"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, CONTROLWORD: False, _POSITION: True},
        **{0x6060: True, 0x6061: True, 0x6067: False, 0x6068: False},
    }

    def __init__(self, scene: Scene) -> None:
        """See Oracle."""
        super().__init__(scene)
        self._rests: dict[Place, _Rest] = {}
        self._travel: dict[Place, tuple[int, int]] = {}  # lowest and highest position so far
        self._at: dict[Place, int] = {}

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """It says nothing any more."""
        for place in [place for place in self._rests if place[:2] == (bus, node)]:
            del self._rests[place]

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """A word, a mode, a position."""
        place = axis.place
        if index == _POSITION:
            self._position(time_ns, place, value)
        elif index == CONTROLWORD:
            if told_to and value & (_NEW_SET_POINT | 0x0F) != 0x0F:
                self._close(time_ns, axis)  # it may begin to move before it says so
        elif index in (STATUSWORD, 0x6060, 0x6061) and not (told_to and index == STATUSWORD):
            self._word(time_ns, axis)

    def _position(self, time_ns: int, place: Place, value: int) -> None:
        self._at[place] = value
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
        else:  # it moved, and still said so afterwards
            rest.confirmed, rest.confirmed_ns = rest.high - rest.low, rest.moved_ns

    def _close(self, time_ns: int, axis: Axis) -> None:
        """It says so no longer."""
        rest = self._rests.pop(axis.place, None)
        if rest is None or not rest.sampled or not self.look(time_ns, axis.place[0]):
            return
        bus, node, number = axis.place
        window = axis.objects.get((0x6067, 0), 0)
        low, high = self._travel[axis.place]
        bound = max(_LEAST_INC, 2 * window if 0 < window < _OFF else (high - low) * _REST_SHARE)
        if rest.confirmed > bound:
            since = f"{rest.from_ns / 1e9:.6f} s"
            text = f"moves while it says, since {since}, that it has arrived"
            self.broken(
                Violation(
                    *(rest.confirmed_ns, text, bus, node, number, axis.name),
                    *(float(rest.confirmed), float(bound), "inc"),
                )
            )

    def end(self, time_ns: int) -> None:
        """Those that still say so."""
        for place in list(self._rests):
            self._close(time_ns, self.scene.axis(place))


@final
class Following(Oracle):
    """`following-bounded`."""

    id = "following-bounded"
    promise = (
        "A following error beyond its window 6065h for longer than 6066h is told: bit 13, a fault"
    )
    source = "CiA 402-2, following error window 6065h, time-out 6066h, statusword bit 13"
    needs = "nobody told a following error (60F4h, 6062h with 6064h, or truth) and its window 6065h"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, 0x60F4: True, 0x6062: True, _POSITION: True},
        **{0x6065: False, 0x6066: False, 0x6060: True, 0x6061: True},
    }

    def __init__(self, scene: Scene) -> None:
        """See Oracle."""
        super().__init__(scene)
        self._since: dict[Place, int] = {}
        self._told: dict[Place, bool] = {}
        self._by_controller = scene.controllers()

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """An error, or what ends its being too large."""
        if index == 0x60F4:
            self._error(time_ns, axis, value)
        elif index == STATUSWORD and (axis.state != ENABLED or value & BIT_13):
            self._since.pop(axis.place, None)
            self._told.pop(axis.place, None)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """The emulated drive's own error, of which it may tell nothing on the bus."""
        error = values.get("following_error_inc")
        if error is None:
            return
        for one in self._by_controller.get(controller, ()):
            if one.place is not None and one.channel == 1 and one.place in self.scene.axes:
                self._error(time_ns, self.scene.axes[one.place], error)

    def _error(self, time_ns: int, axis: Axis, error: float) -> None:
        window = axis.objects.get((0x6065, 0))
        if window is None or window >= _OFF or axis.mode not in (_PP, _IP, _CSP):
            return
        if axis.state != ENABLED or axis.word is None or axis.word & BIT_13:
            return
        bus, node, number = axis.place
        if not self.look(time_ns, bus):
            return
        if abs(error) <= window:
            self._since.pop(axis.place, None)
            self._told.pop(axis.place, None)
            return
        since_ns = self._since.setdefault(axis.place, time_ns)
        limit_ns = axis.objects.get((0x6066, 0), 0) * MS + SETTLE_NS
        if time_ns - since_ns > limit_ns and axis.place not in self._told:
            self._told[axis.place] = True
            text = f"following error since {since_ns / 1e9:.6f} s, and the drive does not tell it"
            numbers = (abs(error), float(window), "inc")
            self.broken(Violation(time_ns, text, bus, node, number, axis.name, *numbers))


_POWERLESS: Final = (NOT_READY, DISABLED, READY, FAULT)
_CURRENT_SETTLE_NS: Final = 50 * MS
_TRUTH_SHARE: Final = 0.01
_PERMILLE: Final = 50.0


@final
class TorqueOff(Oracle):
    """`torque-off`."""

    id = "torque-off"
    promise = "A motor makes no torque once its power stage is off: STO, switched off, or a fault"
    source = "CiA 402-2, PDS FSA: drive power is disabled; IEC 61800-5-2, safe torque off"
    needs = "no drive was heard without power whose torque (6077h, 6078h, or truth) is told, too"
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, 0x6077: True, 0x6078: True}

    def __init__(self, scene: Scene) -> None:
        """See Oracle."""
        super().__init__(scene)
        self._off: dict[str, int] = {}  # by controller, since when
        self._peak: dict[str, float] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """A measured torque or current, in thousandths of what is rated."""
        if index == STATUSWORD or told_to or axis.state not in _POWERLESS:
            return
        if time_ns - axis.state_ns < SETTLE_NS:
            return
        bus, node, number = axis.place
        if self.look(time_ns, bus) and abs(value) > _PERMILLE:
            what = "torque" if index == 0x6077 else "current"
            text = f"{what} without power, since {axis.state_ns / 1e9:.6f} s"
            numbers = (abs(float(value)), _PERMILLE, "permille")
            self.broken(Violation(time_ns, text, bus, node, number, axis.name, *numbers))

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """The motor's own torque, and the drive's own state."""
        torque, state = values.get("torque_n_m"), values.get("state")
        if torque is None or state is None:
            return
        peak = self._peak[controller] = max(self._peak.get(controller, 0.0), abs(torque))
        if state not in _POWERLESS:
            self._off.pop(controller, None)
            return
        since_ns = self._off.setdefault(controller, time_ns)
        if time_ns - since_ns < _CURRENT_SETTLE_NS or not self.look(time_ns):
            return
        limit = peak * _TRUTH_SHARE
        if abs(torque) > max(limit, 1e-9):
            text = f"torque without power, since {since_ns / 1e9:.6f} s"
            self.broken(
                Violation(
                    *(time_ns, text, "", 0, 1, controller),
                    *(abs(torque), limit, "N m"),
                )
            )
