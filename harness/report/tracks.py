"""Quantities over time as they come: appended one by one, then arrays of numpy."""

from array import array
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from numpy import float64, int64
    from numpy.typing import NDArray

TIME_MAX_NS: Final = 1 << 62
"""Further from the beginning nothing is drawn: a stamp that far off is a broken one."""


@final
class Track:
    """One quantity: times [ns from the recording's beginning] and values, in the order they came.

    Attributes:
        held: whether a value stands until the next one; else it is a sample of something smooth.
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
        """It had this value; of a held one, what is not new is left out."""
        if self.held and value == self._last:
            return
        self._last = value
        self.times_ns.append(time_ns)
        self.values.append(value)

    def sorted(self) -> "tuple[NDArray[int64], NDArray[float64]]":
        """Times and values by time; what has one time keeps its order."""
        import numpy as np

        times = np.array(self.times_ns, dtype=np.int64)
        values = np.array(self.values, dtype=np.float64)
        if len(times) > 1 and bool(np.any(np.diff(times) < 0)):
            order = np.argsort(times, kind="stable")
            times, values = times[order], values[order]
        return times, values


@final
class Steps:
    """A state over time: a number from each time on, in the order it came.

    Attributes: times_ns, codes, last (the present one; None: not known yet).
    """

    __slots__ = ("codes", "last", "times_ns")

    def __init__(self) -> None:
        self.times_ns: array[int] = array("q")
        self.codes: array[int] = array("q")
        self.last: int | None = None

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, code: int) -> bool:
        """It is in this state; whether that is new."""
        if code == self.last:
            return False
        self.last = code
        self.times_ns.append(time_ns)
        self.codes.append(code)
        return True
