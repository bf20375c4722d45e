"""Listener of one CAN bus: object values and services from its frames.

The layout of a PDO is computed once, and again after anything that may change it. SDO transfers and
node resets are decoded by `CanopenDecoder`. Nothing is guessed about a PDO without a known mapping.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Final, final

from motorhil.harness.oracles.base import CONTROLWORD, Axis, Oracle, RecordingContext, hooks
from motorhil.traces.decoding.can_errors import ControllerState, bus_error
from motorhil.traces.decoding.canopen import NMT_STATES, CanopenDecoder
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.objects import axis_of

_ERR: Final = 0x2000_0000
_EFF_RTR: Final = 0xC000_0000
_HEAD: Final = struct.Struct("<IB")
_RESETS: Final = (0x81, 0x82)
_ASKED_MAX: Final = 8  # from several hosts at once
_MAY_BE_DRIVES: Final = (0, 402, 0xFFFF)  # low word of 1000h: no profile, drive, several

_Value = Callable[[int, Axis, int, int, int, bool], None]
_Part = tuple[Axis, int, int, int, int, int, bool, tuple[_Value, ...]]
"""Axis, shift, mask, sign bit (0: unsigned), index, sub-index, True if sent to it, listeners."""


@final
class BusListener:
    """Listener that passes the decoded frames of one bus to the oracles.

    Attributes:
        fd_frames: number of CAN FD frames that no oracle judges.
    """

    def __init__(self, name: str, context: RecordingContext, oracles: Sequence[Oracle]) -> None:
        self.fd_frames: int = 0
        self._name = name
        self._context = context
        self._oracles = oracles
        context.buses[name] = False
        self._decoder = CanopenDecoder(objects=context.names.objects_on(name))
        self._plans: dict[int, tuple[_Part, ...] | None] = {}  # None: not a PDO
        self._senders: dict[int, str] = {}
        self._no_drives: dict[int, None] = {}
        self._asked: dict[int, list[bytes]] = {}  # by node: unanswered objects
        self._answered: dict[int, None] = {}  # nodes that have answered
        self._blocks: dict[int, None] = {}  # nodes with block transfers
        self._signed: dict[int, bool] = {}
        self._wanted: dict[int, tuple[_Value, ...]] = {}
        for oracle in oracles:
            for index, is_signed in oracle.objects.items():
                self._signed[index] = is_signed
                self._wanted[index] = (*self._wanted.get(index, ()), oracle.value)
        self._off: dict[str, int] = {}  # time of bus-off, by node name
        self._on_sync = hooks(oracles, "sync")
        self._on_tpdo = hooks(oracles, "tpdo")
        self._on_sender = hooks(oracles, "sender")
        self._on_heartbeat = hooks(oracles, "heartbeat")

    def take(self, time_ns: int, frame: bytes, sender: str, *, is_known: bool = False) -> None:
        """Take a recorded frame; `is_known`: it is of a drive with a protocol of its own."""
        can_id, length = _HEAD.unpack_from(frame)
        if can_id & _ERR:
            self._error(time_ns, frame, sender)
            return
        if self._off and time_ns > self._off.get(sender, time_ns):
            for oracle in self._oracles:
                oracle.sent_while_off(time_ns, self._name, sender, can_id)
        if len(frame) != 16:
            self.fd_frames += not is_known
            return
        if can_id & _EFF_RTR:
            return
        if sender:
            before = self._senders.get(can_id, "")
            if before != sender:
                self._senders[can_id] = sender
                if all(is_sent for _, is_sent, _ in self._decoder.maps.of(can_id)):
                    for hook in self._on_sender:
                        hook(time_ns, self._name, can_id, before, sender)
        try:
            plan = self._plans[can_id]
        except KeyError:
            plan = self._plans[can_id] = self._plan(can_id)
        if plan is None:
            self._service(time_ns, can_id, frame, length)
            return
        if self._on_tpdo:
            self._tpdo(time_ns, can_id)
        if plan:
            self._values(time_ns, plan, int.from_bytes(frame[8 : 8 + length], "little"), 8 * length)

    def _error(self, time_ns: int, message: bytes, sender: str) -> None:
        error = bus_error(message)
        if error.state is ControllerState.BUS_OFF and sender:
            self._off[sender] = time_ns
        elif error.state is not None:
            self._off.pop(sender, None)
        for oracle in self._oracles:
            oracle.error(time_ns, self._name, sender, error)

    # ------------------------------------------------------------------------------------ PDO

    def _values(self, time_ns: int, plan: tuple[_Part, ...], raw: int, size: int) -> None:
        # The objects of a PDO are simultaneous: all values are set before any oracle is called.
        values: list[tuple[Axis, int, int, int, bool, tuple[_Value, ...]]] = []
        for axis, shift, mask, sign, index, subindex, is_written, wanted in plan:
            if shift + mask.bit_length() > size:
                continue
            value = raw >> shift & mask
            if value & sign:
                value -= mask + 1
            axis.take(time_ns, index, subindex, value, is_written)
            values.append((axis, index, subindex, value, is_written, wanted))
        for axis, index, subindex, value, is_written, wanted in values:
            for hook in wanted:
                hook(time_ns, axis, index, subindex, value, is_written)

    def _tpdo(self, time_ns: int, identifier: int) -> None:
        keys = self._decoder.maps.of(identifier)
        if len(keys) == 1 and keys[0][1]:
            for hook in self._on_tpdo:
                hook(time_ns, self._name, keys[0][0], keys[0][2])

    def _plan(self, identifier: int) -> tuple[_Part, ...] | None:
        """Return the parts of a PDO that oracles need; None: not a PDO."""
        keys = self._decoder.maps.of(identifier)
        if not keys:
            return None
        for node, is_sent, _ in keys:
            if is_sent:
                self._context.saw(self._name, node)
            elif self._decoder.maps.objects((node, is_sent, _)) is None:
                self._context.unmapped[self._name, node] = identifier
        parts: list[_Part] = []
        for (node, is_sent, _), at, (index, subindex, bits) in self._decoder.maps.layout(
            identifier
        )[0]:
            number, first = axis_of(index)
            if first not in self._signed or (node in self._no_drives and first >= 0x6000):
                continue
            axis = self._context.axis((self._name, node, number))
            sign = 1 << bits - 1 if self._signed[first] else 0
            mask = (1 << bits) - 1
            wanted = self._wanted[first]
            parts.append((axis, at, mask, sign, first, subindex, not is_sent, wanted))
        return tuple(parts)

    # ------------------------------------------------------------------------------- services

    def _service(self, time_ns: int, can_id: int, frame: bytes, length: int) -> None:
        function, node = can_id >> 7, can_id & 0x7F
        if function == 14 and node and length == 1:
            self._error_control(time_ns, node, frame)
        elif can_id == 0 or (function in (11, 12) and node):
            event = self._decoder.decode(frame)
            if event.kind is Kind.NMT and event.facts:
                self._nmt(time_ns, event)
            elif event.kind in (Kind.SDO_REQUEST, Kind.SDO_RESPONSE):
                self._sdo(time_ns, event, frame[8 : 8 + length])
        elif length < 2 and self._decoder.maps.is_sync(can_id):
            if not length:
                self._context.buses[self._name] = True
            for hook in self._on_sync:
                hook(time_ns, self._name, can_id)
        elif function == 1 and node and length == 8:
            self._context.saw(self._name, node)
            code = int.from_bytes(frame[8:10], "little")
            for oracle in self._oracles:
                oracle.emergency(time_ns, self._name, node, code, frame[10])

    def _error_control(self, time_ns: int, node: int, frame: bytes) -> None:
        state = frame[8] & 0x7F
        if frame[8] == 0:
            self._context.buses[self._name] = True
            self._decoder.decode(frame)
            for oracle in self._oracles:
                oracle.boot(time_ns, self._name, node)
            self._forget(node)
        elif state in NMT_STATES:
            for hook in self._on_heartbeat:
                hook(time_ns, self._name, node, state)
        self._context.saw(self._name, node, is_device=frame[8] == 0)

    def _nmt(self, time_ns: int, event: DecodedEvent) -> None:
        command = event.facts[0].value
        assert isinstance(command, int)
        for oracle in self._oracles:
            oracle.nmt(time_ns, self._name, event.node, command)
        if command in _RESETS:
            self._forget(event.node)

    def _forget(self, node: int | None) -> None:
        self._plans.clear()
        for axis in list(self._context.axes.values()):
            if axis.place[0] == self._name and node in (None, axis.place[1]):
                axis.forget()

    # ------------------------------------------------------------------------------------ SDO

    def _sdo(self, time_ns: int, event: DecodedEvent, data: bytes) -> None:
        node, is_request = event.node, event.kind is Kind.SDO_REQUEST
        assert node is not None
        if len(data) == 8:
            self._follow(node, data, is_request)
        for oracle in self._oracles:
            oracle.sdo(time_ns, self._name, event, data)
        if not is_request:
            self._context.saw(self._name, node)
        index = event.index
        if index is None:
            return
        number, first = axis_of(index)
        if is_request and first == CONTROLWORD and data[0] >> 5 == 1 and data[0] & 2:
            # A controlword acts on arrival, not on confirmation.
            word = int.from_bytes(data[4:6], "little")
            self._pass_value(time_ns, (node, number), first, event.subindex or 0, word, True)
        if not event.facts or not isinstance(event.facts[0].value, int):
            return
        value, is_written = event.facts[0].value, event.facts[0].told_to
        if 0x1400 <= index < 0x1C00 or index == 0x1005:
            self._plans.clear()
        elif index == 0x1000:
            self._plans.clear()
            if value & 0xFFFF in _MAY_BE_DRIVES:
                self._no_drives.pop(node, None)
            else:
                self._no_drives[node] = None
        if first != CONTROLWORD and not (node in self._no_drives and first >= 0x6000):
            if event.facts[0].subject.endswith("aborted"):
                return
            self._pass_value(time_ns, (node, number), first, event.subindex or 0, value, is_written)

    def _follow(self, node: int, data: bytes, is_request: bool) -> None:
        """Match answers with requests: a match proves CANopen, a missing request proves a gap.

        Only the start of a transfer names its object, and block segments may have any content.
        """
        specifier = data[0] >> 5
        if node in self._blocks or (is_request and specifier in (5, 6)):
            self._blocks[node] = None
            return
        asked = self._asked.setdefault(node, [])
        if is_request:
            if data[0] == 0x80:
                asked.clear()
            elif specifier in (1, 2):
                asked.append(data[1:4])
                del asked[:-_ASKED_MAX]
        elif specifier in (2, 3):
            if data[1:4] in asked:
                asked.remove(data[1:4])
                self._context.buses[self._name] = True
                self._answered[node] = None
            elif node in self._answered:
                self._context.gaps["it has an SDO answer without a request"] = None
        elif data[0] == 0x80 and data[1:4] in asked:
            asked.remove(data[1:4])
            self._answered[node] = None

    def _pass_value(
        self, time_ns: int, place: tuple[int, int], index: int, subindex: int, value: int, to: bool
    ) -> None:
        wanted = self._wanted.get(index)
        if wanted is None:
            return
        axis = self._context.axis((self._name, *place))
        axis.take(time_ns, index, subindex, value, to)
        for hook in wanted:
            hook(time_ns, axis, index, subindex, value, to)
