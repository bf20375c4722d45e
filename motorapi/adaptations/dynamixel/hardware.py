"""The hardware class of a Dynamixel servo of the X series.

The servo makes its profiles itself: acceleration (108), velocity (112) and goal (116) in one write
are a motion. 4096 counts are a turn of its output; count 2048 is 0 rad. The motor model's
gear_ratio is that of a gear behind the servo, 1.0 without one.

The servo has one operating mode at a time, which can change only without torque: extended position
(4) or velocity (1). `enable` sets it.

A stop in extended position mode needs to know where the servo is. Its trajectory is read, and then
the goal written at which its ramp ends.

Source: the maker's manuals of the X series.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.motorapi.adaptations.dynamixel.packets import (
    BROADCAST,
    PING,
    REBOOT,
    SYNC_WRITE,
    DynamixelCodec,
    DynamixelExchange,
    Request,
    Status,
    read_of,
    write_of,
)
from motorhil.motorapi.api import (
    BOOT_S,
    ByteLine,
    ExchangeLine,
    LineUnit,
    MotorError,
    Numbers,
    PeerError,
    Poll,
    PolledHardware,
    PolledStatus,
    Registration,
    StateError,
    UnsupportedError,
    require_within,
    texts_of,
)

if TYPE_CHECKING:
    from motorhil.motorapi.api import MotorModel, ProcessLock, Runtime

TURN: Final = 4096
CENTRE: Final = 2048
_SPEED: Final = 64.0 / 4096.0 * 1000.0  # counts/s per register unit
_RAMP: Final = _SPEED / 0.064  # counts/s^2 per register unit
_REGISTER_MAX: Final = 32_767
_EXTENDED_MAX: Final = 1_048_575
MODES: Final = {"position": 4, "velocity": 1}
_TIME_BASED: Final = 0x04  # of the drive mode
_MODEL, _DRIVE_MODE, _MODE, _TORQUE, _WATCHDOG = 0, 10, 11, 64, 98
_WATCHDOG_S: Final = 0.02  # per register unit
_TRIPPED: Final = 0xFF  # in the register of the bus watchdog
_GOAL_VELOCITY, _RAMP_AT, _GOAL, _TRAJECTORY = 104, 108, 116, 136
_FROM, _UNTIL = 64, 144  # the registers of a poll
_X_SERIES: Final = (
    *(1000, 1010, 1020, 1030, 1060, 1070, 1080, 1090, 1100, 1110, 1120, 1130, 1160, 1170),
    *(1190, 1200, 1210, 1220, 1230, 1240),
)
_ERRORS: Final = {
    0x01: "input voltage",
    0x04: "overheating",
    0x08: "motor encoder",
    0x10: "electrical shock",
    0x20: "overload",
}


@final
class GroupStart:
    """A trigger that starts the armed servos of one mode on a line by one sync write.

    Attributes:
        armed: what is to be called after the start of each servo.
    """

    def __init__(self) -> None:
        self.armed: dict[DynamixelHwMotor, Callable[[], None]] = {}

    def fire(self) -> None:
        """Send the packet, which is not answered."""
        armed, self.armed = self.armed, {}
        servos = list(armed)
        address, data = servos[0].prepared
        head = address.to_bytes(2, "little") + len(data).to_bytes(2, "little")
        each = (bytes((one.registers.unit,)) + one.prepared[1] for one in servos)
        owned = [mine for one in servos for mine in one.registers.owned]
        request = Request(SYNC_WRITE, head + b"".join(each))
        line = servos[0].registers.line
        line.tell(request, BROADCAST, *owned, starts=True)
        for servo, started in armed.items():
            line.started_ns[servo.registers.unit] = line.started_ns[BROADCAST]
            started()


@final
class DynamixelLine(ExchangeLine[Request, Status]):
    """The host's end of one line with servos.

    Attributes:
        starts: the triggers of groups on this line, by mode.
    """

    HAS_SILENCES: ClassVar[bool] = False
    QUARANTINE_NS: ClassVar[int] = 50_000_000  # no servo answers later

    def __init__(self, line: ByteLine, runtime: "Runtime", lock: "ProcessLock | None") -> None:
        super().__init__(line, runtime, lock)
        self.starts: Final = {mode: GroupStart() for mode in MODES}

    @property
    def bytes_max(self) -> int:
        """The length of the longest packet: a poll, or the start of all servos, with stuffing."""
        return max(super().bytes_max, 16 + 18 * self.users)

    def _codec(self) -> DynamixelCodec:
        return DynamixelCodec(self.name)


@final
class DynamixelUnit(LineUnit[Request, Status]):
    """The registers of one servo."""

    LINE: ClassVar[type[DynamixelLine]] = DynamixelLine

    def _units(self, line: ByteLine) -> range:
        return range(253)

    def group(self, mode: str) -> GroupStart:
        """Return the trigger of groups of this mode on its line."""
        assert isinstance(self.line, DynamixelLine)
        return self.line.starts[mode]

    def read(self, address: int, count: int) -> bytes:
        """Return bytes of the control table; raises as `LineUnit.ask_repeatedly`."""
        return self.ask_repeatedly(lambda: read_of(address, count)).data

    def write(self, address: int, data: bytes, *, starts: bool = False) -> None:
        """Write bytes of the control table; raises as `LineUnit.command`."""
        self.command(write_of(address, data), starts=starts)


@final
class DynamixelHwMotor(PolledHardware[DynamixelUnit]):
    """One servo; see `PolledHardware`.

    Args:
        line: the line of the servo.
        unit: its id, 0 to 252.
        runtime: the runtime to wait with.
        mode: "position" or "velocity".
        timeout_s: the response timeout [s].
        watchdog_s: without an instruction on the line for this time, the servo stops; None: never.

    Attributes:
        mode, watchdog_s: as given.
        prepared: (address, bytes) of the prepared motion.

    Raises:
        UsageError: a hardware object for this servo exists already.
    """

    NEAR_TURNS: ClassVar[float] = 1 / 2000  # two counts
    NUMBER_MAX: ClassVar[int] = _REGISTER_MAX
    HAS_ONE_RAMP: ClassVar[bool] = True

    def __init__(
        self,
        line: ByteLine,
        unit: int,
        *,
        runtime: "Runtime",
        mode: str = "position",
        timeout_s: float = 0.1,
        watchdog_s: float | None = None,
    ) -> None:
        super().__init__(DynamixelUnit(line, unit, runtime, self, timeout_s))
        self.mode: Final = mode
        self.watchdog_s: Final = watchdog_s
        self._alive: Registration | None = None
        self._last_ping: DynamixelExchange | None = None
        self.prepared: tuple[int, bytes] = (_GOAL, b"")
        self._seen = b""  # the registers of the last poll
        self._quick_ramp = 0
        self._hardware_error = 0

    @property
    def is_referenced(self) -> bool:
        """True: its encoder is absolute."""
        return True

    # --- units and settings ----------------------------------------------------------------------

    def _read_counts(self, standing: tuple[int, int]) -> float:
        known = self._counts > 0.0
        asked = read_of(_MODEL, 7)
        registers = self.registers
        told = (
            registers.read(_MODEL, 7)
            if known
            else registers.ask_patiently(lambda: asked, BOOT_S).data
        )
        model = _number(told, 0, 2)
        if model not in _X_SERIES:
            raise PeerError(
                f"{self.label}: model number {model}, firmware {told[6]}, is not of the X series;"
                " expected a servo with its control table, such as 1200 (XL330-M288); check the id"
            )
        if registers.read(_DRIVE_MODE, 1)[0] & _TIME_BASED:
            raise PeerError(
                f"{self.label}: its profiles are time-based (drive mode, register 10, bit 2);"
                " expected velocity-based ones; clear that bit while torque is off"
            )
        return TURN

    def _rates(self, model: "MotorModel") -> tuple[float, float]:
        per_unit = abs(self._per_unit(model))
        return per_unit / _SPEED, per_unit / _RAMP

    # --- status ----------------------------------------------------------------------------------

    def poll(self, model: "MotorModel") -> Poll:
        """Read torque, errors, goals and all present values in one request."""
        self.connect(model)
        per_unit = self._per_unit(model)
        seen = self._seen = self.registers.read(_FROM, _UNTIL - _FROM)
        is_on, error = bool(self._at(_TORQUE, 1)), self._at(70, 1)
        self._hardware_error = error
        fault = self._fault(bool(error) and not is_on, {error: texts_of(error, _ERRORS)})
        is_stopped = self._at(_WATCHDOG, 1) == _TRIPPED
        profile_runs = bool(seen[123 - _FROM] & 2)
        demand_speed = self._at(_TRAJECTORY, 4)
        is_moving = bool(self._at(122, 1)) or profile_runs or demand_speed != 0
        position = self._at(132, 4)
        demand = self._at(_TRAJECTORY + 4, 4) if is_on and self.mode == "position" else position
        goal_speed = self._at(_GOAL_VELOCITY, 4)
        runs = self.mode == "velocity" and goal_speed != 0 and not is_stopped
        told = PolledStatus(
            time_ns=self.runtime.now_ns(),
            fault=fault,
            is_on=is_on,
            is_stopped=is_stopped,
            position=position - CENTRE,
            demand=demand - CENTRE,
            velocity=self._at(128, 4) * _SPEED / per_unit,
            is_moving=is_moving,
            has_arrived=not is_moving and not runs,
            at_velocity=is_on and abs(demand_speed - goal_speed) <= 1,
        )
        return self._poll_of(told, model)

    def _at(self, address: int, size: int) -> int:
        return _number(self._seen, address - _FROM, size, signed=size > 1)

    def _read_alarm(self) -> int:
        return self._hardware_error

    def was_started(self) -> bool:
        """Return whether the last poll has seen the prepared motion in the registers."""
        address, data = self.prepared
        return self._seen[address - _FROM : address - _FROM + len(data)] == data

    # --- power, fault ----------------------------------------------------------------------------

    def enable(self) -> None:
        """Set the mode, the goal to the present position, and switch the torque on."""
        self._quick_stopped = False
        registers = self.registers
        if registers.read(_WATCHDOG, 1)[0]:
            registers.write(_WATCHDOG, b"\0")  # else goals are refused, once it has tripped
        if registers.read(_TORQUE, 1)[0] == 0:
            if registers.read(_MODE, 1)[0] != MODES[self.mode]:
                registers.write(_MODE, bytes((MODES[self.mode],)))
            if self.mode == "position":
                registers.write(_GOAL, registers.read(132, 4))
            else:
                registers.write(_GOAL_VELOCITY, bytes(4))
            registers.write(_TORQUE, b"\1")
        mode = registers.read(_MODE, 1)[0]
        is_on = registers.read(_TORQUE, 1)[0]
        if not is_on or mode != MODES[self.mode]:
            error = registers.read(70, 1)[0]
            told = f"torque {is_on}, operating mode {mode}, hardware error {error:02X}h"
            remedy = "reset_fault() first" if error else "disable() it, then enable() again"
            raise StateError(motor=self.label, operation="enable", state=told, remedy=remedy)

        self._stay_alive()

    def _stay_alive(self) -> None:
        """Set the bus watchdog, and feed it by pings from now on."""
        if self.watchdog_s is None:
            return
        self.registers.write(_WATCHDOG, bytes((max(1, round(self.watchdog_s / _WATCHDOG_S)),)))
        if self._alive is None:
            self._alive = self.runtime.every(self.watchdog_s / 3.0, self._ping)

    def _ping(self) -> None:
        if self._last_ping is None or self._last_ping.is_over:
            with suppress(MotorError):  # the next request reports it
                ping = Request(PING, count=3)
                self._last_ping = self.registers.post_request(ping, urgent=False)

    def _rest(self) -> None:
        alive, self._alive = self._alive, None
        if alive is not None:
            alive.cancel()

    def disable(self) -> None:
        """Switch the torque off."""
        self._rest()
        self.registers.write(_TORQUE, b"\0")

    def close(self) -> None:
        """Close the hardware; the bus watchdog is fed no more."""
        self._rest()
        super().close()

    def reset_fault(self) -> None:
        """Reboot the servo, which resets a hardware error; it forgets its turns."""
        self.registers.command(Request(REBOOT))
        self.registers.ask_patiently(lambda: Request(PING, count=3), BOOT_S)
        self.forget()

    def home(self, method: int | None, motor: str) -> None:
        """Refuse homing: the encoder is absolute.

        Raises:
            UnsupportedError: always.
        """
        raise UnsupportedError(motor=motor, feature="homing", supported="its absolute encoder")

    # --- motion ----------------------------------------------------------------------------------

    def _prepare(self, numbers: Numbers, model: "MotorModel") -> None:
        """Prepare the write that starts the motion; send nothing."""
        counts, speed, ramp, _ = numbers
        quick = model.acceleration_max * self._rates(model)[1]
        self._quick_ramp = max(ramp, self._down(quick))
        if counts is None:
            most = -_REGISTER_MAX, _REGISTER_MAX
            reason = "the range of the servo's goal velocity"
            require_within(self.label, "velocity", speed, most, "drive units", reason)
            self.prepared = _GOAL_VELOCITY, _bytes(speed, ramp)
            return
        limits = -_EXTENDED_MAX - CENTRE, _EXTENDED_MAX - CENTRE
        reason = "the range of the servo's goal"
        require_within(self.label, "position", counts, limits, "counts", reason)
        self.prepared = _RAMP_AT, _bytes(ramp, speed, counts + CENTRE)

    def trigger(self) -> None:
        """Send the prepared motion, which starts it."""
        self.registers.write(*self.prepared, starts=True)

    def _post_stop(self) -> DynamixelExchange:
        quick_ramp = self._quick_ramp if self._quick_stopped else 0
        registers = self.registers
        if self.mode == "velocity":
            data = _bytes(0, quick_ramp) if quick_ramp else _bytes(0)
            return registers.post_request(write_of(_GOAL_VELOCITY, data))
        asked = read_of(_RAMP_AT, _UNTIL - _RAMP_AT)

        def read(exchange: DynamixelExchange) -> None:
            if exchange.answer is not None and exchange.error is None:
                late_s = (self.runtime.now_ns() - exchange.sent_ns) / 1e9
                late_s += registers.line.line.duration_ns(24) / 1e9
                data = _stop_from(exchange.answer.data, quick_ramp, late_s)
                self._stop = registers.post_request(write_of(_RAMP_AT, data))

        return registers.post_request(asked, read)


def _stop_from(seen: bytes, quick_ramp: int, late_s: float) -> bytes:
    """Return acceleration, velocity and goal of a stop from the registers 108 to 143.

    A servo may tell values that it does not have; those sent are in its ranges.
    """
    ramp = min(quick_ramp or _number(seen, 0, 4), _REGISTER_MAX)
    speed = min(_number(seen, 4, 4), _REGISTER_MAX)
    velocity = _number(seen, _TRAJECTORY - _RAMP_AT, 4, signed=True) * _SPEED
    position = _number(seen, _TRAJECTORY + 4 - _RAMP_AT, 4, signed=True)
    way = velocity * late_s
    if ramp:
        way += velocity * abs(velocity) / (2.0 * ramp * _RAMP)
    goal = max(-_EXTENDED_MAX, min(_EXTENDED_MAX, round(position + way)))
    return _bytes(ramp, speed, goal)


def _number(data: bytes, at: int, size: int, *, signed: bool = False) -> int:
    return int.from_bytes(data[at : at + size], "little", signed=signed)


def _bytes(*values: int) -> bytes:
    return b"".join(value.to_bytes(4, "little", signed=True) for value in values)
