"""The hardware class of an igus dryve D1.

The drive makes its profiles itself: target, velocity and accelerations are objects, and a rising
bit 4 of the controlword starts them. Bit 4 stays set until the next motion is prepared. A stop is a
halt (bit 8); the next start clears it together with setting bit 4, so that the halted motion is not
continued.

Position counts 60A8h's units, or those of the feed constant 6092h if they are linear. 607Bh limits
the targets, which the drive ignores outside without a message; this class refuses them.

The demand is not readable. Its place is taken by the target once the drive has reached it, and by
the position before.

Source: igus, Operating Manual dryve D1 V2.4; igus's sample program of 2020-12-04; for the 10 ms
between parameters and start, users' clients.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.motorapi.adaptations.dryve.telegrams import (
    ABSENT,
    ILLEGAL_VALUE,
    DryveCodec,
    DryveException,
    Request,
    data_of,
)
from motorhil.motorapi.api import (
    BOOT_S,
    ByteLine,
    DeadlineExceeded,
    ExchangeLine,
    LineUnit,
    Numbers,
    PeerError,
    Poll,
    PolledHardware,
    PolledStatus,
    StateError,
    UnsupportedError,
    require_within,
)

if TYPE_CHECKING:
    from motorhil.motorapi.api import Exchange, MotorModel, Runtime

_CONTROLWORD, _STATUSWORD, _ERROR_CODE = (0x6040, 0, 2), (0x6041, 0, 2), (0x603F, 0, 2)
_MODE, _MODE_DISPLAY = (0x6060, 0, 1), (0x6061, 0, 1)
_POSITION, _VELOCITY, _TARGET = (0x6064, 0, 4), (0x606C, 0, 4), (0x607A, 0, 4)
_PROFILE_VELOCITY, _FASTER, _SLOWER = (0x6081, 0, 4), (0x6083, 0, 4), (0x6084, 0, 4)
_TARGET_VELOCITY, _METHOD, _UNITS = (0x60FF, 0, 4), (0x6098, 0, 1), (0x60A8, 0, 4)
_LOWEST, _HIGHEST = (0x607B, 1, 4), (0x607B, 2, 4)
_FEED, _PER_TURNS = (0x6092, 1, 4), (0x6092, 2, 4)
_MOTOR_TURNS, _SHAFT_TURNS = (0x6091, 1, 4), (0x6091, 2, 4)
_Object = tuple[int, int, int]  # index, sub-index, bytes

_SHUTDOWN, _SWITCH_ON, _ENABLE = 0x06, 0x07, 0x0F
_START, _AT_ONCE, _HALT, _RESET = 0x10, 0x20, 0x100, 0x80
_FAULT, _REMOTE, _REACHED, _ACKNOWLEDGED, _FAILED = 0x08, 0x200, 0x400, 0x1000, 0x2000
_STATE: Final = 0x6F
_READY, _ON, _OPERATION = 0x21, 0x23, 0x27
_STANDS, _BRAKES = 0x4F, 0x0F  # fault reaction active, and the bits that tell it from the others
_PP, _PV, _HM = 1, 3, 6
_LINEAR, _DEGREES = 0x01, 0x41
_CYCLE_NS: Final = 10_000_000
_STEP_S: Final = 1.0  # for a state or a mode to follow
_INT32_MAX: Final = 2**31 - 1
_UINT32_MAX: Final = 0xFFFF_FFFF
VELOCITY_UNITS: Final = ("position", "rpm")
_ERRORS: Final = {
    0x2310: "over-current",
    0x3210: "over-voltage",
    0x3220: "under-voltage",
    0x4310: "over-temperature",
    0x8611: "following error",
}


@final
class DryveLine(ExchangeLine[Request, bytes]):
    """The host's end of the connection to a drive."""

    HAS_SILENCES: ClassVar[bool] = False

    def _codec(self) -> DryveCodec:
        return DryveCodec(self.name)


@final
class DryveUnit(LineUnit[Request, bytes]):
    """The objects of one drive."""

    LINE: ClassVar[type[DryveLine]] = DryveLine

    def _units(self, line: ByteLine) -> range:
        return range(248)

    def read(self, what: _Object) -> int:
        """Return the signed value of an object; raises as `LineUnit.ask_repeatedly`."""
        answer = self.ask_repeatedly(lambda: Request(*what))
        return int.from_bytes(data_of(answer), "little", signed=True)

    def write(self, what: _Object, value: int) -> None:
        """Write an object; raises as `LineUnit.command`."""
        self.command(written(what, value))


def written(what: _Object, value: int) -> Request:
    """Return the request that writes an object; the value is signed or not."""
    size = what[2]
    return Request(*what, (value & ((1 << 8 * size) - 1)).to_bytes(size, "little"))


@final
class DryveHwMotor(PolledHardware[DryveUnit]):
    """One drive; see `PolledHardware`.

    Args:
        line: the connection to the drive.
        unit: the unit identifier to send; the drive ignores it.
        runtime: the runtime to wait with.
        velocity_unit: "position" (position units per second) or "rpm" (0.01 rpm).
        timeout_s: the response timeout [s].

    Attributes:
        velocity_unit: as given.
        homing_failed: whether the drive reports that.
        is_homing: whether a homing was started, and not stopped since.

    Raises:
        UsageError: a hardware object for this drive exists already.
    """

    STARTS_AT_ONCE: ClassVar[bool] = False  # the mode may change

    def __init__(
        self,
        line: ByteLine,
        unit: int,
        *,
        runtime: "Runtime",
        velocity_unit: str = "position",
        timeout_s: float = 0.2,
    ) -> None:
        super().__init__(DryveUnit(line, unit, runtime, self, timeout_s))
        self.velocity_unit: Final = velocity_unit
        self.homing_failed: bool = False
        self.is_homing: bool = False
        self._is_homed = False
        self._range = (0, 0)  # 607Bh
        self._mode = _PP  # of the prepared motion
        self._starts: tuple[tuple[_Object, int], ...] = ()
        self._told: dict[_Object, tuple[tuple[int, int], int]] = {}  # with `standing` at that time

    @property
    def is_referenced(self) -> bool:
        """True if the drive reports that it has been homed."""
        return self._is_homed

    # --- units ---------------------------------------------------------------------------------

    def _read_counts(self, standing: tuple[int, int]) -> float:
        registers = self.registers
        if self._counts == 0.0:
            registers.ask_patiently(lambda: Request(*_STATUSWORD), BOOT_S)
        units = registers.read(_UNITS) & _UINT32_MAX
        kind, exponent = units >> 16 & 0xFF, (units >> 24 ^ 0x80) - 0x80
        if kind not in (_LINEAR, _DEGREES):
            raise PeerError(
                f"{self.label}: SI unit position 60A8h = {units:08X}h is not known; expected 01h"
                " (linear) or 41h (rotary) in its third byte; set the axis up in the drive"
            )
        feed = 360.0 / 10.0**exponent
        if kind == _LINEAR:
            feed = registers.read(_FEED) / max(1, registers.read(_PER_TURNS))
        gear = registers.read(_MOTOR_TURNS) / max(1, registers.read(_SHAFT_TURNS))
        if feed <= 0.0 or gear <= 0.0:
            raise PeerError(
                f"{self.label}: feed constant {feed:g} (6092h) with gear {gear:g} (6091h) gives no"
                " scale; expected more than 0; set them in the drive"
            )
        self._range = registers.read(_LOWEST), registers.read(_HIGHEST)
        return feed / gear

    def _rates(self, model: "MotorModel") -> tuple[float, float]:
        rate = abs(self._per_unit(model))
        rate = rate if self.velocity_unit == "position" else rate / self._counts * 6000.0
        return rate, rate

    # --- status ----------------------------------------------------------------------------------

    def poll(self, model: "MotorModel") -> Poll:
        """Read mode, target, state, speed and position, each in a separate request."""
        self.connect(model)
        registers, per_unit = self.registers, self._per_unit(model)
        way = 1 if per_unit > 0 else -1
        mode, command = registers.read(_MODE_DISPLAY), registers.read(_CONTROLWORD)
        target = registers.read(_TARGET_VELOCITY if mode == _PV else _TARGET)
        status = registers.read(_STATUSWORD)
        is_on, reached = status & _STATE == _OPERATION, bool(status & _REACHED)
        self._note_homing(mode, status, is_on)
        fault = self._fault(bool(status & _FAULT), _ERRORS)
        speed, raw = registers.read(_VELOCITY), registers.read(_POSITION)
        time_ns = self.runtime.now_ns()  # of the position, which is read last: the least old
        halted = bool(command & _HALT)
        runs = mode == _PV and not halted and target != 0
        is_moving = is_on and (runs or not reached)
        acknowledged = mode == _PV or not command & _START or bool(status & _ACKNOWLEDGED)
        has_arrived = is_on and not is_moving and acknowledged
        at_target = has_arrived and mode == _PP and not halted and command & _START
        position, demand = self._continued(raw, target if at_target else raw)
        told = PolledStatus(
            time_ns=time_ns,
            fault=fault,
            is_on=is_on,
            position=position,
            demand=demand,
            velocity=way * speed / self._rates(model)[0],
            is_moving=is_moving,
            has_arrived=has_arrived,
            at_velocity=is_on and reached,
        )
        return self._poll_of(told, model)

    def _note_homing(self, mode: int, status: int, is_on: bool) -> None:
        if mode == _HM or not is_on:  # else bit 12 acknowledges a set-point
            self._is_homed = bool(status & _ACKNOWLEDGED)
        self.homing_failed = mode == _HM and is_on and bool(status & _FAILED)

    def _read_alarm(self) -> int:
        try:
            return self.registers.read(_ERROR_CODE) & 0xFFFF
        except DryveException as error:
            if error.code != ABSENT:
                raise
            return 0

    # --- power, fault, reference ------------------------------------------------------------------

    def _await(self, what: str, is_met: Callable[[], bool]) -> None:
        """Ask until a condition is met.

        Raises:
            DeadlineExceeded: it is not in time.
        """
        end_ns = self.runtime.now_ns() + round(_STEP_S * 1e9)
        while not is_met():
            if self.runtime.now_ns() > end_ns:
                status = self.registers.read(_STATUSWORD) & 0xFFFF
                raise DeadlineExceeded(
                    awaited=f"{self.label}: {what}",
                    timeout_s=_STEP_S,
                    last_heard=f"statusword {status:04X}h",
                )

    def _state(self) -> int:
        return self.registers.read(_STATUSWORD) & _STATE

    def enable(self) -> None:
        """Switch the power stage on, in profile position mode; the motor holds its position."""
        self._quick_stopped = False
        registers = self.registers
        status = registers.read(_STATUSWORD)
        if not status & _REMOTE or status & _FAULT:
            why = "the drive has a fault" if status & _FAULT else "its input DI7 (enable) is low"
            remedy = "reset_fault() first" if status & _FAULT else "connect DI7 to 24 V"
            told = f"{why} (statusword {status & 0xFFFF:04X}h)"
            raise StateError(motor=self.label, operation="enable", state=told, remedy=remedy)
        if status & _STATE == _OPERATION:
            return
        self._select(_PP)
        for word, state in ((_SHUTDOWN, _READY), (_SWITCH_ON, _ON), (_ENABLE, _OPERATION)):
            registers.write(_CONTROLWORD, word)
            self._await(f"state {state:02X}h", lambda: self._state() == state)  # noqa: B023 -- at once

    def _select(self, mode: int) -> None:
        """Select a mode of operation, and wait until the drive shows it."""
        registers = self.registers
        if registers.read(_MODE_DISPLAY) != mode:
            registers.write(_MODE, mode)
            self._await(f"mode {mode}", lambda: registers.read(_MODE_DISPLAY) == mode)

    def disable(self) -> None:
        """Switch the power stage off."""
        self.registers.write(_CONTROLWORD, 0)

    def reset_fault(self) -> None:
        """Reset the fault, if its cause is gone; the power stage stays off.

        A drive that still brakes because of it would not take the reset.
        """
        self._await("rest after a fault", lambda: self._state() & _STANDS != _BRAKES)
        self.registers.write(_CONTROLWORD, 0)
        self.registers.write(_CONTROLWORD, _RESET)
        self.registers.write(_CONTROLWORD, 0)

    def home(self, method: int | None, motor: str) -> None:
        """Start homing with the speeds of the drive; None: by its own method."""
        registers = self.registers
        if method is not None:
            try:
                registers.write(_METHOD, method)
            except DryveException as error:
                if error.code != ILLEGAL_VALUE:
                    raise
                feature, known = f"homing by method {method}", "those that 6098h accepts"
                raise UnsupportedError(motor=motor, feature=feature, supported=known) from error
        self._recounts = True
        registers.write(_CONTROLWORD, _ENABLE | _HALT)
        self._select(_HM)
        registers.write(_CONTROLWORD, _ENABLE)
        self._wait_a_cycle(self.runtime.now_ns())
        registers.write(_CONTROLWORD, _ENABLE | _START)
        self.is_homing = True

    def _wait_a_cycle(self, since_ns: int) -> None:
        """Let the drive apply what was written."""
        while self.runtime.now_ns() - since_ns < _CYCLE_NS:
            self.registers.read(_STATUSWORD)

    # --- motion -----------------------------------------------------------------------------------

    def _prepare(self, numbers: Numbers, model: "MotorModel") -> None:
        """Write the parameters of a motion; a running one goes on."""
        counts, speed, faster, slower = numbers
        registers = self.registers
        command, mode = registers.read(_CONTROLWORD), registers.read(_MODE_DISPLAY)
        if command & _START:
            registers.write(_CONTROLWORD, command & ~(_START | _AT_ONCE))
        values = {_FASTER: faster, _SLOWER: slower}
        if counts is None:
            reason = "the range of 60FFh"
            limits = -_INT32_MAX, _INT32_MAX
            require_within(self.label, "velocity", speed, limits, "drive units", reason)
            starts = [(_TARGET_VELOCITY, speed)]
            starts += [(_MODE, _PV)] if mode != _PV else []
            starts += [(_CONTROLWORD, _ENABLE)] if command & _HALT else []
        else:
            values |= {_TARGET: self._allowed(counts), _PROFILE_VELOCITY: speed}
            starts = [(_MODE, _PP)] if mode != _PP else []
            starts.append((_CONTROLWORD, _ENABLE | _START | _AT_ONCE))
        for what, value in values.items():
            told = registers.standing, value
            if self._told.get(what) != told:
                registers.write(what, value)
                self._told[what] = told
        self._wait_a_cycle(self.runtime.now_ns())
        self._starts = tuple(starts)

    def _allowed(self, counts: int) -> int:
        """Return the drive's own number for a target.

        Raises:
            LimitError: the drive would ignore it without a message.
        """
        target, (low, high) = self._target(counts, "counts"), self._range
        if low < high:
            reason = "607Bh, the available stroke: the drive would not move"
            wraps = counts - target
            limits = low + wraps, high + wraps
            require_within(self.label, "position", counts, limits, "counts", reason)
        return target

    def forget(self) -> None:
        """Forget the last status and the values that the drive was told."""
        super().forget()
        self._told.clear()

    def trigger(self) -> None:
        """Start the prepared motion: by one request, if the mode stays."""
        for what, value in self._starts:
            if what == _MODE:
                self._select(value)
            else:
                self.registers.write(what, value)

    def _post_stop(self) -> "Exchange[Request, bytes]":
        return self.registers.post_request(written(_CONTROLWORD, _ENABLE | _HALT))
