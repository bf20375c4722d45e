"""Wall clock as a brake for virtual time.

Virtual events happen no earlier than their wall time.
"""

import time
from typing import final


@final
class WallPace:
    """A callable that returns when wall time has reached the next event's time [ns].

    Time 0 is the first call. Late events are neither delayed further nor skipped.

    Attributes:
        late_ns_max: largest lateness of an event so far [ns].
    """

    def __init__(self) -> None:
        self._start_ns: int | None = None
        self.late_ns_max = 0

    def __call__(self, due_ns: int) -> None:
        """Sleep until wall time has reached `due_ns`."""
        now_ns = time.monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        left_ns = self._start_ns + due_ns - now_ns
        if left_ns > 0:
            time.sleep(left_ns / 1e9)
        else:
            self.late_ns_max = max(self.late_ns_max, -left_ns)
