"""Profile limits as plain numbers, checked once for many profiles."""

from dataclasses import dataclass
from math import inf
from typing import Final, Self, final

from motorhil.motorapi.commands import Range
from motorhil.motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, init=False)
class ProfileLimits:
    """Limits of a profile; immutable. U is the unit of the function value.

    Accelerations are signed ranges of the second derivative, one while the value grows and one
    while it falls. They describe a motor that decelerates more gently than it accelerates, as well
    as a ramp that may rise faster than it falls.

    Attributes:
        velocity: (lowest, highest) first derivative [U/s]; contains 0.
        forward: range of the second derivative while the first is > 0 [U/s²]; 0 in its interior.
        backward: range of the second derivative while the first is < 0 [U/s²].
        value: range of the function value [U].

    Args:
        velocity: a range, or x for (-x, x); inf: no limit.
        acceleration: a range of the second derivative, or a magnitude while speeding up, > 0.
        deceleration: the magnitude while slowing down; None: as `acceleration`.
        value: a range; None: no limit.

    Raises:
        UsageError: a range is empty, does not contain 0, or is given with `deceleration`.
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
            raise UsageError(f"velocity range ({low:g}, {high:g}) must contain 0 and other values")
        if isinstance(acceleration, tuple):
            if deceleration is not None:
                raise UsageError(
                    "deceleration requires acceleration as a magnitude, not as a range"
                )
            forward = backward = acceleration
        elif deceleration is None:
            forward = backward = (-acceleration, acceleration)
        else:
            forward, backward = (-deceleration, acceleration), (-acceleration, deceleration)
        if not (forward[0] < 0.0 < forward[1] and backward[0] < 0.0 < backward[1]):
            raise UsageError(
                f"acceleration range ({forward[0]:g}, {forward[1]:g}) must contain 0 in its "
                "interior, and deceleration must be > 0"
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
        """Return limits with separate ranges of the second derivative by direction.

        Raises:
            UsageError: a range is empty or does not contain 0.
        """
        made = cls(velocity, forward, value=value)
        object.__setattr__(made, "backward", cls(velocity, backward).backward)
        return made


_UNLIMITED: Final = (-inf, inf)
