"""The hardware class of an AZ drive (Oriental Motor): direct data operation.

Position counts steps, 1000 times the electronic gear per turn of the motor; the motor model gives
the turns of the motor per turn of the output. One request of sixteen registers defines and starts a
motion. The request is sent only once, even if its answer is lost. A stop is an operation type of
the same block.

A drive ignores a trigger that it has already. One drive clears its trigger after each operation,
another keeps it. On the other, the trigger is cleared before each start. A stop is one request, so
it uses another trigger there: that of the operation type alone, with the ramp of the motion. Until
the kind is known, and another program may have started the motion, a drive is taken for the other.

Source: an open-source master for these drives, and the description of the maker's emulator.
"""

from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.modbus.client import ModbusExchange
from motorhil.motorapi.adaptations.modbus.unit import ModbusUnit, as_i32, words
from motorhil.motorapi.api.polled_hardware import (
    BOOT_S,
    HERE,
    Numbers,
    Poll,
    PolledHardware,
    PolledStatus,
    check_register,
)
from motorhil.motorapi.errors import DeadlineExceeded, PeerError, UnsupportedError

if TYPE_CHECKING:
    from motorhil.motorapi.api.line_exchanges import ByteLine
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

_BLOCK: Final = 0x0058
_TRIGGER: Final = 0x0066
_INPUTS: Final = 0x007C
_PULSED_INPUTS: Final = 0x0078
_OUTPUTS: Final = 0x007E
_ALARM: Final = 0x0080
_DEMAND: Final = 0x00C6
_SPEED_DEMAND: Final = 0x00CA
_POSITION: Final = 0x00CC
_SPEED: Final = 0x00D0
_PRESET: Final = 0x018A
_GEAR_A: Final = 0x0380
_GEAR_B: Final = 0x0382

_GEAR_MAX: Final = 65_535
_ABSOLUTE: Final = 1
_CONTINUOUS: Final = 16
_DECELERATE: Final = 0
_ALL: Final = 1  # triggers: the whole block,
_TYPE_ALONE: Final = -6  # or its operation type

_M0: Final = 0x0001  # selects stored data, without effect of its own; power-on clears it
_FREE: Final = 0x0040
_RESET: Final = 0x0080
_READY: Final = 0x0020
_IS_ALARM: Final = 0x0080
_MOVE: Final = 0x2000
_IN_POSITION: Final = 0x4000

_FULL_CURRENT: Final = 1000  # in 0.1 % of the base current
_SPEED_MAX: Final = 4_000_000
_RATE_MAX: Final = 1_000_000_000
_RELEASE_S: Final = 0.5
_POLL_S: Final = 0.005
_NEAR: Final = 0.02  # of the commanded speed
_COARSE_HZ: Final = 1000  # resolution of the speed measured each millisecond
_ALARMS: Final = {
    0x10: "excessive position deviation",
    0x20: "overcurrent",
    0x21: "main circuit overheat",
    0x22: "overvoltage",
    0x23: "main power supply off",
    0x25: "undervoltage",
    0x26: "motor overheat",
    0x28: "sensor error",
}


@final
class OrientalAzHwMotor(PolledHardware[ModbusUnit]):
    """One AZ drive; see `PolledHardware`."""

    def __init__(
        self, line: "ByteLine", unit: int, *, runtime: "Runtime", timeout_s: float = 0.2
    ) -> None:
        super().__init__(ModbusUnit(line, unit, runtime, self, timeout_s))
        self._is_enabled = False  # by us: the drive excites its motor at power-on without a command
        self._prepared: tuple[int, ...] = ()
        self._deceleration = 1_000_000
        self._current = _FULL_CURRENT
        self._hz: int | None = None  # commanded; None: a position motion
        self._keeps: bool | None = None  # its trigger; None: not known
        self._is_triggered = False  # by us, since its power-on

    @property
    def is_referenced(self) -> bool:
        """Always True: the encoder is absolute."""
        return True

    # --- units ---------------------------------------------------------------------------------

    def _read_counts(self, standing: tuple[int, int]) -> float:
        if not self._counts:
            self.registers.first_read(_OUTPUTS, BOOT_S)
        a, b = self.registers.read_i32(_GEAR_A), self.registers.read_i32(_GEAR_B)
        if not (1 <= a <= _GEAR_MAX and 1 <= b <= _GEAR_MAX):
            raise PeerError(
                f"{self.label}: its electronic gear A = {a} (0380h), B = {b} (0382h) gives no"
                f" scale; expected 1 to {_GEAR_MAX}; set both in the drive"
            )
        if self.registers.read_i32(_TRIGGER):
            self._keeps = True
        return 1000.0 * b / a

    # --- status ----------------------------------------------------------------------------------

    def poll(self, model: "MotorModel") -> Poll:
        """Read state, position, speed and demand, each in a separate request."""
        self.connect(model)
        registers, per_unit = self.registers, self._per_unit(model)
        places = registers.read_i32, _POSITION, _DEMAND
        position, demand, time_ns = self._read_positions(*places)
        speed = registers.read_i32(_SPEED)
        outputs = self._read_outputs()
        if self._is_old(time_ns):
            position, demand, time_ns = self._read_positions(*places)
        fault = self._fault(bool(outputs & _IS_ALARM), _ALARMS)
        is_moving = bool(outputs & _MOVE)
        hz = self._hz
        told = PolledStatus(
            time_ns=time_ns,
            fault=fault,
            is_on=self._is_enabled and bool(outputs & (_READY | _MOVE)),
            position=position,
            demand=demand,
            velocity=speed / per_unit,
            is_moving=is_moving,
            has_arrived=not is_moving and bool(outputs & _IN_POSITION),
            at_velocity=hz is not None and self._is_at(speed, hz),
        )
        return self._poll_of(told, model)

    def _read_outputs(self) -> int:
        """Read the outputs, with the inputs: they tell of a restart in between two polls."""
        was_enabled = self._is_enabled
        _, inputs, *outputs = self.registers.read(_INPUTS, 4)
        if was_enabled and not self._remembers(inputs):
            self._is_enabled = self._is_triggered = False
            self._asked_at = (-1, 0)  # its power-on values count
        return as_i32(*outputs)

    def _remembers(self, inputs: int) -> bool:
        """Return whether the drive was enabled since its power-on, which clears its inputs."""
        return bool(inputs & _M0)

    def _is_at(self, speed: int, hz: int) -> bool:
        """Return whether the speed is `hz`, for low speeds by their demand."""
        if abs(speed - hz) <= max(2.0, _NEAR * abs(hz)):
            return True
        return abs(speed - hz) <= _COARSE_HZ and self.registers.read_i32(_SPEED_DEMAND) == hz

    def _read_alarm(self) -> int:
        return self.registers.read_i32(_ALARM)

    # --- power, fault, reference ------------------------------------------------------------------

    def enable(self) -> None:
        """Switch the motor current on, with a mark; the motor holds its position."""
        self._quick_stopped = False
        self.registers.write(_INPUTS, *words(_M0))
        end_ns = self.runtime.now_ns() + round(_RELEASE_S * 1e9)
        while not self.registers.read_i32(_OUTPUTS) & (_READY | _MOVE):
            if self.runtime.now_ns() >= end_ns:
                raise DeadlineExceeded(
                    awaited=f"{self.label}: READY",
                    timeout_s=_RELEASE_S,
                    last_heard=f"alarm {self._read_alarm():02X}h",
                )
            self.runtime.wait_until(lambda: False, _POLL_S)
        self._is_enabled = True

    def disable(self) -> None:
        """Switch the motor current off (FREE)."""
        self._is_enabled = False
        self.registers.write(_INPUTS, *words(_FREE))

    def reset_fault(self) -> None:
        """Reset the alarm, if its cause is gone; the motor current stays off."""
        self._is_enabled = False
        self.registers.write(_INPUTS, *words(_FREE))
        self.registers.write(_PULSED_INPUTS, *words(_RESET))
        self.runtime.wait_until(lambda: False, _POLL_S)

    def home(self, method: int | None, motor: str) -> None:
        """Define the present position as 0 (35, 37); an absolute encoder needs no search."""
        if method not in HERE:
            feature = f"homing by method {method}"
            raise UnsupportedError(motor=motor, feature=feature, supported="35 and 37")
        self._recounts = True
        self.registers.write(_PRESET, *words(1))

    # --- motion -----------------------------------------------------------------------------------

    def limit_current(self, per_mille: int | None) -> None:
        """Set the current of the next block [0.1 % of the base current]; None: all of it."""
        self._current = _FULL_CURRENT if per_mille is None else per_mille

    def _prepare(self, numbers: Numbers, model: "MotorModel") -> None:
        """Prepare the block, and clear the trigger of a drive that keeps it."""
        counts, speed, faster, slower = numbers
        check_register(self.label, "acceleration", max(faster, slower), _RATE_MAX, "Hz/s")
        check_register(self.label, "velocity", abs(speed), _SPEED_MAX, "Hz")
        kind, target, self._hz = _CONTINUOUS, 0, speed
        if counts is not None:
            kind, target, self._hz = _ABSOLUTE, self._target(counts, "steps"), None
        self._prepared = words(0, kind, target, speed, faster, slower, self._current, _ALL)
        self._deceleration = slower
        if self._keeps is None and (self._is_triggered or self.physical.ownership.absences):
            is_set = bool(self.registers.read_i32(_TRIGGER))
            self._keeps = is_set if self._is_triggered else is_set or None
        if self._keeps:
            self.registers.write(_TRIGGER, *words(0))

    def trigger(self) -> None:
        """Send the prepared motion, and start it by the same request."""
        self._is_triggered = True  # even if its answer is lost
        self.registers.write(_BLOCK, *self._prepared, starts=True)

    def _post_stop(self) -> ModbusExchange:
        self._hz = None
        slower = self._deceleration
        trigger = _ALL if self._keeps is False else _TYPE_ALONE
        self._is_triggered = True
        block = words(0, _DECELERATE, 0, 0, slower, slower, self._current, trigger)
        return self.registers.post(_BLOCK, *block)
