"""Tells of programs that let no virtual time pass, or that never end.

Virtual time passes only while programs wait. One that computes without a wait stops the world, and
one that receives in an endless loop runs through days of it. Both look alike from outside: nothing
happens. A thread on the wall clock looks once a second and says which it is, once each.
"""

import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime

_LOOK_S: Final = 1.0
_LOOKS: Final = 10  # after which it tells
_LONG_NS: Final = 3600 * 10**9


@final
class Standstill:
    """The progress of a run, as far as it is known.

    Args:
        runtime: the run's.
        place_of: returns the program's line in which a thread (identifier) is, or "".
        tell: called with a sentence.
    """

    def __init__(
        self,
        runtime: "VirtualRuntime",
        place_of: Callable[[int], str],
        tell: Callable[[str], None],
    ) -> None:
        self._runtime = runtime
        self._place_of = place_of
        self._tell = tell
        self._last = (-1, -1)
        self._looks = 0
        self._told_long = False

    def look(self) -> None:
        """Compare with the last look, one second ago."""
        runtime = self._runtime
        progress = runtime.progress()
        if progress != self._last:
            self._last = progress
            self._looks = 0
            self._look_at_end(progress[0])
            return
        self._looks += 1
        if self._looks == _LOOKS:
            self._tell_standstill(progress[0])

    def _tell_standstill(self, now_ns: int) -> None:
        party = self._runtime.running()
        if party is None:
            return
        place = self._place_of(party.ident)
        self._tell(
            f"virtual time has stood still at {now_ns / 1e9:.6f} s for {_LOOKS} s: {party.name!r} "
            f"has not waited since{place}; time passes only while programs wait: time.sleep(0.001) "
            "in a loop lets it pass"
        )

    def _look_at_end(self, now_ns: int) -> None:
        if self._told_long or now_ns < _LONG_NS:
            return
        self._told_long = True
        self._tell(
            f"virtual time has reached {now_ns // 10**9:,} s, and the program still runs; "
            "--until S ends it at S seconds, Ctrl-C ends it now"
        )


def line_in(script: str) -> Callable[[int], str]:
    """Return a function for `Standstill`: the line of the script in which a thread is."""

    def place(ident: int) -> str:
        frame = sys._current_frames().get(ident)  # noqa: SLF001 -- the documented way to see them
        lines = [one for one in traceback.extract_stack(frame) if one.filename == script]
        return f", at {script}:{lines[-1].lineno} ({lines[-1].line})" if lines else ""

    return place


@contextmanager
def watched(watch: Standstill) -> Iterator[None]:
    """Look once a second, in a thread on the wall clock, until the block ends."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(_LOOK_S):
            watch.look()

    thread = threading.Thread(target=run, name="standstill", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
