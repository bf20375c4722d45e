"""Values of a rig that are permitted, but hardly meant: slips of a unit, above all.

The declaration of a setting has its plausible range (`motorhil.settings.Number`). Relations between
values are checked here: time constants and speeds of a plant, and a motor's limits beside it.
A doubt is a note with file and line; it never refuses a rig. One mistake is one note: relations of
a value that is in doubt itself are not looked at.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from math import inf, pi
from pathlib import Path
from typing import Any, Final, final

from motorhil.emulators.cia401.node import IoNode
from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.emulators.controller import Controller
from motorhil.emulators.modbus.drive import ModbusDrive
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.frozen import frozen
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, SETTINGS, installed
from motorhil.harness.rig.config.buses import BusTable
from motorhil.harness.rig.config.conformance import ConformanceTable
from motorhil.harness.rig.config.derived import core_of
from motorhil.harness.rig.config.faults import FaultTable
from motorhil.harness.rig.config.rig_file import MotorDescription, RigDescription
from motorhil.harness.rig.config.stimuli import StimulusTable
from motorhil.harness.rig.config.toml import RigError, Source, read_source
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.settings import Doubt, KeyPath, declaration, dotted, doubts, slip

# Data sheets of motors from 1 W to 10 kW lie well within these ranges.
_ELECTRICAL_S: Final = (1e-6, 0.05)
_ELECTRICAL_SMALL_S: Final = (1e-6, 0.005)
_SMALL_N_M: Final = 1.0  # stall torque of a motor that has a short electrical time constant
_NO_LOAD_RPM: Final = (10.0, 200_000.0)
_MECHANICAL_S: Final = (1e-4, 2.0)
# Limits of a model may exceed, by these factors, what the plant can do.
_SPEED: Final = 1.2
_ACCELERATION: Final = 3.0
_TORQUE: Final = 1.5


@final
@frozen
class RigDoubt:
    """A doubt about a value in a rig or model file.

    Attributes:
        file, line: its place.
        doubt: the value, and the usual range.
    """

    file: Path
    line: int
    doubt: Doubt

    @property
    def text(self) -> str:
        """The doubt without its place."""
        return f"{dotted(self.doubt.path)}: {self.doubt.message}; {self.doubt.remedy}"

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: warning: {self.text}"


@final
@frozen
class _Drive:
    """A plant, the path of its table, and the period of its servo [s] with the path of its key."""

    plant: MotorPlant
    path: KeyPath
    tick_s: float
    tick_path: KeyPath


def doubts_of(
    description: RigDescription,
    models: Mapping[str, MotorModel],
    controllers: Mapping[str, Controller],
) -> list[RigDoubt]:
    """Return the doubts about a rig, each once, in the order of the file.

    Args:
        description: the rig.
        models: the models of its motors, by name.
        controllers: its emulated controllers, by name.
    """
    direct = [_located(description.source, one) for one in _direct(description)]
    sources = {name: _model_source(description, name) for name in models}
    for name, (source, path) in sources.items():
        table = description.motors[name].model
        values = source.root().values if isinstance(table, Path) else table
        unit = models[name].unit
        direct += [_located(source, one) for one in doubts(MotorModel, values, path, unit=unit)]
    drives = {name: _drives(name, core_of(core)) for name, core in controllers.items()}
    doubted = {one.doubt.path for one in direct}
    derived: list[RigDoubt] = []
    sound: dict[str, list[_Drive | None]] = {}
    for name, of_one in drives.items():
        sound[name] = []
        for drive in of_one:
            is_known = any(path[: len(drive.path)] == drive.path for path in doubted)
            first = None if is_known else next(_of_drive(drive), None)
            derived += [] if first is None else [_located(description.source, first)]
            sound[name].append(None if is_known or first else drive)
    for name, model in models.items():
        motor = description.motors[name]
        behind = _behind(motor, sound)
        if behind is not None and model.kind is MotionKind.ROTARY:
            source, path = sources[name]
            derived += [
                _located(source, one)
                for one in _of_model(model, path, behind.plant)
                if one.path not in doubted
            ]
            derived += [_located(description.source, one) for one in _of_cycle(motor, behind)]
    return list(dict.fromkeys([*direct, *derived]))


def _located(source: Source, doubt: Doubt) -> RigDoubt:
    return RigDoubt(source.path, source.line(doubt.path), doubt)


def _direct(description: RigDescription) -> Iterator[Doubt]:
    """Yield the doubts about values whose declarations have a plausible range."""
    values = description.source.root().values
    for name in description.buses:
        yield from doubts(BusTable, _inner(values, "bus", name), ("bus", name))
    for name, controller in description.controllers.items():
        place = ("controller", name)
        yield from _of_plugin(CONTROLLERS, controller.kind, controller.settings, place)
    for name, motor in description.motors.items():
        yield from _of_plugin(ADAPTATIONS, motor.adaptation, motor.settings, ("motor", name))
    for key, of in (("fault", FaultTable), ("stimulus", StimulusTable)):
        given = values.get(key)
        for index, item in enumerate(given if isinstance(given, list) else ()):
            yield from doubts(of, item, (key, index))
    yield from doubts(ConformanceTable, _inner(values, "conformance"), ("conformance",))


def _of_plugin(
    group: str, name: str, settings: Mapping[str, object], path: KeyPath
) -> Iterator[Doubt]:
    """Yield the doubts about a plugin's table, if the plugin declares one."""
    declared = installed(SETTINGS[group])
    if name in declared:
        with suppress(Exception):  # a broken plugin is reported when it is built
            of: Any = declared[name].load()
            yield from doubts(of, settings, path, unit=_unit(settings))


def _unit(settings: Mapping[str, object]) -> str:
    """Return the unit of positions in these settings, by the ends of their keys."""
    return "m" if any(key.endswith(("_m", "_m_s2")) for key in settings) else "rad"


def _inner(values: Mapping[str, object], *keys: str) -> Mapping[str, object]:
    inner: object = values
    for key in keys:
        inner = inner.get(key, {}) if isinstance(inner, Mapping) else {}
    return inner if isinstance(inner, Mapping) else {}


def _model_source(description: RigDescription, motor: str) -> tuple[Source, KeyPath]:
    """Return the file of a motor's model, and the path of the model in it."""
    model = description.motors[motor].model
    if not isinstance(model, Path):
        return description.source, ("motor", motor, "model")
    source = read_source(model, "")
    with suppress(RigError):
        source.root()
    return source, ()


def _drives(name: str, core: Controller) -> list[_Drive]:
    """Return the plants of a controller, by channel."""
    path: KeyPath = ("controller", name)
    if isinstance(core, Cia402Drive | ModbusDrive):
        tick_s = core.settings.tick_ns / 1e9
        return [_Drive(core.settings.plant, (*path, "plant"), tick_s, (*path, "servo", "tick_s"))]
    if isinstance(core, IoNode):
        return [
            _Drive(
                one.plant,
                (*path, "channel", str(number), "plant"),
                one.tick_ns / 1e9,
                (*path, "amplifier", "tick_s"),
            )
            for number, one in enumerate(core.settings.channels, 1)
        ]
    return []


def _behind(motor: MotorDescription, drives: Mapping[str, list[_Drive | None]]) -> _Drive | None:
    """Return what a motor drives, or None if that is not known, or in doubt itself."""
    of_one = [] if motor.controller is None else drives.get(motor.controller, [])
    channel = motor.settings.get("channel", 1)
    known = isinstance(channel, int) and 1 <= channel <= len(of_one)
    return of_one[channel - 1] if known else None  # type: ignore[operator]  # it is an int


def _peak_n_m(plant: MotorPlant) -> float:
    """Return the greatest torque of the motor, by its supply and its current limit [N·m]."""
    return min(plant.stall_torque_n_m(), plant.torque_constant_n_m_a * plant.current_max_a)


def _of_drive(drive: _Drive) -> Iterator[Doubt]:
    """Yield the doubts about combinations of a plant's values, and about its servo."""
    plant, path = drive.plant, drive.path
    k, r = plant.torque_constant_n_m_a, plant.resistance_ohm
    if plant.coulomb_friction_n_m >= _peak_n_m(plant):
        yield Doubt(
            (*path, "coulomb_friction_n_m"),
            f"{plant.coulomb_friction_n_m:g} N·m is not below the motor's greatest torque,"
            f" {_peak_n_m(plant):.4g} N·m: it cannot turn",
            "data sheets give mN·m",
        )
    electrical_s = plant.electrical_time_constant_s()
    small = plant.stall_torque_n_m() < _SMALL_N_M
    low, high = _ELECTRICAL_SMALL_S if small else _ELECTRICAL_S
    if not low <= electrical_s <= high:
        yield Doubt(
            (*path, "inductance_h"),
            f"{plant.inductance_h:g} H and {r:g} ohm are an electrical time constant of"
            f" {electrical_s * 1e3:.4g} ms, which is implausible for a motor with a stall torque of"
            f" {plant.stall_torque_n_m():.3g} N·m",
            f"usual: {low * 1e3:g} to {high * 1e3:g} ms; data sheets give mH",
        )
    rpm = plant.no_load_speed_rad_s() * 30.0 / pi
    low, high = _NO_LOAD_RPM
    if not low <= rpm <= high:
        yield Doubt(
            (*path, "torque_constant_n_m_a"),
            f"{k:g} N·m/A and {plant.supply_v:g} V are a no-load speed of {rpm:.4g} rpm, which is"
            " implausible",
            f"usual: {low:g} to {high:g} rpm; data sheets give mN·m/A",
        )
    rotor_s = plant.rotor_inertia_kg_m2 * r / (k * k)
    low, high = _MECHANICAL_S
    if not low <= rotor_s <= high:
        yield Doubt(
            (*path, "rotor_inertia_kg_m2"),
            f"{plant.rotor_inertia_kg_m2:g} kg·m² is a mechanical time constant of"
            f" {rotor_s * 1e3:.4g} ms, which is implausible",
            f"usual: {low * 1e3:g} to {high * 1e3:g} ms; data sheets give g·cm², which is"
            " 1e-7 kg·m²",
        )
    whole_s = plant.mechanical_time_constant_s()
    if drive.tick_s > whole_s:
        likely = slip(drive.tick_s, "s", 0.0, whole_s)
        yield Doubt(
            drive.tick_path,
            f"{drive.tick_s:g} s is longer than the mechanical time constant of motor and load,"
            f" {whole_s * 1e3:.4g} ms: the servo cannot control it",
            likely or "a shorter period, or the plant's true inertia",
        )


def _of_cycle(motor: MotorDescription, drive: _Drive) -> Iterator[Doubt]:
    """Yield the doubt about the period of a servo on the host."""
    cycle_ms, whole_s = motor.settings.get("cycle_ms"), drive.plant.mechanical_time_constant_s()
    if isinstance(cycle_ms, int | float) and cycle_ms / 1e3 > whole_s:
        yield Doubt(
            ("motor", motor.name, "cycle_ms"),
            f"{cycle_ms:g} ms is longer than the mechanical time constant of motor and load,"
            f" {whole_s * 1e3:.4g} ms: the servo cannot control it",
            slip(cycle_ms, "ms", 0.0, whole_s * 1e3) or "a shorter period",
        )


def _of_model(model: MotorModel, path: KeyPath, plant: MotorPlant) -> Iterator[Doubt]:
    """Yield the doubts about limits of a model that its plant is far from reaching."""
    gear = plant.gear_ratio
    torque_n_m = _peak_n_m(plant) * gear
    inertia_kg_m2 = plant.inertia_kg_m2() * gear * gear
    turns = f"with gear_ratio = {gear:g}"
    for name, value, unit, able, factor, what in (
        (
            "velocity_max",
            model.velocity_max,
            "rad/s",
            plant.no_load_speed_rad_s() / gear,
            _SPEED,
            f"no-load speed of the plant {turns}",
        ),
        (
            "acceleration_max",
            model.acceleration_max,
            "rad/s²",
            torque_n_m / inertia_kg_m2,
            _ACCELERATION,
            f"greatest acceleration of the plant {turns}",
        ),
        (
            "torque_max",
            model.torque_max or 0.0,
            "N·m",
            torque_n_m,
            _TORQUE,
            f"greatest torque of the plant {turns}",
        ),
    ):
        if factor * able < value < inf:
            key = declaration(MotorModel).keys[name].name_for(name, "rad")
            likely = slip(value, unit, 0.0, factor * able)
            yield Doubt(
                (*path, key),
                f"{value:g} {unit} is above the {what}, {able:.4g} {unit}",
                likely or "correct the limit, or the plant",
            )
