"""Motion: one resolved command, as adaptations receive it.

Source: the CLARAty motor interface (Pivtoraiko, Nesnas, Nayar), Figure 4.
"""

from math import inf, isfinite
from typing import TYPE_CHECKING, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlMode, ControlVariable, Range
from motorhil.motorapi.trajectory import Argument, Trajectory

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function


@final
@frozen(repr=False)
class Motion:
    """One resolved command for an adaptation: absolute, signed, SI units, within the limits.

    The hooks receive it. For position, `start` is the reference position that the motor holds now
    and `target` the absolute position at the end; `velocity`, `acceleration` and `deceleration` are
    magnitudes > 0 that the motion must not exceed. For velocity, `target` is the velocity;
    acceleration applies while its magnitude grows and deceleration while it shrinks. A velocity
    trajectory goes from `start` to `target` at a constant rate, and both fields hold this rate. For
    torque and current, `slope` is the steepest change [N·m/s or A/s]. For set-points of position
    and velocity, `slope` is the tighter side of the requested range (inf: no request).

    A trajectory is prescribed at every instant: by the numbers above, or by `function` if there is
    one. `demand_of` returns either as one object to be sampled.
    """

    mode: ControlMode
    variable: ControlVariable
    start: float
    target: float
    velocity: float
    acceleration: float
    deceleration: float
    slope: float = inf
    duration_s: float | None = None
    """The duration of a trajectory [s]; None for set-points and for arguments other than time."""
    trajectory: Trajectory | None = None
    """The requested trajectory, or None for a set-point."""
    function: "Function | None" = None
    """The profile, if not in closed form: to be followed from `interval[0]` to `interval[1]`."""
    offset: float = 0.0
    """The offset added to the values of the function."""
    interval: Range = (0.0, 0.0)
    """(initial, final) argument of the function."""
    argument: Argument | None = None
    """The argument of the function; None: time, from `interval[0]` at the start [s]."""
    stop_deceleration: float | None = None
    """The deceleration of a stop during the motion [U/s²]; None: `deceleration`."""
    initial_velocity: float = 0.0
    """The velocity at the beginning of a position trajectory [U/s].

    Unless it is 0, the motor already moves, and `start` is only where it was when this was planned:
    `motorhil.motorapi.planning.functions.from_here` plans it again from where it begins.
    """
    final_velocity: float = 0.0
    """The velocity at the end of a position trajectory, at which its demand continues [U/s]."""
    rest_at: float | None = None
    """Where a demand that continues has come to rest: a limit of position [U]; None: nowhere."""

    def __repr__(self) -> str:
        text = f"<Motion {self.mode.value} of {self.variable.value}"
        if self.function is not None:
            over = "time" if self.argument is None else f"the {self.argument.name}"
            low, high = self.interval
            return f"{text}: {self.function!r} of {over} from {low:g} to {high:g}>"
        text += f": {self.start:g} to {self.target:g}"
        if self.duration_s is not None:
            text += f" in {self.duration_s:g} s"
        if self.variable is ControlVariable.POSITION:
            text += f", velocity up to {self.velocity:g}"
        if self.variable in (ControlVariable.POSITION, ControlVariable.VELOCITY):
            text += f", acceleration {self.acceleration:g}, deceleration {self.deceleration:g}"
        elif isfinite(self.slope):
            text += f", {self.slope:g} per s"
        return f"{text}>"

    @property
    def distance(self) -> float:
        """The signed change from start to target: for position [U], else in the variable's unit."""
        return self.target - self.start
