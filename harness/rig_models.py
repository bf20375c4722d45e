"""Motor models of a rig, from their own files or its."""

from pathlib import Path

from harness.rig_file import MotorDescription, RigDescription
from harness.settings import RigError
from motorapi.errors import FileError
from motorapi.model import MotorModel


def read_models(description: RigDescription) -> dict[str, MotorModel]:
    """Read the models of all motors, each file once. Raises as `_model` does."""
    files: dict[Path, MotorModel] = {}
    models: dict[str, MotorModel] = {}
    for name, motor in description.motors.items():
        model = files.get(motor.model) if isinstance(motor.model, Path) else None
        models[name] = _model(description, name) if model is None else model
        if isinstance(motor.model, Path):
            files[motor.model] = models[name]
    return models


def _model(description: RigDescription, motor: str) -> MotorModel:
    """Read the motor's model from its own file or from the rig.

    Raises:
        RigError: the model has an error; names its file and line.
    """
    described: MotorDescription = description.motors[motor]
    path = ("motor", motor, "model")
    try:
        if isinstance(described.model, Path):
            return MotorModel.load(described.model)
        return MotorModel.from_table(
            described.model,
            path=str(description.source.path),
            line_of=lambda key: description.source.line((*path, key)),
            default_name=motor,
        )
    except FileError as error:
        key = error.key or ""
        if not isinstance(described.model, Path):
            at = (*path, key) if key else path
            raise description.error(at, error.problem, error.remedy) from None
        raise RigError(error.path, error.problem, error.remedy, line=error.line, key=key) from None
