"""What sums, products and compositions come to: the simplest function that is the same.

Of polynomials, and of functions made of them piece by piece, the result is again one.
"""

from collections.abc import Callable
from fractions import Fraction

from motorapi.commands import as_number
from motorapi.errors import UsageError
from motorapi.functions import exact
from motorapi.functions.function import Function
from motorapi.functions.piecewise import Piecewise
from motorapi.functions.polynomial import Constant, Polynomial, polynomial


def as_function(operand: object) -> Function | None:
    """The operand as a function; None if it is neither a function nor a finite number."""
    if isinstance(operand, Function):
        return operand
    number = as_number(operand)
    return None if number != number else Constant(number)


def add(left: Function, right: Function) -> Function:
    """Left + right."""
    if isinstance(left, Polynomial) and isinstance(right, Polynomial):
        about = _about(left, right)
        return polynomial(exact.rounded(exact.plus(_at(left, about), _at(right, about))), about)
    merged = _by_pieces(left, right, add)
    if merged is not None:
        return merged
    raise NotImplementedError


def multiply(left: Function, right: Function) -> Function:
    """Left * right."""
    if isinstance(left, Polynomial) and isinstance(right, Polynomial):
        about = _about(left, right)
        return polynomial(exact.rounded(exact.times(_at(left, about), _at(right, about))), about)
    merged = _by_pieces(left, right, multiply)
    if merged is not None:
        return merged
    raise NotImplementedError


def compose(outer: Function, inner: Function) -> Function:
    """X -> outer(inner(x))."""
    if isinstance(outer, Polynomial) and isinstance(inner, Polynomial):
        within = exact.rational(inner.coefficients)
        within[0] -= Fraction(outer.about)
        composed = exact.composed(exact.rational(outer.coefficients), within)
        return polynomial(exact.rounded(composed), inner.about)
    raise NotImplementedError


def _about(left: Polynomial, right: Polynomial) -> float:
    """That of the one that loses more by moving."""
    return left.about if left.degree >= right.degree else right.about


def _at(p: Polynomial, about: float) -> exact.Rationals:
    return exact.moved(exact.rational(p.coefficients), Fraction(about) - Fraction(p.about))


def _by_pieces(
    left: Function, right: Function, combine: Callable[[Function, Function], Function]
) -> Function | None:
    """Piece by piece, if that makes pieces that are polynomials."""
    if not (_of_polynomials(left) and _of_polynomials(right)):
        return None
    low = max(left.domain[0], right.domain[0])
    high = min(left.domain[1], right.domain[1])
    if not low < high:
        raise UsageError(f"{left!r} and {right!r} have no interval in common")
    inner = {*left.breaks_between(low, high), *right.breaks_between(low, high)}
    breaks = [low, *sorted(inner), high]
    pieces = [
        combine(_piece(left, breaks[i], breaks[i + 1]), _piece(right, breaks[i], breaks[i + 1]))
        for i in range(len(breaks) - 1)
    ]
    return Piecewise(breaks, pieces)


def _of_polynomials(function: Function) -> bool:
    return isinstance(function, Polynomial) or (
        isinstance(function, Piecewise) and function.is_polynomial
    )


def _piece(function: Function, low: float, high: float) -> Function:
    """The polynomial over an interval without breaks, about its left end if it has one."""
    if isinstance(function, Piecewise):
        ((function, _, _),) = function.within(low, high)
    assert isinstance(function, Polynomial)
    return function.moved_to(low) if low > -float("inf") and function.degree else function
