"""Object dictionary of a CANopen device as a host reads and writes it.

Names and data types come from tables of the standards; values are encoded as CiA 301 defines.
"""

import difflib
import struct
from collections.abc import Mapping
from typing import Final, final

from motorhil.motorapi.errors import UsageError

Value = int | float | str | bytes

# CiA 301 data types: name -> struct format
_FORMATS: Final[dict[str, struct.Struct]] = {
    "u8": struct.Struct("<B"),
    "u16": struct.Struct("<H"),
    "u32": struct.Struct("<I"),
    "i8": struct.Struct("<b"),
    "i16": struct.Struct("<h"),
    "i32": struct.Struct("<i"),
    "u64": struct.Struct("<Q"),
    "i64": struct.Struct("<q"),
    "f32": struct.Struct("<f"),
    "f64": struct.Struct("<d"),
}
KINDS: Final = (*_FORMATS, "string", "bytes")


def decode(kind: str, data: bytes) -> Value:
    """Return the value of `data` read from the device.

    Some devices answer with four bytes for every type: what is beyond the type is cut.

    Raises:
        ValueError: the data is shorter than the type; missing bytes are not made up.
    """
    if kind == "string":
        return data.rstrip(b"\0").decode("utf-8", "replace")
    if kind == "bytes":
        return data
    form = _FORMATS[kind]
    if len(data) < form.size:
        sent = f"{len(data)} byte" + "s" * (len(data) != 1)
        raise ValueError(
            f"{sent} ({data.hex(' ').upper()}) for the data type {kind}, of {form.size}"
        )
    value: int | float = form.unpack_from(data)[0]
    return value


def encode(kind: str, value: Value) -> bytes:
    """Return the bytes to write for a value.

    Raises:
        UsageError: the value does not fit the type.
    """
    if isinstance(value, bytes):
        return value
    if kind in ("string", "bytes"):
        return str(value).encode("utf-8", "replace")
    form = _FORMATS[kind]
    try:
        return form.pack(value if kind[0] == "f" else _whole(value))
    except (struct.error, OverflowError, TypeError):
        raise UsageError(f"{value!r} does not fit the data type {kind}") from None


def _whole(value: Value) -> int:
    if isinstance(value, int):
        return value
    raise UsageError(f"{value!r} is not an integer; the object holds an integer")


# name: (index, sub-index, type), with the standard's names (CiA 301, communication profile area)
COMMUNICATION_OBJECTS: Final[dict[str, tuple[int, int, str]]] = {
    "device_type": (0x1000, 0, "u32"),
    "error_register": (0x1001, 0, "u8"),
    "number_of_errors": (0x1003, 0, "u8"),
    "last_error": (0x1003, 1, "u32"),
    "cob_id_sync": (0x1005, 0, "u32"),
    "communication_cycle_period": (0x1006, 0, "u32"),
    "manufacturer_device_name": (0x1008, 0, "string"),
    "manufacturer_hardware_version": (0x1009, 0, "string"),
    "manufacturer_software_version": (0x100A, 0, "string"),
    "store_parameters": (0x1010, 1, "u32"),
    "restore_default_parameters": (0x1011, 1, "u32"),
    "cob_id_emcy": (0x1014, 0, "u32"),
    "consumer_heartbeat_time": (0x1016, 1, "u32"),
    "producer_heartbeat_time": (0x1017, 0, "u16"),
    "vendor_id": (0x1018, 1, "u32"),
    "product_code": (0x1018, 2, "u32"),
    "revision_number": (0x1018, 3, "u32"),
    "serial_number": (0x1018, 4, "u32"),
}


@final
class ObjectTable:
    """Objects of the standards that a device follows: index, sub-index and data type, by name."""

    def __init__(self, by_name: Mapping[str, tuple[int, int, str]]) -> None:
        self.by_name: Final = by_name
        self._types: Final = {(index, subindex): kind for index, subindex, kind in by_name.values()}

    def type_of(self, index: int, subindex: int) -> str | None:
        """Return the data type of an object, or None if the table does not contain it."""
        known = self._types.get((index, subindex))
        if known is None and subindex == 0 and (index, 1) in self._types:
            return "u8"  # highest sub-index supported
        if known is None and 0x1400 <= index < 0x1A00 + 0x200:
            return _pdo_type(index, subindex)
        return known

    def find(self, what: int | str, subindex: int, kind: str | None) -> tuple[int, int, str | None]:
        """Return (index, sub-index, data type) of an object by index or by the standard's name.

        Args:
            what: the index or the name.
            subindex: the sub-index, if `what` is an index.
            kind: the data type ("u8" to "i64", "f32", "string", "bytes") of an object that the
                table does not contain, or None.

        Raises:
            UsageError: the name, the place or the type does not exist.
        """
        if kind is not None and (not isinstance(kind, str) or kind not in KINDS):
            raise UsageError(f"kind = {kind!r}: give one of {', '.join(KINDS)}")
        if not isinstance(subindex, int):
            raise UsageError(f"sub-index {subindex!r}: it is 0 to FFh")
        if not isinstance(what, int | str):
            raise UsageError(f"{what!r} is not an object: give an index, or the standard's name")
        if isinstance(what, int):
            return what, subindex, kind or self.type_of(what, subindex)
        known = self.by_name.get(what)
        if known is None:
            near = difflib.get_close_matches(what, self.by_name, 1)
            hint = f"; did you mean {near[0]!r}?" if near else "; give its index"
            raise UsageError(f"the standard has no object named {what!r}{hint}")
        return known[0], known[1], kind or known[2]


def _pdo_type(index: int, subindex: int) -> str:
    if subindex == 0:
        return "u8"
    if index & 0x0200:  # 1600h.. and 1A00h..: mapping
        return "u32"
    return {1: "u32", 3: "u16", 5: "u16"}.get(subindex, "u8")
