"""Simplification of sums, products and compositions of functions.

Polynomials and piecewise polynomials stay polynomials and piecewise polynomials. A numeric factor
is merged into the function. Nested sums and nested products are flattened. In a sum, terms that
differ only by their amplitudes are merged.
"""

from collections.abc import Callable
from fractions import Fraction
from itertools import zip_longest
from math import inf

from motorapi.commands import as_number
from motorapi.functions.combined import Composition, Product, Sum
from motorapi.functions.exact import Exact, nearest
from motorapi.functions.exponential import Exponential
from motorapi.functions.function import Function, overlap
from motorapi.functions.piecewise import Piecewise
from motorapi.functions.polynomial import Constant, Polynomial, polynomial
from motorapi.functions.sampled import Sampled
from motorapi.functions.waves import Wave


def as_function(operand: object) -> Function | None:
    """Return the operand as a function; None if it is neither a function nor a number."""
    if isinstance(operand, Function):
        return operand
    number = as_number(operand)
    return None if number != number else Constant(number)


def add(left: Function, right: Function) -> Function:
    """Return left + right."""
    if isinstance(left, Polynomial) and isinstance(right, Polynomial):
        about = _about(left, right)
        if left.about == right.about or min(left.degree, right.degree) == 0:
            pairs = zip_longest(left.coefficients, right.coefficients, fillvalue=0.0)
            return polynomial([a + b for a, b in pairs], about)
        return polynomial(left.exact(about).plus(right.exact(about)).rounded(), about)
    if _is_zero(left):
        return right
    if _is_zero(right):
        return left
    merged = _by_pieces(left, right, add)
    if merged is not None:
        return merged
    terms = _merged(add, _parts(Sum, left), _parts(Sum, right))
    kept = [term for term in terms if not _is_zero(term)] or terms[:1]
    return kept[0] if len(kept) == 1 else Sum(*kept)


def multiply(left: Function, right: Function) -> Function:
    """Return left * right."""
    for one, other in ((left, right), (right, left)):
        if isinstance(one, Polynomial) and one.degree == 0:
            number = one.coefficients[0]
            return other if number == 1.0 else other.times(number)
    if isinstance(left, Polynomial) and isinstance(right, Polynomial):
        about = _about(left, right)
        return polynomial(left.exact(about).times(right.exact(about)).rounded(), about)
    merged = _by_pieces(left, right, multiply)
    if merged is not None:
        return merged
    factors = _merged(multiply, _parts(Product, left), _parts(Product, right))
    return factors[0] if len(factors) == 1 else Product(*factors)


def compose(outer: Function, inner: Function) -> Function:
    """Return x -> outer(inner(x))."""
    if isinstance(outer, Polynomial) and isinstance(inner, Polynomial):
        local = inner.exact().plus(Exact.of([-outer.about]))
        return polynomial(outer.exact().after(local).rounded(), inner.about)
    if isinstance(outer, Polynomial) and _of_polynomials(inner):
        pieces = [compose(outer, piece) for piece in _piecewise(inner).pieces]
        return Piecewise(_piecewise(inner).breaks, pieces)
    if _of_polynomials(outer) and isinstance(inner, Polynomial) and inner.degree == 1:
        return _stretched(_piecewise(outer), inner)
    return Composition(outer, inner)


def _stretched(outer: Piecewise, line: Polynomial) -> Function:
    """Return outer(line(x)), piece by piece."""
    start, slope = (Fraction(c) for c in line.coefficients)
    breaks = [
        nearest((Fraction(b) - start) / slope + Fraction(line.about)) if abs(b) < inf else b
        for b in outer.breaks
    ]
    pieces = [compose(piece, line) for piece in outer.pieces]
    if slope < 0:
        breaks = [-b if abs(b) == inf else b for b in reversed(breaks)]
        pieces.reverse()
    return Piecewise(breaks, pieces)


def _parts(kind: type[Sum] | type[Product], function: Function) -> list[Function]:
    if isinstance(function, Sum) and kind is Sum:
        return list(function.terms)
    if isinstance(function, Product) and kind is Product:
        return list(function.factors)
    return [function]


def _merged(
    combine: Callable[[Function, Function], Function],
    parts: list[Function],
    others: list[Function],
) -> list[Function]:
    """Return all parts, with polynomial parts combined at the position of the first one."""
    result = list(parts)
    for other in others:
        for i, part in enumerate(result):
            if _of_polynomials(part) and _of_polynomials(other):
                result[i] = combine(part, other)
                break
            if combine is add and (like := _like_terms(part, other)) is not None:
                result[i] = like
                break
        else:
            result.append(other)
    return result


def _like_terms(left: Function, right: Function) -> Function | None:
    """Return the sum of two functions that differ only by their amplitudes, else None."""
    if not (isinstance(left, Wave | Exponential) and isinstance(right, type(left))):
        return None
    if left.unit_amplitude() != right.unit_amplitude():
        return None
    total = left.amplitude + right.amplitude
    return left.unit_amplitude().times(total) if total else Constant(0.0)


def _is_zero(function: Function) -> bool:
    return isinstance(function, Polynomial) and function.coefficients == (0.0,)


def _about(left: Polynomial, right: Polynomial) -> float:
    """Return the expansion point of the polynomial that loses more accuracy by a move."""
    return left.about if left.degree >= right.degree else right.about


def _by_pieces(
    left: Function, right: Function, combine: Callable[[Function, Function], Function]
) -> Function | None:
    """Combine piece by piece if both consist of polynomials, else return None."""
    if not (_of_polynomials(left) and _of_polynomials(right)):
        return None
    low, high = overlap(combine.__name__, (left, right))
    inner = {*left.breaks_between(low, high), *right.breaks_between(low, high)}
    breaks = [low, *sorted(inner), high]
    pieces = [
        combine(_piece(left, breaks[i], breaks[i + 1]), _piece(right, breaks[i], breaks[i + 1]))
        for i in range(len(breaks) - 1)
    ]
    return Piecewise(breaks, pieces)


def _of_polynomials(function: Function) -> bool:
    return isinstance(function, Polynomial | Sampled) or (
        isinstance(function, Piecewise) and function.is_polynomial
    )


def _piecewise(function: Function) -> Piecewise:
    if isinstance(function, Sampled):
        return function.curve
    assert isinstance(function, Piecewise)
    return function


def _piece(function: Function, low: float, high: float) -> Polynomial:
    """Return the polynomial over an interval without breaks, about its finite left end."""
    if not isinstance(function, Polynomial):
        ((function, _, _),) = _piecewise(function).within(low, high)
        assert isinstance(function, Polynomial)
    return function.moved_to(low) if low > -inf and function.degree else function
