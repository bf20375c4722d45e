"""Register map of a PR-mode drive: names, addresses and contents.

The vendor's manuals name parameters Pr group.number. Their addresses are: group 0 at 0001h + 2n, 4
at 0141h + 2n, 5 at 0191h + 2n, 6 at 01E1h + 2n, 8 at 6000h + n, 9 at 6200h + n (eight for each of
the sixteen paths).

Source: several independent public drivers for DM556RS, iCL-RS, iSV2-RS and DM2J drives agree on
everything without a mark. Items marked "*" are in one of them only, or follow quotations of the
vendors' manuals there.
"""

from typing import Final

from motorhil.emulators.modbus.registers import Access, Kind, Register

PATHS: Final = 16
INPUTS: Final = 7

# 1003h, motion status
FAULT: Final = 0x0001
ENABLED: Final = 0x0002
RUNNING: Final = 0x0004
COMMAND_DONE: Final = 0x0010
PATH_DONE: Final = 0x0020
HOMED: Final = 0x0040

# 6002h, trigger
RUN_PATH: Final = 0x010  # + number of the path
RUN_HOMING: Final = 0x020
SET_ZERO: Final = 0x021
QUICK_STOP: Final = 0x040
PATH_RUNS: Final = 0x100  # read: + number of the path
POSITIONING_DONE: Final = 0x200  # read: *

# 1801h, control word
RESET_ALARM: Final = 0x1111
SAVE: Final = 0x2211
RESTORE: Final = 0x2222  # *
JOG_FORWARD: Final = 0x4001
JOG_BACKWARD: Final = 0x4002

# 6200h + 8n, mode of a path
KIND_MASK: Final = 0x000F
NO_ACTION: Final = 0
POSITIONING: Final = 1
VELOCITY: Final = 2
HOMING: Final = 3  # *
INTERRUPTS: Final = 0x0010  # *
RELATIVE: Final = 0x0040
JUMPS: Final = 0x4000  # *
JUMP_SHIFT: Final = 8  # *, to this path (6 bits)

# alarms, 2203h: *
OVER_CURRENT: Final = 0x01
OVER_VOLTAGE: Final = 0x02
FOLLOWING_ERROR: Final = 0x20

_R: Final = Access.READ
_FAST_MS: Final = "ms/1000rpm"


def _path(number: int) -> list[Register]:
    at, name = 0x6200 + 8 * number, f"path{number}_"
    return [
        Register(
            at, name + "mode", behaviour="1 position, 2 velocity, +40h relative, +10h interrupts*"
        ),
        Register(at + 1, name + "position", Kind.I32, "pulse", behaviour="target, or distance"),
        Register(at + 3, name + "speed", Kind.I16, "rpm", default=60, low=-6000, high=6000),
        Register(at + 4, name + "acceleration", unit=_FAST_MS, default=100, low=1, high=32767),
        Register(at + 5, name + "deceleration", unit=_FAST_MS, default=100, low=1, high=32767),
        Register(
            at + 6, name + "dwell", unit="ms", high=32767, behaviour="before path done, or jump"
        ),
        Register(at + 7, name + "special", behaviour="path 0: written as 6002h, it triggers*"),
    ]


def _input(number: int) -> Register:
    # 25h and 26h: limit switches, 27h: home switch, 22h: emergency stop.
    return Register(0x0145 + 2 * number, f"input{number}_function", behaviour="25h 26h 27h 22h")


ROWS: Final = (
    Register(0x0001, "pulses_per_revolution", unit="pulse", default=10000, low=200, high=51200),
    Register(0x0007, "direction", high=1, behaviour="1: the other way round"),
    Register(0x000F, "force_enable", high=1, behaviour="1: the motor has current"),
    *(_input(number) for number in range(INPUTS)),
    Register(0x0191, "peak_current", unit="0.1 A", low=1, high=700, default=80),
    Register(0x01E1, "jog_speed", Kind.U16, "rpm", default=60, high=3000),  # *
    Register(0x01E7, "jog_acceleration", unit=_FAST_MS, default=100, low=1, high=10000),  # *
    Register(0x1003, "motion_status", access=_R, behaviour="bits: fault enabled running - done"),
    Register(0x1014, "feedback_position", Kind.I32, "pulse", _R),
    Register(0x1046, "feedback_speed", Kind.I32, "rpm", _R, "upper half FFFFh when idle, in some"),
    Register(
        0x1801, "control_word", access=Access.WRITE, behaviour="1111h 2211h 2222h* 4001h 4002h"
    ),
    Register(0x2203, "alarm", access=_R, behaviour="0: none"),
    Register(0x6000, "pr_control", default=0),  # *
    Register(0x6002, "trigger", behaviour="10h + path, 20h home, 21h set zero, 40h quick stop"),
    Register(0x6006, "limit_forward", Kind.I32, "pulse", default=0, behaviour="software limit*"),
    Register(0x6008, "limit_backward", Kind.I32, "pulse", default=0, behaviour="software limit*"),
    Register(0x600A, "homing_mode", behaviour="bit 0: forward; bit 2: by home switch, else limit*"),
    Register(0x600B, "zero_position", Kind.I32, "pulse", behaviour="position at the switch*"),
    Register(0x600D, "home_stop_position", Kind.I32, "pulse"),  # *
    Register(0x600F, "homing_speed_high", unit="rpm", default=200, low=1, high=6000),
    Register(0x6010, "homing_speed_low", unit="rpm", default=50, low=1, high=6000),
    Register(0x6011, "homing_acceleration", unit=_FAST_MS, default=100, low=1, high=32767),
    Register(0x6012, "homing_deceleration", unit=_FAST_MS, default=100, low=1, high=32767),
    Register(0x6016, "limit_deceleration", unit=_FAST_MS, default=10, low=1, high=32767),  # *
    Register(0x6017, "quick_stop_deceleration", unit=_FAST_MS, default=10, low=1, high=32767),  # *
    Register(0x602C, "motor_position", Kind.I32, "pulse", _R, "as commanded"),
    *(row for number in range(PATHS) for row in _path(number)),
)

SAVED: Final = tuple(
    row.name for row in ROWS if row.access is Access.READ_WRITE and row.name != "trigger"
)
"""The registers that "save" keeps for the next power-on."""
