"""One CANopen bus as the host uses it: NMT, host heartbeats, SYNC.

All hardware objects of a bus share one `CanopenBus`.
"""

import struct
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.sync import BusSync
from motorhil.motorapi.bus_context import Parts, context_of
from motorhil.motorapi.errors import LinkError, UsageError
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.runtime.can_link import CanLink, can_frame, open_link, release_link

if TYPE_CHECKING:
    import can
    import canopen

    from motorhil.motorapi.ownership.fencing import Fence

NMT_ID: Final = 0x000
NMT_START: Final = 0x01
HEARTBEAT_ID: Final = 0x700
STOPPED: Final = 0x04
OPERATIONAL: Final = 0x05
_FRAME: Final = struct.Struct("<IB3x8s")


@final
class _HostHeartbeat:
    """The heartbeat of one host node-ID, produced while it has users."""

    def __init__(self, link: CanLink, host_node_id: int, period_ms: int) -> None:
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
class CanopenBus:
    """The host's end of one CANopen bus; `open_bus` returns a shared one.

    Attributes:
        link: its frames.
        sync: its SYNC.
        fences: the fences of nodes that other processes may take over, by node-ID.
        parts: the state that the kinds of drives keep for this bus.
        users: the number of hardware objects that use it.
    """

    def __init__(self, bus: "can.BusABC", runtime: Runtime) -> None:
        self.link: Final = open_link(bus, runtime)
        self.fences: Final[dict[int, Fence]] = {}
        self.sync: Final = BusSync(self.link, self.fences)
        self.parts: Final = Parts()
        self.users = 0
        self._heartbeats: dict[int, _HostHeartbeat] = {}
        self._network: canopen.Network | None = None

    @property
    def network(self) -> "canopen.Network":
        """A canopen.Network on this bus, never connected: for SDO clients and extra nodes."""
        if self._network is None:
            from motorhil.motorapi.adaptations.canopen.sdo import LinkNetwork

            self._network = LinkNetwork(self.link)
            self.link.on_other = self._notify
        return self._network

    def _notify(self, frame: bytes, time_ns: int) -> None:
        """Pass a frame to the subscribers of the network."""
        can_id, length, data = _FRAME.unpack(frame)
        network = self.network
        if can_id in network.subscribers:
            network.notify(can_id, bytearray(data[:length]), time_ns / 1e9)

    def nmt(self, command: int, node_id: int) -> None:
        """Send an NMT command (CiA 301: 01h start, 02h stop, 80h pre-operational, 81h, 82h resets).

        Starting a node commands no motion, and readers start nodes too, so it is not fenced. All
        other commands are.
        """
        fence = None if command == NMT_START else self.fences.get(node_id)
        self.link.send(can_frame(NMT_ID, bytes((command, node_id))), fence)

    def produce_heartbeat(self, host_node_id: int, period_ms: int) -> None:
        """Produce the heartbeat of a host node, at once and then every `period_ms` [ms].

        Raises:
            UsageError: another period was requested before, or a drive has this node-ID.
        """
        if self.link.is_handled(HEARTBEAT_ID + host_node_id):
            raise UsageError(
                f"{self.link.name}: host_node_id = {host_node_id} is the node-ID of a drive here;"
                " give the host one of its own"
            )
        known = self._heartbeats.get(host_node_id)
        if known is not None:
            if known.period_ms != period_ms:
                raise UsageError(
                    f"{self.link.name}: host node {host_node_id} has a heartbeat of "
                    f"{known.period_ms} ms already, so not of {period_ms} ms; use one period "
                    "for all drives"
                )
            known.users += 1
            return
        heartbeat = self._heartbeats[host_node_id] = _HostHeartbeat(
            self.link, host_node_id, period_ms
        )
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
        """Close the bus: nothing is sent or received afterwards."""
        release_link(self.link)
        for heartbeat in self._heartbeats.values():
            heartbeat.registration.cancel()
        self._heartbeats.clear()
        self.sync.close()


def open_bus(bus: "can.BusABC", runtime: Runtime) -> CanopenBus:
    """Return the CANopen bus on this bus object, made on first use; `release_bus` ends the use."""
    opened = context_of(bus).parts.part(CanopenBus, lambda: CanopenBus(bus, runtime))
    opened.users += 1
    return opened


def release_bus(bus: CanopenBus) -> None:
    """Count one user of the bus less; the last one closes it, not the bus object."""
    bus.users -= 1
    if bus.users == 0:
        context_of(bus.link.bus).parts.drop(bus)
        bus.close()
