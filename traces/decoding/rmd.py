"""Frames of a MyActuator RMD in words: requests and answers.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

from collections.abc import Callable
from typing import Final

from motorhil.traces.can_frame import EFF, ERR, RTR, SFF_MASK, fields
from motorhil.traces.decoding.narrative import BusMessage, Signal

_Layout = tuple[tuple[str, int, int, float, str], ...]  # name, byte, size (< 0: signed), divisor

_REQUEST, _ANSWER, _ALL, _SETTING = 0x140, 0x240, 0x280, 0x300
_NODES: Final = 32
_INDEX: Final = ("index", 1, 1, 1, "")
_NUMBER: Final = ("value", 4, 4, 1, "")
_DPS: Final = ("speed limit", 2, 2, 1, "deg/s")
_ANGLE: Final = ("angle", 4, -4, 100, "deg")
_MOTION: Final[_Layout] = (
    ("temperature", 1, -1, 1, "C"),
    ("current", 2, -2, 100, "A"),
    ("speed", 4, -2, 1, "deg/s"),
    ("angle", 6, -2, 1, "deg"),
)
_PULSES: Final[_Layout] = (("position", 4, -4, 1, "pulses"),)
_COMMANDS: Final[dict[int, tuple[str, _Layout, _Layout]]] = {  # name, request, answer
    0x20: ("function control", (_INDEX, _NUMBER), (_INDEX, _NUMBER)),
    0x30: ("read gain", (_INDEX,), (_INDEX,)),
    0x31: ("write gain to RAM", (_INDEX,), (_INDEX,)),
    0x32: ("write gain to ROM", (_INDEX,), (_INDEX,)),
    0x42: ("read acceleration", (_INDEX,), (_INDEX, ("value", 4, 4, 1, "deg/s^2"))),
    0x43: ("write acceleration", (_INDEX, ("value", 4, 4, 1, "deg/s^2")), (_INDEX,)),
    0x60: ("encoder position", (), _PULSES),
    0x61: ("raw encoder position", (), _PULSES),
    0x62: ("encoder offset", (), _PULSES),
    0x63: ("write encoder offset", _PULSES, _PULSES),
    0x64: ("zero here", (), _PULSES),
    0x70: ("operating mode", (), (("mode", 7, 1, 1, ""),)),
    0x71: ("power", (), (("power", 6, 2, 10, "W"),)),
    0x76: ("reset", (), ()),
    0x77: ("release brake", (), ()),
    0x78: ("lock brake", (), ()),
    0x79: ("CAN ID", (("read", 2, 1, 1, ""), ("ID", 7, 1, 1, "")), ()),
    0x80: ("shutdown", (), ()),
    0x81: ("stop", (), ()),
    0x90: ("single-turn encoder", (), (("position", 2, 2, 1, "pulses"),)),
    0x92: ("multi-turn angle", (), (_ANGLE,)),
    0x94: ("single-turn angle", (), (("angle", 6, 2, 100, "deg"),)),
    0x9A: (
        "status 1",
        (),
        (
            ("temperature", 1, -1, 1, "C"),
            ("brake released", 3, 1, 1, ""),
            ("voltage", 4, 2, 10, "V"),
            ("errors", 6, 2, 1, ""),
        ),
    ),
    0x9C: ("status 2", (), _MOTION),
    0x9D: (
        "status 3",
        (),
        (
            ("temperature", 1, -1, 1, "C"),
            *((f"phase {name}", at, -2, 100, "A") for name, at in (("A", 2), ("B", 4), ("C", 6))),
        ),
    ),
    0xA1: ("torque current", (("current", 4, -2, 100, "A"),), _MOTION),
    0xA2: ("speed", (("speed", 4, -4, 100, "deg/s"),), _MOTION),
    0xA4: ("absolute position", (_DPS, _ANGLE), _MOTION),
    0xA6: (
        "single-turn position",
        (("direction", 1, 1, 1, ""), _DPS, ("angle", 4, 2, 100, "deg")),
        (*_MOTION[:3], ("position", 6, 2, 1, "pulses")),
    ),
    0xA8: ("incremental position", (_DPS, _ANGLE), _MOTION),
    0xB1: ("run time", (), (("time", 4, 4, 1000, "s"),)),
    0xB2: ("software date", (), (("date", 4, 4, 1, ""),)),
    0xB3: ("interruption time", (("time", 4, 4, 1000, "s"),), (("time", 4, 4, 1000, "s"),)),
    0xB5: ("model", (), ()),
    0xB6: ("active reply", (("command", 1, 1, 1, ""), ("on", 2, 1, 1, "")), ()),
    0xF1: ("communication interrupted", (), ()),
}
_ERRORS: Final = {
    **{0x0002: "stall", 0x0004: "under voltage", 0x0008: "over voltage", 0x0010: "over current"},
    **{0x0040: "power overrun", 0x0080: "calibration parameter writing", 0x0100: "over speed"},
    **{0x1000: "motor over temperature", 0x2000: "encoder calibration"},
}


def build(node_id: int) -> Callable[[bytes], BusMessage | None]:
    """Return the decoder of one drive's frames."""

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        if told.fd or told.can_id & (EFF | RTR | ERR) or not told.data:
            return None
        can_id, command = told.can_id & SFF_MASK, told.data[0]
        is_answer = can_id == _ANSWER + node_id
        if not is_answer and can_id not in (_REQUEST + node_id, _ALL, _SETTING):
            return None
        if command not in _COMMANDS:
            return None
        name, request, answer = _COMMANDS[command]
        name += " to all" if can_id == _ALL else ""
        name += " answered" if is_answer and command != 0xF1 else ""
        if len(told.data) != 8:
            return BusMessage(name, problem=f"{len(told.data)} bytes; expected 8")
        signals = []
        for signal, at, size, scale, unit in answer if is_answer else request:
            raw = int.from_bytes(told.data[at : at + abs(size)], "little", signed=size < 0)
            value: int | float | str = raw if scale == 1 else raw / scale
            if signal == "errors":
                value = " | ".join(text for bit, text in _ERRORS.items() if raw & bit) or raw
            signals.append(Signal(signal, value, unit))
        if command == 0xB5 and is_answer:
            signals.append(Signal("model", told.data[1:].rstrip(b"\0").decode("latin-1"), ""))
        return BusMessage(name, tuple(signals))

    return decode
