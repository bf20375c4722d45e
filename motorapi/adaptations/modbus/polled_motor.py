"""The common part of adaptations to polled drives with registers.

Such a drive makes its profiles itself, and sends nothing without a request. Its hardware object
reports the status (`Poll`) and executes commands in the drive's own units; this module makes a
motor of it. All targets are absolute, so that a command whose answer was lost can be verified, and
is never executed twice.

Rounding to the registers of a polled drive, without exceeding a limit.

Shared part of the `build` functions of polled drives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import floor
from typing import TYPE_CHECKING, Final, Protocol, TypeVar, final

from motorhil.motorapi.adaptations.modbus.client import is_silence
from motorhil.motorapi.adaptations.registration import Shared
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import (
    DeviceFault,
    LimitError,
    LinkError,
    MotionInterrupted,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotionKind
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel, SyncOffer, Trigger
from motorhil.settings import REQUIRED, number, text, whole

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.modbus.client import ByteLine
    from motorhil.motorapi.adaptations.modbus.unit import ModbusUnit
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
    from motorhil.motorapi.runtime.api import Runtime

POLL_S: Final = 0.01
_BEGIN_NS: Final = 100_000_000
"""The time for which a drive may show an old status [ns]."""
_RESTS: Final = 2  # the values of one poll are not simultaneous
_NEAR_TURNS: Final = 1 / 200  # a full step: no drive rounds a target by more
_SUPPORTED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY)


@final
@dataclass(frozen=True, slots=True)
class Poll:
    """The status of a drive at `time_ns`, in SI units of the motor.

    Attributes:
        is_moving: whether an operation is active.
        has_arrived: whether the last operation is over, and at its target.
        at_velocity: whether the velocity is the commanded one.
    """

    time_ns: int
    state: MotorState
    fault: Fault | None
    position: float
    demand: float
    velocity: float
    is_moving: bool
    has_arrived: bool
    at_velocity: bool


@final
class Wanted(Enum):
    """The condition that ends the active motion."""

    ARRIVAL = "arrival"
    VELOCITY = "velocity"
    REST = "rest"


@final
class PolledProgress:
    """The state of a physical motor, for all logical motors on it.

    Attributes: poll (the last one since a command), wanted (None: no active motion), armed (the
    value of `wanted` after the trigger), started_ns, ended_ns (of the last command), armed_at and
    target (its target position or velocity; None: any), rests (consecutive polls without motion).
    """

    __slots__ = (
        *("armed", "armed_at", "ended_ns", "poll", "rests", "started_ns", "target", "wanted"),
    )

    def __init__(self) -> None:
        self.poll: Poll | None = None
        self.wanted: Wanted | None = None
        self.armed = Wanted.ARRIVAL
        self.armed_at: float | None = None
        self.target: float | None = None
        self.rests = 0
        self.started_ns: int | None = None
        self.ended_ns: int | None = None


class PolledHardware(Protocol):
    """The interface of a polled drive's hardware object; all methods but the stops may wait."""

    @property
    def progress(self) -> PolledProgress:
        """The state of its motor."""

    @property
    def runtime(self) -> "Runtime":
        """The runtime to wait with."""

    @property
    def physical(self) -> "PhysicalMotor":
        """The record of the physical motor."""

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""

    @property
    def is_referenced(self) -> bool:
        """True if the drive reports that it is referenced."""

    def connect(self, model: "MotorModel") -> None:
        """Read the units of the drive; cheap if they are known."""

    def poll(self, model: "MotorModel") -> Poll:
        """Read the present status."""

    def enable(self) -> None:
        """Switch the motor current on; the motor holds its position."""

    def disable(self) -> None:
        """Switch the motor current off."""

    def reset_fault(self) -> None:
        """Reset the fault."""

    def home(self, method: int | None, motor: str) -> None:
        """Start homing."""

    def quantised(self, motion: Motion, model: "MotorModel") -> Motion:
        """Return the motion in the drive's resolution; requires `connect`."""

    def turn(self, model: "MotorModel") -> float:
        """Return one turn of the motor in its model's units; requires `connect`."""

    def prepare(self, motion: Motion, model: "MotorModel") -> None:
        """Prepare the motion, except for its trigger."""

    def trigger(self) -> None:
        """Start the prepared motion."""

    def post_stop(self, quick: bool) -> None:
        """Send a stop, without waiting and without owning the motor."""


@final
class _PolledTrigger:
    """A trigger that starts one drive."""

    def __init__(self, motor: "PolledMotor") -> None:
        self._motor = motor

    def fire(self) -> None:
        """Start the motion; the drive acknowledges it."""
        self._motor.fire()


class PolledMotor(Motor):
    """The logical motor of a polled drive; each adaptation derives a class of its own name.

    Args:
        hardware: the hardware object of the drive.
        model: the constants of the motor.
        name: the name in messages and records. None: the model's name and the place.
        on_close: called once, when the motor is closed.
    """

    def __init__(
        self,
        hardware: PolledHardware,
        model: "MotorModel",
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(
            name=f"{model.name} at {hardware.label}" if name is None else name,
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
        )
        self._polled = hardware
        self._on_close = on_close

    def close(self) -> None:
        """Close the motor; further calls do nothing."""
        on_close, self._on_close = self._on_close, None
        if on_close is not None:
            on_close()

    # --- capabilities ----------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable in _SUPPORTED

    def _sync_offer(self) -> SyncOffer:
        reason = "its line carries one request at a time: it is started by its own request"
        return SyncOffer(
            SyncLevel.SEQUENTIAL,
            self._polled.label,
            None,
            reason,
            no_firing_bound="the duration of a Modbus exchange is not bounded",
            no_start_bound="the drive's own cycle is not known",
            no_end_bound="the drive's own clock is not known",
        )

    def _quantise(self, motion: Motion) -> Motion:
        return self._polled.quantised(motion, self.model)

    # --- connecting, state and measurements -------------------------------------------------

    def _connect(self) -> None:
        if self._polled.is_closed:
            label = self._polled.label
            raise LinkError(link=label, reason="this hardware object is closed")
        self._polled.connect(self.model)

    def _poll(self) -> Poll:
        """Read the present status, for all logical motors on the drive."""
        poll = self._polled.poll(self.model)
        state = self._polled.progress
        state.poll = poll
        rests = poll.has_arrived or poll.state is MotorState.DISABLED
        state.rests = state.rests + 1 if rests else 0
        news = self._physical.news
        if news is not None:
            news.grow()
        return poll

    def _read_state(self) -> MotorState:
        try:
            return self._poll().state
        except Exception as error:
            if is_silence(error):
                return MotorState.OFFLINE
            raise

    def _read_fault(self) -> Fault | None:
        return self._poll().fault

    def _read_referenced(self) -> bool:
        return self._polled.is_referenced

    def _read_position(self) -> float:
        return self._poll().position

    def _read_velocity(self) -> float:
        return self._poll().velocity

    def _read_reference(self) -> float:
        poll, told = self._poll(), self._polled.progress
        if poll.state is not MotorState.ENABLED:
            return poll.position
        if told.wanted is Wanted.ARRIVAL and told.target is not None and self._is_near(poll):
            return told.target  # the held target as commanded: rounding must not accumulate
        return poll.demand

    def _read_following_error(self) -> float:
        poll = self._poll()
        return poll.demand - poll.position

    def _latest(self) -> Measurement | None:
        poll = self._polled.progress.poll
        if poll is None:
            return None
        error = poll.demand - poll.position
        return Measurement(poll.time_ns, poll.state, poll.position, poll.velocity, None, error)

    def _refresh(self) -> float | None:
        self._poll()
        return POLL_S

    # --- power, fault, reference ------------------------------------------------------------

    def _enable(self) -> None:
        self._polled.enable()

    def _disable(self) -> None:
        self._polled.disable()
        self._polled.progress.wanted = None

    def _reset_fault(self) -> None:
        self._polled.reset_fault()
        poll = self._poll()
        self._raise_fault(poll)

    def _raise_fault(self, poll: Poll) -> None:
        fault = poll.fault
        if fault is not None:
            raise DeviceFault(
                motor=self.name, code=fault.code, text=fault.text, since_ns=fault.since_ns
            )

    def _home(self, method: int | None) -> None:
        self._polled.home(method, self.name)
        self._begun(Wanted.ARRIVAL)

    # --- motion -----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        if motion.function is not None:
            raise UnsupportedError(motor=self.name, feature="a trajectory that is a function")
        self._polled.prepare(motion, self.model)
        moves = motion.variable is ControlVariable.POSITION
        self._polled.progress.armed = Wanted.ARRIVAL if moves else Wanted.VELOCITY
        self._polled.progress.armed_at = motion.target
        return _PolledTrigger(self)

    @final
    def fire(self) -> None:
        """Start the armed motion; for its trigger."""
        self._polled.trigger()
        self._begun(self._polled.progress.armed, self._polled.progress.armed_at)

    def _begun(self, wanted: Wanted, target: float | None = None) -> None:
        state = self._polled.progress
        state.wanted = wanted
        state.target = target
        state.rests = 0
        state.started_ns = self.runtime.now_ns()
        state.ended_ns = None
        state.poll = None

    def _disarm(self) -> None:
        """Do nothing, as nothing starts without a trigger."""

    def _confirm(self, motion: Motion) -> None:
        self._poll()

    def _is_done(self) -> bool:
        state = self._polled.progress
        poll = state.poll
        if self._polled.is_closed:
            raise LinkError(link=self._polled.label, reason="this hardware object is closed")
        if poll is None:
            return state.wanted is None
        self._raise_fault(poll)
        self._refuse_interrupted(poll)
        done = {
            None: True,
            Wanted.ARRIVAL: poll.has_arrived and not self._is_short(poll),
            Wanted.VELOCITY: poll.at_velocity and not self._is_short(poll),
            Wanted.REST: not poll.is_moving,
        }[state.wanted]
        if done and state.ended_ns is None:
            state.ended_ns = poll.time_ns
        return done

    def _is_short(self, poll: Poll) -> bool:
        """Return whether the drive rests elsewhere than commanded, or at another velocity."""
        state = self._polled.progress
        if not poll.has_arrived or state.target is None:
            return False
        return state.target != 0.0 if state.wanted is Wanted.VELOCITY else not self._is_near(poll)

    def _is_near(self, poll: Poll) -> bool:
        target, near = self._polled.progress.target, _NEAR_TURNS * self._polled.turn(self.model)
        return target is not None and abs(poll.demand - target) <= near

    def _refuse_interrupted(self, poll: Poll) -> None:
        """Raise MotionInterrupted if the drive or another program has ended the motion."""
        state = self._polled.progress
        began_ns = poll.time_ns if state.started_ns is None else state.started_ns
        moves = state.wanted in (Wanted.ARRIVAL, Wanted.VELOCITY)
        if not moves or poll.time_ns - began_ns < _BEGIN_NS or state.rests < _RESTS:
            return
        if poll.state is MotorState.DISABLED:
            by = "another program, or the drive, which is disabled now"
        elif self._is_short(poll):
            by = f"another program, or an input of the drive: it rests at {poll.demand:g}"
        else:
            return
        raise MotionInterrupted(motor=self.name, by=by, at_ns=poll.time_ns)

    def _stop(self) -> None:
        self._begun(Wanted.REST)
        self._polled.post_stop(quick=False)

    def _quick_stop(self) -> None:
        self._begun(Wanted.REST)
        self._polled.post_stop(quick=True)

    def _open_low_level(self) -> object:
        return self._polled

    def _close_low_level(self) -> None:
        self._polled.progress.poll = None

    def _motion_times(self) -> MotionTimes | None:
        state = self._polled.progress
        if state.started_ns is None:
            return None
        source = f"its trigger acknowledged; its status as polled every {POLL_S * 1e3:g} ms"
        return MotionTimes(state.started_ns, state.ended_ns, source)


_ROUNDING: Final = 1e-9
"""The tolerance below an integer that counts as the integer, so that rounding twice changes
nothing.
"""


def gear(model: "MotorModel") -> float:
    """Return the motor turns per turn of the output, or per metre.

    Raises:
        UsageError: the model does not define them.
    """
    if model.gear_ratio is None:
        key = "motor_turns_per_m" if model.kind is MotionKind.LINEAR else "gear_ratio"
        raise UsageError(
            f"motor model {model.name}: {key} is not given; the drive counts pulses of the motor,"
            f" so add it ({key} = 1.0, if there is no gear)"
        )
    return model.gear_ratio


def toward_zero(value: float) -> int:
    """Return the nearest integer towards 0."""
    size = floor(abs(value) + _ROUNDING)
    return size if value > 0 else -size


def check_register(label: str, quantity: str, value: int, high: int, unit: str) -> None:
    """Check that a register of the drive `label` can hold `value`.

    Raises:
        LimitError: the value is above `high`; the message gives the quantity in the drive's unit.
    """
    if value > high:
        raise LimitError(
            motor=label,
            quantity=quantity,
            value=value,
            low=None,
            high=high,
            unit=unit,
            reason="the range of the drive's register",
        )


BUS_KINDS: Final = ("modbus_rtu", "modbus_tcp")
"""The `bus_kinds` of a `build` for Modbus drives: the kinds of bus they may be on."""


@final
@dataclass(frozen=True, kw_only=True)
class PolledTable:
    """A motor behind a drive on a Modbus line."""

    unit: int = whole(REQUIRED, 1, 247, "", "Server address of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    timeout_s: float = number(0.2, 0.001, 60.0, "s", "Response timeout.")


class ModbusHardware(Protocol):
    """A hardware object of a Modbus drive, as far as building is concerned."""

    users: int

    @property
    def registers(self) -> "ModbusUnit":
        """The registers of the drive."""

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""

    def close(self) -> None:
        """Close the hardware; no motor can use it afterwards."""


ModbusHardwareT = TypeVar("ModbusHardwareT", bound=ModbusHardware)


def shared_hardware(
    shared: Shared[ModbusHardwareT],
    line: "ByteLine",
    own: PolledTable,
    make: Callable[[int, float], ModbusHardwareT],
) -> ModbusHardwareT:
    """Return the hardware object described by a settings table, and count one more user.

    Args:
        shared: the existing hardware objects of this kind.
        line: the line of the drive.
        own: the table.
        make: makes a hardware object from its server address and timeout [s].

    Raises:
        UsageError: another motor has other settings for the drive.
    """
    return shared.get(
        (id(line), own.unit),
        lambda: make(own.unit, own.timeout_s),
        lambda built: built.registers.timeout_s == own.timeout_s,
    )
