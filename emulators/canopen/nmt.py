"""NMT slave (CiA 301, 7.3.2.2): four states, five commands, one table.

INITIALISING passes into PRE-OPERATIONAL by itself, with the boot-up message; the resets lead back
to it. What works in which state (CiA 301, table 38): SDO, SYNC and EMCY in PRE-OPERATIONAL and
OPERATIONAL, PDOs in OPERATIONAL only, NMT and error control in all but INITIALISING.
"""

from enum import IntEnum, unique
from typing import Final, final


@final
@unique
class NmtState(IntEnum):
    """The states; the value is what a heartbeat carries (INITIALISING: the boot-up message)."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


@final
@unique
class NmtCommand(IntEnum):
    """The command specifiers of the NMT protocol."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


# Where a command leads; transition numbers as in CiA 301, figure 48. Resets are told apart by the
# command: both lead to INITIALISING.
TRANSITIONS: Final[dict[tuple[int, int], int]] = {
    (NmtState.PRE_OPERATIONAL, NmtCommand.START): NmtState.OPERATIONAL,  # 3
    (NmtState.STOPPED, NmtCommand.START): NmtState.OPERATIONAL,  # 6
    (NmtState.OPERATIONAL, NmtCommand.STOP): NmtState.STOPPED,  # 8
    (NmtState.PRE_OPERATIONAL, NmtCommand.STOP): NmtState.STOPPED,  # 5
    (NmtState.OPERATIONAL, NmtCommand.ENTER_PRE_OPERATIONAL): NmtState.PRE_OPERATIONAL,  # 4
    (NmtState.STOPPED, NmtCommand.ENTER_PRE_OPERATIONAL): NmtState.PRE_OPERATIONAL,  # 7
    (NmtState.PRE_OPERATIONAL, NmtCommand.RESET_NODE): NmtState.INITIALISING,  # 11
    (NmtState.OPERATIONAL, NmtCommand.RESET_NODE): NmtState.INITIALISING,  # 9
    (NmtState.STOPPED, NmtCommand.RESET_NODE): NmtState.INITIALISING,  # 10
    (NmtState.PRE_OPERATIONAL, NmtCommand.RESET_COMMUNICATION): NmtState.INITIALISING,  # 14
    (NmtState.OPERATIONAL, NmtCommand.RESET_COMMUNICATION): NmtState.INITIALISING,  # 12
    (NmtState.STOPPED, NmtCommand.RESET_COMMUNICATION): NmtState.INITIALISING,  # 13
}


def commanded(frame: bytes, node_id: int) -> int:
    """The command in an NMT frame for this node (0: all nodes); 0 if it holds none."""
    if frame[4] != 2 or frame[9] not in (0, node_id):
        return 0
    return frame[8]
