"""Oracles of a drive's motion, with and without power.

Source: CiA 402-2: statusword (following error), following error window 6065h and time-out 6066h,
states without power.
"""

from collections.abc import Mapping
from typing import ClassVar, Final, final

from harness.oracles.finding import Violation
from harness.oracles.oracle import MS, SETTLE_NS, Oracle
from harness.oracles.scene import (
    BIT_13,
    DISABLED,
    ENABLED,
    FAULT,
    NOT_READY,
    READY,
    STATUSWORD,
    Axis,
    Place,
    Scene,
)

_POSITION: Final = 0x6064
_OFF: Final = 0xFFFF_FFFF
_PP, _IP, _CSP = 1, 7, 8


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

    def __init__(self, scene: Scene) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(scene)
        self._since: dict[Place, int] = {}
        self._told: dict[Place, bool] = {}
        self._by_controller = scene.controllers()

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """Examine a following error, or a statusword that ends its excess."""
        if index == 0x60F4:
            self._error(time_ns, axis, value)
        elif index == STATUSWORD and (axis.state != ENABLED or value & BIT_13):
            self._since.pop(axis.place, None)
            self._told.pop(axis.place, None)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Examine the true error of an emulated drive, which may be absent on the bus."""
        error = values.get("following_error_inc")
        if error is None:
            return
        for one in self._by_controller.get(controller, ()):
            if one.place is not None and one.channel == 1 and one.place in self.scene.axes:
                self._error(time_ns, self.scene.axes[one.place], error)

    def _error(self, time_ns: int, axis: Axis, error: float) -> None:
        if axis.state != ENABLED or axis.mode not in (_PP, _IP, _CSP):
            return
        self._held_to_file(time_ns, axis, error)
        window = axis.objects.get((0x6065, 0))
        if window is None or window >= _OFF or axis.word is None or axis.word & BIT_13:
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
            text = f"following error since {since_ns / 1e9:.6f} s, not reported by the drive"
            numbers = (abs(error), float(window), "inc")
            self.broken(Violation(time_ns, text, bus, node, number, axis.name, *numbers))

    def _held_to_file(self, time_ns: int, axis: Axis, error: float) -> None:
        """Examine the error against a file of limits, in increments or in the motor's unit."""
        one = axis.subject
        if one is None:
            return
        limit, scale, unit = one.limits.get("following_error_max_inc"), 1.0, "inc"
        if limit is None and one.increments_per_unit is not None:
            limit = one.limits.get(f"following_error_max_{one.unit}")
            scale, unit = abs(one.increments_per_unit), one.unit
        bus, node, number = axis.place
        if limit is None or not self.look(time_ns, bus) or abs(error) <= limit * scale:
            return
        numbers = (abs(error) / scale, limit, unit)
        self.broken(Violation(time_ns, "following error", bus, node, number, axis.name, *numbers))


_POWERLESS: Final = (NOT_READY, DISABLED, READY, FAULT)
_CURRENT_SETTLE_NS: Final = 50 * MS
_TRUTH_SHARE: Final = 0.01
_PERMILLE: Final = 50.0


@final
class TorqueOff(Oracle):
    """The oracle `torque-off`."""

    id = "torque-off"
    promise = "A motor makes no torque after its power stage is off: STO, switched off, or a fault"
    source = "CiA 402-2, PDS FSA: drive power is disabled; IEC 61800-5-2, safe torque off"
    needs = "no drive without power was heard together with its torque (6077h, 6078h, or truth)"
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, 0x6077: True, 0x6078: True}

    def __init__(self, scene: Scene) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(scene)
        self._off: dict[str, int] = {}  # start time, by controller
        self._peak: dict[str, float] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """Examine a measured torque or current [0.1 % of rated]."""
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
        """Examine the motor's true torque in the drive's true state."""
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
