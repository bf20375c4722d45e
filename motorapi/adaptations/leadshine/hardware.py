"""The hardware class of a drive with a path table ("PR mode").

Leadshine and StepperOnline make such drives. Position counts pulses; 0001h holds the pulses per
turn of the motor, the motor model the turns of the motor per turn of the output. Velocity is in
integer rpm, acceleration in milliseconds for a change of 1000 rpm. Values are rounded so that no
limit is exceeded.

Motions use path 0. Its eighth register is the trigger, so one request defines and starts a motion.
The request is sent only once, even if its answer is lost.

Source: the common subset of several independent public drivers for these drives.
"""

from math import ceil
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.modbus.client import ModbusExchange
from motorhil.motorapi.adaptations.modbus.unit import ModbusUnit, as_i32
from motorhil.motorapi.api.polled_hardware import (
    BOOT_S,
    HERE,
    Numbers,
    Poll,
    PolledHardware,
    PolledStatus,
    check_register,
)
from motorhil.motorapi.errors import PeerError, StateError, UnsupportedError

if TYPE_CHECKING:
    from motorhil.motorapi.api.line_exchanges import ByteLine
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

_PULSES: Final = 0x0001
_ENABLE: Final = 0x000F
_PEAK_CURRENT: Final = 0x0191  # 0.1 A
_STATUS: Final = 0x1003
_POSITION: Final = 0x1014  # i32; 1046h: speed
_SPEED: Final = 0x1046
_CONTROL: Final = 0x1801
_ALARM: Final = 0x2203
_TRIGGER: Final = 0x6002
_HOMING_MODE: Final = 0x600A
_DEMAND: Final = 0x602C
_PATH_0: Final = 0x6200
_QUICK_RAMP: Final = 0x6017

_FAULT: Final = 0x0001
_ENABLED: Final = 0x0002
_RUNNING: Final = 0x0004
_COMMAND_DONE: Final = 0x0010
_PATH_DONE: Final = 0x0020
_HOMED: Final = 0x0040

_ABSOLUTE: Final = 0x0011  # interrupts a running motion
_VELOCITY: Final = 0x0012
_RUN: Final = 0x010
_HOME: Final = 0x020
_HERE_IS_ZERO: Final = 0x021
_STOP: Final = 0x040
_RESET_ALARM: Final = 0x1111

# CiA 402 homing methods, and the drive's mode: switch and direction
_HOMING: Final = {17: 0x0000, 18: 0x0001, 19: 0x0005, 21: 0x0004}
_RPM_MAX: Final = 6000
_RAMP_MAX: Final = 32767
_ALARMS: Final = {0x01: "over-current", 0x02: "over-voltage", 0x20: "following error"}


@final
class LeadshineHwMotor(PolledHardware[ModbusUnit]):
    """One PR-mode drive; see `PolledHardware`."""

    def __init__(
        self, line: "ByteLine", unit: int, *, runtime: "Runtime", timeout_s: float = 0.2
    ) -> None:
        super().__init__(ModbusUnit(line, unit, runtime, self, timeout_s))
        self._is_homed = False
        self._is_on = False
        self._prepared: tuple[int, ...] = ()
        self._ramp_told = ((-1, 0), 0)  # `standing` at that time, and the ramp [ms]
        self._own_current: int | None = None  # of the drive, before the first write
        self._current_told = ((-1, 0), 0)  # `standing` at that time, and the current

    @property
    def is_referenced(self) -> bool:
        """True if the drive reports that it has been homed."""
        return self._is_homed

    # --- units ---------------------------------------------------------------------------------

    def _read_counts(self, standing: tuple[int, int]) -> float:
        registers = self.registers
        known = self._counts > 0.0
        pulses = registers.read(_PULSES)[0] if known else registers.first_read(_PULSES, BOOT_S)
        if pulses == 0:
            raise PeerError(
                f"{self.label}: 0 pulses per revolution (0001h) give no scale; expected at least"
                " 200; set them in the drive"
            )
        return pulses

    def _rpm_per_unit(self, model: "MotorModel") -> float:
        """Return the speed of the motor [rpm] at 1 U/s."""
        return abs(self._per_unit(model)) / self._counts * 60.0

    # --- status ----------------------------------------------------------------------------------

    def poll(self, model: "MotorModel") -> Poll:
        """Read state, position, speed and demand, each in a separate request."""
        self.connect(model)
        registers, per_unit = self.registers, self._per_unit(model)
        places = registers.read_i32, _POSITION, _DEMAND
        position, demand, time_ns = self._read_positions(*places)
        speed = as_i32(0, registers.read(_SPEED, 2)[1])
        status = registers.read(_STATUS)[0]
        if self._has_restarted(status):
            return self.poll(model)
        if self._is_old(time_ns):
            position, demand, time_ns = self._read_positions(*places)
        self._is_homed = bool(status & _HOMED)
        fault = self._fault(bool(status & _FAULT), _ALARMS)
        rpm = speed - 0x10000 if speed & 0x8000 else speed
        is_moving = bool(status & _RUNNING)
        told = PolledStatus(
            time_ns=time_ns,
            fault=fault,
            is_on=bool(status & _ENABLED),
            position=position,
            demand=demand,
            velocity=rpm / self._rpm_per_unit(model) * (1 if per_unit > 0 else -1),
            is_moving=is_moving,
            has_arrived=bool(status & _PATH_DONE) and not is_moving,
            at_velocity=bool(status & _COMMAND_DONE),
        )
        return self._poll_of(told, model)

    def _has_restarted(self, status: int) -> bool:
        """Return whether the drive was switched off since it was on, in between two polls.

        Its saved parameters count then.
        """
        was_on, self._is_on = self._is_on, bool(status & _ENABLED)
        if not was_on or status & (_ENABLED | _FAULT):
            return False
        self._asked_at = (-1, 0)
        self._ramp_told = self._current_told = ((-1, 0), 0)
        return True

    def _read_alarm(self) -> int:
        return self.registers.read(_ALARM)[0]

    # --- power, fault, reference ------------------------------------------------------------------

    def enable(self) -> None:
        """Switch the motor current on."""
        self._quick_stopped = False
        self.registers.write(_ENABLE, 1)
        if not self.registers.read(_STATUS)[0] & _ENABLED:
            raise StateError(
                motor=self.label,
                operation="enable",
                state=f"the drive does not follow (alarm {self._read_alarm():02X}h)",
                remedy="reset_fault() first",
            )
        self._is_on = True

    def disable(self) -> None:
        """Switch the motor current off."""
        self._is_on = False
        self.registers.write(_ENABLE, 0)

    def reset_fault(self) -> None:
        """Reset the alarm, if its cause is gone."""
        self._is_on = False
        self.registers.write(_ENABLE, 0)
        self.registers.write(_CONTROL, _RESET_ALARM)

    def home(self, method: int | None, motor: str) -> None:
        """Start homing: here (35, 37), or to a switch (17, 18: limit; 19, 21: home)."""
        if method in HERE:
            self._recounts = True
            self.registers.write(_TRIGGER, _HERE_IS_ZERO)
            return
        mode = _HOMING.get(method or 0)
        if mode is None:
            known = ", ".join(str(number) for number in (*sorted(_HOMING), 35, 37))
            raise UnsupportedError(
                motor=motor, feature=f"homing by method {method}", supported=known
            )
        self._recounts = True
        self.registers.write(_HOMING_MODE, mode)
        self.registers.write(_TRIGGER, _HOME)

    # --- motion -----------------------------------------------------------------------------------

    def _rates(self, model: "MotorModel") -> tuple[float, float]:
        rpm_unit = self._rpm_per_unit(model)
        return rpm_unit, rpm_unit

    def _ramp(self, rate: float) -> int:
        """Return the time for a change of 1000 rpm [ms], not shorter."""
        return max(1, min(_RAMP_MAX, ceil(1e6 / rate - 1e-9)))

    def _rate_of(self, ramp: int) -> float:
        return 1e6 / ramp

    def _prepare(self, numbers: Numbers, model: "MotorModel") -> None:
        """Prepare the request for path 0; send nothing but a changed ramp for stops."""
        counts, speed, faster, slower = numbers
        check_register(self.label, "velocity", abs(speed), _RPM_MAX, "rpm")
        kind, target = _VELOCITY, 0
        if counts is not None:
            kind, target = _ABSOLUTE, self._target(counts, "pulses")
        ramp = self.registers.standing, slower
        if self._ramp_told != ramp:
            self.registers.write(_QUICK_RAMP, slower)  # a stop has the ramp of the motion
            self._ramp_told = ramp
        self._prepared = (kind, target >> 16, target, speed, faster, slower, 0, _RUN)

    def limit_current(self, tenths_a: int | None) -> None:
        """Set the peak current [0.1 A]; None: the drive's own value."""
        if tenths_a is None and self._own_current is None:
            return
        if self._own_current is None:
            self._own_current = self.registers.read(_PEAK_CURRENT)[0]
        wanted = self._own_current if tenths_a is None else tenths_a
        told = self.registers.standing, wanted
        if self._current_told != told:
            self.registers.write(_PEAK_CURRENT, wanted)
            self._current_told = told

    def forget(self) -> None:
        """Forget the last status and the drive's own peak current."""
        super().forget()
        self._own_current = None

    def trigger(self) -> None:
        """Send the prepared motion, and start it by the same request."""
        self.registers.write(_PATH_0, *self._prepared, starts=True)

    def _post_stop(self) -> ModbusExchange:
        return self.registers.post(_TRIGGER, _STOP)
