"""PDO mapping (CiA 301, 7.4.7 and 7.5.2.36): variables in a PDO.

Practically all mappings can be expressed by `struct`. They are packed and unpacked by one
precompiled call on whole frames. Others (single bits, 24-bit integers) are processed bit by bit.
"""

import struct
from collections.abc import Callable
from typing import Final, final

from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.object_dictionary import (
    STRUCT_FORMAT,
    ObjectDictionary,
    Variable,
    decode,
    is_integer,
    is_signed,
    length_bits,
)

MAX_ENTRIES: Final = 64
MAX_BITS: Final = 64

_INTEGER_FORMAT: Final = {8: "b", 16: "h", 32: "i", 64: "q"}
_READABLE: Final = ("ro", "rw", "rwr", "const")  # access types that a TPDO may map
_WRITABLE: Final = ("wo", "rw", "rww")  # access types that an RPDO may map


def is_dummy(entry: int, od: ObjectDictionary) -> bool:
    """Return whether a mapping entry (index, sub-index, bits) only fills space in an RPDO."""
    index, subindex = entry >> 16, entry >> 8 & 0xFF
    return index in od.dummies and subindex == 0 and entry & 0xFF == length_bits(index)


def entry_refusal(od: ObjectDictionary, entry: int, receive: bool, any_length: bool = False) -> int:
    """Return the abort code for an invalid mapping entry, or 0.

    CiA 301, 7.5.2.36: an object that does not exist or cannot be mapped is refused with 0602 0000h
    or 0604 0041h. `any_length` accepts the mappings of some vendors: an object in more bits than
    its data type has (Roboteq: INTEGER16 in 32) or in fewer (Elmo: UNSIGNED64 in 32).
    """
    if receive and is_dummy(entry, od):
        return 0
    index, subindex = entry >> 16, entry >> 8 & 0xFF
    variable = od.get(index, subindex)
    if variable is None:
        if od.has_index(index):
            return AbortCode.NO_SUCH_SUBINDEX
        return AbortCode.NO_SUCH_OBJECT
    allowed = _WRITABLE if receive else _READABLE
    if not variable.pdo_mappable or variable.access not in allowed:
        return AbortCode.NOT_MAPPABLE
    length = entry & 0xFF
    fits = variable.bits == length or (any_length and is_integer(variable.data_type) and length)
    return 0 if fits else AbortCode.NOT_MAPPABLE


@final
class PdoMapping:
    """Mapped variables, prepared for whole frames. Entries without a variable are zeros.

    An entry longer than its variable is sign-extended, a shorter one holds the lower bits.

    Attributes:
        variables: the mapped ones, in order.
        length_bytes: of the PDO.
    """

    def __init__(self, entries: list[tuple[Variable | None, int]]) -> None:
        self.variables: tuple[Variable, ...] = tuple(
            variable for variable, _ in entries if variable is not None
        )
        self.keys: tuple[int, ...] = tuple(
            variable.index << 8 | variable.subindex for variable in self.variables
        )
        bits = sum(length for _, length in entries)
        if bits > MAX_BITS:
            raise ValueError(f"PDO mapping: {bits} bits do not fit; the limit is {MAX_BITS}")
        self.length_bytes: int = (bits + 7) // 8
        layout = _struct_layout(entries)
        self._is_packable = layout is not None
        self._is_unpackable = layout is not None and all(
            variable is None or variable.bits >= length for variable, length in entries
        )
        padding = f"{8 - self.length_bytes}x"
        self._reception = struct.Struct(f"<8x{layout or ''}")
        frame = struct.Struct(f"<IB3x{layout or '8x'}{padding if layout is not None else ''}")
        self._pack: Callable[..., bytes] = frame.pack
        self._raw_frame = struct.Struct("<IB3xQ")
        self._fields: list[tuple[Variable, int, int]] = []  # variable, offset, length [bit]
        offset = 0
        for variable, length in entries:
            if variable is not None:
                self._fields.append((variable, offset, length))
            offset += length

    def write(self, frame: bytes) -> None:
        """Write the frame's values to the variables; a refused value leaves its variable as is."""
        if not self._is_unpackable:
            self._write_bits(int.from_bytes(frame[8:16], "little"))
            return
        values: tuple[int | float, ...] = self._reception.unpack_from(frame)
        variables = self.variables
        for position, value in enumerate(values):
            if isinstance(value, int):
                variables[position].write_integer(value)
            else:
                variables[position].write(value)

    def build(self, can_id: int) -> bytes:
        """Return a frame with the current values of the variables."""
        if self._is_packable:
            try:
                if len(self.variables) == 2:  # the usual case: status and position
                    first, second = self.variables
                    return self._pack(can_id, self.length_bytes, first.read(), second.read())
                values = [variable.read() for variable in self.variables]
                return self._pack(can_id, self.length_bytes, *values)
            except struct.error:
                pass  # a reader's number exceeds its object: cut it below
        payload = 0
        for variable, offset, length in self._fields:
            value = variable.read()
            if not isinstance(value, int):
                value = int.from_bytes(variable.upload(), "little")
            payload |= (value & ((1 << length) - 1)) << offset
        return self._raw_frame.pack(can_id, self.length_bytes, payload)

    def _write_bits(self, payload: int) -> None:
        for variable, offset, length in self._fields:
            bits = min(length, variable.bits)
            number = payload >> offset & ((1 << bits) - 1)
            if not is_integer(variable.data_type):
                variable.write(decode(variable.data_type, number.to_bytes(bits // 8, "little")))
            elif is_signed(variable.data_type) and number >> (bits - 1):
                variable.write_integer(number - (1 << bits))
            else:
                variable.write_integer(number)


def _struct_layout(entries: list[tuple[Variable | None, int]]) -> str | None:
    """Return the `struct` format of the entries, or None if there is none."""
    layout = ""
    for variable, length in entries:
        if variable is None and length % 8 == 0:
            layout += f"{length // 8}x"
        elif variable is not None and variable.bits == length:
            if variable.data_type not in STRUCT_FORMAT:
                return None
            layout += STRUCT_FORMAT[variable.data_type]
        elif variable is not None and length in _INTEGER_FORMAT:
            letter = _INTEGER_FORMAT[length]
            layout += letter if is_signed(variable.data_type) else letter.upper()
        else:
            return None
    return layout


def stored_entries(od: ObjectDictionary, index: int) -> list[int]:
    """Return the entries of the mapping object that its sub-index 0 enables."""
    entries = [od.integer(index, sub, 0) for sub in od.subindices(index) if sub]
    return entries[: od.integer(index, 0, 0)]


def load(
    od: ObjectDictionary, index: int, receive: bool
) -> tuple[PdoMapping, list[tuple[int, int]]]:
    """Return the mapping in the dictionary, and (entry, abort code) of invalid entries.

    Invalid entries are filled with zeros, so that a vendor's power-on mapping is not refused as a
    whole. A mapping longer than a PDO is cut.
    """
    entries: list[tuple[Variable | None, int]] = []
    refused: list[tuple[int, int]] = []
    bits = 0
    for entry in stored_entries(od, index):
        code = entry_refusal(od, entry, receive, any_length=True)
        length = entry & 0xFF
        if bits + length > MAX_BITS:
            refused.append((entry, AbortCode.PDO_TOO_LONG))
            break
        bits += length
        if code:
            refused.append((entry, code))
        usable = code == 0 and not (receive and is_dummy(entry, od))
        entries.append((od.get(entry >> 16, entry >> 8 & 0xFF) if usable else None, length))
    return PdoMapping(entries), refused
