"""Error behaviour (CiA 301, 1029h): effects of errors on the NMT state."""

from typing import Final

from emulators.canopen.nmt import NmtState
from emulators.canopen.object_dictionary import ObjectDictionary

COMMUNICATION: Final = 1  # sub-index: bus-off, a lost heartbeat, a lost guard
DEVICE: Final = 2

_PRE_OPERATIONAL: Final = 0
_NO_CHANGE: Final = 1
_STOPPED: Final = 2


def state_after(od: ObjectDictionary, kind: int, state: int) -> int:
    """Return the NMT state after an error of this kind in `state`."""
    if state != NmtState.OPERATIONAL:
        return state
    behaviour = od.integer(0x1029, kind, _PRE_OPERATIONAL if kind == COMMUNICATION else _NO_CHANGE)
    if behaviour == _PRE_OPERATIONAL:
        return NmtState.PRE_OPERATIONAL
    return NmtState.STOPPED if behaviour == _STOPPED else state
