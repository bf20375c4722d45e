"""The statusword (6041h): the bits of each state, and the other bits."""

from typing import Final

from emulators.cia402.pds_fsa import PdsState

VOLTAGE_ENABLED: Final = 0x0010
WARNING: Final = 0x0080
REMOTE: Final = 0x0200  # the controlword is obeyed
TARGET_REACHED: Final = 0x0400
INTERNAL_LIMIT_ACTIVE: Final = 0x0800
MODE_BIT_12: Final = 0x1000
MODE_BIT_13: Final = 0x2000
MODE_BITS: Final = TARGET_REACHED | MODE_BIT_12 | MODE_BIT_13

# pp
SET_POINT_ACKNOWLEDGE: Final = MODE_BIT_12
FOLLOWING_ERROR: Final = MODE_BIT_13
# pv
SPEED_IS_ZERO: Final = MODE_BIT_12
MAX_SLIPPAGE_ERROR: Final = MODE_BIT_13
# hm
HOMING_ATTAINED: Final = MODE_BIT_12
HOMING_ERROR: Final = MODE_BIT_13
# ip
IP_ACTIVE: Final = MODE_BIT_12
# csp, csv, cst
FOLLOWS_COMMAND: Final = MODE_BIT_12

# Bits 0 to 3, 5 and 6, in the order of PdsState's numbers. CiA 402-2, table of state coding; bit 5
# is 0 where the standard leaves it open.
STATE_BITS: Final[tuple[int, ...]] = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)


def compose(
    state: PdsState, mode_bits: int, voltage: bool, remote: bool, limit: bool, warning: bool
) -> int:
    """Return the statusword (unsigned 16 bit) of `state`; `mode_bits` within MODE_BITS."""
    word = STATE_BITS[state] | mode_bits
    if voltage:
        word |= VOLTAGE_ENABLED
    if remote:
        word |= REMOTE
    if limit:
        word |= INTERNAL_LIMIT_ACTIVE
    if warning:
        word |= WARNING
    return word
