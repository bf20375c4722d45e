"""Motors that move together.

Algorithm 2 of the paper runs nearly word for word::

    group = MotorGroup(motor1, motor2)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done()
"""

# ruff: noqa: SLF001 -- a group works the hooks of its members, as Motor does its own

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from motorapi.capability import capability_of, quality_of
from motorapi.commands import as_number
from motorapi.common_motion import CommonMotion, add_trigger
from motorapi.device import DeviceGroup
from motorapi.errors import MotorError, UsageError
from motorapi.execution import Started, plan, start_together
from motorapi.group_planning import TIME
from motorapi.motion_waits import check_timeout, stop_others, wait_for_all
from motorapi.motor import Motor
from motorapi.outcome import callback_failed
from motorapi.path import predicted_path
from motorapi.reservation import Reservation
from motorapi.sharing import Run
from motorapi.start_conditions import check_asked, require_synchronised
from motorapi.synchronization import (
    FaultReaction,
    SyncCapability,
    Synchronization,
    SyncLevel,
    SyncQuality,
    Trigger,
)
from motorapi.trajectory import Trajectory


class MotorGroup(DeviceGroup[Motor]):
    """An arbitrary number of motors that are started, waited for and stopped as one."""

    def __init__(self, *motors: Motor) -> None:
        self._started: tuple[Started, ...] = ()
        self._common = TIME
        self._motion: CommonMotion | None = None
        self._observer: Callable[[SyncQuality], None] | None = None
        super().__init__(*motors)

    def _check_member(self, device: Motor) -> None:
        for member in self:
            if member._physical is device._physical:
                raise UsageError(
                    f"{device.name} and {member.name} are the same physical motor,"
                    f" {device._physical.label}: a group can move it only once"
                )
            if member.runtime is not device.runtime:
                raise UsageError(
                    f"{device.name} and {member.name} live in different runtimes:"
                    " they have no common time to begin at"
                )

    def set_trajectory(self, *trajectories: Trajectory) -> None:
        """Each motor's trajectory is set, in the order of appending; all of them or none.

        Raises:
            UsageError: there are not as many as motors, or one cannot be made.
        """
        if len(trajectories) != len(self):
            raise UsageError(
                f"{len(trajectories)} trajectories for {len(self)} motors: give one for each"
            )
        before = [(motor._command, motor._argument) for motor in self]
        try:
            for motor, trajectory in zip(self, trajectories, strict=True):
                motor.set_trajectory(trajectory)
        except MotorError:
            for motor, command in zip(self, before, strict=True):
                motor._command, motor._argument = command
            raise

    @property
    def synchronization(self) -> Synchronization:
        """What the trajectories have in common, from the next start on; TIME unless set.

        TIME: they begin and end together, each with its own ramps. PHASE: a straight line in the
        space of the joints, with proportional velocities and equal times of acceleration. NONE:
        they begin together, and each is as fast as it can be.
        """
        return self._common.synchronization

    @synchronization.setter
    def synchronization(self, synchronization: Synchronization) -> None:
        if not isinstance(synchronization, Synchronization):
            raise UsageError(f"synchronization = {synchronization!r}: give a Synchronization")
        self._common = replace(self._common, synchronization=synchronization)

    @property
    def fault_reaction(self) -> FaultReaction:
        """What the others do when one motor fails, from the next start on; EACH unless set.

        TOGETHER: they slow down along the path, at the same instant and in proportion; it needs
        PHASE. EACH: each slows down as its own limit allows. NONE: they go on. It happens whether
        or not anybody waits. A motor fails by a fault, a lost link, another program, by being taken
        over; a stop of one motor stops that one, and the others if the group is waited for. Who
        waits for one that was stopped so is told `MotionInterrupted`, who waits for the group what
        the cause was. With TOGETHER `stop` of the group goes along the path, too.
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
        """All motors have begun what was set for each, in common what `synchronization` says.

        They are as fast as the slowest of them allows, or take the duration that one of their
        trajectories asks for. All are armed, and confirmed it, before the first is fired. If one
        refuses, none has moved; if one fails to begin, all are stopped.

        Args:
            timeout_s: how long to wait until all are free [s], as in `Motor.start`.
            require: what starts them must be of this level at least; None: any will do.
            max_skew_s: between the first and the last start of motion there must not be more than
                this [s], and that must be known beforehand; None: it need not.

        Raises:
            SynchronizationError: `require` or `max_skew_s` cannot be met: says by whom, and why.
                Nothing was armed.
            MotorError: as `Motor.start`; a note on the error says whose it is.
        """
        check_asked(require, max_skew_s)
        members, common = self._members(), self._common

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
        """`with group.reserve("survey"):` all motors are these over several motions, or none is.

        They are taken one after another in one order for all programs, so that groups that share
        motors wait for each other, and never both. See `Motor.reserve`.

        Raises:
            MotorBusyError: somebody else holds one of them.
        """
        check_timeout(timeout_s)
        members = sorted(self._members(), key=lambda motor: motor._physical.order)
        asked_ns = members[0].runtime.now_ns()
        parts: list[Reservation] = []
        with ExitStack() as held:
            for motor in members:
                left_s: float | None = None
                if timeout_s is not None:
                    waited_s = (motor.runtime.now_ns() - asked_ns) / 1e9
                    left_s = max(0.0, as_number(timeout_s) - waited_s)
                parts.append(
                    held.enter_context(
                        motor.reserve(
                            purpose, timeout_s=left_s, lease_s=lease_s, take_over=take_over
                        )
                    )
                )
            yield Reservation.of_all(parts)

    def wait_until_done(self, timeout_s: float | None = None) -> None:
        """What was commanded last is over in every motor. What if one fails: `fault_reaction`.

        Raises:
            DeadlineExceeded: not within `timeout_s` [s]; names who is not done.
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
        """`told` hears how well each start was synchronised, once it was waited for."""
        self._observer = told

    def is_done(self) -> bool:
        """Whether `wait_until_done` would return at once; raises as it does."""
        done: list[bool] = []
        for motor in self:  # every member is looked at, and may raise
            try:
                done.append(motor.is_done())
            except MotorError as error:
                told = self._answer(motor, motor._run, error)
                raise told from told.__cause__
        return all(done)

    def stop(self) -> None:
        """Every motor is slowing down; all are tried, then the first error is raised.

        Those that are to stop together along their path (`fault_reaction`) do.
        """
        motion = self._motion
        self._end_motion()
        if motion is None or not motion.stops_together:
            self._every(Motor.stop)
            return
        triggers: list[tuple[Motor, Trigger]] = []

        def stop(motor: Motor) -> None:
            motor._bring_to_rest("stop", lambda: add_trigger(triggers, motor))

        self._every(stop)
        for motor, trigger in triggers:
            motor._call(trigger.fire)

    def quick_stop(self) -> None:
        """Every motor makes its quick stop; all are tried, then the first error is raised."""
        self._end_motion()
        self._every(Motor.quick_stop)

    def halt(self) -> None:
        """Every motor halts; all are tried, then the first error is raised."""
        self._end_motion()
        self._every(Motor.halt)

    def sync_capability(self) -> SyncCapability:
        """How well these motors can begin and end together, with what is set now.

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
            return capability  # nothing can be started now

    def sync_quality(self) -> SyncQuality:
        """How well the last start began and ended together; what has not happened yet is None.

        Raises:
            UsageError: the group was never started.
        """
        if not self._started:
            raise UsageError("the group has not been started: there is no quality to tell")
        quality = quality_of(self._started)
        return quality if self._motion is None else replace(quality, path=self._motion.path())

    def _end_motion(self) -> None:
        """What the motors do is looked after no more."""
        if self._motion is not None:
            self._motion.end()

    def _answer(self, motor: Motor, run: Run | None, error: Exception) -> Exception:
        """A member failed, of this run; the others do what was set. Returns what to raise."""
        if self._motion is not None and self._motion.watches(run):
            return self._motion.failed(motor, error)
        if self.fault_reaction is not FaultReaction.NONE:
            stop_others(self._members(), motor, error)
        return error

    def _members(self) -> tuple[Motor, ...]:
        if not len(self):
            raise UsageError("the group is empty: append a motor first")
        return tuple(self)

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
