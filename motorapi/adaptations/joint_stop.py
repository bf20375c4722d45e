"""Simultaneous stop of several drives of one bus, latched by one SYNC.

Frames that act at once act one after another: on a full bus, the last of many drives would move on
for a millisecond or more. So each drive gets its halt in the RPDO that SYNC latches, and SYNC
follows when all of these were on the wire. Everything is sent from callbacks, without waiting.
There are cases without a SYNC of ours: a start is being armed, a cyclic SYNC runs, or the bus does
not report own frames. Then, or if SYNC does not come in time, each drive is halted by a frame that
acts at once. The same frame also follows SYNC, as a frame may be lost.
"""

from contextlib import AbstractContextManager
from typing import Final, final
from weakref import WeakKeyDictionary

from motorapi.adaptations.bus_sync import BusSync
from motorapi.adaptations.canopen_link import CanopenLink, Transmission
from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.cia402_objects import Mode, PdsState
from motorapi.adaptations.motion_watch import RestWatch
from motorapi.runtime import Registration

_LOOK_S: Final = 0.0005
_LOOKS_MAX: Final = 10
"""The number of checks, 5 ms in total, after which SYNC is not awaited any longer.

A late halt is worse than separate halts.
"""


@final
class JointStop:
    """The joint halt of several drives of one bus in one group; a `Trigger`."""

    def __init__(self, link: CanopenLink, turn: AbstractContextManager[bool]) -> None:
        self._link = link
        self._turn = turn  # SYNC is ours until this context is left
        self._armed: list[tuple[Cia402HwMotor, RestWatch, Transmission]] = []
        self._timer: Registration | None = None
        self._looks = 0
        self._sync: Transmission | None = None

    def add(self, hardware: Cia402HwMotor) -> bool:
        """Send the drive its halt for the next SYNC; return False if it cannot be halted so."""
        control, node = hardware.control, hardware.node
        is_running = node.state is PdsState.OPERATION_ENABLED
        if not is_running or not control.is_in(Mode.PROFILE_POSITION):
            return False
        watch = RestWatch(commanded_ns=hardware.runtime.now_ns(), needs_bit=True)
        transmission = control.send_armed_halt()
        if transmission is None:
            return False
        hardware.follow(watch)
        self._armed.append((hardware, watch, transmission))
        return True

    def fire(self) -> None:
        """Send SYNC when all frames were on the wire, without waiting."""
        _open.pop(self._link.bus_sync, None)
        if self._armed:
            self._timer = self._link.runtime.every(_LOOK_S, self._look)
        else:
            self._turn.__exit__(None, None, None)

    def _look(self) -> None:
        self._looks += 1
        if self._sync is None and all(sent.time_ns is not None for _, _, sent in self._armed):
            self._sync = self._link.sync()
        is_latched = self._sync is not None and self._sync.time_ns is not None
        if is_latched or self._looks >= _LOOKS_MAX:
            self._halt_at_once()

    def _halt_at_once(self) -> None:
        timer, self._timer = self._timer, None
        if timer is None:
            return
        timer.cancel()
        try:
            for hardware, watch, _ in self._armed:
                if hardware.node.watch is watch:  # else it received another command meanwhile
                    if self._sync is not None:
                        hardware.control.has_started()
                    hardware.control.send_halt(watch)
        finally:
            self._turn.__exit__(None, None, None)


_open: "Final[WeakKeyDictionary[BusSync, JointStop]]" = WeakKeyDictionary()
"""The joint stops that still accept drives, by `BusSync`.

Compiled classes such as CanopenLink have no weak references; BusSync has them.
"""


def joint_stop_of(link: CanopenLink) -> JointStop | None:
    """Return the joint stop for a drive of this bus, or None if SYNC is not ours to send now."""
    stop = _open.get(link.bus_sync)
    if stop is not None:
        return stop
    if not link.confirms or link.latching or link.cyclic_sync() is not None:
        return None
    turn = link.bus_sync.turns.at_once(link.runtime, f"a stop of several on {link.name}")
    if not turn.__enter__():
        turn.__exit__(None, None, None)
        return None
    stop = _open[link.bus_sync] = JointStop(link, turn)
    return stop
