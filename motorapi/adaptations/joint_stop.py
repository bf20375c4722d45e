"""Drives of one bus that slow down at the same instant: one SYNC latches the halt of them all.

Frames that act at once act one after another: of many drives on a full bus the last would go on
for a millisecond or more. So each gets its halt in the RPDO that SYNC latches, and SYNC follows
when all of these were on the wire. All of it is sent from callbacks and waited for by nobody. Where
SYNC is not ours to send now (somebody arms a start, a cyclic one runs, the bus does not tell of own
frames) or does not come in time, each drive is halted by a frame that acts at once; and after SYNC
as well, for a frame may be lost.
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
"""After 5 ms nobody waits for SYNC any more: a halt that is late is worse than one by itself."""


@final
class JointStop:
    """The halt of several drives of one bus, of one group; a `Trigger`."""

    def __init__(self, link: CanopenLink, turn: AbstractContextManager[bool]) -> None:
        self._link = link
        self._turn = turn  # SYNC is ours until this is left
        self._armed: list[tuple[Cia402HwMotor, RestWatch, Transmission]] = []
        self._timer: Registration | None = None
        self._looks = 0
        self._sync: Transmission | None = None

    def add(self, hardware: Cia402HwMotor) -> bool:
        """The drive has its halt, for the SYNC that comes; False: it cannot be halted so."""
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
        """SYNC follows when all frames were on the wire; does not wait."""
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
                if hardware.node.watch is watch:  # else it was told something else meanwhile
                    if self._sync is not None:
                        hardware.control.has_started()
                    hardware.control.send_halt(watch)
        finally:
            self._turn.__exit__(None, None, None)


_open: "Final[WeakKeyDictionary[BusSync, JointStop]]" = WeakKeyDictionary()
"""Those that drives are still added to, by the group that stops now; of a link that is compiled
there are no weak references, of what it has of SYNC there are."""


def joint_stop_of(link: CanopenLink) -> JointStop | None:
    """The one to add a drive of this bus to; None: SYNC is not ours to send now."""
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
