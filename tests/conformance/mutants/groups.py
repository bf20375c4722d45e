"""Mistakes with synchronised motors."""

from contextlib import contextmanager, suppress
from dataclasses import replace
from unittest.mock import patch

from motorhil.motorapi import MotorGroup, Synchronization, execution, group
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.host_servo.axis import ServoAxis
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.errors import MotorError, UsageError
from motorhil.motorapi.group import CommonMotion
from motorhil.motorapi.ownership.reservation import Reservation
from motorhil.motorapi.planning.path import PathWatch
from tests.conformance.mutants import mutant, replaced
from tests.support.sharing.mutants import a_group_that_starts_before_all_are_armed


@mutant("cia402", "SYNC-01")
def started_before_all_are_armed():
    """Each member is started as soon as it is armed."""
    with a_group_that_starts_before_all_are_armed():
        yield


@mutant("cia402", "SYNC-02")
def times_in_microseconds():
    """Start and end times are reported in microseconds."""

    def wrong(times):
        def told(motor):
            found = times(motor)
            if found is None or found.ended_ns is None:
                return found
            return replace(
                found, started_ns=found.started_ns // 1000, ended_ns=found.ended_ns // 1000
            )

        return told

    with replaced(Cia402Motor, "_motion_times", wrong):
        yield


def _unsynchronised(which, instead):
    def wrong(synchronised):
        def planned(motors, motions, common):
            if common.synchronization is which:
                return instead(synchronised, motors, motions, common)
            return synchronised(motors, motions, common)

        return planned

    return replaced(execution, "synchronised", wrong)


@mutant("cia402", "SYNC-03")
def each_as_fast_as_it_can():
    """The members start together, but do not take the same time."""
    with _unsynchronised(Synchronization.TIME, lambda _, motors, motions, common: motions):
        yield


@mutant("cia402", "SYNC-08")
def a_line_that_is_none():
    """Motors in phase synchronization start and end together, each with its own ramps."""

    def timed(synchronised, motors, motions, common):
        return synchronised(motors, motions, replace(common, synchronization=Synchronization.TIME))

    with _unsynchronised(Synchronization.PHASE, timed):
        yield


@mutant("ideal", "SYNC-04")
def done_when_the_first_is():
    """A group is done as soon as one of its motors is."""

    def wrong(_):
        return lambda motors: any(motor.is_done() for motor in motors)

    with replaced(MotorGroup, "is_done", wrong):
        yield


@mutant("software", "SYNC-04")
def a_stop_forgets_all_but_the_first():
    """Operations on all members end after the first one."""

    def wrong(_):
        return lambda motors, method: method(next(iter(motors)))

    with replaced(MotorGroup, "_every", wrong):
        yield


@mutant("cia402", "SYNC-06")
def armed_for_ever():
    """A failed start leaves members armed: the next SYNC starts them."""
    with replaced(Cia402Motor, "_disarm", lambda _: lambda motor: None):
        yield


@mutant("cia402", "SYNC-06")
def not_confirmed():
    """The drives' acknowledgement of their start is not checked."""
    with replaced(Cia402Motor, "_confirm", lambda _: lambda motor, motion: None):
        yield


@mutant("leadshine", "SYNC-07")
def starts_whatever_was_asked():
    """The requirements of a start are not compared with the motors' capability."""
    with replaced(group, "require_synchronised", lambda _: lambda *_args: None):
        yield


@mutant("ideal", "SYNC-09")
def the_others_go_on():
    """The failure of one member does not stop the others."""
    with replaced(CommonMotion, "_answer", lambda _: lambda motion, motor, cause: None):
        yield


@mutant("cia402", "SYNC-09")
def supervised_while_waited_for():
    """A failed member stops the others only while a caller waits for the group."""
    with replaced(CommonMotion, "begin", lambda _: lambda motion: None):
        yield


@mutant("software", "SYNC-09")
def a_fault_of_one_is_swallowed():
    """A wait for a group ignores the members that have failed."""

    def wrong(wait):
        def waited(motors, timeout_s=None):
            try:
                wait(motors, timeout_s)
            except MotorError:
                return

        return waited

    with replaced(MotorGroup, "wait_until_done", wrong):
        yield


@mutant("cia402", "SYNC-02")
def times_of_the_drives_own_clock():
    """Start and end times are those of the drive's clock, which began at its boot-up."""

    def wrong(times):
        def told(motor):
            found = times(motor)
            if found is None or found.ended_ns is None:
                return found
            return replace(
                found,
                started_ns=found.started_ns - 200_000_000,
                ended_ns=found.ended_ns - 200_000_000,
            )

        return told

    with replaced(Cia402Motor, "_motion_times", wrong):
        yield


@mutant("ideal", "SYNC-04")
def a_stop_of_a_group_ends_with_the_first_error():
    """If one member cannot be stopped, those behind it are not tried."""

    def wrong(_):
        def every(self, method):
            for motor in self:
                method(motor)

        return every

    with replaced(MotorGroup, "_every", wrong):
        yield


@mutant("cia402", "SYNC-06")
def others_go_on_after_a_failed_start():
    """A start of which one member fails is given up, and the others make their motions."""

    def wrong(abandon):
        return lambda started, runs, error: execution._disarm(started, error)

    with replaced(execution, "_abandon", wrong):
        yield


@mutant("software", "SYNC-02")
def an_end_outlives_its_motion():
    """The end of a motion is reported until the next one has ended."""

    def wrong(begin):
        def begun(self, cycle):
            ended_ns = self.ended_ns
            begin(self, cycle)
            self.ended_ns = ended_ns

        return begun

    with replaced(ServoAxis, "begin", wrong):
        yield


@mutant("ideal", "SYNC-02")
def a_stop_hides_all_later_ends():
    """After a motion that was stopped, no end is reported any more."""

    def wrong(begin):
        def begun(self, now_ns):
            was_cut_short = self._cut_short
            begin(self, now_ns)
            self._cut_short = was_cut_short

        return begun

    with replaced(IdealHwMotor, "begin", wrong):
        yield


@mutant("cia402", "SYNC-10")
def all_have_ended_when_the_last_has():
    """The end of a motion is the time at which it is asked for."""

    def wrong(times):
        def told(motor):
            found = times(motor)
            if found is None or found.ended_ns is None:
                return found
            return replace(found, ended_ns=motor.runtime.now_ns())

        return told

    with replaced(Cia402Motor, "_motion_times", wrong):
        yield


@mutant("cia402", "SYNC-11")
def each_by_a_frame_of_its_own():
    """One signal is claimed, but each member is started, and acknowledged, before the next."""

    class Acknowledged:
        def __init__(self, motor, trigger):
            self.motor, self.trigger = motor, trigger

        def fire(self):
            self.trigger.fire()
            self.motor.runtime.wait_until(lambda: False, 0.002)

    def wrong(arm):
        def armed(motor, motion, *, together):
            trigger = arm(motor, motion, together=False)
            return Acknowledged(motor, trigger) if together else trigger

        return armed

    with replaced(Cia402Motor, "_arm", wrong):
        yield


@mutant("leadshine", "SYNC-12")
def who_can_start_starts():
    """If one member is refused, the others are started; the error names the one."""

    def wrong(start):
        def started(motors, timeout_s=None, *args, **options):
            try:
                return start(motors, timeout_s, *args, **options)
            except UsageError:
                for motor in motors if len(motors) > 1 else ():
                    with suppress(MotorError):
                        start((motor,), timeout_s)
                raise

        return started

    with replaced(group, "start_together", wrong):
        yield


@mutant("cia402", "SYNC-12")
def armed_for_good():
    """A member that was armed before another one was refused stays armed."""
    with replaced(Cia402Motor, "_disarm", lambda disarm: lambda motor: None):
        yield


@mutant("cia402", "SYNC-19")
def when_a_stream_began():
    """The time when a stream began is not kept."""
    with replaced(CspStream, "_began", lambda began: lambda stream, time_ns: None):
        yield


@mutant("ideal", "SYNC-13")
def a_deviation_that_is_the_last():
    """The deviation from the path is that of the last look, and not the largest."""

    def wrong(compare):
        def forgetful(watch, at_ns):
            watch._worst.clear()
            compare(watch, at_ns)

        return forgetful

    with replaced(PathWatch, "_compare", wrong):
        yield


@mutant("ideal", "SYNC-14")
def a_group_that_keeps_its_commands():
    """After refused trajectories, members keep the commands before them."""

    def wrong(set_trajectory):
        def kept(motors, *trajectories):
            before = [motor.logical.command for motor in motors]
            try:
                set_trajectory(motors, *trajectories)
            except MotorError:
                for motor, command in zip(motors, before, strict=True):
                    motor.logical.command = command
                raise

        return kept

    with replaced(MotorGroup, "set_trajectory", wrong):
        yield


@mutant("ideal", "SYNC-15")
def a_reservation_held_by_its_first_member():
    """A reservation of a group is held as long as that of its first member."""
    first = property(lambda reservation: reservation.claims[0].is_held)
    with patch.object(Reservation, "is_held", first):
        yield


@mutant("ideal", "SYNC-16")
def a_failure_without_a_name():
    """The error of a member that was started alone does not name it."""

    def wrong(stop_others):
        def nameless(motors, failed, error):
            stop_others(motors, failed, error)
            error.__notes__.clear()

        return nameless

    with replaced(group, "stop_others", wrong):
        yield


@mutant("ideal", "SYNC-17")
def a_common_stop_of_each_alone():
    """Members that should stop along their path stop one by one, each as fast as it can."""

    def one_by_one(_):
        def stop(motors):
            motors._end_motion()
            for motor in motors:
                motor.quick_stop()

        return stop

    with replaced(MotorGroup, "stop", one_by_one):
        yield


@mutant("ideal", "SYNC-18")
def an_observer_that_is_told_twice():
    """An observer is told of each start twice."""

    def wrong(observe):
        def twice(motors, told):
            observe(motors, lambda quality: (told(quality), told(quality)))

        return twice

    with replaced(MotorGroup, "observe", wrong):
        yield


@mutant("dryve", "SYNC-21")
def programs_with_an_order_of_their_own():
    """A group takes its members in its own order: those of two programs block each other."""

    def wrong(reserve):
        @contextmanager
        def reserved(group, *args, **options):
            for place, motor in enumerate(group):
                motor.logical.physical.order = ("", "", place)
            with reserve(group, *args, **options) as reservation:
                yield reservation

        return reserved

    with replaced(MotorGroup, "reserve", wrong):
        yield
