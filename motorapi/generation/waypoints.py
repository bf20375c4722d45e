"""Smooth functions through way-points."""

from collections.abc import Sequence
from math import isfinite, nan
from typing import TYPE_CHECKING

from motorhil.motorapi.commands import DerivativeLimits
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.motorapi.functions.piecewise import Piecewise


def through_waypoints(
    values: Sequence[float],
    times: Sequence[float] | None = None,
    *,
    limits: DerivativeLimits | None = None,
    first: Sequence[float | None] | None = None,
    second: Sequence[float | None] | None = None,
    degree: int = 3,
    initial_argument: float = 0.0,
) -> "Piecewise":
    """Return a smooth function through way-points, one polynomial per interval; imports numpy.

    Pieces of degree 3 have a continuous second derivative (the cubic spline), those of degree 5
    continuous third and fourth ones. Given derivatives are reproduced. At a given derivative, the
    second derivative of a cubic may jump. In a quintic the fourth may jump where the first is
    given, the third where the second is given.

    Args:
        values: at least two [U].
        times: one per value, ascending [s]; None: as short as `limits` allow. The limits are met to
            rounding, and one is reached; the division of the time among the pieces is not proven to
            be optimal.
        limits: of first, second and third derivative, without `times`; others raise an error.
        first: first derivatives at the way-points [U/s], None for a free one; by default 0 at both
            ends and free in between.
        second: second derivatives [U/s²], likewise, for degree 5.
        degree: 3 or 5.
        initial_argument: argument at the beginning, without `times`.

    Raises:
        UsageError: there are too few values, a number is not finite, times do not ascend, no
            argument determines the duration, or no times keep given derivatives within the limits.
    """
    from motorhil.motorapi.generation.batch import through_waypoints as many

    if not isfinite(initial_argument):
        raise UsageError(f"the initial argument is {initial_argument}, not a finite number")
    curves = many(
        [list(values)],
        times,
        limits=limits,
        first=_numbers(first),
        second=_numbers(second),
        degree=degree,
    )
    if times is None:
        curves.breaks += initial_argument
    return curves.function(0)


def _numbers(derivatives: Sequence[float | None] | None) -> list[float] | None:
    if derivatives is None:
        return None
    return [nan if number is None else number for number in derivatives]
