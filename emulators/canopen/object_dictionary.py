"""The object dictionary (CiA 301, 7.4): variables by index and sub-index.

A `Variable` is one sub-index. Values are Python ints (BOOLEAN, INTEGERn, UNSIGNEDn, times), floats
(REAL32, REAL64) or bytes (strings, DOMAIN). On the wire all numbers are little-endian and signed
ones are two's complement. The device behind the dictionary attaches two callbacks: a `reader`
returns a current value, a `writer` accepts or refuses a new value.

`DictionaryAccess` is the access of a client, with abort codes. The SDO server uses it.
"""

import struct
from collections.abc import Callable, Iterator
from enum import IntEnum, unique
from typing import Final, Protocol, final

from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.outbox import NodeHost

Value = int | float | bytes
Reader = Callable[[], int]
Writer = Callable[[int], int]

_ACCESS: Final = ("ro", "wo", "rw", "rwr", "rww", "const")


@final
@unique
class DataType(IntEnum):
    """The basic data types and their index in the dictionary (CiA 301, table 44)."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    UNICODE_STRING = 0x0B
    TIME_OF_DAY = 0x0C
    TIME_DIFFERENCE = 0x0D
    DOMAIN = 0x0F
    INTEGER24 = 0x10
    REAL64 = 0x11
    INTEGER40 = 0x12
    INTEGER48 = 0x13
    INTEGER56 = 0x14
    INTEGER64 = 0x15
    UNSIGNED24 = 0x16
    UNSIGNED40 = 0x18
    UNSIGNED48 = 0x19
    UNSIGNED56 = 0x1A
    UNSIGNED64 = 0x1B


_D = DataType

# Whole numbers: data type -> (length in bits, signed).
_INTEGERS: Final[dict[int, tuple[int, bool]]] = {
    _D.BOOLEAN: (1, False),
    _D.INTEGER8: (8, True),
    _D.INTEGER16: (16, True),
    _D.INTEGER24: (24, True),
    _D.INTEGER32: (32, True),
    _D.INTEGER40: (40, True),
    _D.INTEGER48: (48, True),
    _D.INTEGER56: (56, True),
    _D.INTEGER64: (64, True),
    _D.UNSIGNED8: (8, False),
    _D.UNSIGNED16: (16, False),
    _D.UNSIGNED24: (24, False),
    _D.UNSIGNED32: (32, False),
    _D.UNSIGNED40: (40, False),
    _D.UNSIGNED48: (48, False),
    _D.UNSIGNED56: (56, False),
    _D.UNSIGNED64: (64, False),
    _D.TIME_OF_DAY: (48, False),
    _D.TIME_DIFFERENCE: (48, False),
}
# Whole numbers: data type -> (smallest value, largest value).
_RANGES: Final[dict[int, tuple[int, int]]] = {
    data_type: (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    for data_type, (bits, signed) in _INTEGERS.items()
}
_REALS: Final[dict[int, tuple[int, struct.Struct]]] = {
    _D.REAL32: (32, struct.Struct("<f")),
    _D.REAL64: (64, struct.Struct("<d")),
}
# `struct` format characters of data types with a power-of-two number of whole bytes.
STRUCT_FORMAT: Final[dict[int, str]] = {
    _D.INTEGER8: "b",
    _D.INTEGER16: "h",
    _D.INTEGER32: "i",
    _D.INTEGER64: "q",
    _D.UNSIGNED8: "B",
    _D.UNSIGNED16: "H",
    _D.UNSIGNED32: "I",
    _D.UNSIGNED64: "Q",
    _D.REAL32: "f",
    _D.REAL64: "d",
}


def length_bits(data_type: int) -> int:
    """Return the length of a data type [bit]; 0 if it varies (strings, DOMAIN)."""
    if data_type in _INTEGERS:
        return _INTEGERS[data_type][0]
    return _REALS[data_type][0] if data_type in _REALS else 0


def is_integer(data_type: int) -> bool:
    """Return whether values of this data type are ints here."""
    return data_type in _INTEGERS


def is_signed(data_type: int) -> bool:
    """Return whether the data type is a two's complement INTEGERn."""
    return data_type in _INTEGERS and _INTEGERS[data_type][1]


def integer_range(data_type: int) -> tuple[int, int]:
    """Return the smallest and the largest value of a whole-number data type."""
    return _RANGES[data_type]


def zero(data_type: int) -> Value:
    """Return the neutral value of this data type: 0, 0.0 or no bytes."""
    if data_type in _INTEGERS:
        return 0
    return 0.0 if data_type in _REALS else b""


def encode(data_type: int, value: Value) -> bytes:
    """Return the value in its wire format.

    Raises:
        TypeError: the value is not of the Python type of `data_type`.
        ValueError: the value does not fit.
    """
    if isinstance(value, bytes):
        if length_bits(data_type) != 0:
            raise TypeError(f"data type {data_type:02X}h holds a number, not {value!r}")
        return value
    if data_type in _INTEGERS:
        if not isinstance(value, int):
            raise TypeError(f"data type {data_type:02X}h holds whole numbers, not {value!r}")
        low, high = _RANGES[data_type]
        if not low <= value <= high:
            raise ValueError(f"{value} does not fit data type {data_type:02X}h ({low}..{high})")
        bits, signed = _INTEGERS[data_type]
        return value.to_bytes((bits + 7) // 8, "little", signed=signed)
    if data_type not in _REALS:
        raise TypeError(f"data type {data_type:02X}h holds bytes, not {value!r}")
    try:
        return _REALS[data_type][1].pack(value)
    except OverflowError as error:
        raise ValueError(f"{value} does not fit data type {data_type:02X}h") from error


def decode(data_type: int, data: bytes) -> Value:
    """Return the value in these wire bytes.

    Raises:
        ValueError: the number of bytes is not the data type's.
    """
    bits = length_bits(data_type)
    if bits == 0:
        return data
    if len(data) != (bits + 7) // 8:
        raise ValueError(f"data type {data_type:02X}h takes {(bits + 7) // 8} bytes, not {data!r}")
    if data_type in _REALS:
        number: float = _REALS[data_type][1].unpack(data)[0]
        return number
    value = int.from_bytes(data, "little", signed=_INTEGERS[data_type][1])
    return value if bits > 1 else value & 1


@final
class Variable:
    """A sub-index: a value, its access rights and its callbacks.

    Attributes:
        index, subindex, name, data_type, access: as in an EDS (access in lower case).
        pdo_mappable: may be mapped into PDOs; RPDOs take writable, TPDOs readable variables.
        low, high: limits of a whole number, both inclusive; None: only the data type limits.
        default: the power-on value. `has_default`: it was stated, not made up here.
        follows_node_id: another node-ID changes the default by as much ($NODEID).
        value: the present value; with a `reader` the last written value only.
        reader: returns the current value of a whole number.
        writer: called with every new value of a whole number that passed the range checks, by SDO
            and by PDO. The writer returns 0, and the value is stored, or an abort code, and nothing
            changes. The writer may use `value`, which still is the old one.
    """

    def __init__(
        self,
        index: int,
        subindex: int,
        data_type: int,
        name: str = "",
        access: str = "rw",
        pdo_mappable: bool = False,
        limits: tuple[int | None, int | None] = (None, None),
        default: Value | None = None,
    ) -> None:
        if access not in _ACCESS:
            raise ValueError(f"access {access!r}: invalid; expected one of {', '.join(_ACCESS)}")
        self.index = index
        self.subindex = subindex
        self.name = name
        self.data_type = data_type
        self.access = access
        self.pdo_mappable = pdo_mappable
        self.follows_node_id: bool = False
        self.bits: int = length_bits(data_type)
        self.low: int | None = limits[0]
        self.high: int | None = limits[1]
        self.has_default: bool = default is not None
        self.default: Value = zero(data_type) if default is None else default
        if default is not None:
            encode(data_type, default)
        self.value: Value = self.default
        self.reader: Reader | None = None
        self.writer: Writer | None = None

    def copy(self) -> "Variable":
        """Return a new variable as this one was made, with its power-on value."""
        new = Variable(self.index, self.subindex, self.data_type, self.name, self.access)
        new.pdo_mappable, new.low, new.high = self.pdo_mappable, self.low, self.high
        new.has_default, new.default, new.value = self.has_default, self.default, self.default
        new.follows_node_id = self.follows_node_id
        return new

    def is_readable(self) -> bool:
        """Return whether SDO upload is allowed (for PDOs see `entry_refusal`)."""
        return self.access != "wo"

    def is_writable(self) -> bool:
        """Return whether SDO download is allowed."""
        return self.access not in ("ro", "const")

    def can_hold(self, value: Value) -> bool:
        """Return whether the value fits the data type."""
        try:
            encode(self.data_type, value)
        except (TypeError, ValueError):
            return False
        return True

    def integer(self) -> int:
        """Return the stored whole number, or 0 for other types."""
        value = self.value
        return value if isinstance(value, int) else 0

    def read(self) -> Value:
        """Return the current value."""
        reader = self.reader
        return self.value if reader is None else reader()

    def write_integer(self, value: int) -> int:
        """Check a new whole number, call the writer and store it; return 0 or the abort code."""
        high = self.high
        if high is not None and value > high:
            return AbortCode.VALUE_TOO_HIGH
        low = self.low
        if low is not None and value < low:
            return AbortCode.VALUE_TOO_LOW
        writer = self.writer
        if writer is not None:
            code = writer(value)
            if code != 0:
                return code
        self.value = value
        return 0

    def write(self, value: Value) -> int:
        """Check, announce and store a value of the right Python type; return 0 or abort code."""
        if isinstance(value, int):
            return self.write_integer(value)
        self.value = value
        return 0

    def upload(self) -> bytes:
        """Return the current value for the wire; a reader's number is cut to the data type."""
        reader = self.reader
        value = self.value if reader is None else reader()
        if isinstance(value, int) and self.data_type in _INTEGERS:
            bits = self.bits
            return (value & ((1 << bits) - 1)).to_bytes((bits + 7) // 8, "little")
        return encode(self.data_type, value)

    def download(self, data: bytes) -> int:
        """Check, announce and store bytes from the wire; return 0 or the abort code."""
        if self.bits:
            size = (self.bits + 7) // 8
            if len(data) > size:
                return AbortCode.LENGTH_TOO_HIGH
            if len(data) < size:
                return AbortCode.LENGTH_TOO_LOW
        return self.write(decode(self.data_type, data))

    def set_default(self, value: Value) -> None:
        """Set the power-on value and the present value, without calling the writer.

        Raises:
            TypeError, ValueError: the value does not fit the data type.
        """
        encode(self.data_type, value)
        self.default = value
        self.value = value
        self.has_default = True
        self.follows_node_id = False


@final
class ObjectDictionary:
    """All variables of one node.

    Attributes:
        dummies: data types (their index) that an RPDO may map to skip unused bytes.
        node_id: of the defaults; 0: unknown. `supports_lss`: LSS may assign another one.

    An absent object is invisible to SDO and PDO, but the behaviour behind it keeps the standard's
    default: `ensure` provides a variable for it.

    Args:
        pattern: a dictionary that nobody uses: its variables are copied when they are asked for.
    """

    def __init__(self, pattern: "ObjectDictionary | None" = None) -> None:
        self._variables: dict[int, Variable] = {}
        self._hidden: dict[int, Variable] = {}
        self._pattern: dict[int, Variable] = {}
        self._subindices: dict[int, tuple[int, ...]] = {}
        if pattern is not None:
            self._pattern = pattern.variables()
            self._subindices.update(pattern.layout())
        self.dummies: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
        self.node_id: int = 0
        self.supports_lss = False

    def add(self, variable: Variable) -> Variable:
        """Add a visible variable; it replaces one with the same index and sub-index."""
        index, subindex = variable.index, variable.subindex
        self._variables[index << 8 | subindex] = variable
        subindices = self._subindices.get(index, ())
        if subindex not in subindices:
            self._subindices[index] = tuple(sorted((*subindices, subindex)))
        return variable

    def get(self, index: int, subindex: int = 0) -> Variable | None:
        """Return the visible variable, or None if it is absent."""
        key = index << 8 | subindex
        variable = self._variables.get(key)
        if variable is None and key in self._pattern:
            variable = self._variables[key] = self._pattern[key].copy()
        return variable

    def variables(self) -> dict[int, Variable]:
        """Return all visible variables by index << 8 | sub-index."""
        for key in self._pattern:
            self.get(key >> 8, key & 0xFF)
        return self._variables

    def has_index(self, index: int) -> bool:
        """Return whether any sub-index of the object is visible."""
        return index in self._subindices

    def subindices(self, index: int) -> tuple[int, ...]:
        """Return the visible sub-indices of an object, ascending; () if it is absent."""
        return self._subindices.get(index, ())

    def layout(self) -> dict[int, tuple[int, ...]]:
        """Return the visible sub-indices of each object, ascending."""
        return self._subindices

    def indices(self) -> tuple[int, ...]:
        """Return the indices of all visible objects, ascending."""
        return tuple(sorted(self._subindices))

    def __iter__(self) -> Iterator[Variable]:
        for _, variable in sorted(self.variables().items()):
            yield variable

    def ensure(
        self,
        index: int,
        subindex: int,
        data_type: int,
        default: Value,
        follows_node_id: bool = False,
    ) -> Variable:
        """Return the visible variable, or else a hidden one that SDO and PDO do not see.

        A visible variable without a stated default takes `default`; its data type stays. A second
        call returns the same variable.
        """
        key = index << 8 | subindex
        variable = self.get(index, subindex)
        if variable is not None:
            if not variable.has_default and variable.can_hold(default):
                variable.set_default(default)
                variable.follows_node_id = follows_node_id
            return variable
        hidden = self._hidden.get(key)
        if hidden is None:
            hidden = self._hidden[key] = Variable(index, subindex, data_type, default=default)
            hidden.follows_node_id = follows_node_id
        return hidden

    def integer(self, index: int, subindex: int, default: int) -> int:
        """Return the stored whole number, or `default` if it is absent or not a number."""
        key = index << 8 | subindex
        variable = self._variables.get(key)
        if variable is None:  # nothing has changed one that was never asked for
            variable = self._pattern.get(key)
        if variable is None:
            variable = self._hidden.get(key)
        if variable is None:
            return default
        value = variable.value
        return value if isinstance(value, int) else default

    def follow(self, node_id: int) -> None:
        """Adapt the defaults that follow the node-ID; values stay until a reset."""
        shift, self.node_id = node_id - self.node_id, node_id
        if shift == 0:
            return
        for variables in (self.variables(), self._hidden):
            for variable in variables.values():
                if variable.follows_node_id and isinstance(variable.default, int):
                    variable.default += shift

    def reset(self, first: int = 0x0000, last: int = 0xFFFF) -> None:
        """Reset the indices `first`..`last` to power-on values, without calling writers."""
        for variables in (self._variables, self._hidden):
            for key, variable in variables.items():
                if first <= key >> 8 <= last:
                    variable.value = variable.default


class ConfigurationListener(Protocol):
    """A listener for writes to communication objects."""

    def configured(self, index: int, subindex: int, now_ns: int) -> None:
        """Handle a new value of a sub-index of 1000h..1FFFh."""


@final
class DictionaryAccess:
    """One client's view of a dictionary. Absent, read-only and oversized access is refused."""

    def __init__(
        self, od: ObjectDictionary, host: NodeHost, listener: ConfigurationListener
    ) -> None:
        self._od = od
        self._host = host
        self._listener = listener

    def upload(self, index: int, subindex: int, now_ns: int) -> bytes | int:
        """Return the present value, or the abort code."""
        variable = self._od.get(index, subindex)
        if variable is None:
            return self._absent(index)
        if not variable.is_readable():
            return AbortCode.WRITE_ONLY
        if index == 0x1003 and subindex > self._od.integer(0x1003, 0, 0):
            return AbortCode.NO_DATA
        self._host.before_read(now_ns)
        return variable.upload()

    def refusal(self, index: int, subindex: int, size_bytes: int | None) -> int:
        """Return the abort code for beginning a download of this size (None: unknown), or 0."""
        variable = self._od.get(index, subindex)
        if variable is None:
            return self._absent(index)
        if not variable.is_writable():
            return AbortCode.READ_ONLY
        if size_bytes is None or not variable.bits:
            return 0
        expected = (variable.bits + 7) // 8
        if size_bytes > expected:
            return AbortCode.LENGTH_TOO_HIGH
        return AbortCode.LENGTH_TOO_LOW if size_bytes < expected else 0

    def size_bytes(self, index: int, subindex: int) -> int:
        """Return the size of the variable [bytes]; 0 if it varies or the variable is absent."""
        variable = self._od.get(index, subindex)
        return 0 if variable is None else (variable.bits + 7) // 8

    def download(self, index: int, subindex: int, data: bytes, now_ns: int) -> int:
        """Write the value and notify listeners; return 0, or the abort code without any effect."""
        code = self.refusal(index, subindex, len(data))
        if code:
            return code
        variable = self._od.get(index, subindex)
        assert variable is not None
        code = variable.download(data)
        if code:
            return code
        if 0x1000 <= index <= 0x1FFF:
            self._listener.configured(index, subindex, now_ns)
        self._host.on_write(now_ns)
        return 0

    def _absent(self, index: int) -> int:
        if self._od.has_index(index):
            return AbortCode.NO_SUCH_SUBINDEX
        return AbortCode.NO_SUCH_OBJECT
