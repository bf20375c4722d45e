"""Base of Modbus drives: a unit on a line, registers, one axis.

A drive of a certain make derives from `ModbusDrive` and attaches behaviour to its registers. The
drive does nothing between two calls: `next_deadline_ns` returns the time of the next required call.
"""

from collections.abc import Callable, Mapping, Sequence

from motorhil.emulators.firmware.axis import NEVER_NS, Axis
from motorhil.emulators.modbus.registers import RegisterBank
from motorhil.emulators.modbus.rtu import RtuUnit
from motorhil.emulators.modbus.server import Diagnostics, Identification, ModbusServer
from motorhil.emulators.modbus.settings import ModbusDriveSettings
from motorhil.emulators.plant.dc_motor import PI, RANGES
from motorhil.emulators.settings.motor import axis_of
from motorhil.settings import SettingError


class ModbusDrive:
    """The base of Modbus drives; implements `Controller`.

    Args:
        settings: of the rig.
        bank: its holding registers, without behaviour so far.
        identification: its identification; None: it has none.
        functions: the supported function codes.

    Raises:
        SettingError: the rig names an unknown register, or a value that does not fit it.
    """

    def __init__(
        self,
        settings: ModbusDriveSettings,
        bank: RegisterBank,
        identification: Identification | None,
        functions: Sequence[int],
    ) -> None:
        self.unit: int = settings.unit
        self.settings = settings
        self.bank = bank
        plant = settings.plant
        self.turn_inc: int = round(plant.increments_per_rad() * 2.0 * PI)  # in front of the gear
        self.axis: Axis = axis_of(settings, settings.oscillator.rate())
        self.server: ModbusServer = ModbusServer(
            holding=bank,
            identification=identification,
            diagnostics=Diagnostics(),
            functions=functions,
        )
        self.rtu: RtuUnit = RtuUnit(settings.unit, self.server, settings.reply_ns)
        self.is_powered: bool = False
        self.now_ns: int = 0  # of the current call, for readers and writers of registers
        self._ready_ns = NEVER_NS
        self._events: list[tuple[str, str]] = []
        self._set_registers()
        if not settings.oscillator.is_ideal():
            self.tell("info", settings.oscillator.told())

    def _set_registers(self) -> None:
        for key, value in self.settings.registers:
            text, remedy = "", ""
            try:
                self.bank.set_default(key, value)
            except KeyError:
                text, remedy = "is not a register of this drive", "see: motorhil list registers"
            except ValueError as error:
                text = str(error)
            if text:
                raise SettingError(("registers", key), text, remedy)

    # --- hooks of a make -------------------------------------------------------------------------

    def power_on(self) -> None:
        """Handle power-on; registers have their power-on values."""

    def power_off(self) -> None:
        """Handle power-off; the axis has no current already."""

    def settle(self) -> None:
        """Apply the consequences of the axis state at `now_ns`."""

    def wake_ns(self) -> int:
        """Return when `settle` must be called at the latest [ns]; NEVER_NS: only on input."""
        return NEVER_NS

    def alarm(self, code: int) -> None:
        """Raise the alarm of this code."""

    def own_stimuli(self) -> Mapping[str, Callable[[float], None]]:
        """Return further physical stimuli; a setter raises ValueError on a wrong value."""
        return {}

    def own_truth(self) -> Mapping[str, float]:
        """Return further values of the true state."""
        return {}

    def tell(self, level: str, text: str) -> None:
        """Report an event for the record."""
        self._events.append((level, text))

    def wraps(self, counts: int) -> int:
        """Return by how much its position registers of 32 bits differ from the true position."""
        return (counts + (1 << 31)) >> 32 << 32

    # --- switches -------------------------------------------------------------------------------

    def home_closed(self) -> bool:
        """Return whether its home switch is closed."""
        home_rad = self.settings.home_rad
        return home_rad is not None and self.axis.output_position_rad() >= home_rad

    def limits_closed(self) -> tuple[bool, bool]:
        """Return whether its limit switches are closed: forward, backward."""
        forward_rad, backward_rad = (
            self.settings.limit_forward_rad,
            self.settings.limit_backward_rad,
        )
        at_rad = self.axis.output_position_rad()
        forward = forward_rad is not None and at_rad >= forward_rad
        return forward, backward_rad is not None and at_rad <= backward_rad

    # --- Controller -----------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        """Power on."""
        self.now_ns = now_ns
        self.axis.at(now_ns)
        self.is_powered = True
        self._ready_ns = now_ns + self.settings.boot_up_ns
        self.bank.set_defaults()
        if self.server.diagnostics is not None:
            self.server.diagnostics.power_on()
        self.power_on()

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame between two silences on the line; b"": it was spoiled."""
        if not self.is_powered or now_ns < self._ready_ns:
            return
        self._at(now_ns)
        if not data:
            self.rtu.spoiled()
        elif self.rtu.receive(data, now_ns) or self.rtu.expire(now_ns):  # it may respond at once
            self.settle()

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Ignore that an own frame left the line."""
        return False

    def wants_sent(self) -> bool:
        """Return False: `sent` has no effect."""
        return False

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""
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
        """Process what is due: first the motor, then the response."""
        self._at(now_ns)
        self.rtu.expire(now_ns)
        self.settle()

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to send now."""
        return self.rtu.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of each event since the last call."""
        events, self._events = self._events, []
        return events

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set the load at the output [N m], the supply, an alarm, or a stimulus of the make.

        Raises:
            ValueError: the stimulus is unknown, or the value is invalid.
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
        elif name == "alarm":
            self.alarm(_alarm_code(value))
            self.settle()
        elif name in own:
            own[name](value)
            self.settle()
        else:
            known = ", ".join(("load_torque_n_m", "power", "alarm", *own))
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
        """Return the true state at `now_ns`; rad and N m are behind the gear."""
        axis = self.axis
        axis.at(now_ns)
        return {
            **axis.truth(),
            "following_error_inc": float(axis.following_error_inc()),
            **axis.truth_of_extras(),
            **self.own_truth(),
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return None: every unit hears the whole line."""
        return None

    def identifiers_revision(self) -> int:
        """Return a constant."""
        return 0

    def _at(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self.axis.at(now_ns)
        if self.is_powered:
            self.settle()


def _alarm_code(value: float) -> int:
    if not (1 <= value <= 0xFFFF and value == int(value)):
        raise ValueError(f"alarm {value}: invalid; expected a code 1..FFFFh")
    return int(value)
