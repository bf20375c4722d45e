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

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from math import floor, tau
from struct import Struct
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.api import (
    REQUIRED,
    CanDrive,
    Fault,
    LinkError,
    Measurement,
    Motion,
    MotionKind,
    Motor,
    MotorModel,
    MotorState,
    Options,
    PeerError,
    PeriodicMessage,
    SentFrame,
    Shared,
    UsageError,
    adaptation,
    checked_node,
    number,
    read_settings,
    text,
    whole,
)

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.api import Runtime

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
_CONNECT_S: Final = 3.0


class Status(NamedTuple):
    """A status of the drive, and when it was complete on the bus [ns]."""

    state: int
    number: int
    is_moving: bool
    fault: int
    time_ns: int


class Estimate(NamedTuple):
    """Position and velocity [steps, steps/s], and when they were complete on the bus [ns]."""

    position: int
    velocity: int
    time_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    timeout_ms: float = number(
        50.0, 0, unit="ms", doc="Time without a status after which the drive is lost.", above=True
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorTable(DriveOptions):
    """A motor behind this drive."""

    node_id: int = whole(REQUIRED, 0, NODE_ID_MAX, "", "Node-ID of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class MydriveHwMotor:
    """One drive on a CAN bus, by node-ID; shared by all logical motors and threads.

    Attributes:
        drive: its connection.
        status, estimate: the last ones received, or None.
        told: the number of the last command sent, or None.
        users: the number of motors built on it from settings; the last one closes it.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        *,
        runtime: "Runtime | None" = None,
        options: DriveOptions | None = None,
    ) -> None:
        self.node_id: Final = checked_node(node_id, NODE_ID_MAX, "node_id")
        self.options: Final = DriveOptions() if options is None else options
        self.status: Status | None = None
        self.estimate: Estimate | None = None
        self.told: int | None = None
        self.users = 0
        self._fault_since_ns = 0
        self._feeds = False  # whether this program was the last to command the drive
        self.drive: Final = CanDrive(bus, node_id, self, runtime=runtime)
        self.label: Final = self.drive.label
        timeout_s = self.options.timeout_ms / 1e3
        self._statuses = self.drive.expect("status", timeout_s, self._forget)
        self._estimates = self.drive.expect("estimate", timeout_s)
        # 2. What the drive sends, and what other programs send to it. A drive that only answers
        # sends no status: drop both `expect`, and ask in `_refresh` of the motor by `exchange`.
        self.drive.handle(STATUS + node_id, self._on_status)
        self.drive.handle(ESTIMATE + node_id, self._on_estimate)
        self.drive.handle(COMMAND + node_id, self._on_foreign_command)
        self.drive.every(_ALIVE_S, self._feed)

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self.drive.is_closed

    def close(self) -> None:
        """Stop sending and receiving."""
        self.drive.close(at_rest=self.is_settled())

    def connect(self) -> None:
        """Wait until the drive is heard, and declare its traffic.

        Raises:
            LinkError: it is not heard, or this object is closed, or the bus is off.
        """
        if self.is_up():
            return
        self.drive.connect(self.is_up, lambda: None, _CONNECT_S, "status and estimate")
        self.drive.note_traffic(
            (
                PeriodicMessage(STATUS + self.node_id, _STATUS.size, PERIOD_S),
                PeriodicMessage(ESTIMATE + self.node_id, _ESTIMATE.size, PERIOD_S),
            ),
            (PeriodicMessage(ALIVE + self.node_id, 0, _ALIVE_S),),
        )

    def is_up(self) -> bool:
        """Return whether all is known that commands need."""
        return self.status is not None and self.estimate is not None and not self.drive.is_lost

    def is_settled(self) -> bool:
        """Return whether the drive has taken the last command, and does not move."""
        status = self.status
        if status is None or status.is_moving:
            return status is None
        return self.told is None or status.number == self.told

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

        def is_answered() -> bool:
            status = self.status
            return status is not None and status.number == self.told and is_there(status)

        awaited = f"a status after command {code}"
        self.drive.exchange(lambda: self.tell(code), is_answered, _ANSWER_S, awaited)
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
        self._forget()
        self.drive.overheard(f"command {data[:1].hex()}h", time_ns)

    def _feed(self) -> None:
        if self._feeds and not self.drive.status.is_off:
            with suppress(LinkError):
                self.drive.request(ALIVE + self.node_id)

    def _forget(self) -> None:
        self._feeds = False
        self.told = None
        self.drive.doubt()


@final
class MydriveMotor(Motor):
    """A logical motor on this drive; several of them may share one hardware object."""

    def __init__(
        self,
        hardware: MydriveHwMotor,
        model: MotorModel,
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        drive = hardware.drive
        super().__init__(
            name=name,
            model=model,
            runtime=drive.runtime,
            physical=drive.physical,
            on_close=on_close,
        )
        if model.gear_ratio is None:
            raise UsageError(f"motor model {model.name}: gear_ratio is missing; give it")
        self._hardware = hardware
        # 4. Units: steps of the drive per rad (or m) of the output, signed.
        self._steps: Final = (
            STEPS * model.gear_ratio / (tau if model.kind is MotionKind.ROTARY else 1.0)
        )

    # 5. The six hooks that make a motor, in the order in which the kit needs them.

    def _connect(self) -> None:
        self._hardware.connect()

    def _latest(self) -> Measurement | None:
        status, estimate = self._hardware.status, self._hardware.estimate
        if status is None or estimate is None:
            return None
        position, velocity = estimate.position / self._steps, estimate.velocity / self._steps
        return Measurement(estimate.time_ns, _STATES[status.state], position, velocity)

    def _enable(self) -> None:
        status = self._hardware.obey(SWITCH_ON, lambda status: status.state != OFF)
        self._check_fault()
        if status.state != ON:
            raise PeerError(f"{self.name}: the drive does not switch on (state {status.state})")

    def _disable(self) -> None:
        self._hardware.obey(SWITCH_OFF, lambda status: status.state != ON)

    def _command(self, motion: Motion) -> None:
        size = abs(self._steps)
        target, reach = round(motion.target * self._steps), _TARGET_MAX / size
        if abs(target) > _TARGET_MAX:
            raise UsageError(
                f"{self.name}: target {motion.target:g} {self.model.unit}; the drive takes"
                f" {-reach:g} to {reach:g} {self.model.unit}; move less far"
            )
        self._hardware.set_limits(
            round(motion.velocity * size),
            round(motion.acceleration * size),
            round(motion.deceleration * size),
        )
        self._hardware.drive.confirm(self._hardware.tell(MOVE, target))

    def _stop(self) -> None:
        size = self._physical.stop_deceleration(self.model.deceleration)
        self._hardware.set_ramp_to_stop(max(1, round(size * abs(self._steps))))
        self._hardware.tell_anyway(STOP)

    # 6. Capabilities: hooks with a default. What the drive lacks, the kit does not ask for.

    def _quantise(self, motion: Motion) -> Motion:
        size = abs(self._steps)

        def down(value: float) -> float:
            return max(1, floor(value * size * (1 + 1e-12))) / size

        return replace(
            motion,
            target=round(motion.target * self._steps) / self._steps,
            velocity=down(motion.velocity),
            acceleration=down(motion.acceleration),
            deceleration=down(motion.deceleration),
        )

    def _latest_fault(self) -> Fault | None:
        return self._hardware.fault()

    def _reset_fault(self) -> None:
        self._hardware.obey(CLEAR, lambda status: True)
        self._check_fault()

    # 7. The hardware itself, for applications that need more than a motor.

    def _open_low_level(self) -> MydriveHwMotor:
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.drive.doubt()


_SHARED: Final[Shared[MydriveHwMotor]] = Shared("drive")


@adaptation(api=1, rig="rig.toml")
def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: MotorModel, runtime: "Runtime"
) -> MydriveMotor:
    """Build the motor that a table of settings describes; motors on one drive share it.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    own = read_settings(MotorTable, settings)
    hardware, give_back = _SHARED.on_can(
        MydriveHwMotor, bus, own.node_id, runtime, own.part(DriveOptions)
    )
    return MydriveMotor(hardware, model, name=own.name, on_close=give_back)
