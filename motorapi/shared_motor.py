"""A logical motor as one of several that share a physical motor: what goes on, and how it ended.

Taking turns with the others is in `motorapi.sharing`; what an application commands is in
`motorapi.motor`.
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
"""How long a motor may take to come to rest that was left moving."""


class SharedMotor(ReadableMotor):
    """The part of `motorapi.motor.Motor` that knows of runs."""

    _run: Run | None = None
    _callback_error: PluginError | None = None
    _held_hardware: "tuple[Ticket, Any] | None" = None

    def __repr__(self) -> str:
        text = super().__repr__()
        doing = ""
        access, run = self._physical.access, self._physical.run
        if access is not None:
            doing = f"; {access.who} has it"
        elif run is not None and self._goes_on(run):
            doing = f"; {run.name} goes on"
        return f"{text[:-1]}{doing}>"

    @final
    def is_done(self) -> bool:
        """Whether `wait_until_done` would return at once; raises as it does."""
        done = self._look(self._run)
        if done:
            self._raise_callback_error()
        return done

    @final
    def on_done(self, callback: Callable[[Outcome], object]) -> "Registration":
        """`callback(outcome)` is called once, when what was commanded last here is over.

        At once if it is over already; else from the event that ends it, however it ends. Like
        any callback it must neither wait nor start what waits. Of a motor that must be asked it
        hears while somebody waits for that motor.

        Returns:
            What cancels it.

        Raises:
            StateError: nothing was commanded yet.
        """
        if not callable(callback):
            raise UsageError(f"{self.name}: on_done({callback!r}): give what can be called")
        run = self._run
        if run is None:
            raise StateError(
                motor=self.name,
                operation="on_done",
                state="nothing was commanded yet",
                remedy="call start() first: it tells how that motion ends",
            )
        notice = DoneNotice(
            lambda: self._outcome(run), callback, self._callback_failed, f"on_done of {self.name}"
        )
        notice.begin(self.runtime, self._physical)
        return notice

    @final
    def progress(self) -> Progress | None:
        """How far what was commanded last here is; None once it is over, or if nothing was.

        It neither waits nor sends, so callbacks may ask. What is said of velocity, torque or
        current goes on after it was reached, and so does this.
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

    # ---- inside: shared with motorapi.execution, motion_waits, low_level and group ----

    @final
    @contextmanager
    def _operation(self, name: str, timeout_s: float | None = None) -> Iterator[None]:
        """The motor is ours, connected, and nobody else operates on it inside the block."""
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
        """It does what we command; with `take_over` also if it does something for others yet."""
        self._bury_failed_run()
        now_ns = self.runtime.now_ns() if take_over else None
        self._physical.take(self, self.name, self._status(), now_ns)

    @final
    def _adopt(self, timeout_s: float | None = None, since_ns: int = 0) -> None:
        """What was left moving by one who died with the motor, or has lost it, is at rest.

        Raises:
            DeadlineExceeded: it does not come to rest, within `timeout_s` [s] of `since_ns`, if
                that is given.
        """
        if self._call(self._read_state) is MotorState.ENABLED:
            self._call(self._stop)
            left_s = _ADOPTION_S
            if timeout_s is not None:
                left_s = max(0.0, timeout_s - (self.runtime.now_ns() - since_ns) / 1e9)
            patience = Patience(left_s, lambda: None, lambda: self._call(self._refresh))
            if not patience.until(self.runtime, lambda: self._call(self._is_done), left_s):
                raise DeadlineExceeded(
                    awaited=f"rest of {self.name}, left moving by one who has it no more",
                    timeout_s=_ADOPTION_S if timeout_s is None else timeout_s,
                    last_heard=f"{self._call(self._read_velocity):g} {self.model.unit}/s",
                )
        self._physical.ownership.is_orphan = False

    @final
    @contextmanager
    def _commanding(
        self, who: str, timeout_s: float | None = None, purpose: str = ""
    ) -> "Iterator[Ticket]":
        """The motor is owned, and it is our turn. None waits for short operations only.

        The patient wait without a turn, so that its owner can go on meanwhile.
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
        """How to wait for others to end what they do with the motor."""
        return Patience(timeout_s, self._others_run, self._refresh_run)

    @final
    def _others_run(self) -> MotorBusyError | None:
        """What is told of a run of another logical motor; None: none goes on."""
        run = self._physical.run
        if run is None or run.owner is self or not self._goes_on(run):
            return None
        return MotorBusyError(motor=self.name, holder=run.name, since_ns=run.since_ns)

    @final
    def _refresh_run(self) -> float | None:
        """What the hardware tells of a run there is, is fresh; when to ask again [s], if at all."""
        run = self._physical.run
        if self._physical.access is None and (run is None or run.is_over):
            return None
        return self._refresh_freely()

    @final
    def _refresh_freely(self) -> float | None:
        """As the hook; while somebody has low-level access, nothing is asked but when to look."""
        physical = self._physical
        if physical.access is not None:
            return LOOK_PERIOD_S
        with physical.passage(self.name):
            return self._call(self._refresh)

    @final
    def _goes_on(self, run: Run) -> bool:
        """Whether the run is what the motor does, and is not over."""
        if self._physical.run is not run or run.is_over:
            return False
        status = self._status()
        return status is RunStatus.GOING or (status is RunStatus.DONE and not run.ends)

    @final
    def _keep(self) -> None:
        """No other process has the motor until what this one does with it is over."""
        physical = self._physical

        def goes_on() -> bool:
            run = physical.run
            return run is not None and run.owner is self and self._goes_on(run)

        physical.ownership.keep(self, goes_on, physical.bell, physical.news is not None)

    @final
    def _status(self) -> RunStatus:
        """How far the physical motor's run is; DONE if there is none."""
        run = self._physical.run
        if run is None or run.finished:
            return RunStatus.DONE
        try:
            return RunStatus.DONE if self._call(self._is_done) else RunStatus.GOING
        except MotorError:
            return RunStatus.FAILED

    @final
    def _bury_failed_run(self) -> None:
        """What the hardware says has failed is over, whatever it says once it is brought up."""
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
        """Whether the run is over; an error if it was ended short of its target."""
        if run is None or run.finished:
            return True
        self._raise_interruption(run)
        if not self._call(self._is_done):
            return False
        self._physical.ownership.notice(run.owner)
        self._raise_interruption(run)  # what has come to rest may be the next one's doing
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
        """How the run ended; None while it goes on."""
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
        """Raises what a callback raised since this was called last."""
        error, self._callback_error = self._callback_error, None
        if error is not None:
            raise error
