"""Extrema of functions of any kind, by bounds that can miss nothing.

The interval is split where the function may jump, and then wherever more has to be known. A part is
done with as soon as one of these is certain, from the bounds of the function, of its derivative and
of the second one over that part:

- it holds no value beyond those found so far by more than the accuracy;
- the function is monotone there: extreme at the ends, and those are known;
- the derivative is monotone there: then it has at most one zero, found by its sign.

So an extremum can be told too small, by the accuracy, but not missed, however narrow it is.
Source: branch and bound with the monotonicity and the mean value test: Hansen & Walster, Global
Optimization Using Interval Analysis, 2nd ed. (2004), ch. 12.
"""

from itertools import pairwise
from math import inf, nextafter
from typing import Final, final

from motorapi.errors import UsageError
from motorapi.functions.function import Extrema, Function

ACCURACY: Final = 1e-12  # of the largest size of a value found
_PARTS: Final = 200_000
_PROBES: Final = 16  # values taken first, to be done sooner with most parts


def extrema(function: Function, low: float, high: float) -> Extrema:
    """The extrema over [low, high], `low` < `high`, to `ACCURACY`.

    Raises:
        UsageError: the bounds of this function do not get tight enough to tell.
    """
    search = _Search(function)
    edges = [low, *function.breaks_between(low, high), high]
    for left, right in pairwise(edges):
        last = right if right == high else nextafter(right, -inf)
        search.meet(left)
        search.meet(last)
        for k in range(1, _PROBES):
            search.meet(left + (last - left) * (k / _PROBES))
        search.parts.append((left, last))
    search.meet(high)
    search.run()
    return search.found()


@final
class _Search:
    """What has been found, and what is still to be looked at."""

    def __init__(self, function: Function) -> None:
        self.parts: list[tuple[float, float]] = []
        self._function = function
        self._slope = function.derivative()
        self._bend = function.derivative(2)
        self._least = self._most = 0.0
        self._at_least: float | None = None
        self._at_most = 0.0

    def found(self) -> Extrema:
        assert self._at_least is not None
        return Extrema(self._least, self._at_least, self._most, self._at_most)

    def meet(self, at: float) -> float:
        """Takes the value there into account."""
        value = self._function.value(at)
        if self._at_least is None:
            self._least = self._most = value
            self._at_least = self._at_most = at
        elif value < self._least or (value == self._least and at < self._at_least):
            self._least, self._at_least = value, at
        if value > self._most or (value == self._most and at < self._at_most):
            self._most, self._at_most = value, at
        return value

    def run(self) -> None:
        for _ in range(_PARTS):
            if not self.parts:
                return
            left, right = self.parts.pop()
            middle = left + 0.5 * (right - left)
            if left < middle < right and not self._is_done(left, right, middle):
                self.parts += [(middle, right), (left, middle)]
        raise UsageError(
            f"{self._function!r}: what is known of its values between two arguments is too little"
            f" to find its extrema to {ACCURACY:g}"
        )

    def _within(self, least: float, most: float) -> bool:
        """Whether no value from `least` to `most` matters."""
        slack = ACCURACY * max(abs(self._least), abs(self._most))
        return least >= self._least - slack and most <= self._most + slack

    def _is_done(self, left: float, right: float, middle: float) -> bool:
        """Whether all that matters between two arguments, both met, has been met."""
        if self._within(*self._function.bounds(left, right)):
            return True
        value = self.meet(middle)
        if not self._function.is_smooth(left, right):
            return False
        falls, rises = self._slope.bounds(left, right)
        if falls >= 0.0 or rises <= 0.0:
            return True
        reach = max(-falls, rises) * (middle - left)
        if self._within(value - reach, value + reach):
            return True
        low, high = self._bend.bounds(left, right)
        if low < 0.0 < high:
            return False
        if (self._slope.value(left) < 0.0) != (self._slope.value(right) < 0.0):
            self.meet(_zero(self._slope, left, right))
        return True


def _zero(slope: Function, left: float, right: float) -> float:
    """Where a monotone function changes its sign (the Illinois method, bracketed)."""
    at_left, at_right = slope.value(left), slope.value(right)
    for _ in range(200):
        if at_left == at_right:
            break
        at = right - at_right * (right - left) / (at_right - at_left)
        if not left < at < right:
            at = left + 0.5 * (right - left)
            if not left < at < right:
                break
        value = slope.value(at)
        if value == 0.0:
            return at
        if (value < 0.0) == (at_left < 0.0):
            left, at_left, at_right = at, value, 0.5 * at_right
        else:
            right, at_right, at_left = at, value, 0.5 * at_left
    return left + 0.5 * (right - left)
