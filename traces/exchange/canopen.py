"""Exchange logs of all nodes on a recorded CAN bus.

An exchange log contains the commands to one node and its responses. A frame belongs to a node by
the sender's name in the recording, or by its identifier. A PDO belongs to a SYNC if the recording
shows a synchronous transmission type. If the type is unknown, it belongs to SYNC if it follows
nearly every SYNC closely.

Source: CiA 301 (pre-defined connection set, SDO, PDO transmission types, NMT).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, final

from motorhil.traces.can_frame import EFF, ERR, RTR, classic
from motorhil.traces.decoding.canopen import SETPOINTS, CanopenDecoder
from motorhil.traces.decoding.events import DecodedEvent
from motorhil.traces.decoding.objects import ObjectNames, axis_of
from motorhil.traces.decoding.pdo import PdoKey
from motorhil.traces.decoding.sdo import SdoReader
from motorhil.traces.exchange.steps import (
    START,
    ExchangeLog,
    Key,
    Role,
    Sent,
    Step,
    Turn,
    goes_on,
    period_ns,
)
from motorhil.traces.schema import Direction

SYNC_KEY: Final[Key] = ("sync", 0, b"")
_CLASSIC_BYTES: Final = 16  # size of a can_frame
_NMT: Final = 0x000
_SYNCHRONOUS_MAX: Final = 240
_SYNCS_MIN: Final = 8
"""The minimum number of SYNCs for the conclusion that a PDO follows them."""
_NEAR_NS: Final = 2_000_000
_RESETS: Final = (0x81, 0x82)
_NAMING: Final = (2, 3, 4)
"""SDO command specifiers of server frames that name their object."""
_OUTPUTS: Final = (0x6411,)
"""Analogue outputs of I/O nodes (CiA 401): set-points if the servo is on the host."""


@final
class _Node:
    """A node whose exchange log is being built."""

    def __init__(self, bus: str, number: int, begin_ns: int) -> None:
        self.log = ExchangeLog(bus, number)
        self.command = Step(Role.COMMAND, START, begin_ns, "the recording begins")
        self.log.steps.append(self.command)
        self.sdo = SdoReader()
        self.dialogue: Step | None = None
        self.asked_ns = begin_ns
        self.late: tuple[Step, int] | None = None  # request of an earlier dialogue, and its time
        self.commands = 1
        self.set_points: dict[int, bytes] = {}
        self.sync: Step | None = None
        self.syncs = 0
        self.is_commanded = False  # since the last SYNC
        self.remote: dict[int, Step] = {}
        self.times_ns: dict[int, list[int]] = {}
        # PDOs whose relation to SYNC is unknown: (SYNC, command, frame, time).
        self.unclear: dict[int, list[tuple[Step | None, Step, bytes, int]]] = {}
        self.has_sent = False

    def add(self, step: Step) -> None:
        """Add something sent to the node."""
        self.log.steps.append(step)
        if step.role is Role.COMMAND:
            self.commands += 1
            self.command = step
            self.is_commanded = True


@final
class CanopenExchanges:
    """Builds the exchange logs of one bus from its frames, in recorded order."""

    def __init__(
        self,
        bus: str,
        begin_ns: int,
        names: Mapping[int, str] | None = None,
        objects: Mapping[int, ObjectNames] | None = None,
        any_set_point: bool = False,
    ) -> None:
        """Start with an empty log for each node.

        Args:
            bus: the name of the bus.
            begin_ns: the start of the recording [ns].
            names: the names of its nodes.
            objects: the objects of its nodes.
            any_set_point: True to ignore the set-points in PDOs to nodes; a stream of them is then
                logged once, whatever its values.
        """
        self._any_set_point = any_set_point
        self.decoder: CanopenDecoder = CanopenDecoder(names, objects)
        self._bus = bus
        self._begin_ns = begin_ns
        self._numbers = {name: number for number, name in (names or {}).items()}
        self._nodes: dict[int, _Node] = {}
        self._told_all: list[
            Step
        ] = []  # broadcasts, which nodes that have not sent yet received too

    def take(self, time_ns: int, frame: bytes, direction: Direction, sender: str) -> None:
        """Take a frame that was complete at `time_ns`."""
        can_id = int.from_bytes(frame[:4], "little")
        is_fd = len(frame) > _CLASSIC_BYTES  # not a CANopen service, whatever its identifier
        if can_id & (EFF | ERR) or (is_fd and sender not in self._numbers):
            return
        identifier = can_id & 0x7FF
        data = frame[8 : 8 + frame[4]]
        function, number = identifier >> 7, identifier & 0x7F
        if is_fd:
            self._sent(self._numbers[sender], time_ns, identifier, frame)
        elif can_id & RTR:
            self._remote(time_ns, identifier, frame)
        elif len(data) < 2 and self.decoder.maps.is_sync(identifier):
            self._sync(time_ns, frame, self._numbers.get(sender))
        elif sender in self._numbers:
            self._sent(self._numbers[sender], time_ns, identifier, frame)
        elif function == 11 and number:
            self._sent(number, time_ns, identifier, frame)
        elif function == 12 and number:
            self._request(number, time_ns, frame, data)
        elif identifier == _NMT:
            self._nmt(time_ns, frame, data)
        else:
            self._other(time_ns, identifier, frame, direction)

    def logs(self) -> dict[int, ExchangeLog]:
        """Return the logs of all nodes that have sent anything, by node-ID."""
        done: dict[int, ExchangeLog] = {}
        for number, node in sorted(self._nodes.items()):
            if not node.has_sent:
                continue
            self._clear_up(node)
            node.log.steps = [
                step
                for step in node.log.steps
                if step.role is Role.COMMAND or step.turns or step.answers
            ]
            for identifier, times in node.times_ns.items():
                found = period_ns(times)
                if found is not None:
                    node.log.periods_ns[identifier] = found
            _mark_periodic(node)
            done[number] = node.log
        return done

    def _node(self, number: int) -> _Node:
        node = self._nodes.get(number)
        if node is None:
            node = self._nodes[number] = _Node(self._bus, number, self._begin_ns)
            for step in self._told_all:
                node.add(replace(step, reactions=[]))
        return node

    # ------------------------------------------------------------------ frames to a node

    def _request(self, number: int, time_ns: int, frame: bytes, data: bytes) -> None:
        """Take a frame of an SDO client."""
        node = self._node(number)
        step = node.sdo.read(data, False)
        said = self.decoder.decode(frame)
        before_ns, node.asked_ns = node.asked_ns, time_ns
        if step.begins and step.index is not None:
            told = Step(
                Role.POLL if step.upload else Role.COMMAND, sdo_key(data), time_ns, said.text
            )
            told.turns.append(Turn(frame))
            node.add(told)
            before = node.dialogue
            node.late = None
            if before is not None and not before.turns[-1].answers:
                node.late = before, before_ns
            node.dialogue = told
        elif node.dialogue is not None:
            node.dialogue.turns.append(Turn(frame))

    def _nmt(self, time_ns: int, frame: bytes, data: bytes) -> None:
        text = self.decoder.decode(frame).text
        if len(data) < 2:
            return
        step = Step(Role.COMMAND, nmt_key(data), time_ns, text)
        whom = [self._node(data[1])] if data[1] else list(self._nodes.values())
        if not data[1]:
            self._told_all.append(step)
        for node in whom:
            node.add(replace(step, reactions=[]))
            if data[0] in _RESETS:
                node.set_points.clear()

    def _sync(self, time_ns: int, frame: bytes, producer: int | None) -> None:
        """Take a SYNC, which activates earlier commands or only polls."""
        identifier = int.from_bytes(frame[:4], "little")
        for number, node in self._nodes.items():
            if number == producer:
                node.command.reactions.append(Sent(time_ns - node.command.time_ns, frame))
                continue
            if self.decoder.maps.sync_of(number) != identifier:
                continue
            node.log.syncs.add(identifier)
            role = Role.COMMAND if node.is_commanded else Role.POLL
            node.sync = Step(role, SYNC_KEY, time_ns, "SYNC")
            node.syncs += 1
            node.add(node.sync)
            node.is_commanded = False

    def _remote(self, time_ns: int, identifier: int, frame: bytes) -> None:
        keys = self.decoder.maps.of(identifier)
        number = keys[0][0] if keys else identifier & 0x7F
        step = Step(Role.POLL, remote_key(identifier), time_ns, self.decoder.decode(frame).text)
        node = self._node(number)
        node.add(step)
        node.remote[identifier] = step

    def _other(self, time_ns: int, identifier: int, frame: bytes, direction: Direction) -> None:
        """Take a PDO, an emergency or a heartbeat."""
        keys = self.decoder.maps.of(identifier)
        function, number = identifier >> 7, identifier & 0x7F
        if keys and keys[0][1]:
            if direction is not Direction.TRANSMITTED:
                self._sent(keys[0][0], time_ns, identifier, frame)
        elif keys:
            self._set_point(keys, time_ns, identifier, frame)
        elif function in (1, 14) and number and direction is not Direction.TRANSMITTED:
            self._sent(number, time_ns, identifier, frame)

    def _set_point(self, keys: list[PdoKey], time_ns: int, identifier: int, frame: bytes) -> None:
        """Take a PDO to nodes; a repetition is ignored."""
        for key in keys:
            node = self._node(key[0])
            told = frame
            if self._any_set_point:
                mask = self._mask(key)
                masks = node.log.masks.setdefault(identifier, [])
                if not masks or masks[-1][1] != mask:
                    masks.append((node.commands, mask))
                told = masked(frame, mask)
            if node.set_points.get(identifier) != told:
                node.set_points[identifier] = told
                node.add(Step(Role.COMMAND, pdo_key(identifier, told), time_ns, ""))

    def _mask(self, key: PdoKey) -> bytes:
        """Return a mask of the 8 data bytes of a PDO without its set-points."""
        mask, at = (1 << 64) - 1, 0
        for index, _, bits in self.decoder.maps.objects(key) or ():
            if index in _OUTPUTS or axis_of(index)[1] in SETPOINTS:
                mask &= ~(((1 << bits) - 1) << at)
            at += bits
        return mask.to_bytes(8, "little")

    # ---------------------------------------------------------------- frames from a node

    def _sent(self, number: int, time_ns: int, identifier: int, frame: bytes) -> None:
        node = self._node(number)
        node.has_sent = True
        function = identifier >> 7 if len(frame) == _CLASSIC_BYTES else 0
        low = identifier & 0x7F
        if function == 11 and low == number:
            self._answered(node, time_ns, self.decoder.decode(frame), frame)
            return
        if function == 14 and low == number and frame[4] == 1 and frame[8] == 0:
            self.decoder.decode(frame)  # the node has booted and lost its settings
            node.set_points.clear()
            node.remote.clear()  # it does not answer earlier requests
        asked = node.remote.pop(identifier, None)
        if asked is not None:
            asked.answers.append(Sent(time_ns - asked.time_ns, frame))
            return
        node.times_ns.setdefault(identifier, []).append(time_ns)
        keys = self.decoder.maps.of(identifier)
        if keys and keys[0][1]:
            kind = self.decoder.maps.transmission_type(keys[0])
            if kind is None:
                node.unclear.setdefault(identifier, []).append(
                    (node.sync, node.command, frame, time_ns)
                )
                return
            if kind <= _SYNCHRONOUS_MAX and node.sync is not None:
                node.sync.answers.append(Sent(time_ns - node.sync.time_ns, frame))
                return
        node.command.reactions.append(Sent(time_ns - node.command.time_ns, frame))

    @staticmethod
    def _answered(node: _Node, time_ns: int, said: DecodedEvent, frame: bytes) -> None:
        """Take a frame of the node's SDO server."""
        if node.dialogue is None:  # the request was not recorded
            return
        told_of = int.from_bytes(frame[9:12], "little")
        if node.late is not None and frame[8] >> 5 in _NAMING and told_of != node.dialogue.key[1]:
            late, asked_ns = node.late
            if told_of == late.key[1]:  # the host had given up this request
                late.turns[-1].answers.append(Sent(time_ns - asked_ns, frame))
                late.answer_text = said.text
                return
        node.sdo.read(frame[8:16], True)
        node.dialogue.turns[-1].answers.append(Sent(time_ns - node.asked_ns, frame))
        node.dialogue.answer_text = said.text

    @staticmethod
    def _clear_up(node: _Node) -> None:
        """Assign PDOs of unknown type to SYNC or to the commands before them."""
        for found in node.unclear.values():
            near = [
                sync is not None and time_ns - sync.time_ns <= _NEAR_NS
                for sync, _, _, time_ns in found
            ]
            by_sync = node.syncs >= _SYNCS_MIN and 10 * sum(near) >= 9 * max(len(found), node.syncs)
            for sync, command, frame, time_ns in found:
                if by_sync and sync is not None:
                    sync.answers.append(Sent(time_ns - sync.time_ns, frame))
                else:
                    command.reactions.append(Sent(time_ns - command.time_ns, frame))
        for step in node.log.steps:
            if len(step.reactions) > 1:
                step.reactions.sort(key=_delay_of)
        node.unclear.clear()


def _mark_periodic(node: _Node) -> None:
    """Mark periodic frames that were followed by the next one in time.

    A boot-up is not periodic, although it has the identifier of heartbeats.
    """
    for step in node.log.steps:
        for place, one in enumerate(step.reactions):
            identifier = int.from_bytes(one.data[:2], "little")
            period = node.log.periods_ns.get(identifier)
            if period is None or (identifier >> 7 == 14 and not one.data[8]):
                continue
            times, now_ns = node.times_ns[identifier], step.time_ns + one.delay_ns
            if goes_on(times, now_ns, period):
                step.reactions[place] = one._replace(goes_on=True)


def masked(frame: bytes, mask: bytes) -> bytes:
    """Return the can_frame with only the data bits of the mask."""
    data = int.from_bytes(frame[8:], "little") & int.from_bytes(mask, "little")
    return frame[:8] + data.to_bytes(8, "little")


def sdo_key(data: bytes) -> Key:
    """Return the key of a request that begins an SDO transfer: its object and content."""
    return ("sdo", int.from_bytes(data[1:4], "little"), meant(bytes(data)))


def meant(data: bytes) -> bytes:
    """Return an SDO client's frame with reserved and unused bytes set to zero.

    Some clients fill these bytes with zeros, others leave old contents there. Do not use it for the
    segments of a block download, which begin with a number.
    """
    kind, unused = data[0] >> 5, 0
    if kind == 2:
        unused = 4
    elif kind == 3:
        unused = 7
    elif kind == 1 and data[0] & 0x03 == 0x03:
        unused = data[0] >> 2 & 3
    elif kind == 0:
        unused = data[0] >> 1 & 7
    return data[: len(data) - unused] + bytes(unused) if unused < len(data) else data


def nmt_key(data: bytes) -> Key:
    """Return the key of an NMT command, to one node or to all."""
    return ("nmt", data[0], b"")


def pdo_key(identifier: int, frame: bytes) -> Key:
    """Return the key of a PDO to a node."""
    return ("pdo", identifier, frame[4:5] + frame[8:])


def sentence(step: Step, decoder: CanopenDecoder) -> str:
    """Return a step in words; PDOs are decoded only here, because they are frequent."""
    kind, identifier, data = step.key
    if kind != "pdo":
        return step.text
    return decoder.decode(classic(identifier, data[1 : 1 + data[0]])).text


def remote_key(identifier: int) -> Key:
    """Return the key of a remote frame."""
    return ("remote", identifier, b"")


def _delay_of(sent: Sent) -> int:
    return sent.delay_ns
