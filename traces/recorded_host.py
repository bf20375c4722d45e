"""The host of a recording: all frames it sent, on all buses and lines."""

from collections.abc import Callable
from typing import Final, NamedTuple, final

from traces.decode_modbus import ModbusDecoder
from traces.frame_decoder import FrameDecoder
from traces.host_tape import HostCutter, HostStep, Listener
from traces.modbus_records import adu_in
from traces.protobuf import decode
from traces.reader import Trace
from traces.schema import CAN_FRAME, MODBUS_ADU

_RTU_REST: Final = 2
_OBJECTS_AT: Final = 8


@final
class RecordedHost(NamedTuple):
    """Frames of a host in order, and the number of those that no classical bus can carry."""

    steps: list[HostStep]
    unsent: int


def host_of(
    trace: Trace, listener: Listener, length_ns: Callable[[str, bytes], int]
) -> RecordedHost:
    """Return the frames of the host; of a cut recording, as far as it goes.

    Args:
        trace: the recording.
        listener: the listener that hears it.
        length_ns: duration of a frame on a CAN bus [ns]; ValueError: impossible on that bus.

    Raises:
        TraceError: the recording is damaged.
    """
    cutter = HostCutter(listener, length_ns)
    frames = FrameDecoder()
    lines: dict[str, ModbusDecoder] = {}
    for channel, time_ns, payload in trace.messages():
        kind = channel.schema.name if channel.schema is not None else ""
        place = channel.topic.rpartition("/")[2]
        try:
            if kind == CAN_FRAME.name:
                told = frames.frame(payload, time_ns, place)
                cutter.take_frame(time_ns, place, told.frame, told.direction)
            elif kind == MODBUS_ADU.name:
                values = decode(MODBUS_ADU, payload)
                adu, data = adu_in(values), values.get("data", b"")
                start_ns = values.get("start_ns", 0)
                if adu is not None and isinstance(data, bytes) and isinstance(start_ns, int):
                    text = lines.setdefault(place, ModbusDecoder()).decode(adu).text
                    cutter.take_adu(start_ns, place, data, adu, text)
        except ValueError:  # an invalid message
            continue
    return RecordedHost(cutter.steps(), cutter.unsent)


def answer_size(data: bytes, tcp: bool) -> int | None:
    """Return the size of an answer from its first bytes; None if it is not yet known.

    Source: MODBUS Application Protocol Specification V1.1b3, section 6; on TCP, the header.
    """
    if tcp:
        return 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else None
    if len(data) < 3:
        return None
    function = data[1]
    if function & 0x80:
        return 3 + _RTU_REST
    if function == 0x2B:
        return _identification_size(data)
    if function == 0x18:
        return 4 + int.from_bytes(data[2:4], "big") + _RTU_REST if len(data) >= 4 else None
    if function in (0x01, 0x02, 0x03, 0x04, 0x0C, 0x11, 0x14, 0x15, 0x17):
        return 3 + data[2] + _RTU_REST
    fixed = {0x05: 6, 0x06: 6, 0x07: 3, 0x08: 6, 0x0B: 6, 0x0F: 6, 0x10: 6, 0x16: 8}
    return fixed[function] + _RTU_REST if function in fixed else None


def _identification_size(data: bytes) -> int | None:
    """Return the size of a read device identification answer (2Bh, 0Eh) from its objects."""
    if len(data) < _OBJECTS_AT:
        return None
    at = _OBJECTS_AT
    for _ in range(data[_OBJECTS_AT - 1]):
        if len(data) < at + 2:
            return None
        at += 2 + data[at + 1]
    return at + _RTU_REST
