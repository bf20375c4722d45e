"""Comparison of the units that a motor assumes with those of its emulated drive and plant.

A host that takes another gear or resolution than the drive has reads a wrong position, and each
side agrees with itself: nothing else in a run would notice. So both are compared before anything
moves. Metres are not compared, as the plant turns.

A bench that shows a motor's true position needs the opposite: the motor's units per radian of the
plant, with the direction that the model states.
"""

from math import copysign, pi
from typing import Final, final

from motorhil.emulators.cia401.node import IoNode
from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.emulators.controller import Controller
from motorhil.emulators.modbus.drive import ModbusDrive
from motorhil.emulators.motor_drive import MotorDrive
from motorhil.frozen import frozen
from motorhil.harness.rig.config.derived import core_of
from motorhil.harness.rig.config.rig_file import MotorDescription, RigDescription
from motorhil.motorapi.adaptations.cia402.units import DriveUnits, drive_units
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.model import MotionKind, MotorModel

_SAME: Final = 1e-3  # relative: models are written with a few digits
_TURN_RAD: Final = 2.0 * pi


@final
@frozen
class Comparison:
    """One quantity, as motor and drive interpret it.

    Attributes:
        quantity, unit: its name, and the unit of both figures.
        motor: the motor's figure, and `source` where it is from.
        drive: the figure of the emulated drive, and `plant` the constants behind it.
    """

    quantity: str
    unit: str
    motor: float
    source: str
    drive: float
    plant: str

    @property
    def agrees(self) -> bool:
        """True if both figures are the same, apart from rounding and direction."""
        return abs(abs(self.motor) - self.drive) <= _SAME * self.drive

    def __str__(self) -> str:
        return (
            f"{self.quantity}: {abs(self.motor):.6g} {self.unit} for the motor ({self.source}), "
            f"{self.drive:.6g} for drive and plant ({self.plant})"
        )


def compare_units(
    description: RigDescription,
    motor: MotorDescription,
    model: MotorModel,
    controller: Controller | None,
) -> tuple[Comparison, ...]:
    """Return the units of a motor beside those of its emulated drive; none if they are not known.

    Args:
        description: the rig.
        motor: one of its motors.
        model: its model.
        controller: its emulated controller, if the rig has one.

    Raises:
        RigError: they contradict each other.
    """
    core = None if controller is None else core_of(controller)
    if model.kind is MotionKind.LINEAR:
        return ()
    if isinstance(core, Cia402Drive) and motor.adaptation == "cia402":
        found = _of_cia402(motor.name, model, core)
    elif isinstance(core, ModbusDrive) and model.gear_ratio is not None:
        found = (_of_gear(model.gear_ratio, core),)
    else:
        return ()
    for one in found:
        if not one.agrees:
            raise description.error(
                ("motor", motor.name),
                f"the motor's units are not those of its drive: {one}; one unit of the motor is"
                f" {one.drive / abs(one.motor):.6g} of the drive's",
                "correct the motor model, or the drive's EDS, objects and plant",
            )
    return found


def require_units(
    description: RigDescription,
    motor: MotorDescription,
    model: MotorModel,
    controller: Controller | None,
) -> None:
    """Refuse a motor that cannot move, as neither its model nor its drive tells its units.

    Raises:
        RigError: a unit is not known.
    """
    core = None if controller is None else core_of(controller)
    if not isinstance(core, Cia402Drive) or motor.adaptation != "cia402":
        return
    try:
        _assumed(motor.name, model, core).require_all()
    except UsageError as error:
        remedy = "a motor model is a TOML file, or the table `model` of the motor"
        raise description.error(("motor", motor.name), str(error), remedy) from error


def units_per_plant_rad(
    motor: MotorDescription, model: MotorModel, controller: Controller
) -> float:
    """Return the motor's units per radian at the output of its plant [U/rad].

    A rotary motor turns as its plant does, whatever gear its model states, so that a wrong gear
    shows. Its direction, and the metres of a linear motor, are known from the model alone.

    Raises:
        UsageError: the model of a linear motor states no ratio.
    """
    core, scale = core_of(controller), model.increments_per_unit
    if isinstance(core, Cia402Drive):
        scale = _assumed(motor.name, model, core).increments_per_unit
        if scale is not None:
            scale *= core.units().position_numerator  # < 0: 607Eh inverts the drive's positions
    if scale is None:
        scale = model.gear_ratio
    if model.kind is MotionKind.ROTARY:
        return 1.0 if scale is None else copysign(1.0, scale)
    gear_ratio = _gear_ratio_of(motor, core)
    if model.gear_ratio is None or scale is None or gear_ratio is None:
        raise UsageError(
            f"{motor.name}: the true position is not known in m; expected the motor's turns per m"
            " in its model, and a plant with a gear; write motor_turns_per_m into the model"
        )
    return copysign(gear_ratio / _TURN_RAD / model.gear_ratio, scale)


def _gear_ratio_of(motor: MotorDescription, core: Controller) -> float | None:
    """Return the gear ratio of the plant of an emulated drive, or None if it has no plant."""
    drive = getattr(core, "drive", core)  # behind its gateway
    if isinstance(drive, Cia402Drive | ModbusDrive):
        return drive.settings.plant.gear_ratio
    if isinstance(core, MotorDrive):
        return core.axis.gear_ratio
    if isinstance(core, IoNode):
        channel = motor.settings.get("channel", 1)
        assert isinstance(channel, int)
        plant = core.settings.channels[channel - 1].plant
        return None if plant is None else plant.gear_ratio
    return None


def _assumed(name: str, model: MotorModel, core: Cia402Drive) -> DriveUnits:
    """Return the units that the host would read from the drive."""

    def read(index: int, subindex: int) -> int | None:
        variable = core.od.get(index, subindex)
        return None if variable is None else variable.integer()

    return drive_units(name, model, read)


def _of_cia402(name: str, model: MotorModel, core: Cia402Drive) -> tuple[Comparison, ...]:
    host = _assumed(name, model, core)
    plant, drive = core.settings.plant, core.units()
    output_rad = plant.encoder_increments_rev * plant.gear_ratio / _TURN_RAD  # increments of it
    constants = (
        f"encoder_increments_rev = {plant.encoder_increments_rev},"
        f" gear_ratio = {plant.gear_ratio:g}"
    )
    unit_inc = abs(drive.position_numerator) / drive.position_divisor
    if unit_inc != 1.0:
        constants += f", {unit_inc:g} increments per unit"
    found = []
    if host.increments_per_unit is not None:
        what = ("position", "increments/rad", host.increments_per_unit, host.sources[0])
        found.append(Comparison(*what, output_rad / unit_inc, constants))
    for quantity, unit, assumed, source, true_inc in (
        ("velocity", "rad/s", host.velocity_unit, host.sources[1], drive.velocity_unit_inc_s),
        (
            "acceleration",
            "rad/s²",
            host.acceleration_unit,
            host.sources[2],
            drive.acceleration_unit_inc_s2,
        ),
    ):
        if assumed is not None:
            true = true_inc / output_rad
            found.append(Comparison(f"{quantity} unit", unit, assumed, source, true, constants))
    return tuple(found)


def _of_gear(gear_ratio: float, core: ModbusDrive) -> Comparison:
    """Compare the gears: both sides know the drive's counts per turn of the motor."""
    there = core.settings.plant.gear_ratio
    what = ("gear", "motor turns/turn", gear_ratio, "the motor model")
    return Comparison(*what, there, f"gear_ratio = {there:g}")
