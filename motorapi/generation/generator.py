"""Generation of the profile of a simple trajectory."""

from motorapi.commands import ControlVariable
from motorapi.errors import UsageError
from motorapi.generation.feasibility import attempt
from motorapi.generation.profile import Profile
from motorapi.model import MotorModel
from motorapi.trajectory import TrapezoidalTrajectory


def generate(
    trajectory: TrapezoidalTrajectory,
    model: MotorModel,
    *,
    variable: ControlVariable = ControlVariable.POSITION,
    start: float = 0.0,
) -> Profile:
    """Return the absolute profile of a trajectory for a motor with this model.

    The profile is as fast as model and trajectory allow, or has the duration of the trajectory.
    Jerk is not limited: for that see `motorapi.generation.jerk_limited`.

    Args:
        trajectory: simple; its second derivatives at the ends, if any, must be 0.
        model: provides the limits that the trajectory does not tighten.
        variable: its control variable, which determines the unit U.
        start: initial value of a relative trajectory [U].

    Raises:
        LimitError: no such motion exists within the limits; names limit, time and amount.
        UnsupportedError: it limits the third derivative, or begins or ends with a second
            derivative.
        UsageError: no limit bounds its speed, or an argument has another type.
    """
    if not isinstance(trajectory, TrapezoidalTrajectory) or not isinstance(model, MotorModel):
        raise UsageError(
            f"generate({trajectory!r}, {model!r}): give a TrapezoidalTrajectory and a "
            "MotorModel; a ComplexTrajectory needs no generation"
        )
    profile, violations = attempt(trajectory, model, variable, start)
    if profile is not None and not violations:
        return profile
    raise violations[0].as_error(model.name)
