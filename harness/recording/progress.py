"""Progress line of a recording, for the terminal."""

from typing import Final, final

_NS: Final = 1_000_000_000
PERIOD_NS: Final = 250_000_000


@final
class Progress:
    """Progress line, updated four times a second; the caller passes the time."""

    def __init__(self, now_ns: int) -> None:
        """Start at `now_ns` [ns]."""
        self._begin_ns = now_ns
        self._last_ns = now_ns
        self._last_frames = 0

    def line(self, now_ns: int, frames: int, dropped: int, size: int) -> str | None:
        """Return the progress line, or None before the next update is due.

        Args:
            now_ns: monotonic time [ns].
            frames: number of frames recorded so far.
            dropped: number of frames lost so far.
            size: size of the files [bytes].
        """
        passed_ns = now_ns - self._last_ns
        if passed_ns < PERIOD_NS:
            return None
        rate = round((frames - self._last_frames) * _NS / passed_ns)
        self._last_ns, self._last_frames = now_ns, frames
        return (
            f"{(now_ns - self._begin_ns) / _NS:8.1f} s  {frames:,} frames  {rate:,} frames/s  "
            f"{dropped:,} lost  {size / 2**20:.1f} MiB"
        )
