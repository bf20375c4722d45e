"""Set-points that begin together where a cyclic SYNC runs: one burst just after a SYNC.

Nothing can be armed one by one there: each would begin with the SYNC that comes next. So all are
made ready, up to the one frame that is still to be sent; then all of these go out just after a SYNC
and have a period to pass the bus before the next one latches them. If they have not passed by then
(other traffic, a frame that was delayed), that SYNC *straddles* the burst: those that have passed
begin with it, the others with a later one. That is seen, for every frame tells when it was on the
wire, and counted.
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
        link: of the bus.
        control: of the drive.
        index: of the object that holds the target: 607Ah, 60FFh.
        target: in the drive's units.
        fired: is told when that SYNC was on the wire [ns].

    Attributes:
        latched_ns: when it was; None: not yet.
        place: the number of that SYNC, on this link.
        straddles: SYNCs between that of the first of the group and this one's.
        transmission: its frame; None: it was not sent yet.
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
        """Other processes see that it waits in this RPDO of the drive, until `unmark`."""
        self._mark = self._link.bus_sync.marks.mark(self._link, node_id, can_id, self)

    def unmark(self) -> None:
        """It waits no more: a SYNC has latched it, or it was overwritten."""
        mark, self._mark = self._mark, None
        if mark is not None:
            mark.release()

    def send(self) -> None:
        """Its frame is on its way, unless the drive was told to stop.

        Raises:
            LinkError: the bus does not take it.
            MotorBusyError: somebody has low-level access, or has taken the motor over.
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
        """Whether no SYNC is waited for: it was latched, or the drive was told to stop."""
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
        except Exception as error:  # it is told by whoever waits
            self._error = error

    def await_latched(self) -> None:
        """All have begun, or were told to stop.

        Raises:
            LinkError: the bus does not take them, or no SYNC comes.
            MotorBusyError: somebody has low-level access to one, or has taken it over.
        """
        link, armed = self._link, self._armed
        if not self._comes(lambda: self._is_sent):
            self._send(0)  # whoever produced SYNC has ended: one of ours begins them
        if self._error is not None:
            raise self._error
        link.confirmed([one.transmission for one in armed if one.transmission is not None])
        if not self._comes(lambda: all(one.is_over for one in armed)):
            link.confirmed([link.sync()])

    def _comes(self, done: Callable[[], bool]) -> bool:
        """Whether it is done; False: no SYNC runs any more.

        Raises:
            LinkError: one should run, and does not come.
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
    """Each of a group knows how many SYNCs after the first one it began."""
    latched = [one for one in armed if one.latched_ns is not None]
    for one in latched:
        one.straddles = one.place - min(other.place for other in latched)
