"""What Modbus drives have in common: a unit on a line, registers, and one axis behind them.

A drive of a certain make derives from `ModbusDrive` and says what its registers do. Between two
calls nothing happens in it: `next_deadline_ns` says when it has to be looked at again.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from emulators.controller import ControllerContext, SettingError
from emulators.firmware.axis_readings import NEVER_NS
from emulators.firmware.gains import ServoGains
from emulators.modbus.codes import UNITS
from emulators.modbus.diagnostics import Diagnostics
from emulators.modbus.identification import Identification
from emulators.modbus.registers import RegisterBank
from emulators.modbus.rtu import RtuUnit
from emulators.modbus.server import ModbusServer
from emulators.motor_settings import MOTOR_KEYS, axis_of, motor_in
from emulators.plant.dc_motor import PI, RANGES, MotorPlant
from emulators.plant.oscillator import IDEAL, Oscillator
from emulators.setting_tables import (
    duration_ns,
    number,
    refuse_unknown,
    table_in,
    whole,
)

KEYS: Final = ("unit", *MOTOR_KEYS, "timing", "registers", "switches")
TIMING_KEYS: Final = ("boot_up_s", "reply_s")
SWITCH_KEYS: Final = ("home_rad", "limit_forward_rad", "limit_backward_rad")
_RAD_MAX: Final = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusDriveSettings:
    """One drive of a rig.

    Attributes:
        unit: its server address, 1..247.
        plant, gains, tick_ns, current_steps: the motor, and the servo that drives it.
        oscillator: what its own clock shows.
        boot_up_ns: from power-on until it answers.
        reply_ns: from the end of a request to its response.
        registers: what the rig wants registers to hold at power-on, by what they are called in the
            rig (a name, or an address in hex such as "6200h").
        home_rad: where at the output its home switch closes (at this position and beyond); None:
            it has none.
        limit_forward_rad, limit_backward_rad: where its limit switches do, likewise.
        initial_position_rad: at the output, at power-on.
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


def read_settings(table: Mapping[str, object], context: ControllerContext) -> ModbusDriveSettings:
    """The settings in a rig's table.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    refuse_unknown(table, KEYS, ())
    if "unit" not in table:
        raise SettingError(("unit",), "is missing", "a number 1..247")
    motor = motor_in(table, context.stream())
    timing = table_in(table, "timing")
    refuse_unknown(timing, TIMING_KEYS, ("timing",))
    switches = table_in(table, "switches")
    refuse_unknown(switches, SWITCH_KEYS, ("switches",))
    return ModbusDriveSettings(
        unit=whole(table["unit"], ("unit",), UNITS[0], UNITS[-1]),
        plant=motor.plant,
        gains=motor.gains,
        tick_ns=motor.tick_ns,
        current_steps=motor.current_steps,
        oscillator=motor.oscillator,
        boot_up_ns=duration_ns(timing, "boot_up_s", 0.5, ("timing",)),
        reply_ns=duration_ns(timing, "reply_s", 0.002, ("timing",)),
        registers=_registers(table_in(table, "registers")),
        home_rad=_switch(switches, "home_rad"),
        limit_forward_rad=_switch(switches, "limit_forward_rad"),
        limit_backward_rad=_switch(switches, "limit_backward_rad"),
        initial_position_rad=motor.initial_position_rad,
    )


def _registers(table: Mapping[str, object]) -> tuple[tuple[str, int], ...]:
    return tuple(
        (key, whole(value, ("registers", key), -(1 << 31), (1 << 32) - 1))
        for key, value in table.items()
    )


def _switch(table: Mapping[str, object], key: str) -> float | None:
    return number(table[key], ("switches", key), -_RAD_MAX, _RAD_MAX) if key in table else None


class ModbusDrive:
    """Implements `emulators.controller.Controller`; a make derives from it.

    Args:
        settings: of the rig.
        bank: its holding registers, with nothing behind them yet.
        identification: what it calls itself; None: it does not.
        functions: the function codes that it has.
        events: what is to be told of it at power-on.

    Raises:
        SettingError: the rig names a register that is not there, or a value that it cannot hold.
    """

    def __init__(
        self,
        settings: ModbusDriveSettings,
        bank: RegisterBank,
        identification: Identification | None,
        functions: Sequence[int],
        events: Sequence[tuple[str, str]] = (),
    ) -> None:
        self.unit = settings.unit
        self.settings = settings
        self.bank = bank
        plant = settings.plant
        self.inc_rad = plant.gear_ratio * plant.increments_per_rad()
        self.axis = axis_of(settings, settings.oscillator.rate())
        self.server = ModbusServer(
            holding=bank,
            identification=identification,
            diagnostics=Diagnostics(),
            functions=functions,
        )
        self.rtu = RtuUnit(settings.unit, self.server, settings.reply_ns)
        self.is_powered = False
        self.now_ns = 0  # of the call there is: what registers that are read or written look at
        self._ready_ns = NEVER_NS
        self._events: list[tuple[str, str]] = list(events)
        self._set_registers()

    def _set_registers(self) -> None:
        for key, value in self.settings.registers:
            path = ("registers", key)
            try:
                self.bank.set_default(key, value)
            except KeyError:
                raise SettingError(
                    path, "is no register of it", "see: motorhil list registers"
                ) from None
            except ValueError as error:
                raise SettingError(path, str(error)) from None

    # --- what a make says ----------------------------------------------------------------------

    def power_on(self) -> None:
        """Its supply has come; registers hold what they do at power-on."""

    def power_off(self) -> None:
        """Its supply has gone; the axis has no current already."""

    def settle(self) -> None:
        """The axis is at `now_ns`: what follows from where it is has happened."""

    def wake_ns(self) -> int:
        """When `settle` is wanted at the latest [ns]; NEVER_NS: not before something comes."""
        return NEVER_NS

    def own_stimuli(self) -> Mapping[str, Callable[[float], None]]:
        """What else can happen to it physically; a setter raises ValueError on a wrong value."""
        return {}

    def own_truth(self) -> Mapping[str, float]:
        """What else is true of it."""
        return {}

    def tell(self, level: str, text: str) -> None:
        """Something worth a line in the record happened."""
        self._events.append((level, text))

    # --- switches -------------------------------------------------------------------------------

    def home_closed(self) -> bool:
        """Whether its home switch is closed."""
        home_rad = self.settings.home_rad
        return home_rad is not None and self.axis.output_position_rad() >= home_rad

    def limits_closed(self) -> tuple[bool, bool]:
        """Whether its limit switches are closed: forward, backward."""
        forward_rad, backward_rad = (
            self.settings.limit_forward_rad,
            self.settings.limit_backward_rad,
        )
        at_rad = self.axis.output_position_rad()
        forward = forward_rad is not None and at_rad >= forward_rad
        return forward, backward_rad is not None and at_rad <= backward_rad

    # --- Controller -----------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        """Power comes on."""
        self.now_ns = now_ns
        self.is_powered = True
        self._ready_ns = now_ns + self.settings.boot_up_ns
        self.bank.set_defaults()
        self.power_on()

    def receive(self, data: bytes, now_ns: int) -> None:
        """What was on the line between two silences; b"": it was spoiled."""
        if not self.is_powered or now_ns < self._ready_ns:
            return
        self._at(now_ns)
        if data:
            self.rtu.receive(data, now_ns)
            self.settle()  # a broadcast acts at once
        else:
            self.rtu.spoiled()

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """An own frame left the line."""
        return False

    def wants_sent(self) -> bool:
        """Nothing comes of it."""
        return False

    def next_deadline_ns(self) -> int | None:
        """When `expire` must be called at the latest [ns]."""
        if not self.is_powered:
            return None
        due_ns = self.wake_ns()
        reply_ns = self.rtu.next_deadline_ns()
        if reply_ns is not None and reply_ns < due_ns:
            due_ns = reply_ns
        event_ns = self.axis.event_ns(due_ns)
        due_ns = event_ns if event_ns < due_ns else due_ns
        return None if due_ns >= NEVER_NS else due_ns

    def expire(self, now_ns: int) -> None:
        """What is due is done: first the motor's, then its answer."""
        self._at(now_ns)
        self.rtu.expire(now_ns)
        self.settle()

    def take_output(self) -> Sequence[bytes]:
        """The frames to send now."""
        return self.rtu.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """(level, text) of what happened since last asked."""
        events, self._events = self._events, []
        return events

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """The load at the output [N m], its supply (1 or 0), or what the make has besides.

        Raises:
            ValueError: there is no such stimulus, or the value is none.
        """
        self._at(now_ns)
        own = self.own_stimuli()
        if name == "load_torque_n_m":
            low, high = RANGES[name]
            if not low <= value <= high:
                raise ValueError(f"load_torque_n_m is {low:g}..{high:g} N m, not {value}")
            self.axis.set_load(value)
        elif name == "power":
            if value not in (0, 1):
                raise ValueError(f"power is 0 or 1, not {value}")
            self._set_power(value == 1, now_ns)
        elif name in own:
            own[name](value)
            self.settle()
        else:
            known = ", ".join(("load_torque_n_m", "power", *own))
            raise ValueError(f"there is no stimulus {name!r}; known: {known}")

    def _set_power(self, on: bool, now_ns: int) -> None:
        if on and not self.is_powered:
            self.start(now_ns)
        elif not on and self.is_powered:
            self.is_powered = False
            self.axis.power(False)
            self.rtu.power_off()
            self.power_off()

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """The truth at `now_ns`, behind the gear where it says rad and N m."""
        axis = self.axis
        axis.at(now_ns)
        return {
            "position_rad": axis.output_position_rad(),
            "velocity_rad_s": axis.output_velocity_rad_s(),
            "position_inc": float(axis.position_inc()),
            "demand_inc": float(axis.demand_inc()),
            "current_a": axis.current_a(),
            "torque_n_m": axis.torque_n_m(),
            "following_error_inc": float(axis.following_error_inc()),
            **axis.truth_of_extras(),
            **self.own_truth(),
        }

    def identifiers(self) -> Sequence[int] | None:
        """On a line everybody hears everything."""
        return None

    def identifiers_revision(self) -> int:
        """Never changes."""
        return 0

    def _at(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self.axis.at(now_ns)
        if self.is_powered:
            self.settle()


def alarm_code(value: float) -> int:
    """The code that a stimulus `alarm` carries.

    Raises:
        ValueError: it is none.
    """
    if not (1 <= value <= 0xFFFF and value == int(value)):
        raise ValueError(f"alarm takes a code 1..FFFFh, not {value}")
    return int(value)


def revolutions_inc(plant: MotorPlant) -> int:
    """Encoder increments of one revolution of the motor, in front of the gear."""
    return round(plant.increments_per_rad() * 2.0 * PI)
