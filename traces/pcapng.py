"""pcapng: interface names, directions and senders of packets; writer.

Our files are marked in their head (shb_userappl). In these a packet's comment is its sender.

Source: draft-ietf-opsawg-pcapng.
"""

import struct
from collections.abc import Iterator
from typing import BinaryIO, Final, NamedTuple, final

from traces.schema import Direction

MAGIC: Final = b"\x0a\x0d\x0d\x0a"
_LITTLE: Final = b"\x4d\x3c\x2b\x1a"
_PROGRAM: Final = b"motorhil"
_COMMENT: Final = 1  # option opt_comment
_NAME: Final = 2  # option if_name
_FLAGS: Final = 2  # option epb_flags
_PROGRAM_NAME: Final = 4  # option shb_userappl
_RESOLUTION: Final = 9  # option if_tsresol
_WAYS: Final = (Direction.UNKNOWN, Direction.RECEIVED, Direction.TRANSMITTED)
_PACKET: Final = struct.Struct("<IIIII")


class Origin(NamedTuple):
    """Origin of a packet: interface, direction; True if the file is ours, sender."""

    interface: str
    direction: Direction
    ours: bool = False
    sender: str | None = None


def origins(data: bytes) -> Iterator[Origin]:
    """Yield the origin of each packet of a pcapng file, while its blocks are complete."""
    if data[:4] != MAGIC:
        return
    at, order, ours = 0, "<", False
    names: list[str] = []
    while at + 12 <= len(data):
        if data[at : at + 4] == MAGIC:
            order = "<" if data[at + 8 : at + 12] == _LITTLE else ">"
            names = []
        kind, size = struct.unpack_from(order + "II", data, at)
        if size < 12 or size % 4 or at + size > len(data):
            return
        body = data[at + 8 : at + size - 4]
        if data[at : at + 4] == MAGIC:
            ours = _option(body[16:], _PROGRAM_NAME, order) == _PROGRAM
        elif kind == 1:
            name = _option(body[8:], _NAME, order)
            told = f"can{len(names)}" if name is None else name.decode("utf-8", errors="replace")
            names.append(told)
        elif kind == 3 and names:
            yield Origin(names[0], Direction.UNKNOWN, ours)
        elif kind == 6 and len(body) >= 20:
            which, captured = struct.unpack_from(order + "I8xI", body)
            if which < len(names) and 20 + captured <= len(body):
                options = body[20 + (captured + 3 & ~3) :]
                yield _origin(names[which], ours, options, order)
        at += size


def _origin(name: str, ours: bool, options: bytes, order: str) -> Origin:
    flags = _option(options, _FLAGS, order)
    way = struct.unpack(order + "I", flags)[0] & 3 if flags and len(flags) == 4 else 0
    comment = _option(options, _COMMENT, order) if ours else None
    sender = None if comment is None else comment.decode("utf-8", errors="replace")
    return Origin(name, _WAYS[way] if way < 3 else Direction.UNKNOWN, ours, sender)


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


@final
class PcapngWriter:
    """Writer of packets with nanosecond stamps."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._interfaces = 0
        self._ends: dict[tuple[Direction, str | None], bytes] = {}
        head = struct.pack("<4sHHq", _LITTLE, 1, 0, -1)
        self._block(0x0A0D0D0A, head + _packed(_PROGRAM_NAME, _PROGRAM) + _packed(0, b""))

    def interface(self, link_type: int, name: str) -> int:
        """Write a new interface, and return its number."""
        options = _packed(_NAME, name.encode()) + _packed(_RESOLUTION, b"\x09") + _packed(0, b"")
        self._block(1, struct.pack("<HHI", link_type, 0, 0) + options)
        self._interfaces += 1
        return self._interfaces - 1

    def packet(
        self, which: int, time_ns: int, data: bytes, direction: Direction, sender: str | None
    ) -> None:
        """Write a packet of an interface; `sender` None: unknown."""
        end = self._ends.get((direction, sender))
        if end is None:
            end = self._ends[direction, sender] = _options(direction, sender)
        size = len(data)
        head = _PACKET.pack(which, time_ns >> 32, time_ns & 0xFFFF_FFFF, size, size)
        self._block(6, head + data + bytes(-size % 4) + end)

    def _block(self, kind: int, body: bytes) -> None:
        size = struct.pack("<I", len(body) + 12)
        self._file.write(struct.pack("<I", kind) + size + body + size)


def _options(direction: Direction, sender: str | None) -> bytes:
    out = b"" if sender is None else _packed(_COMMENT, sender.encode())
    if direction:
        out += _packed(_FLAGS, struct.pack("<I", direction))
    return out + _packed(0, b"") if out else out


def _packed(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
