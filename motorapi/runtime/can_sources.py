"""CAN buses on the wall clock: their frames, and the condition of their controller.

There is one kind of frame source per kind of python-can bus.

A source yields Linux can_frame bytes, or canfd_frame bytes if the bus object was opened for CAN FD,
and distinguishes own frames from others:

- SocketCAN: the socket is read directly. The kernel returns own frames once they are on the wire
  (CAN_RAW_RECV_OWN_MSGS) and marks them with MSG_CONFIRM. This is exact; `is_rx` of python-can is
  False for frames from any process on this host.
- A bus that exchanges raw frames (the emulated bus, over a socket) is read as it is.
- Any other bus: through `recv` and `send`. Such a bus does not report transmission; a frame counts
  as transmitted when `send` returns.

The condition of a bus is that of the host's CAN controller: error active, passive or bus-off. Error
messages have the SocketCAN format: a can_frame of 8 bytes with ERR_FLAG in its identifier,
whose other bits are error classes. All listeners (`Runtime.listen`) receive them. They are not bus
traffic: no node has sent them. An adaptation has one `BusStatus` per bus. The adaptation passes
error messages to `hear`, and checks the status before it sends and while it waits:

- In bus-off (256 transmit errors) nothing is sent or received: `check` raises LinkError.
- Operations that were waiting when the bus went off fail at once with `failure`, even if the bus
  recovers a moment later: `offs` counts the transitions.
- A controller that stays error passive because of its transmissions gets no ACK: no other node is
  active.

Source: Linux include/uapi/linux/can/error.h.
"""

import errno
import select
import socket
import struct
import time
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.motorapi.errors import LinkError, UsageError

if TYPE_CHECKING:
    import can

Heard = tuple[bytes, int, bool]
"""(can_frame or canfd_frame, its age [ns], True for an own frame that was transmitted)."""

CAN_FRAME_BYTES: Final = 16
_FRAME: Final = struct.Struct("<IB3x8s")
_FD_FRAME: Final = struct.Struct("<IBB2x64s")
_FD_FRAME_BYTES: Final = 72
_BRS: Final = 0x01  # flags of a canfd_frame, as in linux/can.h
_ESI: Final = 0x02
_FDF: Final = 0x04  # not every driver sets it
_LENGTHS: Final = range(9)
_FD_LENGTHS: Final = (*_LENGTHS, 12, 16, 20, 24, 32, 48, 64)  # ISO 11898-1:2015, by DLC
_NEVER_NS: Final = -1
_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
ERROR_FLAG: Final = 0x2000_0000
ERROR_BYTE: Final = 0x20  # in the last byte of an identifier
_ERROR_CLASSES: Final = 0x3FF  # linux/can/error.h
_ERROR_BYTES: Final = 8  # CAN_ERR_DLC
# Linux: linux/socket.h, uapi/linux/can.h, uapi/linux/can/raw.h, asm-generic/socket.h
_AF_CAN: Final = 29
_SOL_CAN_RAW: Final = 101
_CAN_RAW_RECV_OWN_MSGS: Final = 4
_SCM_TIMESTAMPNS: Final = 35
_MSG_CONFIRM: Final = 0x800
_QUEUE_FULL_S: Final = 0.1
_QUEUE_PAUSE_S: Final = 0.0005
_TIMESPEC: Final = struct.Struct("@ll")
# Error messages: linux/can/error.h
_CONTROLLER: Final = 0x004
_NO_ACKNOWLEDGE: Final = 0x020
_BUS_OFF: Final = 0x040
_RESTARTED: Final = 0x100
_COUNTERS: Final = 0x200
_RX_WARNING: Final = 0x04
_TX_WARNING: Final = 0x08
_RX_PASSIVE: Final = 0x10
_TX_PASSIVE: Final = 0x20
_ACTIVE: Final = 0x40


class FrameSource(Protocol):
    """One bus as a source and sink of frames."""

    reports_own: bool
    """True if `receive` returns own frames after their transmission."""

    def open(self) -> None:
        """Prepare the bus for `receive`.

        Raises:
            UsageError: a can.Notifier already reads this bus object.
            LinkError: the bus is closed.
        """

    def receive(self, timeout_s: float) -> Heard | None:
        """Return the next frame, or None after `timeout_s` [s]. Raise if the bus is gone."""

    def send(self, frame: bytes) -> None:
        """Queue the frame for transmission.

        Raises:
            LinkError: the bus does not accept the frame.
        """

    def close(self) -> None:
        """Restore the settings that the bus object had before `open`."""


def source_of(bus: "can.BusABC") -> FrameSource:
    """Return the most precise source that this bus object supports."""
    if callable(getattr(bus, "receive_frame", None)) and callable(getattr(bus, "transmit", None)):
        return _FrameBusSource(bus)
    raw = getattr(bus, "socket", None)
    one_channel = bool(getattr(bus, "channel", ""))  # "" is SocketCAN's "all channels"
    if one_channel and isinstance(raw, socket.socket) and raw.family == _AF_CAN:
        return _SocketCanSource(bus, raw)
    return _MessageSource(bus)


def pack(
    can_id: int, data: bytes = b"", *, flags: int | None = None, remote: int | None = None
) -> bytes:
    """Return a can_frame, or a canfd_frame if `flags` are given.

    Args:
        can_id: the identifier, with EFF_FLAG for one of 29 bits.
        data: 0 to 8 bytes; in CAN FD 0 to 8, 12, 16, 20, 24, 32, 48 or 64.
        flags: those of a CAN FD frame; 1: bit rate switch.
        remote: requested length of a remote frame, which has no data.

    Raises:
        ValueError: the data have another length.
    """
    length = len(data) if remote is None else remote
    if length not in (_LENGTHS if flags is None else _FD_LENGTHS):
        kind, limit = ("CAN frame", "0 to 8") if flags is None else ("CAN FD frame", "up to 64")
        raise ValueError(f"{kind} {can_id & 0x1FFF_FFFF:X}h: {length} bytes of data; {limit} fit")
    if flags is not None:
        return _FD_FRAME.pack(can_id, length, flags | _FDF, data)
    return _FRAME.pack(can_id if remote is None else can_id | _RTR, length, data)


def require_fd(bus: "can.BusABC") -> None:
    """Check that this bus object was not opened for classical CAN; a line of bytes never was.

    Raises:
        UsageError: it was.
    """
    protocol = getattr(bus, "protocol", None)
    if protocol is None:
        return
    from can import CanProtocol

    if protocol is CanProtocol.CAN_20:
        raise UsageError(
            f"{bus.channel_info}: opened for classical CAN; open it with fd=True to exchange CAN "
            "FD frames (interface 'virtual': with protocol=can.CanProtocol.CAN_FD)"
        )


def _refuse_second_reader(bus: "can.BusABC") -> None:
    import can

    if can.Notifier.find_instances(bus):
        raise UsageError(
            f"{bus.channel_info}: a can.Notifier already reads this bus object, and each frame "
            "reaches one reader only; stop it, or open another bus object for this channel"
        )


def _cannot_send(bus: "can.BusABC", error: Exception) -> LinkError:
    return LinkError(link=str(bus.channel_info), reason=f"cannot send: {error}")


class _FrameBus(Protocol):
    """A bus that exchanges raw frames (an `EmulatedBus` over a socket)."""

    def receive_frame(self, timeout_s: float) -> tuple[bytes, int, bool] | None:
        """Return (frame, time by the clock of the bus [ns], transmitted), or None."""

    def transmit(self, frame: bytes) -> None: ...


@final
class _FrameBusSource:
    def __init__(self, bus: "can.BusABC") -> None:
        self.reports_own = True
        self._bus = bus
        self._frames: _FrameBus = bus  # type: ignore[assignment]  # source_of has looked
        self._lead_ns = 0  # offset to the bus clock, from the frame with the least delay
        self._last_ns = _NEVER_NS

    def open(self) -> None:
        _refuse_second_reader(self._bus)

    def receive(self, timeout_s: float) -> Heard | None:
        """Return the next frame, with its age by the clock of the bus, not of this process."""
        heard = self._frames.receive_frame(timeout_s)
        if heard is None:
            return None
        frame, bus_ns, transmitted = heard
        now_ns = time.monotonic_ns()
        if self._last_ns == _NEVER_NS or now_ns - bus_ns < self._lead_ns:
            self._lead_ns = now_ns - bus_ns
        self._last_ns = max(self._last_ns, bus_ns + self._lead_ns)
        return frame, now_ns - self._last_ns, transmitted

    def send(self, frame: bytes) -> None:
        from can import CanError

        try:
            self._frames.transmit(frame)
        except (CanError, OSError) as error:
            raise _cannot_send(self._bus, error) from error

    def close(self) -> None:
        pass


@final
class _SocketCanSource:
    def __init__(self, bus: "can.BusABC", raw: socket.socket) -> None:
        self.reports_own = True
        self._bus = bus
        self._socket = raw
        self._own_before = 0

    def open(self) -> None:
        _refuse_second_reader(self._bus)
        try:
            self._own_before = self._socket.getsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS)
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS, 1)
        except OSError as error:
            reason = f"cannot be read: {error}"
            raise LinkError(link=str(self._bus.channel_info), reason=reason) from error

    def receive(self, timeout_s: float) -> Heard | None:
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return None
        frame, ancillary, flags, _ = self._socket.recvmsg(_FD_FRAME_BYTES, 64)
        age_ns = 0
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SCM_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(data)
                age_ns = max(0, time.time_ns() - (seconds * 1_000_000_000 + nanoseconds))
        return _without_padding(frame), age_ns, bool(flags & _MSG_CONFIRM)

    def send(self, frame: bytes) -> None:
        deadline_s = time.monotonic() + _QUEUE_FULL_S
        while True:
            try:
                self._socket.send(frame)
            except OSError as error:
                # ENOBUFS: the queue of the interface (10 frames by default) is full at the moment.
                if error.errno != errno.ENOBUFS or time.monotonic() > deadline_s:
                    raise _cannot_send(self._bus, error) from error
                time.sleep(_QUEUE_PAUSE_S)
            else:
                return

    def close(self) -> None:
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS, self._own_before)


def _without_padding(frame: bytes) -> bytes:
    """Return the frame with zeros in the padding and after the data: drivers leave garbage."""
    if len(frame) == _FD_FRAME_BYTES:
        can_id, length, flags, data = _FD_FRAME.unpack(frame)
        return _FD_FRAME.pack(can_id, length, flags & (_BRS | _ESI) | _FDF, data[:length])
    can_id, length, data = _FRAME.unpack(frame)
    if can_id & _RTR:
        return _FRAME.pack(can_id, length, b"")
    return _FRAME.pack(can_id, length, data[:length])


def _error_of(message: "can.Message") -> bytes:
    """Return the error message of an error frame, or an empty one if its format is not SocketCAN's.

    Other interfaces define the identifier and data of an error frame in their own ways.
    """
    data, classes = bytes(message.data), message.arbitration_id
    if message.is_extended_id or len(data) != _ERROR_BYTES or classes & ~_ERROR_CLASSES:
        return _FRAME.pack(ERROR_FLAG, _ERROR_BYTES, b"")
    return _FRAME.pack(ERROR_FLAG | classes, _ERROR_BYTES, data)


def _message_of(frame: bytes) -> "can.Message":
    """Return a can_frame or canfd_frame as a message to send."""
    from can import Message

    fd, flags = len(frame) == _FD_FRAME_BYTES, 0
    if fd:
        can_id, length, flags, data = _FD_FRAME.unpack(frame)
    else:
        can_id, length, data = _FRAME.unpack(frame)
    extended = bool(can_id & _EFF)
    remote = bool(can_id & _RTR)
    return Message(
        arbitration_id=can_id & (0x1FFF_FFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_fd=fd,
        bitrate_switch=bool(flags & _BRS),
        error_state_indicator=bool(flags & _ESI),
        dlc=length,
        data=None if remote else data[:length],
    )


@final
class _MessageSource:
    def __init__(self, bus: "can.BusABC") -> None:
        self.reports_own = False
        self._bus = bus

    def open(self) -> None:
        _refuse_second_reader(self._bus)

    def receive(self, timeout_s: float) -> Heard | None:
        message = self._bus.recv(timeout_s)
        if message is None or not message.is_rx:
            return None  # an own frame (receive_own_messages), reported when it was sent
        can_id = message.arbitration_id
        if message.is_error_frame:
            return _error_of(message), 0, False
        if message.is_extended_id:
            can_id |= _EFF
        if message.is_fd:
            flags = _FDF | (_BRS if message.bitrate_switch else 0)
            flags |= _ESI if message.error_state_indicator else 0
            data = bytes(message.data)
            return _FD_FRAME.pack(can_id, len(data), flags, data), 0, False
        if message.is_remote_frame:
            return _FRAME.pack(can_id | _RTR, message.dlc, b""), 0, False
        return _FRAME.pack(can_id, len(message.data), bytes(message.data)), 0, False

    def send(self, frame: bytes) -> None:
        from can import CanError

        try:
            self._bus.send(_message_of(frame))
        except (CanError, OSError) as error:
            raise _cannot_send(self._bus, error) from error

    def close(self) -> None:
        pass


@final
class BusCondition(Enum):
    """Fault confinement state of a CAN controller (ISO 11898-1)."""

    ACTIVE = "error active"
    WARNING = "at the error warning limit"
    PASSIVE = "error passive"
    OFF = "bus-off"


@final
class BusStatus:
    """Known state of one bus.

    Attributes:
        name: name of the bus ("can0").
        condition: last reported condition; ACTIVE before the first report.
        since_ns: time of the last change of condition [ns]; None before the first report.
        counters: last reported transmit and receive error counters, or None.
        is_off: True while the bus is off.
        offs: number of transitions to bus-off.
        unacknowledged_ns: time since which frames get no ACK [ns], or None.
    """

    def __init__(self, name: str, remedy: str) -> None:
        """Create the status of a bus without any report.

        Args:
            name: name of the bus.
            remedy: advice for the user if the bus is off.
        """
        self.name: Final = name
        self.condition: BusCondition = BusCondition.ACTIVE
        self.since_ns: int | None = None
        self.counters: tuple[int, int] | None = None
        self.is_off: bool = False
        self.offs: int = 0
        self.unacknowledged_ns: int | None = None
        self._off_ns: int | None = None
        self._remedy: Final = remedy

    def __repr__(self) -> str:
        return f"<{self}>"

    def __str__(self) -> str:
        text = f"{self.name} is {self.condition.value}"
        if self.since_ns is not None:
            text += f" since {self.since_ns / 1e9:.6f} s"
        if self.counters is not None:
            text += " (TEC {}, REC {})".format(*self.counters)
        return text

    def hear(self, message: bytes, time_ns: int) -> None:
        """Process an error message of the CAN controller, received at `time_ns` [ns]."""
        classes = int.from_bytes(message[:4], "little")
        if classes & _COUNTERS:
            self.counters = (message[14], message[15])
        if classes & _NO_ACKNOWLEDGE and self.unacknowledged_ns is None:
            self.unacknowledged_ns = time_ns
        found = _condition_in(classes, message[9])
        if found is None or found is self.condition:
            return
        self.condition = found
        self.since_ns = time_ns
        if not classes & _COUNTERS:
            self.counters = None
        if found is BusCondition.PASSIVE and message[9] & _TX_PASSIVE:
            if self.unacknowledged_ns is None:
                self.unacknowledged_ns = time_ns
        elif found in (BusCondition.ACTIVE, BusCondition.OFF):
            self.unacknowledged_ns = None
        self.is_off = found is BusCondition.OFF
        if self.is_off:
            self.offs += 1
            self._off_ns = time_ns

    def sent(self) -> None:
        """Record that an own frame was transmitted, and so acknowledged."""
        self.unacknowledged_ns = None

    def check(self) -> None:
        """Raise LinkError while the bus is off."""
        if self.is_off:
            raise self.failure()

    def failure(self) -> LinkError:
        """Return the error for a bus that is, or was, off."""
        if self.is_off:
            reason = "bus-off: nothing is sent or received"
            since_ns, remedy = self._off_ns, self._remedy
            return LinkError(link=self.name, reason=reason, since_ns=since_ns, remedy=remedy)
        at = "once" if self._off_ns is None else f"at {self._off_ns / 1e9:.6f} s"
        reason = f"the bus was off {at} and has recovered; operations waiting at that time failed"
        return LinkError(link=self.name, reason=reason)

    def trouble(self) -> str:
        """Return the problem of the bus for the message of a timeout; "" if none is known."""
        if self.unacknowledged_ns is not None and not self.is_off:
            text = f"{self.name}: no ACK since t = {self.unacknowledged_ns / 1e9:.6f} s"
            return f"{text}, controller {self.condition.value}"
        return "" if self.condition is BusCondition.ACTIVE else str(self)


def _condition_in(classes: int, status: int) -> BusCondition | None:
    """Return the condition that an error message reports, or None."""
    if classes & _BUS_OFF:
        return BusCondition.OFF
    if classes & _CONTROLLER:
        if status & (_RX_PASSIVE | _TX_PASSIVE):
            return BusCondition.PASSIVE
        if status & (_RX_WARNING | _TX_WARNING):
            return BusCondition.WARNING
        if status & _ACTIVE:
            return BusCondition.ACTIVE
    return BusCondition.ACTIVE if classes & _RESTARTED else None


def status_of(bus: "can.BusABC", name: str) -> BusStatus:
    """Return a new status for this bus object, called `name` in messages.

    A bus other than SocketCAN may offer its own remedy in an attribute `bus_off_remedy`.
    """
    remedy = getattr(bus, "bus_off_remedy", "")
    usual = f"ip link set {name} type can restart; or set restart-ms 100 for automatic restart"
    return BusStatus(name, remedy or usual)
