"""Logical motor: the command, the ownership and the active motion of one user of a physical motor.

Several logical motors may share one physical motor, in this process or in others.
`motorhil.motorapi.ownership.physical_motor` coordinates them. `motorhil.motorapi.motor` is the face
of a logical motor for applications; starts, waits and groups work with the class here.

*Operations.* An operation owns the motor and has its turn: no other operation runs on the physical
motor meanwhile. A motor left moving by a former owner is brought to rest before its next operation.

*Low-level access* is the exclusive use of the hardware object by one thread. The paper, Requirement
2: "The user shall be assured that no other part of the interface will have any effect on the
hardware, while the user maintains low-level access to it." So every part of the interface that
would send is refused meanwhile, for all logical motors including that of the holder. Operations and
stops raise `MotorBusyError`. Readings return the last value received, or raise it. Waits do not
poll, and the drive is not set up. *Stops from elsewhere are refused as well*: a halt in the middle
of, say, a firmware download or a manual sequence of controlwords is exactly the effect that the
paper excludes. The motor can still be stopped by the holder (through the hardware object), by the
dead-man of the drive when the host falls silent, and by means outside the interface. SYNC and the
heartbeat of the host are not excluded, as they belong to the bus and not to one motor. The access
begins with the motor at rest. At its end the token grows and caches are dropped, so that the next
start writes all its settings.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from math import isfinite
from typing import Final, final

from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint, as_number
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    PluginError,
    StateError,
    UsageError,
)
from motorhil.motorapi.hooks import Hooks, Rest
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.outcome import Ending, Outcome, Progress, ending_of
from motorhil.motorapi.ownership.claim import AcquirePolicy
from motorhil.motorapi.ownership.physical_motor import ActiveMotion, PhysicalMotor, RunStatus
from motorhil.motorapi.ownership.queue import LOW_LEVEL, TRANSACTION_TIMEOUT_S, Ticket
from motorhil.motorapi.ownership.reservation import Reservation
from motorhil.motorapi.planning.single_axis import duration_of
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S, Awaited, Runtime, wait_until
from motorhil.motorapi.state import Fault, MotorState
from motorhil.motorapi.trajectory import Argument, ComplexTrajectory, Trajectory, has_moving_ends

_ADOPTION_S: Final = 30.0
"""The timeout for the rest of a motor that was left moving [s]."""
_COAST_LOOK_S: Final = 0.02
"""The time between two readings of the position of a motor without power [s]."""
_SLOW_SHARE: Final = 0.01
"""The share of the model's velocity below which a motor without power is taken for at rest."""


@final
class LogicalMotor:
    """One user's view of a physical motor.

    Attributes:
        name: name in messages and recordings.
        model: constant properties of the motor.
        runtime: the runtime in which it waits.
        physical: the record shared with the other logical motors.
        hooks: the adaptation.
        mode, variable: the form of commands (None: not set yet), and the commanded quantity.
        command: what the next start begins, or None.
        asked: the command of the last start, whether it succeeded or not; None before the first.
        argument: the argument of a complex trajectory; None: time.
        run: the last motion begun here, or None.
    """

    def __init__(
        self,
        name: str,
        model: MotorModel,
        runtime: Runtime,
        physical: PhysicalMotor,
        hooks: Hooks,
    ) -> None:
        self.name: Final = name
        self.model: Final = model
        self.runtime: Final = runtime
        self.physical = physical
        self.hooks: Final = hooks
        self.mode: ControlMode | None = None
        self.variable = ControlVariable.POSITION
        self.command: Setpoint | Trajectory | None = None
        self.asked: Setpoint | Trajectory | None = None
        self.argument: Argument | None = None
        self.run: ActiveMotion | None = None
        self._coast = Rest(model)
        self._refreshed_ns: int | None = None
        self._callback_error: PluginError | None = None
        self._held_hardware: tuple[Ticket, object] | None = None
        self._is_closed = False

    def close(self) -> None:
        """Refuse all operations from now on."""
        self._is_closed = True

    def require_open(self) -> None:
        """Raise LinkError if this motor was closed, whoever else keeps the hardware open."""
        if self._is_closed:
            raise LinkError(link=self.name, reason="this motor was closed", remedy="make a new one")

    def forgotten(self) -> str:
        """Return a sentence about a command that was set but not started, or an empty text."""
        command = self.command
        if command is None or command is self.asked:
            return ""
        noun = "set-point" if isinstance(command, Setpoint) else "trajectory"
        return f"{self.name}: its {noun} was set, but not started; start() begins it"

    # ---- operations ----

    @contextmanager
    def operation(self, name: str, timeout_s: float | None = None) -> Iterator[None]:
        """Own the connected motor inside the block, without other operations."""
        self.require_open()
        ownership = self.physical.ownership
        with self._commanding(f"{name}() of {self.name}", timeout_s):
            self._take_physical(ownership.is_orphan)
            self.hooks.connect()
            if ownership.is_orphan:
                self.adopt()
            try:
                yield
            finally:
                self.keep()

    @contextmanager
    def reserve(
        self, purpose: str, timeout_s: float | None, lease_s: float | None, take_over: bool
    ) -> Iterator[Reservation]:
        """Own the motor inside the block; see `Motor.reserve`."""
        self.require_open()
        policy = None if timeout_s is None else self._policy(timeout_s)
        who, asked_ns = f"reserve() of {self.name}", self.runtime.now_ns()
        physical = self.physical
        if take_over:
            physical.require_not_held_elsewhere()
        with physical.ownership.owned(
            self, who, purpose, policy, lease_s=lease_s, take_over=take_over, afresh=True
        ) as claim:
            with physical.transaction(self.runtime, who):
                self._take_physical(take_over or physical.ownership.is_orphan)
                if physical.ownership.is_orphan:
                    self.hooks.connect()
                    self.adopt(timeout_s if take_over else None, asked_ns)
            yield Reservation((self.name,), (claim,))

    def bring_to_rest(self, operation: str, stop: Callable[[], object]) -> None:
        """Stop the motor by `stop`, which neither waits nor needs ownership; its motion ends."""
        self.require_open()
        with self.physical.interrupt(self.name):
            status = self.status()
            try:
                self.hooks.connect()
            except LinkError:
                with suppress(MotorError):
                    stop()  # it may hear us; or its adaptation repeats the stop when it can
                raise
            stop()
            self._coast = Rest(self.model)
            self.run = ActiveMotion(
                f"{operation}() of {self.name}", self, self.runtime.now_ns(), None
            )
            self.physical.begin(self.run, status)
            self.keep()

    def enable(self) -> None:
        """Switch on the power stage, also after a quick stop."""
        self.hooks.enable()
        self.physical.is_quick_stopped = False

    def stop(self) -> None:
        """Stop the motor; see `Motor.stop`."""
        self.bring_to_rest("stop", self.hooks.stop)

    def _take_physical(self, take_over: bool) -> None:
        """Bind the physical motor to this one; with `take_over` also during a motion of another."""
        self._bury_failed_run()
        now_ns = self.runtime.now_ns() if take_over else None
        self.physical.take(self, self.name, self.status(), now_ns)

    def adopt(self, timeout_s: float | None = None, since_ns: int = 0) -> None:
        """Bring to rest a motor that a former owner has left moving.

        Not every drive tells whether it is on: the motor may be driven although its state, as this
        program knows it, is DISABLED.

        Raises:
            DeadlineExceeded: it does not come to rest, within `timeout_s` [s] of `since_ns`, if
                given.
        """
        hooks, coast = self.hooks, Rest(self.model)
        if hooks.read_state() not in (MotorState.FAULT, MotorState.OFFLINE):
            slow = _SLOW_SHARE * self.model.velocity_max
            may_coast = abs(hooks.read_velocity()) > slow
            hooks.stop()
            left_s = _ADOPTION_S
            if timeout_s is not None:
                left_s = max(0.0, timeout_s - (self.runtime.now_ns() - since_ns) / 1e9)

            def coasts() -> bool:
                latest = hooks.latest()
                is_off = latest is not None and latest.state is MotorState.DISABLED
                return may_coast and is_off and not coast.rests

            def refresh() -> float | None:
                pause_s = hooks.refresh()
                if not coasts():
                    return pause_s
                coast.see(hooks.read_position(), self.runtime.now_ns())
                return _COAST_LOOK_S if pause_s is None else min(pause_s, _COAST_LOOK_S)

            policy = AcquirePolicy(left_s, lambda: None, refresh)
            if not policy.until(self.runtime, lambda: hooks.is_done() and not coasts(), left_s):
                raise DeadlineExceeded(
                    awaited=f"rest of {self.name}, left moving by a former owner",
                    timeout_s=_ADOPTION_S if timeout_s is None else timeout_s,
                    last_heard=f"{hooks.read_velocity():g} {self.model.unit}/s",
                )
        self.physical.ownership.is_orphan = False

    @contextmanager
    def _commanding(self, who: str, timeout_s: float | None, purpose: str = "") -> Iterator[Ticket]:
        """Own the motor and its turn inside the block. None: wait for short operations only.

        A request with a timeout waits without a turn, so that the owner can continue meanwhile.
        """
        physical, runtime = self.physical, self.runtime
        if timeout_s is None:
            with (
                physical.transaction(runtime, who) as ticket,
                physical.ownership.owned(self, who, purpose),
            ):
                yield ticket
            return
        asked_ns = runtime.now_ns()
        with physical.ownership.owned(self, who, purpose, self._policy(timeout_s)):
            left_s = max(0.0, timeout_s - (runtime.now_ns() - asked_ns) / 1e9)
            with physical.transaction(runtime, who, left_s) as ticket:
                yield ticket

    def _policy(self, timeout_s: float) -> AcquirePolicy:
        """Return the policy for the wait until others have finished with the motor."""
        return AcquirePolicy(timeout_s, self._others_run, self._refresh_run)

    def _others_run(self) -> MotorBusyError | None:
        """Return the error for an active motion of another logical motor, or None."""
        run = self.physical.run
        if run is None or run.owner is self or not self.goes_on(run):
            return None
        return MotorBusyError(motor=self.name, holder=run.name, since_ns=run.since_ns)

    def _refresh_run(self) -> float | None:
        """Refresh the status of the active motion. Return the polling interval [s], or None."""
        run = self.physical.run
        if self.physical.access is None and (run is None or run.is_over):
            return None
        return self.refresh()

    def refresh(self) -> float | None:
        """Call the hook; during low-level access only return the check interval [s].

        A drive without power does not report the rest of its motor. So its position is read.
        """
        if self.physical.access is not None:
            return LOOK_PERIOD_S
        with self.physical.passage(self.name):
            pause_s = self.hooks.refresh()
            run = self.run
            if run is not None and not run.is_over and self.coasts(run):
                self._see_coasting(self.hooks.read_position(), self.runtime.now_ns())
                return _COAST_LOOK_S if pause_s is None else min(pause_s, _COAST_LOOK_S)
        news = self.physical.news
        if pause_s is not None and news is not None:
            latest = self.hooks.latest()
            heard_ns = None if latest is None else latest.time_ns
            if heard_ns != self._refreshed_ns:  # its frame was counted before it was evaluated
                self._refreshed_ns = heard_ns
                news.grow()
        return pause_s

    def coasts(self, run: ActiveMotion) -> bool:
        """Return True if `run` is the last stop, without power, and rest was not found yet."""
        if run is not self.run or run.motion is not None or self._coast.rests:
            return False
        latest = self.hooks.latest()
        if latest is None or latest.state is not MotorState.DISABLED:
            return False
        if latest.position is not None:
            self._see_coasting(latest.position, latest.time_ns)
        return not self._coast.rests

    def _see_coasting(self, position: float, now_ns: int) -> None:
        """Process a position of a motor without power; report its rest to all that wait."""
        if not self._coast.rests and self._coast.see(position, now_ns):
            self.physical.bell.grow()

    # ---- conditions of an operation ----

    def require_no_fault(self) -> MotorState:
        """Return the state of the motor, which is neither FAULT nor OFFLINE.

        Raises:
            DeviceFault: the drive reports a fault.
            LinkError: the motor does not respond.
        """
        state = self.hooks.read_state()
        if state is MotorState.OFFLINE:
            raise LinkError(
                link=self.physical.label,
                reason=f"{self.name} does not respond",
                remedy="check its power, its cable and the bus",
            )
        if state is MotorState.FAULT:
            fault = self.hooks.read_fault()
            if fault is None:
                fault = Fault(0, "not told", self.runtime.now_ns())
            raise fault.as_error(self.name)
        return state

    def require_rest(self, operation: str) -> None:
        """Require that the acquired motor is at rest.

        Raises:
            StateError: a motion is active.
            MotorBusyError: another logical motor has stopped it since, and it still slows down.
        """
        run = self.physical.run
        if run is None or not self.goes_on(run):
            return
        if run.owner is not self:
            raise MotorBusyError(motor=self.name, holder=run.name, since_ns=run.since_ns)
        raise StateError(
            motor=self.name,
            operation=operation,
            state=f"{run.name} is active since {run.since_ns / 1e9:.6f} s",
            remedy="wait_until_done() or stop() first" if run.ends else "stop() first",
        )

    # ---- the active motion ----

    def begin(self, operation: str, motion: Motion | None) -> ActiveMotion:
        """Make a motion of this motor the active one."""
        run = ActiveMotion(f"{operation}() of {self.name}", self, self.runtime.now_ns(), motion)
        self.physical.begin(run, self.status())
        self.run = run
        return run

    def goes_on(self, run: ActiveMotion) -> bool:
        """Return True if `run` is the active motion and has not ended."""
        if self.physical.run is not run or run.is_over:
            return False
        status = self.status()
        return status is RunStatus.GOING or (status is RunStatus.DONE and not run.ends)

    def keep(self) -> None:
        """Keep other processes from the motor until the motion of this one has ended."""
        physical = self.physical

        def goes_on() -> bool:
            run = physical.run
            return run is not None and run.owner is self and self.goes_on(run)

        physical.ownership.keep(self, goes_on, physical.bell, physical.news is not None)

    def status(self) -> RunStatus:
        """Return the status of the physical motor's motion; DONE without one."""
        run = self.physical.run
        if run is None or run.finished:
            return RunStatus.DONE
        try:
            return RunStatus.DONE if self.hooks.is_done() else RunStatus.GOING
        except MotorError:
            return RunStatus.FAILED

    def _bury_failed_run(self) -> None:
        """End a motion that has failed, so that a later set-up of the drive cannot revive it."""
        run = self.physical.run
        if run is None or run.finished:
            return
        try:
            self.hooks.is_done()
        except MotorError as error:
            self.physical.fail(error, self.runtime.now_ns())

    def look(self, run: ActiveMotion | None) -> bool:
        """Return True if the motion has ended; raise if it ended short of its target."""
        if run is None or run.finished:
            return True
        self._raise_interruption(run)
        if not self.hooks.is_done():
            return False
        if self.coasts(run):
            return False
        self.physical.ownership.notice(run.owner)
        self._raise_interruption(run)  # rest may be the result of the next command
        if run.ends:
            run.finished = True
        return True

    def is_done(self) -> bool:
        """Return True if a wait for the last command would return at once; raise as it does.

        A drive that must be polled is asked, except inside callbacks, which cannot wait.
        """
        run = self.run
        if run is not None and not run.is_over and not self.runtime.is_in_callback():
            self.refresh()
        if not self.look(run):
            return False
        self.raise_callback_error()
        return True

    def _raise_interruption(self, run: ActiveMotion) -> None:
        if run.interrupted_by is not None:
            if run.error is not None:
                raise copy(run.error) from run.error.__cause__
            raise MotionInterrupted(
                motor=self.name, by=run.interrupted_by, at_ns=run.interrupted_at_ns
            )

    def outcome(self, run: ActiveMotion) -> Outcome | None:
        """Return the outcome of the motion, or None while it is active."""
        error: MotorError | None = None
        ending = Ending.DONE
        try:
            if not self.look(run):
                return None
        except MotorError as failed:
            error, ending = failed, ending_of(failed)
        return Outcome(self.name, run.name, ending, self.runtime.now_ns(), error)

    def progress(self, run: ActiveMotion) -> Progress:
        """Return the progress of a motion of this motor."""
        motion = run.motion
        times = None if motion is None else self.hooks.motion_times()
        began_ns = run.since_ns
        if times is not None and times.started_ns is not None:
            began_ns = max(began_ns, times.started_ns)
        elapsed_s = max(0, self.runtime.now_ns() - began_ns) / 1e9
        expected_s = None if motion is None else _expected_s(motion)
        latest = self.hooks.latest()
        position = None if latest is None else latest.position
        fraction = None if motion is None else _covered(motion, position)
        if fraction is None and expected_s is not None:
            fraction = 1.0 if expected_s <= elapsed_s else elapsed_s / expected_s
        return Progress(
            operation=run.name,
            elapsed_s=elapsed_s,
            expected_s=expected_s,
            remaining_s=None if expected_s is None else max(0.0, expected_s - elapsed_s),
            fraction=fraction,
            position=position,
            target=None if motion is None else motion.target,
        )

    def callback_failed(self, error: PluginError) -> None:
        """Keep the error of a callback for `raise_callback_error`, unless there is one."""
        if self._callback_error is None:
            self._callback_error = error

    def raise_callback_error(self) -> None:
        """Raise the error of a callback since the last call, if any."""
        error, self._callback_error = self._callback_error, None
        if error is not None:
            raise error

    # ---- low-level access ----

    @contextmanager
    def low_level(self, timeout_s: float | None) -> Iterator[object]:
        """Yield the hardware object; see `Motor.low_level`."""
        self.require_open()
        physical, runtime = self.physical, self.runtime
        held = self._held_hardware
        if held is not None and held[0] is physical.access and physical.is_held_here:
            yield held[1]  # nested block: the outer one ends the access
            return
        asked_ns = runtime.now_ns()

        def left_s() -> float:
            if timeout_s is None:
                return TRANSACTION_TIMEOUT_S
            return max(0.0, timeout_s - (runtime.now_ns() - asked_ns) / 1e9)

        with self._commanding(f"low_level() of {self.name}", timeout_s, LOW_LEVEL) as ticket:
            while not self._is_at_rest(patient=timeout_s is not None and left_s() > 0.0):
                self._await_end(left_s())
            physical.grant(runtime, ticket, left_s())
            try:
                hardware = self.hooks.open_low_level()
                self._held_hardware = (ticket, hardware)
                try:
                    yield hardware
                finally:
                    self._held_hardware = None
                    self.hooks.close_low_level()
            finally:
                physical.revoke(ticket)

    def _is_at_rest(self, *, patient: bool) -> bool:
        """Return True if no motion is active and the end of the last is known.

        Raises:
            MotorBusyError: a motion of another logical motor is active, and not `patient`.
            StateError: a motion of this one is active, and not `patient`.
        """
        try:
            self._take_physical(False)
            self.require_rest("low_level()")
        except (MotorBusyError, StateError):
            if not patient:
                raise
            return False
        return True

    def _await_end(self, timeout_s: float) -> None:
        """Wait until the motion has ended, a polled change was received, or the time is over.

        The turn is kept meanwhile: later requests queue behind it.
        """
        physical = self.physical
        run = physical.run

        def is_over() -> bool:
            return run is None or not self.goes_on(run)

        pause_s = self.hooks.refresh()
        if pause_s is not None:
            timeout_s = min(timeout_s, pause_s)
        wait_until(self.runtime, Awaited(physical.news, is_over).looks_over, timeout_s)


def check_timeout(timeout_s: float | None) -> float | None:
    """Return the timeout as a float.

    Raises:
        UsageError: it is not a valid timeout.
    """
    if timeout_s is None:
        return None
    number = as_number(timeout_s)
    if not number >= 0.0:
        raise UsageError(f"timeout_s = {timeout_s!r}: must be a number of seconds >= 0")
    return number


def _expected_s(motion: Motion) -> float | None:
    """Return the duration of the commanded profile [s], or None if it is unknown."""
    if motion.argument is not None:
        return None
    expected_s = motion.duration_s
    if expected_s is None:
        expected_s = duration_of(motion)
    return expected_s if isfinite(expected_s) else None


def _covered(motion: Motion, position: float | None) -> float | None:
    """Return the fraction of the distance covered, or None unless it is a position profile."""
    if motion.variable is not ControlVariable.POSITION:
        return None
    trajectory = motion.trajectory
    if isinstance(trajectory, ComplexTrajectory) or has_moving_ends(trajectory):
        return None  # it may turn round on its way
    if position is None or not motion.distance:
        return None
    return min(1.0, max(0.0, (position - motion.start) / motion.distance))
