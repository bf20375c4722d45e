"""Limits of many profiles at once."""

from typing import TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorapi.errors import UsageError
from motorapi.generation.limits import ProfileLimits

FloatArray: TypeAlias = NDArray[np.float64]


@final
class LimitArrays:
    """As `ProfileLimits`, with an array or a number in each place; accelerations are sizes.

    Not to be changed once made, nor the arrays it was made of.

    Attributes:
        high: the highest velocity [U/s].
        rise, fall: sizes of the second derivative while the first is > 0 [U/s²].
        back_rise, back_fall: likewise while it is < 0.
        is_symmetric: backward motion is known to have the same limits as forward motion.

    Args:
        velocity: (low, high), or x for (-x, x).
        acceleration: a range (low, high) of the second derivative, or a size while speeding up.
        deceleration: the size while slowing down; None: as `acceleration`.

    Raises:
        UsageError: a range is empty, does not hold 0, or is given together with `deceleration`;
            names the first index.
    """

    __slots__ = ("_low", "back_fall", "back_rise", "fall", "high", "is_symmetric", "rise")

    def __init__(
        self,
        velocity: ArrayLike | tuple[ArrayLike, ArrayLike],
        acceleration: ArrayLike | tuple[ArrayLike, ArrayLike],
        deceleration: ArrayLike | None = None,
    ) -> None:
        self._low: FloatArray | None = None  # as -high
        if isinstance(velocity, tuple):
            self._low, self.high = _array(velocity[0]), _array(velocity[1])
        else:
            self.high = _array(velocity)
        if isinstance(acceleration, tuple):
            if deceleration is not None:
                raise UsageError("deceleration goes with a size of acceleration, not with a range")
            self.rise = self.back_rise = _array(acceleration[1])
            self.fall = self.back_fall = -_array(acceleration[0])
        else:
            self.rise = self.back_fall = _array(acceleration)
            self.fall = self.back_rise = self.rise if deceleration is None else _array(deceleration)
        self.is_symmetric = self._low is None and self.rise is self.back_fall
        if self._low is None:
            refuse_first(self.high, "velocity is not > 0")
        else:
            widths = np.where((self._low <= 0.0) & (self.high >= 0.0), self.high - self._low, -1.0)
            refuse_first(widths, "velocity range must hold 0 and more than 0")
        for sizes in (self.rise, self.fall):
            refuse_first(sizes, "acceleration range must hold 0 inside, and deceleration be > 0")

    @classmethod
    def of(cls, limits: ProfileLimits) -> "LimitArrays":
        """The same limits for all motions."""
        made = cls(limits.velocity, limits.forward)
        made.back_rise, made.back_fall = _array(limits.backward[1]), -_array(limits.backward[0])
        return made

    @property
    def low(self) -> FloatArray:
        """The lowest velocity [U/s]."""
        return -self.high if self._low is None else self._low


def refuse_first(sizes: FloatArray, why: str, first: int = 0) -> None:
    """Raises UsageError with the index of the first size that is not > 0; counts from `first`."""
    if sizes.min() > 0.0:
        return
    where = f"motion {first + int(np.argmin(sizes > 0.0))}: " if sizes.ndim else ""
    raise UsageError(f"{where}{why}")


def refuse_where(bad: NDArray[np.bool_], why: str, first: int) -> None:
    """Raises UsageError with the first index that is marked, if any is; counts from `first`."""
    if bad.any():
        raise UsageError(f"motion {first + int(np.argmax(bad))}: {why}")


def _array(numbers: ArrayLike) -> FloatArray:
    return np.asarray(numbers, dtype=np.float64)
