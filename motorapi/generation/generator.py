"""From what a trajectory asks for, and what a motor can do, to the motion itself."""

from motorapi.commands import ControlVariable
from motorapi.errors import UnsupportedError
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
        UsageError: nothing limits how fast it is.
    """
    if trajectory.limits is not None and trajectory.limits.third is not None:
        _refuse(model, "a trapezoidal profile with a limit of the third derivative")
    if any((*trajectory.initial_derivatives[1:], *trajectory.final_derivatives[1:])):
        _refuse(model, "a trapezoidal profile that begins or ends with a second derivative")
    profile, violations = attempt(trajectory, model, variable, start)
    if profile is not None and not violations:
        return profile
    raise violations[0].as_error(model.name)


def _refuse(model: MotorModel, feature: str) -> None:
    raise UnsupportedError(
        motor=model.name,
        feature=feature,
        supported="that with a limited jerk: motorapi.generation.jerk_limited",
    )
