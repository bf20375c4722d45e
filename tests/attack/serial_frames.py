"""Requests for each kind of emulated drive on a serial line or TCP, some of them damaged.

A group is of pieces that are sent without a pause: what a line or a connection delivers at once.
"""

from collections.abc import Iterable, Iterator
from random import Random
from typing import Final

from motorhil.emulators.dynamixel.packets import BROADCAST, STATUS, Instruction, packet
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.modbus.tcp import adu
from tests.attack.can_frames import Group, number

UNIT: Final = 1
_FUNCTIONS: Final = (0x03, 0x03, 0x06, 0x06, 0x10, 0x10, 0x17, 0x08, 0x2B, 0x01, 0x04)
_ITEMS: Final = (  # addresses of a servo
    *(0, 7, 8, 9, 10, 11, 12, 20, 24, 31, 36, 38, 44, 48, 52, 60, 63, 64, 64, 68, 98, 98, 100),
    *(102, 104, 104, 108, 112, 116, 116, 122, 132, 168, 170, 208, 224, 9999),
)
_ID: Final = 7
_GATEWAY_OBJECTS: Final = (  # of a dryve: index, sub-index, bytes
    *((index, 0, 1) for index in (0x1001, 0x6060, 0x6060, 0x6061, 0x6098)),
    *((index, 0, 2) for index in (0x2014, 0x6040, 0x6040, 0x6040, 0x6040, 0x6041)),
    *((index, 0, 4) for index in (0x6064, 0x607A, 0x607A, 0x6081, 0x6083, 0x6084, 0x60A8, 0x60FF)),
    *((index, 1, 4) for index in (0x607B, 0x6092, 0x6099)),
)
_SINGLE: Final = (
    *(Instruction.PING, *(Instruction.READ,) * 4, *(Instruction.WRITE,) * 6, Instruction.REG_WRITE),
    *(Instruction.ACTION, Instruction.REBOOT, Instruction.CLEAR, Instruction.BACKUP),
    Instruction.FACTORY_RESET,
)
_GROUPED: Final = (
    *(Instruction.SYNC_READ, Instruction.SYNC_WRITE, Instruction.FAST_SYNC_READ),
    *(Instruction.BULK_READ, Instruction.BULK_WRITE, Instruction.FAST_BULK_READ),
)
_SYNC_READS: Final = (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ)


def damaged(dice: Random, data: bytes) -> bytes:
    """Return data cut, extended, with a flipped bit, or quite different; mostly unchanged."""
    chance = dice.random()
    if chance < 0.02:
        return data[: dice.randrange(len(data))]
    if chance < 0.04:
        return data + dice.randbytes(9)
    if chance < 0.06:
        place = dice.randrange(8 * len(data))
        turned = int.from_bytes(data, "little") ^ 1 << place
        return turned.to_bytes(len(data), "little")
    if chance < 0.07:
        return dice.randbytes(dice.randrange(300))
    return data


def pdus(dice: Random, addresses: list[int]) -> Iterator[bytes]:
    """Yield Modbus requests around the addresses of a drive, valid ones and invalid ones."""
    while True:
        function = dice.choice(_FUNCTIONS) if dice.random() < 0.97 else dice.randrange(256)
        address = (dice.choice(addresses) + dice.choice((0, 0, 0, 1))) & 0xFFFF
        count = dice.choice((1, 1, 1, 2, 2, 2, 4, 4, 125))
        head = bytes((function,)) + address.to_bytes(2, "big")
        if function == 0x06:
            yield head + number(dice, 2).to_bytes(2, "big")
            continue
        few = b"".join(number(dice, 2).to_bytes(2, "big") for _ in range(min(count, 4)))
        values = (few * 32)[: 2 * count]
        writes = count.to_bytes(2, "big") + bytes((2 * count & 0xFF,)) + values
        if function == 0x10:
            yield head + writes
        elif function == 0x17:
            yield head + b"\0\1" + address.to_bytes(2, "big") + writes
        elif function == 0x2B:
            yield bytes((function, 0x0E, dice.randrange(6), dice.randrange(8)))
        else:
            yield head + count.to_bytes(2, "big") + dice.randbytes(dice.choice((0, 0, 0, 3)))


def rtu(dice: Random, addresses: list[int]) -> Iterator[Group]:
    """Yield requests on a serial line."""
    for pdu in pdus(dice, addresses):
        unit = bytes((dice.choice((*(UNIT,) * 10, 0, 2)),))
        yield (damaged(dice, with_crc(unit + pdu[:253])) or b"\0",)


def tcp(dice: Random, addresses: list[int]) -> Iterator[bytes]:
    """Yield requests of Modbus/TCP."""
    for pdu in pdus(dice, addresses):
        yield damaged(dice, adu(number(dice, 2), dice.choice((UNIT, UNIT, 0, 2)), pdu))


def telegrams(dice: Random) -> Iterator[Group]:
    """Yield telegrams for a dryve: objects read and written, valid ones and invalid ones."""
    while True:
        index, subindex, size = dice.choice(_GATEWAY_OBJECTS)
        if dice.random() < 0.1:
            index, subindex, size = index + 1, dice.randrange(4), dice.randrange(6)
        value = dice.choice((*range(12), 0x0F, 0x1F, 0x3F, 0x80, 0x10F, 5400, number(dice, 4)))
        writes = 2 if dice.random() < 0.02 else dice.choice((0, 1, 1))
        data = value.to_bytes(8, "little")[:size] if writes else b""
        place = index.to_bytes(2, "big") + bytes((subindex, 0, 0, 0, size))
        pdu = damaged(dice, bytes((0x2B, 0x0D, writes, 0, 0)) + place + data) or b"\x2b"
        yield (with_crc(bytes((UNIT,)) + pdu),)


def dynamixel(dice: Random) -> Iterator[Group]:
    """Yield packets for a servo and for others, and statuses of others; some in two pieces."""
    for code, parameters in _instructions(dice):
        is_grouped = code in _GROUPED
        unit = BROADCAST if is_grouped else dice.choice((*(UNIT,) * 10, BROADCAST, 2))
        data = damaged(dice, packet(2 if code == STATUS else unit, code, parameters)) or b"\xff"
        cut = dice.randrange(len(data) + 1) if dice.random() < 0.1 else len(data)
        yield tuple(part for part in (data[:cut], data[cut:]) if part)


def _instructions(dice: Random) -> Iterator[tuple[int, bytes]]:
    """Yield instructions with their parameters."""
    while True:
        address = dice.choice(_ITEMS) + dice.choice((0, 0, 0, 1))
        if address == _ID and dice.random() < 0.9:
            continue  # a servo of another id has no further answers
        place = address.to_bytes(2, "little")
        size = dice.choice((1, 1, 2, 4, 4, 4, 4, 8, 8, 80))
        data = (number(dice, 4).to_bytes(4, "little") * 20)[:size]
        chance = dice.random()
        if chance < 0.02:
            yield dice.choice((STATUS, 0x42)), data
        elif chance < 0.8:
            code = dice.choice(_SINGLE)
            yield code, _single(dice, code, place, data)
        else:
            code = dice.choice(_GROUPED)
            units = [dice.choice((UNIT, UNIT, 2, 3, dice.randrange(256))) for _ in range(3)]
            yield code, _grouped(code, units, place, data)


def _single(dice: Random, code: int, place: bytes, data: bytes) -> bytes:
    if code == Instruction.READ:
        return place + len(data).to_bytes(2, "little")
    if code in (Instruction.WRITE, Instruction.REG_WRITE):
        return place + data
    if code == Instruction.FACTORY_RESET:
        return bytes((dice.choice((1, 2, 255, 3)),))
    if code == Instruction.CLEAR:
        return b"\x01DXL\x22"
    if code == Instruction.BACKUP:
        return bytes((dice.choice((1, 2)),)) + b"CTRL"
    return b"" if dice.random() < 0.9 else data


def _grouped(code: int, units: Iterable[int], place: bytes, data: bytes) -> bytes:
    length = len(data).to_bytes(2, "little")
    heads = [bytes((one,)) for one in units]
    if code in _SYNC_READS:
        return place + length + b"".join(heads)
    if code == Instruction.SYNC_WRITE:
        return place + length + b"".join(head + data for head in heads[:2])
    if code == Instruction.BULK_WRITE:
        return b"".join(head + place + length + data for head in heads[:2])
    return b"".join(head + place + length for head in heads)
