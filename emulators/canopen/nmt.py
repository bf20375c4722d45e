"""NMT slave (CiA 301, 7.3.2.2): four states, five commands, one table.

INITIALISING passes into PRE-OPERATIONAL by itself, with the boot-up message. The resets lead back
to it. Services by state (CiA 301, table 38): SDO, SYNC and EMCY in PRE-OPERATIONAL and OPERATIONAL,
PDOs in OPERATIONAL only, NMT and error control in all but INITIALISING.

1029h, error behaviour, states the effects of errors on the NMT state.
"""

from enum import IntEnum, unique
from typing import Final, final

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary

COMMUNICATION: Final = 1  # sub-index: bus-off, a lost heartbeat, a lost guard
DEVICE: Final = 2

_PRE_OPERATIONAL: Final = 0
_NO_CHANGE: Final = 1
_STOPPED: Final = 2


@final
@unique
class NmtState(IntEnum):
    """The NMT states, by their value in a heartbeat (INITIALISING: the boot-up message)."""

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


# The state after a command; transition numbers as in CiA 301, figure 48. Both resets lead to
# INITIALISING; the command distinguishes them.
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
    """Return the command in an NMT frame for this node (node-ID 0: all nodes), or 0."""
    if frame[4] != 2 or frame[9] not in (0, node_id):
        return 0
    return frame[8]


def state_after(od: ObjectDictionary, kind: int, state: int) -> int:
    """Return the NMT state after an error of this kind in `state`."""
    if state != NmtState.OPERATIONAL:
        return state
    behaviour = od.integer(0x1029, kind, _PRE_OPERATIONAL if kind == COMMUNICATION else _NO_CHANGE)
    if behaviour == _PRE_OPERATIONAL:
        return NmtState.PRE_OPERATIONAL
    return NmtState.STOPPED if behaviour == _STOPPED else state
