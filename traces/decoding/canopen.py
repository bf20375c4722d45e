"""Passive decoder of the CANopen traffic on one bus, into sentences and facts.

It is independent of the emulators and of the motor interface. It knows the objects of CiA 301 and
402, and of an EDS attached to the recording. It learns the contents of PDOs from the SDO traffic.
To decode from the middle of a recording, feed it the beginning first.

Source: CiA 301 (pre-defined connection set, NMT, error control, SYNC, TIME, EMCY, SDO and its abort
codes, PDO); CiA 402-2 for the emergencies of drives.
"""

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from itertools import chain
from typing import Final, NamedTuple, final

from motorhil.traces.can_frame import EFF, ERR, RTR
from motorhil.traces.decoding.can_errors import bus_error
from motorhil.traces.decoding.cia402 import controlword_text, mode_text, statusword_text
from motorhil.traces.decoding.events import (
    CONTROLLER,
    FOREIGN,
    DecodedEvent,
    Fact,
    Kind,
    Value,
)
from motorhil.traces.decoding.objects import ObjectName, ObjectNames, axis_of, value_of, value_text
from motorhil.traces.decoding.pdo import Entry, PdoKey, PdoMaps
from motorhil.traces.decoding.sdo import SdoReader, SdoStep, Step

_HEAD: Final = struct.Struct("<IB")
_CONTROLWORD: Final = 0x6040
_STATUSWORD: Final = 0x6041
_MODE: Final = (0x6060, 0x6061)
_DRIVES: Final = (402, 0xFFFF)
"""Low word of the device type 1000h: a drive, or several devices with a profile each."""
_OBJECTS_KEPT: Final = 4096  # of a node
_RESETS: Final = (0x81, 0x82)
_MOTION: Final = frozenset(
    (
        *(0x6042, 0x6043, 0x6044, 0x6062, 0x6063, 0x6064, 0x6069, 0x606B, 0x606C, 0x6071),
        *(0x6074, 0x6077, 0x6078, 0x6079, 0x607A, 0x60C1, 0x60F4, 0x60FA, 0x60FC, 0x60FF),
    )
)
"""Measured and demanded quantities of CiA 402."""
SETPOINTS: Final = frozenset((0x607A, 0x60FF, 0x6071, 0x6042, 0x60C1))
NMT_COMMANDS: Final = {
    0x01: "start",
    0x02: "stop",
    0x80: "enter pre-operational",
    0x81: "reset node",
    0x82: "reset communication",
}
NMT_STATES: Final = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}

_TO_ALL: Final = {0x000: "NMT", 0x080: "SYNC", 0x100: "TIME"}
_SERVICES: Final = {
    1: "EMCY",
    3: "TPDO 1",
    4: "RPDO 1",
    5: "TPDO 2",
    6: "RPDO 2",
    7: "TPDO 3",
    8: "RPDO 3",
    9: "TPDO 4",
    10: "RPDO 4",
    11: "SDO from",
    12: "SDO to",
    14: "heartbeat",
}
SDO_ABORTS: Final = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "client/server command specifier not valid or unknown",
    0x05040002: "invalid block size",
    0x05040003: "invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "unsupported access to an object",
    0x06010001: "attempt to read a write only object",
    0x06010002: "attempt to write a read only object",
    0x06020000: "object does not exist in the object dictionary",
    0x06040041: "object cannot be mapped to the PDO",
    0x06040042: "mapped objects would exceed the PDO's length",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility in the device",
    0x06060000: "access failed due to a hardware error",
    0x06070010: "data type does not match, length of service parameter does not match",
    0x06070012: "data type does not match, length of service parameter too high",
    0x06070013: "data type does not match, length of service parameter too low",
    0x06090011: "sub-index does not exist",
    0x06090030: "invalid value for parameter (download only)",
    0x06090031: "value of parameter written too high",
    0x06090032: "value of parameter written too low",
    0x06090036: "maximum value is less than minimum value",
    0x060A0023: "resource not available: SDO connection",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored to the application",
    0x08000021: "data cannot be transferred or stored: local control",
    0x08000022: "data cannot be transferred or stored: present device state",
    0x08000023: "no object dictionary is present",
    0x08000024: "no data available",
}

_EMERGENCIES: Final = {
    0x0000: "error reset, or no error",
    0x2310: "continuous over current",
    0x2320: "short circuit or earth leakage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4210: "excess temperature of the device",
    0x4310: "excess temperature of the drive",
    0x5441: "contact 1",
    0x7122: "motor error or commutation malfunction",
    0x7305: "incremental sensor 1 fault",
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO not processed: length error",
    0x8220: "PDO length exceeded",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO time-out",
    0x8400: "velocity speed controller",
    0x8500: "position controller",
    0x8611: "following error",
    0x8612: "reference limit",
}
_EMERGENCY_GROUPS: Final = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}


def abort_text(code: int) -> str:
    """Return an SDO abort code in words."""
    return SDO_ABORTS.get(code, "a code that is not in CiA 301")


def emergency_text(code: int) -> str:
    """Return an emergency error code in words, or its group's."""
    found = _EMERGENCIES.get(code) or _EMERGENCY_GROUPS.get(code >> 8)
    return found or _EMERGENCY_GROUPS.get(code >> 8 & 0xF0, "a code that is not in CiA 301")


class _Object(NamedTuple):
    """An object of a node.

    Attributes:
        name: its name and kind.
        place: its index and sub-index.
        axis, first: its axis, and its index on the first axis.
        subject: of its facts.
        words: returns a whole number in words; None: as any of its kind.
        is_motion: True for a measured or demanded quantity.
        teaches: True if its value affects the decoding of frames.
    """

    name: ObjectName
    place: tuple[int, int]
    axis: int
    first: int
    subject: str
    words: "Callable[[_Node, int, int], str] | None"
    is_motion: bool
    teaches: bool


@final
class _Node:
    """The known facts about a node."""

    def __init__(self, name: str, names: ObjectNames) -> None:
        self.name = name
        self.names = names
        self.sdo = SdoReader()
        self.is_drive = True  # until its device type shows otherwise
        self.modes: dict[int, int] = {}  # modes of operation by axis
        self.controlwords: dict[int, int] = {}
        self._objects: dict[tuple[int, int], _Object] = {}

    def be_drive(self, is_drive: bool) -> None:
        """Name the objects from 6000h on by CiA 402 only if this is a drive."""
        self.is_drive = is_drive
        self._objects.clear()

    def object(self, index: int, subindex: int) -> _Object:
        """Return an object, which most frames of a recording name again and again."""
        found = self._objects.get((index, subindex))
        if found is None:
            name = self.names.of(index, subindex, self.is_drive)
            axis, first = self._place(index)
            found = _Object(
                *(name, (index, subindex), axis, first),
                f"{place_text(index, subindex)} {name.text}".strip(),
                _WORDS.get(first),
                first in _MOTION,
                first in _MODE or first == _CONTROLWORD or 0x1000 <= index < 0x1C00,
            )
            if len(self._objects) >= _OBJECTS_KEPT:
                self._objects.clear()
            self._objects[index, subindex] = found
        return found

    def _place(self, index: int) -> tuple[int, int]:
        """Return axis and index on the first axis; index 0 for device objects of a non-drive."""
        return axis_of(index) if self.is_drive or index < 0x6000 else (1, 0)


@final
class _Mapped:
    """An object in a PDO: its place in the data, and how to read it."""

    __slots__ = ("at", "end", "is_motion", "is_whole", "known", "mask", "sign", "size", "words")

    def __init__(self, known: _Object, at: int, bits: int, told_to: bool) -> None:
        kind = known.name.kind
        self.known = known
        self.at = at
        self.end = at + bits
        self.size = (bits + 7) // 8
        self.mask = (1 << bits) - 1
        self.sign = 1 << bits - 1 if kind[:1] == "i" and bits else 0
        # Others are read from their bytes, which may not fit the kind.
        is_usual = kind[:1] in ("u", "i", "x") and int(kind[1:]) == bits
        self.is_whole = is_usual or (not kind and 0 < bits <= 32)
        # A set-point by SDO is an ordinary command; a stream of set-points is motion.
        self.is_motion = known.is_motion and (not told_to or known.first in SETPOINTS)
        self.words = partial(value_text, kind, self.size)


@final
class _Pdo:
    """A PDO as it is mapped now; `parts` is None if its mapping is unknown."""

    __slots__ = ("key", "node", "parts", "what")

    def __init__(
        self, key: PdoKey, transmitted: bool, node: _Node, entries: list[Entry] | None
    ) -> None:
        _, _, which = key
        self.key = key
        self.node = node
        self.what = f"{node.name} TPDO {which}" if transmitted else f"RPDO {which} to {node.name}"
        self.parts: list[_Mapped] | None = None
        if entries is not None:
            self.parts, at = [], 0
            for index, subindex, bits in entries:
                known = node.object(index, subindex)
                self.parts.append(_Mapped(known, at, bits, not transmitted))
                at += bits


@final
class CanopenDecoder:
    """Decoder of one bus; frames must be passed in recorded order."""

    def __init__(
        self,
        node_names: Mapping[int, str] | None = None,
        objects: Mapping[int, ObjectNames] | None = None,
    ) -> None:
        """Create a decoder with the names of nodes and the objects of those with an EDS."""
        self.maps: PdoMaps = PdoMaps()
        self._node_names = dict(node_names or {})
        self._objects = dict(objects or {})
        self._standard = ObjectNames()
        self._nodes: dict[int, _Node] = {}
        self._pdos: dict[int, list[_Pdo]] = {}  # by identifier, as of this version of the maps
        self._pdos_version = 0
        for node, names in self._objects.items():
            self._learn_defaults(node, names)

    def decode(self, frame: bytes, sender: str = "") -> DecodedEvent:
        """Decode a can_frame or canfd_frame; `sender` is the origin of an error message."""
        can_id, length = _HEAD.unpack_from(frame)
        if can_id & ERR:
            return self._bus_error(frame, sender)
        data = frame[8 : 8 + length]
        identifier = can_id & 0x1FFF_FFFF
        if len(frame) != 16:
            return _flexible(identifier, data, can_id, frame[5])
        if can_id & (EFF | RTR):
            return _other(identifier, data, can_id)
        node, function = identifier & 0x7F, identifier >> 7
        if identifier == 0:
            return self._nmt(data)
        if self._pdos_version != self.maps.version:
            self._pdos.clear()
            self._pdos_version = self.maps.version
        pdos = self._pdos.get(identifier)
        if pdos is None:
            pdos = self._pdos[identifier] = self._pdos_of(identifier)
        if pdos:  # a PDO has its own identifier, wherever that is
            return self._pdo(pdos, data)
        if len(data) < 2 and self.maps.is_sync(identifier):
            counter = f" {data[0]}" if data else ""
            return DecodedEvent(Kind.SYNC, None, f"SYNC{counter}")
        if identifier == 0x100:
            return DecodedEvent(Kind.TIME, None, _time_text(data))
        if function == 1 and len(data) == 8:
            return self._emergency(node, data)
        if function in (11, 12) and node:
            return self._sdo(node, data, function == 11)
        if function == 14 and node and len(data) == 1:
            return self._heartbeat(node, data[0])
        return _other(identifier, data, can_id)

    def forget_transfers(self) -> None:
        """Abandon all SDO transfers in progress, because frames are missing from here on."""
        for node in self._nodes.values():
            node.sdo = SdoReader()

    def _node(self, number: int) -> _Node:
        found = self._nodes.get(number)
        if found is None:
            name = self._node_names.get(number)
            found = self._nodes[number] = _Node(
                f"node {number}" if name is None else f"{name} ({number})",
                self._objects.get(number, self._standard),
            )
        return found

    def _forget(self, number: int) -> None:
        """Reset a node: its PDOs are those of its EDS, or unknown."""
        node = self._node(number)
        node.modes, node.controlwords, node.sdo = {}, {}, SdoReader()
        self.maps.forget(number)
        self._learn_defaults(number, node.names)

    def _learn_defaults(self, node: int, names: ObjectNames) -> None:
        """Learn the default PDOs of an EDS."""
        for (index, subindex), text in names.defaults.items():
            if not 0x1400 <= index < 0x1C00:
                continue
            plain = text.upper().replace(" ", "").replace("$NODEID", str(node))
            try:
                value = sum(int(part, 0) for part in plain.split("+"))
            except ValueError:
                continue
            self.maps.learn(node, index, subindex, value)

    def _bus_error(self, frame: bytes, sender: str) -> DecodedEvent:
        node = next((n for n, name in self._node_names.items() if name == sender), None)
        who = sender if node is None else self._node(node).name
        whose = f" of {who}" if who else ""
        told = bus_error(frame)
        words = told.text + told.counted
        # The counters are not part of the value: two runs can differ in them and mean the same.
        subject, value = f"{CONTROLLER}'s errors", told.text
        if told.state is not None:
            subject, value = CONTROLLER, told.state.value
        fact = Fact(subject if node is not None else subject + whose, value, words)
        return DecodedEvent(Kind.BUS_ERROR, node, f"error frame{whose}: {words}", (fact,))

    # ---------------------------------------------------------------------------- services

    def _nmt(self, data: bytes) -> DecodedEvent:
        if len(data) < 2:
            return DecodedEvent(Kind.NMT, None, f"NMT command of {len(data)} bytes instead of 2")
        command = NMT_COMMANDS.get(data[0], f"unknown command {data[0]:02X}h")
        node = data[1] or None
        whom = "all nodes" if node is None else self._node(node).name
        fact = Fact("NMT command", data[0], command, told_to=True)
        if data[0] in _RESETS:
            for number in list(self._nodes) if node is None else [node]:
                self._forget(number)
        return DecodedEvent(Kind.NMT, node, f"NMT to {whom}: {command}", (fact,))

    def _heartbeat(self, node: int, state: int) -> DecodedEvent:
        name = self._node(node).name
        if state == 0:
            self._forget(node)
            fact = Fact("NMT state", 0, "boot-up")
            return DecodedEvent(Kind.BOOT, node, f"{name} has booted", (fact,))
        text = NMT_STATES.get(state & 0x7F, f"state {state & 0x7F:02X}h, unknown")
        fact = Fact("NMT state", state & 0x7F, text)
        return DecodedEvent(Kind.HEARTBEAT, node, f"{name} is {text}", (fact,))

    def _emergency(self, node: int, data: bytes) -> DecodedEvent:
        code = int.from_bytes(data[0:2], "little")
        name = self._node(node).name
        text = f"{code:04X}h {emergency_text(code)}, error register {data[2]:02X}h"
        rest = f", manufacturer's {data[3:].hex(' ').upper()}" if any(data[3:]) else ""
        fact = Fact("emergency", data, text)
        return DecodedEvent(Kind.EMERGENCY, node, f"{name} emergency {text}{rest}", (fact,))

    # --------------------------------------------------------------------------------- SDO

    def _sdo(self, number: int, data: bytes, from_server: bool) -> DecodedEvent:
        node = self._node(number)
        step = node.sdo.read(data, from_server)
        kind = Kind.SDO_RESPONSE if from_server else Kind.SDO_REQUEST
        if step.step is Step.NONE:
            return DecodedEvent(
                kind, number, f"{node.name} SDO, not understood: {data.hex(' ').upper()}"
            )
        known, subject = None, "an object (the beginning was not recorded)"
        if step.index is not None and step.subindex is not None:
            known = node.object(step.index, step.subindex)
            subject = known.subject
        facts: tuple[Fact, ...] = ()
        told: Fact | None = None
        if known is not None and step.whole is not None:
            told = _fact(node, known, step.whole, not step.upload)
            facts = (told,)
            if known.teaches and isinstance(told.value, int):
                self._learn(number, node, known, told.value, told.told_to)
        elif step.step is Step.ABORT:
            what = "read" if step.upload else "write"
            place = place_text(step.index or 0, step.subindex or 0)
            code = step.abort_code
            facts = (Fact(f"{what} of {place} aborted", code, abort_text(code), not from_server),)
        elif known is not None and step.step is Step.DOWNLOAD:
            told = _fact(node, known, step.data, told_to=True)
        who = f"SDO {node.name}" if from_server else f"SDO to {node.name}"
        words = partial(_sdo_text, who, subject, step, told)
        return DecodedEvent(kind, number, words, facts, step.index, step.subindex)

    def _learn(self, number: int, node: _Node, known: _Object, value: int, told_to: bool) -> None:
        """Learn from the value of an object."""
        index, subindex = known.place
        self.maps.learn(number, index, subindex, value)
        if index == 0x1000:
            node.be_drive(value & 0xFFFF in _DRIVES)
            self._pdos.clear()
        if known.first in _MODE and value:
            node.modes[known.axis] = value
        if known.first == _CONTROLWORD and told_to:
            node.controlwords[known.axis] = value

    # --------------------------------------------------------------------------------- PDO

    def _pdos_of(self, identifier: int) -> list[_Pdo]:
        """Return the PDOs with this identifier: a TPDO, or the RPDOs of all receivers."""
        keys = self.maps.of(identifier)
        transmitted = bool(keys) and keys[0][1]
        return [
            _Pdo(key, transmitted, self._node(key[0]), self.maps.objects(key))
            for key in (keys[:1] if transmitted else keys)
        ]

    def _pdo(self, pdos: list[_Pdo], data: bytes) -> DecodedEvent:
        number, transmitted, _ = pdos[0].key
        kind = Kind.TPDO if transmitted else Kind.RPDO
        told = [self._facts(pdo, data, not transmitted) for pdo in pdos]
        words = partial(_pdo_text, pdos, told)
        if len(told) == 1:
            return DecodedEvent(kind, number, words, tuple(told[0]))
        return DecodedEvent(kind, None, words, tuple(chain.from_iterable(told)))

    def _facts(self, pdo: _Pdo, data: bytes, told_to: bool) -> list[Fact]:
        """Return the facts of a PDO, and learn from it."""
        if pdo.parts is None:
            subject = f"{'R' if told_to else 'T'}PDO {pdo.key[2]}"
            return [Fact(subject, data, _data_text, told_to)]
        facts: list[Fact] = []
        node = pdo.node
        raw, size = int.from_bytes(data, "little"), 8 * len(data)
        for part in pdo.parts:
            known = part.known
            if part.end > size:
                missing = "missing: the PDO is too short"
                facts.append(Fact(place_text(*known.place), b"", missing, told_to))
                break
            if known.place[0] < 0x20:
                continue  # a dummy object
            whole = raw >> part.at & part.mask
            value: Value = whole - 2 * (whole & part.sign)
            if not part.is_whole:
                value = value_of(known.name.kind, whole.to_bytes(part.size, "little"))
            words: str | Callable[[Value], str] = part.words
            if known.words is not None and isinstance(value, int):
                words = known.words(node, known.axis, value)
            facts.append(Fact(known.subject, value, words, told_to, part.is_motion))
            if known.teaches and isinstance(value, int):
                self._learn(pdo.key[0], node, known, value, told_to)
        return facts


def _pdo_text(pdos: list[_Pdo], told: list[list[Fact]]) -> str:
    """Return the facts of each PDO as a sentence."""
    sentences: list[str] = []
    for pdo, facts in zip(pdos, told, strict=True):
        if pdo.parts is None:
            words = f"{facts[0].text} (its mapping is not in the recording)"
        else:
            words = ", ".join([f"{fact.subject} = {fact.text}" for fact in facts])
        sentences.append(f"{pdo.what}: {words}")
    return "; ".join(sentences)


def _data_text(data: Value) -> str:
    assert isinstance(data, bytes)
    return data.hex(" ").upper() or "no data"


def _fact(node: _Node, known: _Object, data: bytes, told_to: bool) -> Fact:
    """Return the value of an object, read or written by SDO."""
    value = value_of(known.name.kind, data)
    words: str | Callable[[Value], str] = partial(value_text, known.name.kind, len(data))
    if known.words is not None and isinstance(value, int):
        words = known.words(node, known.axis, value)
    return Fact(known.subject, value, words, told_to, known.is_motion and not told_to)


def _sdo_text(who: str, subject: str, step: SdoStep, told: Fact | None) -> str:
    """Return a frame of a transfer as a sentence; `told` is the value in it, if it is known."""
    if step.step is Step.ABORT:
        code = step.abort_code
        return f"{who}: abort of {subject}: {abort_text(code)} ({code:08X}h)"
    value = ""
    if step.step in (Step.UPLOADED, Step.DOWNLOAD) and told is not None:
        value = f" = {told.text}"
    elif step.data:
        value = f": {step.data.hex(' ').upper()}"
    if step.step is Step.SEGMENT_UPLOADED and told is not None and step.index:
        value += f"; whole = {told.text}"
    size = "" if step.size is None else f", {step.size} bytes"
    word = {Step.ASK_UPLOAD: "read", Step.DOWNLOAD: "write", Step.UPLOADED: ""}.get(
        step.step, step.step.value
    )
    return f"{who}: {f'{word} {subject}'.strip()}{value}{size}"


def _controlword(node: _Node, axis: int, value: int) -> str:
    return _controlword_in(value, node.modes.get(axis, 0), node.controlwords.get(axis))


def _statusword(node: _Node, axis: int, value: int) -> str:
    return _statusword_in(value, node.modes.get(axis, 0))


@lru_cache(1024)
def _controlword_in(value: int, mode: int, before: int | None) -> str:
    return f"{value:04X}h {controlword_text(value, mode, before)}"


@lru_cache(1024)
def _statusword_in(value: int, mode: int) -> str:
    return f"{value:04X}h {statusword_text(value, mode)}"


def _mode(node: _Node, axis: int, value: int) -> str:
    return f"{value} {mode_text(value)}"


def _error_code(node: _Node, axis: int, value: int) -> str:
    return f"{value:04X}h {emergency_text(value)}"


_WORDS: Final = {
    _CONTROLWORD: _controlword,
    _STATUSWORD: _statusword,
    **dict.fromkeys(_MODE, _mode),
    0x603F: _error_code,
}


def place_text(index: int, subindex: int) -> str:
    """Return the notation of an object: 6041h, or 1018h:1."""
    return f"{index:04X}h:{subindex}" if subindex else f"{index:04X}h"


def _time_text(data: bytes) -> str:
    if len(data) != 6:
        return f"TIME of {len(data)} bytes instead of 6"
    milliseconds, days = struct.unpack("<IH", data)
    return f"TIME {(milliseconds & 0xFFF_FFFF) / 1000:.3f} s after midnight, day {days} from 1984"


def _flexible(identifier: int, data: bytes, can_id: int, flags: int) -> DecodedEvent:
    """Decode a CAN FD frame, which belongs to no classical CANopen service."""
    what = f"{_foreign(identifier, can_id)} CAN FD"
    marks = "".join(f" {name}" for bit, name in ((1, "BRS"), (2, "ESI")) if flags & bit)
    fact = Fact(what, data, _data_text)
    return DecodedEvent(Kind.OTHER, None, partial(_flexible_text, fact, marks), (fact,))


def _flexible_text(fact: Fact, marks: str) -> str:
    assert isinstance(fact.value, bytes)
    return f"{fact.subject}{marks}, {len(fact.value)} bytes: {fact.text}"


def _foreign(identifier: int, can_id: int) -> str:
    return f"{FOREIGN}{identifier:0{8 if can_id & EFF else 3}X}h"


def _other(identifier: int, data: bytes, can_id: int) -> DecodedEvent:
    what = _foreign(identifier, can_id)
    if can_id & RTR:
        return DecodedEvent(Kind.OTHER, None, f"{what} remote frame")
    fact = Fact(what, data, _data_text)
    return DecodedEvent(Kind.OTHER, None, partial(_other_text, fact), (fact,))


def _other_text(fact: Fact) -> str:
    return f"{fact.subject}: {fact.text}"


def usual_name(identifier: int, nodes: Mapping[int, str]) -> str:
    """Return service and node of an identifier in words, or "" if the set does not define it.

    Args:
        identifier: an 11-bit identifier.
        nodes: node names by node-ID.
    """
    if identifier in _TO_ALL:
        return _TO_ALL[identifier]
    function, node = identifier >> 7, identifier & 0x7F
    what = _SERVICES.get(function)
    if what is None or not node:
        return ""
    return f"{what} {nodes.get(node, f'node {node}')}"


def is_sdo(identifier: int) -> bool:
    """Return True for a request or response identifier of the default SDO channel."""
    return 0x581 <= identifier <= 0x5FF or 0x601 <= identifier <= 0x67F
