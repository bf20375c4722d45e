"""Lies that a host can detect, for each protocol, and the foreign node that tells them.

A lie is a frame that differs from a true answer in something that the protocol lets a host check:
identifier, length, a number of the sender, a checksum, the registers asked for. Its values are
random. The node sends it in the name of the left drive, or to the host. Faults in it are those
that no emulated drive reports.

Excluded, as no host can know better: values in a frame of right form; the state of a Damiao drive,
and mode and faults of a RobStride; the answer of an RMD to another request that the host sends,
too; a firmware version of a moteus or a VESC, and the notice of its start; a status of a Dynamixel
with its CRC and the number of bytes asked for, or with an error; another exception of a dryve; a
Damiao parameter that was asked for.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Final, final

from motorhil.emulators.can.frame import (
    EFF_FLAG,
    FD_LENGTHS,
    RTR_FLAG,
    pack_fd,
)
from motorhil.emulators.dynamixel.packets import STATUS, packet
from motorhil.harness.rig.rig import Rig
from tests.properties.fuzz.frames import frame

Forge = Callable[[Random], Iterator[bytes]]
"""Yield the frames of one lie."""

_ANY: Final = 0xFF


@final
@dataclass(frozen=True)
class Lies:
    """The lies of a protocol.

    Attributes:
        forge: the frames of the foreign node; None: there is no such node.
        checked: (identifier with its flags, byte, mask): the bits that the medium may turn on CAN,
            because the protocol checks them.
        header: the first bytes of an answer on TCP, all of which the protocol checks.
        lengths: places of lengths in it, which the medium prefers.
        answers: identifiers with their flags, to lose, delay or repeat one of them alone.
        fault: the code of the fault in the frames of the foreign node; None: they have none.
    """

    forge: Forge | None
    checked: tuple[tuple[int, int, int], ...] = ()
    header: int = 8
    lengths: tuple[int, ...] = (5,)
    answers: tuple[int, ...] = ()
    fault: int | None = None

    def turned_on_tcp(self, dice: Random) -> bytes:
        """Return the bits of an answer that are turned: one of its header."""
        place = dice.choice((*self.lengths, dice.randrange(self.header)))
        return bytes(place) + bytes((1 << dice.randrange(8),))

    def turned(self, dice: Random) -> tuple[int, bytes]:
        """Return an identifier, and the bits of its data that are turned: one of those checked."""
        can_id, place, mask = dice.choice(self.checked)
        bit = dice.choice([bit for bit in range(8) if mask >> bit & 1])
        return can_id, bytes(place) + bytes((1 << bit,))


@final
class Liar:
    """A foreign node on the bus or line of a rig."""

    def __init__(self, rig: Rig, bus: str, forge: Forge, dice: Random) -> None:
        self._rig, self._forge, self._dice = rig, forge, dice
        self._until_ns = 0
        is_line = rig.description.buses[bus].is_line
        add = rig.world.add_line_host if is_line else rig.world.add_host
        self._send: Callable[[bytes], object] = add(bus, "liar", lambda *_: None).send

    def begin(self, period_s: float, until_ns: int) -> None:
        """Tell a lie every period, until this time."""
        self._until_ns = until_ns
        self._timer = self._rig.runtime.every(period_s, self._lie)

    def end(self) -> None:
        """Tell no more lies."""
        self._until_ns = 0

    def _lie(self) -> None:
        if self._rig.runtime.now_ns() >= self._until_ns:
            self._timer.cancel()
            return
        for one in self._forge(self._dice):
            self._send(one)


# ------------------------------------------------------------------------------------ CANopen


def canopen(dice: Random) -> Iterator[bytes]:
    """Yield a malformed frame in the name of node 1, or one that answers nothing asked for."""
    which = dice.randrange(5)
    if which == 0:  # an answer to a request for another object
        mux = struct.pack("<BHB", dice.choice((0x43, 0x4B, 0x4F, 0x60)), 0x2FFF, 7)
        yield frame(0x581, mux + dice.randbytes(4))
    elif which == 1:
        yield frame(0x581, dice.randbytes(dice.randrange(8)))
    elif which == 2:
        yield frame(dice.choice((0x181, 0x281)), dice.randbytes(dice.randrange(2)))
    elif which == 3:  # a response of no request: block upload, abort of another object
        yield frame(0x581, struct.pack("<BHBI", 0x80, 0x2FFF, 0, 0x0601_0000))
    else:
        yield frame(0x701, dice.randbytes(dice.choice((0, 2, 8))))


# --------------------------------------------------------------------------- impedance control

_DAMIAO, _DAMIAO_ID = 1, 0x11
_ASKED: Final = (21, 22, 23)  # parameters
_UNDER_VOLTAGE: Final = 9


def mit(dice: Random) -> Iterator[bytes]:
    """Yield feedback of another motor, a cut or foreign frame, a parameter not asked for."""
    state = dice.choice((0, 1, _UNDER_VOLTAGE)) << 4
    told = bytes((state | _DAMIAO,)) + dice.randbytes(7)
    which = dice.randrange(5)
    if which == 0:
        other = dice.choice([number for number in range(16) if number != _DAMIAO])
        yield frame(_DAMIAO_ID, bytes((state | other,)) + told[1:])
    elif which == 1:
        yield frame(_DAMIAO_ID, told[: dice.randrange(8)])
    elif which == 2:
        yield frame(EFF_FLAG | _DAMIAO_ID, told)
    elif which == 3:
        yield frame(RTR_FLAG | _DAMIAO_ID, bytes(8))
    else:
        number = dice.choice([number for number in range(37) if number not in _ASKED])
        yield frame(_DAMIAO_ID, struct.pack("<HBB", _DAMIAO, 0x33, number) + dice.randbytes(4))


_HOST: Final = 0xFD
_NOT_CALIBRATED: Final = 0x20


def robstride(dice: Random) -> Iterator[bytes]:
    """Yield feedback to another host or of another motor, another type, mode, length or format."""
    kind, mode, fault = 2, dice.randrange(3), dice.choice((0, 0, _NOT_CALIBRATED))
    motor, host, flag, data = 1, _HOST, EFF_FLAG, dice.randbytes(8)
    which = dice.randrange(7)
    if which == 0:
        host = dice.choice((0x00, 0x7F, 0xFC, 0xFE, 0xFF))
    elif which == 1:
        motor = dice.choice((0, 3, 0x7F, 0x81))
    elif which == 2:
        kind = dice.choice((0, 1, 3, 17, 18, 21, 31))
    elif which == 3:
        mode = 3
    elif which == 4:
        data = data[: dice.randrange(8)]
    elif which == 5:
        flag |= RTR_FLAG
    else:
        yield frame(motor << 8 | host, data)  # of 11 bits
        return
    yield frame(flag | kind << 24 | mode << 22 | fault << 16 | motor << 8 | host, data)


# ----------------------------------------------------------------------------------------- RMD

_RMD, _ANGLE = 0x241, 0x92
_RMD_ASKED: Final = (0x42, 0x43, 0x70, 0x92, 0x9A, 0x9C, 0x80, 0x81, 0xA1, 0xA2, 0xA4, 0xA8)
_RMD_NOTICES: Final = (0x76, 0xF1)  # of the drive itself
_RMD_BITS: Final = 0b1101_0110  # turn none of those commands into another
_ENCODER: Final = 0x2000


def rmd(dice: Random) -> Iterator[bytes]:
    """Yield answers to foreign commands or of other drives, of another index, length or format."""
    told = (
        bytes((dice.choice((_ANGLE, *_RMD_ASKED[2:])),))
        + dice.randbytes(5)
        + struct.pack("<H", _ENCODER)
    )
    which = dice.randrange(6)
    if which == 0:
        known = (*_RMD_ASKED, *_RMD_NOTICES)
        command = dice.choice([one for one in range(256) if one not in known])
        yield frame(_RMD, bytes((command,)) + told[1:])
    elif which == 1:
        yield frame(_RMD, told[: dice.randrange(8)])
    elif which == 2:
        yield frame(dice.choice((0x240, *range(0x243, 0x261))), told)
    elif which == 3:
        yield frame(EFF_FLAG | _RMD, told)
    elif which == 4:  # of an acceleration that there is not
        yield frame(_RMD, bytes((_RMD_ASKED[0], dice.randrange(4, 256))) + told[2:])
    else:
        yield frame(RTR_FLAG | _RMD, bytes(8))


# -------------------------------------------------------------------------------------- moteus

_MOTEUS: Final = 0x100
_HEADS: Final = (0, 3, 17, 21, 24)
"""Places of the heads in a reply: mode, three floats, completion, fault, control position."""
_REPLY_BYTES: Final = 30
_TOLD: Final = struct.Struct("<2sB2s3f2s2B2sB2sf")
_VELOCITY_UNITS: Final = 47


def _moteus_reply(dice: Random) -> bytes:
    mode = dice.choice((0, 1, 10, 10, 10, 11))
    motion = (dice.uniform(-20.0, 20.0) for _ in range(3))
    heads = [bytes.fromhex(text) for text in ("2100", "2f01", "220b", "210f", "2d38")]
    control = dice.uniform(-20.0, 20.0)
    return _TOLD.pack(
        *(heads[0], mode, heads[1], *motion, heads[2], dice.randrange(2), 0),
        *(heads[3], _VELOCITY_UNITS, heads[4], control),
    )


def moteus(dice: Random) -> Iterator[bytes]:
    """Yield replies cut short, of foreign registers or types, with errors, of or to others."""
    reply, can_id = _moteus_reply(dice), _MOTEUS
    which = dice.randrange(7)
    if which == 0:
        reply = reply[: dice.choice([one for one in FD_LENGTHS if one < _REPLY_BYTES])]
    elif which == 1:  # another register or type in one head
        place = dice.choice(_HEADS)
        head = dice.choice([one for one in _other_heads() if one != reply[place : place + 2]])
        reply = reply[:place] + head + reply[place + 2 :]
    elif which == 2:
        place = dice.choice(_HEADS)  # an error in place of a value
        reply = reply[:place] + dice.choice((b"\x30", b"\x31")) + dice.randbytes(2)
    elif which == 3:
        can_id = dice.choice((_MOTEUS | dice.randrange(10, 0x7F), 0x300, 0x500))
    elif which == 4:
        yield frame(_MOTEUS, reply[: dice.randrange(9)])  # a classical frame
        return
    elif which == 5:
        reply = b"\x2a\x81\x02" + dice.randbytes(dice.choice((1, 5)))  # the versions, cut
    else:
        can_id |= EFF_FLAG | dice.randrange(1, 64) << 16  # another prefix
    size = next(one for one in FD_LENGTHS if one >= len(reply))
    yield pack_fd(can_id, reply.ljust(size, b"\x50") if which else reply)


def _other_heads() -> Iterator[bytes]:
    """Yield the heads of replies of each type, with one register or with three."""
    for kind in (0x20, 0x24, 0x28, 0x2C):
        for count in (1, 2, 3):
            for register in (0x00, 0x01, 0x02, 0x04, 0x0B, 0x0E, 0x0F, 0x38, 0x50):
                yield bytes((kind | count, register))


# ---------------------------------------------------------------------------------------- VESC

_VESC, _VESC_HOST, _OTHER = 1, 0x81, 3
_STATUSES: Final = (9, 16, 27)
_FILL, _END, _SHORT = 5, 7, 8
_VERSION, _SELECTIVE = 0, 50
_MAGNET: Final = 25


def _to_host(command: int, data: bytes) -> bytes:
    return frame(EFF_FLAG | command << 8 | _VESC_HOST, data)


def vesc(dice: Random) -> Iterator[bytes]:
    """Yield status frames of wrong length or sender, and packets of wrong form, CRC or sender."""
    which = dice.randrange(6)
    status = EFF_FLAG | dice.choice(_STATUSES) << 8
    if which == 0:
        yield frame(status | _VESC, dice.randbytes(dice.randrange(8)))
    elif which == 1:
        yield frame(status | _OTHER, dice.randbytes(8))
    elif which == 2:
        yield frame(status | RTR_FLAG | _VESC, bytes(8))
    elif which == 3:  # the fault, of another node, of other values, or cut
        told = bytes((_VESC, 0, _SELECTIVE, 0, 0, 0x80, 0, _MAGNET))
        wrong = (
            bytes((_OTHER,)) + told[1:],
            told[:3] + bytes((1 << dice.randrange(7),)) + told[4:],
            told[: dice.randrange(8)],
        )
        yield _to_host(_SHORT, dice.choice(wrong))
    elif which == 4:
        yield from _vesc_packet(dice)
    else:  # a fragment of no packet
        place = dice.choice((0, 7, 14, dice.randrange(256)))
        yield _to_host(_FILL, bytes((place,)) + dice.randbytes(dice.randrange(8)))


def _vesc_packet(dice: Random) -> Iterator[bytes]:
    """Yield a packet with its version that is too short, or spoiled on its way."""
    body = bytes((_VERSION, dice.randrange(256), 0)) + dice.randbytes(dice.randrange(20))
    sender, crc = _VESC, crc_hqx(body, 0)
    which = dice.randrange(5)
    if which == 0:
        body = body[: dice.randrange(3)]
        crc = crc_hqx(body, 0)
    elif which == 1:
        body = body[: dice.randrange(len(body))]
    elif which == 2:
        crc ^= dice.randrange(1, 0x10000)
    elif which == 3:
        sender = _OTHER
    else:
        crc, body = crc_hqx(body, 0), body + b"\0"
    for place in range(0, len(body), 7):
        yield _to_host(_FILL, bytes((place,)) + body[place : place + 7])
    length = len(body).to_bytes(2, "big")
    yield _to_host(_END, bytes((sender, 0)) + length + crc.to_bytes(2, "big"))


# ----------------------------------------------------------------------------------- Dynamixel

_SERVO: Final = 1
_COUNTS: Final = (1, 2, 3, 4, 7, 36, 80, 80, 80)
"""Bytes that a host asks for, and others: 80 are the registers of a poll."""
_NOT_ASKED: Final = (2, 5, 6, 8, 9, 35, 37, 79, 81)


def dynamixel(dice: Random) -> Iterator[bytes]:
    """Yield statuses with a wrong CRC, length, id or number of bytes; other instructions; parts."""
    body = b"\0" + dice.randbytes(dice.choice(_COUNTS))
    data = packet(_SERVO, STATUS, body)
    which = dice.randrange(7)
    if which == 0:
        crc = int.from_bytes(data[-2:], "little") ^ dice.randrange(1, 0x10000)
        yield data[:-2] + crc.to_bytes(2, "little")
    elif which == 1:
        yield packet(dice.choice((3, 0, 0x81, 0xFD)), STATUS, body)
    elif which == 2:
        yield packet(_SERVO, dice.choice((0x54, 0x56, 0xD5)), body)
    elif which == 3:  # another length than that of the packet
        wrong = dice.choice((0, 1, 2, 3, len(body) - 1, len(body) + 9, 0x400, 0xFFFF))
        yield data[:5] + wrong.to_bytes(2, "little") + data[7:]
    elif which == 4:
        yield packet(_SERVO, STATUS, b"\0" + dice.randbytes(dice.choice(_NOT_ASKED)))
    elif which == 5:
        yield data[: dice.randrange(1, len(data))]
    else:
        yield dice.randbytes(dice.randrange(1, 20))


_CANOPEN: Final = Lies(
    canopen,
    tuple((can_id, place, _ANY) for can_id in (0x581, 0x582) for place in range(4)),
    answers=(0x181, 0x281, 0x581, 0x701),
)
_PART, _LAST_PART, _WHOLE = (EFF_FLAG | one << 8 | _VESC_HOST for one in (_FILL, _END, _SHORT))
LIES: Final = {
    "cia402": _CANOPEN,
    "software": _CANOPEN,
    "mit": Lies(mit, ((_DAMIAO_ID, 0, 0x0F),), answers=(_DAMIAO_ID,), fault=_UNDER_VOLTAGE),
    "robstride": Lies(robstride, fault=_NOT_CALIBRATED),
    "rmd": Lies(rmd, ((_RMD, 0, _RMD_BITS),), answers=(_RMD,), fault=_ENCODER),
    "moteus": Lies(
        moteus,
        tuple((_MOTEUS, place + more, _ANY) for place in _HEADS for more in (0, 1)),
        answers=(_MOTEUS,),
        fault=_VELOCITY_UNITS,
    ),
    "vesc": Lies(
        vesc,
        (
            *((_PART, place, _ANY) for place in range(8)),
            *((_LAST_PART, place, _ANY) for place in (0, 2, 3, 4, 5)),
            *((_WHOLE, place, _ANY) for place in (0, 2, 3, 4, 5, 6)),
        ),
        answers=tuple(EFF_FLAG | one << 8 | _VESC for one in _STATUSES),
        fault=_MAGNET,
    ),
    "dynamixel": Lies(dynamixel),
    "dryve": Lies(None, header=19, lengths=(5, 18)),  # up to the number of bytes of the value
}
"""The lies by the name of a kind of hardware; others have only those of their medium."""
NONE: Final = Lies(None)
