"""Hardware class of an ideal motor, in memory without a bus."""

from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.ideal.profiles import Course, Held, Ramped, Reading, course_of
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import LinkError, MotorError, UsageError
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.api import ChangeCounter
from motorhil.motorapi.state import Fault, MotorState

if TYPE_CHECKING:
    from collections.abc import Callable

    from motorhil.motorapi.motion import Motion
    from motorhil.motorapi.runtime.api import Registration, Runtime

LOOK_PERIOD_S: Final = 0.001
"""The period with which a moving motor reports its status [s], as a drive does by cyclic messages.
"""


@final
class IdealTrigger:
    """A trigger that starts all motions armed for it at the same nanosecond."""

    def __init__(self, runtime: "Runtime") -> None:
        self._runtime = runtime
        self._armed: list[IdealHwMotor] = []

    def __repr__(self) -> str:
        return "the common start of ideal motors"

    def arm(self, hardware: "IdealHwMotor") -> None:
        """Start the armed motion of `hardware` when this trigger fires."""
        self._armed.append(hardware)

    def disarm(self, hardware: "IdealHwMotor") -> None:
        """Exclude `hardware` from this trigger."""
        self._armed = [other for other in self._armed if other is not hardware]

    def fire(self) -> None:
        """Start all armed motions."""
        armed, self._armed = self._armed, []
        now_ns = self._runtime.now_ns()
        for hardware in armed:
            hardware.begin(now_ns)


@final
class IdealHwMotor:
    """A physical motor that follows its commands exactly: no mass, no friction, no delay.

    Moving needs no torque. In torque or current control the shaft is held, so torque causes no
    motion. The motor stands still when its power stage is switched off.

    Args:
        runtime: the runtime of the motor.
        label: its name in messages, unique in the runtime.
        position: the initial position [U].
        torque_constant: the torque per current [N·m/A, of a linear motor N/A].

    Attributes:
        shared_trigger: fires all ideal motors of a group at the same instant.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: an ideal motor of this label exists in this runtime; the message names it.
    """

    def __init__(
        self,
        runtime: "Runtime",
        label: str = "ideal motor",
        *,
        position: float = 0.0,
        torque_constant: float = 1.0,
    ) -> None:
        if not torque_constant > 0.0:
            raise UsageError(f"torque_constant = {torque_constant!r}: must be > 0")
        self.runtime: Final = runtime
        self.label: Final = label
        self.initial_position: Final = position
        self.torque_constant: Final = torque_constant
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            runtime, ("ideal", label), label, self
        )
        self.physical.news = self._news = ChangeCounter()
        self.shared_trigger: Final = context_of(runtime).parts.part(
            IdealTrigger, lambda: IdealTrigger(runtime)
        )
        self.users = 0
        self.is_closed: bool = False
        self.is_referenced: bool = False
        self.fault: Fault | None = None
        self.failure: MotorError | None = None
        self._last: Course | None = None  # of the last motion started, not of a stop
        self._cut_short = False
        self._power = MotorState.DISABLED
        self._armed: tuple[Callable[[float], Motion], IdealTrigger] | None = None
        self._motion: Motion | None = None
        self._course: Course = Held(runtime.now_ns(), position)
        self._looking: Registration | None = None

    def __repr__(self) -> str:
        what = self.state.value
        return f"<IdealHwMotor {self.label}: {what} at {self.reading().position:g}>"

    def close(self) -> None:
        """Close the motor: it is offline and at rest, and its label may be reused."""
        if self.is_closed:
            return
        now_ns = self.runtime.now_ns()
        status = RunStatus.DONE if self.is_over else RunStatus.GOING
        self.physical.end(f"close() of {self.label}", now_ns, status)
        self._stand_still()
        self.is_closed = True
        self._news.grow()
        release_physical_motor(self.runtime, ("ideal", self.label), self)

    # --- state and measurements ------------------------------------------------------------

    @property
    def state(self) -> MotorState:
        """The state of the power stage; FAULT and OFFLINE take precedence."""
        if self.is_closed:
            return MotorState.OFFLINE
        return self._power if self.fault is None else MotorState.FAULT

    def reading(self) -> Reading:
        """Return position [U], velocity [U/s] and torque [N·m or N] at this instant."""
        course = self._course
        return course.at(max(self.runtime.now_ns(), course.begun_ns))

    @property
    def is_over(self) -> bool:
        """True if the goal of the last command has been reached."""
        if self._armed is not None:
            return False
        over_ns = self._course.over_ns
        return over_ns is not None and self.runtime.now_ns() >= over_ns

    def look_again_s(self) -> float | None:
        """Return the time until the goal may be reached [s], or None if it need not be polled."""
        over_ns = self._course.over_ns
        if over_ns is None or self._armed is not None:
            return None
        self._news.count += 1
        left_ns = over_ns - self.runtime.now_ns()
        return left_ns / 1e9 if left_ns > 0 else None

    def motion_times_ns(self) -> tuple[int | None, int | None]:
        """Return the times when the last motion began and reached its goal; None: not (yet)."""
        course = self._last
        if course is None:
            return None, None
        over_ns = course.over_ns
        if self._cut_short or over_ns is None or self.runtime.now_ns() < over_ns:
            return course.begun_ns, None
        return course.begun_ns, over_ns

    # --- commands --------------------------------------------------------------------------

    def inject_fault(self, code: int, text: str = "injected") -> None:
        """Inject a fault for a test: the power stage is off, and the motor stands still."""
        self.fault = Fault(code, text, self.runtime.now_ns())
        self._power = MotorState.DISABLED
        self._stand_still()

    def reset_fault(self) -> None:
        """Clear the fault; the power stage stays off if there was one."""
        self.fault = None
        self._news.count += 1

    def enable(self) -> None:
        """Switch the power stage on."""
        self._require_open()
        self._power = MotorState.ENABLED
        self._news.count += 1

    def disable(self) -> None:
        """Switch the power stage off; the motor stands still at its position."""
        self._power = MotorState.DISABLED
        self._stand_still()

    def call_here(self, position: float) -> None:
        """Define the present position as `position` [U]."""
        self._take(Held(self.runtime.now_ns(), position), None)
        self.is_referenced = True

    # --- motion ----------------------------------------------------------------------------

    def arm(self, planned: "Callable[[float], Motion]", *, together: bool) -> IdealTrigger:
        """Arm a motion, and return the trigger that starts it.

        Args:
            planned: returns the motion, for the position where it begins [U].
            together: True if the trigger is shared.
        """
        self._require_open()
        trigger = self.shared_trigger if together else IdealTrigger(self.runtime)
        trigger.arm(self)
        self._armed = (planned, trigger)
        self._news.count += 1
        return trigger

    def disarm(self) -> None:
        """Cancel the armed motion."""
        armed, self._armed = self._armed, None
        if armed is not None:
            armed[1].disarm(self)
            self._news.count += 1

    def begin(self, now_ns: int) -> None:
        """Start the armed motion at `now_ns`."""
        armed, self._armed = self._armed, None
        if armed is None:
            return
        now = self._course.at(max(now_ns, self._course.begun_ns))
        motion = armed[0](now.position)
        course = course_of(motion, now, now_ns, self.torque_constant)
        self._take(course, motion)
        self._last, self._cut_short = course, False

    def slow_down(self, deceleration: float, *, quickly: bool = False) -> None:
        """Decelerate the motor to rest; it then holds its position.

        Args:
            deceleration: the deceleration [U/s²], unless the running motion has its own.
            quickly: `deceleration` takes precedence, and the motor is STOPPED.
        """
        self.disarm()
        now_ns = self.runtime.now_ns()
        now = self.reading()
        if self._motion is not None and not quickly:
            deceleration = self._motion.stop_deceleration or self._motion.deceleration
        if quickly and self._power is MotorState.ENABLED:
            self._power = MotorState.STOPPED
        # No notification: the owner of the motion learns that it was stopped, not that it arrived.
        ramp = Ramped(now_ns, now, 0.0, deceleration, deceleration)
        self._take(ramp, self._motion, quietly=True)

    # --- internals -------------------------------------------------------------------------

    def _require_open(self) -> None:
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    def _stand_still(self) -> None:
        self.disarm()
        self._take(Held(self.runtime.now_ns(), self.reading().position), None)

    def _take(
        self,
        course: Course,
        motion: "Motion | None",
        failure: MotorError | None = None,
        *,
        quietly: bool = False,
    ) -> None:
        """Replace the course of the motor, and sample it at a fixed rate while it moves."""
        if self._course is self._last and not self.is_over:
            self._cut_short = True
        self._stop_looking()
        self._course, self._motion, self.failure = course, motion, failure
        if not isinstance(course, Held):
            self._looking = self.runtime.every(LOOK_PERIOD_S, lambda: self._look(course))
        if quietly:
            self._news.count += 1
        else:
            self._news.grow()

    def _look(self, course: Course) -> None:
        if course is not self._course:
            return
        now_ns = self.runtime.now_ns()
        try:
            course.look(now_ns)
        except MotorError as error:  # the argument of the motion is lost
            self._take(Held(now_ns, course.place), None, error)
            return
        is_over = course.over_ns is not None and now_ns >= course.over_ns
        if is_over and course.at(now_ns).velocity == 0.0:
            self._stop_looking()
        self._news.grow()

    def _stop_looking(self) -> None:
        looking, self._looking = self._looking, None
        if looking is not None:
            looking.cancel()
