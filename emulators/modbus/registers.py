"""Registers of a controller: a table of rows, with readers and writers.

The table is data (`Register` rows): it can be printed, checked and extended. Behaviour is attached
by name: a *reader* returns the current value, a *writer* receives a new value and may refuse it. A
row without either keeps the written value.

A row of 32 bit is two registers, the upper half first. One request reads both halves at one
instant. Two requests read them at two instants, as in any controller with a changing value.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from motorhil.emulators.modbus.codes import ILLEGAL_DATA_VALUE, OK

Reader = Callable[[], int]
"""A function that returns the current value of a register, in its own type."""
Writer = Callable[[int], int]
"""A function that receives a value within the row's limits; returns 0 or an exception code."""


@final
class Kind(Enum):
    """The type of a row: two's complement where signed, upper register first."""

    U16 = "u16"
    I16 = "i16"
    U32 = "u32"
    I32 = "i32"


@final
class Access(Enum):
    """The access of a client to a row."""

    READ = "r"
    WRITE = "w"
    READ_WRITE = "rw"


_WORDS: Final = {Kind.U16: 1, Kind.I16: 1, Kind.U32: 2, Kind.I32: 2}
_SIGNED: Final = (Kind.I16, Kind.I32)


@final
@dataclass(frozen=True, slots=True)
class Register:
    """One row of a register map.

    Attributes:
        address: of its first register, as in the PDU: 0 to FFFFh.
        name: its unique name, for code and users.
        kind: the type of its bits.
        unit: of the number in it ("ms", "0.1 A"; "" for a code).
        access: the access of a client.
        behaviour: its effect, in words.
        default: the power-on value.
        low, high: limits of written values; None: those of the kind.
    """

    address: int
    name: str
    kind: Kind = Kind.U16
    unit: str = ""
    access: Access = Access.READ_WRITE
    behaviour: str = ""
    default: int = 0
    low: int | None = None
    high: int | None = None

    @property
    def words(self) -> int:
        """The number of registers, 1 or 2."""
        return _WORDS[self.kind]


@final
class _Cell:
    """The state of a row."""

    def __init__(self, row: Register) -> None:
        bits = 16 * row.words
        signed = row.kind in _SIGNED
        lowest = -(1 << (bits - 1)) if signed else 0
        highest = (1 << (bits - 1 if signed else bits)) - 1
        self.row = row
        self.address = row.address
        self.is_wide = row.words == 2
        self.is_readable = row.access is not Access.WRITE
        self.is_writable = row.access is not Access.READ
        self.low = lowest if row.low is None else row.low
        self.high = highest if row.high is None else row.high
        self.sign = 1 << (bits - 1) if signed else 0
        self.span = 1 << bits
        self.mask = self.span - 1
        self.default = row.default
        self.value = row.default
        self.reader: Reader | None = None
        self.writer: Writer | None = None
        if not lowest <= self.low <= row.default <= self.high <= highest:
            raise ValueError(
                f"register {row.name}: default {row.default}, limits {self.low} to {self.high}:"
                f" {row.kind.value} holds {lowest} to {highest}"
            )

    def signed(self, raw: int) -> int:
        """Return the number that these bits represent."""
        return raw - self.span if raw & self.sign else raw


@final
class RegisterBank:
    """The registers of one table of a server: holding registers, or input registers.

    Args:
        rows: in any order, with unique addresses and names.

    Raises:
        ValueError: two rows share an address or a name, or a row does not fit its kind.
    """

    def __init__(self, rows: Sequence[Register]) -> None:
        self._cells: dict[int, _Cell] = {}
        self._named: dict[str, _Cell] = {}
        for row in sorted(rows, key=_address_of):
            cell = _Cell(row)
            if row.name in self._named:
                raise ValueError(f"register {row.name}: name already used; expected a unique name")
            self._named[row.name] = cell
            for address in range(row.address, row.address + row.words):
                if not 0 <= address <= 0xFFFF:
                    raise ValueError(
                        f"register {row.name}: address {address:X}h is out of "
                        "range; expected 0 to FFFFh"
                    )
                other = self._cells.get(address)
                if other is not None:
                    raise ValueError(
                        f"registers {row.name} and {other.row.name}: both at address {address:04X}h"
                    )
                self._cells[address] = cell

    # ---- the controller's side ----

    def rows(self) -> list[Register]:
        """Return the rows, by address."""
        return [cell.row for cell in self._named.values()]

    def on_read(self, name: str, reader: Reader) -> None:
        """Attach a function that returns the register's value."""
        self._named[name].reader = reader

    def on_write(self, name: str, writer: Writer) -> None:
        """Attach a function that receives written values and may refuse them."""
        self._named[name].writer = writer

    def __getitem__(self, name: str) -> int:
        """Return the value of the register."""
        return self._named[name].value

    def __setitem__(self, name: str, value: int) -> None:
        """Set the value of the register without calling its writer."""
        self._named[name].value = value

    def set_defaults(self) -> None:
        """Set all registers to their power-on values without calling writers."""
        for cell in self._named.values():
            cell.value = cell.default

    def set_default(self, key: str, value: int) -> None:
        """Set the power-on value and the present value of a register.

        Args:
            key: its name, or its address in hex ("6200h").
            value: within its limits.

        Raises:
            KeyError: the register does not exist.
            ValueError: the value exceeds the register's limits.
        """
        cell = self._named.get(key)
        if cell is None and key[-1:] in "hH" and len(key) == 5:
            cell = self._cells.get(int(key[:4], 16)) if _is_hex(key[:4]) else None
        if cell is None:
            raise KeyError(key)
        if not cell.low <= value <= cell.high:
            raise ValueError(f"{cell.row.name} is {cell.low} to {cell.high}, not {value}")
        cell.default = cell.value = value

    def forget_kept(self) -> None:
        """Reset the power-on values to those of the rows."""
        for cell in self._named.values():
            cell.default = cell.row.default

    def keep(self, names: Sequence[str]) -> None:
        """Make the present values of these registers their power-on values."""
        for name in names:
            cell = self._named[name]
            cell.default = cell.value

    # ---- the client's side ----

    def can_read(self, address: int, count: int) -> bool:
        """Return whether all these registers exist and are readable."""
        cells = self._cells
        for place in range(address, address + count):
            cell = cells.get(place)
            if cell is None or not cell.is_readable:
                return False
        return True

    def can_write(self, address: int, count: int) -> bool:
        """Return whether all these registers exist and are writable."""
        cells = self._cells
        for place in range(address, address + count):
            cell = cells.get(place)
            if cell is None or not cell.is_writable:
                return False
        return True

    def read(self, address: int, count: int) -> bytes:
        """Return the current content of the registers, two bytes each; requires `can_read`."""
        cells = self._cells
        packed = 0  # one number, since each piece of bytes would cost a call
        end = address + count
        while address < end:
            cell = cells[address]
            raw = (cell.value if cell.reader is None else cell.reader()) & cell.mask
            if not cell.is_wide:
                packed = packed << 16 | raw
                address += 1
            elif address == cell.address and address + 1 < end:
                packed = packed << 32 | raw
                address += 2
            else:  # half of it
                packed = packed << 16 | (raw >> 16 if address == cell.address else raw & 0xFFFF)
                address += 1
        return packed.to_bytes(2 * count, "big")

    def write(self, address: int, data: bytes) -> int:
        """Write the registers in the order of their addresses; requires `can_write`.

        All values are checked before the first is stored. A writer may still refuse; the values
        before it have been written then.

        Returns:
            0, or the exception code.
        """
        pending: list[tuple[_Cell, int]] = []
        at = 0
        while at < len(data):
            cell = self._cells[address]
            if not cell.is_wide:
                raw = int.from_bytes(data[at : at + 2], "big")
                words = 1
            else:
                first = address - cell.address
                words = min(2 - first, (len(data) - at) // 2)
                both = (cell.value & cell.mask).to_bytes(4, "big")
                part = data[at : at + 2 * words]
                both = both[: 2 * first] + part + both[2 * (first + words) :]
                raw = int.from_bytes(both, "big")
            value = cell.signed(raw)
            if not cell.low <= value <= cell.high:
                return ILLEGAL_DATA_VALUE
            pending.append((cell, value))
            at += 2 * words
            address += words
        for cell, value in pending:
            if cell.writer is not None:
                refused = cell.writer(value)
                if refused:
                    return refused
            cell.value = value
        return OK


@final
class BitBank:
    """The coils, or the discrete inputs, of a server: bits at consecutive addresses from 0.

    Args:
        names: of each bit, by address.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names: Final = tuple(names)
        self.values: list[bool] = [False] * len(names)
        self._writers: dict[int, Callable[[bool], int]] = {}

    def on_write(self, name: str, writer: Callable[[bool], int]) -> None:
        """Attach a function that receives written bits; it returns 0 or an exception code."""
        self._writers[self.names.index(name)] = writer

    def has(self, address: int, count: int) -> bool:
        """Return whether these bits exist."""
        return address + count <= len(self.values)

    def read(self, address: int, count: int) -> bytes:
        """Return the bits, the first one lowest in the first byte; unused bits are 0."""
        packed = 0
        for place, value in enumerate(self.values[address : address + count]):
            packed |= value << place
        return packed.to_bytes((count + 7) // 8, "little")

    def write(self, address: int, count: int, data: bytes) -> int:
        """Write the bits and return 0, or the exception code."""
        packed = int.from_bytes(data, "little")
        for place in range(count):
            value = bool(packed >> place & 1)
            writer = self._writers.get(address + place)
            if writer is not None:
                refused = writer(value)
                if refused:
                    return refused
            self.values[address + place] = value
        return OK


def _address_of(row: Register) -> int:
    return row.address


def _is_hex(text: str) -> bool:
    return all(letter in "0123456789ABCDEFabcdef" for letter in text)
