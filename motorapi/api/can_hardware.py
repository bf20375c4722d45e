"""The hardware object of a drive on a CAN bus, as far as all kinds agree.

A kind derives a class, names its constants, and adds its protocol: what it sends, what comes, and
what must be known before a command. `StreamedCanHardware` is for drives to which the host streams.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Final, Generic, NamedTuple, TypeVar

from motorhil.motorapi.api.can_drive import CanDrive, checked_node
from motorhil.motorapi.api.registration import Options
from motorhil.motorapi.api.streamed_motion import StreamedMotion
from motorhil.motorapi.ownership.claim import LockAction, OwnershipEvent
from motorhil.motorapi.state import Fault, Measurement, MotorState

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.runtime.api import Runtime

_ASK_S: Final = 0.05
OptionsT = TypeVar("OptionsT", bound=Options)


class CanHardware(ABC, Generic[OptionsT]):
    """One drive on a CAN bus, by node number; shared by all logical motors and threads.

    Args:
        bus: an open python-can bus with any interface.
        node_id: the number of the drive.
        runtime: the runtime for waits; None: the bus's own, else wall time.
        options: the options; None: the defaults.

    Attributes:
        OPTIONS: the class of its options.
        NOUN: the drive with its article, for messages ("an RMD").
        NODE_ID_MIN, NODE_ID_MAX: the smallest node number, and the largest one.
        LACKS: the missing messages, if it is not heard ("heartbeat and version").
        CONNECT_S: the longest time until it is heard [s].
        EXTENDED, FD: as in `CanDrive`.
        node_id, options: as given.
        drive: its connection.
        label: its name in messages.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this drive exists already, or a number is out of range.
    """

    OPTIONS: type[OptionsT]
    NOUN: ClassVar[str]
    NODE_ID_MIN: ClassVar[int] = 0
    NODE_ID_MAX: ClassVar[int]
    LACKS: str
    CONNECT_S: float = 3.0
    EXTENDED: ClassVar[bool] = False
    FD: ClassVar[bool] = False

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        *,
        runtime: "Runtime | None" = None,
        options: OptionsT | None = None,
    ) -> None:
        what, low = f"node_id of {self.NOUN}", self.NODE_ID_MIN
        self.node_id: Final = checked_node(node_id, self.NODE_ID_MAX, what, low=low)
        self.options: Final = self.OPTIONS() if options is None else options
        self.users: int = 0
        self.drive: Final = CanDrive(
            bus, node_id, self, runtime=runtime, extended=self.EXTENDED, fd=self.FD
        )
        self.label: Final = self.drive.label
        self._is_connected = False
        try:
            self._begin()
        except BaseException:
            self.drive.close(at_rest=True)
            raise

    # --- what a kind adds

    @abstractmethod
    def _begin(self) -> None:
        """Declare its state, the frames that come, and what is repeated; send nothing."""

    @abstractmethod
    def _knows(self) -> bool:
        """Return whether all has come that commands need."""

    def _greet(self) -> None:
        """Ask for what commands need; does not wait. By default, the drive tells it by itself."""

    def _connected(self) -> None:
        """Check what has come (PeerError), and declare the traffic; may wait."""

    def _lose(self) -> None:
        """Forget all that must come anew after a loss; for `CanDrive.expect`."""
        self._is_connected = False
        self.forget()

    def _rests(self) -> bool:
        """Return whether no motion goes on."""
        return True

    def forget(self) -> None:
        """Forget what the drive was told: another program commands it, or it was lost."""
        self.drive.doubt()

    def overheard(self, by: str, time_ns: int) -> None:
        """Note that another program has commanded the drive; see `CanDrive.overheard`."""
        self.forget()
        self.drive.overheard(by, time_ns)

    # --- what all have

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self.drive.is_closed

    def close(self) -> None:
        """Stop sending and receiving."""
        self.drive.close(at_rest=self._rests())
        self.forget()

    def is_up(self) -> bool:
        """Return whether all is known that commands need."""
        return self._knows() and not self.drive.is_lost

    def connect(self) -> None:
        """Wait until the drive is heard; free if it is.

        Raises:
            LinkError: it is not heard, or this object is closed, or the bus is off.
            PeerError: it is not as expected.
        """
        if self._is_connected and self.is_up():
            return
        self._is_connected = False
        self.drive.connect(self.is_up, self._greet, self.CONNECT_S, self.LACKS)
        self._connected()
        self._is_connected = True


class Estimate(NamedTuple):
    """Position and velocity in units of the drive, and when they were complete on the bus [ns]."""

    position: float
    velocity: float
    time_ns: int


class StreamedCanHardware(CanHardware[OptionsT]):
    """The hardware object of a `StreamedMotor`: a drive without a profile generator.

    A kind adds `is_on`, `send` and `stop_anyway`; its `_begin` calls `_stream`, and declares the
    frame of a set-point by `CanDrive.starts_by`.

    Attributes:
        motions: the motion that is streamed to it.
        estimate: the last measurement, or None.
        fault: its fault until it is reset, or None.
    """

    motions: StreamedMotion

    def _stream(self, period_ms: float, lead_ms: float) -> None:
        """Prepare the stream; see `StreamedMotion`."""
        self.estimate: Estimate | None = None
        self.fault: Fault | None = None
        self.motions = StreamedMotion(self.drive, period_ms / 1e3, lead_ms / 1e3)
        self.drive.physical.ownership.listeners.append(self._see_ownership)

    def _see_ownership(self, event: OwnershipEvent) -> None:
        """End a repeated command when another program has taken the motor over."""
        lock = self.drive.physical.ownership.lock
        if event.action is LockAction.LOST and lock is not None and lock.hold is None:
            self.forget()

    def _rests(self) -> bool:
        return not self.motions.is_under_way

    def forget(self) -> None:
        """End the stream, and forget what the drive was told."""
        self.motions.forget()
        super().forget()

    @property
    @abstractmethod
    def is_on(self) -> bool:
        """True if the motor has current, as far as known."""

    def see_fault(self, code: int, text: str, time_ns: int) -> None:
        """Note the fault that the drive reports, 0 for none; a new one ends the motion."""
        if code and (self.fault is None or self.fault.code != code):
            self.motions.forget()
            self.fault = Fault(code, text, time_ns)

    def measurement(self, units: float) -> Measurement | None:
        """Return the last measurement, with so many units of the drive per unit of the model."""
        last = self.estimate
        if last is None:
            return None
        state = MotorState.ENABLED if self.is_on else MotorState.DISABLED
        state = state if self.fault is None else MotorState.FAULT
        return Measurement(last.time_ns, state, last.position / units, last.velocity / units)

    def await_clear(self, read: Callable[[], int], timeout_s: float) -> None:
        """Read the fault until it is 0 or the time [s] is over; forget the fault if it is 0."""
        runtime = self.drive.runtime
        end_ns = runtime.now_ns() + round(timeout_s * 1e9)
        while (code := read()) and runtime.now_ns() < end_ns:
            runtime.wait_until(lambda: False, _ASK_S)
        if not code:
            self.fault = None

    def measured(self) -> tuple[float, float]:
        """Return position and velocity, extrapolated to the present."""
        last = self.estimate
        assert last is not None  # connected before
        age_s = (self.drive.runtime.now_ns() - last.time_ns) / 1e9
        return last.position + last.velocity * age_s, last.velocity
