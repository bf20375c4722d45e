"""What every function can do: the base class of the Math Function API, and its rules.

A function is a value: immutable, hashable, comparable, printable, and it pickles. Two functions
are equal if they are written alike (class and parameters), not if they agree everywhere.

The rules, for every function `f`:

- *Domain.* `f.domain` is closed: both ends belong to it. An argument outside, and nan and the
  infinities always, raise `DomainError`, which names argument and domain.
- *Jumps.* A piecewise function is continuous from the right: at a break the piece that begins
  there counts, at the domain's highest argument the last one. Its derivative is that of its pieces,
  by the same rule: from the right at a break, and without an impulse where the function jumps.
- *Derivative* of any order: `f.derivative(2)`; order 0 is the function itself.
- *Integral.* `f.integral()` is the antiderivative that is 0 where the domain begins, or, if it
  begins nowhere, at 0 (at its end if it ends below 0). `f.integrate(low, high)` is the definite
  one, and more accurate than a difference of the former; with `high < low` its sign changes.
- *Extrema* over a closed interval, exact to rounding for polynomials (by pieces) and waves; of
  equal ones the one at the lowest argument is told. Others are searched with bounds that can miss
  nothing, to 1e-12 of the values' size, and any of equals is told (`motorapi.functions.search`).
- *Arrays.* `f(x)` takes a number, or an array and gives one of the same shape. Functions made of
  polynomials give the same bits either way; sines and exponentials agree to the last place or two
  (they are the C library's for a number, numpy's for an array).
- *Operators* take numbers too. What is made of polynomials stays made of polynomials.

`value(x)` is the fast path for one number: no numpy on its way.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from sys import float_info
from typing import TYPE_CHECKING, Final, NoReturn, TypeAlias, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorapi.commands import as_number
from motorapi.errors import DomainError, UsageError

if TYPE_CHECKING:
    from motorapi.functions.piecewise import Piecewise

FloatArray: TypeAlias = NDArray[np.float64]
LARGEST: Final = float_info.max  # the end of a domain that has none: nan and inf lie beyond

_TOLD: Final = 80  # characters of a function within a message


@final
@dataclass(frozen=True, slots=True)
class Extrema:
    """The least and the greatest value over an interval, each with an argument of it."""

    minimum: float
    at_minimum: float
    maximum: float
    at_maximum: float


class Function(ABC):
    """A function of one real argument; see the module for what holds for all of them.

    A class of your own says what is abstract here. Its parameters are what `_parameters` tells, in
    the order in which the class takes them: equality, hash, pickling and `repr` come from there.
    """

    __slots__ = ()
    __array_ufunc__: Final = None  # numpy's own numbers leave operators to this class

    # --- what every class says

    @property
    @abstractmethod
    def domain(self) -> tuple[float, float]:
        """The lowest and the highest argument; -inf and inf where there is none."""

    @abstractmethod
    def value(self, argument: float) -> float:
        """The value at one argument, without numpy.

        Raises:
            DomainError: the argument lies outside the domain, or is not finite.
        """

    @abstractmethod
    def _values(self, arguments: FloatArray) -> FloatArray:
        """Values at a flat array of arguments, all of them in the domain; a new array."""

    @abstractmethod
    def _derivative(self, order: int) -> "Function":
        """The derivative of `order` >= 1."""

    @abstractmethod
    def integral(self) -> "Function":
        """The antiderivative that is 0 where the domain begins (or at 0, if it begins nowhere)."""

    @abstractmethod
    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        """A range that holds every value over [low, high]; the tighter the smaller the interval."""

    @abstractmethod
    def _parameters(self) -> tuple[object, ...]:
        """What the class was called with, in order; hashable."""

    # --- what most classes leave as it is

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Where, inside ]low, high[, the function or a derivative of it may jump, if known."""
        return ()

    def is_smooth(self, low: float, high: float) -> bool:
        """Whether nothing jumps in ]low, high]; False if that is not known."""
        return True

    def _extrema(self, low: float, high: float) -> Extrema:
        from motorapi.functions.search import extrema

        return extrema(self, low, high)

    def _integrate(self, low: float, high: float) -> float:
        from motorapi.functions.quadrature import integrate

        return integrate(self, low, high)

    # --- what an application calls

    @overload
    def __call__(self, argument: float) -> float: ...
    @overload
    def __call__(self, argument: ArrayLike) -> FloatArray: ...
    @final
    def __call__(self, argument: ArrayLike) -> float | FloatArray:
        """The value at a number, or the values at an array of numbers, in its shape.

        Raises:
            DomainError: an argument lies outside the domain, or is not finite; the first such.
            UsageError: it is no number and no array of numbers.
        """
        if isinstance(argument, float | int | np.integer | np.floating | np.bool_):
            return self.value(as_number(argument) if isinstance(argument, int) else float(argument))
        try:
            points = np.asarray(argument, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"{self!r}: {argument!r} is no array of numbers") from error
        flat = np.ascontiguousarray(points).reshape(-1)
        if flat.size:
            low, high = self.domain
            low, high = max(low, -LARGEST), min(high, LARGEST)
            if not (low <= flat.min() and flat.max() <= high):
                self._refuse(float(flat[np.argmin((low <= flat) & (flat <= high))]))
        with np.errstate(all="ignore"):
            return self._values(flat).reshape(points.shape)

    @final
    def derivative(self, order: int = 1) -> "Function":
        """The derivative of that order, >= 0; UsageError if it is beyond the largest float."""
        if not isinstance(order, int) or order < 0:
            raise UsageError(f"{self!r}: {order!r} is no order of a derivative; it is 0, 1, 2, ...")
        try:
            return self._derivative(order) if order else self
        except (OverflowError, RecursionError) as error:
            raise UsageError(f"{self!r}: its derivative of this order is too large") from error

    @final
    def integrate(self, low: float, high: float) -> float:
        """The definite integral from `low` to `high`.

        Raises:
            DomainError: one of them lies outside the domain, or is not finite.
            UsageError: it, or a value on the way, is beyond the largest float.
        """
        low, high = self._inside(low), self._inside(high)
        if low == high:
            return 0.0
        try:
            found = self._integrate(low, high) if low < high else -self._integrate(high, low)
        except (OverflowError, ValueError):  # of inf - inf it is a ValueError
            found = inf
        if -LARGEST <= found <= LARGEST:
            return found
        raise UsageError(f"{self!r}: its integral from {low!r} to {high!r} is too large")

    @final
    def extrema(self, low: float | None = None, high: float | None = None) -> Extrema:
        """The least and the greatest value over [low, high]; None: the domain's own end.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: `low` is above `high`.
        """
        low, high = self._interval(low, high)
        if low == high:
            only = self.value(low)
            return Extrema(only, low, only, low)
        return self._extrema(low, high)

    @final
    def bounds(self, low: float | None = None, high: float | None = None) -> tuple[float, float]:
        """A range that holds every value over [low, high]: quicker than `extrema`, and wider.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: `low` is above `high`.
        """
        low, high = self._interval(low, high)
        if low == high:
            return self.value(low), self.value(low)
        return self._bounds(low, high)

    @final
    def restricted(self, low: float, high: float) -> "Piecewise":
        """The same function over [low, high] only, a part of its domain.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: `low` is not below `high`.
        """
        from motorapi.functions.piecewise import Piecewise

        return Piecewise((self._inside(low), self._inside(high)), (self,))

    def shifted(self, offset: float) -> "Function":
        """X -> f(x - offset): what it was at x it is at x + offset; it begins that much later."""
        from motorapi.functions.moved import Shifted

        return Shifted(self, offset)

    def scaled(self, factor: float) -> "Function":
        """X -> f(x / factor): what it was at x it is at x * factor; it takes that much longer.

        A factor below 0 turns it round. To scale the values, multiply: `2.0 * f`.
        """
        from motorapi.functions.moved import Scaled

        return Scaled(self, factor)

    def times(self, number: float) -> "Function":
        """The values multiplied by a number, finite: what `number * f` is."""
        from motorapi.functions.combined import Product
        from motorapi.functions.polynomial import Constant

        return Product(Constant(number), self)

    @final
    def after(self, inner: "Function") -> "Function":
        """X -> f(inner(x))."""
        from motorapi.functions.algebra import compose

        return compose(self, inner)

    # --- operators

    @final
    def __add__(self, other: "Function | float") -> "Function":
        from motorapi.functions.algebra import add, as_function

        right = as_function(other)
        return NotImplemented if right is None else add(self, right)

    @final
    def __radd__(self, other: float) -> "Function":
        return self.__add__(other)

    @final
    def __mul__(self, other: "Function | float") -> "Function":
        from motorapi.functions.algebra import as_function, multiply

        right = as_function(other)
        return NotImplemented if right is None else multiply(self, right)

    @final
    def __rmul__(self, other: float) -> "Function":
        return self.__mul__(other)

    @final
    def __neg__(self) -> "Function":
        return self.__mul__(-1.0)

    @final
    def __pos__(self) -> "Function":
        return self

    @final
    def __sub__(self, other: "Function | float") -> "Function":
        from motorapi.functions.algebra import add, as_function

        right = as_function(other)
        return NotImplemented if right is None else add(self, -right)

    @final
    def __rsub__(self, other: float) -> "Function":
        return (-self).__add__(other)

    @final
    def __truediv__(self, divisor: float) -> "Function":
        number = as_number(divisor)
        if number != number or number == 0.0:
            raise UsageError(f"{self!r} cannot be divided by {divisor!r}, but by numbers only")
        return self.__mul__(1.0 / number)

    # --- as values

    @final
    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        assert isinstance(other, Function)
        return self is other or self._parameters() == other._parameters()

    @final
    def __hash__(self) -> int:
        return hash((type(self).__name__, self._parameters()))

    @final
    def __reduce__(self) -> tuple[Callable[..., "Function"], tuple[object, ...]]:
        return type(self), self._parameters()

    @final
    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is immutable: {name} cannot be set")

    @final
    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is immutable: {name} cannot be deleted")

    def __repr__(self) -> str:
        told = ", ".join(repr(parameter) for parameter in self._parameters())
        return f"{type(self).__name__}({told})"

    # --- within the package

    @final
    def _keep(self, **attributes: object) -> None:
        """Sets attributes while the object is made (and what it finds out about itself later)."""
        for name, value in attributes.items():
            object.__setattr__(self, name, value)

    @final
    def _refuse(self, argument: float) -> NoReturn:
        low, high = self.domain
        told = repr(self)
        if len(told) > _TOLD:
            told = f"this {type(self).__name__}"
        raise DomainError(argument=as_number(argument), low=low, high=high, function=told)

    @final
    def _inside(self, argument: float) -> float:
        low, high = self.domain
        number = as_number(argument)
        if not max(low, -LARGEST) <= number <= min(high, LARGEST):
            self._refuse(number)
        return number

    @final
    def _interval(self, low: float | None, high: float | None) -> tuple[float, float]:
        lowest, highest = self.domain
        first = self._inside(lowest if low is None else low)
        last = self._inside(highest if high is None else high)
        if first > last:
            raise UsageError(f"{self!r}: there is nothing between {first!r} and {last!r}")
        return first, last

    @final
    def _origin(self) -> float:
        """Where the integral is 0."""
        low, high = self.domain
        return low if low > -inf else min(0.0, high)


def finite(owner: str, name: str, value: object) -> float:
    """The parameter as a float.

    Raises:
        UsageError: it is no finite number.
    """
    number = value if type(value) is float else as_number(value)
    if not -LARGEST <= number <= LARGEST:
        raise UsageError(f"{owner}: {name} is {value!r}, not a finite number")
    return number


def overlap(owner: str, functions: Sequence[Function]) -> tuple[float, float]:
    """The interval that the domains have in common.

    Raises:
        UsageError: there is no function, one is none, or they have no interval in common.
    """
    if not functions:
        raise UsageError(f"{owner}: there is no function")
    for one in functions:
        if not isinstance(one, Function):
            raise UsageError(f"{owner}: {one!r} is no function")
    low = max(one.domain[0] for one in functions)
    high = min(one.domain[1] for one in functions)
    if not low < high:
        told = " and ".join("{!r} to {!r}".format(*one.domain) for one in functions)
        raise UsageError(f"{owner}: the domains {told} have no interval in common")
    return low, high
