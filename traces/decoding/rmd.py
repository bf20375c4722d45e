"""Frames of a MyActuator RMD in words: requests and answers.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

from collections.abc import Callable
from typing import Final

from motorhil.traces.can_frame import EFF, ERR, RTR, SFF_MASK, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Signal, layouts

_REQUEST, _ANSWER, _ALL, _SETTING = 0x140, 0x240, 0x280, 0x300
_IMPEDANCE, _IMPEDANCE_ANSWER = 0x400, 0x500  # motion mode
_SINGLE: Final = "@1 temperature i8 C; current i16/100 A; speed i16 deg/s"
_MOTION: Final = f"{_SINGLE}; angle i16 deg"
_COMMANDS: Final = layouts(  # request | answer
    f"""
20 function control: @1 index u8; @4 value u32 | @1 index u8; @4 value u32
30 read gain: @1 index u8 | @1 index u8
31 write gain to RAM: @1 index u8 | @1 index u8
32 write gain to ROM: @1 index u8 | @1 index u8
42 read acceleration: @1 index u8 | @1 index u8; @4 value u32 deg/s^2
43 write acceleration: @1 index u8; @4 value u32 deg/s^2 | @1 index u8
60 encoder position: | @4 position i32 pulses
61 raw encoder position: | @4 position i32 pulses
62 encoder offset: | @4 position i32 pulses
63 write encoder offset: @4 position i32 pulses | @4 position i32 pulses
64 zero here: | @4 position i32 pulses
70 operating mode: | @7 mode u8
71 power: | @6 power u16/10 W
76 reset: |
77 release brake: |
78 lock brake: |
79 CAN ID: @2 read u8; @7 ID u8 |
80 shutdown: |
81 stop: |
90 single-turn encoder: | @2 position u16 pulses
92 multi-turn angle: | @4 angle i32/100 deg
94 single-turn angle: | @6 angle u16/100 deg
9A status 1: | @1 temperature i8 C; @3 brake released u8; voltage u16/10 V; errors u16
9C status 2: | {_MOTION}
9D status 3: | @1 temperature i8 C; phase A i16/100 A; phase B i16/100 A; phase C i16/100 A
A1 torque current: @4 current i16/100 A | {_MOTION}
A2 speed: @4 speed i32/100 deg/s | {_MOTION}
A4 absolute position: @2 speed limit u16 deg/s; angle i32/100 deg | {_MOTION}
A6 single-turn position: @1 direction u8; speed limit u16 deg/s; angle u16/100 deg |
  {_SINGLE}; position u16 pulses
A8 incremental position: @2 speed limit u16 deg/s; angle i32/100 deg | {_MOTION}
B1 run time: | @4 time u32/1000 s
B2 software date: | @4 date u32
B3 interruption time: @4 time u32/1000 s | @4 time u32/1000 s
B5 model: |
B6 active reply: @1 command u8; on u8 |
F1 communication interrupted: |
""",
    base=16,
)
_FORCES: Final = {  # of motion mode: bits, least and largest value, unit
    "p": (16, -12.5, 12.5, "rad"),
    "v": (12, -45.0, 45.0, "rad/s"),
    "kp": (12, 0.0, 500.0, "N m/rad"),
    "kd": (12, 0.0, 5.0, "N m s/rad"),
    "t": (12, -24.0, 24.0, "N m"),
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
        if can_id in (_IMPEDANCE + node_id, _IMPEDANCE_ANSWER + node_id):
            return _motion_mode(told.data, can_id == _IMPEDANCE_ANSWER + node_id)
        is_answer = can_id == _ANSWER + node_id
        if not is_answer and can_id not in (_REQUEST + node_id, _ALL, _SETTING):
            return None
        if command not in _COMMANDS:
            return None
        name, kinds = _COMMANDS[command]
        name += " to all" if can_id == _ALL else ""
        name += " answered" if is_answer and command != 0xF1 else ""
        if len(told.data) != 8:
            return BusMessage(name, problem=f"{len(told.data)} bytes; expected 8")
        signals = []
        for signal in kinds[is_answer].signals(told.data):
            if signal.name == "errors":
                bits = int(signal.value)
                named = [text for bit, text in _ERRORS.items() if bits & bit]
                signal = Signal("errors", " | ".join(named) or bits, "")
            signals.append(signal)
        if command == 0xB5 and is_answer:
            signals.append(Signal("model", told.data[1:].rstrip(b"\0").decode("latin-1"), ""))
        return BusMessage(name, tuple(signals))

    return decode


def _motion_mode(data: bytes, is_answer: bool) -> BusMessage:
    """Return a frame of motion mode: codes, the highest bits first; an answer has the ID before."""
    name = "motion mode answered" if is_answer else "motion mode"
    if len(data) != 8:
        return BusMessage(name, problem=f"{len(data)} bytes; expected 8")
    bits, left = int.from_bytes(data, "big"), 56 if is_answer else 64
    signals = []
    for one in ("p", "v", "t") if is_answer else _FORCES:
        size, low, high, unit = _FORCES[one]
        left -= size
        code = bits >> left & ((1 << size) - 1)
        value = low + code * (high - low) / ((1 << size) - 1)
        signals.append(Signal(one, float(f"{value:.4g}"), unit))
    return BusMessage(name, tuple(signals))
