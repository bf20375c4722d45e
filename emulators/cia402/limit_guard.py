"""Hardware limit switches and software limits: what they stop, and what they let pass.

An active limit switch stops a motion into it on the quick stop ramp 6085h, in every mode, and keeps
it from being commanded again; away from it every motion is allowed. It is no fault, so there is no
EMCY; statusword bit 11 shows that a switch is active (so SMC's LECSN-T and Novanta's stop manager).
A homing minds them itself.

Software limits (607Dh) keep the target within them where a position is controlled. In the modes of
velocity and torque they are what a limit switch would be there: whoever has passed one is braked on
6085h and so comes to rest behind it, as Danfoss' VLT servo drive ISD says of "all other modes"
(MG36D1, object 607Dh; others, Novanta's Summit, fail there). They count from home, whatever it is
called (607Ch), and are looked at by the axis' own gate: without 607Dh nothing is.
"""

from typing import Final, final

from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.settings import EMULATED_MODES
from emulators.cia402.written import FACTORS, POSITION_LIMITS
from emulators.firmware.axis import Axis
from emulators.firmware.digital_inputs import (
    LIMITS,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    DigitalInputs,
    Edge,
)

_FENCED_MODES: Final = tuple(EMULATED_MODES[name] for name in ("pv", "tq", "csv", "cst"))


@final
class LimitGuard:
    """Keeps the axis out of active limit switches, except while a homing has it.

    Attributes:
        is_active: whether one of the two is, or the axis is beyond a software limit.
    """

    def __init__(self, axis: Axis, inputs: DigitalInputs, motion: MotionObjects) -> None:
        self._axis = axis
        self._inputs = inputs
        self._motion = motion
        self._homing: bool = False
        self._counts: bool = False  # whether software limits do, in this mode
        self._beyond: int = 0  # as last applied
        self.is_active: bool = inputs.bits & LIMITS != 0

    def homes(self, on: bool) -> None:
        """A homing begins, or is over."""
        if on != self._homing:
            self._homing = on
            self.apply()

    def sees(self, edges: list[Edge]) -> None:
        """Digital inputs have changed, or a software limit has been passed."""
        moved = self._inputs.beyond != self._beyond
        for edge in edges:
            if edge.bit & LIMITS:
                moved = True
                break
        if moved:
            self.apply()

    def select(self, mode: int) -> None:
        """This mode of operation has the axis now."""
        self._counts = mode in _FENCED_MODES
        self.fence()

    def written(self, what: int) -> None:
        """Objects were written: 607Dh, perhaps, or what its numbers mean."""
        if what & (POSITION_LIMITS | FACTORS):
            self.fence()

    def fence(self) -> None:
        """Software limits count from now on as they are, where the mode looks at them."""
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
        """What the switches say counts from now on."""
        self._beyond = self._inputs.beyond
        active = (self._inputs.bits | self._beyond) & LIMITS
        self.is_active = active != 0
        bits = 0 if self._homing else active
        self._axis.bar(
            bits & NEGATIVE_LIMIT != 0,
            bits & POSITIVE_LIMIT != 0,
            self._motion.quick_stop_deceleration_inc_s2(),
        )
