"""Base class of the Math Function API, and its rules.

A function is a value: immutable, hashable, comparable, printable and picklable. Two functions are
equal if their classes and parameters are equal, not if they agree everywhere.

The rules, for every function `f`:

- *Domain.* `f.domain` is closed: both ends belong to it. An argument outside, nan or an infinity
  raises `DomainError`, which names argument and domain.
- *Jumps.* A piecewise function is continuous from the right: at a break the piece that begins there
  counts, at the highest argument of the domain the last one. Its derivative is that of its pieces,
  by the same rule: from the right at a break, and without an impulse at a jump.
- *Derivative* of any order: `f.derivative(2)`; order 0 is the function itself.
- *Integral.* `f.integral()` is the antiderivative that is 0 at the lower end of the domain, or at
  min(0, upper end) without a lower end. `f.integrate(low, high)` is the definite integral, more
  accurate than a difference of the antiderivative; with `high < low` its sign changes.
- *Extrema* over a closed interval are exact to rounding for (piecewise) polynomials and waves; the
  first of equal ones is returned. Other functions are searched with bounds that miss nothing, to
  1e-12 of the size of the values; any of equal ones is returned
  (`motorhil.motorapi.functions.numerics`).
- *Arrays.* `f(x)` takes a number, or an array and returns one of the same shape. Functions made of
  polynomials give the same bits either way; sines and exponentials agree to the last digit or two
  (the C library computes single numbers, numpy computes arrays).
- *Operators* accept numbers too. Combinations of polynomials remain polynomials.

`value(x)` is the fast path for one number, without numpy.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import inf
from sys import float_info
from typing import Final, NoReturn, TypeAlias, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorhil.frozen import frozen
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import DomainError, UsageError

FloatArray: TypeAlias = NDArray[np.float64]
LARGEST: Final = float_info.max  # the end of an unbounded domain: nan and inf lie beyond

_TOLD: Final = 80  # maximum length of a function in a message


@final
@frozen
class Extrema:
    """The minimum and maximum over an interval, each with one of its arguments."""

    minimum: float
    at_minimum: float
    maximum: float
    at_maximum: float


class Function(ABC):
    """A function of one real argument; see the module for the common rules.

    Subclasses implement the abstract methods. `_parameters` returns the arguments of the
    constructor in order: equality, hash, pickling and `repr` use them.
    """

    __slots__ = ()
    __array_ufunc__: Final = None  # numpy scalars leave the operators to this class

    # --- implemented by every class

    @property
    @abstractmethod
    def domain(self) -> tuple[float, float]:
        """The lowest and the highest argument; -inf and inf for unbounded sides."""

    @abstractmethod
    def value(self, argument: float) -> float:
        """Return the value at one argument, without numpy.

        Raises:
            DomainError: the argument lies outside the domain, or is not finite.
        """

    @abstractmethod
    def _values(self, arguments: FloatArray) -> FloatArray:
        """Return the values at a flat array of arguments in the domain, as a new array."""

    @abstractmethod
    def _derivative(self, order: int) -> "Function":
        """Return the derivative of `order` >= 1."""

    @abstractmethod
    def integral(self) -> "Function":
        """Return the antiderivative that is 0 at the lower end of the domain (else at 0)."""

    @abstractmethod
    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        """Return a range of all values over [low, high], tighter for smaller intervals."""

    @abstractmethod
    def _parameters(self) -> tuple[object, ...]:
        """Return the arguments of the constructor, in order; hashable."""

    # --- overridden by a few classes

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the known points in ]low, high[ where the function or a derivative may jump."""
        return ()

    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if nothing jumps in ]low, high]; False if that is unknown."""
        return True

    def _extrema(self, low: float, high: float) -> Extrema:
        return operations.extrema(self, low, high)

    def _integrate(self, low: float, high: float) -> float:
        return operations.integrate(self, low, high)

    # --- called by applications

    @overload
    def __call__(self, argument: float) -> float: ...
    @overload
    def __call__(self, argument: ArrayLike) -> FloatArray: ...
    @final
    def __call__(self, argument: ArrayLike) -> float | FloatArray:
        """Return the value at a number, or the values at an array, in its shape.

        Raises:
            DomainError: an argument lies outside the domain, or is not finite; names the first.
            UsageError: the argument is neither a number nor an array of numbers.
        """
        if isinstance(argument, float | int | np.integer | np.floating | np.bool_):
            return self.value(as_number(argument) if isinstance(argument, int) else float(argument))
        try:
            points = np.asarray(argument, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"{self!r}: {argument!r} is not an array of numbers") from error
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
        """Return the derivative of `order` >= 0; UsageError if it exceeds the largest float."""
        if not isinstance(order, int) or order < 0:
            raise UsageError(f"{self!r}: derivative order {order!r}; expected 0, 1, 2, ...")
        try:
            return self._derivative(order) if order else self
        except (OverflowError, RecursionError) as error:
            raise UsageError(f"{self!r}: its derivative of this order is too large") from error

    @final
    def integrate(self, low: float, high: float) -> float:
        """Return the definite integral from `low` to `high`.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: the integral, or an intermediate value, exceeds the largest float.
        """
        low, high = self._inside(low), self._inside(high)
        if low == high:
            return 0.0
        try:
            found = self._integrate(low, high) if low < high else -self._integrate(high, low)
        except (OverflowError, ValueError):  # inf - inf raises ValueError
            found = inf
        if -LARGEST <= found <= LARGEST:
            return found
        raise UsageError(f"{self!r}: its integral from {low!r} to {high!r} is too large")

    @final
    def extrema(self, low: float | None = None, high: float | None = None) -> Extrema:
        """Return minimum and maximum over [low, high]; None: the end of the domain.

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
        """Return a range of all values over [low, high]: faster than `extrema`, and wider.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: `low` is above `high`.
        """
        low, high = self._interval(low, high)
        if low == high:
            return self.value(low), self.value(low)
        return self._bounds(low, high)

    @final
    def restricted(self, low: float, high: float) -> "Function":
        """Return the same function over [low, high] only, a part of its domain.

        Raises:
            DomainError: an end lies outside the domain, or is not finite.
            UsageError: `low` is not below `high`.
        """
        return operations.restrict(self, self._inside(low), self._inside(high))

    def shifted(self, offset: float) -> "Function":
        """Return x -> f(x - offset), which begins `offset` later."""
        return operations.shift(self, offset)

    def scaled(self, factor: float) -> "Function":
        """Return x -> f(x / factor), which takes `factor` times as long.

        A negative factor reverses the function. To scale the values, multiply: `2.0 * f`.
        """
        return operations.scale(self, factor)

    def times(self, number: float) -> "Function":
        """Return the function multiplied by a finite number, as `number * f`."""
        return operations.amplify(self, number)

    @final
    def after(self, inner: "Function") -> "Function":
        """Return x -> f(inner(x))."""
        return operations.compose(self, inner)

    # --- operators

    @final
    def __add__(self, other: "Function | float") -> "Function":
        right = operations.as_function(other)
        return NotImplemented if right is None else operations.add(self, right)

    @final
    def __radd__(self, other: float) -> "Function":
        return self.__add__(other)

    @final
    def __mul__(self, other: "Function | float") -> "Function":
        right = operations.as_function(other)
        return NotImplemented if right is None else operations.multiply(self, right)

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
        right = operations.as_function(other)
        return NotImplemented if right is None else operations.add(self, -right)

    @final
    def __rsub__(self, other: float) -> "Function":
        return (-self).__add__(other)

    @final
    def __truediv__(self, divisor: float) -> "Function":
        number = as_number(divisor)
        if number != number or number == 0.0:
            raise UsageError(f"{self!r}: divisor {divisor!r}; expected a number other than 0")
        return self.__mul__(1.0 / number)

    # --- value semantics

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

    # --- internal to the package

    @final
    def _keep(self, **attributes: object) -> None:
        """Set attributes in the constructor (and cached results later)."""
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
            raise UsageError(f"{self!r}: the interval from {first!r} to {last!r} is empty")
        return first, last

    @final
    def _origin(self) -> float:
        """Return the argument at which the integral is 0."""
        low, high = self.domain
        return low if low > -inf else min(0.0, high)


@final
class Operations:
    """The operations of `Function` whose results are of other classes.

    The modules of these classes are above this one, so they set the operations when the package is
    imported.
    """

    extrema: Callable[[Function, float, float], Extrema]
    integrate: Callable[[Function, float, float], float]
    restrict: Callable[[Function, float, float], Function]
    shift: Callable[[Function, float], Function]
    scale: Callable[[Function, float], Function]
    amplify: Callable[[Function, float], Function]
    as_function: Callable[[object], Function | None]
    add: Callable[[Function, Function], Function]
    multiply: Callable[[Function, Function], Function]
    compose: Callable[[Function, Function], Function]


operations: Final = Operations()


def finite(owner: str, name: str, value: object) -> float:
    """Return the parameter as a float.

    Raises:
        UsageError: it is not a finite number.
    """
    number = value if type(value) is float else as_number(value)
    if not -LARGEST <= number <= LARGEST:
        raise UsageError(f"{owner}: {name} is {value!r}, not a finite number")
    return number


def overlap(owner: str, functions: Sequence[Function]) -> tuple[float, float]:
    """Return the intersection of the domains.

    Raises:
        UsageError: there is no function, one is not a function, or the domains do not overlap.
    """
    if not functions:
        raise UsageError(f"{owner}: there is no function")
    for one in functions:
        if not isinstance(one, Function):
            raise UsageError(f"{owner}: {one!r} is not a function")
    low = max(one.domain[0] for one in functions)
    high = min(one.domain[1] for one in functions)
    if not low < high:
        told = " and ".join("{!r} to {!r}".format(*one.domain) for one in functions)
        raise UsageError(f"{owner}: the domains {told} have no interval in common")
    return low, high
