"""Sums, products and compositions of functions, as simple as possible.

The operators of `Function` come here. Polynomials and piecewise polynomials stay polynomials and
piecewise polynomials. A numeric factor is merged into the function. Nested sums and nested products
are flattened. In a sum, terms that differ only by their amplitudes are merged. Anything else
becomes a composite function.
"""

import operator
from collections.abc import Callable
from fractions import Fraction
from functools import reduce
from itertools import zip_longest
from math import fsum, inf
from typing import Final, Self, final

import numpy as np

from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import DomainError, UsageError
from motorhil.motorapi.functions.base import (
    LARGEST,
    Extrema,
    FloatArray,
    Function,
    operations,
    overlap,
)
from motorhil.motorapi.functions.integrals import Integral, anchored
from motorhil.motorapi.functions.numerics import extrema
from motorhil.motorapi.functions.piecewise import Piecewise
from motorhil.motorapi.functions.polynomial import Constant, Polynomial, polynomial
from motorhil.motorapi.functions.polynomial_math import Exact, nearest
from motorhil.motorapi.functions.sampled import Sampled
from motorhil.motorapi.functions.waves import Exponential, Wave

_SLACK: Final = 1e-15  # relative to the larger end of a domain: a few rounding errors


class _Members(Function):
    """The common part of sums and products: the members and their common domain."""

    __slots__ = ("_high", "_low", "_members")

    _members: tuple[Function, ...]
    _low: float
    _high: float

    def __init__(self, *members: Function) -> None:
        low, high = overlap(type(self).__name__, members)
        self._keep(_members=members, _low=low, _high=high)

    @property
    @final
    def domain(self) -> tuple[float, float]:
        """The intersection of the domains of its members."""
        return self._low, self._high

    @final
    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the breaks of all members in ]low, high[."""
        return tuple(sorted({b for m in self._members for b in m.breaks_between(low, high)}))

    @final
    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if all members are smooth in ]low, high]."""
        return all(member.is_smooth(low, high) for member in self._members)

    @final
    def shifted(self, offset: float) -> Self:
        """Return the function with every member shifted."""
        return type(self)(*(member.shifted(offset) for member in self._members))

    @final
    def scaled(self, factor: float) -> Self:
        """Return the function with every member scaled."""
        return type(self)(*(member.scaled(factor) for member in self._members))

    @final
    def _parameters(self) -> tuple[object, ...]:
        return self._members

    @final
    def _check(self, argument: float) -> None:
        if not (self._low <= argument <= self._high and -LARGEST <= argument <= LARGEST):
            self._refuse(argument)


@final
class Sum(_Members):
    """The sum of one or more functions over their common domain.

    Raises:
        UsageError: there is no term, one is not a function, or the domains do not overlap.
    """

    __slots__ = ()

    @property
    def terms(self) -> tuple[Function, ...]:
        """The terms, from left to right."""
        return self._members

    def value(self, argument: float) -> float:
        """Return the sum of the terms, added from left to right."""
        self._check(argument)
        total = self._members[0].value(argument)
        for term in self._members[1:]:
            total += term.value(argument)
        return total

    def _values(self, arguments: FloatArray) -> FloatArray:
        total = self._members[0](arguments)
        for term in self._members[1:]:
            total += term(arguments)
        return total

    def _derivative(self, order: int) -> Function:
        return reduce(operator.add, [term.derivative(order) for term in self._members])

    def integral(self) -> Function:
        """Return the sum of the integrals."""
        total = reduce(operator.add, [term.integral() for term in self._members])
        return anchored(total, self._origin())

    def _integrate(self, low: float, high: float) -> float:
        return fsum(term.integrate(low, high) for term in self._members)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        parts = [term.bounds(low, high) for term in self._members]
        return sum(part[0] for part in parts), sum(part[1] for part in parts)

    def times(self, number: float) -> Function:
        """Return the sum with every term multiplied by `number`."""
        return Sum(*(term.times(number) for term in self._members))


@final
class Product(_Members):
    """The product of one or more functions over their common domain.

    Raises:
        UsageError: there is no factor, one is not a function, or the domains do not overlap.
    """

    __slots__ = ()

    @property
    def factors(self) -> tuple[Function, ...]:
        """The factors, from left to right."""
        return self._members

    def value(self, argument: float) -> float:
        """Return the product of the factors, multiplied from left to right."""
        self._check(argument)
        total = self._members[0].value(argument)
        for factor in self._members[1:]:
            total *= factor.value(argument)
        return total

    def _values(self, arguments: FloatArray) -> FloatArray:
        total = self._members[0](arguments)
        for factor in self._members[1:]:
            total *= factor(arguments)
        return total

    def _derivative(self, order: int) -> Function:
        members = self._members
        terms = [
            reduce(operator.mul, [f.derivative() if k == i else f for k, f in enumerate(members)])
            for i in range(len(members))
        ]
        return reduce(operator.add, terms).derivative(order - 1)

    def integral(self) -> Function:
        """Return the integral by quadrature: existing closed forms suffer from cancellation."""
        return Integral(self)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        least, most = self._members[0].bounds(low, high)
        for factor in self._members[1:]:
            smallest, largest = factor.bounds(low, high)
            corners = (least * smallest, least * largest, most * smallest, most * largest)
            least, most = min(corners), max(corners)
        return least, most

    def times(self, number: float) -> Function:
        """Return the product with the first factor multiplied by `number`."""
        return Product(self._members[0].times(number), *self._members[1:])


@final
class Composition(Function):
    """x -> outer(inner(x)), on the domain of `inner`.

    A value of `inner` that exceeds the domain of `outer` only by rounding counts as the end of that
    domain. At a break of `outer` the piece that begins there counts, from whichever side `inner`
    approaches it.

    Raises:
        UsageError: `outer` or `inner` is not a function.
        DomainError: `inner` has a bounded domain, and leaves the domain of `outer` in it.
    """

    __slots__ = ("_high", "_low", "_slack", "inner", "outer")

    outer: Function
    inner: Function
    _low: float  # domain of outer
    _high: float
    _slack: float

    def __init__(self, outer: Function, inner: Function) -> None:
        for one in (outer, inner):
            if not isinstance(one, Function):
                raise UsageError(f"Composition: {one!r} is not a function")
        low, high = outer.domain
        sizes = [abs(end) for end in (low, high) if abs(end) <= LARGEST]
        self._keep(
            outer=outer,
            inner=inner,
            _low=max(low, -LARGEST),
            _high=min(high, LARGEST),
            _slack=_SLACK * max(sizes, default=0.0),
        )
        if sizes and max(abs(end) for end in inner.domain) <= LARGEST:
            self._require(*inner.domain)

    @property
    def domain(self) -> tuple[float, float]:
        """The domain of `inner`."""
        return self.inner.domain

    def _require(self, low: float, high: float) -> None:
        """Require that `inner` stays within the domain of `outer` over [low, high]."""
        found = self.inner.extrema(low, high)
        self._inner_value(found.minimum, found.at_minimum)
        self._inner_value(found.maximum, found.at_maximum)

    def _inner_value(self, value: float, argument: float) -> float:
        if self._low <= value <= self._high:
            return value
        if self._low - self._slack <= value <= self._high + self._slack:
            return self._low if value < self._low else self._high
        low, high = self.outer.domain
        within = f"{self.outer!r}, which it is the argument of where {self.inner!r} is at"
        raise DomainError(argument=value, low=low, high=high, function=f"{within} {argument!r}")

    def value(self, argument: float) -> float:
        """Return the value of the outer function at the value of the inner one."""
        inner = self.inner.value(argument)
        if not self._low <= inner <= self._high:
            inner = self._inner_value(inner, argument)
        return self.outer.value(inner)

    def _values(self, arguments: FloatArray) -> FloatArray:
        inner = self.inner(arguments)
        beyond = ~((self._low <= inner) & (inner <= self._high))
        for i in np.flatnonzero(beyond):
            inner[i] = self._inner_value(float(inner[i]), float(arguments[i]))
        return self.outer(inner)

    def _derivative(self, order: int) -> Function:
        chain = self.outer.derivative().after(self.inner) * self.inner.derivative()
        return chain.derivative(order - 1)

    def integral(self) -> Function:
        """Return the integral by quadrature."""
        return Integral(self)

    def _extrema(self, low: float, high: float) -> Extrema:
        self._require(low, high)
        return extrema(self, low, high)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        return self.outer.bounds(*self._reach(low, high))

    def _reach(self, low: float, high: float) -> tuple[float, float]:
        """Return a range of `inner` over [low, high], clipped to the domain of `outer`."""
        least, most = self.inner.bounds(low, high)
        return (
            min(max(least, self._low), self._high),
            max(min(most, self._high), self._low),
        )

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the breaks of `inner`; those caused by `outer` are unknown."""
        return self.inner.breaks_between(low, high)

    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if `inner` is smooth and does not come near a break of `outer`."""
        return self.inner.is_smooth(low, high) and self.outer.is_smooth(*self._reach(low, high))

    def times(self, number: float) -> Function:
        """Return the composition with the outer function multiplied by `number`."""
        return Composition(self.outer.times(number), self.inner)

    def shifted(self, offset: float) -> Function:
        """Return the composition with the inner function shifted."""
        return Composition(self.outer, self.inner.shifted(offset))

    def scaled(self, factor: float) -> Function:
        """Return the composition with the inner function scaled."""
        return Composition(self.outer, self.inner.scaled(factor))

    def _parameters(self) -> tuple[object, ...]:
        return self.outer, self.inner


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


def _amplified(function: Function, number: float) -> Product:
    return Product(Constant(number), function)


operations.amplify = _amplified
operations.as_function = as_function
operations.add = add
operations.multiply = multiply
operations.compose = compose
