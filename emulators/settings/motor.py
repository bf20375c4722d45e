"""Motor settings of a rig, and the axis built from them.

Third-party controllers may use this module like our own. They bring the protocol, and support every
motor that a rig can describe, with the same keys:

    class MyTable(MotorTable): ...                      # its own keys (motorhil.settings)
    motor = read(MyTable, table).motor(context.stream())
    axis = axis_of(motor, motor.oscillator.rate())      # motorhil.emulators.firmware.axis
    return on_own_time(controller, motor.oscillator)    # motorhil.emulators.firmware.clock
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, Final, Protocol, final

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.nonlinear_tables import substeps_for
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.settings.tables import (
    PLANT,
    POSITION_RAD,
    OscillatorTable,
    check_position,
    ns,
    plant_of,
)
from motorhil.frozen import frozen
from motorhil.settings import KeyPath, SettingError, number, table, whole

SERVO_S: Final = (1e-5, 0.02)
"""The plausible periods of a servo."""
_GAIN_MAX: Final = 1e12


def _gain(unit: str, doc: str) -> Any:
    return number(None, 0, _GAIN_MAX, unit, doc)


@final
@frozen(kw_only=True, slots=False)
class ServoTable:
    """The servo: its periods, and gains in place of those tuned for the plant."""

    tick_s: float = number(0.001, 1e-6, 1.0, "s", "Servo period.", plausible=SERVO_S)
    current_steps: int = whole(10, 1, 1000, "", "Current loop steps in each servo period.")
    position_kp_1_s: float | None = _gain("1/s", "Velocity per following error.")
    velocity_kp_a_s_inc: float | None = _gain("A·s/inc", "Current per velocity error.")
    velocity_ki_a_inc: float | None = _gain("A/inc", "Growth of that current.")
    current_kp_v_a: float | None = _gain("V/A", "Voltage per current error.")
    current_ki_v_a_s: float | None = _gain("V/(A·s)", "Growth of that voltage.")
    velocity_feedforward: float | None = _gain("", "Share of the demand's velocity passed on.")
    acceleration_feedforward_a_s2_inc: float | None = _gain(
        "A·s²/inc", "Current per acceleration of the demand."
    )

    def tick_ns(self) -> int:
        """Return the servo period [ns], a whole number of current loop steps.

        Raises:
            SettingError: it is not.
        """
        tick_ns, steps = ns(self.tick_s), self.current_steps
        if tick_ns % steps:
            message = f"{steps} steps do not divide a servo period of {tick_ns} ns"
            raise SettingError(("servo", "current_steps"), message, "usual: 10")
        if tick_ns < steps * 1000:
            message = f"{steps} steps in a servo period of {tick_ns} ns are shorter than a"
            raise SettingError(
                ("servo", "current_steps"),
                f"{message} microsecond each",
                "a longer tick_s, or fewer steps",
            )
        return tick_ns

    def gains(self, plant: MotorPlant) -> ServoGains:
        """Return the gains; those that are not given are tuned for the plant.

        Raises:
            SettingError: the plant is too fast for the steps of the servo.
        """
        tick_ns = self.tick_ns()
        check_steps(plant, tick_ns, self.current_steps, ("plant",))
        own = {one.name: getattr(self, one.name) for one in fields(ServoGains)}
        tuned = ServoGains.tuned(plant, tick_ns, self.current_steps)
        return replace(tuned, **{name: gain for name, gain in own.items() if gain is not None})


def check_steps(plant: MotorPlant, tick_ns: int, current_steps: int, path: KeyPath) -> None:
    """Check that the steps of the current loop are short enough for the plant at `path`.

    Raises:
        SettingError: they are not; names the key of the plant.
    """
    try:
        substeps_for(plant, tick_ns / (1e9 * current_steps))
    except ValueError as error:
        name, _, text = str(error).partition(" = ")
        raise SettingError((*path, name), text) from error


@final
@frozen(kw_only=True)
class MotorSettings:
    """One motor of a rig, with the servo that drives it.

    Attributes:
        plant: the motor, its gear and load, its encoder.
        gains, tick_ns, current_steps: of the servo; its period, and current loop steps in each.
        oscillator: the controller's own clock.
        initial_position_rad: at the output, at power-on.
    """

    plant: MotorPlant
    gains: ServoGains
    tick_ns: int
    current_steps: int
    oscillator: Oscillator
    initial_position_rad: float


@frozen(kw_only=True, slots=False)
class MotorTable:
    """Keys of every controller with one motor; a controller's own table derives from it."""

    plant: Mapping[str, Any] = table(PLANT, "The motor behind the drive.")
    servo: ServoTable = table(ServoTable, "The servo of the drive.")
    oscillator: OscillatorTable = table(OscillatorTable, "The clock of the controller.")
    initial_position_rad: float = number(
        0.0, -1e9, 1e9, "rad", "Position of the output at power-on.", plausible=POSITION_RAD
    )

    def motor(self, stream: str) -> MotorSettings:
        """Return the motor; random clock values come from `stream`.

        Raises:
            SettingError: values do not go together.
        """
        plant = plant_of(self.plant)
        gains = self.servo.gains(plant)
        check_position(self.initial_position_rad, plant)
        return MotorSettings(
            plant=plant,
            gains=gains,
            tick_ns=self.servo.tick_ns(),
            current_steps=self.servo.current_steps,
            oscillator=self.oscillator.oscillator(stream),
            initial_position_rad=self.initial_position_rad,
        )


class Motorised(Protocol):
    """Settings that hold a motor; see `MotorSettings`."""

    @property
    def plant(self) -> MotorPlant:
        """The motor, its gear and load, its encoder."""

    @property
    def gains(self) -> ServoGains:
        """The gains of the servo."""

    @property
    def tick_ns(self) -> int:
        """The period of the servo [ns]."""

    @property
    def current_steps(self) -> int:
        """The number of current loop steps in each period."""

    @property
    def initial_position_rad(self) -> float:
        """The position at the output, at power-on [rad]."""


def axis_of(motor: Motorised, clock_rate: float) -> Axis:
    """Build the axis at rest, its power stage off; `clock_rate` as of `Oscillator.rate`.

    Raises:
        ValueError: the gains make the current loop unstable.
    """
    inc_rad = motor.plant.gear_ratio * motor.plant.increments_per_rad()
    return Axis(
        motor.plant,
        motor.gains,
        motor.tick_ns,
        motor.current_steps,
        int(motor.initial_position_rad * inc_rad // 1.0),
        clock_rate,
    )
