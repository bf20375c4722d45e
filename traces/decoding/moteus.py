"""Frames of a moteus in words: its registers, commands and diagnostic text.

Names and scales are those of mjbots/moteus, docs/protocol/registers.md.
"""

from collections.abc import Callable
from math import nan
from struct import Struct
from typing import Final

from motorhil.traces.can_frame import ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Signal

_BROADCAST: Final = 0x7F
_TYPES: Final = (Struct("<b"), Struct("<h"), Struct("<i"), Struct("<f"))
_TYPE_NAMES: Final = ("int8", "int16", "int32", "float")
_UNITS: Final = {  # of one bit, by type
    "rev": (0.01, 0.0001, 0.00001),
    "rev/s": (0.1, 0.00025, 0.00001),
    "rev/s²": (0.05, 0.001, 0.00001),
    "N·m": (0.5, 0.01, 0.001),
    "A": (1.0, 0.1, 0.001),
    "V": (0.5, 0.1, 0.001),
    "°C": (1.0, 0.1, 0.001),
    "s": (0.01, 0.001, 0.000001),
    "W": (10.0, 0.05, 0.0001),
    "-": (1 / 127, 1 / 32767, 1 / 2147483647),
}
_LISTED: Final = """
000 mode; 001 position rev; 002 velocity rev/s; 003 torque N·m; 004 Q current A; 005 D current A
006 absolute position rev; 007 power W; 00A motor temperature °C; 00B trajectory complete
00C home state; 00D voltage V; 00E temperature °C; 00F fault
010 PWM A -; 011 PWM B -; 012 PWM C -; 014 voltage A V; 015 voltage B V; 016 voltage C V
018 FOC theta -; 019 FOC voltage V; 01A D voltage V; 01B Q voltage V
01C Q current command A; 01D D current command A; 01E FOC theta rate rev/s
020 position command rev; 021 velocity command rev/s; 022 feedforward torque N·m
023 kp scale -; 024 kd scale -; 025 maximum torque N·m; 026 stop position rev; 027 watchdog s
028 velocity limit rev/s; 029 acceleration limit rev/s²; 02A fixed voltage V
02B integral limit scale -; 02C fixed current A; 02D ignore position bounds
030 P torque N·m; 031 I torque N·m; 032 D torque N·m; 033 feedforward N·m; 034 torque command N·m
038 control position rev; 039 control velocity rev/s; 03A control torque N·m
03B position error rev; 03C velocity error rev/s; 03D torque error N·m
040 lower bound rev; 041 upper bound rev; 042 feedforward torque N·m; 043 kp scale -
044 kd scale -; 045 maximum torque N·m; 046 watchdog s; 047 integral limit scale -
048 ignore position bounds; 050 encoder 0 position rev; 051 encoder 0 velocity rev/s
052 encoder 1 position rev; 053 encoder 1 velocity rev/s; 054 encoder 2 position rev
055 encoder 2 velocity rev/s; 058 encoder validity; 05C aux1 outputs; 05D aux2 outputs
05E aux1 inputs; 05F aux2 inputs; 070 millisecond counter; 071 clock trim
072 aux1 period; 073 aux1 duty -; 074 aux2 period; 075 aux2 duty -
100 model; 101 ABI version; 102 register map version; 120 serial 1; 121 serial 2; 122 serial 3
130 nearest output position rev; 131 exact output position rev; 132 require reindex
133 recapture; 140 driver fault 1; 141 driver fault 2; 150 UUID 1; 151 UUID 2; 152 UUID 3
153 UUID 4; 154 UUID mask 1; 155 UUID mask 2; 156 UUID mask 3; 157 UUID mask 4
158 UUID mask capable
"""
_MODES: Final = (
    *("stopped", "fault", "enabling", "calibrating", "calibration complete", "pwm", "voltage"),
    *("voltage FOC", "voltage DQ", "current", "position", "position timeout", "zero velocity"),
    *("stay within", "measure inductance", "brake"),
)
_FAULTS: Final = {
    **{32: "calibration", 33: "motor driver", 34: "over-voltage", 35: "encoder"},
    **{36: "motor not configured", 37: "cycle overrun", 38: "over-temperature"},
    **{39: "outside limit", 40: "under-voltage", 41: "configuration changed"},
    **{42: "theta invalid", 43: "position invalid", 44: "driver enable"},
    **{45: "stop position deprecated", 46: "timing violation", 47: "no acceleration limit"},
    **{48: "invalid limits", 49: "position error", 50: "velocity error"},
    **{96: "limit: velocity", 97: "limit: power", 98: "limit: voltage", 99: "limit: current"},
    **{100: "limit: temperature", 101: "limit: motor temperature", 102: "limit: torque"},
    **{103: "limit: position", 104: "limit: flux braking", 105: "limit: field weakening"},
}


def _registers() -> dict[int, tuple[str, str]]:
    """Return name and unit of each register."""
    found = {}
    for entry in _LISTED.replace("\n", ";").split(";"):
        number, _, text = entry.strip().partition(" ")
        name, _, unit = text.rpartition(" ")
        if number:
            found[int(number, 16)] = (name, unit) if unit in _UNITS else (text, "")
    aux = ((1, "analog", 0x060), (2, "analog", 0x068), (1, "PWM", 0x076), (2, "PWM", 0x07B))
    for port, kind, first in aux:
        found |= {first + pin: (f"aux{port} {kind} {pin + 1}", "-") for pin in range(5)}
    return found


_REGISTERS: Final = _registers()


class _Reader:
    """The data of a frame, read from the beginning; IndexError at its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __bool__(self) -> bool:
        return bool(self._data.strip(b"\x50"))

    def take(self, size: int) -> bytes:
        """Return the next bytes."""
        if size > len(self._data):
            raise IndexError("the frame ends within a subframe")
        taken, self._data = self._data[:size], self._data[size:]
        return taken

    def number(self) -> int:
        """Return the next number in groups of 7 bits, low first."""
        value = 0
        for place in range(5):
            (byte,) = self.take(1)
            value |= (byte & 0x7F) << 7 * place
            if byte < 0x80:
                break
        return value


def build(node_id: int) -> Callable[[bytes], BusMessage | None]:
    """Return the decoder of one drive's frames; the prefix of identifiers may be any."""

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        source, destination = told.can_id >> 8 & 0x7F, told.can_id & 0xFF
        if told.can_id & (ERR | RTR):
            return None
        if destination in (node_id, _BROADCAST):
            name = "Query" if told.can_id & 0x8000 else "Command"
        elif source == node_id:
            name = "Reply"
        else:
            return None
        signals: list[Signal] = []
        try:
            reader = _Reader(told.data)
            while reader:
                signals += _subframe(reader)
        except (IndexError, ValueError) as error:
            return BusMessage(name, tuple(signals), problem=str(error))
        return BusMessage(name, tuple(signals))

    return decode


def _subframe(reader: _Reader) -> list[Signal]:
    (code,) = reader.take(1)
    if code < 0x30:
        kind = code >> 2 & 3
        count = code & 3 or reader.number()
        first = reader.number()
        if 0x10 <= code < 0x20:
            last = f" to {first + count - 1:03X}h" if count > 1 else ""
            return [Signal("read", f"{first:03X}h{last} as {_TYPE_NAMES[kind]}", "")]
        size = _TYPES[kind].size
        return [_value(first + place, kind, reader.take(size)) for place in range(count)]
    if code in (0x30, 0x31):
        what = "write" if code == 0x30 else "read"
        register = reader.number()
        error = {1: "unknown", 2: "not writable"}
        told = reader.number()
        return [Signal(f"{what} of {register:03X}h refused", error.get(told, told), "")]
    if code in (0x40, 0x41, 0x42):
        channel, length = reader.number(), reader.number()
        if code == 0x42:
            return [Signal(f"poll of channel {channel}", length, "bytes")]
        text = reader.take(length).decode("latin-1").encode("unicode_escape").decode()
        return [Signal(f"channel {channel}", text, "")]
    if code == 0x50:
        return []
    raise ValueError(f"subframe {code:02X}h is not known")


def _value(register: int, kind: int, raw: bytes) -> Signal:
    name, unit = _REGISTERS.get(register, (f"register {register:03X}h", ""))
    (value,) = _TYPES[kind].unpack(raw)
    if unit:
        scales = (*_UNITS[unit], 1.0)
        is_least = kind < 3 and value == -1 << 8 * len(raw) - 1
        return Signal(name, nan if is_least else value * scales[kind], unit.strip("-"))
    if register == 0x000 and value in range(len(_MODES)):
        return Signal(name, _MODES[int(value)], "")
    if register == 0x00F and value in _FAULTS:
        return Signal(name, f"{value:g} ({_FAULTS[int(value)]})", "")
    return Signal(name, value, "")
