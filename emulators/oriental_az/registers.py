"""Register map of an AZ drive: names, addresses and contents.

All registers have 32 bits, upper half first. The block from 0058h to 0067h is written in one
request; its last row is the trigger.

Source: an open-source client for AZD drives, and the trigger description of the maker's emulator,
agree on everything without a mark. Items marked "*" follow quotations of the vendor's manuals.

Left out, because the sources only mention them: the lifetime in the upper half of the trigger (its
unit, and its effect), and the response to a request for one half of a row, which clients should not
send. Here a half is read, and written, as any register.
"""

from typing import Final

from motorhil.emulators.modbus.registers import Access, Kind, Register

TABLE: Final = 8  # operation data selected by the inputs M0 to M2

# operation types
DECELERATE: Final = 0
ABSOLUTE: Final = 1
RELATIVE_TO_COMMAND: Final = 2
RELATIVE_TO_FEEDBACK: Final = 3
CONTINUOUS: Final = 16
STOP_AT_ONCE: Final = 32
TYPES: Final = (
    *(DECELERATE, ABSOLUTE, RELATIVE_TO_COMMAND, RELATIVE_TO_FEEDBACK),
    *(CONTINUOUS, STOP_AT_ONCE),
)

TRIGGER_ALL: Final = 1
TRIGGERS: Final = {
    -7: "data_number",
    -6: "operation_type",
    -5: "position",
    -4: "speed",
    -3: "rate",
    -2: "deceleration",
    -1: "current",
}
"""The trigger values that make a single item of the block effective: *"""

# inputs, 007Dh
M_MASK: Final = 0x0007
START: Final = 0x0008
ZHOME: Final = 0x0010
STOP: Final = 0x0020
FREE: Final = 0x0040
ALARM_RESET: Final = 0x0080
FORWARD: Final = 0x4000  # *
BACKWARD: Final = 0x8000  # *

# outputs, 007Fh
HOME_END: Final = 0x0010  # *
READY: Final = 0x0020
ALARM: Final = 0x0080
BUSY: Final = 0x0100
MOVE: Final = 0x2000
IN_POSITION: Final = 0x4000

# alarms, 0080h
EXCESSIVE_DEVIATION: Final = 0x10
ALARMS: Final = {
    0x10: "excessive position deviation",
    0x20: "overcurrent",
    0x21: "main circuit overheat",
    0x22: "overvoltage",
    0x23: "main power supply off",
    0x25: "undervoltage",
    0x26: "motor overheat",
    0x28: "sensor error",
}

_R: Final = Access.READ
_I32: Final = Kind.I32
_U32: Final = Kind.U32
_RATE_MAX: Final = 1_000_000_000
_SPEED_MAX: Final = 4_000_000


def _data(at: int, name: str) -> list[Register]:
    return [
        Register(at, name + "operation_type", _U32, high=32, behaviour="0 1 2 3 16 32"),
        Register(at + 2, name + "position", _I32, "step", behaviour="target, or distance"),
        Register(
            at + 4, name + "speed", _I32, "Hz", default=1000, low=-_SPEED_MAX, high=_SPEED_MAX
        ),
        Register(at + 6, name + "rate", _U32, "Hz/s", default=1_000_000, low=1, high=_RATE_MAX),
        Register(
            at + 8, name + "deceleration", _U32, "Hz/s", default=1_000_000, low=1, high=_RATE_MAX
        ),
        Register(at + 10, name + "current", _U32, "0.1 %", default=1000, high=1000),
    ]


ROWS: Final = (
    Register(0x0058, "data_number", _U32, high=255, behaviour="what data the rest is a change of"),
    *_data(0x005A, ""),
    Register(0x0066, "trigger", _I32, low=-7, high=1, behaviour="1: all counts; -7..-1: one item*"),
    Register(0x0068, "forwarding", _U32, high=1, behaviour="where to: the buffer, or now*"),
    Register(0x0078, "inputs_auto_off", _U32, behaviour="as inputs, and off again by itself*"),
    Register(0x007C, "inputs", _U32, behaviour="M0-2 START ZHOME STOP FREE ALM-RST"),
    Register(0x007E, "outputs", _U32, "", _R, "HOME-END* READY ALM-A SYS-BSY MOVE IN-POS"),
    Register(0x0080, "alarm", _U32, "", _R, "0: none*"),
    Register(0x00C6, "command_position", _I32, "step", _R),
    Register(0x00CA, "command_speed", _I32, "Hz", _R),  # *
    Register(0x00CC, "feedback_position", _I32, "step", _R),  # *
    Register(0x00CE, "feedback_speed_rpm", _I32, "r/min", _R),  # *
    Register(0x00D0, "feedback_speed", _I32, "Hz", _R),  # *
    Register(0x0180, "alarm_reset", _U32, "", high=1, behaviour="1 resets it*"),
    Register(0x018A, "preset", _U32, "", high=1, behaviour="1: the position here is 0*"),
    Register(0x0380, "gear_a", _U32, "", default=1, low=1, high=65535),  # *
    Register(0x0382, "gear_b", _U32, "", default=1, low=1, high=65535),  # *: 1000 b/a steps a turn
    *(row for n in range(TABLE) for row in _data(0x1800 + 0x40 * n, f"data{n}_")),  # *
)
STEPS_PER_TURN: Final = 1000
