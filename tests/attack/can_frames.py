"""Frames for each kind of emulated drive on CAN: of its protocol, and some damaged ones.

Values are often at or beyond the ends of their ranges. A group of frames is sent without a pause,
because a drive obeys its last frame only after the first ones.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from math import inf, nan
from random import Random
from typing import Final

from motorhil.emulators.can.frame import EFF_FLAG, FD_LENGTHS, RTR_FLAG, pack_fd
from motorhil.emulators.moteus import registers as r
from motorhil.emulators.vesc.packets import frames_of
from tests.properties.fuzz.frames import frame

Group = tuple[bytes, ...]
"""Inputs one after another."""

NODE: Final = 5
FLOATS: Final = (
    *(0.0, -0.0, 0.0, 1.0, -1.0, 0.5, -0.25, 3.0, 10.0, -20.0, 1e3, 1e-45, -1e-38, 1e6, 1e9),
    *(3.4028234e38, -3.4028234e38, 1e30, inf, -inf, nan),
)
NUMBERS: Final = (
    *(0, 0, 1, 1, 2, 3, 4, 5, 9, 10, 50, 100, 1_000, 5_000, 36_000, 100_000, 1_000_000, 10_000_000),
    *(
        -1,
        -2,
        -100,
        -1_000,
        -50_000,
        0x7F,
        0x80,
        0xFF,
        0x7FFF,
        0x8000,
        0xFFFF,
        0x7FFF_FFFF,
        1 << 31,
    ),
)
_MIT_PARAMETERS: Final = (*range(7, 11), *range(13, 17), *range(20, 24))
_ROBSTRIDE_PARAMETERS: Final = (*range(0x7004, 0x7020),)
_ROBSTRIDE_TYPES: Final = (*(1,) * 8, *(3,) * 4, 4, 4, 6, 0, *(17,) * 3, *(18,) * 4, 2, 21)
_RMD_COMMANDS: Final = (
    *(0xA1, 0xA2, 0xA4, 0xA4, 0xA6, 0xA8, 0xA8, 0x81, 0x81, 0x80, 0x20, 0x31, 0x32, 0x43, 0x43),
    *(0x63, 0x64, 0x77, 0x78, 0xB3, 0xB6, 0xB6, 0x30, 0x42, 0x60, 0x61, 0x62, 0x92, 0x94, 0xB1),
    *(0xB2, 0x70, 0x71, 0xB5, 0x90, 0x9A, 0x9C, 0x9D),
)
_VESC_MOTIONS: Final = (0, 1, 2, 3, 3, 4, 4, 10, 11, 12, 13)
_VESC_PACKETS: Final = (0, 4, 5, 6, 7, 8, 9, 10, 29, 30, 50, 84, 159, 2, 255)
_MOTEUS_MODES: Final = (0, *(10,) * 6, 10, 9, 9, 12, 13, 13, 15, 15, 1, 5, 8, 11, 16)
_MOTEUS_REGISTERS: Final = (*r.QUANTITIES, *r.IDENTITY, 0x110, 0x200, 0x3FFF)


def number(dice: Random, size: int) -> int:
    """Return an unsigned number of this many bytes."""
    value = dice.choice(NUMBERS) if dice.random() < 0.8 else dice.getrandbits(8 * size)
    return value & (1 << 8 * size) - 1


def single(dice: Random) -> bytes:
    """Return a float of four bytes, little endian."""
    value = dice.choice(FLOATS) if dice.random() < 0.6 else dice.uniform(-10.0, 10.0)
    return struct.pack("<f", value) if dice.random() < 0.97 else dice.randbytes(4)


def bent(dice: Random, can_id: int, data: bytes) -> bytes:
    """Return the frame; rarely with another length, bit or identifier, or as a remote one."""
    chance = dice.random()
    if chance < 0.02:
        data = data[: dice.randrange(9)]
    elif chance < 0.03:
        data = (data + dice.randbytes(8))[:8]
    elif chance < 0.05 and data:
        place = dice.randrange(8 * len(data))
        data = (int.from_bytes(data, "little") ^ 1 << place).to_bytes(len(data), "little")
    elif chance < 0.06:
        can_id |= RTR_FLAG
    elif chance < 0.07:
        can_id ^= 1 << dice.randrange(11)
    elif chance < 0.08:
        can_id ^= EFF_FLAG
    elif chance < 0.09:
        data = dice.randbytes(dice.randrange(9))
    return frame(can_id, data[:8])


def mit(dice: Random) -> Iterator[Group]:
    """Yield commands, special codes, and reads and writes of Damiao's parameters."""

    def special(*codes: int) -> Group:
        return tuple(bent(dice, NODE, b"\xff" * 7 + bytes((code,))) for code in codes)

    def command() -> bytes:
        p, v, t = (dice.choice((0, 1, 1 << 15, dice.getrandbits(16), 0xFFFF)) for _ in range(3))
        kp, kd = (dice.choice((0, 0, 1, 100, dice.getrandbits(12), 0xFFF)) for _ in range(2))
        bits = p << 48 | (v >> 4) << 36 | kp << 24 | kd << 12 | t >> 4
        return bent(dice, NODE, bits.to_bytes(8, "big"))

    while True:
        chance = dice.random()
        if chance < 0.6:
            yield (command(),)
        elif chance < 0.7:
            yield (*special(0xFD, 0xFC), command(), command())
        elif chance < 0.8:
            yield special(dice.choice((0xFA, 0xFB, 0xFC, 0xFD, 0xFE, 0xFE, 0xFF)))
        else:
            operation = dice.choice((0x33, 0x33, 0x55, 0x55, 0x55, 0xAA, 0xCC, 0x00))
            value = single(dice) if dice.random() < 0.6 else number(dice, 4).to_bytes(4, "little")
            node = dice.choice((NODE, NODE, NODE, NODE, NODE, 6, 0x105))
            head = struct.pack("<HBB", node, operation, dice.choice(_MIT_PARAMETERS))
            yield (bent(dice, 0x7FF, head + value),)


def robstride(dice: Random) -> Iterator[Group]:
    """Yield frames of all types, mostly to this drive."""

    def typed(kind: int, area: int, data: bytes) -> bytes:
        target = NODE if dice.random() < 0.95 else dice.choice((0, 6, 0x7F, 0xFE))
        return bent(dice, EFF_FLAG | kind << 24 | (area & 0xFFFF) << 8 | target, data)

    def write(index: int, value: bytes) -> bytes:
        return typed(18, 0xFD, struct.pack("<HH", index, 0) + value)

    while True:
        kind = dice.choice(_ROBSTRIDE_TYPES) if dice.random() < 0.99 else dice.randrange(32)
        if kind == 7 and dice.random() < 0.9:
            continue  # a drive of another number has no further answers
        if kind == 1:
            data = struct.pack(">4H", *(number(dice, 2) for _ in range(4)))
            yield (typed(kind, number(dice, 2), data),)
        elif kind == 3 and dice.random() < 0.6:
            mode = bytes((dice.choice((0, 1, 2, 3, 3, 4)), 0, 0, 0))
            reference = dice.choice((0x7006, 0x700A, 0x7016, 0x7017, 0x7018))
            stop, begin = (typed(one, 0xFD, bytes(8)) for one in (4, 3))
            yield stop, write(0x7005, mode), begin, write(reference, single(dice))
        elif kind in (17, 18):
            index = dice.choice(_ROBSTRIDE_PARAMETERS)
            yield (typed(kind, 0xFD, struct.pack("<HH", index, 0) + single(dice)),)
        else:
            yield (typed(kind, number(dice, 2), number(dice, 8).to_bytes(8, "little")),)


def rmd(dice: Random) -> Iterator[Group]:
    """Yield requests to this drive and to all, valid ones and invalid ones."""
    while True:
        command = dice.choice(_RMD_COMMANDS) if dice.random() < 0.97 else dice.randrange(256)
        if command == 0x76 and dice.random() < 0.5:
            continue
        index = dice.choice((*range(10), *_RMD_COMMANDS[-8:]))
        speed = dice.choice((0, 1, 10, 360, 2_000, 0xFFFF))
        data = struct.pack("<BBHI", command, index, speed, number(dice, 4))
        chance = dice.random()
        if chance < 0.005:
            told = bytes((0x79, 0, dice.randrange(2), 0, 0, 0, 0, number(dice, 1)))
            yield (bent(dice, 0x300, told),)
        else:
            yield (bent(dice, 0x140 + NODE if chance < 0.93 else 0x280, data),)


def vesc(dice: Random) -> Iterator[Group]:
    """Yield commands, and packets in all their fragments or with one missing."""

    def to(command: int, data: bytes) -> bytes:
        target = NODE if dice.random() < 0.95 else dice.choice((255, 0, 6))
        return bent(dice, EFF_FLAG | command << 8 | target, data)

    while True:
        chance = dice.random()
        if chance < 0.7:
            data = number(dice, 4).to_bytes(4, "big")
            yield (to(dice.choice(_VESC_MOTIONS), data + (b"\0\0" if chance < 0.02 else b"")),)
        elif chance < 0.85:
            kind = dice.choice(_VESC_PACKETS)
            body = number(dice, 4).to_bytes(4, "big") + bytes(dice.choice((0, 0, 0, 3, 30, 300)))
            mode = dice.choice((0, 0, 0, 1, 2, 3, 9))
            parts = [to(*one) for one in frames_of(bytes((kind,)) + body, 0x2A, mode)]
            if len(parts) > 1 and dice.random() < 0.3:
                del parts[dice.randrange(len(parts))]
            yield tuple(parts)
        else:
            command = (
                dice.choice((17, 17, 21, 22, 55, 56, 63)) if chance < 0.98 else number(dice, 1)
            )
            yield (to(command, number(dice, 8).to_bytes(8, "big")[: dice.choice((8, 8, 4, 1))]),)


def moteus(dice: Random) -> Iterator[Group]:
    """Yield frames of up to six subframes, as classical frames and as those of CAN FD."""

    def values(kind: int, count: int) -> bytes:
        if kind == r.FLOAT:
            return b"".join(single(dice) for _ in range(count))
        size = r.LAYOUTS[kind].size
        return b"".join(number(dice, size).to_bytes(size, "little") for _ in range(count))

    def part() -> bytes:
        chance, kind = dice.random(), dice.randrange(4)
        if chance < 0.3:
            mode = bytes((0x01, 0x00, dice.choice(_MOTEUS_MODES)))
            count = dice.choice((0, 1, 2, 3, 6))
            return mode + (r.subframe(r.WRITE, kind, 0x20, [values(kind, 1)] * count))
        first, count = dice.choice(_MOTEUS_REGISTERS), dice.choice((1, 1, 1, 1, 2, 3, 4))
        if chance < 0.6:
            head = r.subframe(r.READ, kind, first, ())
            many = b"" if count < 4 else r.packed(count)
            return bytes((head[0] + (0 if many else count),)) + many + r.packed(first)
        if chance < 0.9:
            return r.subframe(r.WRITE, kind, first, [values(kind, 1) for _ in range(count)])
        text = dice.randbytes(dice.randrange(9))
        tunnel = bytes((dice.choice((0x40, 0x41, 0x42, 0x43)), dice.choice((1, 1, 2)), len(text)))
        return dice.choice((b"\x50", b"\x30", b"\x31\x20", tunnel + text, dice.randbytes(3)))

    while True:
        data = b"".join(part() for _ in range(dice.choice((0, 1, 1, 1, 1, 2, 4))))
        head = dice.choice((0x8000, 0x8000, 0x8000, 0x0000, 0x8100, 0x2000_0000 >> 16))
        can_id = head | dice.choice((NODE, NODE, NODE, NODE, NODE, 0x7F, 1))
        can_id |= EFF_FLAG if can_id > 0x7FF else 0
        if len(data) <= 8 and dice.random() < 0.5:
            yield (bent(dice, can_id, data),)
            continue
        data = data[: FD_LENGTHS[-1]]
        length = min(one for one in FD_LENGTHS if one >= len(data))
        cut = data if dice.random() < 0.97 else dice.randbytes(length)
        yield (pack_fd(can_id, cut.ljust(length, b"P")),)


def frames_for(identifiers: Callable[[], Sequence[int] | None], dice: Random) -> Iterator[Group]:
    """Yield frames of any data under the identifiers of a drive."""
    while True:
        size = dice.choice((8, 8, 6, 5, 4, 4, *range(9)))
        data = bytes(dice.choice((0, 0, 1, 0xFF, dice.randrange(256))) for _ in range(size))
        yield (bent(dice, dice.choice(list(identifiers() or (0,))), data),)
