"""Brake: the pace of a rig by the wall clock, between whose events hands act.

The runtime asks before each event. The brake waits until the event is due at the present pace, and
takes requests meanwhile. While time stands still it asks the runtime every 0.1 s to look again.
"""

from collections.abc import Callable
from time import monotonic_ns
from typing import Any, Final, final

from motorhil.harness.hands.channel import Channel
from motorhil.harness.hands.hands import Hands, RefusedError, checked
from motorhil.harness.hands.requests import ACTS, Continue, Request, Speed, Step, Stop

_LOOK_S: Final = 0.1
_OFTEN_NS: Final = 5_000_000  # of wall time between two looks, while events are due
_SELDOM: Final = 64  # events between two looks at the channel, if nothing brakes


@final
class Brake:
    """A pace of a runtime (`runtime.Pace`) that a page controls.

    Attributes:
        held_ns: where time stands still [ns]; None: it passes.
        pace: seconds of the rig in one second of wall time; None: no limit.
    """

    def __init__(
        self,
        hands: Hands,
        channel: Channel,
        pace: float | None,
        is_stopped: bool = False,
        clock_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        """Begin at the rig's present time; `clock_ns` is the wall clock."""
        self.held_ns: int | None = hands.now_ns() if is_stopped else None
        self.pace: float | None = pace
        self._hands = hands
        self._channel = channel
        self._clock_ns = clock_ns
        self._wall_ns: int | None = None  # at which the rig's time was `_rig_ns`
        self._rig_ns = 0
        self._calls = 0
        self._looked_ns = clock_ns() - _OFTEN_NS
        self._is_settled = False  # a standstill has been told, and the record written
        self._told: object = None
        self._is_over = False
        channel.tell_elements(hands.elements())
        self._tell()

    def __call__(self, due_ns: int) -> bool:
        """Wait until `due_ns` is due; return True if an act comes first."""
        passes = self.held_ns is None and not self._hands.is_busy
        if passes and self._has_just_looked() and self._reached_ns(due_ns) >= due_ns:
            return False
        timeout_s = 0.0
        while True:
            self._channel.wait(timeout_s)
            self._looked_ns = self._clock_ns()
            if self._hands.is_busy:
                return False  # the next event is an act
            if self._hands.revision != self._told:
                self._tell()
            if self._take(due_ns):
                return True
            at_ns = self._reached_ns(due_ns)
            if at_ns >= due_ns:
                self._is_settled = False
                return False
            if self.held_ns is not None:
                if not self._channel.is_open:
                    self._release()  # there is no page to let time pass
                    continue
                if timeout_s and not self._channel.inbox:
                    return True
                self._settle()
                timeout_s = _LOOK_S
            else:
                assert self.pace is not None
                timeout_s = min(_LOOK_S, (due_ns - at_ns) / self.pace / 1e9)

    def end(self) -> None:
        """Tell the page that the run is over; refuse what waits."""
        self._is_over = True
        while self._channel.inbox:
            self._channel.answer(self._channel.inbox.popleft().get("id"), "rig: the run is over")
        self._tell()
        self._channel.finish()

    # ---------------------------------------------------------------------------------- inside

    def _has_just_looked(self) -> bool:
        """Return True if requests need not be looked for before an event that is due."""
        if self.pace is None:
            self._calls += 1
            return self._calls % _SELDOM > 0
        return self._clock_ns() - self._looked_ns < _OFTEN_NS

    def _take(self, due_ns: int) -> bool:
        """Fulfil the requests that wait; return True if one of them is an act."""
        inbox = self._channel.inbox
        while inbox:
            number, table = inbox[0].get("id"), inbox[0].get("act")
            try:
                request = checked(table if isinstance(table, dict) else {})
                is_act = isinstance(request, ACTS)
                if is_act and not self._has_room(due_ns):
                    return False
                self._fulfil(request, due_ns)
            except RefusedError as error:
                inbox.popleft()
                self._channel.answer(number, str(error))
                continue
            inbox.popleft()
            self._channel.answer(number)
            if is_act:
                return True
            self._tell()
        return False

    def _has_room(self, due_ns: int) -> bool:
        """Return True if an act can take effect before the next event."""
        if self.held_ns is not None and self.held_ns >= due_ns:
            return False  # a step is not over
        if due_ns - self._hands.now_ns() >= 2:
            return True
        if self.held_ns is not None:
            self.held_ns = due_ns  # no instant is free before the next event: after it
        return False

    def _fulfil(self, request: Request, due_ns: int) -> None:
        """Do as requested.

        Raises:
            RefusedError: the rig does not permit it.
        """
        if isinstance(request, Stop):
            self._stop(due_ns)
        elif isinstance(request, Continue):
            self._release()
        elif isinstance(request, Step):
            held_ns = self._stop(due_ns) if self.held_ns is None else self.held_ns
            self.held_ns = held_ns + round(request.for_s * 1e9)
        elif isinstance(request, Speed):
            self._anchor(self._position_ns(due_ns))
            self.pace = request.pace
        else:
            time_ns = self._instant_ns(due_ns)
            self._hands.act(request, time_ns)
            if self.held_ns is not None:
                self.held_ns = max(self.held_ns, time_ns)
                self._is_settled = False

    def _instant_ns(self, due_ns: int) -> int:
        """Return an instant between the latest event and the next one."""
        return min(max(self._reached_ns(due_ns), self._hands.now_ns() + 1), due_ns - 1)

    def _reached_ns(self, due_ns: int) -> int:
        """Return how far time has come, `due_ns` at most [ns]."""
        if self.held_ns is not None:
            return min(self.held_ns, due_ns)
        if self.pace is None:
            return due_ns
        if self._wall_ns is None:
            self._anchor(self._hands.now_ns())
            assert self._wall_ns is not None
        passed_ns = self._clock_ns() - self._wall_ns
        return min(due_ns, self._rig_ns + int(passed_ns * self.pace))

    def _anchor(self, rig_ns: int) -> None:
        """Let time pass from here on."""
        self._wall_ns, self._rig_ns = self._clock_ns(), rig_ns

    def _position_ns(self, due_ns: int) -> int:
        """Return where a hand stops time [ns]: without a pace, or in a step, at the last event."""
        if self.pace is None if self.held_ns is None else self.held_ns >= due_ns:
            return self._hands.now_ns()
        return self._reached_ns(due_ns)

    def _stop(self, due_ns: int) -> int:
        """Let time stand still; return where [ns]."""
        self.held_ns = self._position_ns(due_ns)
        self._is_settled = False
        return self.held_ns

    def _release(self) -> None:
        if self.held_ns is not None:
            self._anchor(self.held_ns)
            self.held_ns = None
            self._tell()

    def _settle(self) -> None:
        """Write the record for the page once, when time begins to stand still."""
        if not self._is_settled:
            self._is_settled = True
            self._hands.flush()
            self._tell()

    def _tell(self) -> None:
        self._told = self._hands.revision
        state: dict[str, Any] = {
            "stands": self.held_ns is not None,
            "at_s": None if self.held_ns is None else self.held_ns / 1e9,
            "pace": self.pace,
            "over": self._is_over,
        }
        self._channel.tell_state(state | self._hands.state())
