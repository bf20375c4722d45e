"""Mistakes in stops, and in the state that they leave."""

from contextlib import contextmanager
from dataclasses import replace

from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.adaptations.ideal.profiles import Held
from motorhil.motorapi.adaptations.leadshine import hardware as leadshine_hardware
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.state import MotorState
from tests.conformance.mutants import motions_changed, mutant, replaced


@mutant("software", "STOP-09")
def no_power_is_taken_for_rest():
    """A stop of a motor without power is done at once, although it coasts."""
    with replaced(LogicalMotor, "coasts", lambda coasts: lambda self, run: False):
        yield


def power_off_at_rest(self):
    """Switch the power off when the motor has slowed down to rest."""
    hardware = self.hardware
    hardware.slow_down(self.model.deceleration)
    course = hardware._course

    def look():
        if hardware._course is not course or hardware._armed is not None:
            timer.cancel()
        elif hardware.is_over:
            timer.cancel()
            hardware._power = MotorState.DISABLED

    timer = hardware.runtime.every(0.01, look)


def plain_stop(self):
    self.hardware.slow_down(self.model.deceleration)


@contextmanager
def only(name, wrong):
    """Return a change of one kind of stop; the others are unchanged."""
    with (
        replaced(IdealMotor, "_stop", lambda stop: wrong if name == "_stop" else stop),
        replaced(IdealMotor, "_halt", lambda halt: wrong if name == "_halt" else plain_stop),
    ):
        yield


@mutant("ideal", "STOP-01")
def a_stop_lets_go():
    """A stopped motor is disabled at rest, to save current."""
    with only("_stop", power_off_at_rest):
        yield


@mutant("ideal", "STOP-02")
def a_halt_lets_go():
    """A halted motor is disabled at rest, to save current."""
    with only("_halt", power_off_at_rest):
        yield


@mutant("leadshine", "STOP-03")
def a_quick_stop_is_a_stop():
    """A quick stop is made as a normal stop: the next start moves the motor."""
    with replaced(
        LeadshineHwMotor, "post_stop", lambda post: lambda self, quick: post(self, quick=False)
    ):
        yield


@mutant("ideal", "STOP-04")
def a_stop_as_hard_as_can_be():
    """A stop decelerates ten times as fast as the model allows."""

    def hard(self):
        self.hardware._motion = None
        self.hardware.slow_down(10.0 * self.model.deceleration)

    with only("_stop", hard):
        yield


@mutant("ideal", "STOP-05")
def a_halt_ends_profiles_only():
    """A halt ends position profiles only, and otherwise does nothing."""

    def wrong(self):
        motion = self.hardware._motion
        if motion is None or motion.variable is not ControlVariable.VELOCITY:
            plain_stop(self)

    with only("_halt", wrong):
        yield


@mutant("ideal", "STOP-06")
def a_second_stop_lifts_the_first():
    """The stop bit is toggled: a second stop before rest lets the motor continue."""

    def wrong(self):
        hardware = self.hardware
        stops = getattr(hardware, "stopping", None)
        if stops is not None and stops[0] is hardware._course and not hardware.is_over:
            course, motion = stops[1]
            hardware._take(course, motion)
            return
        before = hardware._course, hardware._motion
        plain_stop(self)
        hardware.stopping = hardware._course, before

    with only("_stop", wrong):
        yield


@mutant("ideal", "STOP-07")
def a_stopped_target_is_not_sent_again():
    """A target equal to the previous one is not sent, even after a stop."""
    before = {}

    def wrong(motor, motion):
        aims = (motion.mode, motion.variable) == (ControlMode.SETPOINT, ControlVariable.POSITION)
        target = motion.target if aims else None
        known, before[motor] = before.get(motor), target
        return replace(motion, target=motion.start) if aims and known == target else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "STOP-08")
def enabling_resumes():
    """A disabled motion remains in the drive: when enabled, the motor continues to its target."""

    def off(disable):
        def disabled(self):
            self.kept = None if self.is_over else self._motion
            disable(self)

        return disabled

    def on(enable):
        def enabled(self):
            enable(self)
            kept = getattr(self, "kept", None)
            if kept is not None:
                self.kept = None
                self._take(Held(self.runtime.now_ns(), kept.target), None)

        return enabled

    with replaced(IdealHwMotor, "disable", off), replaced(IdealHwMotor, "enable", on):
        yield


@mutant("ideal", "STOP-01", "STOP-02", "STOP-04", "STOP-06")
def a_stop_does_nothing():
    """A stop is reported as done, but the motion continues."""
    with replaced(IdealMotor, "_stop", lambda stop: lambda self: None):
        yield


@mutant("leadshine", "STOP-10")
def a_stop_asks_first():
    """A stop reads the status of the drive first, and so cannot be called from a callback."""

    def wrong(post):
        def stopped(self, quick):
            self.poll_before_stop = self.registers.read(leadshine_hardware._STATUS)
            return post(self, quick)

        return stopped

    with replaced(LeadshineHwMotor, "post_stop", wrong):
        yield


@mutant("cia402", "STOP-11")
def the_halt_is_lifted_before_the_new_target():
    """A start lifts the halt before it sends its target, so the old one counts for a moment."""

    def wrong(arm):
        def armed(motor, motion, *, together):
            hardware = motor.hardware
            can_id = hardware.facts.control_id
            frame = can_id.to_bytes(4, "little") + bytes((2, 0, 0, 0, 0x0F, 0)) + bytes(6)
            hardware.link.send_tracked(frame, None)
            motor.runtime.wait_until(lambda: False, 0.05)
            return arm(motor, motion, together=together)

        return armed

    with replaced(Cia402Motor, "_arm", wrong):
        yield


@mutant("ideal", "STOP-11")
def back_to_where_it_was_stopped():
    """A stop aims at the position at the time of the stop, so the motor overshoots and returns."""

    def wrong(self):
        hardware = self.hardware
        place = hardware.reading().position
        plain_stop(self)
        course = hardware._course

        def look():
            if hardware._course is not course:
                timer.cancel()
            elif hardware.is_over:
                timer.cancel()
                hardware._take(Held(self.runtime.now_ns(), place), None, quietly=True)

        timer = hardware.runtime.every(0.01, look)

    with only("_stop", wrong):
        yield
