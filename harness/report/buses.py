"""Buses of the report: their traffic, and the quantities of their nodes.

Traffic is one entry per frame or ADU, for any medium. Most frames are PDOs, and most of their
objects are not drawn. The position of each quantity in a PDO is therefore computed once, from the
decoder's knowledge, and again after anything that may change it. All other CANopen frames go to the
decoder. Repeated heartbeats are ignored.
"""

import struct
from array import array
from dataclasses import dataclass, field
from typing import Final, final

from motorhil.harness.analysis.from_recording import RecordedBus
from motorhil.harness.analysis.subject import Queues, Subject
from motorhil.harness.report.incidents import Incidents, Severity
from motorhil.harness.report.series import Steps, Track
from motorhil.traces.can_frame import EFF, ERR, RTR
from motorhil.traces.decoding.attached_rig import RecordedNames
from motorhil.traces.decoding.can_errors import ControllerState, bus_error
from motorhil.traces.decoding.canopen import NMT_STATES, CanopenDecoder, usual_name
from motorhil.traces.decoding.cia402 import STATES, state_number
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.decoding.objects import axis_of
from motorhil.traces.formats.modbus import Malformed, recorded_adu
from motorhil.traces.protobuf import Value
from motorhil.traces.schema import Direction, FrameDecoder

Place = tuple[str, int, int]
"""Bus, node or unit, axis from 1."""
LABELS_MAX: Final = 4_000
"""Limit of distinguished identifiers on one bus."""
_SYNC: Final = 0x080
_HEAD: Final = struct.Struct("<IBB")

# Index: True if signed. Source: CiA 402-2, object dictionary.
QUANTITIES: Final[dict[int, bool]] = {
    0x603F: False,  # error code
    0x6041: False,  # statusword
    0x6061: True,  # modes of operation display
    0x6062: True,  # position demand value
    0x6064: True,  # position actual value
    0x606B: True,  # velocity demand value
    0x606C: True,  # velocity actual value
    0x6077: True,  # torque actual value
    0x607A: True,  # target position
    0x60C1: True,  # interpolation data record
    0x60F4: True,  # following error actual value
    0x60FF: True,  # target velocity
}
STATUSWORD: Final = 0x6041
FAULTS: Final = tuple(n for n, (_, _, name) in enumerate(STATES) if name.startswith("fault"))

_Part = tuple[int, int, int, bool, int, int]
"""Node, shift, mask, True if signed, axis, index on the first axis."""
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
        kind: "CAN", "Modbus RTU" or "Modbus/TCP".
        unit: unit of `weights`: "bit" or "ns".
        capacity_s: capacity per second in that unit; None: unknown, so no load in per cent.
        why_no_capacity: the reason if it is None.
        times_ns: end of each entry [ns from the recording's beginning].
        keys: index into `labels` of each entry.
        weights: capacity taken by each entry.
        labels: the distinguished kinds (identifiers, functions), in order of appearance.
        ranks: sort key of each label.
        names: description of each label.
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

    def add(self, time_ns: int, key: int, weight: int) -> None:
        """Add one entry."""
        self.times_ns.append(time_ns)
        self.keys.append(key)
        self.weights.append(weight)

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
            self.traffic = Traffic(name, "Modbus/TCP", "bit", None, why)
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
class CanBus:
    """Collector of the frames of one bus.

    Attributes:
        traffic: the load of the bus.
        unmapped: number of possible PDOs without a known mapping.
        switched: number of frames with a bit rate switch, on a bus without a known data bit rate.
        untyped: nodes whose device type names no profile; their objects are read as CiA 402.
        doubtful: possible emergencies on a bus without other signs of CANopen; they are reported
            only after the first sign.
    """

    def __init__(
        self,
        name: str,
        bitrate_bit_s: int | None,
        names: RecordedNames,
        nodes: Nodes,
        incidents: Incidents,
        data_bitrate_bit_s: int | None = None,
    ) -> None:
        """Set up the collector; states go to `nodes`, events go to `incidents`."""
        why = "" if bitrate_bit_s else "its bit rate is not in the recording; give --bitrate"
        capacity = float(bitrate_bit_s) if bitrate_bit_s else None
        self.traffic = Traffic(name, "CAN", "bit", capacity, why)
        self.unmapped = 0
        self.switched = 0
        self._rates = bitrate_bit_s, data_bitrate_bit_s
        self._recorded = RecordedBus(name)
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
        self._plans: dict[int, tuple[_Part, ...] | None] = {}
        self._heartbeats: dict[int, int] = {}
        self._no_drives: set[int] = set()
        self._is_canopen = False
        self.doubtful: list[tuple[int, Severity, str]] = []

    def take(self, time_ns: int, payload: bytes) -> None:
        """Take a recorded frame.

        Raises:
            ValueError: the payload is not a frame.
        """
        frame, _, sender = self._frames.decode(payload)
        can_id, length, _ = _HEAD.unpack_from(frame)
        if can_id & ERR:
            self._recorded.take(time_ns, frame, sender)
            self._error(time_ns, frame, sender)
            return
        self._weigh(time_ns, can_id, frame, sender)
        if can_id & (EFF | RTR) or len(frame) != 16:
            return
        function = can_id >> 7
        if function == 14 and length == 1:
            state = frame[8]
            if state and self._heartbeats.get(can_id) == state:
                return
            self._heartbeats[can_id] = state
        elif can_id and not (function == 1 and length == 8) and function not in (11, 12):
            if can_id == _SYNC and length <= 1 and not self._is_canopen:
                self._begin_canopen(self._decoder.decode(frame))
            self._pdo(time_ns, can_id, frame[8 : 8 + length])
            return
        self._tell(time_ns, self._decoder.decode(frame))

    # ----------------------------------------------------------------------------------- load

    def _weigh(self, time_ns: int, can_id: int, frame: bytes, sender: str) -> None:
        bits = self._recorded.take(time_ns, frame, sender)
        if bits is None:
            raise ValueError(f"{frame.hex()}: not a valid CAN frame")
        key = self._labels.get(can_id)
        if key is None:
            key = self._labels[can_id] = self._new_label(can_id)
        nominal, data = bits
        rate, data_rate = self._rates
        if data and rate and data_rate:  # in nominal bit times
            data = round(data * rate / data_rate)
        elif data and not data_rate:
            self.switched += 1
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

    def _new_label(self, can_id: int) -> int:
        identifier = can_id & 0x1FFF_FFFF
        text = f"{identifier:08X}h" if can_id & EFF else f"{identifier:03X}h"
        rank = identifier << 2 | 1 if can_id & EFF else identifier << 20
        if can_id & RTR:
            return self.traffic.label(f"{text} remote", rank + 1)
        name = "" if can_id & EFF else usual_name(identifier, self._node_names)
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
        if not plan:
            return
        raw, size = int.from_bytes(data, "little"), 8 * len(data)
        for node, shift, mask, is_signed, axis, index in plan:
            width = mask.bit_length()
            if shift + width > size:
                continue
            value = raw >> shift & mask
            if is_signed and value >> width - 1:
                value -= 1 << width
            self._quantity(time_ns, node, axis, index, value)

    def _plan(self, identifier: int) -> tuple[_Part, ...] | None:
        """Return the drawn parts of a PDO; None: a PDO without a known mapping."""
        layout, unknown = self._decoder.maps.layout(identifier)
        parts: list[_Part] = []
        for (node, _, _), at, (index, _, bits) in layout:
            axis, first = axis_of(index)
            if first in QUANTITIES and node not in self._no_drives:
                parts.append((node, at, (1 << bits) - 1, QUANTITIES[first], axis, first))
        return None if unknown and not parts else tuple(parts)

    def _quantity(self, time_ns: int, node: int, axis: int, index: int, value: int) -> None:
        told = self._nodes.of(self._name, node, axis)
        if index == STATUSWORD:
            before = told.pds.last
            code = state_number(value)
            if told.pds.add(time_ns, code) and code in FAULTS and before not in FAULTS:
                name = self._node_names.get(node, f"node {node}")
                axis_text = f" axis {axis}" if axis > 1 else ""
                text = f"{name}{axis_text}: {STATES[code][2]} (statusword {value:04X}h)"
                self._incidents.add(time_ns, Severity.ERROR, "drive fault", self._name, text)
        elif index == 0x6061:
            told.mode.add(time_ns, value)
        elif index != 0x603F:
            told.track(index).add(time_ns, value)

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
            self._heartbeats.clear()
            word = "boot-up" if kind is Kind.BOOT else "NMT command"
            self._incidents.add(time_ns, Severity.INFO, word, self._name, said.text)
        if kind in (Kind.BOOT, Kind.HEARTBEAT) and node is not None:
            code = said.facts[0].value
            assert isinstance(code, int)
            self._nodes.of(self._name, node, 1).nmt.add(time_ns, code)
        elif kind is Kind.EMERGENCY:
            data = said.facts[0].value
            over = isinstance(data, bytes) and data[:2] == b"\0\0"
            level = Severity.INFO if over else Severity.ERROR
            if self._is_canopen:
                self._incidents.add(time_ns, level, "emergency", self._name, said.text)
            else:
                self.doubtful.append((time_ns, level, said.text))

    def _begin_canopen(self, said: DecodedEvent) -> None:
        """Accept the doubtful emergencies after the first certain sign of CANopen."""
        if said.kind in (Kind.SDO_REQUEST, Kind.SDO_RESPONSE) and said.index is None:
            return
        self._is_canopen = True
        for time_ns, level, text in self.doubtful:
            self._incidents.add(time_ns, level, "emergency", self._name, text)
        self.doubtful.clear()

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
        state = bus_error(frame).state
        level = _LEVELS.get(state, Severity.WARNING)
        kind = "bus error" if state is None else "state of a CAN controller"
        self._incidents.add(time_ns, level, kind, self._name, said.text)


def nmt_text(code: int) -> str:
    """Return the name of an NMT state."""
    return NMT_STATES.get(code, f"state {code:02X}h")
