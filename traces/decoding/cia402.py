"""Passive decoder of CiA 402 controlword, statusword and modes, into words.

Source: CiA 402-2 (IEC 61800-7-201), PDS FSA, controlword 6040h, statusword 6041h, modes 6060h; bits
4 to 6, 9, 12 and 13 depend on the mode of operation.
"""

from functools import lru_cache
from typing import Final

# mask, value, state
STATES: Final = (
    (0x4F, 0x00, "not ready to switch on"),
    (0x4F, 0x40, "switch on disabled"),
    (0x6F, 0x21, "ready to switch on"),
    (0x6F, 0x23, "switched on"),
    (0x6F, 0x27, "operation enabled"),
    (0x6F, 0x07, "quick stop active"),
    (0x4F, 0x0F, "fault reaction active"),
    (0x4F, 0x08, "fault"),
)
UNKNOWN_STATE: Final = len(STATES)
_COMMANDS: Final = (
    (0x82, 0x00, "disable voltage"),
    (0x86, 0x02, "quick stop"),
    (0x87, 0x06, "shutdown"),
    (0x8F, 0x07, "switch on"),
    (0x8F, 0x0F, "enable operation"),
)
MODES: Final = {
    0: "none",
    1: "pp (profile position)",
    2: "vl (velocity)",
    3: "pv (profile velocity)",
    4: "tq (torque)",
    6: "hm (homing)",
    7: "ip (interpolated position)",
    8: "csp (cyclic synchronous position)",
    9: "csv (cyclic synchronous velocity)",
    10: "cst (cyclic synchronous torque)",
}
_CONTROL_BITS: Final[dict[int, tuple[tuple[int, str], ...]]] = {
    1: (
        (4, "new set-point"),
        (5, "change immediately"),
        (6, "relative"),
        (9, "change on set-point"),
    ),
    6: ((4, "start homing"),),
    7: ((4, "enable interpolation"),),
}
_STATUS_BITS: Final[dict[int, tuple[tuple[int, str], ...]]] = {
    1: ((12, "set-point acknowledge"), (13, "following error")),
    3: ((12, "speed is 0"), (13, "max slippage error")),
    6: ((12, "homing attained"), (13, "homing error")),
    7: ((12, "interpolation active"),),
    8: ((12, "follows the target"), (13, "following error")),
    9: ((12, "follows the target"),),
    10: ((12, "follows the target"),),
}


@lru_cache(1024)
def controlword_text(word: int, mode: int = 0, before: int | None = None) -> str:
    """Return the command in a controlword, and its mode-specific bits, in words.

    Args:
        word: the controlword.
        mode: the mode of operation; 0: unknown, then its bits are listed by number.
        before: the previous controlword; None: unknown. A fault reset is the edge of bit 7.
    """
    if word & 0x80:
        fresh = before is None or not before & 0x80
        told = ["fault reset" if fresh else "fault reset, still set: no command"]
    else:
        told = [name for mask, value, name in _COMMANDS if word & mask == value]
    halted = ((8, "halt"),)
    return ", ".join(told + _bits(word, (4, 5, 6, 9), _CONTROL_BITS.get(mode, ()) + halted, mode))


def state_number(word: int) -> int:
    """Return the index of a statusword's state in `STATES`, or `UNKNOWN_STATE`."""
    for number, (mask, value, _) in enumerate(STATES):
        if word & mask == value:
            return number
    return UNKNOWN_STATE


def state_of(word: int) -> str:
    """Return the PDS FSA state in a statusword; an unknown state with its bits."""
    number = state_number(word)
    return STATES[number][2] if number < len(STATES) else f"no state (bits {word & 0x6F:02X}h)"


@lru_cache(1024)
def statusword_text(word: int, mode: int = 0) -> str:
    """Return a statusword in words; voltage and remote only if they are missing.

    Args:
        word: the statusword.
        mode: the mode of operation; 0: unknown, then bits 12 and 13 are listed by number.
    """
    told = [state_of(word)]
    if word & 0x80:
        told.append("warning")
    if not word & 0x10 and word & 0x6F in (0x23, 0x27, 0x07):
        told.append("no voltage")
    if not word & 0x200 and word & 0x6F in (0x23, 0x27, 0x07):
        told.append("not remote")
    common = ((10, "target reached"), (11, "internal limit active"))
    return ", ".join(told + _bits(word, (12, 13), common + _STATUS_BITS.get(mode, ()), mode))


def mode_text(mode: int) -> str:
    """Return a mode of operation in words."""
    if mode in MODES:
        return MODES[mode]
    return f"mode {mode}, the manufacturer's" if mode < 0 else f"mode {mode}, reserved"


def _bits(
    word: int, own: tuple[int, ...], names: tuple[tuple[int, str], ...], mode: int
) -> list[str]:
    """Return the names of set bits; without a known mode, its bits by number."""
    told = [name for bit, name in names if word & 1 << bit]
    if mode == 0:
        told += [f"bit {bit}" for bit in own if word & 1 << bit]
    return told
