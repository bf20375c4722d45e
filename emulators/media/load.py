"""Load of a medium: exact over any window, and at its peak."""

from array import array
from bisect import bisect_right
from typing import Final, final

ENTRIES_MAX: Final = 1 << 16  # 1 MB, so that a rig of ten buses grows by no more than 10 MB


@final
class BusyTime:
    """The busy time of a medium, as a list of periods.

    Adjacent periods are merged. A CAN bus without pauses costs nothing per frame, one with a pause
    after every frame 16 bytes per frame, up to 1 MB. Beyond that, every other entry of the older
    half is dropped. The totals stay exact, and so do windows in the newer half. An older window is
    exact between entries; inside of one, the busy time counts as evenly spread.
    """

    def __init__(self, entries_max: int = ENTRIES_MAX) -> None:
        self._entries_max = entries_max
        self._ends_ns = array("q")  # of the periods before the last one
        self._sums_ns = array("q")  # busy time from 0 to each of these ends
        self._spread = 0  # number of entries, from the first on, that stand for several periods
        self._start_ns = 0  # of the last period
        self._end_ns = 0
        self._before_ns = 0  # busy time before the last period

    def add(self, start_ns: int, end_ns: int) -> None:
        """Add a busy period from `start_ns` to `end_ns`, not before the end of the last one."""
        last_end_ns = self._end_ns
        if start_ns != last_end_ns:
            before_ns = self._before_ns + last_end_ns - self._start_ns
            self._ends_ns.append(last_end_ns)
            self._sums_ns.append(before_ns)
            if len(self._ends_ns) > self._entries_max:
                self._thin()
            self._before_ns = before_ns
            self._start_ns = start_ns
        self._end_ns = end_ns

    def _thin(self) -> None:
        """Drop every other entry of the older half."""
        half = self._entries_max // 2
        self._ends_ns = self._ends_ns[1:half:2] + self._ends_ns[half:]
        self._sums_ns = self._sums_ns[1:half:2] + self._sums_ns[half:]
        self._spread = half // 2

    def busy_ns(self, until_ns: int | None = None) -> int:
        """Return the busy time from 0 to `until_ns`, or in total [ns]."""
        if until_ns is None or until_ns >= self._end_ns:
            return self._before_ns + self._end_ns - self._start_ns
        if until_ns >= self._start_ns:
            return self._before_ns + until_ns - self._start_ns
        return self._busy_before_last_ns(until_ns, bisect_right(self._ends_ns, until_ns))

    def load(self, from_ns: int, until_ns: int) -> float:
        """Return the busy part of a window, 0.0 to 1.0.

        Raises:
            ValueError: the window is empty.
        """
        if until_ns <= from_ns:
            raise ValueError(
                f"window from {from_ns} ns until {until_ns} ns is empty; expected "
                "from_ns < until_ns"
            )
        return (self.busy_ns(until_ns) - self.busy_ns(from_ns)) / (until_ns - from_ns)

    def peak_load(self, window_ns: int) -> float:
        """Return the highest load of any window of this length, 0.0 to 1.0, wherever it begins.

        The result is exact, because a fullest window ends where a period ends; where old entries
        were dropped, a window's busy time may be off by what two entries stand for, either way.

        Raises:
            ValueError: window_ns is not above 0.
        """
        if window_ns <= 0:
            raise ValueError(f"window of {window_ns} ns is empty; expected above 0 ns")
        ends_ns = self._ends_ns
        index = 0
        most_ns = 0
        for end_ns, sum_ns in zip(ends_ns, self._sums_ns, strict=True):
            from_ns = end_ns - window_ns
            while ends_ns[index] <= from_ns:
                index += 1
            most_ns = max(most_ns, sum_ns - self._busy_before_last_ns(from_ns, index))
        from_ns = self._end_ns - window_ns
        most_ns = max(most_ns, self.busy_ns() - self.busy_ns(from_ns))
        return most_ns / window_ns

    def _busy_before_last_ns(self, until_ns: int, index: int) -> int:
        """Return the busy time from 0 to `until_ns`; period `index` is the first to end later."""
        if index == len(self._ends_ns):
            return self._before_ns
        before_ns = self._sums_ns[index - 1] if index else 0
        if index < self._spread:
            begin_ns = self._ends_ns[index - 1] if index else 0
            part_ns = (self._sums_ns[index] - before_ns) * max(0, until_ns - begin_ns)
            return before_ns + part_ns // (self._ends_ns[index] - begin_ns)
        start_ns = self._ends_ns[index] - (self._sums_ns[index] - before_ns)
        return before_ns + max(0, until_ns - start_ns)
