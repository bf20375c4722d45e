"""A carriage on two wheels: it drives to two places, stops half-way at an obstacle, and rests."""

from contextlib import suppress

from motorhil.harness.swarm.properties import always, sometimes
from motorhil.motorapi import (
    ControlMode,
    DeadlineExceeded,
    DeviceFault,
    Motor,
    MotorError,
)
from motorhil.motorapi.state import MotorState
from tests.system.swarm.defects import correct, defect
from tests.system.swarm.defects.truth import Truth

RIG = "carriage.toml"
PLACES = (2.0, 1.4)  # [rad]
NEAR_RAD = 0.03
ALIGNED_RAD = 0.05
ALONE_S = 0.85  # a wheel may drive that long without the other, until both are stopped
LEG_S = 4.0  # time that a leg may take, whatever happens


class GivenUp(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """The mission cannot go on; the carriage stands."""


class Carriage:
    """Both wheels go together; each fault is logged once, and a leg is tried again."""

    def __init__(self, rig):
        self.rig, self.runtime = rig, rig.runtime
        self.truth = Truth(rig)
        self.group = rig.groups["both"]
        self.wheels = [rig.motors["left"], rig.motors["right"]]
        self.names = ["left", "right"]
        self.log = []  # names of motors, one for each fault that was read
        self.is_aligned = False
        self.deadline_ns = 0

    def run(self):
        """Make the mission, or give it up; then nothing moves."""
        try:
            self.prepare()
            for target in PLACES:
                self.leg(target)
            self.obstacle(2.4)
        except GivenUp:
            sometimes(True, "the mission is given up")
        self.runtime.run_for(0.7)
        self.truth.require_rest(self.names, "the carriage rests after its mission")
        self.rest()
        for name in self.names:
            always(self.truth.resets(name) <= self.log.count(name), "every fault is logged")
        always(self.truth.alone_s < ALONE_S, "no wheel drives alone")

    # --- what it does ----------------------------------------------------------------------------

    def prepare(self):
        """Enable both wheels."""
        try:
            self.group.for_each(Motor.enable)
        except MotorError as error:
            self.give_up(error)
        self.group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)

    def leg(self, target):
        """Drive to a place; try again after a fault, within the time of a leg."""
        begun_ns = self.runtime.now_ns()
        self.deadline_ns = begun_ns + round((LEG_S - 0.5) * 1e9)
        while True:
            try:
                self.go(target)
                self.arrived(target)
                break
            except DeviceFault as fault:
                self.recover(fault)
            except MotorError as error:
                self.give_up(error)
        took_s = (self.runtime.now_ns() - begun_ns) / 1e9
        always(took_s <= LEG_S, "a leg ends in time")

    def go(self, target):
        """Move both wheels, and wait for their end."""
        self.align()
        self.set_targets(target)
        self.start()
        self.group.wait_until_done(timeout_s=self.left_s())

    def set_targets(self, target):
        """Give both wheels the place as their target."""
        for wheel in self.wheels:
            wheel.set_setpoint(target)

    def start(self):
        """Start both wheels, which are aligned."""
        left, right = map(self.truth.position, self.names)
        always(abs(left - right) < 2 * ALIGNED_RAD, "wheels that start together are aligned")
        self.group.start()

    def align(self):
        """Bring the wheels beside each other again, if a failure has parted them."""
        places = [wheel.position() for wheel in self.wheels]
        if max(places) - min(places) > ALIGNED_RAD:
            sometimes(True, "the wheels are aligned")
            self.set_targets(sum(places) / 2)
            for wheel in self.wheels:
                wheel.start()
            self.group.wait_until_done(timeout_s=self.left_s())

    def arrived(self, target):
        """State that the wheels are where they should be; let passengers in."""
        for name in self.names:
            off = abs(self.truth.position(name) - target)
            always(off < NEAR_RAD, "an arrival is at the target")
        self.runtime.run_for(0.15)

    def obstacle(self, target):
        """Begin to drive, and stop half-way."""
        try:
            self.align()
            self.set_targets(target)
            self.start()
            self.runtime.run_for(0.25)
            self.stop_all()
        except MotorError as error:
            self.give_up(error)
        self.doors_open()

    def doors_open(self):
        """Open the doors, now that the carriage stands."""
        self.truth.require_rest(self.names, "doors open at rest")

    def recover(self, fault):
        """Stop, log the faults and reset them, once each."""
        sometimes(True, "a fault is reset")
        self.come_to_rest()
        if self.left_s() < 0.5:
            self.give_up(fault)
        try:
            for wheel in self.wheels:
                self.clear(wheel)
            self.group.for_each(Motor.enable)
        except MotorError as error:
            self.give_up(error)

    def clear(self, wheel):
        """Log the fault of a wheel, and reset it."""
        if wheel.fault() is not None:
            self.log.append(wheel.name)
            wheel.reset_fault()

    # --- how it stops ----------------------------------------------------------------------------

    def stop_all(self):
        """Stop, and wait for rest."""
        self.group.stop()
        self.group.wait_until_done(timeout_s=1.0)

    def come_to_rest(self):
        """Stop each wheel, whatever happens to the other."""
        for wheel in self.wheels:
            with suppress(MotorError):
                wheel.stop()
        for wheel in self.wheels:
            with suppress(MotorError):
                wheel.wait_until_done(timeout_s=1.0)

    def give_up(self, error):
        """Come to rest, and end the mission."""
        self.come_to_rest()
        raise GivenUp(str(error)) from error

    def rest(self):
        """Switch off; log what is left."""
        for wheel in self.wheels:
            with suppress(MotorError):
                if wheel.fault() is not None:
                    self.log.append(wheel.name)
                wheel.disable()

    def left_s(self):
        """Return the time left for this leg [s]."""
        return max(0.0, (self.deadline_ns - self.runtime.now_ns()) / 1e9)


carriage = correct(RIG)(Carriage)


# --- defects -------------------------------------------------------------------------------------


@defect(RIG, "always | the carriage rests after its mission", "always | a leg ends in time")
class StopsOneWheel(Carriage):
    """After a failure only the wheel that failed is stopped."""

    def come_to_rest(self):
        for wheel in self.wheels:
            with suppress(MotorError):
                if not wheel.is_done():
                    continue
            with suppress(MotorError):
                wheel.stop()
                wheel.wait_until_done(timeout_s=1.0)


@defect(RIG, "always | an arrival is at the target")
class RepeatsTheWholeWay(Carriage):
    """The way to a place is a distance; a try after a fault makes all of it again."""

    def go(self, target):
        before = 0.0 if target == PLACES[0] else PLACES[0]
        self.align()
        for wheel in self.wheels:
            wheel.set_setpoint(target - before, relative=True)
        self.start()
        self.group.wait_until_done(timeout_s=self.left_s())


@defect(RIG, "always | every fault is logged")
class HidesASecondFault(Carriage):
    """A reset is repeated until the drive has no fault; only the first fault is logged."""

    def clear(self, wheel):
        if wheel.fault() is not None:
            self.log.append(wheel.name)
        for _ in range(5):
            if wheel.fault() is None:
                return
            wheel.reset_fault()
            self.runtime.run_for(0.1)


@defect(RIG, "always | an arrival is at the target")
class SwallowsAnError(Carriage):
    """Errors of a motion are ignored: its end counts as an arrival."""

    def go(self, target):
        self.align()
        self.set_targets(target)
        self.start()
        with suppress(MotorError):
            self.group.wait_until_done(timeout_s=self.left_s())


@defect(RIG, "always | a leg ends in time")
class TimesAddUp(Carriage):
    """Each try has the time of the whole leg."""

    def go(self, target):
        self.deadline_ns = self.runtime.now_ns() + round((LEG_S - 0.5) * 1e9)
        super().go(target)


@defect(RIG, "always | no wheel drives alone")
class StartsWithoutTheOther(Carriage):
    """The wheels are started one by one, and one that fails does not hold back the other."""

    def go(self, target):
        error = None
        self.align()
        self.set_targets(target)
        for wheel in self.wheels:
            try:
                wheel.start()
            except MotorError as failed:
                error = failed
        self.group.wait_until_done(timeout_s=self.left_s())
        if error is not None:
            raise error


@defect(RIG, "always | an arrival is at the target")
class CallbackForgetsAFault(Carriage):
    """A callback counts each end of a motion as an arrival, whatever its outcome."""

    def go(self, target):
        ended = []
        self.align()
        self.set_targets(target)
        self.start()
        for wheel in self.wheels:
            wheel.on_done(ended.append)
        if not self.runtime.wait_until(lambda: len(ended) == 2, self.left_s()):
            raise DeadlineExceeded(awaited="both wheels", timeout_s=LEG_S, last_heard="")


@defect(RIG, "end | still runs")
class WaitsWithoutADeadline(Carriage):
    """After a reset, the program waits until the drive is enabled, however long."""

    def recover(self, fault):
        self.come_to_rest()
        if self.left_s() < 0.5:
            self.give_up(fault)
        for wheel in self.wheels:
            try:
                self.clear(wheel)
                with suppress(MotorError):
                    wheel.enable()
                while wheel.state() is not MotorState.ENABLED:
                    self.runtime.run_for(0.05)
            except MotorError as error:
                self.give_up(error)


@defect(RIG, "always | doors open at rest")
class OpensTheDoorsTooEarly(Carriage):
    """A stop that fails is not looked at: the doors open as if it had been done."""

    def stop_all(self):
        with suppress(MotorError):
            super().stop_all()


@defect(RIG, "always | every fault is logged")
class ResetsToBeSafe(Carriage):
    """Each leg begins with a reset, so a fault between legs is never seen."""

    def go(self, target):
        for wheel in self.wheels:
            wheel.reset_fault()
        super().go(target)


@defect(RIG, "always | wheels that start together are aligned")
class AlignsOnce(Carriage):
    """The wheels are aligned before the first leg only."""

    def align(self):
        if not self.is_aligned:
            super().align()
        self.is_aligned = True
