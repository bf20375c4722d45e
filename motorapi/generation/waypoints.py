"""Functions through way-points."""

from collections.abc import Sequence
from math import isfinite, nan
from typing import TYPE_CHECKING

from motorapi.commands import DerivativeLimits
from motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorapi.functions.piecewise import Piecewise


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
    """A smooth function through way-points, as polynomials from each to the next; loads numpy.

    Pieces of degree 3 go through with a second derivative that does not step (the cubic spline),
    those of degree 5 with a third and a fourth one. Where a derivative is given as well, it is as
    given, and of a cubic the second may step there; of a quintic the fourth where the first is
    given, the third where the second is.

    Args:
        values: at least two [U].
        times: as many, ascending [s]; None: as short as `limits` allow. Those are held to rounding,
            and one is reached; that no other division of the time among the pieces is shorter, is
            not proved.
        limits: of first, second and third derivative, where there are no times; others are refused.
        first: first derivatives at the way-points [U/s], None where one is free; left out, they
            are 0 at both ends and free in between.
        second: likewise second ones [U/s²], for degree 5.
        degree: 3 or 5.
        initial_argument: where it begins, if there are no times.

    Raises:
        UsageError: there are too few, a number is not finite, times do not ascend, nothing tells
            how long it takes, or no times keep given derivatives within the limits.
    """
    from motorapi.generation.batched.waypoints import through_waypoints as many

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
