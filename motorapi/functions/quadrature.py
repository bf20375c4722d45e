"""Definite integrals of any function, by adaptive Gauss-Kronrod quadrature.

The interval is split where the function may jump. Then the part with the largest error is halved
until the sum of errors is below 1e-14 of the integral of the absolute value, or until only rounding
errors remain. The method needs function values only.

Source: QUADPACK (Piessens, de Doncker-Kapenga, Überhuber, Kahaner: 1983), the pair of 7 and 15
nodes and its error estimate.
"""

from heapq import heapify, heappop, heappush
from itertools import pairwise
from math import fsum
from typing import Final

from motorapi.functions.function import Function

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
