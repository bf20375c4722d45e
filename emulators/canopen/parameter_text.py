"""Text format of stored parameters, readable and protected by a CRC.

    motorhil parameters 1
    identity 00000000 00000402      vendor-ID and product code (1018h:1, 1018h:2)
    node_id 5                       if LSS has stored one; 255: none
    bit_timing 0                    its index in CiA 305's table 0
    1017:00 6400                    a value in its wire format
    end 1 1A2B3C4D                  number of values, and the CRC-32 of all lines before

A text that ends early, was changed by hand, or belongs to another device is refused as a whole.
"""

import zlib
from typing import Final, final

_FIRST: Final = "motorhil parameters 1"
UNSET: Final = -1
_NODE_IDS: Final = (*range(1, 128), 255)
_BIT_TIMING_MAX: Final = 9  # CiA 305's table 0


@final
class StoredParameters:
    """The parameters that a device has stored.

    Attributes:
        identity: vendor-ID and product code.
        values: (index << 8 | sub-index) -> bytes as on the wire, in order of their places.
        node_id, bit_timing: set by LSS; UNSET if not stored.
    """

    def __init__(self, identity: tuple[int, int]) -> None:
        self.identity = identity
        self.values: dict[int, bytes] = {}
        self.node_id: int = UNSET
        self.bit_timing: int = UNSET

    def write(self) -> bytes:
        """Return the parameters as text."""
        lines = [_FIRST, self._identity()]
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
        """Read all parameters from the text; return "", or the reason of a refusal."""
        lines = data.decode("latin-1").splitlines()
        if not lines or lines[0] != _FIRST:
            return f"it does not begin with {_FIRST!r}"
        last = lines[-1].split(" ")
        checked = data[: data.rfind(b"end ")]
        if last[0] != "end" or len(last) != 3 or not data.endswith(b"\n"):
            return "it ends early"
        if last[2] != f"{zlib.crc32(checked):08X}":
            return "it is damaged, or was changed by hand (its CRC is wrong)"
        identity = self._identity()
        if len(lines) < 3 or lines[1] != identity:
            return f"it is another device's: {lines[1]!r}, here {identity!r}"
        for line in lines[2:-1]:
            try:
                self._read_line(line)
            except ValueError:
                return f"{line!r} in it is no stored value"
        return ""

    def begins(self, data: bytes) -> bool:
        """Return whether the text is this device's, as far as it goes: whole, torn or empty.

        Some file systems leave zeros after a power failure during a write.
        """
        first = f"{_FIRST}\n{self._identity()}\n".encode()
        return data.startswith(first) or first.startswith(data) or not data.strip(b"\0")

    def _identity(self) -> str:
        return f"identity {self.identity[0]:08X} {self.identity[1]:08X}"

    def _read_line(self, line: str) -> None:
        """Read one of the lines between header and end.

        Raises:
            ValueError: the line is malformed.
        """
        key, _, value = line.partition(" ")
        if key == "node_id":
            self.node_id = int(value)
            if self.node_id not in _NODE_IDS:
                raise ValueError(value)
        elif key == "bit_timing":
            self.bit_timing = int(value)
            if not UNSET < self.bit_timing < _BIT_TIMING_MAX:
                raise ValueError(value)
        else:
            index, _, subindex = key.partition(":")
            self.values[int(index, 16) << 8 | int(subindex, 16)] = bytes.fromhex(value)
