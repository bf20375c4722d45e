"""Exchange logs of all CANopen nodes and Modbus units in a recording."""

from dataclasses import dataclass
from typing import Final, final

from motorhil.traces.decoding.attached_rig import RecordedNames, names_of
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.exchange.canopen import CanopenExchanges
from motorhil.traces.exchange.modbus import LineAdu, modbus_logs
from motorhil.traces.exchange.steps import ExchangeLog
from motorhil.traces.formats.modbus import Adu, recorded_adu
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, FrameDecoder

_RUN: Final = "run"
"""Metadata of a rig; its time begins at 0, with power-on."""


@final
@dataclass(frozen=True, slots=True)
class RecordedExchanges:
    """Everything that can be replayed.

    Attributes:
        logs: exchange logs by bus or line, and node-ID or unit.
        decoders: decoders of the CAN buses by name; they have seen the whole recording.
        tcp: the lines that are Modbus/TCP.
        cut: where the recording ends prematurely, in words; "": it is complete.
    """

    logs: dict[tuple[str, int], ExchangeLog]
    decoders: dict[str, CanopenDecoder]
    tcp: frozenset[str] = frozenset()
    cut: str = ""


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
        except ValueError:  # an invalid message
            continue
    found: dict[tuple[str, int], ExchangeLog] = {}
    for bus, cutter in buses.items():
        found |= {(bus, number): log for number, log in cutter.logs().items()}
    for line, adus in lines.items():
        units = modbus_logs(line, adus, begin_ns)
        found |= {(line, unit): log for unit, log in units.items()}
    tcp = frozenset(line for line, adus in lines.items() if any(one.is_tcp for one in adus))
    decoders = {bus: cutter.decoder for bus, cutter in buses.items()}
    cut = "" if trace.cut is None else str(trace.cut)
    return RecordedExchanges(found, decoders, tcp, cut)


def _cutter(bus: str, begin_ns: int, names: RecordedNames, any_set_point: bool) -> CanopenExchanges:
    nodes = {number: name for (where, number), name in names.nodes.items() if where == bus}
    return CanopenExchanges(bus, begin_ns, nodes, names.objects_on(bus), any_set_point)
