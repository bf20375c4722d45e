"""Plant parameters taken from the motor model on request of a rig.

This is convenient but risky: a wrong gear ratio on both sides hides itself. So a rig has to request
it (`plant.from_motor_model = true`), and notes report the values taken. Values that the rig gives
itself take precedence. A controller of several motors requests it for each channel, or for all of
them if their models agree.

Assumed drive timing, taken from the emulated drive on request.

This is convenient but risky, like `plant.from_motor_model`: the host's assumption is right by
construction, so that a wrong assumption about the real drive stays hidden. So a rig has to request
it (`timing_from_controller = true`), and a note reports the values taken. Values that the motor
gives itself take precedence.
"""

from collections.abc import Mapping
from typing import Final, final

from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.emulators.cia402.quirks import QuirkyWire
from motorhil.emulators.cia402.settings import DriveSettings
from motorhil.emulators.controller import Controller
from motorhil.emulators.firmware.clock import LateWakes, OwnTime
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.presets import PRESETS
from motorhil.emulators.settings.tables import plant_of
from motorhil.frozen import frozen
from motorhil.harness.rig.config.rig_file import (
    ControllerDescription,
    MotorDescription,
    RigDescription,
)
from motorhil.harness.rig.config.toml import replaced
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.settings import KeyPath, SettingError, dotted, flag, read

_TURN_RAD: Final = 6.283185307179586
_WHOLE_TOLERANCE: Final = 1e-3  # increments per turn: models are written with a few digits


def plant_in(controller: ControllerDescription) -> MotorPlant | None:
    """Return the numbers of a controller's plant, or None if they are not in the rig alone."""
    table = controller.settings.get("plant")
    if controller.plants_from_model or not isinstance(table, Mapping):
        return None
    try:
        return plant_of(table)
    except SettingError:
        return None


def settings_with_model(
    description: RigDescription,
    controller: ControllerDescription,
    models: Mapping[str, MotorModel],
) -> tuple[dict[str, object], list[str]]:
    """Return the controller's settings completed from its motors' models, and notes about it.

    Args:
        description: the rig.
        controller: one of its controllers.
        models: the models of its motors, by name.

    Raises:
        RigError: no motor uses the controller, or a model's values are not usable.
    """
    settings, notes = dict(controller.settings), []
    for place in controller.plants_from_model:
        numbers, asked = _numbers_for(description, controller, models, settings, place)
        path = ("controller", controller.name, *place)
        taken = ", ".join(f"{key} = {value:g}" for key, value in numbers.items())
        line = description.source.line((*path, "from_motor_model"))
        notes.append(
            f"{description.source.path}:{line}: {dotted(path)}: {taken} taken from motor model "
            f'"{asked}": a mistake in it is on both sides'
        )
        settings = replaced(settings, place, {**_table(settings, place), **numbers})
    return settings, notes


def _numbers_for(
    description: RigDescription,
    controller: ControllerDescription,
    models: Mapping[str, MotorModel],
    settings: Mapping[str, object],
    place: KeyPath,
) -> tuple[dict[str, int | float], str]:
    """Return the parameters for the plant at `place`, and the name of their model."""
    path = ("controller", controller.name, *place, "from_motor_model")
    motors = _motors_behind(description, controller.name, place)
    if not motors:
        raise description.error(
            path, "no motor of this rig uses this controller", "remove the line, or add a motor"
        )
    plant = _table(settings, place)
    if len(place) > 1 and "preset" not in plant:
        plant = {**_table(settings, ("plant",)), **plant}  # overrides the common one
    try:
        found = [plant_numbers(models[motor.name], plant) for motor in motors]
    except ValueError as error:
        raise description.error(path, str(error), "correct one of them") from None
    first = models[motors[0].name].name
    for motor, numbers in zip(motors, found, strict=True):
        if numbers != found[0]:
            raise description.error(
                path,
                f'the models of motors "{motors[0].name}" and "{motor.name}" differ',
                f"write it in [controller.{controller.name}.channel.1.plant] and so on",
            )
    if not found[0]:
        raise description.error(
            path, f'motor model "{first}" adds nothing to what the rig gives', "remove the line"
        )
    return found[0], first


def _motors_behind(
    description: RigDescription, controller: str, place: KeyPath
) -> list[MotorDescription]:
    """Return the motors whose plant is at `place`: of one channel, or all of the controller."""
    motors = [motor for motor in description.motors.values() if motor.controller == controller]
    if len(place) == 1:
        return motors
    return [motor for motor in motors if str(motor.settings.get("channel", 1)) == place[1]]


def _table(settings: Mapping[str, object], place: KeyPath) -> Mapping[str, object]:
    inner: object = settings
    for key in place:
        inner = inner.get(str(key), {}) if isinstance(inner, Mapping) else {}
    return inner if isinstance(inner, Mapping) else {}


def plant_numbers(model: MotorModel, plant: Mapping[str, object]) -> dict[str, int | float]:
    """Return the plant parameters that the model has and `plant` (the rig's table) lacks.

    Args:
        model: model of the motor with this plant.
        plant: the rig's table; its gear ratio (or its preset's) is needed for the resolution if the
            model has no gear ratio.

    Raises:
        ValueError: the model's resolution is not a whole number of increments per motor turn.
    """
    numbers: dict[str, int | float] = {}
    if model.current_max is not None and "current_max_a" not in plant:
        numbers["current_max_a"] = model.current_max
    rotary = model.kind is MotionKind.ROTARY
    if rotary and model.gear_ratio is not None and "gear_ratio" not in plant:
        numbers["gear_ratio"] = abs(model.gear_ratio)  # the drive defines the direction
    increments, source = model.encoder_increments_rev, f"{model.encoder_increments_rev}"
    if increments is None and rotary and model.increments_per_unit is not None:
        gear_ratio = _gear_ratio({**plant, **numbers})
        increments = abs(model.increments_per_unit) * _TURN_RAD / gear_ratio
        source = f"{model.increments_per_unit} per rad with gear_ratio = {gear_ratio:g}"
    if increments is not None and "encoder_increments_rev" not in plant:
        if abs(increments - round(increments)) > _WHOLE_TOLERANCE or increments < 0.5:
            raise ValueError(
                f"the motor model's increments, {source}, are {increments:.6g} per motor turn: "
                "not a whole number"
            )
        numbers["encoder_increments_rev"] = round(increments)
    return numbers


def _gear_ratio(plant: Mapping[str, object]) -> float:
    preset = PRESETS.get(str(plant.get("preset")))
    value = plant.get("gear_ratio", 1.0 if preset is None else preset.gear_ratio)
    return float(value) if isinstance(value, int | float) and value > 0 else 1.0


@final
@frozen(kw_only=True, slots=False)
class TimingTable:
    """Keys of a motor that the harness reads itself."""

    timing_from_controller: bool = flag(
        False,
        "Take missing timing from the emulated drive. A mistake there is then on both sides.",
    )


ASKED: Final = "timing_from_controller"
_KIND: Final = "cia402"


def with_timing(
    description: RigDescription, motor: MotorDescription, controller: Controller | None
) -> tuple[dict[str, object], str]:
    """Return the motor's settings completed from its emulated drive, and a note about it.

    Args:
        description: the rig.
        motor: one of its motors.
        controller: its emulated controller, if the rig has one.

    Raises:
        RigError: there is no suitable drive, or the key is not true or false.
    """
    settings = {key: value for key, value in motor.settings.items() if key != ASKED}
    path = ("motor", motor.name, ASKED)
    with description.source.with_lines():
        given = {ASKED: motor.settings[ASKED]} if ASKED in motor.settings else {}
        asked = read(TimingTable, given, path[:-1])
    if not asked.timing_from_controller:
        return settings, ""
    core = None if controller is None else core_of(controller)
    if motor.adaptation != _KIND or motor.controller is None or not isinstance(core, Cia402Drive):
        raise description.error(
            path, "its controller is not an emulated CiA 402 drive of this rig", "take it out"
        )
    table = description.controllers[motor.controller].settings.get("oscillator")
    numbers = _numbers(core.settings, table if isinstance(table, Mapping) else {})
    taken = {key: value for key, value in numbers.items() if key not in settings}
    told = ", ".join(f"{key} = {value:g}" for key, value in taken.items())
    line = description.source.line(path)
    note = (
        f"{description.source.path}:{line}: motor.{motor.name}: {told or 'nothing'} taken from"
        f' controller "{motor.controller}": a mistake in it is on both sides'
    )
    return {**settings, **taken}, note


def core_of(controller: Controller) -> Controller:
    """Return the controller without what deviates its clock or its wire."""
    while isinstance(controller, OwnTime | LateWakes | QuirkyWire):
        controller = controller.inner
    return controller


def _numbers(drive: DriveSettings, oscillator: Mapping[str, object]) -> dict[str, float]:
    """Return the host's assumptions; for a random clock error, its limit."""
    ppm = abs(drive.oscillator.error_1e12) / 1e6
    ppm_max = oscillator.get("ppm_max")
    if isinstance(ppm_max, int | float):
        ppm = float(ppm_max)
    return {
        "servo_period_ms": drive.tick_ns / 1e6,
        "oscillator_ppm": ppm,
        "sdo_reply_ms": drive.sdo_reply_ns / 1e6 / (1.0 - ppm * 1e-6),
    }
