"""Motor groups: several motors that move together.

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
    """Any number of motors that are started, awaited and stopped together."""

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
                    f"{device.name} and {member.name} live in different runtimes: they share "
                    "no time at which to begin"
                )

    def set_trajectory(self, *trajectories: Trajectory) -> None:
        """Set the trajectory of each motor, in the order of appending; all of them or none.

        Raises:
            UsageError: the number of trajectories is not that of motors, or one is impossible.
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
                told = self._answer(motor, motor._run, error)
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
        triggers: list[tuple[Motor, Trigger]] = []

        def stop(motor: Motor) -> None:
            motor._bring_to_rest("stop", lambda: add_trigger(triggers, motor))

        self._every(stop)
        for motor, trigger in triggers:
            motor._call(trigger.fire)

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

    def _answer(self, motor: Motor, run: Run | None, error: Exception) -> Exception:
        """React to the failure of a member in `run`. Return the error to be raised."""
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
