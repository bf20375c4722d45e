"""The base motor: the public interface for applications.

Algorithm 1 of the paper runs nearly word for word::

    hw = Cia402HwMotor(bus, node_id=3)
    motor = Cia402Motor(hw, model=MotorModel.load("wheel.toml"))
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()

Settings are local: nothing is sent, and other logical motors of the same physical motor are not
affected. `start` acquires the motor, transmits changed settings, and starts; or it raises and
nothing has moved.

Public methods are final: they validate, acquire the motor, convert errors, and report. The vendor
implements the hooks of `motorhil.motorapi.hooks`. Read access is in `motorhil.motorapi.motor`, the
end of motions in `motorhil.motorapi.motor`. U is the unit of position of the motor: rad, or m if
linear.

Read access to a motor at any time: state, fault and measurements.

Read access needs no ownership and never disturbs the owner of the motor. During low-level access
nothing is requested from the drive: readings return the last value received, or raise an error that
names the holder. U is the unit of position of the motor: rad, or m if linear.

A logical motor that shares a physical motor: active motion and its end.

`motorhil.motorapi.ownership.physical_motor` coordinates logical motors; `motorhil.motorapi.motor`
has the commands of applications.

Low-level access: exclusive use of the hardware object by one thread.

The paper, Requirement 2: "The user shall be assured that no other part of the interface will have
any effect on the hardware, while the user maintains low-level access to it."

So every part of the interface that would send is refused meanwhile, for all logical motors
including that of the holder. Operations and stops raise `MotorBusyError`. Readings return the last
value received, or raise it. Waits do not poll, and the drive is not set up. *Stops from elsewhere
are refused as well*: a halt in the middle of, say, a firmware download or a manual sequence of
controlwords is exactly the effect that the paper excludes. The motor can still be stopped by the
holder (through the hardware object), by the dead-man of the drive when the host falls silent, and
by means outside the interface. SYNC and the heartbeat of the host are not excluded, as they belong
to the bus and not to one motor.

The access begins with the motor at rest. At its end the token grows and caches are dropped, so that
the next start writes all its settings.

Progress of a motion, from the command and received data, without requests.

Outcome of a motion, and its single notification by callback.

The event that ends a motion may be a received frame, a missing heartbeat, or a call of another
logical motor. The callback runs inside this event. So it must not wait or start anything that
waits; it may set a flag that another thread waits for. Its exceptions must not break the event:
they become a `PluginError`, which is logged and raised where that motor is next awaited or
examined.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum
from math import isfinite
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar, final

from motorhil.motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Setpoint,
    as_number,
)
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    PluginError,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.execution import (
    check_timeout,
    require_no_fault,
    require_rest,
    start_together,
    wait_for_all,
)
from motorhil.motorapi.hooks import MotorHooks
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.claim import AcquirePolicy
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.ownership.physical_motor import ActiveMotion, RunStatus
from motorhil.motorapi.ownership.queue import LOW_LEVEL, TRANSACTION_TIMEOUT_S
from motorhil.motorapi.ownership.reservation import Reservation, check_lease, check_take_over
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S, Awaited, wait_until
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.trajectory import Trajectory, require_argument

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
    from motorhil.motorapi.ownership.queue import Ticket
    from motorhil.motorapi.runtime.api import Registration, Runtime
    from motorhil.motorapi.trajectory import Argument

P = ParamSpec("P")
R = TypeVar("R")


class ReadableMotor(MotorHooks):
    """The read-only part of `motorhil.motorapi.motor.Motor`."""

    @property
    @final
    def ownership(self) -> Ownership:
        """The ownership of the physical motor; its `listeners` receive its events."""
        return self._physical.ownership

    @final
    def state(self) -> MotorState:
        """Return the state; OFFLINE if the motor does not respond."""
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                return self._call(self._read_state)
        latest = self.latest()
        if latest is None:
            raise access.busy(self.name)
        return latest.state

    @final
    def fault(self) -> Fault | None:
        """Return the fault reported by the drive, or None."""
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                return self._call(self._read_fault)
        latest = self.latest()
        if latest is None or latest.state is MotorState.FAULT:
            raise access.busy(self.name)  # only a request could tell the fault
        return None

    @final
    def is_referenced(self) -> bool:
        """Return True if position 0 is that of the model."""
        with self._physical.passage(self.name):
            self._call(self._connect)
            return self._call(self._read_referenced)

    @final
    def position(self) -> float:
        """Return the measured position [U]."""
        return self._measured(self._read_position, lambda latest: latest.position)

    @final
    def velocity(self) -> float:
        """Return the measured velocity [U/s]."""
        return self._measured(self._read_velocity, lambda latest: latest.velocity)

    @final
    def torque(self) -> float:
        """Return the measured torque [N·m], or force [N]."""
        return self._measured(self._read_torque, lambda latest: latest.torque)

    @final
    def following_error(self) -> float:
        """Return demand minus actual position [U]."""
        return self._measured(self._read_following_error, lambda latest: latest.following_error)

    @final
    def latest(self) -> Measurement | None:
        """Return the last measurement received; nothing is sent, so callbacks may call this."""
        return self._call(self._latest)

    def __repr__(self) -> str:
        text = f"<{type(self).__name__} {self.name!r} on {self._physical.label}"
        try:
            latest = self._latest()
        except Exception as error:  # at a prompt, a repr that raises hides the problem
            return f"{text}: {error!r}>"
        if latest is None:
            return f"{text}>"
        where = "" if latest.position is None else f", {latest.position:g} {self.model.unit}"
        return f"{text}: {latest.state.value}{where}>"

    # ---- internal: shared with Motor, motorhil.motorapi.execution and motorhil.motorapi.group ----

    @final
    def _measured(
        self, read: Callable[[], float], heard: Callable[[Measurement], float | None]
    ) -> float:
        """Return a measured value; during low-level access, the last one received.

        Raises:
            MotorBusyError: low-level access is active, and no value was received.
        """
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                self._call(self._connect)
                return self._call(read)
        latest = self.latest()
        value = None if latest is None else heard(latest)
        if value is None:
            raise access.busy(self.name)
        return value

    @final
    def _call(self, hook: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the hook and return its result; convert foreign exceptions to PluginError."""
        try:
            return hook(*args, **kwargs)
        except MotorError:
            raise
        except Exception as error:
            where = getattr(hook, "__name__", None) or repr(hook)
            raise PluginError(
                plugin=type(self).__qualname__, where=str(where), problem=repr(error)
            ) from error


# ruff: noqa: SLF001 -- it works the hooks of a motor, as Motor does its own


@contextmanager
def low_level_access(motor: "Motor", timeout_s: float | None) -> Iterator[object]:
    """Yield the hardware object of `motor`; see `Motor.low_level`."""
    check_timeout(timeout_s)
    timeout_s = None if timeout_s is None else as_number(timeout_s)
    physical, runtime = motor._physical, motor.runtime
    held = motor._held_hardware
    if held is not None and held[0] is physical.access and physical.is_held_here:
        yield held[1]  # nested block: the outer one ends the access
        return
    asked_ns = runtime.now_ns()

    def left_s() -> float:
        if timeout_s is None:
            return TRANSACTION_TIMEOUT_S
        return max(0.0, timeout_s - (runtime.now_ns() - asked_ns) / 1e9)

    who = f"low_level() of {motor.name}"
    with motor._commanding(who, timeout_s, LOW_LEVEL) as ticket:
        while not _is_at_rest(motor, patient=timeout_s is not None and left_s() > 0.0):
            _await_end(motor, left_s())
        physical.grant(runtime, ticket, left_s())
        try:
            hardware = motor._call(motor._open_low_level)
            motor._held_hardware = (ticket, hardware)
            try:
                yield hardware
            finally:
                motor._held_hardware = None
                motor._call(motor._close_low_level)
        finally:
            physical.revoke(ticket)


def _is_at_rest(motor: "Motor", *, patient: bool) -> bool:
    """Return True if no motion is active and the end of the last is known.

    Raises:
        MotorBusyError: a motion of another logical motor is active, and not `patient`.
        StateError: a motion of this one is active, and not `patient`.
    """
    motor._bury_failed_run()
    try:
        motor._physical.take(motor, motor.name, motor._status())
        require_rest(motor, "low_level()")
    except (MotorBusyError, StateError):
        if not patient:
            raise
        return False
    return True


def _await_end(motor: "Motor", timeout_s: float) -> None:
    """Wait until the motion has ended, a polled change was received, or the time is over.

    The turn is kept meanwhile: later requests queue behind it.
    """
    physical = motor._physical
    run = physical.run

    def is_over() -> bool:
        return run is None or not motor._goes_on(run)

    pause_s = motor._call(motor._refresh)
    if pause_s is not None:
        timeout_s = min(timeout_s, pause_s)
    wait_until(motor.runtime, Awaited(physical.news, is_over).looks_over, timeout_s)


# ruff: noqa: SLF001 -- it reads the hooks of a motor, as Motor does its own


@final
@dataclass(frozen=True, slots=True, repr=False)
class Progress:
    """The progress of a motion. U is rad, or m if the motor is linear.

    Attributes:
        operation: the active operation, as in "start() of left".
        elapsed_s: time since its begin [s], as reported by the hardware if it does.
        expected_s: duration of the commanded profile [s]; None: unknown (homing, a stop, an
            argument other than time).
        remaining_s: remaining part of that [s], 0 if it is late.
        fraction: 0 to 1: of the distance, for a direct position motion, else of the expected time;
            None: both unknown.
        position: the last position received [U].
        target: its target, in the unit of its control variable, or None if unknown.
    """

    operation: str
    elapsed_s: float
    expected_s: float | None
    remaining_s: float | None
    fraction: float | None
    position: float | None
    target: float | None

    def __repr__(self) -> str:
        text = f"<Progress of {self.operation}: {self.elapsed_s:.3f} s"
        if self.expected_s is not None:
            text += f" of {self.expected_s:.3f} s"
        if self.fraction is not None:
            text += f", {self.fraction:.1%}"
        if self.position is not None and self.target is not None:
            text += f", at {self.position:g} on the way to {self.target:g}"
        return f"{text}>"


def progress_of(motor: "SharedMotor", run: "ActiveMotion") -> Progress:
    """Return the progress of `run` of `motor`."""
    motion = run.motion
    times = None if motion is None else motor._call(motor._motion_times)
    began_ns = run.since_ns
    if times is not None and times.started_ns is not None:
        began_ns = max(began_ns, times.started_ns)
    elapsed_s = max(0, motor.runtime.now_ns() - began_ns) / 1e9
    expected_s = None if motion is None else _expected_s(motion)
    latest = motor.latest()
    position = None if latest is None else latest.position
    fraction = None if motion is None else _of_the_way(motion, position)
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


def _expected_s(motion: Motion) -> float | None:
    if motion.argument is not None:
        return None
    expected_s = motion.duration_s
    if expected_s is None:
        expected_s = planning.duration_of(motion)
    return expected_s if isfinite(expected_s) else None


def _of_the_way(motion: Motion, position: float | None) -> float | None:
    if motion.variable is not ControlVariable.POSITION or motion.function is not None:
        return None
    if position is None or not motion.distance:
        return None
    return min(1.0, max(0.0, (position - motion.start) / motion.distance))


_LOG: Final = logging.getLogger("motorapi")


@final
class Ending(Enum):
    """The kinds of end of a motion."""

    DONE = "done"  # as commanded; a velocity, torque or current: reached
    INTERRUPTED = "interrupted"  # stopped, replaced or switched off before its end
    FAILED = "failed"  # by a fault, a lost link, a failed homing


@final
@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """The outcome of one motion, true if it ended as commanded.

    Attributes:
        motor: the name of the logical motor that commanded it.
        operation: its name, as in "start() of left".
        ending: the kind of end.
        time_ns: time at which the end was known [ns], by the runtime.
        error: the error that `wait_until_done` raises; None if it was done.
    """

    motor: str
    operation: str
    ending: Ending
    time_ns: int
    error: MotorError | None = None

    def __bool__(self) -> bool:
        return self.ending is Ending.DONE

    def __repr__(self) -> str:
        return f"<Outcome of {self}>"

    def __str__(self) -> str:
        text = f"{self.operation}: {self.ending.value} at {self.time_ns / 1e9:.6f} s"
        return text if self.error is None else f"{text}: {self.error}"


def ending_of(error: MotorError) -> Ending:
    """Return the ending of a motion whose examination raises `error`."""
    return Ending.INTERRUPTED if isinstance(error, MotionInterrupted) else Ending.FAILED


@final
class DoneNotice:
    """One callback for the outcome of one motion. A `Registration`.

    Args:
        look: returns the outcome, or None while there is none; neither waits nor sends.
        callback: the callback of the application.
        failed: called with the error of the callback.
        where: place in that error, as in "on_done of left".
    """

    def __init__(
        self,
        look: Callable[[], Outcome | None],
        callback: Callable[[Outcome], object],
        failed: Callable[[PluginError], None],
        where: str,
    ) -> None:
        self._look_at = look
        self._callback = callback
        self._failed = failed
        self._where = where
        self._listeners: list[Callable[[], None]] = []
        self._timer: Registration | None = None

    def begin(self, runtime: "Runtime", physical: "PhysicalMotor") -> None:
        """Examine the motion at every change from now on, and now: it may have ended already."""
        if physical.news is None:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self._listeners = physical.bell.listeners
        self._listeners.append(self.look)
        self.look()

    def look(self) -> None:
        """Call the callback if the motion has ended."""
        outcome = self._look_at()
        if outcome is None or not self._claim():
            return
        try:
            self._callback(outcome)
        except Exception as error:
            self._failed(callback_failed(self._callback, self._where, error))

    def cancel(self) -> None:
        """Cancel the notification; cancelling again does nothing."""
        self._claim()

    def _claim(self) -> bool:
        """Return True for the first caller that ends it: two threads may get here at once."""
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return False
        if self._timer is not None:
            self._timer.cancel()
        return True


def callback_failed(callback: object, where: str, error: Exception) -> PluginError:
    """Log and return the error for a callback that raised."""
    name = getattr(callback, "__qualname__", None) or repr(callback)
    failed = PluginError(plugin=str(name), where=where, problem=repr(error))
    failed.__cause__ = error
    _LOG.error("%s", failed, exc_info=error)
    return failed


_ADOPTION_S: Final = 30.0
"""The timeout for the rest of a motor that was left moving [s]."""


class SharedMotor(ReadableMotor):
    """The part of `motorhil.motorapi.motor.Motor` that manages motions."""

    _run: ActiveMotion | None = None
    _callback_error: PluginError | None = None
    _held_hardware: "tuple[Ticket, Any] | None" = None

    def __repr__(self) -> str:
        text = super().__repr__()
        doing = ""
        access, run = self._physical.access, self._physical.run
        if access is not None:
            doing = f"; held by {access.who}"
        elif run is not None and self._goes_on(run):
            doing = f"; {run.name} is active"
        return f"{text[:-1]}{doing}>"

    @final
    def is_done(self) -> bool:
        """Return True if `wait_until_done` would return at once; raises as it does."""
        done = self._look(self._run)
        if done:
            self._raise_callback_error()
        return done

    @final
    def on_done(self, callback: Callable[[Outcome], object]) -> "Registration":
        """Call `callback(outcome)` once, when the last command has ended.

        The call is immediate if it has ended already; else it happens in the event that ends it,
        whatever the outcome. Like any callback it must neither wait nor start anything that waits.
        A motor that must be polled reports only while a caller waits for it.

        Returns:
            A registration that cancels it.

        Raises:
            StateError: no command was given yet.
        """
        if not callable(callback):
            raise UsageError(f"{self.name}: on_done({callback!r}): not callable; give a function")
        run = self._run
        if run is None:
            raise StateError(
                motor=self.name,
                operation="on_done",
                state="nothing was commanded yet",
                remedy="call start() first, then on_done() reports the end of that motion",
            )
        notice = DoneNotice(
            lambda: self._outcome(run), callback, self._callback_failed, f"on_done of {self.name}"
        )
        notice.begin(self.runtime, self._physical)
        return notice

    @final
    def progress(self) -> Progress | None:
        """Return the progress of the last command; None after its end, or without a command.

        This neither waits nor sends, so callbacks may call it. A command of velocity, torque or
        current continues after it was reached, and so does its progress.
        """
        run = self._run
        if run is None or run.is_over:
            return None
        try:
            if self._look(run) and run.ends:
                return None
        except MotorError:
            return None
        return progress_of(self, run)

    # ---- internal: shared with motorhil.motorapi.execution, motion_waits, low_level and group ----

    @final
    @contextmanager
    def _operation(self, name: str, timeout_s: float | None = None) -> Iterator[None]:
        """Own the connected motor inside the block, without other operations."""
        with self._commanding(f"{name}() of {self.name}", timeout_s):
            self._take_physical(self._physical.ownership.is_orphan)
            self._call(self._connect)
            if self._physical.ownership.is_orphan:
                self._adopt()
            try:
                yield
            finally:
                self._keep()

    @final
    def _take_physical(self, take_over: bool) -> None:
        """Bind the physical motor to this one; with `take_over` also during a motion of another."""
        self._bury_failed_run()
        now_ns = self.runtime.now_ns() if take_over else None
        self._physical.take(self, self.name, self._status(), now_ns)

    @final
    def _adopt(self, timeout_s: float | None = None, since_ns: int = 0) -> None:
        """Bring to rest a motor that a former owner has left moving.

        Raises:
            DeadlineExceeded: it does not come to rest, within `timeout_s` [s] of `since_ns`, if
                given.
        """
        if self._call(self._read_state) is MotorState.ENABLED:
            self._call(self._stop)
            left_s = _ADOPTION_S
            if timeout_s is not None:
                left_s = max(0.0, timeout_s - (self.runtime.now_ns() - since_ns) / 1e9)
            patience = AcquirePolicy(left_s, lambda: None, lambda: self._call(self._refresh))
            if not patience.until(self.runtime, lambda: self._call(self._is_done), left_s):
                raise DeadlineExceeded(
                    awaited=f"rest of {self.name}, left moving by a former owner",
                    timeout_s=_ADOPTION_S if timeout_s is None else timeout_s,
                    last_heard=f"{self._call(self._read_velocity):g} {self.model.unit}/s",
                )
        self._physical.ownership.is_orphan = False

    @final
    @contextmanager
    def _commanding(
        self, who: str, timeout_s: float | None = None, purpose: str = ""
    ) -> "Iterator[Ticket]":
        """Own the motor and its turn inside the block. None: wait for short operations only.

        A request with a timeout waits without a turn, so that the owner can continue meanwhile.
        """
        physical, runtime = self._physical, self.runtime
        if timeout_s is None:
            with (
                physical.transaction(runtime, who) as ticket,
                physical.ownership.owned(self, who, purpose),
            ):
                yield ticket
            return
        asked_ns = runtime.now_ns()
        with physical.ownership.owned(self, who, purpose, self._patience(timeout_s)):
            left_s = max(0.0, timeout_s - (runtime.now_ns() - asked_ns) / 1e9)
            with physical.transaction(runtime, who, left_s) as ticket:
                yield ticket

    @final
    def _patience(self, timeout_s: float) -> AcquirePolicy:
        """Return the policy for the wait until others have finished with the motor."""
        return AcquirePolicy(timeout_s, self._others_run, self._refresh_run)

    @final
    def _others_run(self) -> MotorBusyError | None:
        """Return the error for an active motion of another logical motor, or None."""
        run = self._physical.run
        if run is None or run.owner is self or not self._goes_on(run):
            return None
        return MotorBusyError(motor=self.name, holder=run.name, since_ns=run.since_ns)

    @final
    def _refresh_run(self) -> float | None:
        """Refresh the status of the active motion. Return the polling interval [s], or None."""
        run = self._physical.run
        if self._physical.access is None and (run is None or run.is_over):
            return None
        return self._refresh_freely()

    @final
    def _refresh_freely(self) -> float | None:
        """Call the hook `_refresh`; during low-level access only return the check interval."""
        physical = self._physical
        if physical.access is not None:
            return LOOK_PERIOD_S
        with physical.passage(self.name):
            return self._call(self._refresh)

    @final
    def _goes_on(self, run: ActiveMotion) -> bool:
        """Return True if `run` is the active motion and has not ended."""
        if self._physical.run is not run or run.is_over:
            return False
        status = self._status()
        return status is RunStatus.GOING or (status is RunStatus.DONE and not run.ends)

    @final
    def _keep(self) -> None:
        """Keep other processes from the motor until the motion of this one has ended."""
        physical = self._physical

        def goes_on() -> bool:
            run = physical.run
            return run is not None and run.owner is self and self._goes_on(run)

        physical.ownership.keep(self, goes_on, physical.bell, physical.news is not None)

    @final
    def _status(self) -> RunStatus:
        """Return the status of the physical motor's motion; DONE without one."""
        run = self._physical.run
        if run is None or run.finished:
            return RunStatus.DONE
        try:
            return RunStatus.DONE if self._call(self._is_done) else RunStatus.GOING
        except MotorError:
            return RunStatus.FAILED

    @final
    def _bury_failed_run(self) -> None:
        """End a motion that has failed, so that a later set-up of the drive cannot revive it."""
        run = self._physical.run
        if run is None or run.finished:
            return
        try:
            self._call(self._is_done)
        except MotorError as error:
            self._physical.fail(error, self.runtime.now_ns())

    @final
    def _begin(self, operation: str, motion: "Motion | None") -> ActiveMotion:
        name = f"{operation}() of {self.name}"
        run = ActiveMotion(name, self, self.runtime.now_ns(), motion)
        self._physical.begin(run, self._status())
        self._run = run
        return run

    @final
    def _look(self, run: ActiveMotion | None) -> bool:
        """Return True if the motion has ended; raise if it ended short of its target."""
        if run is None or run.finished:
            return True
        self._raise_interruption(run)
        if not self._call(self._is_done):
            return False
        self._physical.ownership.notice(run.owner)
        self._raise_interruption(run)  # rest may be the result of the next command
        if run.ends:
            run.finished = True
        return True

    def _raise_interruption(self, run: ActiveMotion) -> None:
        if run.interrupted_by is not None:
            if run.error is not None:
                raise copy(run.error) from run.error.__cause__
            raise MotionInterrupted(
                motor=self.name, by=run.interrupted_by, at_ns=run.interrupted_at_ns
            )

    @final
    def _outcome(self, run: ActiveMotion) -> Outcome | None:
        """Return the outcome of the motion, or None while it is active."""
        error: MotorError | None = None
        ending = Ending.DONE
        try:
            if not self._look(run):
                return None
        except MotorError as failed:
            error, ending = failed, ending_of(failed)
        return Outcome(self.name, run.name, ending, self.runtime.now_ns(), error)

    @final
    def _callback_failed(self, error: PluginError) -> None:
        if self._callback_error is None:
            self._callback_error = error

    @final
    def _raise_callback_error(self) -> None:
        """Raise the error of a callback since the last call, if any."""
        error, self._callback_error = self._callback_error, None
        if error is not None:
            raise error


_HOMING_TIMEOUT_S: Final = 60.0


class Motor(SharedMotor):
    """A logical motor: the user's view of one physical motor. Settings stay here until start().

    An adaptation derives from it and implements the hooks; it cannot override public methods.
    """

    _mode: ControlMode | None = None
    _variable: ControlVariable = ControlVariable.POSITION
    _command: Setpoint | Trajectory | None = None
    _argument: "Argument | None" = None

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in cls.__dict__:
            if not name.startswith("_") and name != "close" and hasattr(Motor, name):
                raise PluginError(
                    plugin=cls.__qualname__,
                    where=name,
                    problem="public methods of Motor are final; implement a hook instead",
                )

    # ---- settings, kept here until start() ----

    @property
    @final
    def control_mode(self) -> ControlMode | None:
        """The form of commands; None until `set_control_mode`."""
        return self._mode

    @property
    @final
    def control_variable(self) -> ControlVariable:
        """The commanded quantity."""
        return self._variable

    @final
    def set_control_mode(
        self, mode: ControlMode, variable: ControlVariable = ControlVariable.POSITION
    ) -> None:
        """Set the form of commands and the commanded quantity. Nothing is sent.

        A command for another mode or variable is discarded.

        Raises:
            UnsupportedError: this motor does not support them.
        """
        if not isinstance(mode, ControlMode) or not isinstance(variable, ControlVariable):
            raise UsageError(
                f"{self.name}: control mode {mode!r}, {variable!r}: give a ControlMode and a"
                " ControlVariable, as ControlMode.SETPOINT, ControlVariable.VELOCITY"
            )
        if not self._call(self._supports, mode, variable):
            able = ", ".join(
                f"{m.value} of {v.value}"
                for m in ControlMode
                for v in ControlVariable
                if self._call(self._supports, m, v)
            )
            asked = f"{mode.value} of {variable.value}"
            raise UnsupportedError(motor=self.name, feature=asked, supported=able)
        if (mode, variable) != (self._mode, self._variable):
            self._command = None
        self._mode = mode
        self._variable = variable

    @final
    def set_setpoint(
        self, value: float, relative: bool = False, limits: DerivativeLimits | None = None
    ) -> None:
        """Set the target of start(). Nothing is sent.

        Args:
            value: the target, in the unit of the control variable (position: U).
            relative: `value` is a distance from the position at the start.
            limits: of the derivatives, if tighter than those of the model.

        Raises:
            StateError: the control mode is not SETPOINT.
            LimitError: the target or a limit exceeds that of the model.
        """
        self._require_mode(ControlMode.SETPOINT, "set_setpoint")
        setpoint = Setpoint(value, relative, limits)
        planning.check_setpoint(self.name, self.model, self._variable, setpoint)
        self._call(self._check_command, self._variable, setpoint)
        self._command = replace(setpoint, value=float(value))

    @final
    def set_trajectory(self, trajectory: Trajectory, argument: "Argument | None" = None) -> None:
        """Set the trajectory of start(). Nothing is sent.

        Args:
            trajectory: simple (TrapezoidalTrajectory) or complex (ComplexTrajectory).
            argument: the argument of a complex one; None: time since the start [s].

        Raises:
            StateError: the control mode is not TRAJECTORY.
            LimitError: a boundary value, a limit or the duration exceeds the ability of the motor.
            UnsupportedError: the motor cannot follow a trajectory of that kind.
        """
        self._require_mode(ControlMode.TRAJECTORY, "set_trajectory")
        require_argument(self.name, argument)
        planning.check_trajectory(self.name, self.model, self._variable, trajectory, argument)
        self._call(self._check_command, self._variable, trajectory)
        self._command = trajectory
        self._argument = argument

    # ---- motion ----

    @final
    def start(self, timeout_s: float | None = None) -> None:
        """Start the commanded motion, with the settings made here.

        This is one atomic operation. The motor is acquired, and connected and enabled if necessary;
        changed settings are transmitted; the motion is started and acknowledged. Otherwise an error
        is raised and nothing has moved. Another start repeats the command. During a motion a
        set-point replaces a set-point of its variable, and a command of velocity, torque or current
        replaces one of the same variable. All other commands start from rest.

        Args:
            timeout_s: timeout, first come first served, while another logical motor, of any
                process, holds it [s]; None: wait for a short operation only.

        Raises:
            StateError: no command is set, a motion is active, or homing is required first.
            LimitError: the path leaves the limits.
            MotorBusyError: another logical motor holds it; names holder, purpose and time.
            DeviceFault: the drive reports a fault: reset_fault() first.
            MotionInterrupted: another party stopped the motor meanwhile.
        """
        start_together((self,), timeout_s)

    @final
    @contextmanager
    def reserve(
        self,
        purpose: str = "",
        *,
        timeout_s: float | None = None,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> Iterator[Reservation]:
        """Reserve the motor for several motions: `with motor.reserve("survey"):`.

        Inside the block no other owner, of any process, commands it; others may read it, and may
        stop it. A motion that is active at the end holds the motor until it has ended, without a
        lease. A takeover interrupts the motion of the former owner. Until the end of its block the
        former owner is refused, with the name of the new one, unless it reserves the motor again.

        Args:
            purpose: reported to other requests that are refused.
            timeout_s: timeout for the motor [s], as in `start`; with a takeover, for its rest.
            lease_s: another owner may take it over after this time without use [s]: no operation,
                no wait, no `Reservation.renew`; None: never.
            take_over: take it from its owner, ahead of all waiters, and bring it to rest.

        Raises:
            MotorBusyError: another owner holds or moves it, or is in the middle of a write.
            DeadlineExceeded: a motor that was taken over does not come to rest.
        """
        check_timeout(timeout_s)
        check_lease(lease_s)
        check_take_over(take_over)
        if not isinstance(purpose, str):
            raise UsageError(f"{self.name}: purpose {purpose!r} is not text; describe it in words")
        patience = None if timeout_s is None else self._patience(as_number(timeout_s))
        who, asked_ns = f"reserve() of {self.name}", self.runtime.now_ns()
        physical = self._physical
        if take_over:
            physical.require_not_held_elsewhere()
        with physical.ownership.owned(
            self, who, purpose, patience, lease_s=lease_s, take_over=take_over, afresh=True
        ) as claim:
            with physical.transaction(self.runtime, who):
                self._take_physical(take_over or physical.ownership.is_orphan)
                if physical.ownership.is_orphan:
                    self._call(self._connect)
                    self._adopt(timeout_s if take_over else None, asked_ns)
            yield Reservation((self.name,), (claim,))

    @final
    def wait_until_done(self, timeout_s: float | None = None) -> None:
        """Wait until the last command (motion, homing or stop), if any, has ended.

        A velocity, torque or current set-point is done when it is reached, and continues.

        Args:
            timeout_s: [s]; None: no timeout.

        Raises:
            DeadlineExceeded: not within `timeout_s`; the motion continues.
            MotionInterrupted: another party stopped or replaced the motion.
            DeviceFault: the drive has a fault.
            LinkError: the drive no longer responds.
        """
        wait_for_all((self,), timeout_s)

    @final
    def stop(self) -> None:
        """Slow down and end the motion; wait_until_done() waits for rest.

        A stop needs no ownership, and may be called from a callback, as may `quick_stop` and
        `halt`.
        """
        self._bring_to_rest("stop", self._stop)

    @final
    def quick_stop(self) -> None:
        """Stop by the quick stop of the drive; the motor moves again only after enable()."""
        self._bring_to_rest("quick_stop", self._quick_stop)

    @final
    def halt(self) -> None:
        """Stop according to the halt option of the drive, and end the motion."""
        self._bring_to_rest("halt", self._halt)

    # ---- power, fault, reference ----

    @final
    def enable(self) -> None:
        """Switch on the power stage; the motor holds its position.

        Raises:
            DeviceFault: the drive reports a fault: reset_fault() first.
        """
        with self._operation("enable"):
            if require_no_fault(self) is not MotorState.ENABLED:
                self._call(self._enable)

    @final
    def disable(self) -> None:
        """Switch off the power stage and end the motion; a moving motor coasts."""
        with self._operation("disable"):
            status = self._status()
            self._call(self._disable)
            self._physical.end(f"disable() of {self.name}", self.runtime.now_ns(), status)

    @final
    def reset_fault(self) -> None:
        """Clear the fault, if any; the power stage is off afterwards.

        Raises:
            DeviceFault: its cause persists.
        """
        with self._operation("reset_fault"):
            fault = self._call(self._read_fault)
            if fault is None:
                return
            self._call(self._reset_fault)
            by = f"fault {fault.code:04X}h"
            self._physical.end(by, self.runtime.now_ns(), RunStatus.FAILED)

    @final
    def home(
        self, method: int | None = None, *, wait: bool = True, timeout_s: float = _HOMING_TIMEOUT_S
    ) -> None:
        """Find position 0 of the motor.

        Args:
            method: homing method number of CiA 402 (37: present position); None: the default of the
                hardware.
            wait: False: only begin; wait_until_done() waits for the end.
            timeout_s: timeout [s]; after that it is stopped.

        Raises:
            UnsupportedError: the motor does not support the method.
            PeerError: homing failed.
            DeadlineExceeded: not within `timeout_s`.
        """
        if method is not None and (not isinstance(method, int) or not -128 <= method <= 127):
            what = f"homing method {method!r}"
            raise UsageError(f"{self.name}: {what}: CiA 402 numbers them -128 to 127")
        check_timeout(timeout_s)
        with self._operation("home"):
            require_rest(self, "home")
            if require_no_fault(self) is not MotorState.ENABLED:
                self._call(self._enable)
            self._begin("home", None)
            try:
                self._call(self._home, method)
            except BaseException as error:
                self._physical.end(f"{error!r}", self.runtime.now_ns(), RunStatus.FAILED)
                raise
        if not wait:
            return
        try:
            self.wait_until_done(timeout_s)
        except BaseException:
            if not self._physical.ownership.is_lost_by(self):
                self.stop()
            raise

    # ---- direct hardware access ----

    @final
    def low_level(self, *, timeout_s: float | None = None) -> AbstractContextManager[Any]:
        """Return a context with exclusive hardware access: `with motor.low_level() as hardware:`.

        Inside the block no other part of the interface accesses the hardware, for any logical motor
        including this one. Operations and stops are refused; readings return the last value
        received, or are refused; see `motorhil.motorapi.motor`. The hardware object is for this
        thread
        only. Afterwards nothing is assumed of the hardware: the next start writes all its settings.
        A nested block of the same motor has no effect.

        Args:
            timeout_s: timeout, first come first served, for other low-level access and for the end
                of a motion [s]; None: do not wait.

        Raises:
            MotorBusyError: another logical motor holds or moves it.
            StateError: a motion of this one is active.
            UnsupportedError: the adaptation does not offer its hardware object.
        """
        return low_level_access(self, timeout_s)

    # ---- internal ----

    @final
    def _bring_to_rest(self, operation: str, hook: Callable[[], None]) -> None:
        with self._physical.interrupt(self.name):
            status = self._status()
            self._call(self._connect)
            self._call(hook)
            run = ActiveMotion(f"{operation}() of {self.name}", self, self.runtime.now_ns(), None)
            self._run = run
            self._physical.begin(run, status)
            self._keep()

    @final
    def _require_mode(self, mode: ControlMode, operation: str) -> None:
        if self._mode is not mode:
            found = "not set" if self._mode is None else self._mode.name
            raise StateError(
                motor=self.name,
                operation=operation,
                state=f"its control mode is {found}",
                remedy=f"call set_control_mode(ControlMode.{mode.name}) first",
            )
