"""The connection to one device on a line, and the ownership of its motor.

A request without effect is repeated if its answer is lost; the line separates late answers from the
next. A command is sent once, as it may have been executed.

Two locks coordinate processes, as on CAN: one for the ownership of the drive, one for the exchanges
on its line.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from motorhil.motorapi.api.line_exchanges import (
    AnswerT,
    ByteLine,
    Exchange,
    ExchangeLine,
    LineProtocolViolation,
    RequestT,
    is_silence,
)
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorError, PeerError, UsageError
from motorhil.motorapi.locking.directory import line_name
from motorhil.motorapi.locking.process_lock import ProcessLock, can_share_time
from motorhil.motorapi.ownership.physical_motor import (
    register_physical_motor,
    release_physical_motor,
)

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.fencing import Owned
    from motorhil.motorapi.runtime.api import Runtime

LineT = TypeVar("LineT", bound=ExchangeLine[Any, Any])

_READS_MAX: Final = 2  # of the same request
_READ_NS: Final = 2_000_000_000  # after this time a request is not repeated


def _open(kind: type[LineT], line: ByteLine, runtime: "Runtime") -> LineT:
    def make() -> LineT:
        where = line_name(line) if can_share_time(runtime) else None
        lock: ProcessLock | None = None
        if where is not None:
            label = f"the line {line.name}"
            lock = ProcessLock(f"{where}-exchange", label, runtime=runtime)
        return kind(line, runtime, lock)

    known = context_of(line).parts.part(kind, make)
    known.users += 1
    return known


def _release(line: ExchangeLine[Any, Any]) -> None:
    line.users -= 1
    if line.users == 0:
        context_of(line.line).parts.drop(line)
        line.close()


class LineUnit(ABC, Generic[RequestT, AnswerT]):
    """One device on a line, and the record of its motor.

    A protocol derives a class with its requests, and names the class of its lines.

    Args:
        line: the line of the device.
        unit: its address.
        runtime: the runtime to wait with.
        hardware: the hardware object of the motor.
        timeout_s: the response timeout [s].

    Attributes:
        LINE: the class of the protocol's lines.
        repeats: number of requests that were repeated.
        silences: number of requests without an answer; each may mean a loss of power.

    Raises:
        UsageError: a hardware object for the unit exists already, or the address is not valid.
    """

    LINE: ClassVar[type[ExchangeLine[Any, Any]]]

    def __init__(
        self, line: ByteLine, unit: int, runtime: "Runtime", hardware: object, timeout_s: float
    ) -> None:
        units = self._units(line)
        if isinstance(unit, bool) or not isinstance(unit, int) or unit not in units:
            what = f"must be a server address, {units[0]} to {units[-1]}"
            raise UsageError(f"unit = {unit!r}: {what}")
        own = getattr(line, "wall", getattr(line, "runtime", None))
        if own is not None and own is not runtime:
            raise UsageError(f"{line.name} is read by another runtime: use the line's own runtime")
        self.unit: Final = unit
        self.runtime: Final = runtime
        self.timeout_s: Final = timeout_s
        self.label: Final = f"{line.name} unit {unit}"
        where = line_name(line) if can_share_time(runtime) else None
        lock: ProcessLock | None = None
        if where is not None:
            lock = ProcessLock(f"{where}-unit{unit}", self.label, runtime=runtime)
        self.physical: Final = register_physical_motor(line, unit, self.label, hardware, lock)
        self._hardware = hardware
        self.line: Final[ExchangeLine[RequestT, AnswerT]] = _open(self.LINE, line, runtime)
        self.line.timeout_max_s = max(timeout_s, self.line.timeout_max_s)
        self.is_closed: bool = False
        self.silences: int = 0
        self.repeats: int = 0
        self._answers = False  # False: requests are not repeated until the drive answers

    @abstractmethod
    def _units(self, line: ByteLine) -> range:
        """Return the valid addresses on a line."""

    def close(self) -> None:
        """Close the unit; further calls do nothing."""
        if not self.is_closed:
            self.is_closed = True
            release_physical_motor(self.line.line, self.unit, self._hardware)
            _release(self.line)

    def _require_open(self) -> None:
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    @property
    def standing(self) -> tuple[int, int]:
        """A token that is constant while the motor keeps its owner and always answers.

        Values read from the drive, or written to it, are valid only that long.
        """
        return self.physical.token, self.silences + self.line.reconnections

    def ask_repeatedly(self, request: Callable[[], RequestT]) -> AnswerT:
        """Send a request without effect; ask a device that answered before once more, within 2 s.

        Raises: as `ExchangeLine.ask`.
        """
        end_ns = self.runtime.now_ns() + _READ_NS
        left = _READS_MAX if self._answers else 1
        while True:
            left -= 1
            try:
                return self._ask_once(request())
            except (DeadlineExceeded, PeerError) as error:
                if not _is_lost(error):
                    raise
                if not left or self.runtime.now_ns() >= end_ns:
                    self._answers = False
                    self.silences += is_silence(error)
                    raise
                self.repeats += 1

    def ask_patiently(self, request: Callable[[], RequestT], patience_s: float) -> AnswerT:
        """Send a request without effect to a device that may be booting, until it answers.

        Raises: as `ExchangeLine.ask`, after `patience_s` [s].
        """
        end_ns = self.runtime.now_ns() + round(patience_s * 1e9)
        while True:
            try:
                return self._ask_once(request())
            except (DeadlineExceeded, PeerError) as error:
                self.silences += is_silence(error)
                if not _is_lost(error) or self.runtime.now_ns() >= end_ns:
                    raise

    def _ask_once(self, request: RequestT) -> AnswerT:
        self._require_open()
        answer = self.line.ask(request, self.unit, self.timeout_s)
        self._answers = True
        return answer

    def command(self, request: RequestT, *, starts: bool = False) -> AnswerT:
        """Send a command once; only while this process owns the motor, if others can own it.

        One that `starts` a motion goes before all requests that wait for the line, except stops.

        Raises: as `ExchangeLine.ask`; MotorBusyError if the motor was taken over, or if a motor on
            this unit has reserved or moves it, and this is not one of its operations.
        """
        self._require_open()
        self.physical.require_free()
        try:
            answer = self.line.ask(request, self.unit, self.timeout_s, *self.owned, starts=starts)
        except MotorError as error:
            self.silences += is_silence(error)
            raise
        self._answers = True
        return answer

    @property
    def owned(self) -> "tuple[Owned, ...]":
        """The ownership that commands need."""
        ownership = self.physical.ownership
        return (ownership,)

    def post_request(
        self,
        request: RequestT,
        on_over: Callable[[Exchange[RequestT, AnswerT]], None] | None = None,
        *,
        urgent: bool = True,
    ) -> Exchange[RequestT, AnswerT]:
        """Send a request without waiting and without owning the motor: for stops, if urgent."""
        self._require_open()
        return self.line.post(request, self.unit, self.timeout_s, on_over, urgent=urgent)


def _is_lost(error: MotorError) -> bool:
    """Return whether the error means that the answer was lost or spoiled."""
    return isinstance(error, LineProtocolViolation) or is_silence(error)
