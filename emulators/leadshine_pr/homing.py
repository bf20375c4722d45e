"""Homing of a PR-mode drive: search, back off, set zero.

Bit 0 of the homing mode is the direction (1: forward). Bit 2 selects the home switch, otherwise the
limit switch of that side. Without such a switch the search continues until it is stopped, as in the
real drive.
"""

from enum import Enum
from typing import TYPE_CHECKING, final

from emulators.firmware import flags as f

if TYPE_CHECKING:
    from emulators.leadshine_pr.drive import LeadshinePr

_FORWARD = 0x0001
_HOME_SWITCH = 0x0004


@final
class _Phase(Enum):
    IDLE = 0
    LEAVING = 1  # it began on the switch
    SEARCHING = 2
    STOPPING = 3
    BACKING = 4
    SETTLING = 5


@final
class Homing:
    """The search for the switch, tick by tick."""

    def __init__(self, drive: "LeadshinePr") -> None:
        self._drive = drive
        self._phase = _Phase.IDLE

    def is_active(self) -> bool:
        """Return whether homing is in progress."""
        return self._phase is not _Phase.IDLE

    def begin(self) -> None:
        """Begin the search for the switch."""
        self._phase = _Phase.LEAVING if self._closed() else _Phase.SEARCHING
        if self._phase is _Phase.LEAVING:
            self._run(-self._way() * self._drive.bank["homing_speed_low"])
        else:
            self._run(self._way() * self._drive.bank["homing_speed_high"])

    def abandon(self) -> None:
        """End homing, successful or not."""
        self._phase = _Phase.IDLE

    def settle(self) -> None:
        """Advance the phases according to the position of the axis."""
        drive, phase = self._drive, self._phase
        if phase is _Phase.SEARCHING and self._closed():
            self._phase = _Phase.STOPPING
            drive.axis.ramp_to_rest(drive.inc_s2(drive.bank["homing_deceleration"]))
        elif phase is _Phase.STOPPING and not drive.axis.flags & f.PROFILE_ACTIVE:
            self._phase = _Phase.BACKING
            self._run(-self._way() * drive.bank["homing_speed_low"])
        elif phase in (_Phase.BACKING, _Phase.LEAVING) and not self._closed():
            at_switch = drive.inc(drive.bank["zero_position"])
            drive.axis.set_position(at_switch)
            drive.axis.ramp_to_rest(drive.inc_s2(drive.bank["homing_deceleration"]))
            self._phase = _Phase.SETTLING
        elif phase is _Phase.SETTLING and not drive.axis.flags & f.PROFILE_ACTIVE:
            drive.is_homed = True
            self._phase = _Phase.IDLE

    def _way(self) -> int:
        return 1 if self._drive.bank["homing_mode"] & _FORWARD else -1

    def _closed(self) -> bool:
        if self._drive.bank["homing_mode"] & _HOME_SWITCH:
            return self._drive.home_closed()
        forward, backward = self._drive.limits_closed()
        return forward if self._way() > 0 else backward

    def _run(self, rpm: int) -> None:
        drive = self._drive
        drive.axis.run_at(
            drive.inc_s(rpm),
            drive.inc_s2(drive.bank["homing_acceleration"]),
            drive.inc_s2(drive.bank["homing_deceleration"]),
        )
