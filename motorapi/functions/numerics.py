"""Extrema and definite integrals of any function, from its values and bounds.

*Extrema*, by branch and bound without a miss. The interval is split where the function may jump,
and then where its bounds leave the most room. A part is finished as soon as one of these conditions
is certain:

- it contains no value beyond those found so far by more than the accuracy;
- the function is monotone there: its extrema are at the ends, which are known;
- the derivative is monotone there: it has at most one zero, found by its sign.

So an extremum may be too small by the accuracy, but is never missed, however narrow it is.

Source: branch and bound with the monotonicity and the mean value test: Hansen & Walster, Global
Optimization Using Interval Analysis, 2nd ed. (2004), ch. 12.

*Integrals*, by adaptive Gauss-Kronrod quadrature. The interval is split where the function may
jump. Then the part with the largest error is halved until the sum of errors is below 1e-14 of the
integral of the absolute value, or until only rounding errors remain. The method needs function
values only.

Source: QUADPACK (Piessens, de Doncker-Kapenga, Überhuber, Kahaner: 1983), the pair of 7 and 15
nodes and its error estimate.
"""

from heapq import heapify, heappop, heappush
from itertools import pairwise
from math import fsum, inf, nextafter
from typing import Final, final

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import Extrema, Function, operations

# (number of parts, accuracy relative to the largest value) at which the search settles for less.
# Only terms that cancel almost everywhere (a sine squared and a cosine squared) get beyond the
# first.
ACCURACIES: Final = ((4096, 1e-12), (8192, 1e-9), (65536, 1e-6))
_PROBES: Final = 16  # values taken first, to finish most parts sooner

_RELATIVE: Final = 1e-14
_PARTS: Final = 2000

# (node, weight of the 15-node rule, weight of the 7-node rule), from the outside in; the middle
# node is last
_NODES: Final = (
    (0.991455371120812639206854697526329, 0.022935322010529224963732008058970, 0.0),
    (
        0.949107912342758524526189684047851,
        0.063092092629978553290700663189204,
        0.129484966168869693270611432679082,
    ),
    (0.864864423359769072789712788640926, 0.104790010322250183839876322541518, 0.0),
    (
        0.741531185599394439863864773280788,
        0.140653259715525918745189590510238,
        0.279705391489276667901467771423780,
    ),
    (0.586087235467691130294144258781560, 0.169004726639267902826583426598550, 0.0),
    (
        0.405845151377397166906606412076961,
        0.190350578064785409913256402421014,
        0.381830050505118944950369775488975,
    ),
    (0.207784955007898467600689403773245, 0.204432940075298892414161999234649, 0.0),
)
_MIDDLE: Final = (0.209482141084727828012999174891714, 0.417959183673469387755102040816327)
_EPSILON: Final = 2.3e-16

Part = tuple[
    float, float, float, float, float
]  # -error, low, high, integral, integral of the absolute value


def extrema(function: Function, low: float, high: float) -> Extrema:
    """Return the extrema over [low, high], `low` < `high`, to the first `ACCURACIES` reached.

    Raises:
        UsageError: the bounds of this function do not become tight enough.
    """
    search = _Search(function)
    for left, right in pairwise([low, *function.breaks_between(low, high), high]):
        last = right if right == high else nextafter(right, -inf)
        for k in range(_PROBES):
            search.meet(left + (last - left) * (k / _PROBES))
        search.meet(last)
    search.meet(high)
    for left, right in pairwise([low, *function.breaks_between(low, high), high]):
        search.look(left, right if right == high else nextafter(right, -inf))
    search.run()
    return search.found()


@final
class _Search:
    """The state of a search: extrema found, and parts still to be examined."""

    def __init__(self, function: Function) -> None:
        self._function = function
        self._slope = function.derivative()
        self._bend = function.derivative(2)
        self._least = self._most = 0.0
        self._at_least: float | None = None
        self._at_most = 0.0
        # (room left, negative; from, to; minimum and maximum possible value)
        self._parts: list[tuple[float, float, float, float, float]] = []

    def found(self) -> Extrema:
        assert self._at_least is not None
        return Extrema(self._least, self._at_least, self._most, self._at_most)

    def meet(self, at: float) -> float:
        """Evaluate the function at `at` and update the extrema."""
        value = self._function.value(at)
        if self._at_least is None:
            self._least = self._most = value
            self._at_least = self._at_most = at
        elif value < self._least:
            self._least, self._at_least = value, at
        elif value > self._most:
            self._most, self._at_most = value, at
        return value

    def run(self) -> None:
        """Examine parts until none can change the result."""
        done = 0
        for parts, accuracy in ACCURACIES:
            while self._parts and -self._parts[0][0] > self._slack(accuracy):
                if done == parts:
                    break
                done += 1
                _, left, right, least, most = heappop(self._parts)
                if self._room(least, most) > self._slack(accuracy):
                    middle = left + 0.5 * (right - left)
                    self.look(left, middle)
                    self.look(middle, right)
            else:
                return
        raise UsageError(
            f"{self._function!r}: its bounds are too wide to find its extrema to "
            f"{ACCURACIES[-1][1]:g}"
        )

    def look(self, left: float, right: float) -> None:
        """Examine the part between two evaluated arguments; finish it or queue it."""
        middle = left + 0.5 * (right - left)
        if not left < middle < right:
            return
        least, most = self._function.bounds(left, right)
        slack = self._slack(ACCURACIES[0][1])
        if self._room(least, most) <= slack:
            return
        value = self.meet(middle)
        if self._function.is_smooth(left, right):
            falls, rises = self._slope.bounds(left, right)
            low, high = self._bend.bounds(left, right)
            if falls >= 0.0 or rises <= 0.0:
                return
            if low >= 0.0 or high <= 0.0:
                if (self._slope.value(left) < 0.0) != (self._slope.value(right) < 0.0):
                    self.meet(_zero(self._slope, left, right))
                return
            half = middle - left
            by_bend = half * (abs(self._slope.value(middle)) + 0.5 * half * max(-low, high))
            reach = min(half * max(-falls, rises), by_bend)
            least, most = max(least, value - reach), min(most, value + reach)
        room = self._room(least, most)
        if room > slack:
            heappush(self._parts, (-room, left, right, least, most))

    def _room(self, least: float, most: float) -> float:
        """Return how far a value could exceed those found."""
        return max(self._least - least, most - self._most)

    def _slack(self, accuracy: float) -> float:
        return accuracy * max(abs(self._least), abs(self._most))


def _zero(slope: Function, left: float, right: float) -> float:
    """Return the sign change of a monotone function (bracketed Illinois method)."""
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


def integrate(function: Function, low: float, high: float) -> float:
    """Return the integral over [low, high], `low` < `high`.

    Returns:
        The integral. Its error is below 1e-13 of the integral of the absolute value if the function
        is smooth between its known breaks.
    """
    edges = [low, *function.breaks_between(low, high), high]
    parts = [_part(function, a, b) for a, b in pairwise(edges)]
    heapify(parts)
    for _ in range(_PARTS):
        error, a, b, _, size = parts[0]
        middle = a + 0.5 * (b - a)
        if -error <= 25.0 * _EPSILON * size or not a < middle < b:
            break
        if -fsum(part[0] for part in parts) <= _RELATIVE * fsum(part[4] for part in parts):
            break
        heappop(parts)
        heappush(parts, _part(function, a, middle))
        heappush(parts, _part(function, middle, b))
    return fsum(part[3] for part in parts)


def _part(function: Function, low: float, high: float) -> Part:
    half = 0.5 * (high - low)
    middle = low + half
    value = function.value
    at_middle = value(middle)
    pairs = [(value(middle - half * n), value(middle + half * n)) for n, _, _ in _NODES]
    fine, coarse = _MIDDLE[0] * at_middle, _MIDDLE[1] * at_middle
    size = _MIDDLE[0] * abs(at_middle)
    for (_, weight, rough), (left, right) in zip(_NODES, pairs, strict=True):
        fine += weight * (left + right)
        coarse += rough * (left + right)
        size += weight * (abs(left) + abs(right))
    mean = 0.5 * fine
    spread = _MIDDLE[0] * abs(at_middle - mean)
    for (_, weight, _), (left, right) in zip(_NODES, pairs, strict=True):
        spread += weight * (abs(left - mean) + abs(right - mean))
    error = abs(fine - coarse)
    if error and spread:
        error = spread * min(1.0, (200.0 * error / spread) ** 1.5)
    return -error * half, low, high, fine * half, size * half


operations.extrema = extrema
operations.integrate = integrate
