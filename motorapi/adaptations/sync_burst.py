"""Joint start of set-points beside a cyclic SYNC, in one burst.

Set-points cannot be armed one by one there: each would begin with the next SYNC. So all are
prepared up to the one frame that is still to be sent. Then all frames are sent just after a SYNC,
and have a period to pass the bus before the next SYNC latches them. If they have not passed by then
(other traffic, a delayed frame), that SYNC *straddles* the burst. The drives whose frames have
passed begin with it, the others with a later one. This is detected and counted, as each frame's
time on the wire is known.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import LinkError

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import CanopenLink, Transmission
    from motorapi.adaptations.drive_control import DriveControl
    from motorapi.process_lock import Hold

_FIRST_SYNC_S: Final = 0.5
_PERIODS: Final = 4


@final
class ArmedSetPoint:
    """A set-point of one drive that begins at a SYNC, with others.

    Args:
        link: the link of the bus.
        control: the controls of the drive.
        index: the object that holds the target: 607Ah, 60FFh.
        target: the target in the drive's units.
        fired: called with the time [ns] when that SYNC was on the wire.

    Attributes:
        latched_ns: the time of that SYNC; None: not yet.
        place: the number of that SYNC, on this link.
        straddles: the SYNCs between the first one of the group and this one's.
        transmission: the frame; None: not sent yet.
    """

    def __init__(
        self,
        link: "CanopenLink",
        control: "DriveControl",
        index: int,
        target: int,
        fired: Callable[[int], None],
    ) -> None:
        self._link = link
        self._control = control
        self._index = index
        self._target = target
        self._fired = fired
        self.place = 0
        self._mark: Hold | None = None
        self.transmission: Transmission | None = None
        self.latched_ns: int | None = None
        self.straddles = 0

    def mark(self, node_id: int, can_id: int) -> None:
        """Mark the set-point as waiting in this RPDO of the drive, for other processes."""
        self._mark = self._link.bus_sync.marks.mark(self._link, node_id, can_id, self)

    def unmark(self) -> None:
        """Remove the mark: a SYNC has latched the set-point, or it was overwritten."""
        mark, self._mark = self._mark, None
        if mark is not None:
            mark.release()

    def send(self) -> None:
        """Send the frame, unless the drive was stopped.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: low-level access is active, or another program has taken the motor over.
        """
        if not self._control.is_halted:
            self.transmission = self._control.send_armed(
                self._index, self._target, fired=self._latched
            )

    def _latched(self, time_ns: int) -> None:
        self.latched_ns = time_ns
        self.place = self._link.bus_sync.count
        self._fired(time_ns)

    @property
    def is_over(self) -> bool:
        """True if no SYNC is awaited: the set-point was latched, or the drive stopped."""
        return self.latched_ns is not None or not self._control.is_armed


@final
class Burst:
    """The frames of several drives, sent one after another just after a SYNC."""

    def __init__(self, link: "CanopenLink", armed: Sequence[ArmedSetPoint]) -> None:
        self._link = link
        self._armed = armed
        self._error: Exception | None = None
        self._is_sent = False
        link.at_next_sync(self._send)

    def _send(self, time_ns: int) -> None:
        if self._is_sent:
            return
        self._is_sent = True
        try:
            for one in self._armed:
                one.send()
        except Exception as error:  # raised in the waiting call
            self._error = error

    def await_latched(self) -> None:
        """Wait until all set-points have begun, or their drives were stopped.

        Raises:
            LinkError: the bus does not accept the frames, or no SYNC comes.
            MotorBusyError: low-level access is active, or another program has taken a motor over.
        """
        link, armed = self._link, self._armed
        if not self._comes(lambda: self._is_sent):
            self._send(0)  # the producer of SYNC has ended: one of ours begins them
        if self._error is not None:
            raise self._error
        link.confirmed([one.transmission for one in armed if one.transmission is not None])
        if not self._comes(lambda: all(one.is_over for one in armed)):
            link.confirmed([link.sync()])

    def _comes(self, done: Callable[[], bool]) -> bool:
        """Return whether `done` becomes true; False: the cyclic SYNC has ended.

        Raises:
            LinkError: a cyclic SYNC should run, but does not come.
        """
        link = self._link
        runs = link.bus_sync.known()
        period_s = 0.0 if runs is None else runs.period_ns / 1e9
        end_ns = link.runtime.now_ns() + round((_FIRST_SYNC_S + _PERIODS * period_s) * 1e9)
        while runs is not None:
            if link.wait_until(done, _PERIODS * period_s):
                return True
            runs = link.bus_sync.known()
            if runs is not None and link.runtime.now_ns() >= end_ns:
                raise LinkError(link=link.name, reason=f"no SYNC was transmitted, but {runs}")
        return done()


def count_straddles(armed: Sequence[ArmedSetPoint]) -> None:
    """Set `straddles` of each set-point: the number of SYNCs after the first one."""
    latched = [one for one in armed if one.latched_ns is not None]
    for one in latched:
        one.straddles = one.place - min(other.place for other in latched)
