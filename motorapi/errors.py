"""All errors of the motor interface, in one class tree.

    MotorError
    |-- UsageError            your mistake; nothing was sent
    |   |-- LimitError        a value lies outside what the motor, or its model, allows
    |   |-- DomainError       a function has no value at that argument
    |   |-- StateError        not now: what the motor is doing, or is, forbids it
    |   |-- UnsupportedError  this motor can never do it
    |   |-- SynchronizationError  these motors cannot begin together as well as was asked
    |   `-- FileError         a file of yours says what it cannot mean: path, line, key, remedy
    |-- MotorBusyError        somebody else holds the motor: who, since when
    |-- MotionInterrupted     the motion waited for was stopped or replaced by somebody else
    |-- PeerError             the device refused, or broke its protocol
    |-- DeviceFault           the drive reports a fault: code, since when
    |-- LinkError             the bus is off, closed, or the device is not there any more
    |-- DeadlineExceeded      what was awaited, for how long, what was heard last
    `-- PluginError           an adaptation, or a callback, broke its contract

Attributes carry the facts, so that callers need not parse a message. Messages carry value, limit,
unit and motor. All errors can be pickled. Adaptations add subclasses of `PeerError` only.
"""

from collections.abc import Callable
from typing import final


class MotorError(Exception):
    """Any error between an application and a motor."""

    def __reduce__(self) -> tuple[Callable[..., "MotorError"], tuple[object, ...]]:
        return _restored, (type(self), self.args, dict(self.__dict__))


def _restored(
    kind: type[MotorError], args: tuple[object, ...], facts: dict[str, object]
) -> MotorError:
    error = kind.__new__(kind, *args)  # not __init__: its keywords are already in the attributes
    error.args = args
    error.__dict__.update(facts)
    return error


class UsageError(MotorError):
    """A mistake of the caller: nothing was sent to any device."""


@final
class LimitError(UsageError):
    """A value outside a limit of the motor, of its model, or of the command itself.

    Attributes: motor (name), quantity ("velocity"), value, low and high (None: no limit on that
    side), unit ("rad/s"), reason (whose limit it is, or "").
    """

    def __init__(
        self,
        *,
        motor: str,
        quantity: str,
        value: float,
        low: float | None,
        high: float | None,
        unit: str,
        reason: str = "",
    ) -> None:
        self.motor = motor
        self.quantity = quantity
        self.value = value
        self.low = low
        self.high = high
        self.unit = unit
        self.reason = reason
        for digits in (6, 9, 12, 17):  # as many as tell the value from its limit
            told, least, most = (
                "" if one is None else f"{one:.{digits}g}" for one in (value, low, high)
            )
            if told not in (least, most):
                break
        if low is not None and high is not None:
            allowed = f"{least} to {most} {unit}"
        elif low is not None:
            allowed = f"at least {least} {unit}"
        else:
            allowed = f"at most {most} {unit}"
        tail = f" ({reason})" if reason else ""
        super().__init__(f"{motor}: {quantity} {told} {unit}, allowed is {allowed}{tail}")


def require_within(
    motor: str,
    quantity: str,
    value: float,
    bounds: tuple[float | None, float],
    unit: str,
    reason: str,
) -> None:
    """Raise LimitError for a value outside its bounds; a lower bound of None: there is none."""
    low, high = bounds
    if value > high or (low is not None and value < low):
        raise LimitError(
            motor=motor,
            quantity=quantity,
            value=value,
            low=low,
            high=high,
            unit=unit,
            reason=reason,
        )


def below_step(motor: str, quantity: str, value: float, least: float, unit: str) -> LimitError:
    """Return the error for a value below the smallest step of a drive's units, `least`."""
    return LimitError(
        motor=motor,
        quantity=quantity,
        value=value,
        low=least,
        high=None,
        unit=unit,
        reason="it is below the smallest step of the drive's units",
    )


@final
class DomainError(UsageError):
    """An argument outside the domain of a function.

    Attributes: argument, low and high (the domain, both included; -inf and inf: unbounded),
    function (in words).
    """

    def __init__(self, *, argument: float, low: float, high: float, function: str) -> None:
        self.argument = argument
        self.low = low
        self.high = high
        self.function = function
        super().__init__(
            f"the argument {argument!r} lies outside the domain, {low!r} to {high!r}, of {function}"
        )


@final
class StateError(UsageError):
    """An operation that the present state of the motor forbids.

    Attributes: motor (name), operation ("start"), state (as found), remedy.
    """

    def __init__(self, *, motor: str, operation: str, state: str, remedy: str) -> None:
        self.motor = motor
        self.operation = operation
        self.state = state
        self.remedy = remedy
        super().__init__(f"{motor}: {operation} refused, {state}; {remedy}")


@final
class UnsupportedError(UsageError):
    """An operation that this motor never supports.

    Attributes: motor (name), feature (the request), supported (the alternatives).
    """

    def __init__(self, *, motor: str, feature: str, supported: str = "") -> None:
        self.motor = motor
        self.feature = feature
        self.supported = supported
        tail = f"; it supports {supported}" if supported else ""
        super().__init__(f"{motor} does not support {feature}{tail}")


@final
class FileError(UsageError):
    """A file with invalid content.

    Attributes: path, line (from 1; None for the file as a whole), key (or None), remedy.
    """

    def __init__(
        self, *, path: str, line: int | None, key: str | None, problem: str, remedy: str
    ) -> None:
        self.path = path
        self.line = line
        self.key = key
        self.problem = problem
        self.remedy = remedy
        where = path if line is None else f"{path}:{line}"
        what = problem if key is None else f"{key}: {problem}"
        super().__init__(f"{where}: {what}; {remedy}")


@final
class MotorBusyError(MotorError):
    """A motor held by another owner.

    Attributes: motor (name), holder (in words), since_ns (in the time of the runtime), purpose
    ("low-level access"; "" if the name of the holder is sufficient). For a process that holds the
    lock between processes, also process (pid and program, None: unknown), pid, program, and since
    (in words). taken_over ("": it was not): the reason for a takeover from the caller, as "its
    lease of 0.5 s was over". remedy: advice for a holder that does not release the motor by itself,
    or "".
    """

    def __init__(
        self,
        *,
        motor: str,
        holder: str,
        since_ns: int,
        purpose: str = "",
        process: tuple[int, str] | None = None,
        since: str = "",
        taken_over: str = "",
        remedy: str = "",
    ) -> None:
        self.motor = motor
        self.holder = holder
        self.since_ns = since_ns
        self.purpose = purpose
        self.process = process
        self.pid: int | None = None if process is None else process[0]
        self.program: str = "" if process is None else process[1]
        self.since: str = since or f"{since_ns / 1e9:.6f} s"
        self.taken_over = taken_over
        self.remedy = remedy
        whom = f"{holder} for {purpose}" if purpose else holder
        how = f"was taken over ({taken_over})" if taken_over else "is held"
        tail = f"; {remedy}" if remedy else ""
        super().__init__(f"{motor} {how} by {whom} since {self.since}{tail}")


@final
class MotionInterrupted(MotorError):
    """A motion that another party ended short of its target.

    Attributes: motor (name), by (who and how, in words), at_ns.
    """

    def __init__(self, *, motor: str, by: str, at_ns: int) -> None:
        self.motor = motor
        self.by = by
        self.at_ns = at_ns
        super().__init__(f"{motor}: the motion was ended by {by} at {at_ns / 1e9:.6f} s")


class PeerError(MotorError):
    """A device that refused a request, or broke its protocol."""


@final
class DeviceFault(MotorError):
    """A fault reported by the drive, which does not move until `Motor.reset_fault`.

    Attributes: motor (name), code (the error code of the device), text, since_ns.
    """

    def __init__(self, *, motor: str, code: int, text: str, since_ns: int) -> None:
        self.motor = motor
        self.code = code
        self.text = text
        self.since_ns = since_ns
        super().__init__(
            f"{motor}: fault {code:04X}h ({text}) since {since_ns / 1e9:.6f} s;"
            " remove the cause, then reset_fault()"
        )


@final
class LinkError(MotorError):
    """A lost connection to a device: bus off, bus closed, or no response.

    Attributes: link ("can0", or "can0 node 3"), reason, since_ns (None if unknown), remedy (or "").
    """

    def __init__(
        self, *, link: str, reason: str, since_ns: int | None = None, remedy: str = ""
    ) -> None:
        self.link = link
        self.reason = reason
        self.since_ns = since_ns
        self.remedy = remedy
        tail = "" if since_ns is None else f" since {since_ns / 1e9:.6f} s"
        tail += f"; {remedy}" if remedy else ""
        super().__init__(f"{link}: {reason}{tail}")


@final
class DeadlineExceeded(MotorError):
    """An awaited event that did not happen in time.

    Attributes: awaited (in words, with the name of the motor), timeout_s, last_heard (in words).
    """

    def __init__(self, *, awaited: str, timeout_s: float, last_heard: str) -> None:
        self.awaited = awaited
        self.timeout_s = timeout_s
        self.last_heard = last_heard
        super().__init__(
            f"{awaited}: did not happen within {timeout_s:g} s; last heard: {last_heard}"
        )


@final
class PluginError(MotorError):
    """A contract broken by code plugged into the interface; its cause is chained.

    Attributes: plugin (class or function), where (the hook), problem.
    """

    def __init__(self, *, plugin: str, where: str, problem: str) -> None:
        self.plugin = plugin
        self.where = where
        self.problem = problem
        super().__init__(f"{plugin}: {where}: {problem}")
