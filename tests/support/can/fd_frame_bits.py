"""CAN FD frames built bit by bit, as `wire` does.

Strings of bits; the CRC is the remainder of a long division of the whole string, with the initial
value of the register as a term of the dividend.
Source: ISO 11898-1:2015, frame formats, CRC, bit stuffing.
"""

from dataclasses import dataclass
from random import Random

from hypothesis import strategies as st

from tests.support.can.frame_bits import INTERMISSION, TAIL, stuffed

LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
GENERATOR_17 = 0b11_0110_1000_0101_1011  # x17 x16 x14 x13 x11 x6 x4 x3 x 1
GENERATOR_21 = 0b11_0000_0010_1000_1001_1001  # x21 x20 x13 x11 x7 x4 x3 1
STUFF_COUNTS = ["0000", "0011", "0110", "0101", "1100", "1111", "1010", "1001"]


@dataclass(frozen=True)
class FdFields:
    """The fields of a CAN FD frame."""

    identifier: int
    extended: bool
    brs: bool
    esi: bool
    data: bytes

    def can_frame(self) -> bytes:
        can_id = self.identifier | self.extended << 31
        flags = self.brs | self.esi << 1 | 4
        head = can_id.to_bytes(4, "little") + bytes([len(self.data), flags, 0, 0])
        return head + self.data + bytes(64 - len(self.data))


def header(frame: FdFields) -> str:
    """Return start of frame to BRS."""
    if frame.extended:
        identifier = f"{frame.identifier:029b}"
        return "0" + identifier[:11] + "11" + identifier[11:] + "0" + "10" + f"{frame.brs:b}"
    return "0" + f"{frame.identifier:011b}" + "00" + "10" + f"{frame.brs:b}"


def remainder(bits: str, generator: int, first: int) -> int:
    """Return the remainder of the shifted bits; `first` is the initial register value."""
    width = generator.bit_length() - 1
    rest = int(bits, 2) << width ^ first << len(bits)
    while rest.bit_length() > width:
        rest ^= generator << rest.bit_length() - 1 - width
    return rest


def dynamically_stuffed(frame: FdFields) -> str:
    """Return start of frame to the end of the data; no stuff bit follows the last."""
    rest = f"{frame.esi:b}{LENGTHS.index(len(frame.data)):04b}"
    if frame.data:
        rest += f"{int.from_bytes(frame.data, 'big'):0{8 * len(frame.data)}b}"
    bits = header(frame) + rest
    return stuffed(bits[:-1]) + bits[-1]


def stuff_bits(frame: FdFields, sent: str) -> int:
    """Return the number of dynamic stuff bits up to the end of the data."""
    return len(sent) - (41 if frame.extended else 22) - 8 * len(frame.data)


def checks(frame: FdFields, sent: str, divide: bool = True) -> str:
    """Return stuff count and CRC after the data, without fixed stuff bits.

    `divide=False` gives 0s in place of the CRC, for counting bits only.
    """
    count = STUFF_COUNTS[stuff_bits(frame, sent) % 8]
    if not divide:
        return count + "0" * (17 if len(frame.data) <= 16 else 21)
    if len(frame.data) <= 16:
        return count + f"{remainder(sent + count, GENERATOR_17, 1 << 16):017b}"
    return count + f"{remainder(sent + count, GENERATOR_21, 1 << 20):021b}"


def on_the_wire(frame: FdFields, divide: bool = True) -> str:
    """Return every bit from start of frame to end of frame."""
    sent = dynamically_stuffed(frame)
    field = checks(frame, sent, divide)
    for start in range(0, len(field), 4):
        sent += ("0" if sent[-1] == "1" else "1") + field[start : start + 4]
    return sent + TAIL


def takes_protocol_exception(heard: str) -> bool:
    """Return whether a CAN FD node that hears these levels meets FDF and res both recessive.

    It takes them for a format of the future and waits for an idle bus, without an error flag.
    Source: ISO 11898-1:2015, protocol exception event.
    """
    header = run = ""
    for level in heard.lstrip("1"):
        if len(run) == 5:
            if level in run:
                break
            run = level
            continue
        run = run + level if level in run else level
        header += level
    fdf = 33 if header[13:14] == "1" else 14
    return header[fdf : fdf + 2] == "11"


def data_phase(frame: FdFields, divide: bool = True) -> tuple[int, int]:
    """Return the first bit that counts as one at the data rate, and the first one after them.

    BRS and CRC delimiter are sent at both rates, and together last one bit of each: the former
    counts as nominal.
    """
    if not frame.brs:
        return 0, 0
    end = len(on_the_wire(frame, divide)) - len(TAIL) + 1
    return len(stuffed(header(frame)[:-1]) + "?"), end


def phases(frame: FdFields, divide: bool = True) -> tuple[int, int]:
    """Return (bits at the nominal rate, bits at the data rate), intermission included."""
    whole = len(on_the_wire(frame, divide)) + INTERMISSION
    if not frame.brs:
        return whole, 0
    nominal = len(stuffed(header(frame)[:-1]) + "?") + len(TAIL) - 1 + INTERMISSION
    return nominal, whole - nominal


_BYTES = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0xC3, 0x3C, 0x1F, 0xE0]) | st.integers(0, 255)


@st.composite
def fd_fields(draw: st.DrawFn) -> FdFields:
    extended = draw(st.booleans())
    identifier = draw(st.integers(0, 2**29 - 1 if extended else 0x7FF))
    length = draw(st.sampled_from(LENGTHS))
    data = bytes(draw(st.lists(_BYTES, min_size=length, max_size=length)))
    return FdFields(identifier, extended, draw(st.booleans()), draw(st.booleans()), data)


_RUNS = (0x00, 0xFF, 0x0F, 0xF0, 0xC3, 0x3C, 0x1F, 0xE0, 0x83, 0x78, 0x87, 0x55)
_IDENTIFIERS = (0, 0x1FFFFFFF, 0x00FF00FF, 0x07C1F07C, 0x15555555, 0x1555BFFF, 0x78)


def random_fd_fields(random: Random) -> FdFields:
    """Return one of a seed's frames; most have runs, which stuffing depends on."""
    extended = random.random() < 0.5
    identifier = random.choice(_IDENTIFIERS) if random.random() < 0.4 else random.getrandbits(29)
    length = random.choice(LENGTHS)
    kind = random.random()
    if kind < 0.3:
        data = random.randbytes(length)
    elif kind < 0.6:
        data = bytes([random.choice(_RUNS)]) * length
    else:
        data = bytes(random.choices(_RUNS, k=length))
    identifier &= 0x1FFFFFFF if extended else 0x7FF
    return FdFields(identifier, extended, random.random() < 0.8, random.random() < 0.3, data)
