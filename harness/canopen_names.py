"""Names of identifiers by the CiA 301 pre-defined connection set."""

from collections.abc import Mapping
from typing import Final

_ALL: Final = {0x000: "NMT", 0x080: "SYNC", 0x100: "TIME"}
_SERVICES: Final = {
    1: "EMCY",
    3: "TPDO 1",
    4: "RPDO 1",
    5: "TPDO 2",
    6: "RPDO 2",
    7: "TPDO 3",
    8: "RPDO 3",
    9: "TPDO 4",
    10: "RPDO 4",
    11: "SDO from",
    12: "SDO to",
    14: "heartbeat",
}


def usual_name(identifier: int, nodes: Mapping[int, str]) -> str:
    """Return service and node of an identifier in words, or "" if the set does not define it.

    Args:
        identifier: an 11-bit identifier.
        nodes: node names by node-ID.
    """
    if identifier in _ALL:
        return _ALL[identifier]
    function, node = identifier >> 7, identifier & 0x7F
    what = _SERVICES.get(function)
    if what is None or not node:
        return ""
    return f"{what} {nodes.get(node, f'node {node}')}"


def is_sdo(identifier: int) -> bool:
    """Return True for a request or response identifier of the default SDO channel."""
    return 0x581 <= identifier <= 0x5FF or 0x601 <= identifier <= 0x67F
