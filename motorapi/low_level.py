"""Low-level access: exclusive use of the hardware object by one thread.

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
"""

# ruff: noqa: SLF001 -- it works the hooks of a motor, as Motor does its own

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from motorapi.commands import as_number
from motorapi.errors import MotorBusyError, StateError
from motorapi.execution import require_rest
from motorapi.motion_waits import check_timeout
from motorapi.runtime import wait_until
from motorapi.turns import LOW_LEVEL, TRANSACTION_TIMEOUT_S
from motorapi.waiting import Awaited

if TYPE_CHECKING:
    from motorapi.motor import Motor


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
