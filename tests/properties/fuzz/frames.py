"""Frames for fuzzing a drive: valid-looking ones, invalid ones and recorded ones.

A step is a line of text, so that a run can be kept, reduced and repeated. Frames are "PAUSE_NS
ID#DATA" as candump writes them (a remote frame "#R8", a 29-bit identifier in eight digits).
Physical inputs of the drive are "PAUSE_NS !INPUT VALUE".
"""

import struct
from collections.abc import Iterator, Sequence
from functools import cache
from random import Random
from typing import Final

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from tests.support.checkout import CHECKOUT
from tests.support.cia402.bench import MS, NODE
from tests.support.cia402.stranger import NORMAL, PHYSICS

Step = tuple[int, int, bytes | float | str]
"""Pause [ns]; identifier with its flags, and data; or -1 and "name value"."""

EXTENDED: Final = 0x8000_0000
REMOTE: Final = 0x4000_0000
GOLDEN: Final = CHECKOUT / "traces" / "golden" / "cia402.mcap"
PAUSES_NS: Final = (0, 0, 0, 0, 1, 100_000, 1 * MS, 1 * MS, 2 * MS, 7 * MS, 20 * MS)
WORDS: Final = (0x06, 0x07, 0x0F, 0x0F, 0x1F, 0x3F, 0x00, 0x02, 0x80, 0x8F, 0x010F)
INTERESTING: Final = (
    *(0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF),
    *(0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF),
    *(0x6576_6173, 0x6461_6F6C),  # "save", "load"
    *(0x6041_0010, 0x6064_0020, 0x607A_0020, 0x6040_0010),  # PDO mapping entries
    *(0x4000_0185, 0x8000_0185, 0x205),  # COB-IDs
)
INPUTS: Final = tuple(dict.fromkeys(name for name, _ in PHYSICS if name != "fault"))
# Commands of block and segmented transfers; the last ones are invalid.
COMMANDS: Final = (0x40, 0x40, 0x2F, 0x2B, 0x27, 0x23, 0x22, 0x20, 0x21, 0x60, 0x70, 0x00, 0x10,
                   0x01, 0x1F, 0xA0, 0xA4, 0xA3, 0xA2, 0xC2, 0xC6, 0xC1, 0xD5, 0x80)  # fmt: skip
NMT: Final = (0x01, 0x01, 0x01, 0x01, 0x80, 0x02, 0x81, 0x82)
LSS: Final = (0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x41, 0x42, 0x43, 0x46, 0x47, 0x48, 0x49, 0x4A,
              0x4B, 0x4C, 0x51, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E)  # fmt: skip
_CONFIGURE_NODE_ID: Final = 0x11  # 255 would leave a drive without an identifier for its answers


@cache
def recorded() -> tuple[tuple[int, bytes], ...]:
    """Return the host's frames to one drive in the golden recording, addressed to this node."""
    found: dict[tuple[int, bytes], None] = {}
    with GOLDEN.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, can in reader.iter_decoded_messages():
            if channel.topic.startswith("/can/") and not can.extended and not can.remote:
                can_id = can.id & 0x780 | NODE if can.id & 0x7F and can.id > 0x100 else can.id
                found[can_id, bytes(can.data)] = None
    return tuple(found)


class Frames:
    """An endless supply of steps from one seed."""

    def __init__(self, seed: str, od: ObjectDictionary) -> None:
        self._dice = Random(seed)
        self._places = [(one.index, one.subindex, (one.bits + 7) // 8) for one in od]
        self._script: list[Step] = []
        self._makers = (
            *(self._download,) * 5,
            *(self._upload, self._transfer, self._transfer),
            *(self._controlword,) * 6,
            *(self._rpdo, self._rpdo, self._service, self._service, self._lss, self._noise),
            *(self._recorded,) * 3,
        )

    def take(self, count: int) -> Iterator[Step]:
        """Yield this many steps."""
        dice = self._dice
        for _ in range(count):
            if self._script:
                yield self._script.pop()
                continue
            pause = dice.choice(PAUSES_NS)
            chance = dice.random()
            if chance < 0.02:
                self._enable()
            elif chance < 0.025:
                name, value = dice.choice(PHYSICS)
                yield pause, -1, f"{name} {value}"
                continue
            can_id, data = dice.choice(self._makers)()
            if dice.random() < 0.15:
                can_id, data = self._mutated(can_id, data)
            if can_id == 0x7E5 and data[:2] == bytes((_CONFIGURE_NODE_ID, 0xFF)):
                continue
            yield pause, can_id, bytes(len(data)) if can_id & REMOTE else data

    def _enable(self) -> None:
        """Script the way to OPERATION ENABLED without faults, which few random runs would reach."""
        dice = self._dice
        steps: list[Step] = [(0, 0x000, bytes((0x01, NODE)))]
        steps.extend((0, -1, f"{name} {NORMAL.get(name, 0)}") for name in INPUTS)
        for word in (0x00, 0x80, 0x06, 0x07, 0x0F, dice.choice(WORDS)):
            by_pdo = dice.random() < 0.5
            data = word.to_bytes(2, "little")
            body = data if by_pdo else struct.pack("<BHB2s2x", 0x2B, 0x6040, 0, data)
            steps.append((21 * MS, (0x200 if by_pdo else 0x600) + NODE, body))
        self._script = steps[::-1]

    def _value(self, size: int) -> int:
        dice = self._dice
        value = dice.choice(INTERESTING) if dice.random() < 0.7 else dice.getrandbits(32)
        return value & (1 << 8 * size) - 1

    def _download(self) -> tuple[int, bytes]:
        index, subindex, size = self._dice.choice(self._places)
        if not 1 <= size <= 4:
            return self._transfer()
        head = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        return 0x600 + NODE, head + self._value(size).to_bytes(4, "little")

    def _upload(self) -> tuple[int, bytes]:
        index, subindex, _ = self._dice.choice(self._places)
        return 0x600 + NODE, struct.pack("<BHB4x", 0x40, index, subindex)

    def _transfer(self) -> tuple[int, bytes]:
        dice = self._dice
        index, subindex, _ = dice.choice(self._places)
        if dice.random() < 0.05:
            index, subindex = dice.getrandbits(16), dice.getrandbits(8)
        command = dice.choice(COMMANDS) if dice.random() < 0.9 else dice.getrandbits(8)
        return 0x600 + NODE, struct.pack("<BHBI", command, index, subindex, self._value(4))

    def _controlword(self) -> tuple[int, bytes]:
        return 0x200 + NODE, self._dice.choice(WORDS).to_bytes(2, "little")

    def _rpdo(self) -> tuple[int, bytes]:
        dice = self._dice
        word = dice.choice(WORDS) if dice.random() < 0.8 else dice.getrandbits(16)
        number, length = dice.randrange(4), dice.choice((2, 3, 4, 6, 6, 8))
        data = word.to_bytes(2, "little") + dice.randbytes(6)
        return 0x200 + 0x100 * number + NODE, data[:length]

    def _service(self) -> tuple[int, bytes]:
        """Return an NMT, SYNC, TIME or guarding frame, or another node's heartbeat or EMCY."""
        dice = self._dice
        which = dice.randrange(8)
        if which == 0:
            return 0x000, bytes((dice.choice(NMT), dice.choice((0, NODE, NODE, 6))))
        if which in (1, 2):
            return 0x080, dice.choice((b"", b"", bytes((dice.randrange(1, 241),))))
        if which == 3:
            return 0x100, dice.randbytes(6)
        if which == 4:
            return REMOTE | dice.choice((0x700, 0x180, 0x280, 0x080)) + NODE, b"\0"
        if which == 5:
            return 0x700 + dice.choice((1, 127)), bytes((dice.choice((0, 4, 5, 0x7F)),))
        if which == 6:
            return 0x080 + dice.randrange(1, 128), dice.randbytes(8)
        return dice.choice((0x180, 0x580, 0x680)) + dice.randrange(1, 128), dice.randbytes(8)

    def _lss(self) -> tuple[int, bytes]:
        dice = self._dice
        body = dice.choice((b"\0", b"\1", dice.randbytes(1)))
        return 0x7E5, (bytes((dice.choice(LSS),)) + body + dice.randbytes(6))[:8]

    def _noise(self) -> tuple[int, bytes]:
        dice = self._dice
        return dice.getrandbits(11), dice.randbytes(dice.randrange(9))

    def _recorded(self) -> tuple[int, bytes]:
        can_id, data = self._dice.choice(recorded())
        if can_id == 0x000 and data[:1] in (b"\x81", b"\x82") and self._dice.random() < 0.8:
            return 0x000, b"\x01\x00"  # a drive that reboots all the time receives nothing
        return can_id, data

    def _mutated(self, can_id: int, data: bytes) -> tuple[int, bytes]:
        """Return the frame with another length, bit or identifier, remote, or with 29 bits."""
        dice = self._dice
        which = dice.randrange(7)
        if which == 0:
            return can_id, data[: dice.randrange(9)]
        if which == 1:
            return can_id, (data + dice.randbytes(8))[:8]
        if which in (2, 3) and data:
            place = dice.randrange(8 * len(data))
            turned = int.from_bytes(data, "little") ^ 1 << place
            return can_id, turned.to_bytes(len(data), "little")
        if which == 4:
            return can_id ^ 1 << dice.randrange(11), data
        if which == 5:
            return can_id | REMOTE, bytes(len(data))
        return can_id | EXTENDED | dice.getrandbits(18) << 11, data


def frame(can_id: int, data: bytes) -> bytes:
    """Return a can_frame."""
    return struct.pack("<IB3x8s", can_id, len(data), b"" if can_id & REMOTE else data)


def line_of(step: Step) -> str:
    """Return the step as a line of text."""
    pause, can_id, what = step
    if not isinstance(what, bytes):
        return f"{pause} !{what}"
    number = can_id & 0x1FFF_FFFF
    head = f"{number:08X}" if can_id & EXTENDED else f"{number:03X}"
    return f"{pause} {head}#" + (f"R{len(what)}" if can_id & REMOTE else what.hex().upper())


def steps_in(lines: Sequence[str]) -> list[Step]:
    """Return the steps of a kept run; empty lines and lines with "//" are ignored."""
    steps: list[Step] = []
    for line in lines:
        pause, _, rest = line.strip().partition(" ")
        if not rest or line.startswith("//"):
            continue
        if rest.startswith("!"):
            steps.append((int(pause), -1, rest[1:]))
            continue
        head, _, tail = rest.partition("#")
        can_id = int(head, 16) | (EXTENDED if len(head) > 3 else 0)
        if tail.startswith("R"):
            steps.append((int(pause), can_id | REMOTE, bytes(int(tail[1:] or "0"))))
        else:
            steps.append((int(pause), can_id, bytes.fromhex(tail)))
    return steps
