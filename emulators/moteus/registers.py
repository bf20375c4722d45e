"""The registers of a moteus, and the subframes that carry them.

All numbers are little endian. A register is transferred in one of four types; integers are scaled
by the quantity, and truncated toward zero. The least integer stands for NaN, so that values are
limited to the range without it. Enumerations and counters are cast, not scaled.

Source: mjbots/moteus, docs/protocol/registers.md, fw/moteus_controller.cc.
"""

from collections.abc import Iterable
from math import inf, isfinite, nan
from struct import Struct
from typing import Final

INT8, INT16, INT32, FLOAT = range(4)
LAYOUTS: Final = (Struct("<b"), Struct("<h"), Struct("<i"), Struct("<f"))
WRITE, READ, REPLY = 0x00, 0x10, 0x20
WRITE_ERROR, READ_ERROR = 0x30, 0x31
TO_SERVER, TO_CLIENT, POLL, NOP = 0x40, 0x41, 0x42, 0x50
UNKNOWN_REGISTER, NOT_WRITABLE = 1, 2

_PWM: Final = (1 / 127, 1 / 32767, 1 / 2147483647)
_SCALES: Final = {
    "position": (0.01, 0.0001, 0.00001),
    "velocity": (0.1, 0.00025, 0.00001),
    "acceleration": (0.05, 0.001, 0.00001),
    "torque": (0.5, 0.01, 0.001),
    "current": (1.0, 0.1, 0.001),
    "voltage": (0.5, 0.1, 0.001),
    "temperature": (1.0, 0.1, 0.001),
    "time": (0.01, 0.001, 0.000001),
    "power": (10.0, 0.05, 0.0001),
    "pwm": _PWM,
    "int": None,
}

MODE: Final = 0x000
COMMAND: Final[
    dict[int, tuple[str, float]]
] = {  # register: quantity, value after a write of the mode
    **dict.fromkeys(range(0x010, 0x013), ("pwm", 0.0)),
    **dict.fromkeys((*range(0x014, 0x017), 0x019, 0x01A, 0x01B), ("voltage", 0.0)),
    **dict.fromkeys((0x01C, 0x01D), ("current", 0.0)),
    0x018: ("pwm", 0.0),
    0x01E: ("velocity", 0.0),
    0x020: ("position", 0.0),
    0x021: ("velocity", 0.0),
    0x022: ("torque", 0.0),
    0x023: ("pwm", 1.0),
    0x024: ("pwm", 1.0),
    0x025: ("torque", 100.0),
    0x026: ("position", nan),
    0x027: ("time", 0.0),
    0x028: ("velocity", nan),
    0x029: ("acceleration", nan),
    0x02A: ("voltage", nan),
    0x02B: ("pwm", 1.0),
    0x02C: ("current", nan),
    0x02D: ("int", 0.0),
    0x040: ("position", 0.0),
    0x041: ("position", 0.0),
}
SHADOWS: Final = {
    **{0x042: 0x022, 0x043: 0x023, 0x044: 0x024, 0x045: 0x025},
    **{0x046: 0x027, 0x047: 0x02B, 0x048: 0x02D},
}
MEASURED: Final = {
    **dict.fromkeys((0x001, 0x006, 0x038, 0x03B, 0x050, 0x052, 0x054), "position"),
    **dict.fromkeys((0x002, 0x039, 0x03C, 0x051, 0x053, 0x055), "velocity"),
    **dict.fromkeys((0x003, *range(0x030, 0x035), 0x03A, 0x03D), "torque"),
    **dict.fromkeys((0x004, 0x005), "current"),
    **dict.fromkeys((0x00A, 0x00E), "temperature"),
    **dict.fromkeys((0x00B, 0x00C, 0x00F, 0x058, 0x05E, 0x05F, 0x070, 0x072, 0x074), "int"),
    **dict.fromkeys((0x140, 0x141, 0x158), "int"),
    **dict.fromkeys((*range(0x060, 0x065), *range(0x068, 0x06D), 0x073, 0x075), "pwm"),
    0x007: "power",
    0x00D: "voltage",
}
STORED: Final = {
    **dict.fromkeys((0x05C, 0x05D, 0x071), "int"),
    **dict.fromkeys(range(0x076, 0x080), "pwm"),
}
IDENTITY: Final = (*range(0x100, 0x103), *range(0x120, 0x123), *range(0x150, 0x154))
"""Registers that are read as int32 only."""
ACTIONS: Final = {
    **{0x130: "position", 0x131: "position", 0x132: "int", 0x133: "int"},
    **dict.fromkeys(range(0x154, 0x158), "int"),
}
_NAMED: Final = 0x110  # known, and neither readable nor writable
QUANTITIES: Final[dict[int, str]] = {
    MODE: "int",
    **{register: quantity for register, (quantity, _) in COMMAND.items()},
    **{shadow: COMMAND[register][0] for shadow, register in SHADOWS.items()},
    **STORED,
    **MEASURED,
    **ACTIONS,
}


def defaults() -> dict[int, float]:
    """Return the command fields as a write of the mode sets them."""
    return {register: value for register, (_, value) in COMMAND.items()}


def encode(value: float, quantity: str, kind: int) -> bytes:
    """Return the value of a register in one of the types."""
    layout = LAYOUTS[kind]
    if kind == FLOAT:
        return layout.pack(single(value))
    bits = 8 * layout.size
    scales = _SCALES[quantity]
    if scales is None:
        whole = int(value) if isfinite(value) else 0
        return (whole & (1 << bits) - 1).to_bytes(layout.size, "little")
    most = (1 << bits - 1) - 1
    if not isfinite(value):
        return layout.pack(-most - 1)
    scaled = single(single(value) / single(scales[kind]))
    return layout.pack(int(max(-most, min(most, scaled))))


def decode(raw: bytes, quantity: str, kind: int) -> float:
    """Return the value of a register from one of the types."""
    (value,) = LAYOUTS[kind].unpack(raw)
    scales = _SCALES[quantity]
    if kind == FLOAT or scales is None:
        return float(value)
    if value == -1 << 8 * len(raw) - 1:
        return nan
    return single(value * single(scales[kind]))


def single(value: float) -> float:
    """Return the nearest single-precision float; infinite beyond the largest."""
    try:
        (rounded,) = LAYOUTS[FLOAT].unpack(LAYOUTS[FLOAT].pack(value))
    except OverflowError:
        return inf if value > 0 else -inf
    return float(rounded)


def varuint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number in groups of 7 bits, low first, and where it ends.

    Raises:
        IndexError: the data end within it, or it is longer than 5 bytes.
    """
    value = 0
    for place in range(5):
        value |= (data[at + place] & 0x7F) << 7 * place
        if data[at + place] < 0x80:
            return value, at + place + 1
    raise IndexError("a number of more than 5 bytes")


def packed(value: int) -> bytes:
    """Return a number in groups of 7 bits, low first."""
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*groups, value))


def subframe(code: int, kind: int, start: int, values: Iterable[bytes]) -> bytes:
    """Return a subframe with the values of successive registers."""
    given = tuple(values)
    count = bytes(()) if len(given) < 4 else packed(len(given))
    head = code + 4 * kind + (0 if count else len(given))
    return bytes((head,)) + count + packed(start) + b"".join(given)


def refusal(register: int) -> int:
    """Return the error for a write of a register that cannot be written; 0 if it can."""
    if register in MEASURED or register in IDENTITY or register == _NAMED:
        return NOT_WRITABLE
    return 0 if register in QUANTITIES else UNKNOWN_REGISTER
