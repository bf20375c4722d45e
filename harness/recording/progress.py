"""What a terminal shows of a recording being made."""

from typing import Final, final

_NS: Final = 1_000_000_000
PERIOD_NS: Final = 250_000_000


@final
class Progress:
    """A line that says how it goes, four times a second; told the time, it asks no clock."""

    def __init__(self, now_ns: int) -> None:
        """It began at `now_ns`."""
        self._begin_ns = now_ns
        self._last_ns = now_ns
        self._last_frames = 0

    def line(self, now_ns: int, frames: int, dropped: int, size: int) -> str | None:
        """The line, if it is time for one.

        Args:
            now_ns: by a clock that never goes back [ns].
            frames: recorded so far.
            dropped: lost so far.
            size: of the files [bytes].
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
