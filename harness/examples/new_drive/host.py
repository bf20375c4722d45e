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
    ControlMode,
    ControlVariable,
    DeviceFault,
    Fault,
    LinkError,
    Measurement,
    Motion,
    MotionInterrupted,
    MotionKind,
    Motor,
    MotorModel,
    MotorState,
    Options,
    PeerError,
    PeriodicMessage,
    SentFrame,
    Setpoint,
    Shared,
    SyncLevel,
    SyncOffer,
    Trajectory,
    TrapezoidalTrajectory,
    Trigger,
    UnsupportedError,
    UsageError,
    adaptation,
    asks_for_smoothness,
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
        target: the last commanded position [steps]; None: not known.
        stopped: whether a quick stop was the last command.
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
        self.target: int | None = None
        self.stopped = False
        self.users = 0
        self._fault_since_ns = 0
        self._feeds = False  # whether this program was the last to command the drive
        self.drive: Final = CanDrive(bus, node_id, self, runtime=runtime)
        self.label: Final = self.drive.label
        self._life = self.drive.expect("status", self.options.timeout_ms / 1e3, self._forget)
        # 2. What the drive sends, and what other programs send to it.
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
        if self.is_up() and not self.drive.is_lost:
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
        known = self.status is not None and self.estimate is not None
        return known and self._life.lost_since_ns is None

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

    def obey(self, code: int, is_there: Callable[[Status], bool], target: int = 0) -> Status:
        """Send a command, and return the first status after it that satisfies `is_there`.

        Raises:
            DeadlineExceeded: there was none.
        """

        def is_answered() -> bool:
            status = self.status
            return status is not None and status.number == self.told and is_there(status)

        awaited = f"a status after command {code}"
        self.drive.exchange(lambda: self.tell(code, target), is_answered, _ANSWER_S, awaited)
        assert self.status is not None  # checked by is_answered
        return self.status

    def _next(self, code: int, target: int) -> bytes:
        last = self.told if self.told is not None else self.status.number if self.status else 0
        self.told = (last + 1) & 0xFF
        self.target = target if code == MOVE else None
        self._feeds = True
        return _COMMAND.pack(code, self.told, target)

    def _on_status(self, data: bytes, time_ns: int) -> None:
        if len(data) != _STATUS.size:
            return
        state, told, is_moving, fault = _STATUS.unpack(data)
        before = self.status
        self.status = Status(state, told, bool(is_moving), fault, time_ns)
        if state == FAULT and (before is None or before.state != FAULT):
            self._fault_since_ns = time_ns
        if self._life.came(time_ns) or before is None or before[:4] != self.status[:4]:
            self.drive.news.grow()

    def _on_estimate(self, data: bytes, time_ns: int) -> None:
        if len(data) == _ESTIMATE.size:
            position, velocity = _ESTIMATE.unpack(data)
            self.estimate = Estimate(position, velocity, time_ns)

    def _on_foreign_command(self, data: bytes, time_ns: int) -> None:
        self._forget()
        self.drive.overheard(f"command {data[:1].hex()}h", time_ns)

    def _feed(self) -> None:
        if self._feeds and not self.drive.status.is_off:
            with suppress(LinkError):
                self.drive.request(ALIVE + self.node_id)

    def _forget(self) -> None:
        self._feeds = False
        self.told = self.target = None
        self.drive.doubt()


@final
class Start:
    """The trigger of one motion: the frame that starts it."""

    def __init__(self, hardware: MydriveHwMotor, target: int) -> None:
        self._hardware = hardware
        self._target = target

    def fire(self) -> None:
        """Start the motion; return when its frame is on the bus."""
        self._hardware.drive.confirm(self._hardware.tell(MOVE, self._target))


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
        super().__init__(
            name=f"{model.name} at {hardware.label}" if name is None else name,
            model=model,
            runtime=hardware.drive.runtime,
            physical=hardware.drive.physical,
        )
        if model.gear_ratio is None:
            raise UsageError(f"motor model {model.name}: gear_ratio is missing; give it")
        self._hardware = hardware
        self._on_close = on_close
        self._armed = False
        # 4. Units: steps of the drive per rad (or m) of the output, signed.
        self._steps: Final = (
            STEPS * model.gear_ratio / (tau if model.kind is MotionKind.ROTARY else 1.0)
        )

    def close(self) -> None:
        """Close the motor; closing again does nothing."""
        on_close, self._on_close = self._on_close, None
        if on_close is not None:
            on_close()

    # 5. What the drive can do. What is not claimed here, the kit does not ask for.

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable is ControlVariable.POSITION

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        super()._check_command(variable, command)
        if isinstance(command, TrapezoidalTrajectory) and asks_for_smoothness(variable, command):
            feature = "a trajectory with limited jerk"
            raise UnsupportedError(motor=self.name, feature=feature, supported="trapezoids")

    def _sync_offer(self) -> SyncOffer:
        return SyncOffer(
            SyncLevel.SEQUENTIAL,
            self._hardware.label,
            None,
            "the drive has no signal that starts several: each has a frame of its own",
            no_firing_bound="no bound is known for that frame",
            no_start_bound="the drive's own cycle is not known",
            no_end_bound="the drive's own clock is not known",
        )

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

    # 6. State and measurements.

    def _connect(self) -> None:
        self._hardware.connect()

    def _read_state(self) -> MotorState:
        hardware = self._hardware
        status = hardware.status
        if status is None or hardware.drive.is_lost:
            return MotorState.OFFLINE
        if status.state == FAULT:
            return MotorState.FAULT
        if status.state == OFF:
            return MotorState.DISABLED
        return MotorState.STOPPED if hardware.stopped else MotorState.ENABLED

    def _read_fault(self) -> Fault | None:
        return self._hardware.fault()

    def _read_referenced(self) -> bool:
        return False  # the drive has an absolute encoder, or homing: tell it here

    def _read_position(self) -> float:
        self._hardware.drive.check()
        assert self._hardware.estimate is not None  # after _connect
        return self._hardware.estimate.position / self._steps

    def _read_velocity(self) -> float:
        self._hardware.drive.check()
        assert self._hardware.estimate is not None
        return self._hardware.estimate.velocity / self._steps

    def _read_reference(self) -> float:
        hardware = self._hardware
        is_on = hardware.status is not None and hardware.status.state == ON
        if hardware.target is None or not is_on or not hardware.is_settled():
            return self._read_position()
        return hardware.target / self._steps

    def _latest(self) -> Measurement | None:
        estimate = self._hardware.estimate
        if estimate is None:
            return None
        position, velocity = estimate.position / self._steps, estimate.velocity / self._steps
        return Measurement(estimate.time_ns, self._read_state(), position, velocity)

    # 7. Power and faults.

    def _enable(self) -> None:
        status = self._hardware.obey(SWITCH_ON, lambda status: status.state != OFF)
        self._check_fault()
        if status.state != ON:
            raise PeerError(f"{self.name}: the drive does not switch on (state {status.state})")
        self._hardware.stopped = False

    def _disable(self) -> None:
        self._hardware.obey(SWITCH_OFF, lambda status: status.state != ON)
        self._hardware.stopped = False

    def _reset_fault(self) -> None:
        self._hardware.obey(CLEAR, lambda status: True)
        self._check_fault()

    def _check_fault(self) -> None:
        fault = self._hardware.fault()
        if fault is not None:
            raise DeviceFault(
                motor=self.name, code=fault.code, text=fault.text, since_ns=fault.since_ns
            )

    def _home(self, method: int | None) -> None:
        raise UnsupportedError(motor=self.name, feature="homing")

    # 8. Motion: prepare, start, confirm, end, stop.

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
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
        self._armed = True
        return Start(self._hardware, target)

    def _disarm(self) -> None:
        self._armed = False

    def _confirm(self, motion: Motion) -> None:
        hardware = self._hardware
        awaited = "the number of the motion's command in a status"

        def is_taken() -> bool:
            status = hardware.status
            return status is not None and (status.number == hardware.told or status.state == FAULT)

        hardware.drive.exchange(lambda: None, is_taken, _ANSWER_S, awaited)
        self._armed = False

    def _is_done(self) -> bool:
        hardware = self._hardware
        hardware.drive.check()
        self._check_fault()
        status = hardware.status
        if status is None or self._armed:
            return False
        if status.state != ON and status.number == hardware.told and hardware.target is not None:
            raise MotionInterrupted(motor=self.name, by="the drive, now off", at_ns=status.time_ns)
        return hardware.is_settled()

    def _stop(self) -> None:
        run = self._physical.run
        motion = None if run is None else run.motion
        size = self.model.deceleration
        if motion is not None:
            size = motion.stop_deceleration or motion.deceleration
        self._brake(size)

    def _quick_stop(self) -> None:
        status = self._hardware.status
        self._hardware.stopped = status is not None and status.state == ON
        self._brake(self.model.deceleration)

    def _brake(self, deceleration: float) -> None:
        self._armed = False
        self._hardware.set_ramp_to_stop(max(1, round(deceleration * abs(self._steps))))
        self._hardware.tell_anyway(STOP)

    # 9. The hardware itself, for applications that need more than a motor.

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
    options = own.part(DriveOptions)
    hardware = _SHARED.get(
        bus,
        own.node_id,
        lambda: MydriveHwMotor(bus, own.node_id, runtime=runtime, options=options),
        lambda built: built.options == options,
    )
    return MydriveMotor(
        hardware, model, name=own.name, on_close=lambda: _SHARED.give_back(hardware)
    )
