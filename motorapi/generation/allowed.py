"""Combined limits of a motor model and of a command."""

from dataclasses import dataclass
from math import inf
from typing import Final, final

from motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorapi.errors import UsageError
from motorapi.generation.limits import ProfileLimits
from motorapi.limits import slack, value_range
from motorapi.model import MotorModel

_ALL: Final[Range] = (-inf, inf)
_PER: Final = ("", "/s", "/s²", "/s³", "/s⁴")
_NAMES: Final = {
    ControlVariable.POSITION: ("position", "velocity", "acceleration", "jerk"),
    ControlVariable.VELOCITY: ("velocity", "acceleration", "jerk", "derivative of jerk"),
    ControlVariable.TORQUE: ("torque", "slope of torque", "bend of torque", "third derivative"),
    ControlVariable.CURRENT: ("current", "slope of current", "bend of current", "third derivative"),
}
_PLAIN: Final = ("value", "first derivative", "second derivative", "third derivative")


@final
@dataclass(frozen=True, slots=True)
class Allowed:
    """Ranges of a value and its derivatives, with their names.

    Attributes:
        whose: the name of the model, or "limits".
        names: names of the value and its derivatives.
        units: their units; "" without a model.
        value, first, third: their ranges.
        forward: range of the second derivative while the first is > 0.
        backward: range of the second derivative while the first is < 0.
    """

    whose: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Range
    first: Range
    forward: Range
    backward: Range
    third: Range

    @classmethod
    def by(
        cls,
        against: MotorModel | DerivativeLimits,
        variable: ControlVariable,
        own: DerivativeLimits | None,
        *,
        sizes: Range | None = None,
    ) -> "Allowed":
        """Return the limits of `against`, tightened by `own` if given.

        Args:
            against: a model, or limits alone.
            variable: the control variable; irrelevant for limits alone.
            own: tighter limits.
            sizes: for a motion of velocity: its initial and final value, because acceleration and
                deceleration have different limits in the model; None: the tighter one.

        Raises:
            UsageError: `against` or `variable` has the wrong type.
        """
        if not isinstance(variable, ControlVariable):
            raise UsageError(f"variable is {variable!r}; give a ControlVariable")
        if isinstance(against, MotorModel):
            made = cls._by_model(against, variable, sizes)
        elif not isinstance(against, DerivativeLimits):
            raise UsageError(f"{against!r} has no limits; give a MotorModel or DerivativeLimits")
        else:
            made = cls("limits", _PLAIN, ("",) * 4, _ALL, _ALL, _ALL, _ALL, _ALL)
            made = made.tightened(against)
        return made if own is None else made.tightened(own)

    @classmethod
    def _by_model(
        cls, model: MotorModel, variable: ControlVariable, sizes: Range | None
    ) -> "Allowed":
        low, high = value_range(model, variable)
        value = (-inf if low is None else low, inf if high is None else high)
        first = forward = backward = third = _ALL
        order = 0
        jerk = _ALL if model.jerk_max is None else (-model.jerk_max, model.jerk_max)
        up, down = model.acceleration_max, model.deceleration
        if variable is ControlVariable.POSITION:
            first = (-model.velocity_max, model.velocity_max)
            forward, backward, third = (-down, up), (-up, down), jerk
        elif variable is ControlVariable.VELOCITY:
            order = 1
            if sizes is None or sizes[0] * sizes[1] < 0.0:
                up = min(up, down)
            elif abs(sizes[1]) <= abs(sizes[0]):
                up = down
            first, forward, backward = (-up, up), jerk, jerk
        base = model.unit if order else model.unit_of(variable)
        units = tuple(base + _PER[order + k] for k in range(4))
        whose = f"model {model.name}"
        return cls(whose, _NAMES[variable], units, value, first, forward, backward, third)

    def tightened(self, own: DerivativeLimits) -> "Allowed":
        """Return these limits, tightened by `own`."""
        return Allowed(
            self.whose,
            self.names,
            self.units,
            _common(self.value, own.value),
            _common(self.first, own.first),
            _common(self.forward, own.second),
            _common(self.backward, own.second),
            _common(self.third, own.third),
        )

    def profile_limits(self, *velocities: float) -> ProfileLimits:
        """Return generator limits, widened to boundary velocities that exceed them by rounding."""
        low, high = self.first
        for velocity in velocities:
            if low - slack(low) <= velocity <= high + slack(high):
                low, high = min(low, velocity), max(high, velocity)
        return ProfileLimits.by_direction(
            (low, high), self.forward, self.backward, value=self.value
        )


def _common(one: Range, other: Range | None) -> Range:
    return one if other is None else (max(one[0], other[0]), min(one[1], other[1]))
