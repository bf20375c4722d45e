"""Effects of hardware limit switches and software limits on the motion.

An active limit switch stops a motion into it on the quick stop ramp 6085h, in every mode. New
motion into it is refused; motion away from it is allowed. This is not a fault, so there is no EMCY.
Statusword bit 11 shows that a switch is active (as with SMC's LECSN-T and Novanta's stop manager).
Homing handles the limit switches itself.

Software limits (607Dh) limit the target where a position is controlled. In the velocity and torque
modes they act like limit switches. An axis that has passed one is braked on 6085h and comes to rest
beyond it. Danfoss' VLT servo drive ISD does the same in "all other modes" (MG36D1, object 607Dh);
others, for example Novanta's Summit, raise a fault. The limits count from home, regardless of its
position (607Ch). The axis' own gate monitors them. Without 607Dh they cost nothing.
"""

from typing import Final, final

from motorhil.emulators.cia402.objects.changes import ObjectChange
from motorhil.emulators.cia402.objects.motion import MotionObjects
from motorhil.emulators.cia402.settings import EMULATED_MODES
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import (
    LIMITS,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    DigitalInputs,
    Edge,
)

_FENCED_MODES: Final = tuple(EMULATED_MODES[name] for name in ("pv", "tq", "csv", "cst"))
_LIMIT_CHANGES: Final = int(ObjectChange.POSITION_LIMITS | ObjectChange.FACTORS)


@final
class LimitGuard:
    """Keeps the axis out of active limit switches, except during homing.

    Attributes:
        is_active: True if a switch is active, or the axis is beyond a software limit.
    """

    def __init__(self, axis: Axis, inputs: DigitalInputs, motion: MotionObjects) -> None:
        self._axis = axis
        self._inputs = inputs
        self._motion = motion
        self._homing: bool = False
        self._counts: bool = False  # True if software limits apply in this mode
        self._beyond: int = 0  # as last applied
        self.is_active: bool = inputs.bits & LIMITS != 0

    def homes(self, on: bool) -> None:
        """Start or end the exception for homing."""
        if on != self._homing:
            self._homing = on
            self.apply()

    def sees(self, edges: list[Edge]) -> None:
        """Handle edges of digital inputs, or a passed software limit."""
        moved = self._inputs.beyond != self._beyond
        for edge in edges:
            if edge.bit & LIMITS:
                moved = True
                break
        if moved:
            self.apply()

    def select(self, mode: int) -> None:
        """Apply the rules of a mode of operation."""
        self._counts = mode in _FENCED_MODES
        self.fence()

    def written(self, what: int) -> None:
        """Handle a write to 607Dh or to objects that change its meaning."""
        if what & _LIMIT_CHANGES:
            self.fence()

    def fence(self) -> None:
        """Update the software limits, if the mode uses them."""
        inputs = self._inputs
        if self._counts and self._motion.has_position_limits():
            low_inc, high_inc = self._motion.position_limits_inc()
            offset_inc = self._axis.position_inc() - self._axis.count()
            inputs.fence(float(low_inc - offset_inc), float(high_inc + 1 - offset_inc))
        else:
            inputs.fence()
        if inputs.beyond != self._beyond:
            self.apply()

    def apply(self) -> None:
        """Apply the present state of switches and software limits to the axis."""
        self._beyond = self._inputs.beyond
        active = (self._inputs.bits | self._beyond) & LIMITS
        self.is_active = active != 0
        bits = 0 if self._homing else active
        self._axis.bar(
            bits & NEGATIVE_LIMIT != 0,
            bits & POSITIVE_LIMIT != 0,
            self._motion.quick_stop_deceleration_inc_s2(),
        )
