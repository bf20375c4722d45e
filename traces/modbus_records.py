"""ADUs of the Modbus lines in our recordings.

Source: MODBUS over Serial Line V1.02, section 2.5.1.2 for the check sum; the Messaging on TCP/IP
guide V1.0b, section 3.1.3 for the header.
"""

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from traces.modbus import Adu, Malformed
from traces.protobuf import Value, decode
from traces.reader import Trace
from traces.schema import MODBUS_ADU, Direction

_TOPIC: Final = "/modbus/"
_SHORTEST: Final = 4
_HEAD: Final = 7
_POLYNOMIAL: Final = 0xA001


class RecordedAdu(NamedTuple):
    """A recorded ADU: log time [ns], line, a motorhil.ModbusAdu."""

    time_ns: int
    line: str
    payload: bytes


def all_adus(trace: Trace) -> Iterator[RecordedAdu]:
    """Yield the ADUs of all lines in recorded order."""
    for channel, time_ns, payload in trace.messages():
        if channel.schema is not None and channel.schema.name == MODBUS_ADU.name:
            yield RecordedAdu(time_ns, channel.topic.removeprefix(_TOPIC), payload)


def lines_of(trace: Trace) -> list[str]:
    """Return the names of the lines in a recording, sorted."""
    topics = {channel.topic for channel in trace.channels.values()}
    return sorted(topic.removeprefix(_TOPIC) for topic in topics if topic.startswith(_TOPIC))


def recorded_adus(trace: Trace, line: str) -> Iterator[Adu | Malformed]:
    """Yield the contents of a line in order; times are those of last bits [ns of the rig]."""
    for _, _, payload in trace.messages(topics=[_TOPIC + line]):
        yield _told(decode(MODBUS_ADU, payload))


def adu_in(values: Mapping[str, Value]) -> Adu | None:
    """Return the ADU in a message's fields; None if its bytes are not an ADU."""
    told = _told(values)
    return told if isinstance(told, Adu) else None


def _told(values: Mapping[str, Value]) -> Adu | Malformed:
    data, end_ns = values.get("data", b""), values.get("end_ns", 0)
    assert isinstance(data, bytes)
    assert isinstance(end_ns, int)
    to_server = values.get("direction") == Direction.TRANSMITTED
    is_tcp = bool(values.get("tcp"))
    problem = _problem(data, spoiled=bool(values.get("spoiled")), tcp=is_tcp)
    if problem:
        return Malformed(end_ns, None, 0, data, problem)
    if is_tcp:
        transaction = int.from_bytes(data[:2], "big")
        return Adu(end_ns, None, to_server, transaction, data[6], data[_HEAD:])
    return Adu(end_ns, None, to_server, 0, data[0], data[1:-2])


def _problem(data: bytes, *, spoiled: bool, tcp: bool) -> str:
    """Return the reason why it is not an ADU; "" if it is one."""
    if spoiled:
        return "a pause in it, or a collision"
    if tcp:
        return "" if len(data) > _HEAD else "shorter than a header"
    if len(data) < _SHORTEST:
        return "shorter than any frame"
    return "" if _checked(data) else "a wrong check sum"


def _checked(data: bytes) -> bool:
    """Return True if the check sum is correct: the CRC over everything is then 0."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc == 0
