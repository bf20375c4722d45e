"""Messages at a recording's beginning that a decoder needs for the rest.

Most traffic is PDOs. Only the last PDO of each identifier counts, unless a message that affects
their decoding follows. So only a few messages need to be decoded.
"""

from collections.abc import Iterable, Iterator
from typing import Final

from traces.reader import TraceMessage
from traces.schema import CAN_FRAME

_ID_TAG: Final = b"\x0d"  # the first byte of our CanFrame; the identifier follows
_NMT: Final = bytes(4)
_ERROR_CONTROL: Final = b"\x07"
_BOOTED: Final = b"\x7a\x01\x00"  # the end of a CanFrame with one data byte, 0
_SERVICES: Final = frozenset(
    number.to_bytes(4, "little") for number in (0, *range(0x580, 0x680), *range(0x701, 0x780))
)
"""Identifiers of NMT, SDO and error control, as encoded in a CanFrame."""
_SHAPING: Final = frozenset(
    index.to_bytes(2, "little")
    for index in (
        *(0x1000, *range(0x1400, 0x1C00)),
        *(first + 0x800 * axis for first in (0x6040, 0x6060, 0x6061) for axis in range(8)),
    )
)
"""Objects that affect the contents of PDOs or their decoding."""


def telling(messages: Iterable[TraceMessage], most: int) -> Iterator[TraceMessage]:
    """Yield those of the first `most` messages of traffic that affect a decoder.

    These are all Modbus messages; of CAN, NMT, boot-ups and SDO in order, and of other frames the
    last of each identifier before a message that affects decoding; and all CAN frames of other
    writers.
    """
    last: dict[tuple[int, bytes], TraceMessage] = {}
    kinds: dict[int, str] = {}  # schemas by channel; "": not traffic
    for message in messages:
        channel, _, payload = message
        kind = kinds.get(channel.number)
        if kind is None:
            schema = channel.schema if channel.topic.startswith(("/can/", "/modbus/")) else None
            kind = kinds[channel.number] = schema.name if schema is not None else ""
        if not kind:
            continue
        if kind != CAN_FRAME.name or payload[:1] != _ID_TAG:
            yield message
        elif payload[1:5] not in _SERVICES:
            key = channel.number, payload[:7]
            last.pop(key, None)  # keeps them in the order of their last occurrence
            last[key] = message
        elif payload[2:3] != _ERROR_CONTROL or payload.endswith(_BOOTED):
            is_sdo = payload[1:5] != _NMT and payload[2:3] != _ERROR_CONTROL
            if last and (not is_sdo or payload[-7:-5] in _SHAPING):
                yield from last.values()
                last.clear()
            yield message
        most -= 1
        if not most:
            break
    yield from last.values()
