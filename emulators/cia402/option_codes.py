"""The option codes: how the drive stops, and what follows (CiA 402-2, 605Ah to 605Eh, 6007h)."""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.written import Choice, Written
from emulators.firmware.axis import Axis

_QUICK_STOPS: Final = frozenset((0, 1, 2, 5, 6))
_D = DataType


@final
class OptionCodes:
    """Each as it stands in its object."""

    def __init__(self, od: ObjectDictionary, motion: MotionObjects, written: Written) -> None:
        ensure = od.ensure
        self._motion = motion
        self._abort_connection = ensure(0x6007, 0, _D.INTEGER16, 1)
        self._quick_stop = ensure(0x605A, 0, _D.INTEGER16, 2)
        self._shutdown = ensure(0x605B, 0, _D.INTEGER16, 0)
        self._disable = ensure(0x605C, 0, _D.INTEGER16, 1)
        self._halt = ensure(0x605D, 0, _D.INTEGER16, 1)
        self._fault_reaction = ensure(0x605E, 0, _D.INTEGER16, 2)
        refused = int(AbortCode.INVALID_VALUE)
        self._quick_stop.writer = Choice(written, 0, _QUICK_STOPS, refused).write

    def quick_stop(self) -> int:
        """605Ah."""
        return self._quick_stop.integer()

    def shutdown_ramps(self) -> bool:
        """605Bh: whether transition 8 brakes first."""
        return self._shutdown.integer() == 1

    def disable_ramps(self) -> bool:
        """605Ch: whether transition 5 brakes first."""
        return self._disable.integer() == 1

    def halt_deceleration_inc_s2(self) -> float:
        """605Dh: 2 brakes as a quick stop, everything else on the slow-down ramp."""
        if self._halt.integer() == 2:
            return self._motion.quick_stop_deceleration_inc_s2()
        return self._motion.deceleration_inc_s2()

    def halt(self, axis: Axis) -> None:
        """The motion that 605Dh asks for begins; it ends at standstill, held there."""
        axis.ramp_to_rest(self.halt_deceleration_inc_s2())

    def fault_deceleration_inc_s2(self) -> float | None:
        """605Eh: how a fault brakes; None: it does not, the motor coasts."""
        option = self._fault_reaction.integer()
        if option == 1:
            return self._motion.deceleration_inc_s2()
        return None if option == 0 else self._motion.quick_stop_deceleration_inc_s2()

    def abort_connection(self) -> int:
        """6007h."""
        return self._abort_connection.integer()
