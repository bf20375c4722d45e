"""A recording that is read while it grows: one thread, and pages that wait for its events.

The thread alone reads the file and feeds the session. Pages take events from the session's stream
under one lock; none of them can delay the thread by more than one picture takes to be made.
"""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Final, final

from motorhil.harness.view.session import Session
from motorhil.harness.view.stream import Event
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import Trace, TraceMessage

POLL_S: Final = 0.02
_PIECE: Final = 2_000  # messages between two looks at the clock


@final
class Source:
    """The events of a recording, complete or in progress.

    Attributes:
        problem: why the recording cannot be read any more; "": it can.
    """

    def __init__(
        self,
        trace: Trace,
        begin: Callable[[Trace], Session],
        publish: Callable[[TraceMessage], None] | None = None,
    ) -> None:
        """Set up the source.

        Args:
            trace: the recording.
            begin: makes the session once the first message is there.
            publish: gets every message as well; None: nothing does.
        """
        self.problem: str = ""
        self._trace = trace
        self._begin = begin
        self._publish = publish
        self._session: Session | None = None
        self._has_begun = False
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="motorhil view", daemon=True)

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading, and wake all pages."""
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def is_stopped(self) -> bool:
        """True after `stop`."""
        return self._stopped.is_set()

    @property
    def is_over(self) -> bool:
        """True if the recording is complete and all of it is in the events."""
        return self._session is not None and self._session.is_over

    def stretch(self, from_s: float, to_s: float) -> str:
        """Return all points between two times of the page [s]; "": nothing is there yet."""
        with self._changed:
            return "" if self._session is None else self._session.stretch(from_s, to_s)

    def wake(self) -> None:
        """Let all pages look whether there is anything but events."""
        with self._changed:
            self._changed.notify_all()

    def events(
        self, position: str | None, longest_s: float, stop: Callable[[], bool] = lambda: False
    ) -> list[Event]:
        """Return the events after a position, or one with the whole picture.

        Wait for up to `longest_s` [s] until there is one. After the end there are none.

        Args:
            position: what a page has already; None: nothing.
            longest_s: how long to wait [s].
            stop: returns True if the page need not wait any longer; asked after each `wake`.
        """
        end_s = time.monotonic() + longest_s
        with self._changed:
            while not self._stopped.is_set():
                found = self._events(position)
                left_s = end_s - time.monotonic()
                if found or left_s <= 0.0 or self.problem or self.is_over or stop():
                    return found
                self._changed.wait(left_s)
        return []

    def _events(self, position: str | None) -> list[Event]:
        session = self._session
        if session is None or not self._has_begun:
            return []
        found = None if position is None else session.stream.after(position)
        return [session.whole(time.monotonic_ns())] if found is None else found

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                is_busy = self._read()
                if self._session is not None and self._trace.cut is None and not is_busy:
                    with self._changed:
                        self._session.finish(time.monotonic_ns())
                        self._changed.notify_all()
                    return
                if not is_busy:
                    self._stopped.wait(POLL_S)
        except TraceError as error:
            with self._changed:
                self.problem = str(error)
                self._changed.notify_all()

    def _read(self) -> bool:
        """Read all that is new; return True if there was anything."""
        has_grown = self._trace.cut is not None and self._trace.grow()
        if self._session is None:
            if self._trace.span_ns() is None:
                return has_grown
            self._session = self._begin(self._trace)
        session, count = self._session, 0
        messages = self._trace.more_messages()
        if self._publish is not None:
            messages = _published(messages, self._publish)
        while not self._stopped.is_set():
            with self._changed:
                more = session.feed(islice(messages, _PIECE))
                count += more
                if self._has_begun and session.is_due(time.monotonic_ns()):
                    self._advance(session)
            if not more:
                break
        with self._changed:
            if not self._has_begun or session.is_due(time.monotonic_ns()):
                self._has_begun = True
                self._advance(session)
        return count > 0

    def _advance(self, session: Session) -> None:
        session.advance(time.monotonic_ns())
        self._changed.notify_all()


def _published(
    messages: Iterator[TraceMessage], publish: Callable[[TraceMessage], None]
) -> Iterator[TraceMessage]:
    for message in messages:
        publish(message)
        yield message
