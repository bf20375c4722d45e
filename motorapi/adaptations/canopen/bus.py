"""The host's end of one CANopen bus: frames, SYNC, NMT and heartbeats.

All hardware objects of a bus share one link. Frames are Linux can_frame (16 bytes). Received frames
are dispatched by identifier, at the cost of one dictionary look-up. Own frames are reported when
they were *transmitted*. Arming rests on that: SYNC (080h) wins arbitration over any RPDO that still
waits (CiA 301 default identifiers), so a SYNC sent too early fires without that RPDO.

Own frames that wait for transmission, and their times on the wire.

Single CAN frames for low-level access, beside the objects of a device.
"""

import struct
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.motorapi.adaptations.canopen.sync import BusSync, FenceNow, Lost
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, UsageError
from motorhil.motorapi.ownership.fencing import joint_fence
from motorhil.motorapi.runtime.api import Registration, Runtime, wait_until
from motorhil.motorapi.runtime.can_sources import ERROR_BYTE, status_of

if TYPE_CHECKING:
    from types import TracebackType

    import can
    import canopen

    from motorhil.motorapi.adaptations.canopen.sync import CyclicSync
    from motorhil.motorapi.adaptations.cia402.motion import ArmedSetPoint, ArmedStream
    from motorhil.motorapi.ownership.fencing import Fence

_UNCONFIRMED_MAX: Final = 1000


@final
class Transmission:
    """One queued frame; `time_ns` is its time of completion on the bus, None before that."""

    __slots__ = ("frame", "time_ns")

    def __init__(self, frame: bytes) -> None:
        self.frame = frame
        self.time_ns: int | None = None


def all_sent(transmissions: Sequence[Transmission]) -> bool:
    """Return whether all of them were on the wire."""
    return all(one.time_ns is not None for one in transmissions)


@final
class Transmissions:
    """All frames that wait for one bus, by identifier."""

    def __init__(self, link: str) -> None:
        self._link: Final = link
        self._awaited: dict[bytes, deque[Transmission]] = {}

    def add(self, transmission: Transmission, confirms: bool) -> None:
        """Record a frame that waits for the bus; `confirms`: whether the bus reports own frames.

        Raises:
            LinkError: the bus has not transmitted anything for a long time.
        """
        key = transmission.frame[:4]
        waiting = self._awaited.get(key)
        if waiting is None:
            waiting = self._awaited[key] = deque()
        elif len(waiting) >= _UNCONFIRMED_MAX:
            if confirms:
                reason = f"{len(waiting)} frames wait, none is transmitted"
                raise LinkError(link=self._link, reason=reason)
            waiting.popleft()  # a bus that does not report own frames
        waiting.append(transmission)

    def remove(self, transmission: Transmission) -> None:
        """Remove a frame that was not sent."""
        self._awaited[transmission.frame[:4]].remove(transmission)

    def pending(self, key: bytes) -> Sequence[Transmission]:
        """Return the waiting frames with this identifier (its 4 bytes)."""
        return tuple(self._awaited.get(key, ()))

    def confirm(self, frame: bytes, time_ns: int) -> None:
        """Confirm the oldest equal frame with this identifier; earlier ones were never sent."""
        waiting = self._awaited.get(frame[:4])
        if not waiting:
            return
        for place, transmission in enumerate(waiting):
            if transmission.frame == frame:
                transmission.time_ns = time_ns
                for _ in range(place + 1):
                    waiting.popleft()
                return

    def forget(self) -> None:
        """Forget all frames: with the bus off they are lost."""
        self._awaited.clear()


FrameHandler = Callable[[bytes, int], None]
"""A callback for frames with one identifier, called with (frame, time_ns)."""

SYNC_ID: Final = 0x080
NMT_ID: Final = 0x000
NMT_START: Final = 0x01
HEARTBEAT_ID: Final = 0x700
STOPPED: Final = 0x04
OPERATIONAL: Final = 0x05

_FRAME: Final = struct.Struct("<IB3x8s")
_ID: Final = struct.Struct("<I")


def can_frame(can_id: int, data: bytes) -> bytes:
    """Return the Linux can_frame with this identifier (with its flags) and up to 8 bytes."""
    return _FRAME.pack(can_id, len(data), data)


@final
class _HostHeartbeat:
    """The heartbeat of one host node-ID, produced while it has users."""

    def __init__(self, link: "CanopenLink", host_node_id: int, period_ms: int) -> None:
        self.period_ms = period_ms
        self.users = 1
        self._link = link
        self._frame = can_frame(HEARTBEAT_ID + host_node_id, bytes((OPERATIONAL,)))
        self._fails = False
        self.registration: Final = link.runtime.every(period_ms / 1e3, self._again)

    def send(self) -> None:
        """Send one heartbeat."""
        self._link.send(self._frame)

    def _again(self) -> None:
        """Send the periodic heartbeat; report a failed transmission only once."""
        if self._link.status.is_off:
            return
        try:
            self.send()
        except LinkError:
            if self._fails:
                return
            self._fails = True
            raise
        self._fails = False


@final
class CanopenLink:
    """The host's end of one CANopen bus; `open_link` returns a shared one.

    Attributes:
        name: the name of the bus in messages ("can0").
        status: the status of the bus, as its CAN controller reports it.
        on_bus_off: callbacks for the transition to bus-off.
        confirms: whether an own frame has ever been reported as transmitted.
        sync_id, sync_frame: the identifier of SYNC, and a SYNC frame.
        latching: the node-IDs of drives that may hold a set-point which a SYNC would start.
        armed_streams: the streams of several motors that are to begin at one SYNC.
        armed_set_points: the single set-points that are to begin at one SYNC.
        bus_sync: SYNC arbitration on the bus.
        cycle: the cycle of the servos on the host that share this link (`ServoCycle`).
        fences: the fences of nodes that other processes may take over, by node-ID.
        lost: whether a drive that was armed here was taken over. A halt of its new owner then waits
            in the drive for a SYNC, and no SYNC is sent before the next arming.
    """

    def __init__(self, bus: "can.BusABC", runtime: Runtime) -> None:
        self.bus = bus
        self.runtime = runtime
        self.name = bus_label(bus)
        self.status = status_of(bus, self.name)
        self.on_bus_off: list[Callable[[], None]] = []
        self.confirms = False
        self.sync_id = SYNC_ID
        self.sync_frame = can_frame(SYNC_ID, b"")
        self.latching: set[int] = set()
        self.armed_streams: list[ArmedStream] = []
        self.armed_set_points: list[ArmedSetPoint] = []
        self.cycle: object = None
        self.fences: dict[int, Fence] = {}
        self.lost = False
        self.users = 0
        self._handlers: dict[bytes, FrameHandler] = {}
        self._transmissions = Transmissions(self.name)
        self._heartbeats: dict[int, _HostHeartbeat] = {}
        self._sync_key = _ID.pack(SYNC_ID)
        self._network: canopen.Network | None = None
        self.bus_sync = BusSync(self)
        self.handle(SYNC_ID, self.bus_sync.hear)  # a SYNC of another producer fires as well as ours
        self._registration = runtime.listen(bus, self._on_frame)

    @property
    def network(self) -> "canopen.Network":
        """A canopen.Network on this link, never connected: for SDO clients and extra nodes."""
        if self._network is None:
            from motorhil.motorapi.adaptations.canopen.sdo import LinkNetwork

            self._network = LinkNetwork(self)
        return self._network

    # --- frames ---------------------------------------------------------------------------

    def handle(self, can_id: int, handler: FrameHandler) -> None:
        """Dispatch frames with this identifier to `handler`, in place of any previous one."""
        self._handlers[_ID.pack(can_id)] = handler

    def ignore(self, can_id: int) -> None:
        """Stop dispatching frames with this identifier."""
        self._handlers.pop(_ID.pack(can_id), None)

    def send(self, frame: bytes, fence: "Fence | None" = None) -> None:
        """Queue a frame for transmission; a commanding frame only if its fence permits it.

        Raises:
            LinkError: the bus does not accept the frame, or is off.
            MotorBusyError: the fence refuses the frame: another program has taken the motor over.
        """
        if self.status.is_off:
            raise self.status.failure()
        try:
            if fence is None:
                self.runtime.send(self.bus, frame)
            else:
                fence.send(frame)
        except Exception as error:  # other errors than python-can's and the system's pass
            from can import CanError

            if isinstance(error, CanError | OSError):
                lost = LinkError(link=self.name, reason=f"cannot send: {error}")
                lost.__cause__ = error  # Compiled code loses the cause of `raise ... from`.
                raise lost from error
            raise

    def send_tracked(self, frame: bytes, fence: "Fence | None" = None) -> Transmission:
        """Queue a frame as `send` does; return the transmission, which holds the time of sending.

        Either all frames of an identifier must be sent tracked, or none.

        Raises:
            LinkError: the bus does not accept the frame, or has not transmitted for a long time.
            MotorBusyError: the fence refuses the frame.
        """
        return self.send_as(Transmission(frame), fence)

    def send_as(self, transmission: Transmission, fence: "Fence | None" = None) -> Transmission:
        """Queue a transmission that the caller has made, as `send_tracked` does.

        On the wall clock, another thread may hear an answer to the frame before this method has
        returned.

        Raises:
            LinkError: as `send_tracked`.
            MotorBusyError: as `send_tracked`.
        """
        self._transmissions.add(transmission, self.confirms)
        try:
            self.send(transmission.frame, fence)
        except BaseException:
            self._transmissions.remove(transmission)
            raise
        return transmission

    def confirmed(self, transmissions: Sequence[Transmission], timeout_s: float = 0.5) -> None:
        """Wait until all of these transmissions have been on the wire.

        Raises:
            LinkError: they were not within `timeout_s` [s], or the bus went off.
        """
        if self.wait_until(lambda: all_sent(transmissions), timeout_s):
            return
        missing = [one for one in transmissions if one.time_ns is None]
        can_id = _ID.unpack_from(missing[0].frame)[0]
        hint = ""
        if not self.confirms:
            hint = "; this bus never reported an own frame: open it with receive_own_messages=True"
        trouble = self.status.trouble()
        hint = f"; {trouble}" if trouble else hint
        raise LinkError(
            link=self.name,
            reason=f"{len(missing)} of {len(transmissions)} frames (first {can_id:03X}h) were not"
            f" transmitted within {timeout_s:g} s{hint}",
        )

    def pending(self, can_id: int) -> Sequence[Transmission]:
        """Return the tracked frames with this identifier that still wait for the bus.

        The result is empty if the bus does not report own frames.
        """
        return self._transmissions.pending(_ID.pack(can_id)) if self.confirms else ()

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait like the runtime's `wait_until`, for a condition that only this bus can fulfil.

        Raises:
            LinkError: the bus is off, or went off while waiting.
        """
        status = self.status
        status.check()
        offs = status.offs
        over = self.runtime.wait_until(lambda: done() or status.offs != offs, timeout_s)
        if over and status.offs != offs and not done():
            raise status.failure()
        return over

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted:
            self.confirms = True
            self._transmissions.confirm(frame, time_ns)
            if frame[:4] == self._sync_key and self.bus_sync.is_awaited:
                self.bus_sync.passed(time_ns)
            if self.status.unacknowledged_ns is not None:
                self.status.sent()
            return
        handler = self._handlers.get(frame[:4])
        if handler is not None:
            handler(frame, time_ns)
        elif frame[3] & ERROR_BYTE:
            self._on_error(frame, time_ns)
        elif self._network is not None:
            can_id, length, data = _FRAME.unpack(frame)
            if can_id in self._network.subscribers:
                self._network.notify(can_id, bytearray(data[:length]), time_ns / 1e9)

    def _on_error(self, message: bytes, time_ns: int) -> None:
        """Handle an error frame of our own CAN controller."""
        status, offs = self.status, self.status.offs
        status.hear(message, time_ns)
        if status.offs != offs:
            self._transmissions.forget()
            self.bus_sync.bus_off(status.failure())
            for told in tuple(self.on_bus_off):
                told()

    # --- NMT, SYNC, heartbeat -------------------------------------------------------------

    def nmt(self, command: int, node_id: int) -> None:
        """Send an NMT command (CiA 301: 01h start, 02h stop, 80h pre-operational, 81h, 82h resets).

        Starting a node commands no motion, and readers start nodes too, so it is not fenced. All
        other commands are.
        """
        fence = None if command == NMT_START else self.fences.get(node_id)
        self.send(can_frame(NMT_ID, bytes((command, node_id))), fence)

    def sync(self) -> Transmission:
        """Queue one SYNC; a caller that armed set-points must await their confirmation first.

        Raises:
            MotorBusyError: another program has taken over a motor that this SYNC would start.
        """
        fence = None
        if self.fences and self.latching:
            fences = self.fences
            fence = joint_fence([fences[node] for node in sorted(self.latching) if node in fences])
        self.lost = False
        return self.send_tracked(self.sync_frame, fence)

    def at_next_sync(self, action: Callable[[int], None]) -> None:
        """Call `action` with the time [ns] of the next SYNC on the wire, from any producer."""
        self.bus_sync.at_next(action)

    @property
    def sync_period_ns(self) -> int | None:
        """The period of the cyclic SYNC that this link uses [ns], or None if it uses none."""
        return self.bus_sync.period_ns

    def cyclic_sync(self) -> "CyclicSync | None":
        """Return the SYNC known to run on the bus, from any producer, or None."""
        return self.bus_sync.cyclic()

    def on_sync(
        self,
        period_s: float,
        action: Callable[[], None],
        lost: Lost | None = None,
        fence: FenceNow | None = None,
    ) -> Registration:
        """Run a cyclic SYNC, and call `action` just after each is queued or heard.

        SYNC is produced here, unless another program produces one of the same period on this bus.

        Args:
            period_s: the period of SYNC [s].
            action: called once for each SYNC; it must not wait.
            lost: called once when the SYNC is lost; the registration need not be cancelled then.
            fence: returns the current fence of this user. No SYNC is sent while every user has lost
                its motors.

        Raises:
            UsageError: SYNC runs with another period on this bus; names its producer.
        """
        self.bus_sync.join(period_s, action, lost, fence)
        return _SyncRegistration(self, action)

    def produce_heartbeat(self, host_node_id: int, period_ms: int) -> None:
        """Produce the heartbeat of a host node, at once and then every `period_ms` [ms].

        Raises:
            UsageError: another period was requested before, or a drive has this node-ID.
        """
        if _ID.pack(HEARTBEAT_ID + host_node_id) in self._handlers:
            raise UsageError(
                f"{self.name}: host_node_id = {host_node_id} is the node-ID of a drive here;"
                " give the host one of its own"
            )
        known = self._heartbeats.get(host_node_id)
        if known is not None:
            if known.period_ms != period_ms:
                raise UsageError(
                    f"{self.name}: host node {host_node_id} has a heartbeat of "
                    f"{known.period_ms} ms already, so not of {period_ms} ms; use one period "
                    "for all drives"
                )
            known.users += 1
            return
        heartbeat = self._heartbeats[host_node_id] = _HostHeartbeat(self, host_node_id, period_ms)
        heartbeat.send()

    def is_host(self, node_id: int) -> bool:
        """Return whether the host itself produces a heartbeat with this node-ID."""
        return node_id in self._heartbeats

    def release_heartbeat(self, host_node_id: int) -> None:
        """Count one user less of a host heartbeat, and stop it after the last one."""
        known = self._heartbeats[host_node_id]
        known.users -= 1
        if known.users == 0:
            known.registration.cancel()
            del self._heartbeats[host_node_id]

    def close(self) -> None:
        """Close the link: nothing is sent or received afterwards."""
        self._registration.cancel()
        for heartbeat in self._heartbeats.values():
            heartbeat.registration.cancel()
        self._heartbeats.clear()
        self.bus_sync.close()


@final
class _SyncRegistration:
    def __init__(self, link: CanopenLink, action: Callable[[], None]) -> None:
        self._link = link
        self._action = action

    def cancel(self) -> None:
        """End the registration; further calls do nothing."""
        self._link.bus_sync.leave(self._action)


def bus_label(bus: "can.BusABC") -> str:
    """Return the name of a bus in messages: its channel, if python-can knows it."""
    channel = getattr(bus, "channel", None)
    return str(channel) if channel is not None else str(bus.channel_info)


def open_link(bus: "can.BusABC", runtime: Runtime) -> CanopenLink:
    """Return the link of this bus object, made on first use; `release_link` ends the use."""
    link = context_of(bus).parts.part(CanopenLink, lambda: CanopenLink(bus, runtime))
    link.users += 1
    return link


def release_link(link: CanopenLink) -> None:
    """Count one user of the link less; the last one closes the link, not the bus."""
    link.users -= 1
    if link.users == 0:
        context_of(link.bus).parts.drop(link)
        link.close()


_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_KEPT_MAX: Final = 10_000


@final
@dataclass(frozen=True, slots=True)
class RawFrame:
    """One received frame: identifier (11 bits, or 29 if `extended`), data, time of completion."""

    can_id: int
    data: bytes
    time_ns: int
    extended: bool = False


def raw_frame(can_id: int, data: bytes, *, extended: bool) -> bytes:
    """Return the Linux can_frame with an identifier of 11 bits (29 if `extended`) and 0 to 8 bytes.

    Raises:
        UsageError: the identifier or the data is not valid.
    """
    highest = 0x1FFF_FFFF if extended else 0x7FF
    if not isinstance(can_id, int) or not 0 <= can_id <= highest:
        hint = "" if extended else "; longer ones need extended=True"
        raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to {highest:X}h{hint}")
    if not isinstance(data, bytes | bytearray) or len(data) > 8:
        raise UsageError(f"data = {data!r}: a frame has up to 8 bytes")
    return can_frame(can_id | (_EFF if extended else 0), bytes(data))


@final
class FrameInbox:
    """Frames of other nodes received from now on, oldest first (the last 10,000), until `close`.

    Args:
        link: the link of the bus.
        can_ids: identifiers to receive, of 11 or 29 bits; none: all of them.
    """

    def __init__(self, link: "CanopenLink", can_ids: Collection[int]) -> None:
        for can_id in can_ids:
            if not isinstance(can_id, int) or not 0 <= can_id <= 0x1FFF_FFFF:
                raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to 1FFFFFFFh")
        self._link = link
        self._can_ids = frozenset(can_ids)
        self._frames: deque[RawFrame] = deque(maxlen=_KEPT_MAX)
        self._registration = link.runtime.listen(link.bus, self._on_frame)

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        word = int.from_bytes(frame[:4], "little")
        if transmitted or word & (_RTR | _ERR):
            return
        can_id = word & 0x1FFF_FFFF
        if not self._can_ids or can_id in self._can_ids:
            data = frame[8 : 8 + frame[4]]
            self._frames.append(RawFrame(can_id, data, time_ns, bool(word & _EFF)))

    def receive(self, timeout_s: float = 1.0) -> RawFrame:
        """Return the next frame.

        Raises:
            DeadlineExceeded: none came within `timeout_s` [s].
            LinkError: the bus is off.
        """
        frames, status = self._frames, self._link.status
        if not wait_until(self._link.runtime, lambda: bool(frames) or status.is_off, timeout_s):
            which = ", ".join(f"{can_id:03X}h" for can_id in sorted(self._can_ids)) or "any"
            raise DeadlineExceeded(
                awaited=f"a frame on {self._link.name} ({which})",
                timeout_s=timeout_s,
                last_heard="none of them",
            )
        if not frames:
            raise status.failure()
        return frames.popleft()

    def close(self) -> None:
        """Stop receiving."""
        self._registration.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: "type[BaseException] | None",
        error: BaseException | None,
        traceback: "TracebackType | None",
    ) -> None:
        self.close()
