"""A controller's registers: one table that says what there is, and what stands behind each row.

The table is data (`Register` rows): it can be printed, checked and extended. What a register does
is attached to it by name: a *reader* gives its value now, a *writer* is told a new one and may
refuse it. A row without either keeps what is written to it.

A row of 32 bit is two registers, the upper half first. In one request it is read at one instant; in
two requests its halves are of two instants, as in any controller whose value moves meanwhile.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.modbus.codes import ILLEGAL_DATA_VALUE, OK

Reader = Callable[[], int]
"""The value of a register now, in its own type."""
Writer = Callable[[int], int]
"""Told a new value within the row's limits; 0, or the exception code that refuses it."""


@final
class Kind(Enum):
    """What the bits of a row mean: two's complement where signed, upper register first."""

    U16 = "u16"
    I16 = "i16"
    U32 = "u32"
    I32 = "i32"


@final
class Access(Enum):
    """What a client may do with a row."""

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
        name: what code and people call it; no two of a map are alike.
        kind: what its bits mean.
        unit: of the number in it ("ms", "0.1 A"; "" where it is a code).
        access: what a client may do.
        behaviour: what it does, in words.
        default: at power-on.
        low, high: limits of what may be written; None: those of the kind.
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
        """How many registers it takes: 1 or 2."""
        return _WORDS[self.kind]


@final
class _Cell:
    """A row at work."""

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
        self.default = row.default
        self.value = row.default
        self.reader: Reader | None = None
        self.writer: Writer | None = None
        if not lowest <= self.low <= row.default <= self.high <= highest:
            raise ValueError(
                f"register {row.name}: default {row.default}, limits {self.low} to {self.high}:"
                f" {row.kind.value} holds {lowest} to {highest}"
            )

    def raw(self) -> int:
        """Its bits now, without sign."""
        value = self.value if self.reader is None else self.reader()
        return value & (self.span - 1)

    def signed(self, raw: int) -> int:
        """The number that these bits are."""
        return raw - self.span if raw & self.sign else raw


@final
class RegisterBank:
    """The registers of one table of a server: holding registers, or input registers.

    Args:
        rows: in any order; no two may share an address or a name.

    Raises:
        ValueError: two do, or a row does not fit its kind.
    """

    def __init__(self, rows: Sequence[Register]) -> None:
        self._cells: dict[int, _Cell] = {}
        self._named: dict[str, _Cell] = {}
        for row in sorted(rows, key=_address_of):
            cell = _Cell(row)
            if row.name in self._named:
                raise ValueError(f"two registers are called {row.name}")
            self._named[row.name] = cell
            for address in range(row.address, row.address + row.words):
                if not 0 <= address <= 0xFFFF:
                    raise ValueError(f"register {row.name}: address {address:X}h, FFFFh at most")
                other = self._cells.get(address)
                if other is not None:
                    raise ValueError(f"{row.name} and {other.row.name} are both at {address:04X}h")
                self._cells[address] = cell

    # ---- the controller's side ----

    def rows(self) -> list[Register]:
        """The table, by address."""
        return [cell.row for cell in self._named.values()]

    def on_read(self, name: str, reader: Reader) -> None:
        """The register's value is what `reader` says."""
        self._named[name].reader = reader

    def on_write(self, name: str, writer: Writer) -> None:
        """`writer` is told what is written to the register, and may refuse it."""
        self._named[name].writer = writer

    def __getitem__(self, name: str) -> int:
        """What the register holds."""
        return self._named[name].value

    def __setitem__(self, name: str, value: int) -> None:
        """The register holds this; nobody is told."""
        self._named[name].value = value

    def set_defaults(self) -> None:
        """Every register holds what it does at power-on; nobody is told."""
        for cell in self._named.values():
            cell.value = cell.default

    def set_default(self, key: str, value: int) -> None:
        """The register holds this at power-on, and now.

        Args:
            key: its name, or its address in hex ("6200h").
            value: within its limits.

        Raises:
            KeyError: there is no such register.
            ValueError: it cannot hold the value.
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
        """At power-on every register holds what its row says."""
        for cell in self._named.values():
            cell.default = cell.row.default

    def keep(self, names: Sequence[str]) -> None:
        """What these hold now they hold at power-on, too."""
        for name in names:
            cell = self._named[name]
            cell.default = cell.value

    # ---- the client's side ----

    def can_read(self, address: int, count: int) -> bool:
        """Whether there are such registers, all to be read."""
        cells = self._cells
        for place in range(address, address + count):
            cell = cells.get(place)
            if cell is None or not cell.is_readable:
                return False
        return True

    def can_write(self, address: int, count: int) -> bool:
        """Whether there are such registers, all to be written."""
        cells = self._cells
        for place in range(address, address + count):
            cell = cells.get(place)
            if cell is None or not cell.is_writable:
                return False
        return True

    def read(self, address: int, count: int) -> bytes:
        """The registers' content now, two bytes each; `can_read` holds."""
        cells = self._cells
        out = bytearray()
        end = address + count
        while address < end:
            cell = cells[address]
            raw = cell.raw()
            if not cell.is_wide:
                out += raw.to_bytes(2, "big")
                address += 1
                continue
            both = raw.to_bytes(4, "big")
            first = 2 * (address - cell.address)
            last = min(4, first + 2 * (end - address))
            out += both[first:last]
            address += (last - first) // 2
        return bytes(out)

    def write(self, address: int, data: bytes) -> int:
        """The registers hold this, in the order of their addresses; `can_write` holds.

        Every value is looked at before the first is stored. A writer may still refuse: what stands
        before it has been written then.

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
                both = (cell.value & (cell.span - 1)).to_bytes(4, "big")
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
        self.values = [False] * len(names)
        self._writers: dict[int, Callable[[bool], int]] = {}

    def on_write(self, name: str, writer: Callable[[bool], int]) -> None:
        """`writer` is told what is written to the bit: 0, or the exception code that refuses it."""
        self._writers[self.names.index(name)] = writer

    def has(self, address: int, count: int) -> bool:
        """Whether there are such bits."""
        return address + count <= len(self.values)

    def read(self, address: int, count: int) -> bytes:
        """The bits, the first one lowest in the first byte; what is left of the last byte is 0."""
        packed = 0
        for place, value in enumerate(self.values[address : address + count]):
            packed |= value << place
        return packed.to_bytes((count + 7) // 8, "little")

    def write(self, address: int, count: int, data: bytes) -> int:
        """The bits are these. Returns 0, or the exception code."""
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
