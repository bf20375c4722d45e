"""Limits of a profile in plain numbers, checked once and used for as many profiles as wanted."""

from dataclasses import dataclass
from math import inf
from typing import Final, Self, final

from motorapi.commands import Range
from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, init=False)
class ProfileLimits:
    """What a profile must not leave; immutable. U is the unit of the function value, whichever.

    Accelerations are signed ranges of the second derivative, one while the value grows and one
    while it falls: so a motor that slows down more gently than it speeds up has its limits here as
    well as a ramp that may rise faster than it falls.

    Attributes:
        velocity: (lowest, highest) first derivative [U/s]; 0 lies in it.
        forward: range of the second derivative while the first is > 0 [U/s²]; 0 lies inside.
        backward: likewise while the first is < 0.
        value: range of the function value [U].

    Args:
        velocity: a range, or x for (-x, x); inf: no limit.
        acceleration: a range of the second derivative, or a size while speeding up, > 0.
        deceleration: the size while slowing down; None: as `acceleration`.
        value: a range; None: no limit.

    Raises:
        UsageError: a range is empty, does not hold 0, or is given together with `deceleration`.
    """

    velocity: Range
    forward: Range
    backward: Range
    value: Range

    def __init__(
        self,
        velocity: Range | float,
        acceleration: Range | float,
        deceleration: float | None = None,
        *,
        value: Range | None = None,
    ) -> None:
        low, high = velocity if isinstance(velocity, tuple) else (-velocity, velocity)
        if not low <= 0.0 <= high or low == high:
            raise UsageError(f"velocity range ({low:g}, {high:g}) must hold 0 and more than 0")
        if isinstance(acceleration, tuple):
            if deceleration is not None:
                raise UsageError("deceleration goes with a size of acceleration, not with a range")
            forward = backward = acceleration
        elif deceleration is None:
            forward = backward = (-acceleration, acceleration)
        else:
            forward, backward = (-deceleration, acceleration), (-acceleration, deceleration)
        if not (forward[0] < 0.0 < forward[1] and backward[0] < 0.0 < backward[1]):
            raise UsageError(
                f"acceleration range ({forward[0]:g}, {forward[1]:g}) must hold 0 inside, and"
                " deceleration be > 0"
            )
        if value is None:
            value = _UNLIMITED
        elif not value[0] <= value[1]:
            raise UsageError(f"the range of the value, ({value[0]:g}, {value[1]:g}), is empty")
        store = object.__setattr__
        store(self, "velocity", (low, high))
        store(self, "forward", forward)
        store(self, "backward", backward)
        store(self, "value", value)

    @classmethod
    def by_direction(
        cls, velocity: Range, forward: Range, backward: Range, *, value: Range | None = None
    ) -> Self:
        """Limits with ranges of the second derivative while the value grows and while it falls.

        Raises:
            UsageError: a range is empty or does not hold 0.
        """
        made = cls(velocity, forward, value=value)
        object.__setattr__(made, "backward", cls(velocity, backward).backward)
        return made


_UNLIMITED: Final = (-inf, inf)
