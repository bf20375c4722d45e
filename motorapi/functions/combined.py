"""Composite functions: sums, products, compositions.

The operators create these where `motorapi.functions.algebra` finds nothing simpler.
"""

from functools import reduce
from math import fsum
from operator import add, mul
from typing import Final, Self, final

import numpy as np

from motorapi.errors import DomainError, UsageError
from motorapi.functions.function import LARGEST, Extrema, FloatArray, Function, overlap
from motorapi.functions.integrals import Integral, anchored
from motorapi.functions.search import extrema

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
        return reduce(add, [term.derivative(order) for term in self._members])

    def integral(self) -> Function:
        """Return the sum of the integrals."""
        total = reduce(add, [term.integral() for term in self._members])
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
            reduce(mul, [f.derivative() if k == i else f for k, f in enumerate(members)])
            for i in range(len(members))
        ]
        return reduce(add, terms).derivative(order - 1)

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
