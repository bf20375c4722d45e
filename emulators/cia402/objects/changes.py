"""Kinds of objects written since the drive last looked, one bit for each."""

from typing import Final, final

from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary

CONTROLWORD: Final = 1
MODE: Final = 2
TARGET_POSITION: Final = 4
TARGET_VELOCITY: Final = 8
RAMPS: Final = 16
WINDOWS: Final = 32
FACTORS: Final = 64
TORQUE: Final = 128  # target or slope
TORQUE_LIMIT: Final = 256
GAINS: Final = 512
OFFSETS: Final = 1024
IP_DATA: Final = 2048
MOTION_LIMITS: Final = 4096
POSITION_LIMITS: Final = 8192
TOUCH_PROBE: Final = 8192

# index, sub-index, kind
_WATCHED: Final = (
    (0x6065, 0, WINDOWS),
    (0x6066, 0, WINDOWS),
    (0x6067, 0, WINDOWS),
    (0x6068, 0, WINDOWS),
    (0x606D, 0, WINDOWS),
    (0x606E, 0, WINDOWS),
    (0x606F, 0, WINDOWS),
    (0x6070, 0, WINDOWS),
    (0x6071, 0, TORQUE),
    *((index, 0, TORQUE_LIMIT) for index in (0x6072, 0x6073, 0x60E0, 0x60E1)),
    (0x6075, 0, FACTORS | TORQUE_LIMIT),
    (0x6076, 0, FACTORS | TORQUE_LIMIT),
    (0x6087, 0, TORQUE),
    *((index, 0, OFFSETS) for index in (0x60B0, 0x60B1, 0x60B2)),
    *((index, 0, RAMPS | MOTION_LIMITS) for index in (0x607F, 0x6080, 0x60C5, 0x60C6)),
    (0x607C, 0, POSITION_LIMITS),  # because the limits count from home
    *((0x607D, subindex, POSITION_LIMITS) for subindex in (1, 2)),
    (0x6083, 0, RAMPS),
    (0x6084, 0, RAMPS),
    *((0x607B, subindex, FACTORS) for subindex in (1, 2)),
    (0x608C, 0, FACTORS),
    (0x608E, 0, FACTORS),
    (0x608F, 1, FACTORS),
    (0x608F, 2, FACTORS),
    (0x6091, 1, FACTORS),
    (0x6091, 2, FACTORS),
    (0x6092, 1, FACTORS),
    (0x6092, 2, FACTORS),
    (0x6096, 1, FACTORS),
    (0x6096, 2, FACTORS),
    (0x6097, 1, FACTORS),
    (0x6097, 2, FACTORS),
    (0x60A8, 0, FACTORS),
    (0x60A9, 0, FACTORS),
)


@final
class Written:
    """The set of `kinds` as bits; the reader clears them."""

    def __init__(self) -> None:
        self.kinds: int = 0


@final
class Watch:
    """A writer that accepts every value and records its kind."""

    def __init__(self, written: Written, kind: int) -> None:
        self._written = written
        self._kind = kind

    def write(self, value: int) -> int:
        """Record the kind before the value is stored; always allowed."""
        self._written.kinds |= self._kind
        return OK


@final
class Choice:
    """A writer that accepts only values with an effect, and records its kind."""

    def __init__(
        self, written: Written, kind: int, allowed: frozenset[int], refused_with: int
    ) -> None:
        self._written = written
        self._kind = kind
        self._allowed = allowed
        self._refused_with = refused_with

    def write(self, value: int) -> int:
        """Check a value before it is stored; return 0 or the abort code."""
        if value not in self._allowed:
            return self._refused_with
        self._written.kinds |= self._kind
        return OK


def watch(od: ObjectDictionary, written: Written) -> None:
    """Install a writer in every visible object of the table."""
    for index, subindex, kind in _WATCHED:
        variable = od.get(index, subindex)
        if variable is not None:
            variable.writer = Watch(written, kind).write
