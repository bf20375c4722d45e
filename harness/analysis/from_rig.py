"""Traffic of a rig's CAN buses, prepared for the response-time analysis.

The rig declares messages of others. The messages that motorapi configures in controllers, and sends
itself, are known once the motors are connected. So the rig is opened and every motor's position is
read. No motor moves.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.emulators.can.controller_config import QueueOrder
from motorhil.frozen import frozen
from motorhil.harness.analysis.advice import Reserved
from motorhil.harness.analysis.subject import Queues, Subject, is_canopen_reserved, reserves_nothing
from motorhil.harness.rig.bus_load import Declared, declared, heartbeats, syncs
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.errors import MotorError
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage, own_traffic
from motorhil.motorapi.synchronization.can_response_time import Arrival, BusLoad, Message, floor_ns
from motorhil.traces.decoding.canopen import usual_name

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.canopen.sync import BusSync
    from motorhil.motorapi.synchronization.bus_load import NodeTraffic

HOST: Final = "host"
_SYNC_ID: Final = 0x080
_SET_POINT_BYTES: Final = 6
_NOT_COUNTED: Final = "SDO, NMT, EMCY, LSS and single commands to drives are not counted: sporadic"


@final
@frozen
class Assumptions:
    """Assumptions that a rig's file does not contain.

    Attributes:
        fifo: True if every node has one first-in-first-out queue; None: as in the rig.
        sync_s: period of SYNC [s]; None: as the rig's servos on the host need it.
        streamed: True if every capable drive gets a streamed set-point per SYNC.
    """

    fifo: bool | None = None
    sync_s: float | None = None
    streamed: bool = False


def subjects_of_rig(path: Path, assumptions: Assumptions) -> list[Subject]:
    """Return every CAN bus of the rig.

    Raises:
        RigError: the rig cannot be used as it is written.
    """
    with Rig.open(path) as rig:
        failed: dict[str, str] = {}
        for name, motor in rig.motors.items():
            try:
                motor.position()
            except MotorError as error:
                failed[name] = str(error)
        buses = [bus.name for bus in rig.description.buses.values() if not bus.is_line]
        return [_Bus(rig, name, assumptions, failed).subject() for name in buses]


@final
class _Bus:
    """One bus of a rig whose motors are connected."""

    def __init__(
        self, rig: Rig, name: str, assumptions: Assumptions, failed: dict[str, str]
    ) -> None:
        self._rig = rig
        self._name = name
        self._assumptions = assumptions
        self._found: dict[int, Message] = {}
        self._notes = [
            f"motor {motor} cannot be connected, so its traffic is not counted: {text}"
            for motor, text in failed.items()
            if rig.description.motors[motor].bus == name
        ]
        controllers = rig.description.controllers.values()
        self._repeats_ns = self._repeats()
        self._syncs = {_SYNC_ID}
        self._nodes = {one.node_id: one.name for one in controllers if one.bus == name}
        motors = rig.description.motors.values()
        self._is_canopen = bool(self._nodes) or any(one.bus == name for one in motors)
        self._is_reserved = is_canopen_reserved if self._is_canopen else reserves_nothing

    def subject(self) -> Subject:
        """Return the bus with all known messages."""
        description = self._rig.description
        told = declared(description, self._name)
        if told is None:
            self._notes.append(
                f"what others send is not declared ([[bus.{self._name}.message]]): taken as nothing"
            )
        self._add([_declared(one, self._is_reserved) for one in told or ()])
        self._add(
            self._message(one, self._nodes[one.can_id & 0x7F], "heartbeat or boot-up")
            for one in heartbeats(description, self._name)
        )
        produced = syncs(description, self._name)
        self._syncs.update(one.can_id for _, one in produced)
        self._add(self._message(one, sender, "SYNC producer") for sender, one in produced)
        sync_s = self._sync_s(produced)
        own = own_traffic(self._rig.bus(self._name))
        for node in own:
            self._add_node(node, sync_s)
        if sync_s is not None and (self._assumptions.sync_s is not None or not produced):
            self._add([self._message(PeriodicMessage(_SYNC_ID, 0, sync_s), HOST, "SYNC")])
        if self._assumptions.streamed:
            self._add(self._set_points())
        self._notes += [one.unknown for one in own if one.unknown]
        if self._is_canopen:
            self._notes.append(_NOT_COUNTED)
        messages = tuple(self._found[rank] for rank in sorted(self._found))
        senders = frozenset(one.sender for one in messages if one.sender)
        bus = description.buses[self._name]
        by_priority = frozenset(
            name for name, chip in bus.nodes.items() if chip.queue is QueueOrder.PRIORITY
        )
        return Subject(
            load=BusLoad(
                self._name,
                bus.bitrate_bit_s,
                messages,
                bus.data_bitrate_bit_s,
                fifo=Queues(self._assumptions.fifo, by_priority).one_each(senders),
            ),
            is_reserved=self._is_reserved,
            notes=tuple(self._notes),
        )

    def _add(self, messages: Iterable[Message]) -> None:
        """Add these messages; the worse one counts if an identifier is known already."""
        for message in messages:
            known = self._found.get(message.rank)
            self._found[message.rank] = message if known is None else _worse(known, message)

    def _add_node(self, node: "NodeTraffic", sync_s: float | None) -> None:
        sender = ""
        for one in (*node.sent, *node.sent_at_sync):
            sender = self._nodes.get(one.can_id & 0x7F, sender)
        self._add(self._message(one, sender, "motorapi") for one in node.sent)
        self._add(self._message(one, HOST, "motorapi") for one in node.ours)
        if sync_s is None:
            return
        for messages, whose in ((node.sent_at_sync, sender), (node.ours_at_sync, HOST)):
            self._add(
                self._message(replace(one, period_s=sync_s, jitter_s=sync_s), whose, "at SYNC")
                for one in messages
            )

    def _repeats(self) -> dict[int, int]:
        """Return the repetition period of each node's spontaneous messages by node-ID [ns]."""
        found: dict[int, int] = {}
        for name, described in self._rig.description.motors.items():
            options = getattr(getattr(self._rig.motors[name], "hardware", None), "options", None)
            repeated_ms = getattr(options, "status_period_ms", 0)
            if described.bus == self._name and described.node_id is not None and repeated_ms:
                found[described.node_id] = int(repeated_ms * 1_000_000)
        return found

    def _message(self, one: PeriodicMessage, sender: str, source: str) -> Message:
        """Return a message for the analysis; heartbeat and SYNC are periodic, the rest sporadic.

        The deadline of a node's spontaneous message is its repetition.
        """
        is_sync = one.can_id in self._syncs
        by_clock = one.can_id >= 0x700 or is_sync
        message = Message.of(one)
        is_own = sender != HOST and not by_clock
        repeated_ns = self._repeats_ns.get(one.can_id & 0x7F, 0) if is_own else 0
        return replace(
            message,
            deadline_ns=max(message.period_ns, repeated_ns),
            name=self._name_of(one, is_sync),
            sender=sender,
            arrival=Arrival.PERIODIC if by_clock else Arrival.SPORADIC,
            movable=not (is_sync or is_canopen_reserved(one.can_id, one.extended)),
            source=source,
        )

    def _name_of(self, one: PeriodicMessage, is_sync: bool) -> str:
        if is_sync:
            return "SYNC"
        return "" if one.extended else usual_name(one.can_id, _numbered(self._nodes))

    def _sync(self) -> "BusSync | None":
        """Return the SYNC that the motors of this bus share, or None."""
        for name, described in self._rig.description.motors.items():
            if described.bus == self._name:
                hardware = getattr(self._rig.motors[name], "hardware", None)
                bus = getattr(getattr(hardware, "node", None), "bus", None)
                if bus is not None:
                    found: BusSync = bus.sync
                    return found
        return None

    def _sync_s(self, produced: list[tuple[str, PeriodicMessage]]) -> float | None:
        from motorhil.motorapi.adaptations.canopen.bus_load import sync_period

        if self._assumptions.sync_s is not None:
            return self._assumptions.sync_s
        if produced:
            return min(one.period_s for _, one in produced)
        sync = self._sync()
        period_s = None if sync is None else sync_period(sync)[0]
        if period_s is None and self._assumptions.streamed:
            periods = [one.period_ns for one in self._set_points()]
            period_s = min(periods) / 1e9 if periods else None
        if period_s is None and self._is_canopen:
            self._notes.append("no cyclic SYNC; --sync S assumes one every S seconds")
        return period_s

    def _set_points(self) -> list[Message]:
        """Return one set-point per capable drive, as motorapi streams them."""
        from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor

        found: list[Message] = []
        for name, described in self._rig.description.motors.items():
            hardware = getattr(self._rig.motors[name], "hardware", None)
            if described.bus != self._name or not isinstance(hardware, Cia402HwMotor):
                continue
            identifier = hardware.connect().latched_ids.get(0x607A)
            if identifier is not None:
                period_s = self._assumptions.sync_s
                if period_s is None:
                    period_s = hardware.options.set_point_period_ms / 1e3
                one = PeriodicMessage(identifier, _SET_POINT_BYTES, period_s)
                found.append(self._message(one, HOST, "set-points"))
        return found


def _declared(one: Declared, is_reserved: Reserved) -> Message:
    message = one.message
    return replace(
        Message.of(message),
        deadline_ns=floor_ns(one.deadline_s),
        sender=one.sender,
        movable=not is_reserved(message.can_id, message.extended),
        source="declared",
    )


def _worse(one: Message, other: Message) -> Message:
    """Return a message at least as bad as both; an unswitched CAN FD frame is the longest."""
    deadlines = [each.deadline_ns for each in (one, other) if each.deadline_ns is not None]
    return replace(
        other,
        length=max(one.length, other.length),
        period_ns=min(one.period_ns, other.period_ns),
        jitter_ns=max(one.jitter_ns, other.jitter_ns),
        deadline_ns=min(deadlines, default=None),
        fd=one.fd or other.fd,
        switched=one.switched and other.switched,
        name=other.name or one.name,
        sender=other.sender or one.sender,
    )


def _numbered(nodes: dict[int | None, str]) -> dict[int, str]:
    return {number: name for number, name in nodes.items() if number is not None}
