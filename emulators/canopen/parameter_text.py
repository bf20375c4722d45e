"""How stored parameters are written: lines that a person can read, and that cannot be mistaken.

    motorhil parameters 1
    identity 00000000 00000402      vendor-ID and product code (1018h:1, 1018h:2)
    node_id 5                       where LSS has stored one; 255: none
    bit_timing 0                    its index in CiA 305's table 0
    1017:00 6400                    a value as it goes over the wire
    end 1 1A2B3C4D                  how many values, and the CRC-32 of all lines before

A text that ends early, was changed by hand, or is another device's is refused as a whole.
"""

import zlib
from typing import Final, final

_FIRST: Final = "motorhil parameters 1"
UNSET: Final = -1


@final
class StoredParameters:
    """What a device has stored.

    Attributes:
        identity: vendor-ID and product code.
        values: (index << 8 | sub-index) -> bytes as on the wire, in order of their places.
        node_id, bit_timing: by LSS; UNSET where it has stored none.
    """

    def __init__(self, identity: tuple[int, int]) -> None:
        self.identity = identity
        self.values: dict[int, bytes] = {}
        self.node_id: int = UNSET
        self.bit_timing: int = UNSET

    def write(self) -> bytes:
        """The text."""
        lines = [_FIRST, f"identity {self.identity[0]:08X} {self.identity[1]:08X}"]
        if self.node_id != UNSET:
            lines.append(f"node_id {self.node_id}")
        if self.bit_timing != UNSET:
            lines.append(f"bit_timing {self.bit_timing}")
        for place in sorted(self.values):
            value = self.values[place].hex().upper()
            lines.append(f"{place >> 8:04X}:{place & 0xFF:02X} {value}")
        text = "\n".join(lines) + "\n"
        return f"{text}end {len(self.values)} {zlib.crc32(text.encode()):08X}\n".encode()

    def read(self, data: bytes) -> str:
        """All is what the text says: "", or why nothing is."""
        lines = data.decode("latin-1").splitlines()
        if not lines or lines[0] != _FIRST:
            return f"it does not begin with {_FIRST!r}"
        last = lines[-1].split(" ")
        checked = data[: data.rfind(b"end ")]
        if last[0] != "end" or len(last) != 3 or not data.endswith(b"\n"):
            return "it ends early"
        if last[2] != f"{zlib.crc32(checked):08X}":
            return "it is damaged, or was changed by hand (its CRC is wrong)"
        identity = f"identity {self.identity[0]:08X} {self.identity[1]:08X}"
        if len(lines) < 3 or lines[1] != identity:
            return f"it is another device's: {lines[1]!r}, here {identity!r}"
        for line in lines[2:-1]:
            key, _, value = line.partition(" ")
            if key == "node_id":
                self.node_id = int(value)
            elif key == "bit_timing":
                self.bit_timing = int(value)
            else:
                index, _, subindex = key.partition(":")
                self.values[int(index, 16) << 8 | int(subindex, 16)] = bytes.fromhex(value)
        return ""
