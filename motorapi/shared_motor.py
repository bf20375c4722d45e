"""A logical motor that shares a physical motor: active motion and its end.

`motorapi.sharing` coordinates logical motors; `motorapi.motor` has the commands of applications.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import TYPE_CHECKING, Any, Final, final

from motorapi.errors import (
    DeadlineExceeded,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    PluginError,
    StateError,
    UsageError,
)
from motorapi.outcome import DoneNotice, Ending, Outcome, ending_of
from motorapi.patience import Patience
from motorapi.progress import Progress, progress_of
from motorapi.readable_motor import ReadableMotor
from motorapi.sharing import Run, RunStatus
from motorapi.state import MotorState
from motorapi.waiting import LOOK_PERIOD_S

if TYPE_CHECKING:
    from motorapi.commands import Motion
    from motorapi.runtime import Registration
    from motorapi.turns import Ticket


_ADOPTION_S: Final = 30.0
"""The timeout for the rest of a motor that was left moving [s]."""


class SharedMotor(ReadableMotor):
    """The part of `motorapi.motor.Motor` that manages motions."""

    _run: Run | None = None
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

    # ---- internal: shared with motorapi.execution, motion_waits, low_level and group ----

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
            patience = Patience(left_s, lambda: None, lambda: self._call(self._refresh))
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
    def _patience(self, timeout_s: float) -> Patience:
        """Return the policy for the wait until others have finished with the motor."""
        return Patience(timeout_s, self._others_run, self._refresh_run)

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
    def _goes_on(self, run: Run) -> bool:
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
    def _begin(self, operation: str, motion: "Motion | None") -> Run:
        name = f"{operation}() of {self.name}"
        run = Run(name, self, self.runtime.now_ns(), motion)
        self._physical.begin(run, self._status())
        self._run = run
        return run

    @final
    def _look(self, run: Run | None) -> bool:
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

    def _raise_interruption(self, run: Run) -> None:
        if run.interrupted_by is not None:
            if run.error is not None:
                raise copy(run.error) from run.error.__cause__
            raise MotionInterrupted(
                motor=self.name, by=run.interrupted_by, at_ns=run.interrupted_at_ns
            )

    @final
    def _outcome(self, run: Run) -> Outcome | None:
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
