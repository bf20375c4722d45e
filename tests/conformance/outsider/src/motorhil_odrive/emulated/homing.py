"""Homing of an ODrive at its minimum end stop.

The axis runs to the end stop and off it again; the place where the switch opens becomes position 0.
The direction, and the final closed loop state, are those in ODrive's manuals of earlier firmware.
How the axis leaves the switch is a choice of this emulator.
"""

from enum import Enum
from typing import Final, final

from motorhil.emulators.api import flags as f

from motorhil_odrive.emulated.control import Control

_FAR: Final = 1e18


@final
class _Phase(Enum):
    SEARCHING = 0
    STOPPING = 1
    LEAVING = 2
    SETTLING = 3


@final
class Homing:
    """An active homing; `endstop_count` is the encoder count where its switch closes."""

    def __init__(self, control: Control, endstop_count: int) -> None:
        self._control = control
        self._edge: Final = float(endstop_count)
        self._phase = _Phase.LEAVING if self._is_closed() else _Phase.SEARCHING
        self._go()

    def settle(self) -> bool:
        """Continue from the axis' position; return whether homing is over, near position 0."""
        axis, control = self._control.axis, self._control
        if self._phase is _Phase.SEARCHING and self._is_closed():
            self._phase = _Phase.STOPPING
            control.rest()
        elif self._phase is _Phase.STOPPING and not axis.flags & f.PROFILE_ACTIVE:
            self._phase = _Phase.LEAVING
            self._go()
        elif self._phase is _Phase.LEAVING and not self._is_closed():
            self._phase = _Phase.SETTLING
            axis.set_position(0)
            control.rest()
        elif self._phase is _Phase.SETTLING and not axis.flags & f.PROFILE_ACTIVE:
            self.abandon()
            return True
        return False

    def abandon(self) -> None:
        """Ignore the switch from now on."""
        self._control.axis.set_gate(-_FAR, _FAR, -_FAR, _FAR)

    def _is_closed(self) -> bool:
        return self._control.axis.output_count() < self._edge

    def _go(self) -> None:
        axis = self._control.axis
        if self._phase is _Phase.SEARCHING:
            axis.set_gate(-_FAR, _FAR, self._edge, _FAR)
            self._control.home_run(-1)
        else:
            axis.set_gate(-_FAR, _FAR, -_FAR, self._edge)
            self._control.home_run(1)
