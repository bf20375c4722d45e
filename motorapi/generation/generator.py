"""From what a trajectory asks for, and what a motor can do, to the motion itself."""

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
    """The motion that a trajectory asks for, of a motor with this model; absolute.

    As fast as the model and the trajectory's own limits allow, or of the trajectory's duration.
    Jerk is not limited: for that see `motorapi.generation.jerk_limited`.

    Args:
        trajectory: simple; its second derivatives at the ends, if any, must be 0.
        model: for limits that the trajectory does not tighten.
        variable: what it is a trajectory of; the function value [U] is in its unit.
        start: where a relative trajectory begins [U].

    Raises:
        LimitError: there is no such motion within the limits; says which, when and by how much.
        UnsupportedError: it asks for a limit of the third derivative, or begins or ends with a
            second one.
        UsageError: nothing limits how fast it is, or an argument is of another type.
    """
    if not isinstance(trajectory, TrapezoidalTrajectory) or not isinstance(model, MotorModel):
        raise UsageError(
            f"generate({trajectory!r}, {model!r}): give a TrapezoidalTrajectory and a MotorModel;"
            " a ComplexTrajectory is generated already"
        )
    profile, violations = attempt(trajectory, model, variable, start)
    if profile is not None and not violations:
        return profile
    raise violations[0].as_error(model.name)
