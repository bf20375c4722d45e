"""The hardware object of a polled drive with registers, as far as all makes agree.

Such a drive makes its profiles itself, and sends nothing without a request. Its hardware object
reports the status (`Poll`) and executes commands in the drive's own units. All targets are
absolute: a command whose answer was lost can be verified, and is never executed twice.

Position is in counts (pulses, steps) of the motor. The drive holds the counts per turn of the
motor, the motor model the turns of the motor per turn of the output. Speeds and ramps are whole
numbers in units of the drive (`_rates`), rounded so that no limit is exceeded.

The drive's counter has 32 bits and wraps around; positions here do not. They differ by a multiple
of 2^32 counts, which each status updates. So a status is needed at least every 500 s of motion.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from math import copysign, floor, pi
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, TypeVar, final

from motorhil.frozen import frozen
from motorhil.motorapi.api.line_exchanges import Exchange
from motorhil.motorapi.api.line_unit import LineUnit
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import LimitError, UsageError, below_step, require_within
from motorhil.motorapi.model import MotionKind
from motorhil.motorapi.state import Fault, MotorState

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.motion import Motion
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
    from motorhil.motorapi.runtime.api import Runtime

BOOT_S: Final = 3.0
"""The time within which a drive answers after power-on [s]."""
INT32_MAX: Final = 0x7FFF_FFFF
UINT32_MAX: Final = 0xFFFF_FFFF
HERE: Final = (None, 35, 37)
"""The homing methods that define the present position as 0."""
_OLD_NS: Final = 100_000_000  # longer than a poll on a line of 9600 bit/s that loses nothing
_ROUNDING: Final = 1e-9  # below an integer: counts as the integer, so that rounding twice is safe
_ROUNDING_SHARE: Final = 4e-16  # likewise, of a large one


@final
@frozen
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
class PolledStatus(NamedTuple):
    """A status as the drive tells it, for `PolledHardware._poll_of`; see `Poll`.

    Attributes:
        is_on: whether the motor has current.
        position, demand: [counts].
        velocity: [U/s].
        is_stopped: whether the drive has stopped the motor; after a quick stop it has in any case.
    """

    time_ns: int
    fault: Fault | None
    is_on: bool
    position: int
    demand: int
    velocity: float
    is_moving: bool
    has_arrived: bool
    at_velocity: bool
    is_stopped: bool = False


@final
class Numbers(NamedTuple):
    """A motion in whole numbers of the drive.

    Attributes:
        target: the position [counts]; None: a motion at a velocity.
        speed: that of the profile, or the signed velocity.
        faster, slower: the ramps.
    """

    target: int | None
    speed: int
    faster: int
    slower: int


@final
class Wanted(Enum):
    """The condition that ends the active motion."""

    ARRIVAL = "arrival"
    VELOCITY = "velocity"
    REST = "rest"


@final
@dataclass(slots=True)
class PolledProgress:
    """The state of a physical motor, for all logical motors on it.

    Attributes:
        poll: the last status since a command.
        last: the last status, also from before the command.
        wanted: the condition that ends the active motion; None: no active motion.
        armed, armed_at, armed_s: `wanted`, `target` and the least duration after the trigger.
        target: the target position or velocity; None: any.
        least_ns: the time before which the motion cannot end.
        rests: number of consecutive polls without motion.
        anchor: the first status at about the present position.
        started_ns, ended_ns: of the last command.
        latched_ns: the end of its request on the line; None: unknown.
    """

    poll: Poll | None = None
    last: Poll | None = None
    wanted: Wanted | None = None
    armed: Wanted = Wanted.ARRIVAL
    armed_at: float | None = None
    armed_s: float = 0.0
    target: float | None = None
    least_ns: int = 0
    rests: int = 0
    anchor: Poll | None = None
    started_ns: int | None = None
    ended_ns: int | None = None
    latched_ns: int | None = None


UnitT = TypeVar("UnitT", bound=LineUnit[Any, Any])


class PolledHardware(ABC, Generic[UnitT]):
    """One polled drive, shared by all logical motors and threads of a process.

    Each make derives a class with its registers. All methods but the stops may wait.

    Args:
        registers: the registers of the drive.

    Attributes:
        registers: as given.
        progress: the state of its motor.
        users: the number of motors built on it from settings; the last one closes it.
        settings: those settings; empty for an object made by an application.
        STARTS_AT_ONCE: whether `trigger` sends one request, which `starts` a motion.
        NEAR_TURNS: the most by which the drive rounds a target; a full step of a stepper.
        NUMBER_MAX: the largest speed or ramp; larger ones are limited to it.
        HAS_ONE_RAMP: whether the drive accelerates and decelerates alike.
    """

    STARTS_AT_ONCE: ClassVar[bool] = True
    NEAR_TURNS: ClassVar[float] = 1 / 200
    NUMBER_MAX: ClassVar[int] = UINT32_MAX
    HAS_ONE_RAMP: ClassVar[bool] = False

    def __init__(self, registers: UnitT) -> None:
        self.registers: Final[UnitT] = registers
        self.progress: Final = PolledProgress()
        self.users = 0
        self.settings: Mapping[str, object] = {}
        self._counts = 0.0  # per turn of the motor; 0: not read yet
        self._asked_at = (-1, 0)  # `standing` at that time
        self._fault_since_ns = 0
        self._quick_stopped = False
        self._stop: Exchange[Any, Any] | None = None
        self._position = 0  # in counts, continued beyond the 32 bits of the drive
        self._recounts = False  # the drive sets its counter: not a wrap

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.label}>"

    @property
    def runtime(self) -> "Runtime":
        """The runtime to wait with."""
        return self.registers.runtime

    @property
    def physical(self) -> "PhysicalMotor":
        """The record of the physical motor."""
        return self.registers.physical

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""
        return self.registers.label

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""
        return self.registers.is_closed

    def close(self) -> None:
        """Close the hardware; further calls do nothing."""
        self.registers.close()

    # --- units ---------------------------------------------------------------------------------

    @final
    def connect(self, model: "MotorModel") -> None:
        """Read the counts per turn, unless they are known."""
        gear(model)
        standing = self.registers.standing
        if self._asked_at != standing:
            self._counts = self._read_counts(standing)
            self._asked_at = standing

    @abstractmethod
    def _read_counts(self, standing: tuple[int, int]) -> float:
        """Read the counts per turn of the motor."""

    def _per_unit(self, model: "MotorModel") -> float:
        """Return the counts per U, signed."""
        turns = 1.0 if model.kind is MotionKind.LINEAR else 1.0 / (2.0 * pi)
        return gear(model) * turns * self._counts

    @final
    def turn(self, model: "MotorModel") -> float:
        """Return one turn of the motor in its model's units; requires `connect`."""
        return self._counts / abs(self._per_unit(model))

    @final
    def _continued(self, position: int, demand: int) -> tuple[int, int]:
        """Return position and demand [counts] without the wraps of the drive's counter."""
        before = position if self._recounts else self._position
        self._position = before + as_signed(position - before)
        return self._position, self._position + as_signed(demand - position)

    @final
    def _target(self, counts: int, unit: str) -> int:
        """Return the drive's own number for a target [counts].

        Raises:
            LimitError: the drive's counter wraps around between here and there.
        """
        wraps = self._position - as_signed(self._position)
        require_within(
            self.label,
            "position",
            counts,
            (wraps - INT32_MAX, wraps + INT32_MAX),
            unit,
            "the drive's counter wraps around in between; cross it at a velocity, or call home(37)"
            " at rest",
        )
        return counts - wraps

    def _rates(self, model: "MotorModel") -> tuple[float, float]:
        """Return the drive's numbers for 1 U/s and 1 U/s²; by default in counts."""
        per_unit = abs(self._per_unit(model))
        return per_unit, per_unit

    def _ramp(self, rate: float) -> int:
        """Return the drive's number for a ramp, by default of the same size."""
        return self._down(rate)

    def _rate_of(self, ramp: int) -> float:
        """Return the size of a ramp."""
        return ramp

    @final
    def _down(self, value: float) -> int:
        """Return the drive's number that does not exceed this value, but not 0."""
        return max(1, min(self.NUMBER_MAX, toward_zero(value)))

    @final
    def _numbers(self, motion: "Motion", model: "MotorModel") -> Numbers:
        per_unit, (speed, ramp) = self._per_unit(model), self._rates(model)
        ramps = motion.acceleration, motion.deceleration
        ramps = (min(ramps), min(ramps)) if self.HAS_ONE_RAMP else ramps
        faster, slower = (self._ramp(one * ramp) for one in ramps)
        if motion.variable is ControlVariable.VELOCITY:
            way = 1 if per_unit > 0 else -1
            return Numbers(None, way * toward_zero(motion.target * speed), faster, slower)
        target = round(motion.target * per_unit)
        return Numbers(target, self._down(motion.velocity * speed), faster, slower)

    # --- status ----------------------------------------------------------------------------------

    @property
    @abstractmethod
    def is_referenced(self) -> bool:
        """True if the drive reports that it is referenced."""

    @abstractmethod
    def poll(self, model: "MotorModel") -> Poll:
        """Read state, position, speed and demand, each in a separate request."""

    @final
    def _poll_of(self, told: PolledStatus, model: "MotorModel") -> Poll:
        """Return a status as a poll, and send a lost stop again."""
        per_unit, fault = self._per_unit(model), told.fault
        self._stop_again(told.is_moving)
        is_stopped = told.is_stopped or self._quick_stopped
        state = MotorState.STOPPED if is_stopped else MotorState.ENABLED
        state = state if told.is_on else MotorState.DISABLED
        return Poll(
            *(told.time_ns, state if fault is None else MotorState.FAULT, fault),
            *(told.position / per_unit, told.demand / per_unit, told.velocity),
            *(told.is_moving, told.has_arrived, told.at_velocity),
        )

    @final
    def _read_positions(
        self, read: Callable[[int], int], position: int, demand: int
    ) -> tuple[int, int, int]:
        """Read the registers `position` and `demand`.

        Returns:
            Both without the wraps of the drive's counter [counts], and when the first was answered.
        """
        raw, time_ns = read(position), self.runtime.now_ns()
        return *self._continued(raw, read(demand)), time_ns

    @final
    def _is_old(self, time_ns: int) -> bool:
        """Return whether a slow line has made the position of a poll old, so it is read again."""
        return self.runtime.now_ns() - time_ns > _OLD_NS

    @final
    def _fault(self, is_set: bool, texts: Mapping[int, str]) -> Fault | None:
        """Return the fault, if the status has one, with its code and the time of its detection."""
        if not is_set:
            self._fault_since_ns = 0
            return None
        code = self._read_alarm()
        if not self._fault_since_ns:
            self._fault_since_ns = self.runtime.now_ns()
        return Fault(code, texts.get(code, "see the drive's manual"), self._fault_since_ns)

    @abstractmethod
    def _read_alarm(self) -> int:
        """Read the alarm code."""

    # --- power, fault, reference ------------------------------------------------------------------

    @abstractmethod
    def enable(self) -> None:
        """Switch the motor current on; the motor holds its position."""

    @abstractmethod
    def disable(self) -> None:
        """Switch the motor current off."""

    @abstractmethod
    def reset_fault(self) -> None:
        """Reset the alarm, if its cause is gone."""

    @abstractmethod
    def home(self, method: int | None, motor: str) -> None:
        """Start homing."""

    def forget(self) -> None:
        """Forget values of the drive that other programs may have changed; sends nothing."""
        self.progress.poll = self.progress.last = None

    # --- motion -----------------------------------------------------------------------------------

    def quantised(self, motion: "Motion", model: "MotorModel") -> "Motion":
        """Return the motion in the drive's resolution; requires `connect`."""
        target, number, faster, slower = self._numbers(motion, model)
        per_unit, (speed, ramp) = self._per_unit(model), self._rates(model)
        changed = replace(
            motion,
            acceleration=self._rate_of(faster) / ramp,
            deceleration=self._rate_of(slower) / ramp,
        )
        if target is None:
            return replace(changed, target=(number if per_unit > 0 else -number) / speed)
        return replace(changed, velocity=number / speed, target=target / per_unit)

    def require_speed(self, motion: "Motion", motor: str, model: "MotorModel") -> None:
        """Require the drive to be able to move as slowly as the motion allows, if it moves at all.

        Raises:
            LimitError: its smallest velocity is above the limit.
        """
        per_unit, least = self._per_unit(model), 1.0 / self._rates(model)[0]
        is_way = round(motion.start * per_unit) != round(motion.target * per_unit)
        if is_way and motion.velocity < least * (1.0 - _ROUNDING):
            raise below_step(motor, "velocity limit", motion.velocity, least, f"{model.unit}/s")

    def prepare(self, motion: "Motion", model: "MotorModel") -> None:
        """Prepare the motion, except for its trigger."""
        self.connect(model)
        self._recounts = False
        self._prepare(self._numbers(motion, model), model)
        self._stop = None

    @final
    def in_units(self, error: LimitError, motor: str, model: "MotorModel") -> LimitError:
        """Return an error about a number of the drive in the units of the model, with its motor."""
        speed, ramp = self._rates(model)
        known = {
            "position": (self._per_unit(model), model.unit),
            "velocity": (speed, f"{model.unit}/s"),
            "acceleration": (ramp, f"{model.unit}/s²"),
        }
        if error.quantity not in known:
            return error
        scale, unit = known[error.quantity]
        if error.low is not None and error.quantity == "velocity":
            scale = copysign(scale, self._per_unit(model))
        ends = [None if one is None else one / scale for one in (error.low, error.high)]
        low, high = ends if scale > 0.0 else reversed(ends)
        return LimitError(
            motor=motor,
            quantity=error.quantity,
            value=error.value / scale,
            low=low,
            high=high,
            unit=unit,
            reason=error.reason,
        )

    @abstractmethod
    def _prepare(self, numbers: Numbers, model: "MotorModel") -> None:
        """Write or keep the numbers of the next motion; send no trigger."""

    @abstractmethod
    def trigger(self) -> None:
        """Send the prepared motion, and start it by the same request."""

    def post_stop(self, quick: bool) -> None:
        """Send a stop without waiting; repeat it if the drive did not answer and still moves."""
        self._quick_stopped |= quick
        self._stop = self._post_stop()

    @abstractmethod
    def _post_stop(self) -> Exchange[Any, Any]:
        """Send a stop, without waiting and without owning the motor."""

    @final
    def _stop_again(self, is_moving: bool) -> None:
        stop = self._stop
        if stop is not None and stop.is_over:
            lost = stop.error is not None and is_moving
            self._stop = self._post_stop() if lost else None


def as_signed(value: int) -> int:
    """Return the value as a counter of 32 bits holds it."""
    return ((value + (1 << 31)) & 0xFFFF_FFFF) - (1 << 31)


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
    size = floor(abs(value) * (1.0 + _ROUNDING_SHARE) + _ROUNDING)
    return size if value > 0 else -size


def check_register(label: str, quantity: str, value: int, high: int, unit: str) -> None:
    """Check that a register of the drive `label` can hold `value`.

    Raises:
        LimitError: the value is above `high`; the message gives the quantity in the drive's unit.
    """
    reason = "the range of the drive's register"
    require_within(label, quantity, value, (None, high), unit, reason)
