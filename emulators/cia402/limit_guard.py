"""Hardware limit switches: what they stop, and what they let pass.

An active limit switch stops a motion into it on the quick stop ramp 6085h, in every mode, and keeps
it from being commanded again; away from it every motion is allowed. It is no fault, so there is no
EMCY; statusword bit 11 shows that a switch is active (so SMC's LECSN-T and Novanta's stop manager).
A homing minds them itself.
"""

from typing import final

from emulators.cia402.motion_objects import MotionObjects
from emulators.firmware.axis import Axis
from emulators.firmware.digital_inputs import (
    LIMITS,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    DigitalInputs,
    Edge,
)


@final
class LimitGuard:
    """Keeps the axis out of active limit switches, except while a homing has it.

    Attributes:
        is_active: whether one of the two is.
    """

    def __init__(self, axis: Axis, inputs: DigitalInputs, motion: MotionObjects) -> None:
        self._axis = axis
        self._inputs = inputs
        self._motion = motion
        self._homing: bool = False
        self.is_active: bool = inputs.bits & LIMITS != 0

    def homes(self, on: bool) -> None:
        """A homing begins, or is over."""
        if on != self._homing:
            self._homing = on
            self.apply()

    def sees(self, edges: list[Edge]) -> None:
        """Digital inputs have changed."""
        for edge in edges:
            if edge.bit & LIMITS:
                self.is_active = self._inputs.bits & LIMITS != 0
                self.apply()
                break

    def apply(self) -> None:
        """What the switches say counts from now on."""
        bits = 0 if self._homing else self._inputs.bits
        self._axis.bar(
            bits & NEGATIVE_LIMIT != 0,
            bits & POSITIVE_LIMIT != 0,
            self._motion.quick_stop_deceleration_inc_s2(),
        )
