"""6502h, supported drive modes: only modes that are emulated.

The bit of a mode is one less than its number in 6060h; bits 16 to 31 are manufacturer-specific.
"""

from collections.abc import Sequence
from typing import Final

from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.cia402.settings import EMULATED_MODES

_STANDARD: Final = 0xFFFF
_EMULATED: Final = sum(1 << (code - 1) for code in EMULATED_MODES.values())
_TARGETS: Final = (
    ("pp", 0x607A),
    ("pv", 0x60FF),
    ("tq", 0x6071),
    ("ip", 0x60C1),
    ("csp", 0x607A),
    ("csv", 0x60FF),
    ("cst", 0x6071),
)


def modes_with_target(od: ObjectDictionary) -> int:
    """Return the emulated modes whose target object exists, for an EDS without a 6502h."""
    modes = _EMULATED
    for name, index in _TARGETS:
        if not od.has_index(index):
            modes &= ~(1 << (EMULATED_MODES[name] - 1))
    return modes


def honest_modes(stated: int, names: Sequence[str] | None) -> int:
    """Return the modes of the rig (None: as stated), without those that are not emulated."""
    wanted = stated & _STANDARD
    if names is not None:
        wanted = 0
        for name in names:
            wanted |= 1 << (EMULATED_MODES[name] - 1)
    return (stated & ~_STANDARD) | (wanted & _EMULATED)
