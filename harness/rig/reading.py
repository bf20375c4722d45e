"""Rigs and motor models, read from their files."""

from pathlib import Path

from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, installed, named
from motorhil.harness.rig.config.rig_file import (
    Known,
    MotorDescription,
    RigDescription,
    read_rig,
)
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.fragment import read_fragment
from motorhil.motorapi.errors import FileError
from motorhil.motorapi.model import MotorModel


def describe(path: Path, world: Path | None = None) -> RigDescription:
    """Read a rig file, or the rig in a recording.

    Args:
        path: a rig file, or a recording.
        world: a fragment for the rig file, or a recording that has one.

    Raises:
        RigError: the rig cannot be used.
    """
    from motorhil.traces.mcap.records import is_recording

    known = installed_plugins()
    if is_recording(path):
        if world is not None:
            raise RigError(path, "is a recording; no world disturbs it", "name a rig file")
        from motorhil.harness.replay.rig import rig_in

        return rig_in(path, known)
    if path.suffix == ".mcap" and path.exists():
        raise RigError(path, "is not a recording (MCAP)", "give a recording, or a rig file (TOML)")
    return read_rig(path, known, None if world is None else read_fragment(world))


def installed_plugins() -> Known:
    """Return the plugins of this Python environment that a rig may name."""

    def needs_bus(adaptation: str) -> bool | None:
        try:
            build = named(ADAPTATIONS, adaptation).load()
        except (Exception, SystemExit):
            return None
        return getattr(build, "needs_bus", True) is not False

    return Known(tuple(installed(CONTROLLERS)), tuple(installed(ADAPTATIONS)), needs_bus)


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
