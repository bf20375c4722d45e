"""Exchange logs of all CANopen nodes, Modbus units and known drives in a recording."""

from collections.abc import Collection, Mapping
from dataclasses import field
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding.attached_rig import RecordedNames, controllers_in, names_of
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.dynamixel import Packets
from motorhil.traces.exchange.canopen import CanopenExchanges
from motorhil.traces.exchange.drive_kinds import CAN_KINDS, LINE_KINDS, readers_of
from motorhil.traces.exchange.drives import DriveExchanges
from motorhil.traces.exchange.modbus import LineAdu, modbus_logs
from motorhil.traces.exchange.steps import ExchangeLog
from motorhil.traces.formats.modbus import Adu, recorded_adu
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import Value, decode
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, SERIAL_DATA, FrameDecoder

_RUN: Final = "run"
"""Metadata of a rig; its time begins at 0, with power-on."""


@final
@frozen
class RecordedExchanges:
    """Everything that can be replayed.

    Attributes:
        logs: exchange logs by bus or line, and node-ID or unit.
        decoders: decoders of the CAN buses by name; they have seen the whole recording.
        tcp: the lines that are Modbus/TCP.
        cut: where the recording ends prematurely, in words; "": it is complete.
        drives: the tables of drives with a protocol of their own, by bus and node.
    """

    logs: dict[tuple[str, int], ExchangeLog]
    decoders: dict[str, CanopenDecoder]
    tcp: frozenset[str] = frozenset()
    cut: str = ""
    drives: Mapping[tuple[str, int], Mapping[str, object]] = field(default_factory=dict)


def exchanges_of(trace: Trace, any_set_point: bool = False) -> RecordedExchanges:
    """Return the exchange logs of a recording; of a cut one, as far as it goes.

    Args:
        trace: the recording.
        any_set_point: True to ignore the values of set-points in PDOs.

    Raises:
        TraceError: the recording is damaged.
    """
    names = names_of(trace.attachments)
    span = trace.span_ns() or (0, 0)
    begin_ns = 0 if _RUN in trace.metadata else span[0]
    buses: dict[str, CanopenExchanges] = {}
    lines: dict[str, list[LineAdu]] = {}
    tables = _drives_of(trace)
    drives = _exchanges_of_drives(tables, CAN_KINDS, names, begin_ns, any_set_point)
    own_lines = {
        line: _Line(own)
        for line, own in _exchanges_of_drives(
            *(tables, LINE_KINDS, names, begin_ns, any_set_point)
        ).items()
    }
    frames = FrameDecoder()
    for channel, time_ns, payload in trace.messages():
        kind = channel.schema.name if channel.schema is not None else ""
        place = channel.topic.rpartition("/")[2]
        try:
            if kind == CAN_FRAME.name:
                cutter = buses.get(place)
                if cutter is None:
                    cutter = buses[place] = _cutter(place, begin_ns, names, any_set_point)
                frame, direction, sender = frames.decode(payload)
                own = drives.get(place)
                # Every drive takes a frame to all.
                if own is None or True not in [one.take(time_ns, frame, sender) for one in own]:
                    cutter.take(time_ns, frame, direction, sender)
            elif kind == MODBUS_ADU.name:
                values = decode(MODBUS_ADU, payload)
                start_ns, end_ns = values.get("start_ns", 0), values.get("end_ns", 0)
                assert isinstance(start_ns, int)
                assert isinstance(end_ns, int)
                adu = recorded_adu(values, end_ns)
                if isinstance(adu, Adu):
                    is_tcp = bool(values.get("tcp"))
                    one = LineAdu(time_ns, start_ns, end_ns, adu, is_tcp)
                    lines.setdefault(place, []).append(one)
            elif kind == SERIAL_DATA.name and place in own_lines:
                own_lines[place].take(decode(SERIAL_DATA, payload))
        except ValueError:  # an invalid message
            continue
    found: dict[tuple[str, int], ExchangeLog] = {}
    for bus, cutter in buses.items():
        found |= {(bus, number): log for number, log in cutter.logs().items()}
        logs = [one.finished() for one in drives.get(bus, ()) if one.has_sent]
        found |= {(bus, log.number): log for log in logs}
    for line, on_line in own_lines.items():
        found |= {(line, log.number): log for log in on_line.logs()}
    for line, adus in lines.items():
        units = modbus_logs(line, adus, begin_ns)
        found |= {(line, unit): log for unit, log in units.items()}
    tcp = frozenset(line for line, adus in lines.items() if any(one.is_tcp for one in adus))
    decoders = {bus: cutter.decoder for bus, cutter in buses.items()}
    cut = "" if trace.cut is None else str(trace.cut)
    return RecordedExchanges(found, decoders, tcp, cut, tables)


def _drives_of(trace: Trace) -> dict[tuple[str, int], Mapping[str, object]]:
    """Return the tables of the drives that have a protocol of their own."""
    tables, kinds = controllers_in(trace.attachments), (*CAN_KINDS, *LINE_KINDS)
    return {place: table for place, table in tables.items() if table.get("kind") in kinds}


def _exchanges_of_drives(
    tables: Mapping[tuple[str, int], Mapping[str, object]],
    kinds: Collection[str],
    names: RecordedNames,
    begin_ns: int,
    any_set_point: bool,
) -> dict[str, list[DriveExchanges]]:
    """Return the logs to be built of drives of these kinds, by bus."""
    found: dict[str, list[DriveExchanges]] = {}
    for place, table in tables.items():
        kind = str(table["kind"])
        readers = readers_of(kind, place[1], table) if kind in kinds else None
        if readers is not None:
            name = names.nodes.get(place, "")
            log = DriveExchanges(place, name, readers, begin_ns, any_set_point)
            found.setdefault(place[0], []).append(log)
    return found


@final
class _Line:
    """A serial line whose exchange logs are being built."""

    def __init__(self, drives: list[DriveExchanges]) -> None:
        self._drives = drives
        self._packets: dict[str, Packets] = {}  # by sender

    def take(self, values: Mapping[str, Value]) -> None:
        """Take the fields of a message: what one sender sent without a pause."""
        data, sender = values.get("data", b""), str(values.get("sender", ""))
        start_ns, end_ns = values.get("start_ns", 0), values.get("end_ns", 0)
        assert isinstance(data, bytes)
        assert isinstance(start_ns, int)
        assert isinstance(end_ns, int)
        if values.get("spoiled"):
            return
        packets = self._packets.setdefault(sender, Packets()).feed(data)
        for drive in self._drives:
            # An answer is not cut: it may be a part, or the drive's block of a joint one.
            for packet in [data] if sender == drive.name else packets:
                drive.take_packet(start_ns, end_ns, packet, sender)

    def logs(self) -> list[ExchangeLog]:
        """Return the logs of the drives that have sent anything."""
        return [drive.finished() for drive in self._drives if drive.has_sent]


def _cutter(bus: str, begin_ns: int, names: RecordedNames, any_set_point: bool) -> CanopenExchanges:
    nodes = {number: name for (where, number), name in names.nodes.items() if where == bus}
    return CanopenExchanges(bus, begin_ns, nodes, names.objects_on(bus), any_set_point)
