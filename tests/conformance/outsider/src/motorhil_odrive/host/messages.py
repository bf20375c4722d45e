"""CANSimple, as the host implements it: messages as signals at bit positions.

An 11-bit identifier is the six-bit node-ID, followed by the five-bit command. Bit 0 is the lowest
bit of the first byte. A message is one number, least significant byte first.

Source: the message set of firmware 0.6.10, as ODrive describes it in a DBC.
"""

import struct
from typing import Final, NamedTuple


class Signal(NamedTuple):
    """A signal of `bits` bits at bit `at`: "u" unsigned, "i" signed, or "f" IEEE 754 single."""

    name: str
    at: int
    bits: int
    kind: str
    scale: float = 1.0


class Message(NamedTuple):
    """A command number, the length of its frame, and its signals."""

    command: int
    length: int
    signals: tuple[Signal, ...] = ()


def _two(command: int, first: str, second: str, kind: str = "f") -> Message:
    return Message(command, 8, (Signal(first, 0, 32, kind), Signal(second, 32, 32, kind)))


def _one(command: int, name: str, kind: str = "f") -> Message:
    return Message(command, 8, (Signal(name, 0, 32, kind),))


VERSION: Final = Message(
    0,
    8,
    tuple(
        Signal(name, 8 * place, 8, "u")
        for place, name in enumerate(
            (
                "protocol",
                *(f"hardware_{part}" for part in ("major", "minor", "variant")),
                *(f"firmware_{part}" for part in ("major", "minor", "revision", "unreleased")),
            )
        )
    ),
)
HEARTBEAT: Final = Message(
    1,
    8,
    (
        Signal("error", 0, 32, "u"),
        Signal("state", 32, 8, "u"),
        Signal("result", 40, 8, "u"),
        Signal("done", 48, 1, "u"),
    ),
)
ESTOP: Final = Message(2, 0)
ERRORS: Final = _two(3, "active", "disarm_reason", "u")
AXIS_STATE: Final = _one(7, "state", "u")
ESTIMATES: Final = _two(9, "position", "velocity")
CONTROLLER_MODE: Final = _two(11, "control", "input", "u")
INPUT_POSITION: Final = Message(
    12,
    8,
    (
        Signal("position", 0, 32, "f"),
        Signal("velocity", 32, 16, "i", 0.001),
        Signal("torque", 48, 16, "i", 0.001),
    ),
)
INPUT_VELOCITY: Final = _two(13, "velocity", "torque")
INPUT_TORQUE: Final = _one(14, "torque")
LIMITS: Final = _two(15, "velocity", "current")
TRAJECTORY_VELOCITY: Final = _one(17, "velocity")
TRAJECTORY_ACCELERATION: Final = _two(18, "acceleration", "deceleration")
TRAJECTORY_INERTIA: Final = _one(19, "inertia")
CURRENT: Final = _two(20, "wanted", "measured")
TEMPERATURE: Final = _two(21, "inverter", "motor")
REBOOT: Final = Message(22, 1, (Signal("action", 0, 8, "u"),))
SUPPLY: Final = _two(23, "voltage", "current")
CLEAR_ERRORS: Final = Message(24, 1, (Signal("identify", 0, 8, "u"),))
ABSOLUTE_POSITION: Final = _one(25, "position")
POSITION_GAIN: Final = _one(26, "gain")
VELOCITY_GAINS: Final = _two(27, "gain", "integrator_gain")
TORQUES: Final = _two(28, "wanted", "estimate")
POWERS: Final = _two(29, "electrical", "mechanical")
DFU_MODE: Final = Message(31, 0)

TOLD_BY_DRIVE: Final = (
    *(VERSION, HEARTBEAT, ERRORS, ESTIMATES, CURRENT, TEMPERATURE, SUPPLY, TORQUES, POWERS),
)
TOLD_TO_DRIVE: Final = (
    *(ESTOP, AXIS_STATE, CONTROLLER_MODE, INPUT_POSITION, INPUT_VELOCITY, INPUT_TORQUE, LIMITS),
    *(TRAJECTORY_VELOCITY, TRAJECTORY_ACCELERATION, TRAJECTORY_INERTIA, REBOOT, CLEAR_ERRORS),
    *(ABSOLUTE_POSITION, POSITION_GAIN, VELOCITY_GAINS, DFU_MODE),
)

IDLE, CLOSED_LOOP, HOMING = 1, 8, 11  # axis states
TORQUE_CONTROL, VELOCITY_CONTROL, POSITION_CONTROL = 1, 2, 3
PASSTHROUGH, TRAPEZOID = 1, 5  # input modes
PROTOCOL: Final = 2
RESULTS: Final = (
    *("success", "busy", "cancelled", "disarmed", "no response"),
    *("pole pairs and encoder resolution do not match", "phase resistance out of range"),
    *("phase inductance out of range", "unbalanced phases", "invalid motor type"),
    *("illegal Hall state", "timeout", "homing without an end stop", "invalid state"),
    *("not calibrated", "does not converge"),
)
ERROR_TEXTS: Final = {
    0x0000_0001: "initializing",
    0x0000_0002: "system level",
    0x0000_0004: "timing error",
    0x0000_0008: "missing estimate",
    0x0000_0010: "bad configuration",
    0x0000_0020: "gate driver fault",
    0x0000_0040: "missing input",
    0x0000_0100: "DC bus over-voltage",
    0x0000_0200: "DC bus under-voltage",
    0x0000_0400: "DC bus over-current",
    0x0000_0800: "DC bus over-current in regeneration",
    0x0000_1000: "current limit violated",
    0x0000_2000: "motor too hot",
    0x0000_4000: "inverter too hot",
    0x0000_8000: "velocity limit violated",
    0x0001_0000: "position limit violated",
    0x0100_0000: "watchdog timer expired",
    0x0200_0000: "emergency stop requested",
    0x0400_0000: "spin-out detected",
    0x0800_0000: "brake resistor disarmed",
    0x1000_0000: "thermistor disconnected",
    0x4000_0000: "calibration error",
}


def result_text(result: int) -> str:
    """Return the text of a procedure's result."""
    return RESULTS[result] if result < len(RESULTS) else f"result {result}"


def encoded(message: Message, *values: float) -> bytes:
    """Encode a message; integers are limited to their range.

    Raises:
        ValueError: the number of values differs from that of the signals.
    """
    number = 0
    for signal, value in zip(message.signals, values, strict=True):
        if signal.kind == "f":
            raw = int.from_bytes(struct.pack("<f", value), "little")
        else:
            low = -(1 << signal.bits - 1) if signal.kind == "i" else 0
            raw = max(low, min(low + (1 << signal.bits) - 1, round(value / signal.scale)))
        number |= (raw & (1 << signal.bits) - 1) << signal.at
    return number.to_bytes(message.length, "little")


def decoded(message: Message, data: bytes) -> tuple[float, ...] | None:
    """Decode the values of a message's signals, in order; None if it is too short."""
    if len(data) < message.length:
        return None
    number = int.from_bytes(data, "little")
    values: list[float] = []
    for signal in message.signals:
        raw = number >> signal.at & (1 << signal.bits) - 1
        if signal.kind == "f":
            values.append(struct.unpack("<f", raw.to_bytes(4, "little"))[0])
            continue
        if signal.kind == "i" and raw >> signal.bits - 1:
            raw -= 1 << signal.bits
        values.append(raw if signal.scale == 1.0 else raw * signal.scale)
    return tuple(values)
