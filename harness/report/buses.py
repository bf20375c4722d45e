"""Buses of the report: their traffic, and the quantities of their nodes.

Traffic is one entry per frame or ADU, for any medium. Most frames are PDOs, and most of their
objects are not drawn. The position of each quantity in a PDO is therefore computed once, from the
decoder's knowledge, and again after anything that may change it. All other CANopen frames go to the
decoder. Of repeated heartbeats only the times count.

A state lasts until the next message about it, but not longer than the node is heard. From a reset
command, a boot-up, or the first of several missing heartbeats on, an earlier state is unknown.
"""

import struct
from array import array
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.analysis.from_recording import RecordedBus
from motorhil.harness.analysis.subject import Queues, Subject
from motorhil.harness.report.incidents import KEPT, Incidents, Severity
from motorhil.harness.report.series import STRETCH_NS, Steps, Track, cell_width_ns, cells
from motorhil.traces.can_frame import EFF, ERR, RTR
from motorhil.traces.decoding.attached_rig import RecordedNames
from motorhil.traces.decoding.can_errors import BusError, ControllerState, bus_error
from motorhil.traces.decoding.canopen import NMT_STATES, CanopenDecoder, usual_name
from motorhil.traces.decoding.cia402 import STATES, UNKNOWN_STATE, state_number
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.decoding.narrative import BusMessage, Describe
from motorhil.traces.decoding.objects import axis_of
from motorhil.traces.formats.modbus import Malformed, recorded_adu
from motorhil.traces.protobuf import Value
from motorhil.traces.schema import Direction, FrameDecoder

if TYPE_CHECKING:
    from numpy import int64
    from numpy.typing import NDArray

Place = tuple[str, int, int]
"""Bus, node or unit, axis from 1."""
LABELS_MAX: Final = 4_000
"""Limit of distinguished identifiers on one bus."""
_HEAD: Final = struct.Struct("<IB")
_SYNC: Final = 0x080
_HEARTBEAT_TIME: Final = 0x1017

# Index: True if signed. Source: CiA 402-2, object dictionary.
QUANTITIES: Final[dict[int, bool]] = {
    0x603F: False,  # error code
    0x6041: False,  # statusword
    0x6061: True,  # modes of operation display
    0x6062: True,  # position demand value
    0x6064: True,  # position actual value
    0x606B: True,  # velocity demand value
    0x606C: True,  # velocity actual value
    0x6075: False,  # motor rated current
    0x6076: False,  # motor rated torque
    0x6077: True,  # torque actual value
    0x6078: True,  # current actual value
    0x607A: True,  # target position
    0x60C1: True,  # interpolation data record
    0x60F4: True,  # following error actual value
    0x60FF: True,  # target velocity
}
STATUSWORD: Final = 0x6041
FAULTS: Final = tuple(n for n, (_, _, name) in enumerate(STATES) if name.startswith("fault"))

FRAMES_MEASURED: Final = 1_000_000
"""Limit of the frames of one bus from which response times are measured."""
NO_HEARTBEAT: Final = 0x100
RESET: Final = 0x101
"""Numbers beside the NMT states: heartbeats are missing; reset, without a message since."""
_OTHER_STATES: Final = {NO_HEARTBEAT: "no heartbeat", RESET: "reset"}
_OF_DRIVE: Final = {0x81}  # NMT command that also resets the drive profile, and its power
_RESETS: Final = {0x81, 0x82}
_GAPS: Final = 8  # the period of a heartbeat is the median of so many distances
_MISSING: Final = 3  # periods without a heartbeat
_LEVELS: Final[dict[ControllerState | None, Severity]] = {
    ControllerState.BUS_OFF: Severity.ERROR,
    ControllerState.ACTIVE: Severity.INFO,
    ControllerState.RESTARTED: Severity.INFO,
}
_MAY_BE_DRIVES: Final = (0, 402, 0xFFFF)
"""Low word of the device type 1000h: no profile, a drive, or several devices in one."""
_FUNCTIONS: Final = {
    1: "read coils",
    2: "read discrete inputs",
    3: "read registers",
    4: "read input registers",
    5: "write coil",
    6: "write register",
    8: "diagnostics",
    15: "write coils",
    16: "write registers",
    22: "mask register",
    23: "read and write registers",
    43: "encapsulated interface",
}
_NS: Final = 1e9


@final
@dataclass(slots=True)
class Traffic:
    """All traffic of one bus or line.

    Attributes:
        name: name of the bus or line.
        kind: "CAN", "Modbus RTU", "Modbus/TCP" or "serial line".
        unit: unit of `weights`: "bit" or "ns".
        capacity_s: capacity per second in that unit; None: unknown, so no load in per cent.
        why_no_capacity: the reason if it is None.
        times_ns: end of each entry [ns from the recording's beginning].
        keys: index into `labels` of each entry.
        weights: capacity taken by each entry.
        labels: the distinguished kinds (identifiers, functions), in order of appearance.
        ranks: sort key of each label.
        names: description of each label.
        counts: number of frames in each of the first entries, which are cells.
        width_ns: duration of a cell [ns], whose time is its begin; 0: all entries are frames.
        frames: number of all frames.
    """

    name: str
    kind: str
    unit: str
    capacity_s: float | None
    why_no_capacity: str = ""
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    keys: "array[int]" = field(default_factory=lambda: array("H"))
    weights: "array[int]" = field(default_factory=lambda: array("L"))
    labels: list[str] = field(default_factory=list)
    ranks: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    counts: "array[int]" = field(default_factory=lambda: array("q"))
    width_ns: int = 0
    frames: int = 0

    def add(self, time_ns: int, key: int, weight: int) -> None:
        """Add one frame."""
        self.frames += 1
        self.times_ns.append(time_ns)
        self.keys.append(key)
        self.weights.append(weight)

    def latest(self, frames: int) -> "Traffic":
        """Return the latest entries, at most this number of frames; cells are not in it."""
        count = max(0, min(frames, len(self.times_ns) - len(self.counts)))
        begin = len(self.times_ns) - count
        part = replace(self, counts=array("q"), width_ns=0, frames=count)
        part.times_ns, part.keys, part.weights = (
            one[begin:] for one in (self.times_ns, self.keys, self.weights)
        )
        return part

    def arrays(self) -> "tuple[NDArray[int64], ...]":
        """Return times, keys, weights and counts of all entries, in order of arrival."""
        import numpy as np

        times, keys, weights, counts = (
            np.array(one, dtype=np.int64)
            for one in (self.times_ns, self.keys, self.weights, self.counts)
        )
        single = np.ones(len(times) - len(counts), dtype=np.int64)
        return times, keys, weights, np.concatenate((counts, single))

    def sum_up(self, budget: int) -> None:
        """Sum the entries in at most `budget` cells, of the shortest duration that allows it."""
        times, keys, weights, counts = self.arrays()
        width_ns = cell_width_ns(times, keys, budget, max(self.width_ns, STRETCH_NS))
        times, keys, weights, counts = cells(times, keys, weights, counts, width_ns)
        self.width_ns = width_ns
        self.times_ns = array("q", times.tobytes())
        self.keys = array("H", keys.astype("<u2").tobytes())
        self.weights = array("L", weights.astype("<u8").tobytes())
        self.counts = array("q", counts.tobytes())

    def label(self, text: str, rank: int, name: str = "") -> int:
        """Return the number of a new label; from `LABELS_MAX` on, one number for all the rest."""
        if len(self.labels) >= LABELS_MAX:
            if len(self.labels) == LABELS_MAX:
                self.labels.append("others")
                self.ranks.append(1 << 40)
                self.names.append("")
            return LABELS_MAX
        self.labels.append(text)
        self.ranks.append(rank)
        self.names.append(name)
        return len(self.labels) - 1


@final
class ModbusLine:
    """Collector of the ADUs of one line.

    Attributes:
        traffic: the load; in ns of occupation on a serial line, otherwise in bits of ADUs.
    """

    def __init__(self, name: str, tcp: bool, names: RecordedNames, incidents: Incidents) -> None:
        """Set up the collector; events go to `incidents`; `tcp`: the framing is MBAP."""
        if tcp:
            why = "a TCP connection has no bit rate of its own"
            self.traffic: Traffic = Traffic(name, "Modbus/TCP", "bit", None, why)
        else:
            self.traffic = Traffic(name, "Modbus RTU", "ns", _NS)
        self._name = name
        self._incidents = incidents
        self._units = {n: c for (bus, n), c in names.nodes.items() if bus == name}
        self._decoder = ModbusDecoder(self._units)
        self._labels: dict[tuple[int, int, bool], int] = {}

    def take(self, time_ns: int, fields: dict[str, Value], begin_ns: int) -> None:
        """Take a recorded ADU; `time_ns` counts from `begin_ns`, unlike the times in its fields."""
        data = fields.get("data", b"")
        assert isinstance(data, bytes)
        to_server = fields.get("direction") == Direction.TRANSMITTED
        start_ns, end_ns = fields.get("start_ns", 0), fields.get("end_ns", 0)
        assert isinstance(start_ns, int)
        assert isinstance(end_ns, int)
        tcp = bool(fields.get("tcp"))
        adu = recorded_adu(fields, time_ns)
        is_broken = isinstance(adu, Malformed)
        is_busy = self.traffic.unit == "ns" and end_ns > start_ns
        weight = end_ns - start_ns if is_busy else 8 * len(data)
        if self.traffic.unit == "ns" and not is_busy:
            weight = 0
        ended_ns = end_ns - begin_ns if is_busy else time_ns
        self.traffic.add(ended_ns, self._label(data, tcp, to_server, is_broken), weight)
        if isinstance(adu, Malformed):
            text = f"no ADU ({adu.problem}): {data.hex(' ').upper()}"
            self._incidents.add(time_ns, Severity.WARNING, "no Modbus ADU", self._name, text)
            return
        sender = str(fields.get("sender", ""))
        if not to_server and sender:
            self._decoder.call(adu.unit, sender)
        said = self._decoder.decode(adu)
        if said.facts and said.facts[0].subject.endswith("refused"):
            self._incidents.add(
                time_ns, Severity.WARNING, "Modbus exception", self._name, said.text
            )

    def _label(self, data: bytes, tcp: bool, to_server: bool, broken: bool) -> int:
        at = 6 if tcp else 0
        unit, function = (-1, 0) if broken or len(data) < at + 2 else (data[at], data[at + 1])
        key = (unit, function & 0x7F, to_server)
        found = self._labels.get(key)
        if found is None:
            found = self._labels[key] = self._new_label(*key)
        return found

    def _new_label(self, unit: int, function: int, to_server: bool) -> int:
        if unit < 0:
            return self.traffic.label("broken", 1 << 30)
        way = "request" if to_server else "response"
        rank = unit << 16 | function << 1 | (not to_server)
        what = _FUNCTIONS.get(function, f"function {function:02X}h")
        return self.traffic.label(f"unit {unit} {function:02X}h {way}", rank, what)


@final
class SerialLine:
    """Collector of the packets of one line of another protocol.

    Attributes:
        traffic: the load, in ns of occupation, by sender and message.
    """

    def __init__(self, name: str, incidents: Incidents, describe: Describe | None) -> None:
        """Set up the collector; events go to `incidents`; `describe` names messages."""
        self.traffic: Traffic = Traffic(name, "serial line", "ns", _NS)
        self._name = name
        self._incidents = incidents
        self._describe = describe
        self._labels: dict[str, int] = {}

    def take(self, time_ns: int, fields: dict[str, Value], begin_ns: int) -> None:
        """Take recorded bytes; `time_ns` counts from `begin_ns`, unlike the times in the fields."""
        data, start_ns, end_ns = (fields.get(key, 0) for key in ("data", "start_ns", "end_ns"))
        assert isinstance(start_ns, int)
        assert isinstance(end_ns, int)
        data = data if isinstance(data, bytes) else b""
        message = None if self._describe is None else self._describe(self._name, data)
        sender = str(fields.get("sender", ""))
        label = f"{sender} {'bytes' if message is None else message.name}"
        if label not in self._labels:
            self._labels[label] = self.traffic.label(label, len(self._labels))
        self.traffic.add(end_ns - begin_ns, self._labels[label], end_ns - start_ns)
        if fields.get("spoiled"):
            text = f"a collision: {data.hex(' ').upper()}"
            self._incidents.add(time_ns, Severity.WARNING, "collision", self._name, text)
        elif message is not None and message.problem:
            text = str(message)
            self._incidents.add(time_ns, Severity.WARNING, "not decodable", self._name, text)


@final
@dataclass(slots=True)
class Told:
    """The values from one axis of one node.

    Attributes:
        pds: states of the PDS FSA, with the numbers of `motorhil.traces.decoding.cia402.STATES`.
        mode: modes of operation.
        nmt: NMT states.
        tracks: by index of CiA 402, in the drive's own units.
    """

    pds: Steps = field(default_factory=Steps)
    mode: Steps = field(default_factory=Steps)
    nmt: Steps = field(default_factory=Steps)
    tracks: dict[int, Track] = field(default_factory=dict)

    def track(self, index: int) -> Track:
        """Return the quantity with this index, created if necessary."""
        found = self.tracks.get(index)
        if found is None:
            found = self.tracks[index] = Track(held=True)
        return found


@final
class Nodes:
    """All nodes."""

    def __init__(self) -> None:
        self.told: dict[Place, Told] = {}

    def of(self, bus: str, node: int, axis: int) -> Told:
        """Return the values of this axis, created if necessary."""
        place = (bus, node, axis)
        found = self.told.get(place)
        if found is None:
            found = self.told[place] = Told()
        return found

    def is_drive(self, bus: str, node: int) -> bool:
        """Return True if a node has CiA 402 values on any axis."""
        return any(
            place[:2] == (bus, node) and bool(told.tracks or len(told.pds) or len(told.mode))
            for place, told in self.told.items()
        )


@final
class _Part:
    """One quantity in a PDO.

    Attributes:
        end: first bit after it.
        sign, modulus: bit and value to subtract if it is set; 0 if it is unsigned.
        track: its track, if it is drawn as a line and has a value.
        steps: its states, if it is a statusword and has a value.
    """

    __slots__ = (
        *("axis", "end", "index", "mask", "modulus", "node", "shift", "sign", "steps", "track"),
    )

    def __init__(self, node: int, axis: int, index: int, shift: int, bits: int) -> None:
        self.node = node
        self.axis = axis
        self.index = index
        self.shift = shift
        self.end = shift + bits
        self.mask = (1 << bits) - 1
        is_signed = QUANTITIES[index] and bits > 0
        self.sign = 1 << bits - 1 if is_signed else 0
        self.modulus = 1 << bits
        self.track: Track | None = None
        self.steps: Steps | None = None


@final
class _Plan:
    """The drawn quantities in PDOs of one identifier, and the time of the latest one."""

    __slots__ = ("heard_ns", "parts")

    def __init__(self, parts: tuple[_Part, ...]) -> None:
        self.parts = parts
        self.heard_ns = 0


@final
class _Beat:
    """The heartbeat of one node.

    Attributes:
        state: its latest NMT state.
        last_ns: the time of the latest heartbeat [ns].
    """

    __slots__ = ("_gaps", "last_ns", "state")

    def __init__(self, time_ns: int, state: int) -> None:
        self.state = state
        self.last_ns = time_ns
        self._gaps: list[int] = []

    def add(self, time_ns: int) -> None:
        """Add a heartbeat."""
        if len(self._gaps) < _GAPS:
            self._gaps.append(time_ns - self.last_ns)
        self.last_ns = time_ns

    def period_ns(self) -> int | None:
        """Return the usual distance of two heartbeats [ns]; None: not known yet."""
        period_ns = sorted(self._gaps)[len(self._gaps) // 2] if len(self._gaps) > 1 else 0
        return period_ns if period_ns > 0 else None

    def missing_since(self, time_ns: int) -> int | None:
        """Return when the first of several missing heartbeats was due [ns]; None: none misses."""
        period_ns = self.period_ns()
        if period_ns is None or time_ns - self.last_ns <= _MISSING * period_ns:
            return None
        return self.last_ns + period_ns


@final
class CanBus:
    """Collector of the frames of one bus.

    Attributes:
        traffic: the load of the bus.
        unmapped: number of possible PDOs without a known mapping.
        switched: number of frames with a bit rate switch, on a bus without a known data bit rate.
        untyped: nodes whose device type names no profile; their objects are read as CiA 402.
        doubts: number of possible emergencies on a bus without other signs of CANopen; the first
            of them are reported after the first sign.
        is_timed: True if the log times are times, not numbers of messages.
        contents: the latest frame of each label, by its number.
        heard: the time of the latest frame of each sender [ns].
        controllers: the latest error message of each sender.
    """

    def __init__(
        self,
        name: str,
        bitrate_bit_s: int | None,
        names: RecordedNames,
        nodes: Nodes,
        incidents: Incidents,
        data_bitrate_bit_s: int | None = None,
        describe: Describe | None = None,
    ) -> None:
        """Set up the collector; states go to `nodes`, events go to `incidents`."""
        self._describe = describe
        why = "" if bitrate_bit_s else "its bit rate is not in the recording; give --bitrate"
        capacity = float(bitrate_bit_s) if bitrate_bit_s else None
        self.traffic: Traffic = Traffic(name, "CAN", "bit", capacity, why)
        self.unmapped: int = 0
        self.switched: int = 0
        self._rates = bitrate_bit_s, data_bitrate_bit_s
        self._recorded = RecordedBus(name, FRAMES_MEASURED)
        self.untyped: set[int] = set()
        self._name = name
        self._nodes = nodes
        self._incidents = incidents
        self._frames = FrameDecoder()
        own = {n: controller for (bus, n), controller in names.nodes.items() if bus == name}
        objects = names.objects_on(name)
        self._node_names = own
        self._decoder = CanopenDecoder(own, objects)
        self._labels: dict[int, int] = {}
        self._plans: dict[int, _Plan | None] = {}
        self._beats: dict[int, _Beat] = {}
        self._no_drives: set[int] = set()
        self._is_canopen = False
        self.is_timed = True
        self.doubts: int = 0
        self.contents: dict[int, bytes] = {}
        self.heard: dict[str, int] = {}
        self.controllers: dict[str, BusError] = {}
        self._doubtful: list[tuple[int, Severity, str]] = []

    def take(self, time_ns: int, payload: bytes) -> None:
        """Take a recorded frame.

        Raises:
            ValueError: the payload is not a frame.
        """
        frame, _, sender = self._frames.decode(payload)
        can_id, length = _HEAD.unpack_from(frame)
        self.heard[sender] = time_ns
        bits = self._recorded.take(time_ns, frame, sender)
        if bits is None:
            if not can_id & ERR:
                raise ValueError(f"{frame.hex()}: not a valid CAN frame")
            self._error(time_ns, frame, sender)
            return
        self._weigh(time_ns, can_id, frame, bits)
        if can_id & (EFF | RTR) or len(frame) != 16:
            return
        function = can_id >> 7
        if function == 14 and length == 1:
            if self._is_known_beat(time_ns, can_id & 0x7F, frame[8]):
                return
        elif can_id and not (function == 1 and length == 8) and function not in (11, 12):
            if can_id == _SYNC and length <= 1 and not self._is_canopen:
                self._begin_canopen(self._decoder.decode(frame))
            self._pdo(time_ns, can_id, frame[8 : 8 + length])
            return
        said = self._decoder.decode(frame)
        message = self._message(frame)
        self._tell(time_ns, said if message is None else replace(said, words=str(message)))

    def end(self, end_ns: int) -> None:
        """Examine the heartbeats up to the end of the recording."""
        for node, beat in self._beats.items():
            self._note_missing(node, beat, end_ns)

    def heartbeats(self) -> dict[int, tuple[int, int | None]]:
        """Return the time of the latest heartbeat and the period [ns] of each node."""
        return {node: (beat.last_ns, beat.period_ns()) for node, beat in self._beats.items()}

    # ----------------------------------------------------------------------------------- load

    def _weigh(self, time_ns: int, can_id: int, frame: bytes, bits: tuple[int, int]) -> None:
        key = self._labels.get(can_id)
        if key is None:
            key = self._new_label(can_id, frame)
            if key < LABELS_MAX:
                self._labels[can_id] = key
        nominal, data = bits
        if data:
            rate, data_rate = self._rates
            if rate and data_rate:  # in nominal bit times
                data = round(data * rate / data_rate)
            elif not data_rate:
                self.switched += 1
        self.contents[key] = frame
        self.traffic.add(time_ns, key, nominal + data)

    def subject(self, by_priority: frozenset[str]) -> Subject | None:
        """Return the input of the response time analysis, or None if the bit rate is unknown.

        Args:
            by_priority: nodes that send their most urgent frame first.
        """
        rate, data_rate = self._rates
        if rate is None:
            return None
        queues = Queues(by_priority=by_priority)
        return self._recorded.subject(rate, data_rate, self._node_names, queues)

    def _message(self, frame: bytes) -> BusMessage | None:
        return None if self._describe is None else self._describe(self._name, frame)

    def _new_label(self, can_id: int, frame: bytes) -> int:
        identifier = can_id & 0x1FFF_FFFF
        text = f"{identifier:08X}h" if can_id & EFF else f"{identifier:03X}h"
        rank = identifier << 2 | 1 if can_id & EFF else identifier << 20
        if can_id & RTR:
            return self.traffic.label(f"{text} remote", rank + 1)
        message = self._message(frame)
        name = "" if can_id & EFF else usual_name(identifier, self._node_names)
        if message is not None:
            node = message.node and self._node_names.get(message.node, f"node {message.node}")
            name = f"{message.name} {node}" if node else message.name
        return self.traffic.label(text, rank, name)

    # ---------------------------------------------------------------------------------- nodes

    def _pdo(self, time_ns: int, identifier: int, data: bytes) -> None:
        try:
            plan = self._plans[identifier]
        except KeyError:
            plan = self._plans[identifier] = self._plan(identifier)
        if plan is None:
            self.unmapped += 1
            return
        if not plan.parts:
            return
        plan.heard_ns = time_ns
        raw, size = int.from_bytes(data, "little"), 8 * len(data)
        for part in plan.parts:
            if part.end > size:
                continue
            value = raw >> part.shift & part.mask
            if value & part.sign:
                value -= part.modulus
            track = part.track
            if track is not None:
                if value != track.last:
                    track.add(time_ns, value)
            elif part.steps is None or _state_number(value & 0xFFFF) != part.steps.last:
                told = self._quantity(time_ns, part.node, part.axis, part.index, value)
                if part.index == STATUSWORD:
                    part.steps = told.pds
                else:
                    part.track = told.tracks.get(part.index)

    def _plan(self, identifier: int) -> _Plan | None:
        """Return the drawn parts of a PDO; None: a PDO without a known mapping."""
        layout, unknown = self._decoder.maps.layout(identifier)
        parts: list[_Part] = []
        for (node, _, _), at, (index, _, bits) in layout:
            axis, first = axis_of(index)
            if first in QUANTITIES and node not in self._no_drives:
                parts.append(_Part(node, axis, first, at, bits))
        return None if unknown and not parts else _Plan(tuple(parts))

    def _quantity(self, time_ns: int, node: int, axis: int, index: int, value: int) -> Told:
        """Add a value; return all values of its axis."""
        told = self._nodes.of(self._name, node, axis)
        if index == STATUSWORD:
            before = told.pds.last
            code = _state_number(value & 0xFFFF)
            if told.pds.add(time_ns, code) and code in FAULTS and before not in FAULTS:
                name = self._node_names.get(node, f"node {node}")
                axis_text = f" axis {axis}" if axis > 1 else ""
                text = f"{name}{axis_text}: {STATES[code][2]} (statusword {value:04X}h)"
                self._incidents.add(time_ns, Severity.ERROR, "drive fault", self._name, text)
        elif index == 0x6061:
            told.mode.add(time_ns, value)
        elif index != 0x603F:
            told.track(index).add(time_ns, value)
        return told

    def _tell(self, time_ns: int, said: DecodedEvent) -> None:
        """Handle a frame that the decoder has read."""
        kind, node = said.kind, said.node
        if not self._is_canopen and kind is not Kind.EMERGENCY:
            self._begin_canopen(said)
        if kind in (Kind.SDO_REQUEST, Kind.SDO_RESPONSE):
            self._sdo(time_ns, said)
            return
        if kind in (Kind.BOOT, Kind.NMT):
            self._plans.clear()
            if kind is Kind.NMT and said.facts:
                self._reset(time_ns, node, said.facts[0].value)
            word = "boot-up" if kind is Kind.BOOT else "NMT command"
            self._incidents.add(time_ns, Severity.INFO, word, self._name, said.text)
        if kind in (Kind.BOOT, Kind.HEARTBEAT) and node is not None:
            code = said.facts[0].value
            assert isinstance(code, int)
            self._nodes.of(self._name, node, 1).nmt.add(time_ns, code)
            if kind is Kind.BOOT:
                self._forget_power(node, time_ns)
        elif kind is Kind.EMERGENCY:
            data = said.facts[0].value
            over = isinstance(data, bytes) and data[:2] == b"\0\0"
            level = Severity.INFO if over else Severity.ERROR
            if self._is_canopen:
                self._incidents.add(time_ns, level, "emergency", self._name, said.text)
            else:
                self.doubts += 1
                if self.doubts <= KEPT:
                    self._doubtful.append((time_ns, level, said.text))

    def _begin_canopen(self, said: DecodedEvent) -> None:
        """Accept the doubtful emergencies after the first certain sign of CANopen."""
        if said.kind in (Kind.SDO_REQUEST, Kind.SDO_RESPONSE) and said.index is None:
            return
        self._is_canopen = True
        for time_ns, level, text in self._doubtful:
            self._incidents.add(time_ns, level, "emergency", self._name, text)
        if self.doubts > len(self._doubtful):
            self._incidents.counts["emergency"] += self.doubts - len(self._doubtful)
        self._doubtful.clear()
        self.doubts = 0

    def _is_known_beat(self, time_ns: int, node: int, state: int) -> bool:
        """Take the time of a heartbeat; return True if it tells nothing else that is new."""
        beat = self._beats.get(node)
        if not state or beat is None:
            self._beats[node] = _Beat(time_ns, state)
            return False
        was_missing = self._note_missing(node, beat, time_ns)
        beat.add(time_ns)
        if beat.state == state and not was_missing:
            return True
        beat.state = state
        return False

    def _note_missing(self, node: int, beat: _Beat, now_ns: int) -> bool:
        """End the states of a node whose heartbeat is missing; return True if it is."""
        since_ns = beat.missing_since(now_ns) if self.is_timed else None
        if since_ns is None:
            return False
        self._nodes.of(self._name, node, 1).nmt.add(since_ns, NO_HEARTBEAT)
        told_ns = [
            plan.heard_ns
            for plan in self._plans.values()
            if plan is not None and any(part.node == node for part in plan.parts)
        ]
        if max(told_ns, default=0) <= since_ns:
            self._forget_power(node, since_ns)
        return True

    def _reset(self, time_ns: int, node: int | None, command: object) -> None:
        """End the states of the nodes that a command resets."""
        if command not in _RESETS:
            return
        for (bus, number, axis), told in list(self._nodes.told.items()):
            if bus != self._name or node not in (None, number):
                continue
            if axis == 1 and len(told.nmt):
                told.nmt.add(time_ns, RESET)
            self._beats.pop(number, None)
            if command in _OF_DRIVE:
                self._forget_power(number, time_ns)

    def _forget_power(self, node: int, time_ns: int) -> None:
        """End the states of the drives of a node, which has been reset or is not heard."""
        for (bus, number, _), told in self._nodes.told.items():
            is_of_node = (bus, number) == (self._name, node)
            if is_of_node and len(told.pds) and told.pds.times_ns[-1] <= time_ns:
                told.pds.add(time_ns, UNKNOWN_STATE)

    def _sdo(self, time_ns: int, said: DecodedEvent) -> None:
        index, node = said.index, said.node
        if index is None or node is None or not said.facts:
            return
        fact = said.facts[0]
        if fact.subject.endswith("aborted"):
            self._incidents.add(time_ns, Severity.WARNING, "SDO abort", self._name, said.text)
            return
        if not isinstance(fact.value, int):
            return
        if 0x1400 <= index < 0x1C00:
            self._plans.clear()
        elif index == _HEARTBEAT_TIME:
            self._beats.pop(node, None)
        elif index == 0x1000:
            self._plans.clear()
            profile = fact.value & 0xFFFF
            (self._no_drives.discard if profile in _MAY_BE_DRIVES else self._no_drives.add)(node)
            (self.untyped.discard if profile else self.untyped.add)(node)
        elif index >= 0x6000 and node not in self._no_drives:
            axis, first = axis_of(index)
            if first in QUANTITIES:
                self._quantity(time_ns, node, axis, first, fact.value)

    def _error(self, time_ns: int, frame: bytes, sender: str) -> None:
        said = self._decoder.decode(frame, sender)
        error = bus_error(frame)
        state = error.state
        if state is not None or error.counters is not None:
            self.controllers[sender] = error
        level = _LEVELS.get(state, Severity.WARNING)
        kind = "bus error" if state is None else "state of a CAN controller"
        self._incidents.add(time_ns, level, kind, self._name, said.text)


@cache
def _state_number(statusword: int) -> int:
    """Return the number of the state in one of 65536 statuswords."""
    return state_number(statusword)


def nmt_text(code: int) -> str:
    """Return the name of an NMT state."""
    return _OTHER_STATES.get(code) or NMT_STATES.get(code, f"state {code:02X}h")
