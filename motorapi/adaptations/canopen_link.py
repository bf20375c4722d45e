"""One host on one CANopen bus: frames in, frames out, confirmation, SYNC, NMT and heartbeats.

A link is shared by every hardware object of its bus. Frames are Linux can_frame (16 bytes). What
comes in is handed on by identifier, at the cost of one dictionary look-up; own frames are reported
when they were *transmitted*, which is what arming rests on: SYNC (080h) wins arbitration over any
RPDO that still waits (CiA 301 default identifiers), so a SYNC sent too early fires without it.
"""

import struct
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.bus_sync import BusSync, FenceNow, Lost
from motorapi.adaptations.transmissions import Transmission as Transmission
from motorapi.adaptations.transmissions import Transmissions, all_sent
from motorapi.bus_status import ERROR_BYTE, status_of
from motorapi.errors import LinkError, UsageError
from motorapi.fencing import joint_fence
from motorapi.runtime import Registration, Runtime

if TYPE_CHECKING:
    import can
    import canopen

    from motorapi.adaptations.cia402_triggers import ArmedStream
    from motorapi.adaptations.sync_burst import ArmedSetPoint
    from motorapi.adaptations.sync_producer import CyclicSync
    from motorapi.fencing import Fence

FrameHandler = Callable[[bytes, int], None]
"""(frame, time_ns) of a frame with the identifier that was asked for."""

SYNC_ID: Final = 0x080
NMT_ID: Final = 0x000
NMT_START: Final = 0x01
HEARTBEAT_ID: Final = 0x700
STOPPED: Final = 0x04
OPERATIONAL: Final = 0x05

_FRAME: Final = struct.Struct("<IB3x8s")
_ID: Final = struct.Struct("<I")


def can_frame(can_id: int, data: bytes) -> bytes:
    """The Linux can_frame with this identifier (with its flags) and up to 8 bytes."""
    return _FRAME.pack(can_id, len(data), data)


@final
class _HostHeartbeat:
    """The heartbeat of one host node-ID, as long as somebody needs it."""

    def __init__(self, link: "CanopenLink", host_node_id: int, period_ms: int) -> None:
        self.period_ms = period_ms
        self.users = 1
        self._link = link
        self._frame = can_frame(HEARTBEAT_ID + host_node_id, bytes((OPERATIONAL,)))
        self._fails = False
        self.registration: Final = link.runtime.every(period_ms / 1e3, self._again)

    def send(self) -> None:
        """It is heard once."""
        self._link.send(self._frame)

    def _again(self) -> None:
        """That a bus takes no more is told once, not with every period for ever."""
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
    """The host's end of one CANopen bus. Get one by `open_link`; it costs nothing to share.

    Attributes:
        name: what messages call it ("can0").
        status: of the bus, by what its CAN controller tells.
        on_bus_off: are told when it goes off.
        confirms: whether an own frame has ever been reported as transmitted.
        sync_id, sync_frame: the identifier of SYNC, and a SYNC.
        latching: node-IDs of drives that may have something latched that a SYNC would start.
        armed_streams: set-points of several motors that are to begin at one SYNC.
        armed_set_points: likewise, single ones.
        bus_sync: SYNC, which belongs to the bus.
        cycle: of the servos on the host that share this link (motorapi.adaptations.software_cycle).
        fences: of the nodes that other processes may take over, by node-ID.
        lost: whether a drive that was armed here was taken over: a halt of its new owner's waits in
            it for a SYNC, and none is sent before anything is armed again.
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
        self.handle(SYNC_ID, self.bus_sync.hear)  # of another producer: it fires as well as ours
        self._registration = runtime.listen(bus, self._on_frame)

    @property
    def network(self) -> "canopen.Network":
        """A canopen.Network on this link, never connected: for SDO clients and extra nodes."""
        if self._network is None:
            from motorapi.adaptations.sdo_client import LinkNetwork

            self._network = LinkNetwork(self)
        return self._network

    # --- frames ---------------------------------------------------------------------------

    def handle(self, can_id: int, handler: FrameHandler) -> None:
        """Frames with this identifier go to `handler`, in place of whoever had them before."""
        self._handlers[_ID.pack(can_id)] = handler

    def ignore(self, can_id: int) -> None:
        """Frames with this identifier go to nobody."""
        self._handlers.pop(_ID.pack(can_id), None)

    def send(self, frame: bytes, fence: "Fence | None" = None) -> None:
        """The frame waits its turn on the bus; a commanding one only while its fence lets it out.

        Raises:
            LinkError: the bus does not take it, or is off.
            MotorBusyError: the fence does not let it out: somebody has taken the motor over.
        """
        if self.status.is_off:
            raise self.status.failure()
        try:
            if fence is None:
                self.runtime.send(self.bus, frame)
            else:
                fence.send(frame)
        except Exception as error:  # python-can's own, and the system's; others pass through
            from can import CanError

            if isinstance(error, CanError | OSError):
                lost = LinkError(link=self.name, reason=f"cannot send: {error}")
                lost.__cause__ = error  # compiled code forgets what an error is raised from
                raise lost from error
            raise

    def send_tracked(self, frame: bytes, fence: "Fence | None" = None) -> Transmission:
        """As `send`; the answer tells when the frame was transmitted.

        Every frame of an identifier must be sent tracked, or none of them.

        Raises:
            LinkError: the bus does not take it, or has not transmitted anything for a long time.
            MotorBusyError: the fence does not let it out.
        """
        return self.send_as(Transmission(frame), fence)

    def send_as(self, transmission: Transmission, fence: "Fence | None" = None) -> Transmission:
        """As `send_tracked`, for whoever must know the transmission before it can be answered.

        On the wall clock an answer may be heard, in another thread, before this has returned.

        Raises: as `send_tracked`.
        """
        self._transmissions.add(transmission, self.confirms)
        try:
            self.send(transmission.frame, fence)
        except BaseException:
            self._transmissions.remove(transmission)
            raise
        return transmission

    def confirmed(self, transmissions: Sequence[Transmission], timeout_s: float = 0.5) -> None:
        """All of these have been on the wire.

        Raises:
            LinkError: not within `timeout_s` [s], or the bus went off.
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
        """Tracked frames with this identifier that wait for the bus, where it tells of own ones."""
        return self._transmissions.pending(_ID.pack(can_id)) if self.confirms else ()

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """As the runtime's, for what only this bus can bring.

        Raises:
            LinkError: the bus is off, or went off meanwhile.
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
        """Our CAN controller tells of an error: never taken for a frame of anybody's."""
        status, offs = self.status, self.status.offs
        status.hear(message, time_ns)
        if status.offs != offs:
            self._transmissions.forget()
            self.bus_sync.bus_off(status.failure())
            for told in tuple(self.on_bus_off):
                told()

    # --- NMT, SYNC, heartbeat -------------------------------------------------------------

    def nmt(self, command: int, node_id: int) -> None:
        """An NMT command (CiA 301: 01h start, 02h stop, 80h pre-operational, 81h, 82h resets).

        To start a node commands nothing: who only reads does so, too. All others are fenced.
        """
        fence = None if command == NMT_START else self.fences.get(node_id)
        self.send(can_frame(NMT_ID, bytes((command, node_id))), fence)

    def sync(self) -> Transmission:
        """One SYNC waits for the bus. Whoever armed something first awaits its confirmation.

        Raises:
            MotorBusyError: a motor that it would start was taken over by somebody else.
        """
        fence = None
        if self.fences and self.latching:
            fences = self.fences
            fence = joint_fence([fences[node] for node in sorted(self.latching) if node in fences])
        self.lost = False
        return self.send_tracked(self.sync_frame, fence)

    def at_next_sync(self, action: Callable[[int], None]) -> None:
        """`action` is told when the next SYNC was on the wire [ns], whoever sends it."""
        self.bus_sync.at_next(action)

    @property
    def sync_period_ns(self) -> int | None:
        """The period of the cyclic SYNC that somebody here goes by [ns]; None: nobody does."""
        return self.bus_sync.period_ns

    def cyclic_sync(self) -> "CyclicSync | None":
        """The SYNC that runs on the bus, whoever produces it, as far as it is known; else None."""
        return self.bus_sync.cyclic()

    def on_sync(
        self,
        period_s: float,
        action: Callable[[], None],
        lost: Lost | None = None,
        fence: FenceNow | None = None,
    ) -> Registration:
        """A cyclic SYNC runs, and `action` just after each was queued, or heard; it must not wait.

        It is produced here, unless somebody else produces one of the same period on this bus.

        Args:
            period_s: of SYNC [s].
            action: runs once for each.
            lost: is told, once, that there is none any more; nothing has to be cancelled then.
            fence: asked for the fence of what goes by it: while no user owns that, none is sent.

        Raises:
            UsageError: SYNC runs with another period on this bus; says who produces it.
        """
        self.bus_sync.join(period_s, action, lost, fence)
        return _SyncRegistration(self, action)

    def produce_heartbeat(self, host_node_id: int, period_ms: int) -> None:
        """The host is heard as a node, at once and then every `period_ms` [ms].

        Raises:
            UsageError: another period was asked for before, or a drive has this node-ID.
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
                    f"{self.name}: host node {host_node_id} has a heartbeat of {known.period_ms}"
                    f" ms already, so not of {period_ms} ms; give it one period for all drives"
                )
            known.users += 1
            return
        heartbeat = self._heartbeats[host_node_id] = _HostHeartbeat(self, host_node_id, period_ms)
        heartbeat.send()

    def is_host(self, node_id: int) -> bool:
        """Whether the host itself is heard under this node-ID."""
        return node_id in self._heartbeats

    def release_heartbeat(self, host_node_id: int) -> None:
        """One user less; after the last one the host falls silent."""
        known = self._heartbeats[host_node_id]
        known.users -= 1
        if known.users == 0:
            known.registration.cancel()
            del self._heartbeats[host_node_id]

    def close(self) -> None:
        """Nothing is sent or heard any more."""
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
        """It has ended; cancelling again does nothing."""
        self._link.bus_sync.leave(self._action)


def bus_label(bus: "can.BusABC") -> str:
    """What messages call a bus: its channel, where python-can knows it."""
    channel = getattr(bus, "channel", None)
    return str(channel) if channel is not None else str(bus.channel_info)


_LINKS: dict[int, CanopenLink] = {}  # by id(bus), which stays its own while the link holds the bus


def open_link(bus: "can.BusABC", runtime: Runtime) -> CanopenLink:
    """The link of this bus object, made if it is the first use; `release_link` ends the use."""
    link = _LINKS.get(id(bus))
    if link is None:
        link = _LINKS[id(bus)] = CanopenLink(bus, runtime)
    link.users += 1
    return link


def release_link(link: CanopenLink) -> None:
    """One user less; the last one closes the link, not the bus."""
    link.users -= 1
    if link.users == 0:
        _LINKS.pop(id(link.bus), None)
        link.close()
