"""Quantities over time: appended one by one, then read as numpy arrays."""

from array import array
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from numpy import float64, int64
    from numpy.typing import NDArray

TIME_MAX_NS: Final = 1 << 62
"""Limit of drawn times; a stamp that far from the beginning is invalid."""


@final
class Track:
    """One quantity: times [ns from the recording's beginning] and values, in order of arrival.

    Attributes:
        held: True if a value holds until the next one; False if it samples a smooth quantity.
    """

    __slots__ = ("_last", "held", "times_ns", "values")

    def __init__(self, held: bool = False) -> None:
        self.times_ns: array[int] = array("q")
        self.values: array[float] = array("d")
        self.held = held
        self._last: float | None = None

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, value: float) -> None:
        """Append a value; an unchanged value of a held quantity is skipped."""
        if self.held and value == self._last:
            return
        self._last = value
        self.times_ns.append(time_ns)
        self.values.append(value)

    def sorted(self) -> "tuple[NDArray[int64], NDArray[float64]]":
        """Return times and values by time; equal times keep their order."""
        import numpy as np

        times = np.array(self.times_ns, dtype=np.int64)
        values = np.array(self.values, dtype=np.float64)
        if len(times) > 1 and bool(np.any(np.diff(times) < 0)):
            order = np.argsort(times, kind="stable")
            times, values = times[order], values[order]
        return times, values


@final
class Steps:
    """A state over time: a number from each time on, in order of arrival.

    Attributes:
        times_ns, codes: the times [ns] and the numbers.
        last: the present number; None: unknown.
    """

    __slots__ = ("codes", "last", "times_ns")

    def __init__(self) -> None:
        self.times_ns: array[int] = array("q")
        self.codes: array[int] = array("q")
        self.last: int | None = None

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, code: int) -> bool:
        """Append a state; return True if it differs from the previous one."""
        if code == self.last:
            return False
        self.last = code
        self.times_ns.append(time_ns)
        self.codes.append(code)
        return True
