"""CAN frames built bit by bit, to check the bus.

No code is shared with the emulator: frames are given as fields, the CRC is the remainder of a long
division of the whole bit string, and stuffing looks for five equal bits.
Source: ISO 11898-1, frame formats, CRC sequence, bit stuffing.
"""

import re
from dataclasses import dataclass

from hypothesis import strategies as st

TAIL = "1" + "1" + "1" + "1111111"  # CRC delimiter, ACK slot (as sent), ACK delimiter, EOF
INTERMISSION = 3
_RUN = re.compile("00000|11111")
GENERATOR = 0b1100010110011001  # x15 + x14 + x10 + x8 + x7 + x4 + x3 + 1


@dataclass(frozen=True)
class Fields:
    """The fields of a classical frame."""

    identifier: int
    extended: bool
    remote: bool
    dlc: int
    data: bytes

    def can_frame(self) -> bytes:
        can_id = self.identifier | self.extended << 31 | self.remote << 30
        head = can_id.to_bytes(4, "little") + bytes([self.dlc, 0, 0, 0])
        return head + self.data + bytes(8 - len(self.data))


def arbitration_field(frame: Fields) -> str:
    """Return the first identifier bit to the last bit that distinguishes frames of two nodes."""
    remote = "1" if frame.remote else "0"
    if frame.extended:
        identifier = f"{frame.identifier:029b}"
        return identifier[:11] + "11" + identifier[11:] + remote  # SRR and IDE recessive
    return f"{frame.identifier:011b}" + remote + "0"  # IDE dominant


def unstuffed(frame: Fields) -> str:
    """Return start of frame to the end of the data field."""
    reserved = "00" if frame.extended else "0"
    data = "".join(f"{byte:08b}" for byte in frame.data)
    return "0" + arbitration_field(frame) + reserved + f"{frame.dlc:04b}" + data


def with_crc(bits: str) -> str:
    rest = int(bits, 2) << 15
    while rest.bit_length() > 15:
        rest ^= GENERATOR << (rest.bit_length() - 16)
    return bits + f"{rest:015b}"


def stuffed(bits: str) -> str:
    start = 0
    while (run := _RUN.search(bits, start)) is not None:
        start = run.end()  # position of the stuff bit, which may begin the next run
        bits = bits[:start] + ("1" if run[0][0] == "0" else "0") + bits[start:]
    return bits


def on_the_wire(frame: Fields) -> str:
    """Return every bit from start of frame to end of frame."""
    return stuffed(with_crc(unstuffed(frame))) + TAIL


# Data with and without stuffing: runs are essential for the state machine.
_BYTES = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0xC3, 0x3C, 0x1F, 0xE0, 0x83]) | st.integers(
    0, 255
)
_IDENTIFIERS_29 = st.sampled_from([0, 0x1FFFFFFF, 0x00FF00FF, 0x07C1F07C]) | st.integers(
    0, 2**29 - 1
)


@st.composite
def fields(draw: st.DrawFn) -> Fields:
    extended = draw(st.booleans())
    remote = draw(st.sampled_from([False, False, False, True]))
    identifier = draw(_IDENTIFIERS_29 if extended else st.integers(0, 0x7FF))
    data = bytes(draw(st.lists(_BYTES, max_size=8)))
    return Fields(identifier, extended, remote, len(data), b"" if remote else data)
