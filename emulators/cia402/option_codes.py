"""Option codes for stopping the drive (CiA 402-2, 605Ah to 605Eh, 6007h).

Meaning of their terms in this drive:

- *slow-down ramp*: 6084h, or 609Ah if homing is halted. *Quick stop ramp*: 6085h. The demand
  decreases linearly.
- *current limit*: the velocity loop demands standstill at once, and brakes with all the current
  that 6072h, 60E0h and 60E1h allow.
- *voltage limit*: the hardest stop without energy flowing back into the supply, which would raise
  its voltage. The motor brakes as if its terminals were shorted. The standard defines no more than
  the name.
- *coast*: the power stage is switched off.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.written import Choice, Written
from emulators.firmware.axis import Axis

# Common to 605Ah, 605Dh and 605Eh; 605Ah has 5 to 8 for the same reactions, and then stays.
COAST: Final = 0
SLOW_DOWN_RAMP: Final = 1
QUICK_STOP_RAMP: Final = 2
CURRENT_LIMIT: Final = 3
VOLTAGE_LIMIT: Final = 4
STAYS: Final = 5  # from here on, 605Ah stays in QUICK STOP ACTIVE

# Values that have an effect, and can therefore be written.
_ALLOWED: Final = {
    0x6007: frozenset(range(4)),
    0x605A: frozenset(range(9)),
    0x605B: frozenset(range(2)),
    0x605C: frozenset(range(2)),
    0x605D: frozenset(range(1, 5)),
    0x605E: frozenset(range(5)),
}
_D = DataType


@final
class OptionCodes:
    """The option codes as in their objects; a default of the EDS outside the table is kept."""

    def __init__(self, od: ObjectDictionary, motion: MotionObjects, written: Written) -> None:
        ensure = od.ensure
        self._motion = motion
        self._abort_connection = ensure(0x6007, 0, _D.INTEGER16, 1)
        self._quick_stop = ensure(0x605A, 0, _D.INTEGER16, 2)
        self._shutdown = ensure(0x605B, 0, _D.INTEGER16, 0)
        self._disable = ensure(0x605C, 0, _D.INTEGER16, 1)
        self._halt = ensure(0x605D, 0, _D.INTEGER16, 1)
        self._fault_reaction = ensure(0x605E, 0, _D.INTEGER16, 2)
        codes: tuple[Variable, ...] = (
            *(self._abort_connection, self._quick_stop, self._shutdown),
            *(self._disable, self._halt, self._fault_reaction),
        )
        for code in codes:
            allowed = _ALLOWED[code.index]
            code.writer = Choice(written, 0, allowed, int(AbortCode.INVALID_VALUE)).write

    def quick_stops_and_stays(self) -> bool:
        """Return True if 605Ah >= 5: the drive stays in QUICK STOP ACTIVE until transition 16."""
        return self._quick_stop.integer() >= STAYS

    def shutdown_ramps(self) -> bool:
        """Return True if transition 8 brakes first (605Bh)."""
        return self._shutdown.integer() == 1

    def disable_ramps(self) -> bool:
        """Return True if transition 5 brakes first (605Ch)."""
        return self._disable.integer() == 1

    def abort_connection(self) -> int:
        """Return 6007h."""
        return self._abort_connection.integer()

    def quick_stop(self, axis: Axis) -> bool:
        """Start the reaction of 605Ah; return False to coast. An unknown code brakes on 6085h."""
        option = self._quick_stop.integer()
        return self._stop(axis, option - 4 if option >= STAYS else option, QUICK_STOP_RAMP)

    def halt(self, axis: Axis, slow_down_inc_s2: float = 0.0, within_limits: bool = False) -> None:
        """Start the reaction of 605Dh, which ends at standstill. An unknown code slows down.

        Args:
            axis: the axis to stop.
            slow_down_inc_s2: the mode's own slow-down ramp, if > 0, else 6084h is used.
            within_limits: True to stop within 607Dh, with a steeper ramp if necessary.
        """
        option = self._halt.integer()
        within_inc: tuple[int, int] | None = None
        if within_limits and self._motion.has_position_limits():
            within_inc = self._motion.position_limits_inc()
        how = option if option != COAST else SLOW_DOWN_RAMP
        self._stop(axis, how, SLOW_DOWN_RAMP, slow_down_inc_s2, within_inc)

    def react(self, axis: Axis) -> bool:
        """Start the reaction of 605Eh; return False to coast. An unknown code brakes on 6085h."""
        return self._stop(axis, self._fault_reaction.integer(), QUICK_STOP_RAMP)

    def _stop(
        self,
        axis: Axis,
        how: int,
        otherwise: int,
        slow_down_inc_s2: float = 0.0,
        within_inc: tuple[int, int] | None = None,
    ) -> bool:
        if how < COAST or how > VOLTAGE_LIMIT:
            how = otherwise
        if how == COAST:
            return False
        if how == SLOW_DOWN_RAMP:
            axis.ramp_to_rest(slow_down_inc_s2 or self._motion.deceleration_inc_s2(), within_inc)
        elif how == QUICK_STOP_RAMP:
            axis.ramp_to_rest(self._motion.quick_stop_deceleration_inc_s2(), within_inc)
        else:
            axis.brake(how == VOLTAGE_LIMIT)
        return True
