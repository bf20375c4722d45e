"""Intervals in which a function rises or falls.

Numpy is imported only if a function is given.
"""

from itertools import pairwise
from math import nextafter
from typing import TYPE_CHECKING

from motorapi.commands import Range

if TYPE_CHECKING:
    from motorapi.functions.function import Function


def parts_by_direction(function: "Function", interval: Range) -> tuple[list[Range], list[Range]]:
    """Return the parts of the interval where the first derivative may be > 0, and < 0.

    The result is exact for (piecewise) polynomials. For other functions a part between two breaks
    with both signs is listed twice.
    """
    from motorapi.functions.piecewise import Piecewise
    from motorapi.functions.polynomial import Polynomial
    from motorapi.functions.polynomial_extrema import candidates

    low, high = interval
    pieces = (
        function.within(low, high) if isinstance(function, Piecewise) else [(function, low, high)]
    )
    slope = function.derivative()
    forward: list[Range] = []
    backward: list[Range] = []
    for piece, first, last in pieces:
        exact = isinstance(piece, Polynomial)
        if isinstance(piece, Polynomial):
            about = piece.about
            turns = candidates(piece.coefficients, first - about, last - about)
            inner = [about + turn for turn in turns if first < about + turn < last]
        else:
            inner = list(piece.breaks_between(first, last))
        for begin, end in pairwise([first, *inner, last]):
            if not begin < end:
                continue
            middle = slope.value(0.5 * (begin + end))
            lowest, highest = (middle, middle) if exact else slope.bounds(begin, end)
            # The right end of a part belongs to the next part.
            part = (begin, end if end == high else nextafter(end, begin))
            if highest > 0.0:
                forward.append(part)
            if lowest < 0.0:
                backward.append(part)
    return forward, backward
