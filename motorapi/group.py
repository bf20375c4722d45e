"""Motor groups: several motors that start, wait and stop together.

Algorithm 2 of the paper runs nearly word for word::

    group = MotorGroup(motor1, motor2)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done()

A group predicts how closely its motors can begin and end together, and measures it afterwards.

Each start is supervised to its end, whether or not a caller waits. Supervision examines every
change of the motors, as `on_done` does, and sends its reaction from there without waiting. A motor
that must be polled reports only while a caller waits for it.

A motor fails when its motion ends short of its target although its owner did not request that: by a
fault, a lost link, another program, or a takeover. A stop of one motor affects that motor only. A
caller that waits for the group finds it short of its target, and then the group reacts as to a
fault. Motors stopped in reaction raise an interruption for callers that wait for one of them; a
caller that waits for the group gets the cause.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import replace
from typing import Final, final

from motorhil.motorapi.device import DeviceGroup
from motorhil.motorapi.errors import MotorError, UsageError
from motorhil.motorapi.execution import (
    Started,
    plan,
    start_together,
    stop_others,
    wait_for_all,
)
from motorhil.motorapi.logical_motor import LogicalMotor, check_timeout
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.outcome import callback_failed
from motorhil.motorapi.ownership.physical_motor import ActiveMotion
from motorhil.motorapi.ownership.reservation import Reservation
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.planning.groups import TIME, Common
from motorhil.motorapi.planning.path import PathWatch, predicted_path
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S, Registration
from motorhil.motorapi.synchronization.offer import Trigger
from motorhil.motorapi.synchronization.quality import (
    FaultReaction,
    PathDeviation,
    SyncCapability,
    Synchronization,
    SyncLevel,
    SyncQuality,
    check_asked,
    require_synchronised,
    spread_s,
)
from motorhil.motorapi.synchronization.skew import (
    Bound,
    Member,
    command_bound,
    end_bound,
    start_bound,
)
from motorhil.motorapi.trajectory import Trajectory

_LOG: Final = logging.getLogger("motorapi")
_TOLD: Final = {
    FaultReaction.TOGETHER: "the others of its group were stopped along the path",
    FaultReaction.EACH: "the others of its group were stopped",
    FaultReaction.NONE: "the others of its group continue",
}


@final
class _Watched:
    """A motor with its active motion of this start."""

    __slots__ = ("_common", "is_over", "motor", "run")

    def __init__(self, common: "CommonMotion", motor: LogicalMotor, run: ActiveMotion) -> None:
        self._common = common
        self.motor: Final = motor
        self.run: Final = run
        self.is_over: bool = False

    def look(self) -> None:
        """Examine the motor after a change."""
        self._common.look_at(self)

    def ended(self) -> bool:
        """Return True if the end of the motion is known."""
        return self.is_over

    def failure(self) -> MotorError | None:
        """Return the failure of the motion; None if it runs, is done, or its owner ended it."""
        run = self.run
        try:
            self.is_over = self.motor.look(run) and run.ends
        except MotorError as error:
            self.is_over = True
            # A takeover ends the motion before the new owner has begun its own.
            taken_over = self.motor.physical.run is run
            wanted = run.interrupted_by is not None and run.error is None and not taken_over
            return None if wanted else error
        return None


@final
class CommonMotion:
    """The motions of one start, supervised between `begin` and `end`.

    Args:
        started: the result of `start_together`.
        common: the common properties of the motions.

    Attributes:
        cause: the first failure and its motor, or None.
    """

    def __init__(self, started: Sequence[Started], common: Common) -> None:
        self.cause: tuple[LogicalMotor, MotorError] | None = None
        self._common: Final = common
        self._runtime: Final = started[0].motor.runtime
        self._watched: Final[list[_Watched]] = []
        for one in started:
            if one.motor.run is not None:
                self._watched.append(_Watched(self, one.motor, one.motor.run))
        self._timers: list[Registration] = []
        self._claim: Final[list[None]] = [
            None
        ]  # the finder of the first failure takes the only element
        self._ended = False
        self._answers: list[tuple[LogicalMotor, ActiveMotion]] = []
        self._path: PathWatch | None = None
        if common.synchronization is Synchronization.PHASE:
            self._path = PathWatch(started, self._after_look)

    def begin(self) -> None:
        """Examine every change from now on, and all motors now: one may have failed already."""
        if self._path is not None:
            self._path.begin()
        for one in self._watched:
            physical = one.motor.physical
            if physical.news is None:
                self._timers.append(self._runtime.every(LOOK_PERIOD_S, one.look))
            physical.bell.listeners.append(one.look)
        for one in tuple(self._watched):
            one.look()

    def end(self) -> None:
        """Stop the supervision; ending again does nothing."""
        self._fall_silent()
        if self._path is not None:
            self._path.end()

    @property
    def stops_together(self) -> bool:
        """True if the motors slow down along their path."""
        return self._common.reaction is FaultReaction.TOGETHER

    def path(self) -> tuple[PathDeviation, ...]:
        """Return the deviation of each motor from the common path; empty without a path."""
        return () if self._path is None else self._path.told()

    def look_at(self, one: _Watched) -> None:
        """Examine one motor, and react if it is the first to fail."""
        if one.is_over or self._ended:
            return
        error = one.failure()
        physical = one.motor.physical
        if one.ended() and physical.news is None:
            physical.bell.grow()  # no other source reports its end to the listeners
        if error is not None:
            self._fail(one.motor, error)
        elif all(other.is_over for other in self._watched):
            if self._path is not None:
                self._path.look()
            self.end()

    def watches(self, run: ActiveMotion | None) -> bool:
        """Return True if `run` belongs to this start."""
        return any(one.run is run for one in self._watched)

    def failed(self, motor: LogicalMotor, error: Exception) -> Exception:
        """React to a failure found by a waiting caller. Return the error that it should raise."""
        if not isinstance(error, MotorError):
            return error
        self._fail(motor, error)
        cause = self.cause
        if cause is None:  # another thread is reacting
            return error
        told = copy(cause[1])
        told.__cause__ = cause[1].__cause__
        return told

    def _fail(self, motor: LogicalMotor, error: MotorError) -> None:
        try:
            self._claim.pop()  # two threads may get here at once
        except IndexError:
            return
        self._fall_silent()
        if len(self._watched) > 1:
            error.add_note(f"from {motor.name}; {_TOLD[self._common.reaction]}")
        self.cause = (motor, error)
        if self._path is not None:
            self._path.leave(motor)
        self._answer(motor, error)
        if self._common.reaction is not FaultReaction.TOGETHER and self._path is not None:
            self._path.end()

    def _answer(self, failed: LogicalMotor, cause: MotorError) -> None:
        """Stop the other motors according to the fault reaction."""
        reaction = self._common.reaction
        if reaction is FaultReaction.NONE:
            return
        by = f"the fault reaction of its group ({cause})"
        triggers: list[tuple[LogicalMotor, Trigger]] = []
        for one in self._watched:
            motor = one.motor
            if motor is failed or not motor.goes_on(one.run):
                continue
            try:
                self._stop(motor, by, triggers)
            except Exception as further:
                self._not_stopped(motor, cause, further)
        for motor, trigger in triggers:
            try:
                motor.hooks.fire(trigger)
            except Exception as further:
                self._not_stopped(motor, cause, further)

    def _stop(
        self, motor: LogicalMotor, by: str, triggers: list[tuple[LogicalMotor, Trigger]]
    ) -> None:
        """Stop the motor, or add its trigger; its motion ends, interrupted by the group."""
        physical = motor.physical
        with physical.interrupt(motor.name):
            status = motor.status()
            if self._common.reaction is FaultReaction.TOGETHER:
                add_trigger(triggers, motor)
            else:
                motor.hooks.stop()
            run = ActiveMotion(by, motor, self._runtime.now_ns(), None)
            physical.begin(run, status)
            motor.keep()
        self._answers.append((motor, run))

    def _not_stopped(self, motor: LogicalMotor, cause: MotorError, further: Exception) -> None:
        cause.add_note(f"but {motor.name} could not be stopped: {further}")
        _LOG.error("%s could not be stopped after %s: %s", motor.name, cause, further)

    def _fall_silent(self) -> None:
        self._ended = True
        for timer in self._timers:
            timer.cancel()
        for one in self._watched:
            listeners = one.motor.physical.bell.listeners
            if one.look in listeners:
                listeners.remove(one.look)

    def _after_look(self) -> None:
        """End the supervision of the path when all motors are at rest."""
        if self._answers and not any(motor.goes_on(run) for motor, run in self._answers):
            self.end()


def add_trigger(triggers: list[tuple[LogicalMotor, Trigger]], motor: LogicalMotor) -> None:
    """Stop the motor, or add its trigger to the list, which holds each trigger once."""
    trigger = motor.hooks.stop_with_others()
    if trigger is not None and all(trigger != known for _, known in triggers):
        triggers.append((motor, trigger))


def capability_of(motors: Sequence[LogicalMotor], common: Common = TIME) -> SyncCapability:
    """Return how closely together `motors` can begin and end with the present settings.

    Args:
        motors: motors of one runtime.
        common: the common properties of their motions.

    Raises:
        MotorError: a motor does not answer.
    """
    with ExitStack() as passages:
        for motor in motors:
            passages.enter_context(motor.physical.passage(motor.name))
        return _capability(motors, common)


def _capability(motors: Sequence[LogicalMotor], common: Common) -> SyncCapability:
    for motor in motors:
        motor.hooks.connect()
    offers = [motor.hooks.sync_offer() for motor in motors]  # only when all are connected
    weakest = min(range(len(offers)), key=lambda place: offers[place].level)
    level, reason = offers[weakest].level, offers[weakest].reason
    for place, offer in enumerate(offers):
        if offer.group != offers[0].group and level is not SyncLevel.SEQUENTIAL:
            level, weakest = SyncLevel.SEQUENTIAL, place
            reason = f"it has another trigger ({offer.group}) than {motors[0].name}"
    durations, not_planned = _durations_s(motors, common)
    members = [
        Member(motor.name, offer, duration_s)
        for motor, offer, duration_s in zip(motors, offers, durations, strict=True)
    ]
    command = command_bound(members)
    start = start_bound(members, command)
    end = Bound(None, not_planned) if not_planned else end_bound(members, start)
    return SyncCapability(
        level=level,
        command_skew_s=command.value_s,
        start_skew_s=start.value_s,
        end_skew_s=end.value_s,
        weakest=motors[weakest].name,
        reason=reason,
        no_command_bound=command.reason,
        no_start_bound=start.reason,
        no_end_bound=end.reason,
    )


def quality_of(started: Sequence[Started]) -> SyncQuality:
    """Return how closely a start began and ended together; times still to come are None.

    Raises:
        MotorError: a motor does not answer.
    """
    times = tuple((one.motor.name, one.motor.hooks.motion_times()) for one in started)
    known = [its for one, (_, its) in zip(started, times, strict=True) if not stays(one)]
    offers = [one.motor.hooks.sync_offer() for one in started]
    members = [
        Member(one.motor.name, offer, None)
        for one, offer in zip(started, offers, strict=True)
        if not stays(one)
    ]
    return SyncQuality(
        predicted_start_skew_s=start_bound(members, command_bound(members)).value_s,
        predicted_end_skew_s=end_skew_s(started),
        start_skew_s=spread_s([None if its is None else its.started_ns for its in known]),
        end_skew_s=spread_s([None if its is None else its.ended_ns for its in known]),
        times=times,
        command_skew_s=spread_s([None if its is None else its.latched_ns for its in known]),
        straddles=max((0 if its is None else its.straddles for its in known), default=0),
    )


def stays(one: Started) -> bool:
    """Return True if the motor is at its target within the resolution: it cannot end late."""
    motion = one.motion
    return (
        motion.trajectory is not None and motion.function is None and one.quantised.distance == 0.0
    )


def end_skew_s(started: Sequence[Started]) -> float:
    """Return the time between the ends of the quantised profiles [s], without motors at rest."""
    durations_s = [
        planning.duration_of(one.quantised)
        for one in started
        if one.motion.duration_s is not None and not stays(one)
    ]
    return max(durations_s) - min(durations_s) if durations_s else 0.0


def _durations_s(motors: Sequence[LogicalMotor], common: Common) -> tuple[list[float | None], str]:
    """Return the quantised duration of each motor [s], and why no start is possible, or "".

    A duration is None if the motion does not end by itself.
    """
    try:
        motions = plan(motors, common)
    except UsageError as error:
        return [None for _ in motors], f"no start is possible now: {error}"
    durations: list[float | None] = []
    for motor, motion in zip(motors, motions, strict=True):
        one = Started(motor, motion, motor.hooks.quantise(motion))
        ends = motion.duration_s is not None and not stays(one)
        durations.append(planning.duration_of(one.quantised) if ends else None)
    return durations, ""


class MotorGroup(DeviceGroup[Motor]):
    """Any number of motors that are started, awaited and stopped together."""

    def __init__(self, *motors: Motor) -> None:
        self._started: tuple[Started, ...] = ()
        self._common = TIME
        self._motion: CommonMotion | None = None
        self._observer: Callable[[SyncQuality], None] | None = None
        super().__init__(*motors)

    def _check_member(self, device: Motor) -> None:
        for member in self:
            if member.logical.physical is device.logical.physical:
                raise UsageError(
                    f"{device.name} and {member.name} are the same physical motor,"
                    f" {device.logical.physical.label}: a group can move it only once"
                )
            if member.runtime is not device.runtime:
                raise UsageError(
                    f"{device.name} and {member.name} live in different runtimes: they share "
                    "no time at which to begin"
                )

    def set_trajectory(self, *trajectories: Trajectory) -> None:
        """Set the trajectory of each motor, in the order of appending; all of them or none.

        If one is refused, the former commands of all are discarded: start() then refuses, too.

        Raises:
            UsageError: the number of trajectories is not that of motors, or one is impossible.
        """
        try:
            if len(trajectories) != len(self):
                raise UsageError(
                    f"{len(trajectories)} trajectories for {len(self)} motors: give one for each"
                )
            for motor, trajectory in zip(self, trajectories, strict=True):
                motor.set_trajectory(trajectory)
        except MotorError:
            for motor in self:
                motor.logical.command = None
            raise

    @property
    def synchronization(self) -> Synchronization:
        """The synchronization of the trajectories from the next start on; TIME by default.

        TIME: they begin and end together, each with its own ramps. PHASE: a straight line in joint
        space, with proportional velocities and equal times of acceleration. NONE: they begin
        together, and each is as fast as possible.
        """
        return self._common.synchronization

    @synchronization.setter
    def synchronization(self, synchronization: Synchronization) -> None:
        if not isinstance(synchronization, Synchronization):
            raise UsageError(f"synchronization = {synchronization!r}: give a Synchronization")
        self._common = replace(self._common, synchronization=synchronization)

    @property
    def fault_reaction(self) -> FaultReaction:
        """The reaction of the others to a failure from the next start on; EACH by default.

        TOGETHER: they slow down along the path, at the same instant and in proportion; this
        requires PHASE. EACH: each slows down as its own limit allows. NONE: they continue. The
        reaction does not depend on a waiting caller. A motor fails by a fault, a lost link, another
        program, or a takeover. A stop of one motor stops that motor, and the others if a caller
        waits for the group. A caller that waits for a motor stopped in reaction gets
        `MotionInterrupted`, a caller that waits for the group gets the cause. With TOGETHER, `stop`
        of the group follows the path, too.
        """
        return self._common.reaction

    @fault_reaction.setter
    def fault_reaction(self, reaction: FaultReaction) -> None:
        if not isinstance(reaction, FaultReaction):
            raise UsageError(f"fault_reaction = {reaction!r}: give a FaultReaction")
        self._common = replace(self._common, reaction=reaction)

    def start(
        self,
        timeout_s: float | None = None,
        *,
        require: SyncLevel | None = None,
        max_skew_s: float | None = None,
    ) -> None:
        """Start the commands of all motors, synchronised as `synchronization` says.

        They are as fast as the slowest of them allows, or have the duration of one of their
        trajectories. All are armed and confirmed before the first is fired. If one refuses, no
        motor moves; if one fails to begin, all are stopped.

        Args:
            timeout_s: timeout until all are free [s], as in `Motor.start`.
            require: the minimum level of their common start; None: any level.
            max_skew_s: maximum time between the first and the last start of motion [s], guaranteed
                in advance; None: no requirement.

        Raises:
            SynchronizationError: `require` or `max_skew_s` cannot be met; names the motor and the
                reason. No motor was armed.
            MotorError: as `Motor.start`; a note on the error names the motor.
        """
        check_asked(require, max_skew_s)
        members, common = self._members(), self._common
        common.check()

        def check() -> None:
            if require is not None or max_skew_s is not None:
                require_synchronised(capability_of(members, common), require, max_skew_s)

        started = start_together(members, timeout_s, common, check)
        self._end_motion()
        self._started = started
        self._motion = CommonMotion(started, common)
        self._motion.begin()

    @contextmanager
    def reserve(
        self,
        purpose: str = "",
        *,
        timeout_s: float | None = None,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> Iterator[Reservation]:
        """Reserve all motors for several motions, or none: `with group.reserve("survey"):`.

        They are acquired one after another, in the same order in all programs. So groups that share
        motors wait for each other without deadlock. See `Motor.reserve`.

        Raises:
            MotorBusyError: another owner holds one of them.
        """
        timeout_s = check_timeout(timeout_s)
        self._members()
        motors = sorted(self, key=lambda motor: motor.logical.physical.order)
        asked_ns = motors[0].runtime.now_ns()
        parts: list[Reservation] = []
        with ExitStack() as held:
            for motor in motors:
                left_s: float | None = None
                if timeout_s is not None:
                    left_s = max(0.0, timeout_s - (motor.runtime.now_ns() - asked_ns) / 1e9)
                reserved = motor.reserve(
                    purpose, timeout_s=left_s, lease_s=lease_s, take_over=take_over
                )
                parts.append(held.enter_context(reserved))
            yield Reservation.of_all(parts)

    def wait_until_done(self, timeout_s: float | None = None) -> None:
        """Wait until the last command of every motor has ended. See `fault_reaction` for failures.

        Raises:
            DeadlineExceeded: not within `timeout_s` [s]; names the motors that are not done.
            MotorError: as `Motor.wait_until_done`.
        """
        wait_for_all(self._members(), timeout_s, self._answer)
        if self._observer is not None and self._started:
            quality = self.sync_quality()
            try:
                self._observer(quality)
            except MotorError:
                raise
            except Exception as error:
                names = ", ".join(motor.name for motor in self)
                raise callback_failed(self._observer, f"observer of {names}", error) from error

    def observe(self, told: Callable[[SyncQuality], None]) -> None:
        """Call `told` with the quality of each start, after it was awaited."""
        self._observer = told

    def is_done(self) -> bool:
        """Return True if `wait_until_done` would return at once; raises as it does."""
        done: list[bool] = []
        for motor in self:  # every member is examined, and may raise
            try:
                done.append(motor.is_done())
            except MotorError as error:
                told = self._answer(motor.logical, motor.logical.run, error)
                raise told from told.__cause__
        return all(done)

    def stop(self) -> None:
        """Stop every motor; all are tried, then the first error is raised.

        Motors with a common stop along their path (`fault_reaction`) stop along it.
        """
        motion = self._motion
        self._end_motion()
        if motion is None or not motion.stops_together:
            self._every(Motor.stop)
            return
        triggers: list[tuple[LogicalMotor, Trigger]] = []

        def stop(motor: Motor) -> None:
            logical = motor.logical
            logical.bring_to_rest("stop", lambda: add_trigger(triggers, logical))

        self._every(stop)
        for motor, trigger in triggers:
            motor.hooks.fire(trigger)

    def quick_stop(self) -> None:
        """Quick-stop every motor; all are tried, then the first error is raised."""
        self._end_motion()
        self._every(Motor.quick_stop)

    def halt(self) -> None:
        """Halt every motor; all are tried, then the first error is raised."""
        self._end_motion()
        self._every(Motor.halt)

    def sync_capability(self) -> SyncCapability:
        """Return how closely these motors can begin and end together with the present settings.

        Raises:
            MotorError: a motor does not answer.
        """
        members, common = self._members(), self._common
        capability = capability_of(members, common)
        if common.synchronization is not Synchronization.PHASE:
            return capability
        try:
            return replace(capability, path=predicted_path(members, plan(members, common)))
        except UsageError:
            return capability  # no start is possible now

    def sync_quality(self) -> SyncQuality:
        """Return how closely the last start began and ended together; unknown times are None.

        Raises:
            UsageError: the group was never started.
        """
        if not self._started:
            raise UsageError("the group has not been started: it has no synchronization quality")
        quality = quality_of(self._started)
        return quality if self._motion is None else replace(quality, path=self._motion.path())

    def _end_motion(self) -> None:
        """End the supervision of the motors."""
        if self._motion is not None:
            self._motion.end()

    def _answer(self, motor: LogicalMotor, run: ActiveMotion | None, error: Exception) -> Exception:
        """React to the failure of a member in `run`. Return the error to be raised."""
        if self._motion is not None and self._motion.watches(run):
            return self._motion.failed(motor, error)
        if self.fault_reaction is not FaultReaction.NONE:
            stop_others(self._members(), motor, error)
        return error

    def _members(self) -> tuple[LogicalMotor, ...]:
        if not len(self):
            raise UsageError("the group is empty: append a motor first")
        return tuple(motor.logical for motor in self)

    def _every(self, method: Callable[[Motor], None]) -> None:
        first: MotorError | None = None
        for motor in self:
            try:
                method(motor)
            except MotorError as error:
                error.add_note(f"from {motor.name}")
                if first is None:
                    first = error
                else:
                    first.add_note(f"and {motor.name}: {error}")
        if first is not None:
            raise first
