"""Waiting for the motions of one or several motors, with one deadline."""

# ruff: noqa: SLF001 -- it works the hooks of motors, as motorapi.execution does

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, final

from motorapi.commands import as_number
from motorapi.errors import DeadlineExceeded, MotorError, UsageError
from motorapi.leases import use_leases
from motorapi.runtime import wait_until
from motorapi.waiting import Awaited, Waiting

if TYPE_CHECKING:
    from motorapi.motor import Motor
    from motorapi.sharing import Run

    Answer = Callable[[Motor, Run | None, Exception], Exception]


def check_timeout(timeout_s: float | None) -> None:
    """Raise UsageError if `timeout_s` is not a valid timeout."""
    if timeout_s is not None and not as_number(timeout_s) >= 0.0:
        raise UsageError(f"timeout_s = {timeout_s!r}: must be a number of seconds >= 0")


def wait_for_all(
    motors: Sequence["Motor"], timeout_s: float | None, answer: "Answer | None" = None
) -> None:
    """Wait until the last command of all motors has ended; react to the first failure.

    Args:
        motors: motors of one runtime.
        timeout_s: [s]; None: no timeout.
        answer: called with the failed motor, its motion and the error; returns the error to be
            raised. None: raise the original error.

    Raises:
        DeadlineExceeded: not within `timeout_s` [s]; names the motors that are not done. Nothing is
            stopped.
        MotorError: the failure of a motion.
    """
    check_timeout(timeout_s)
    members = [_Member(motor) for motor in motors]
    awaited = [Awaited(one.motor._physical.news, one.is_over) for one in members]
    waiting = Waiting(awaited)

    def going() -> list[_Member]:
        return [m for m, one in zip(members, awaited, strict=True) if one in waiting.going]

    runtime = motors[0].runtime
    deadline_ns: int | None = None
    if timeout_s is not None:
        deadline_ns = runtime.now_ns() + round(min(timeout_s, 1e9) * 1e9)
    while True:
        again_s = [one.motor._refresh_freely() for one in going() if one.run is not None]
        again_s += [one.motor._physical.ownership.use(one.motor) for one in going()]
        again_s.append(use_leases())
        pauses_s = [pause_s for pause_s in again_s if pause_s is not None]
        if deadline_ns is not None:
            pauses_s.append(max(0, deadline_ns - runtime.now_ns()) / 1e9)
        try:
            if wait_until(runtime, waiting.all_over, min(pauses_s) if pauses_s else None):
                for motor in motors:
                    motor._physical.ownership.look()
                    motor._raise_callback_error()
                return
        except _MemberFailed as failed:
            error = failed.error
            if answer is not None:
                error = answer(failed.motor, failed.run, error)
            raise error from error.__cause__
        if deadline_ns is not None and runtime.now_ns() >= deadline_ns:
            break
    raise DeadlineExceeded(
        awaited=f"end of motion of {', '.join(one.motor.name for one in going())}",
        timeout_s=0.0 if timeout_s is None else timeout_s,
        last_heard="; ".join(_last_heard(one.motor) for one in going()),
    )


@final
class _Member:
    """A motor with its motion at the beginning of the wait."""

    def __init__(self, motor: "Motor") -> None:
        self.motor = motor
        self.run = motor._run

    def is_over(self) -> bool:
        try:
            return self.motor._look(self.run)
        except Exception as error:
            raise _MemberFailed(self.motor, self.run, error) from error


@final
class _MemberFailed(MotorError):  # noqa: N818 -- never leaves this module
    def __init__(self, motor: "Motor", run: "Run | None", error: Exception) -> None:
        super().__init__()
        self.motor = motor
        self.run = run
        self.error = error


def stop_others(motors: Sequence["Motor"], failed: "Motor", error: Exception) -> None:
    """Stop all motors except the failed one; a note on the error reports this."""
    if len(motors) == 1:
        return
    error.add_note(f"from {failed.name}; the others of its group were stopped")
    for motor in motors:
        if motor is not failed and not motor._physical.ownership.is_lost_by(motor):
            try:
                motor.stop()
            except Exception as further:
                error.add_note(f"but {motor.name} could not be stopped: {further}")


def _last_heard(motor: "Motor") -> str:
    latest = motor.latest()
    if latest is None:
        return f"{motor.name}: nothing"
    text = f"{motor.name}: {latest.state.value} at {latest.time_ns / 1e9:.6f} s"
    if latest.position is not None:
        text += f", {latest.position:g} {motor.model.unit}"
    if latest.velocity is not None:
        text += f", {latest.velocity:g} {motor.model.unit}/s"
    return text
