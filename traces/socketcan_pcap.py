"""CAN frames in packet captures: SocketCAN's, in pcap and pcapng; writes pcapng.

Linux's frames with the identifier turned to network order are link type 227; on "any" or cooked
captures they stand behind a head. Which interface a packet came from and which way it went only
pcapng tells.

Source: LINKTYPE_CAN_SOCKETCAN, LINKTYPE_LINUX_SLL, tcpdump.org; draft-ietf-opsawg-pcapng.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from traces import traffic
from traces.pcap import Capture, Packet
from traces.schema import Direction
from traces.traffic import Findings, Frame

_SOCKETCAN: Final = 227
_COOKED: Final = 113
_COOKED_2: Final = 276
_PROTOCOLS: Final = (0x000C, 0x000D)  # ETH_P_CAN, ETH_P_CANFD
_HEAD: Final = struct.Struct(">IBB2x")
_PCAPNG: Final = b"\x0a\x0d\x0d\x0a"
_NAME: Final = 2  # option if_name
_FLAGS: Final = 2  # option epb_flags
_RESOLUTION: Final = 9  # option if_tsresol
_WAYS: Final = (Direction.UNKNOWN, Direction.RECEIVED, Direction.TRANSMITTED)


def is_capture(head: bytes) -> bool:
    """Whether a file that begins so is a capture."""
    return head[:4] in (
        _PCAPNG,
        b"\xd4\xc3\xb2\xa1",
        b"\xa1\xb2\xc3\xd4",
        b"\x4d\x3c\xb2\xa1",
        b"\xa1\xb2\x3c\x4d",
    )


class _Origin(NamedTuple):
    """Where a packet came from, and which way it went."""

    bus: str
    direction: Direction


def captured_frames(path: str, findings: Findings) -> Iterator[Frame]:
    """The CAN frames of a capture, in its order; what else is in it is counted in a note.

    Raises:
        TraceError: it cannot be read, or is no capture.
    """
    capture = Capture(path)
    told = _origins(Path(path).read_bytes())
    nothing = _Origin("can0", Direction.UNKNOWN)
    others = 0
    for packet in capture.packets():
        origin = next(told, nothing)
        try:
            content, direction = _can_part(packet)
            if content is None:
                others += 1
                continue
            frame = _frame(content, packet.missing)
        except ValueError as error:
            findings.problem(packet.number, f"{error}, in packet {packet.number}")
            continue
        if packet.time_ns == 0:
            findings.unstamped += 1
        yield Frame(packet.time_ns, origin.bus, frame, origin.direction or direction)
    if others:
        findings.note(f"{others} packets are no CAN frames, and left out")
    for problem in capture.problems:
        findings.problem(0, problem.removeprefix(f"{path}: "))


def _can_part(packet: Packet) -> tuple[bytes | None, Direction]:
    """Linux's frame in a packet, None: there is none; and which way a cooked one went."""
    data = packet.data
    if packet.link_type == _SOCKETCAN:
        return data, Direction.UNKNOWN
    if packet.link_type == _COOKED and len(data) >= 16:
        kind, protocol, size = int.from_bytes(data[:2], "big"), data[14:16], 16
    elif packet.link_type == _COOKED_2 and len(data) >= 20:
        kind, protocol, size = data[10], data[:2], 20
    else:
        return None, Direction.UNKNOWN
    if int.from_bytes(protocol, "big") not in _PROTOCOLS:
        return None, Direction.UNKNOWN
    return data[size:], Direction.TRANSMITTED if kind == 4 else Direction.RECEIVED


def _frame(content: bytes, missing: int) -> bytes:
    if len(content) < 8:
        raise ValueError(f"{len(content)} bytes are no CAN frame")
    can_id, length, flags = _HEAD.unpack_from(content)
    fd = bool(flags & traffic.FDF) or len(content) > 16
    data = content[8 : 8 + length]
    if can_id & traffic.RTR:
        return traffic.remote(can_id & ~traffic.RTR, length)
    if len(data) < length:
        cut = ", which were not captured" if missing else ""
        raise ValueError(f"{len(data)} of {length} bytes{cut}")
    return traffic.flexible(can_id, flags, data) if fd else traffic.classic(can_id, data)


def _origins(data: bytes) -> Iterator[_Origin]:
    """Of each packet of a pcapng file, in its order, as far as its blocks are whole."""
    if data[:4] != _PCAPNG:
        return
    at, order = 0, "<"
    names: list[str] = []
    while at + 12 <= len(data):
        if data[at : at + 4] == _PCAPNG:
            order = "<" if data[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
            names = []
        kind, size = struct.unpack_from(order + "II", data, at)
        if size < 12 or size % 4 or at + size > len(data):
            return
        body = data[at + 8 : at + size - 4]
        if kind == 1:
            name = _option(body[8:], _NAME, order)
            told = f"can{len(names)}" if name is None else name.decode("utf-8", errors="replace")
            names.append(told)
        elif kind == 3 and names:
            yield _Origin(names[0], Direction.UNKNOWN)
        elif kind == 6 and len(body) >= 20:
            which, captured = struct.unpack_from(order + "I8xI", body)
            if which < len(names) and 20 + captured <= len(body):
                flags = _option(body[20 + (captured + 3 & ~3) :], _FLAGS, order)
                way = struct.unpack(order + "I", flags)[0] & 3 if flags and len(flags) == 4 else 0
                yield _Origin(names[which], _WAYS[way] if way < 3 else Direction.UNKNOWN)
        at += size


def _option(options: bytes, wanted: int, order: str) -> bytes | None:
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == wanted:
            return options[at + 4 : at + 4 + length]
        if code == 0:
            break
        at += 4 + (length + 3 & ~3)
    return None


def write_pcapng(file: BinaryIO, buses: Sequence[str], frames: Iterator[Frame]) -> None:
    """A pcapng file of nanoseconds, an interface a bus."""
    file.write(_block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
    for bus in buses:
        options = _packed_option(_NAME, bus.encode()) + _packed_option(_RESOLUTION, b"\x09")
        options += _packed_option(0, b"")
        file.write(_block(1, struct.pack("<HHI", _SOCKETCAN, 0, 0) + options))
    which = {bus: number for number, bus in enumerate(buses)}
    ends = [
        (_packed_option(_FLAGS, struct.pack("<I", way)) + _packed_option(0, b"")) if way else b""
        for way in range(3)
    ]
    for time_ns, bus, frame, direction, _ in frames:
        told = traffic.fields(frame)
        size = 8 if told.can_id & traffic.RTR else 8 + told.length
        content = _HEAD.pack(told.can_id, told.length, told.flags) + frame[8:size]
        if not told.fd:
            content = content.ljust(16, b"\0")
        head = struct.pack(
            "<IIIII",
            which[bus],
            time_ns >> 32,
            time_ns & 0xFFFFFFFF,
            len(content),
            len(content),
        )
        body = head + content + bytes(-len(content) % 4)
        file.write(_block(6, body + ends[direction]))


def _packed_option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


def _block(kind: int, body: bytes) -> bytes:
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size
