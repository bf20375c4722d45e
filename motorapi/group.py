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

from motorapi.capability import capability_of, quality_of
from motorapi.commands import as_number
from motorapi.device import DeviceGroup
from motorapi.errors import MotorError, UsageError
from motorapi.execution import Started, start_together
from motorapi.motion_waits import check_timeout, wait_for_all
from motorapi.motor import Motor
from motorapi.outcome import callback_failed
from motorapi.reservation import Reservation
from motorapi.synchronization import SyncCapability, SyncQuality
from motorapi.trajectory import Trajectory


class MotorGroup(DeviceGroup[Motor]):
    """An arbitrary number of motors that are started, waited for and stopped as one."""

    def __init__(self, *motors: Motor) -> None:
        self._started: tuple[Started, ...] = ()
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

    def start(self, timeout_s: float | None = None) -> None:
        """All motors have begun what was set for each: trajectories begin and end together.

        They are as fast as the slowest of them allows, or take the duration that one of their
        trajectories asks for. All are armed, and confirmed it, before the first is fired. If one
        refuses, none has moved; if one fails to begin, all are stopped.

        Args:
            timeout_s: how long to wait until all are free [s], as in `Motor.start`.

        Raises:
            MotorError: as `Motor.start`; a note on the error says whose it is.
        """
        self._started = start_together(self._members(), timeout_s)

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
        """What was commanded last is over in every motor. If one fails, the others are stopped.

        Raises:
            DeadlineExceeded: not within `timeout_s` [s]; names who is not done.
            MotorError: as `Motor.wait_until_done`.
        """
        wait_for_all(self._members(), timeout_s)
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
        done = [motor.is_done() for motor in self]  # every member is looked at, and may raise
        return all(done)

    def stop(self) -> None:
        """Every motor is slowing down; all are tried, then the first error is raised."""
        self._every(Motor.stop)

    def quick_stop(self) -> None:
        """Every motor makes its quick stop; all are tried, then the first error is raised."""
        self._every(Motor.quick_stop)

    def halt(self) -> None:
        """Every motor halts; all are tried, then the first error is raised."""
        self._every(Motor.halt)

    def sync_capability(self) -> SyncCapability:
        """How well these motors can begin and end together, with what is set now.

        Raises:
            MotorError: a motor does not answer.
        """
        return capability_of(self._members())

    def sync_quality(self) -> SyncQuality:
        """How well the last start began and ended together; what has not happened yet is None.

        Raises:
            UsageError: the group was never started.
        """
        if not self._started:
            raise UsageError("the group has not been started: there is no quality to tell")
        return quality_of(self._started)

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
