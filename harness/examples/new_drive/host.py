"""The adaptation. Replace the protocol, in the order of the numbers; the kit tells what is true.

The protocol of this template, which no drive speaks (identifiers + node-ID, little endian):

| identifier | from  | data |
| ---------- | ----- | --------------------------------------------------------------------- |
| 180h       | drive | state u8 (0 off, 1 on, 2 fault), number of the last command u8,       |
|            |       | moving u8, -, fault u16                                               |
| 280h       | drive | position i32, velocity i32                                            |
| 200h       | host  | command u8 (0 off, 1 on, 2 move, 3 stop, 4 clear fault), number u8,   |
|            |       | -, -, target i32                                                      |
| 300h       | host  | velocity u32 of the next move                                         |
| 380h       | host  | acceleration u32, deceleration u32 of the next move or stop           |
| 400h       | host  | none: the host is alive; without it the drive stops (fault 3)         |

Positions are in 1/65536 turn of the motor, velocities and accelerations in that per s and s².
"""

from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import ClassVar, Final, NamedTuple, final

from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    CanHardware,
    CanMotor,
    Estimate,
    Fault,
    Measurement,
    Motion,
    MotorModel,
    MotorState,
    Options,
    PeerError,
    SentFrame,
    UsageError,
    adaptation,
    motor_turns,
    positive,
    text,
    whole,
    whole_steps,
)

# 1. The protocol: identifiers, layouts, codes, units. Write the source of each beside it.
STATUS, ESTIMATE, COMMAND, SPEED, RAMPS, ALIVE = 0x180, 0x280, 0x200, 0x300, 0x380, 0x400
_STATUS: Final = Struct("<BBBxH")
_ESTIMATE: Final = Struct("<ii")
_COMMAND: Final = Struct("<BBxxi")
_SPEED: Final = Struct("<I")
_RAMPS: Final = Struct("<II")
_TARGET_MAX: Final = 0x7FFF_FFFF
OFF, ON, FAULT = 0, 1, 2
_STATES: Final = {OFF: MotorState.DISABLED, ON: MotorState.ENABLED, FAULT: MotorState.FAULT}
SWITCH_OFF, SWITCH_ON, MOVE, STOP, CLEAR = range(5)
NODE_ID_MAX: Final = 0x3F
STEPS: Final = 65536  # per turn of the motor
PERIOD_S: Final = 0.01  # of status and estimate
FAULTS: Final = {1: "over-temperature", 2: "over-voltage", 3: "no host", 4: "cannot follow"}

_ALIVE_S: Final = 0.02
_ANSWER_S: Final = 0.2


class Status(NamedTuple):
    """A status of the drive, and when it was complete on the bus [ns]."""

    state: int
    number: int
    is_moving: bool
    fault: int
    time_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    timeout_ms: float = positive(50.0, "ms", "Time without a status after which the drive is lost.")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorTable(DriveOptions):
    """A motor behind this drive."""

    node_id: int = whole(REQUIRED, 0, NODE_ID_MAX, "", "Node-ID of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class MydriveHwMotor(CanHardware[DriveOptions]):
    """One drive on a CAN bus; see `CanHardware`, which has the rest.

    Attributes:
        status, estimate: the last ones received, or None.
        told: the number of the last command sent, or None.
    """

    OPTIONS = DriveOptions
    NOUN: ClassVar[str] = "a mydrive"
    NODE_ID_MAX: ClassVar[int] = NODE_ID_MAX
    LACKS: str = "status and estimate"

    # 2. What the drive sends, and what other programs send to it. A drive that only answers sends
    # no status: drop both `expect`, and ask in `_refresh` of the motor by `exchange`.

    def _begin(self) -> None:
        self.status: Status | None = None
        self.estimate: Estimate | None = None
        self.told: int | None = None
        self._fault_since_ns = 0
        self._feeds = False  # whether this program was the last to command the drive
        timeout_s = self.options.timeout_ms / 1e3
        self._statuses = self.drive.expect("status", timeout_s, self._lose)
        self._estimates = self.drive.expect("estimate", timeout_s)
        self.drive.handle(STATUS + self.node_id, self._on_status)
        self.drive.handle(ESTIMATE + self.node_id, self._on_estimate)
        self.drive.handle(COMMAND + self.node_id, self._on_foreign_command)
        self.drive.repeat(_ALIVE_S, self._feed)
        self.drive.starts_by(COMMAND + self.node_id, _COMMAND.size)

    def _knows(self) -> bool:
        return self.status is not None and self.estimate is not None

    def _connected(self) -> None:
        own = self.node_id
        self.drive.note_frames(
            [(STATUS + own, _STATUS.size, PERIOD_S), (ESTIMATE + own, _ESTIMATE.size, PERIOD_S)],
            [(ALIVE + own, 0, _ALIVE_S)],
        )

    def _rests(self) -> bool:
        """Return whether the drive has taken the last command, and does not move."""
        status = self.status
        if status is None or status.is_moving:
            return status is None
        return self.told is None or status.number == self.told

    def forget(self) -> None:
        """Forget what the drive was told: another program commands it, or it was lost."""
        self._feeds = False
        self.told = None
        super().forget()

    def fault(self) -> Fault | None:
        """Return the fault of the last status, or None."""
        status = self.status
        if status is None or status.state != FAULT:
            return None
        code = status.fault
        return Fault(code, FAULTS.get(code, "unknown fault"), self._fault_since_ns)

    # 3. Commands. `command` needs the ownership of the motor; stops do not.

    def tell(self, code: int, target: int = 0) -> SentFrame:
        """Send a command, and note its number."""
        return self.drive.command(COMMAND + self.node_id, self._next(code, target))

    def tell_anyway(self, code: int) -> SentFrame:
        """Send a command whoever owns the motor: for stops."""
        return self.drive.stop_command(COMMAND + self.node_id, self._next(code, 0))

    def set_limits(self, velocity: int, acceleration: int, deceleration: int) -> None:
        """Set the limits of the next move, unless the drive has them already."""
        for base, data in (
            (SPEED, _SPEED.pack(velocity)),
            (RAMPS, _RAMPS.pack(acceleration, deceleration)),
        ):
            if self.drive.remembered(base) != data:
                self.drive.command(base + self.node_id, data)
                self.drive.remember(base, data)

    def set_ramp_to_stop(self, deceleration: int) -> None:
        """Set the deceleration of a stop, whoever owns the motor."""
        data = _RAMPS.pack(deceleration, deceleration)
        self.drive.stop_command(RAMPS + self.node_id, data)
        self.drive.remember(RAMPS, data)

    def obey(self, code: int, is_there: Callable[[Status], bool]) -> Status:
        """Send a command, and return the first status after it that satisfies `is_there`.

        Raises:
            DeadlineExceeded: there was none.
        """
        return self._await_status(
            lambda: self.tell(code), is_there, f"a status after command {code}"
        )

    def await_taken(self) -> None:
        """Wait until the drive has taken the last command. Raises as `obey`."""
        self._await_status(lambda: None, lambda status: True, "a status after the last command")

    def _await_status(
        self, request: Callable[[], object], is_there: Callable[[Status], bool], awaited: str
    ) -> Status:
        def is_answered() -> bool:
            status = self.status
            return status is not None and status.number == self.told and is_there(status)

        self.drive.exchange(request, is_answered, _ANSWER_S, awaited)
        assert self.status is not None  # checked by is_answered
        return self.status

    def _next(self, code: int, target: int) -> bytes:
        last = self.told if self.told is not None else self.status.number if self.status else 0
        self.told = (last + 1) & 0xFF
        self._feeds = True
        return _COMMAND.pack(code, self.told, target)

    def _on_status(self, data: bytes, time_ns: int) -> None:
        if len(data) != _STATUS.size or data[0] not in _STATES:
            return
        state, told, is_moving, fault = _STATUS.unpack(data)
        before = self.status
        self.status = Status(state, told, bool(is_moving), fault, time_ns)
        if state == FAULT and (before is None or before.state != FAULT):
            self._fault_since_ns = time_ns
        self._statuses.came(time_ns)

    def _on_estimate(self, data: bytes, time_ns: int) -> None:
        if len(data) == _ESTIMATE.size:
            position, velocity = _ESTIMATE.unpack(data)
            self.estimate = Estimate(position, velocity, time_ns)
            self._estimates.came(time_ns)

    def _on_foreign_command(self, data: bytes, time_ns: int) -> None:
        self.overheard(f"command {data[:1].hex()}h", time_ns)

    def _feed(self) -> None:
        if self._feeds:
            self.drive.request(ALIVE + self.node_id)


@final
class MydriveMotor(CanMotor[MydriveHwMotor]):
    """A logical motor on this drive; several of them may share one hardware object."""

    # 4. Units: steps of the drive per rad (or m) of the output, signed.

    def _units_of(self, model: MotorModel) -> float:
        return STEPS * motor_turns(model)

    # 5. The hooks that make a motor, in the order in which the kit needs them.

    def _latest(self) -> Measurement | None:
        status, estimate = self.hardware.status, self.hardware.estimate
        if status is None or estimate is None:
            return None
        position, velocity = estimate.position / self._units, estimate.velocity / self._units
        return Measurement(estimate.time_ns, _STATES[status.state], position, velocity)

    def _enable(self) -> None:
        status = self.hardware.obey(SWITCH_ON, lambda status: status.state != OFF)
        self._check_fault()
        if status.state != ON:
            raise PeerError(f"{self.name}: the drive does not switch on (state {status.state})")

    def _disable(self) -> None:
        self.hardware.obey(SWITCH_OFF, lambda status: status.state != ON)

    def _command(self, motion: Motion) -> None:
        size = abs(self._units)
        target, reach = round(motion.target * self._units), _TARGET_MAX / size
        if abs(target) > _TARGET_MAX:
            raise UsageError(
                f"{self.name}: target {motion.target:g} {self.model.unit}; the drive takes"
                f" {-reach:g} to {reach:g} {self.model.unit}; move less far"
            )
        self.hardware.set_limits(
            round(motion.velocity * size),
            round(motion.acceleration * size),
            round(motion.deceleration * size),
        )
        self.hardware.drive.confirm(self.hardware.tell(MOVE, target))

    def _confirm(self, motion: Motion) -> None:
        self.hardware.await_taken()

    def _stop(self) -> None:
        size = self._physical.stop_deceleration(self.model.deceleration)
        self.hardware.set_ramp_to_stop(max(1, round(size * abs(self._units))))
        self.hardware.tell_anyway(STOP)

    # 6. Capabilities: hooks with a default. What the drive lacks, the kit does not ask for.

    def _quantise(self, motion: Motion) -> Motion:
        return whole_steps(motion, self._units)

    def _latest_fault(self) -> Fault | None:
        return self.hardware.fault()

    def _reset_fault(self) -> None:
        self.hardware.obey(CLEAR, lambda status: True)
        self._check_fault()


build: Final = adaptation(api=1, rig="rig.toml")(
    CanBuilder(MotorTable, MydriveHwMotor, MydriveMotor)
)
