"""Modbus/TCP out of packet captures: every ADU, with the time of the packet that completed it.

A line is a server's address; the application is taken for the client, so requests are sent and
responses received. Senders are told by address and port.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from traces.modbus import Malformed, adus
from traces.pcap import Capture
from traces.protobuf import Value, encode
from traces.schema import MODBUS_ADU, Direction, Schema
from traces.tcp_streams import pieces
from traces.traffic import Findings
from traces.writer import TraceWriter

_PREFIX: Final = "/modbus/"
_BATCH: Final = 8192


class RecordedAdu(NamedTuple):
    """An ADU as a recording has it: log time [ns], line, a motorhil.ModbusAdu."""

    time_ns: int
    line: str
    payload: bytes


def captured_adus(path: str, findings: Findings) -> Iterator[RecordedAdu]:
    """The ADUs of a capture, in the order they became complete.

    Raises:
        TraceError: it cannot be read, or is no capture.
    """
    capture = Capture(path)
    for adu in adus(pieces(capture.packets())):
        if isinstance(adu, Malformed):
            findings.problem(adu.packet, f"{adu.way}: {adu.problem}")
            continue
        way = adu.way
        if way is None:  # a serial line: not in a capture
            continue
        data = adu.transaction.to_bytes(2, "big") + bytes(2)
        data += (len(adu.pdu) + 1).to_bytes(2, "big") + bytes((adu.unit,)) + adu.pdu
        values: dict[str, Value] = {
            "direction": int(Direction.TRANSMITTED if adu.to_server else Direction.RECEIVED),
            "sender": f"{way.source}:{way.source_port}",
            "start_ns": adu.time_ns,
            "end_ns": adu.time_ns,
            "tcp": True,
            "data": data,
        }
        findings.frames += 1
        line = way.target if adu.to_server else way.source
        yield RecordedAdu(adu.time_ns, line, encode(MODBUS_ADU, values))
    for problem in capture.problems:
        findings.problem(0, problem.removeprefix(f"{path}: "))


def record_adus(
    target: str, adus_: Iterator[RecordedAdu], metadata: dict[str, dict[str, str]]
) -> tuple[str, ...]:
    """A recording holds these ADUs, in this order; the lines.

    Raises:
        TraceError: it cannot be written.
    """
    channels: dict[str, int] = {}
    with TraceWriter(target, metadata) as writer:
        entries: list[tuple[int, int, bytes]] = []
        for time_ns, line, payload in adus_:
            if line not in channels:
                channels[line] = writer.channel(_PREFIX + line, Schema.of(MODBUS_ADU))
            entries.append((-channels[line], time_ns, payload))
            if len(entries) >= _BATCH:
                writer.extend(entries)
                entries = []
        writer.extend(entries)
    return tuple(channels)
