"""CAN frames in packet captures of SocketCAN; reads pcap and pcapng, writes pcapng.

Linux's frames with the identifier in network byte order are link type 227. In captures of "any" or
cooked ones they follow a head, and the identifier has the byte order of the machine that captured.
Only pcapng contains a packet's interface and direction; only our files contain the sender.

Source: LINKTYPE_CAN_SOCKETCAN, LINKTYPE_LINUX_SLL, tcpdump.org; draft-ietf-opsawg-pcapng.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import BinaryIO, Final

from motorhil.traces import can_frame
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.pcap import MAGIC, PCAP, Capture, Packet, PcapngWriter
from motorhil.traces.schema import Direction

_BUS: Final = "can0"  # of a file without names
_SOCKETCAN: Final = 227
_COOKED: Final = 113
_COOKED_2: Final = 276
_LINKS: Final = {
    **{0: "loopback", 1: "Ethernet", 101: "raw IP", 105: "IEEE 802.11", 113: "cooked"},
    **{189: "USB", 210: "FlexRay", 212: "LIN", 220: "USB", 250: "serial lines", 276: "cooked"},
}
_PROTOCOLS: Final = (0x000C, 0x000D)  # ETH_P_CAN, ETH_P_CANFD
_HEADS: Final = {order: struct.Struct(order + "IBB2x") for order in "<>"}


def is_capture(head: bytes) -> bool:
    """Return True if a file with this beginning is a capture."""
    return head[:4] == MAGIC or head[:4] in PCAP


def captured_frames(path: str, findings: Findings, memory_max: int) -> Iterator[Frame]:
    """Yield the CAN frames of a capture in order; other packets are counted in a note.

    Raises:
        TraceError: the file cannot be read, or is not a capture.
    """
    capture = Capture(path, memory_max)
    others: Counter[int] = Counter()  # by link type
    for packet in capture.packets():
        try:
            content, direction = _can_part(packet)
            if content is None:
                others[packet.link_type] += 1
                continue
            head = _HEADS[">" if packet.link_type == _SOCKETCAN else packet.order]
            frame = _frame(content, head, packet.missing)
        except ValueError as error:
            findings.problem(packet.number, f"{error}, in packet {packet.number}")
            continue
        if packet.time_ns == 0:
            findings.unstamped += 1
        bus = _BUS if packet.interface is None else packet.interface
        way = packet.direction or direction
        yield Frame(packet.time_ns, bus, frame, way, packet.sender or "")
    if others:
        kinds = ", ".join(_LINKS.get(one, f"link type {one}") for one in sorted(others))
        findings.note(f"{others.total()} packets are not CAN frames ({kinds}), and are omitted")
    for problem in capture.problems:
        findings.problem(0, problem.removeprefix(f"{path}: "))


def _can_part(packet: Packet) -> tuple[bytes | None, Direction]:
    """Return Linux's frame in a packet, or None, and the direction of a cooked one."""
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


def _frame(content: bytes, head: struct.Struct, missing: int) -> bytes:
    if len(content) < 8:
        raise ValueError(f"{len(content)} bytes are not a CAN frame")
    can_id, length, flags = head.unpack_from(content)
    fd = bool(flags & can_frame.FDF) or len(content) > 16
    data = content[8 : 8 + length]
    if can_id & can_frame.RTR:
        return can_frame.remote(can_id & ~can_frame.RTR, length)
    if len(data) < length:
        cut = ", which were not captured" if missing else ""
        raise ValueError(f"{len(data)} of {length} bytes{cut}")
    return can_frame.flexible(can_id, flags, data) if fd else can_frame.classic(can_id, data)


def write_pcapng(file: BinaryIO, buses: Sequence[str], frames: Iterator[Frame]) -> None:
    """Write a pcapng file with nanoseconds, one interface per bus."""
    writer = PcapngWriter(file)
    which = {bus: writer.interface(_SOCKETCAN, bus) for bus in buses}
    for time_ns, bus, frame, direction, sender in frames:
        told = can_frame.fields(frame)
        size = 8 if told.can_id & can_frame.RTR else 8 + told.length
        content = _HEADS[">"].pack(told.can_id, told.length, told.flags) + frame[8:size]
        if not told.fd:
            content = content.ljust(16, b"\0")
        writer.packet(which[bus], time_ns, content, direction, sender or None)
