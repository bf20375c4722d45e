"""The option codes: how the drive stops, and what follows (CiA 402-2, 605Ah to 605Eh, 6007h).

What they name, and what it is here:

- *slow-down ramp*: 6084h, but 609Ah where a homing is halted; *quick stop ramp*: 6085h; the demand
  goes down evenly.
- *current limit*: the velocity loop wants standstill at once, and brakes with all the current that
  6072h, 60E0h and 60E1h leave it.
- *voltage limit*: as hard as can be without energy going back into the supply, whose voltage would
  rise: the motor brakes as if its terminals were shorted. The standard says no more than the name.
- *coast*: the power stage goes off.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.written import Choice, Written
from emulators.firmware.axis import Axis

# What 605Ah, 605Dh and 605Eh have in common; 605Ah has 5 to 8 for the same, and then stays.
COAST: Final = 0
SLOW_DOWN_RAMP: Final = 1
QUICK_STOP_RAMP: Final = 2
CURRENT_LIMIT: Final = 3
VOLTAGE_LIMIT: Final = 4
STAYS: Final = 5  # from here on, 605Ah stays in QUICK STOP ACTIVE

# What has a behaviour, and so may be written.
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
    """Each as it stands in its object; a file's own default, if not in the table, is as stated."""

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
        """605Ah, 5 and more: the drive stays in QUICK STOP ACTIVE, and transition 16 leads out."""
        return self._quick_stop.integer() >= STAYS

    def shutdown_ramps(self) -> bool:
        """605Bh: whether transition 8 brakes first."""
        return self._shutdown.integer() == 1

    def disable_ramps(self) -> bool:
        """605Ch: whether transition 5 brakes first."""
        return self._disable.integer() == 1

    def abort_connection(self) -> int:
        """6007h."""
        return self._abort_connection.integer()

    def quick_stop(self, axis: Axis) -> bool:
        """605Ah begins; False: the motor shall coast. Another number brakes on 6085h."""
        option = self._quick_stop.integer()
        return self._stop(axis, option - 4 if option >= STAYS else option, QUICK_STOP_RAMP)

    def halt(self, axis: Axis, slow_down_inc_s2: float = 0.0, within_limits: bool = False) -> None:
        """605Dh begins; it ends at standstill, held there. Another number slows down.

        The slow-down ramp is the mode's own, if it has one (> 0), else 6084h.
        `within_limits`: a ramp from within 607Dh that would leave it is steeper, and does not.
        """
        option = self._halt.integer()
        within_inc: tuple[int, int] | None = None
        if within_limits and self._motion.has_position_limits():
            within_inc = self._motion.position_limits_inc()
        how = option if option != COAST else SLOW_DOWN_RAMP
        self._stop(axis, how, SLOW_DOWN_RAMP, slow_down_inc_s2, within_inc)

    def react(self, axis: Axis) -> bool:
        """605Eh begins; False: the motor shall coast. Another number brakes on 6085h."""
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
