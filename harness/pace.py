"""The wall clock as a brake: virtual events happen no earlier than their wall time."""

import time
from typing import final


@final
class WallPace:
    """Called with the time of the next event [ns], it returns when the wall clock has come there.

    Time 0 is the first call. What is late is not waited for, and not skipped either.

    Attributes: late_ns_max, the most that an event has been late so far [ns].
    """

    def __init__(self) -> None:
        self._start_ns: int | None = None
        self.late_ns_max = 0

    def __call__(self, due_ns: int) -> None:
        """Sleep until the wall clock has come to `due_ns`."""
        now_ns = time.monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        left_ns = self._start_ns + due_ns - now_ns
        if left_ns > 0:
            time.sleep(left_ns / 1e9)
        else:
            self.late_ns_max = max(self.late_ns_max, -left_ns)
