"""Trajectories as light, immutable values: what is asked for. Generating them is another matter.

Source: the paper, 3.3.1. A *simple* trajectory states boundary conditions and limits only.
"""

from dataclasses import dataclass, field
from math import isfinite
from typing import final

from motorapi.commands import DerivativeLimits, Range, as_number
from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, repr=False)
class TrapezoidalTrajectory:
    """The simplest motion that satisfies its boundary conditions; at rest at both ends.

    `TrapezoidalTrajectory(1.0)` is a distance: 1.0 further than where the motor is.
    `TrapezoidalTrajectory(1.0, initial=0.25)` is absolute: from 0.25 to 1.0, and the motor must be
    at 0.25 when it starts.

    Args:
        final: the final value [U]; without `initial`, counted from where the motor is.
        initial: the initial value [U].
        limits: of the value and its derivatives; the model's where they say nothing.
        duration_s: how long it takes [s]; None: as short as the limits allow.

    Raises:
        UsageError: a number is not finite, the duration not > 0, or a boundary value lies outside
            `limits.value`.
    """

    final: float
    initial: float | None = None
    limits: DerivativeLimits | None = field(default=None, kw_only=True)
    duration_s: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("final", "initial", "duration_s"):
            value = getattr(self, name)
            if value is None and name != "final":
                continue
            number = as_number(value)
            if not isfinite(number):
                raise UsageError(f"TrapezoidalTrajectory: {name} is {value!r}, not a finite number")
            object.__setattr__(self, name, number)
        if not isinstance(self.limits, DerivativeLimits | None):
            raise UsageError(
                f"TrapezoidalTrajectory: limits is {self.limits!r}, no DerivativeLimits"
            )
        if self.duration_s is not None and self.duration_s <= 0.0:
            raise UsageError(f"TrapezoidalTrajectory: duration_s is {self.duration_s:g}, not > 0")
        allowed = None if self.limits is None else self.limits.value
        if allowed is not None and self.initial is not None:
            for value in (self.initial, self.final):
                if not allowed[0] <= value <= allowed[1]:
                    raise UsageError(
                        f"TrapezoidalTrajectory: {value:g} lies outside its own limits of the"
                        f" value, {allowed[0]:g} to {allowed[1]:g}"
                    )

    @property
    def is_relative(self) -> bool:
        """Whether `final` is counted from where the motor is when it starts."""
        return self.initial is None

    def __repr__(self) -> str:
        unit = "rad|m"
        if self.initial is None:
            way = f"by {self.final!r} {unit}"
        else:
            way = f"from {self.initial!r} to {self.final!r} {unit}"
        time = "as fast as allowed" if self.duration_s is None else f"in {self.duration_s!r} s"
        parts = [way, time]
        if self.limits is not None:
            for name, limit, per in (
                ("value", self.limits.value, ""),
                ("velocity", self.limits.first, "/s"),
                ("acceleration", self.limits.second, "/s²"),
                ("jerk", self.limits.third, "/s³"),
            ):
                if limit is not None:
                    parts.append(f"{name} {_range(limit)} {unit}{per}")
        return f"<TrapezoidalTrajectory {', '.join(parts)}>"


def _range(limit: Range) -> str:
    if limit[0] == -limit[1]:
        return f"at most {limit[1]!r}"
    return f"{limit[0]!r} to {limit[1]!r}"
