"""Names and data types of the objects of a CANopen node.

Source: CiA 301 (communication profile area 1000h to 1FFFh), CiA 402-2 (6000h and up).
Manufacturer-specific objects (2000h to 5FFFh) are only in an EDS.
"""

import configparser
import struct
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding.events import Value

# Kinds: u and i are integers with their bits, x is unsigned and shown in hex, s is text, o is
# bytes.
_STANDARD: Final = """
1000 x32 device type
1001 x8 error register
1002 x32 manufacturer status register
1003 x32 pre-defined error field
1005 x32 COB-ID SYNC
1006 u32 communication cycle period
1007 u32 synchronous window length
1008 s manufacturer device name
1009 s manufacturer hardware version
100A s manufacturer software version
100C u16 guard time
100D u8 life time factor
1010 x32 store parameters
1011 x32 restore default parameters
1012 x32 COB-ID TIME
1013 u32 high resolution time stamp
1014 x32 COB-ID EMCY
1015 u16 inhibit time EMCY
1016 x32 consumer heartbeat time
1017 u16 producer heartbeat time
1018 x32 identity
1019 u8 synchronous counter overflow value
1029 u8 error behaviour
6007 i16 abort connection option code
603F x16 error code
6040 x16 controlword
6041 x16 statusword
6042 i16 vl target velocity
6043 i16 vl velocity demand
6044 i16 vl velocity actual value
605A i16 quick stop option code
605B i16 shutdown option code
605C i16 disable operation option code
605D i16 halt option code
605E i16 fault reaction option code
6060 i8 modes of operation
6061 i8 modes of operation display
6062 i32 position demand value
6063 i32 position actual internal value
6064 i32 position actual value
6065 u32 following error window
6066 u16 following error time out
6067 u32 position window
6068 u16 position window time
6069 i32 velocity sensor actual value
606B i32 velocity demand value
606C i32 velocity actual value
606D u16 velocity window
606E u16 velocity window time
606F u16 velocity threshold
6070 u16 velocity threshold time
6071 i16 target torque
6072 u16 max torque
6073 u16 max current
6074 i16 torque demand
6075 u32 motor rated current
6076 u32 motor rated torque
6077 i16 torque actual value
6078 i16 current actual value
6079 u32 DC link circuit voltage
607A i32 target position
607B i32 position range limit
607C i32 home offset
607D i32 software position limit
607E x8 polarity
607F u32 max profile velocity
6080 u32 max motor speed
6081 u32 profile velocity
6082 u32 end velocity
6083 u32 profile acceleration
6084 u32 profile deceleration
6085 u32 quick stop deceleration
6086 i16 motion profile type
6087 u32 torque slope
608F u32 position encoder resolution
6091 u32 gear ratio
6092 u32 feed constant
6096 u32 velocity factor
6097 u32 acceleration factor
6098 i8 homing method
6099 u32 homing speeds
609A u32 homing acceleration
60B0 i32 position offset
60B1 i32 velocity offset
60B2 i16 torque offset
60B8 x16 touch probe function
60B9 x16 touch probe status
60C0 i16 interpolation sub mode select
60C1 i32 interpolation data record
60C2 i8 interpolation time period
60C5 u32 max acceleration
60C6 u32 max deceleration
60E0 u16 positive torque limit value
60E1 u16 negative torque limit value
60F4 i32 following error actual value
60FA i32 control effort
60FC i32 position demand internal value
60FD x32 digital inputs
60FE x32 digital outputs
60FF i32 target velocity
6402 u16 motor type
6502 x32 supported drive modes
"""

_SUBS: Final = """
1018:1 x32 vendor-ID
1018:2 x32 product code
1018:3 x32 revision number
1018:4 x32 serial number
607B:1 i32 min position range limit
607B:2 i32 max position range limit
607D:1 i32 min position limit
607D:2 i32 max position limit
608F:1 u32 encoder increments
608F:2 u32 motor revolutions
6091:1 u32 motor revolutions
6091:2 u32 shaft revolutions
6092:1 u32 feed
6092:2 u32 shaft revolutions
6096:1 u32 velocity factor numerator
6096:2 u32 velocity factor divisor
6097:1 u32 acceleration factor numerator
6097:2 u32 acceleration factor divisor
6099:1 u32 speed during search for switch
6099:2 u32 speed during search for zero
60C2:1 u8 interpolation time period value
60C2:2 i8 interpolation time index
60FE:1 x32 physical outputs
60FE:2 x32 output mask
"""

_PDO_SUBS: Final = {
    1: ("x32", "COB-ID"),
    2: ("u8", "transmission type"),
    3: ("u16", "inhibit time"),
    5: ("u16", "event timer"),
    6: ("u8", "SYNC start value"),
}
_ARRAYS: Final = frozenset(
    (
        *(0x1003, 0x1010, 0x1011, 0x1016, 0x1018, 0x1029, 0x607B, 0x607D, 0x608F, 0x6091),
        *(0x6092, 0x6096, 0x6097, 0x6099, 0x60C1, 0x60C2, 0x60FE),
    )
)
"""Objects whose sub-index 0 is a count."""

# CiA 301, data types: code in an EDS to our kind.
_EDS_KINDS: Final = {
    **{0x01: "u1", 0x02: "i8", 0x03: "i16", 0x04: "i32", 0x05: "u8", 0x06: "u16", 0x07: "u32"},
    **{0x08: "f32", 0x09: "s", 0x0A: "o", 0x0F: "o", 0x10: "i24", 0x11: "f64", 0x15: "i64"},
    **{0x16: "u24", 0x1B: "u64"},
}


@final
@frozen
class ObjectName:
    """The name of an object, and its `kind` ("" if unknown)."""

    text: str
    kind: str


def _table(text: str) -> dict[tuple[int, int], ObjectName]:
    found: dict[tuple[int, int], ObjectName] = {}
    for line in text.split("\n"):
        if line:
            place, kind, name = line.split(" ", 2)
            index, _, sub = place.partition(":")
            found[int(index, 16), int(sub or "0", 16)] = ObjectName(name, kind)
    return found


_KNOWN: Final = _table(_STANDARD) | _table(_SUBS)


def axis_of(index: int) -> tuple[int, int]:
    """Return the axis of an object, from 1, and its index on the first axis.

    Source: CiA 402-2: the objects of each further axis follow at a distance of 800h.
    """
    if 0x6800 <= index < 0xA000:
        return (index - 0x6000) // 0x800 + 1, 0x6000 + index % 0x800
    return 1, index


def standard_name(index: int, subindex: int) -> ObjectName:
    """Return the name of an object of CiA 301 or 402; of any other with an empty text."""
    axis, first = axis_of(index)
    if axis > 1:
        name = standard_name(first, subindex)
        return ObjectName(f"{name.text}, axis {axis}" if name.text else "", name.kind)
    if 0x1400 <= index < 0x1C00:
        return _pdo_name(index, subindex)
    if subindex == 0 and index in _ARRAYS:
        base = _KNOWN.get((index, 0))
        return ObjectName(f"{base.text if base else ''}, entries".strip(", "), "u8")
    found = _KNOWN.get((index, subindex))
    if found is None and subindex:
        base = _KNOWN.get((index, 0))
        if base is not None:
            return ObjectName(f"{base.text} {subindex}", base.kind)
    return found or ObjectName("", "")


def _pdo_name(index: int, subindex: int) -> ObjectName:
    way = "RPDO" if index < 0x1800 else "TPDO"
    number = (index & 0x1FF) + 1
    if index & 0x200:
        if subindex == 0:
            return ObjectName(f"{way} {number} mapped objects", "u8")
        return ObjectName(f"{way} {number} mapping {subindex}", "x32")
    if subindex == 0:
        return ObjectName(f"{way} {number} parameters", "u8")
    kind, name = _PDO_SUBS.get(subindex, ("", f"parameter {subindex}"))
    return ObjectName(f"{way} {number} {name}", kind)


@final
class ObjectNames:
    """The names of one node's objects: the standards' and those of its EDS.

    Attributes:
        defaults: default values in the EDS, by index and sub-index (for its PDOs).
    """

    def __init__(self, eds: str = "") -> None:
        """Read the text of an EDS or DCF; invalid entries are skipped."""
        self._own: dict[tuple[int, int], ObjectName] = {}
        self._wholes: dict[int, str] = {}  # names of arrays and records
        self.defaults: dict[tuple[int, int], str] = {}
        if eds:
            self._read(eds)

    @property
    def count(self) -> int:
        """The number of objects and sub-indices in the EDS."""
        return len(self._own)

    def of(self, index: int, subindex: int, is_drive: bool = True) -> ObjectName:
        """Return the object's name; its text is empty if it is unknown."""
        known = is_drive or index < 0x6000
        standard = standard_name(index, subindex) if known else ObjectName("", "")
        own = self._own.get((index, subindex))
        if own is None or (standard.text and standard.kind):
            return standard
        whole = self._wholes.get(index, "") if subindex else ""
        if not whole or whole in own.text:
            return own
        return ObjectName(f"{whole}, {own.text}", own.kind)

    def _read(self, text: str) -> None:
        parser = configparser.RawConfigParser(strict=False, allow_no_value=True)
        try:
            parser.read_string(text)
        except configparser.Error:
            return
        for section in parser.sections():
            index, _, sub = section.lower().partition("sub")
            try:
                key = int(index, 16), int(sub or "0", 16)
                kind = int(parser.get(section, "DataType", fallback="0") or "0", 0)
            except ValueError:
                continue
            if not 0x1000 <= key[0] <= 0xFFFF:
                continue
            name = (parser.get(section, "ParameterName", fallback="") or "").strip()
            if not sub:
                self._wholes[key[0]] = name
            self._own[key] = ObjectName(name, _EDS_KINDS.get(kind, ""))
            value = parser.get(section, "ParameterValue", fallback=None) or parser.get(
                section, "DefaultValue", fallback=None
            )
            if value:
                self.defaults[key] = value.strip()


def value_of(kind: str, data: bytes) -> Value:
    """Return the bytes read as `kind`; the bytes themselves if they do not fit."""
    if kind == "s":
        text = data.rstrip(b"\0")
        return text.decode("latin-1")
    if kind in ("f32", "f64") and len(data) * 8 == int(kind[1:]):
        return _real(data)
    if kind[:1] in ("u", "i", "x") and data:
        width = int(kind[1:])
        size = max(1, width // 8)
        if len(data) >= size and not any(data[size:]):
            return int.from_bytes(data[:size], "little", signed=kind[0] == "i")
    if not kind and 0 < len(data) <= 4:
        return int.from_bytes(data, "little")
    return data


def _real(data: bytes) -> float:
    value: float = struct.unpack("<f" if len(data) == 4 else "<d", data)[0]
    return value


def value_text(kind: str, size: int, value: Value) -> str:
    """Return in words what `value_of` reads in `size` bytes."""
    if isinstance(value, int):
        if kind.startswith("x") or (not kind and value > 9):
            return f"{value:0{int(kind[1:]) // 4 if kind else 2 * size}X}h"
        return str(value)
    if isinstance(value, bytes):
        return value.hex(" ").upper() if value else "nothing"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
