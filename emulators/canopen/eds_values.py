"""Values in EDS and DCF files (CiA 306, 4.5).

Every function returns the value and a remark. A remark other than "" names a repair.
"""

import re
from typing import Final

from emulators.canopen.object_dictionary import (
    DataType,
    Value,
    decode,
    integer_range,
    is_integer,
    is_signed,
    length_bits,
)

_NODE_ID: Final = re.compile(r"\$node_?id", re.IGNORECASE)
_COMMENT: Final = re.compile(r"\s*(;|//|/\*|#|\().*$")
_HEX: Final = re.compile(r"([+-]?)0x([0-9a-f]+)", re.IGNORECASE)
_HEX_WITH_H: Final = re.compile(r"([+-]?)([0-9a-f]+)h", re.IGNORECASE)
_DECIMAL: Final = re.compile(r"[+-]?[0-9]+")
_WHOLE_REAL: Final = re.compile(r"([+-]?[0-9]+)[.,]0*")
_WORDS: Final = {"true": 1, "false": 0, "yes": 1, "no": 0}


def parse_integer(text: str, node_id: int) -> tuple[int, bool, str]:
    """Return the number, whether it was written in hexadecimal, and a remark.

    Raises:
        ValueError: the text is not a number; the message quotes it.
    """
    if _NODE_ID.search(text):
        return _with_node_id(text, node_id)
    remark = ""
    bare = text.strip().strip("\"'")
    cut = _COMMENT.sub("", bare)
    if cut != text.strip():
        remark = f"read as {cut}"
    if match := _HEX.fullmatch(cut):
        return int(match[1] + match[2], 16), True, remark
    if _DECIMAL.fullmatch(cut):
        return _decimal(cut, remark)
    if cut.lower() in _WORDS:
        return _WORDS[cut.lower()], False, f"read as {_WORDS[cut.lower()]}"
    if match := _HEX_WITH_H.fullmatch(cut):
        return int(match[1] + match[2], 16), True, f"read as 0x{match[2]}"
    if match := _WHOLE_REAL.fullmatch(cut):
        return int(match[1]), False, f"read as {match[1]}"
    raise ValueError(f"{text!r} is no number")


def _decimal(text: str, remark: str) -> tuple[int, bool, str]:
    """Parse a decimal number, or an octal one with a leading 0 (CiA 306)."""
    digits = text.lstrip("+-")
    if len(digits) > 1 and digits[0] == "0" and digits.strip("0"):
        if set(digits) <= set("01234567"):
            value = int(text, 8)
            return value, False, f"a leading 0 means octal (CiA 306): read as {value}"
        return int(text), False, f"no octal number for all its leading 0: read as {int(text)}"
    return int(text), False, remark


def _with_node_id(text: str, node_id: int) -> tuple[int, bool, str]:
    """Parse $NODEID, $NODEID + number or number + $NODEID."""
    cut = _COMMENT.sub("", text.strip())
    rest = "".join(_NODE_ID.sub("", cut, count=1).split())
    if rest and not (rest[0] == "+" or rest[-1] == "+"):
        raise ValueError(f"{text!r} is not $NODEID plus a number")
    rest = rest.strip("+")
    if not rest:
        return node_id, True, ""
    value, is_hex, remark = parse_integer(rest, node_id)
    if cut != text.strip():
        remark = f"read as {cut}"
    return value + node_id, is_hex, remark


def fit(value: int, data_type: int, is_hex: bool) -> tuple[int, str]:
    """Fit the number to the data type; hexadecimals of signed types are two's complement.

    Raises:
        ValueError: the number does not fit the data type.
    """
    low, high = integer_range(data_type)
    bits = length_bits(data_type)
    if low <= value <= high:
        return value, ""
    if is_signed(data_type):
        if 0 <= value < 1 << bits:
            signed = value - (1 << bits)
            return signed, "" if is_hex else f"{value} read as two's complement, {signed}"
        for width in (16, 24, 32, 64):
            if is_hex and value < 1 << width and low <= value - (1 << width) < 0:
                signed = value - (1 << width)
                return signed, f"{value:X}h has more than {bits} bits, read as {signed}"
    elif value < 0 and value >= -(1 << (bits - 1)) and bits > 1:
        unsigned = value + (1 << bits)
        return unsigned, f"{value} of an unsigned type, read as {unsigned}"
    raise ValueError(f"{value} does not fit {type_name(data_type)} ({low}..{high})")


def parse_value(text: str, data_type: int, node_id: int) -> tuple[Value, str]:
    """Return a DefaultValue or ParameterValue, and a remark.

    Raises:
        ValueError: the text is not a value of this data type.
    """
    if is_integer(data_type):
        number, is_hex, remark = parse_integer(text, node_id)
        try:
            value, fit_remark = fit(number, data_type, is_hex)
        except ValueError as error:
            raise ValueError(f"{text!r}: {error}") from None
        return value, remark or fit_remark
    if data_type in (DataType.REAL32, DataType.REAL64):
        return _real(text, data_type)
    if data_type in (DataType.OCTET_STRING, DataType.DOMAIN):
        digits = text[2:] if text[:2].lower() == "0x" else text
        try:
            return bytes.fromhex(digits), ""
        except ValueError:
            return text.encode("latin-1", "replace"), "not in hexadecimal; read as text"
    if data_type == DataType.UNICODE_STRING:
        return text.encode("utf-16-le"), ""
    return text.encode("latin-1", "replace"), ""


def _real(text: str, data_type: int) -> tuple[float, str]:
    """Parse a decimal fraction, or a bit pattern if all its hexadecimal digits are given."""
    size = length_bits(data_type) // 8
    match = _HEX.fullmatch(text)
    if match and len(match[2]) == 2 * size:
        value = decode(data_type, bytes.fromhex(match[2])[::-1])
        assert isinstance(value, float)
        return value, f"read as the bit pattern of {value:g}"
    if match:
        return float(int(match[1] + match[2], 16)), ""
    cut = _COMMENT.sub("", text)
    number = float(cut.replace(",", "."))
    return number, "" if cut == text and "," not in text else f"read as {number:g}"


def type_name(data_type: int) -> str:
    """Return the standard's name of a data type."""
    try:
        return DataType(data_type).name
    except ValueError:
        return f"data type {data_type:X}h"
