"""Settings of Modbus drives in a rig, and the builder that makes a drive an entry point."""

from collections.abc import Callable, Mapping
from typing import Any, Final, final

from motorhil.emulators.controller import Controller, ControllerContext
from motorhil.emulators.firmware.clock import on_own_time
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.modbus.codes import UNITS
from motorhil.emulators.modbus.registers import Register
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.oscillator import IDEAL, Oscillator
from motorhil.emulators.settings.motor import MotorTable
from motorhil.emulators.settings.tables import BOOT_UP_S, POSITION_RAD, REPLY_S, ns
from motorhil.frozen import frozen
from motorhil.settings import (
    REQUIRED,
    Number,
    TablesByKey,
    number,
    read,
    setting,
    table,
    whole,
)

_RAD_MAX: Final = 1e9


@final
@frozen(kw_only=True, slots=False)
class ModbusTimingTable:
    """Delays of the drive."""

    boot_up_s: float = number(
        0.5, 0, 3600, "s", "From power-on until it responds.", plausible=BOOT_UP_S
    )
    reply_s: float = number(
        0.002, 0, 3600, "s", "From the end of a request to its response.", plausible=REPLY_S
    )


def _switch(doc: str) -> Any:
    doc = f"{doc}: closed from this position on."
    return number(None, -_RAD_MAX, _RAD_MAX, "rad", doc, plausible=POSITION_RAD)


@final
@frozen(kw_only=True, slots=False)
class ModbusSwitchesTable:
    """Switches of the drive, by positions of the output."""

    home_rad: float | None = _switch("Home switch")
    limit_forward_rad: float | None = _switch("Forward limit switch")
    limit_backward_rad: float | None = _switch("Backward limit switch")


@frozen(kw_only=True, slots=False)
class ModbusDriveTable(MotorTable):
    """Keys of every Modbus drive; the table of a make derives from it."""

    unit: int = whole(REQUIRED, UNITS[0], UNITS[-1], "", "Its server address.", example="1")
    timing: ModbusTimingTable = table(ModbusTimingTable, "Delays of the drive.")
    registers: Mapping[str, int] = setting(
        {},
        TablesByKey(Number(-(1 << 31), (1 << 32) - 1, is_whole=True)),
        'Power-on values, by name or address ("6200h"); see `motorhil list registers`.',
    )
    switches: ModbusSwitchesTable = table(ModbusSwitchesTable, "Switches of the drive.")

    def settings(self, stream: str) -> "ModbusDriveSettings":
        """Return the settings of the drive; random clock values come from `stream`.

        Raises:
            SettingError: values do not go together.
        """
        motor = self.motor(stream)
        return ModbusDriveSettings(
            unit=self.unit,
            plant=motor.plant,
            gains=motor.gains,
            tick_ns=motor.tick_ns,
            current_steps=motor.current_steps,
            oscillator=motor.oscillator,
            boot_up_ns=ns(self.timing.boot_up_s),
            reply_ns=ns(self.timing.reply_s),
            registers=tuple(self.registers.items()),
            home_rad=self.switches.home_rad,
            limit_forward_rad=self.switches.limit_forward_rad,
            limit_backward_rad=self.switches.limit_backward_rad,
            initial_position_rad=motor.initial_position_rad,
        )


@frozen(kw_only=True)
class ModbusDriveSettings:
    """One drive of a rig.

    Attributes:
        unit: its server address, 1..247.
        plant, gains, tick_ns, current_steps: the motor, and the servo that drives it.
        oscillator: its own clock.
        boot_up_ns: from power-on until it responds.
        reply_ns: from the end of a request to its response.
        registers: power-on values of registers, by their keys in the rig (a name, or an address in
            hex such as "6200h").
        home_rad: the position at the output where its home switch closes (there and beyond); None:
            it has none.
        limit_forward_rad, limit_backward_rad: those of its limit switches, likewise.
        initial_position_rad: at the output, at power-on.
        options: the options of its make.
    """

    unit: int
    plant: MotorPlant
    gains: ServoGains
    tick_ns: int = 1_000_000
    current_steps: int = 10
    oscillator: Oscillator = IDEAL
    boot_up_ns: int = 500_000_000
    reply_ns: int = 2_000_000
    registers: tuple[tuple[str, int], ...] = ()
    home_rad: float | None = None
    limit_forward_rad: float | None = None
    limit_backward_rad: float | None = None
    initial_position_rad: float = 0.0
    trigger_auto_clear: bool = True


@final
class DriveBuilder:
    """The `build` of one make of Modbus drives (entry point `motorhil.controllers`).

    Args:
        make: the class of the drive.
        rows: its register map, for display.
        table: its table in a rig.
    """

    bus_kinds: Final = ("modbus_rtu", "modbus_tcp")

    def __init__(
        self,
        make: Callable[[ModbusDriveSettings], Controller],
        rows: tuple[Register, ...],
        table: type[ModbusDriveTable],
    ) -> None:
        self._make = make
        self._rows = rows
        self._table = table

    def registers(self) -> tuple[Register, ...]:
        """Return the register map, for display."""
        return self._rows

    def __call__(self, settings: Mapping[str, object], context: ControllerContext) -> Controller:
        """Build the drive that a rig describes.

        Args:
            settings: the controller's table without `kind` and `bus`.
            context: its name, the folder of relative paths, the seed.

        Raises:
            SettingError: a key is unknown, or a value is missing or wrong; names the keys.
        """
        own = read(self._table, settings).settings(context.stream())
        return on_own_time(self._make(own), own.oscillator)
