"""One motor of the servo cycle: its servo, armed course and faults."""

from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.host_servo.demand import POSITION, Course
from motorhil.motorapi.adaptations.host_servo.node import (
    READY,
    AmplifierNode,
    SwitchOff,
)
from motorhil.motorapi.adaptations.host_servo.servo import Servo, ServoLimits
from motorhil.motorapi.errors import (
    LinkError,
    MotorBusyError,
    MotorError,
)
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
)
from motorhil.motorapi.state import Fault, MotorState

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.host_servo.settings import PidGains
    from motorhil.motorapi.locking.process_lock import LockHandle


FAULT: Final = 2
AMPLIFIER_FAULT: Final = 0x5400  # device hardware, power section (CiA 402-2, error codes)
COMMUNICATION: Final = 0x8100
FOLLOWING_ERROR: Final = 0x8611
_RAW_MAX: Final = 32767


@final
class ServoAxis:
    """One motor of the servo cycle (protocol `Axis`); positions are increments.

    Attributes:
        servo: position, demand and output, as of the last cycle.
        is_active: whether the motor takes part in the cycle.
        is_stopped: whether a quick stop was the last command.
        failure: the error that ended the control, if it is not a fault of the motor; else None.
        fault: the fault detected by the host, or None.
        amplifier_fault_ns: the time since when the amplifier reports a fault, or None.
        counted_ns: the time of the last count (-1: none).
        steps: the number of counts since the motor became active.
        started_ns, ended_ns: the times of the last motion; None: not (yet), or ended before its
            goal.
    """

    def __init__(
        self,
        io: "AmplifierNode",
        channel: int,
        physical: "PhysicalMotor",
        period_s: float,
        raw_per_ampere: float,
    ) -> None:
        self.physical: Final = physical
        self.servo: Final = Servo(period_s)
        self.is_active: bool = False
        self.is_stopped: bool = False
        self.failure: MotorError | None = None
        self.fault: Fault | None = None
        self.amplifier_fault_ns: int | None = None
        self.counted_ns: int = -1
        self.steps: int = 0
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self._io: Final = io
        self._node: Final = io.node
        self._channel: Final = channel
        self._raw_per_ampere: Final = raw_per_ampere
        self._armed: tuple[Course, PidGains, ServoLimits] | None = None
        self._moves = False  # a motion, not a stop
        self._hold: LockHandle | None = None  # of the node
        self._switching_off: SwitchOff | None = None

    # --- state -----------------------------------------------------------------------------

    @property
    def is_powered(self) -> bool:
        """True if the servo holds the motor."""
        return self.servo.course is not None

    @property
    def is_over(self) -> bool:
        """True if the goal of the last command has been reached, or the motor has no power."""
        return self._armed is None and (self.servo.is_done or self.servo.course is None)

    @property
    def state(self) -> MotorState:
        """The state of the motor, provided that its node is heard."""
        if self.current_fault() is not None:
            return MotorState.FAULT
        if not self.is_powered:
            return MotorState.DISABLED
        return MotorState.STOPPED if self.is_stopped else MotorState.ENABLED

    def current_fault(self) -> Fault | None:
        """Return the fault that prevents motion until it is reset, or None."""
        if self.fault is None and self.amplifier_fault_ns is not None:
            return Fault(AMPLIFIER_FAULT, "amplifier fault", self.amplifier_fault_ns)
        return self.fault

    # --- commands --------------------------------------------------------------------------

    def activate(self) -> None:
        """Join the cycle, without control or current at first.

        Raises:
            MotorBusyError: another process's servo runs on the node.
        """
        hold, before = self._io.occupation.occupy(), self._hold
        self._hold = hold
        if before is not None:
            before.release()
        self.end_switching_off()
        self._node.keep_host_heartbeat()
        self.failure = None
        self.servo.forget()
        self.is_active = True
        self.is_stopped = False
        self.steps = 0

    def hold(self, gains: "PidGains", limits: ServoLimits) -> None:
        """Hold the motor at its present position."""
        course = Course(POSITION, self.servo.position)
        self.servo.begin(course, gains, limits, self._io.cycle.count)
        self.servo.is_done = True
        self._moves = False
        self._node.news.grow()

    def arm(self, course: Course, gains: "PidGains", limits: ServoLimits) -> None:
        """Arm a course, which begins at a cycle chosen by the trigger.

        Raises:
            LinkError: the servo does not hold the motor.
        """
        if self.failure is not None and not self.is_powered:
            raise self.failure
        if not self.is_powered:
            raise LinkError(link=self.physical.label, reason="its servo is off")
        self._armed = (course, gains, limits)

    def disarm(self) -> None:
        """Cancel the armed course."""
        self._armed = None
        armed = self._io.cycle.armed
        if self in armed:
            armed.remove(self)

    def slow_down(self, deceleration_inc_s2: float, *, quickly: bool = False) -> None:
        """Bring the motor to rest at this deceleration, and hold it."""
        self.disarm()
        if self.is_powered:
            self.is_stopped = self.is_stopped or quickly
            self.servo.brake(deceleration_inc_s2)
            self._moves = False
        self._node.news.grow()

    def call_here(self, position_inc: int) -> None:
        """Define the present position as `position_inc`, without motion."""
        self.servo.call_here(position_inc)
        self.servo.is_done = True
        self._node.news.grow()

    def cut(self) -> None:
        """End control and current, and switch the amplifier off until its node confirms it.

        Raises:
            LinkError: the bus does not accept the frame.
        """
        was_active = self.is_active
        self.is_active = self.is_stopped = False
        self.disarm()
        self.servo.release()
        hold, self._hold = self._hold, None
        try:
            if was_active and self._io.is_switched(self._channel):
                self.end_switching_off()
                self._switching_off = SwitchOff(self._io, self._channel, hold)
                hold = None
                self._io.switch(self._channel, False)
        except MotorBusyError:  # Another process owns the node now, and so the amplifier.
            self.end_switching_off()
        finally:
            if hold is not None:
                hold.release()
            self._node.news.grow()

    def end_switching_off(self) -> None:
        """Stop repeating the command to switch the amplifier off."""
        switching_off, self._switching_off = self._switching_off, None
        if switching_off is not None:
            switching_off.end()

    # --- called by the cycle and the node --------------------------------------------------

    def step(self, count: int, cycle: int, time_ns: int) -> int:
        """Process the count of this cycle, and return the output for it (6411h)."""
        servo = self.servo
        was_done = servo.is_done
        self.counted_ns = time_ns
        self.steps += 1
        raw = round(servo.step(count, cycle) * self._raw_per_ampere)
        if servo.is_done and not was_done:
            if self._moves:
                self.ended_ns = time_ns
            self._node.news.grow()
        if servo.lags:
            servo.lags = False
            behind = servo.demand - servo.position
            text = f"following error: {behind:.0f} increments"
            self._trip(Fault(FOLLOWING_ERROR, text, time_ns))
            return 0
        if servo.error is not None:
            self.failure, servo.error = servo.error, None
            self.slow_down(servo.deceleration)
        return _RAW_MAX if raw > _RAW_MAX else max(raw, -_RAW_MAX)

    def look(self, count: int) -> None:
        """Process a further count of one cycle."""
        self.servo.look(count)

    def begin(self, cycle: int) -> None:
        """Begin the armed course with the count of this cycle."""
        armed, self._armed = self._armed, None
        if armed is None or not self.is_powered:
            return
        self.failure = None
        self.started_ns = self.ended_ns = None
        self._moves = True
        try:
            self.servo.begin(*armed, cycle)
        except MotorError as error:  # no such motion from where the motor is now
            self.failure = error
            self.slow_down(self.servo.deceleration)

    def began(self, time_ns: int) -> None:
        """Record the time when the SYNC of the beginning was on the wire."""
        if self._moves:
            self.started_ns = time_ns

    def fail(self, error: MotorError) -> None:
        """End the control, as the cycle has failed."""
        self.failure = error
        is_lost = isinstance(error, MotorBusyError)  # taken over: not a fault
        if not self._node.is_lost and self._node.is_up and not is_lost:
            now_ns = self._io.link.runtime.now_ns()
            self.fault = Fault(COMMUNICATION, str(error), now_ns)
        self._cut_anyhow()

    def see_inputs(self, time_ns: int) -> None:
        """Evaluate digital inputs received from the node."""
        if self._switching_off is not None:
            self._switching_off.see(time_ns)
        status = self._io.status(self._channel)
        if not status & FAULT:
            self.amplifier_fault_ns = None
        elif self.amplifier_fault_ns is None:
            self.amplifier_fault_ns = time_ns
        if self.is_powered and not status & READY:
            text = "amplifier fault" if status & FAULT else "amplifier not ready"
            self._trip(Fault(AMPLIFIER_FAULT, text, time_ns))

    def _trip(self, fault: Fault) -> None:
        loss = None if self._hold is None else self._hold.loss
        if loss is None:
            self.fault = fault
        else:  # caused by the process that has taken the node over
            self.failure = loss.busy(self.physical.label)
        self._cut_anyhow()

    def _cut_anyhow(self) -> None:
        """Cut from a callback; a bus that accepts no frames is not a second error."""
        try:
            self.cut()
        except LinkError as error:
            if self.failure is None:
                self.failure = error
