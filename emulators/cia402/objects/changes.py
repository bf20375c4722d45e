"""Kinds of objects written since the drive last applied them."""

from enum import IntFlag, auto
from typing import Final, final

from motorhil.emulators.canopen.codes import OK, AbortCode
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary

_INVALID_VALUE: Final = int(AbortCode.INVALID_VALUE)


class ObjectChange(IntFlag):
    """Kinds of objects that a drive applies after they were written.

    Modules test masks of `int(ObjectChange...)`: an operation of IntFlag takes about 1 us.
    """

    CONTROLWORD = auto()
    MODE = auto()
    TARGET_POSITION = auto()
    TARGET_VELOCITY = auto()
    RAMPS = auto()
    WINDOWS = auto()
    FACTORS = auto()
    TORQUE = auto()  # target or slope
    TORQUE_LIMIT = auto()
    GAINS = auto()
    OFFSETS = auto()
    IP_DATA = auto()
    MOTION_LIMITS = auto()
    POSITION_LIMITS = auto()
    TOUCH_PROBE = auto()


_C = ObjectChange

# index, sub-indices, kinds
_WATCHED: Final = (
    *((index, (0,), _C.WINDOWS) for index in (0x6065, 0x6066, 0x6067, 0x6068)),
    *((index, (0,), _C.WINDOWS) for index in (0x606D, 0x606E, 0x606F, 0x6070)),
    *((index, (0,), _C.TORQUE) for index in (0x6071, 0x6087)),
    *((index, (0,), _C.TORQUE_LIMIT) for index in (0x6072, 0x6073, 0x60E0, 0x60E1)),
    *((index, (0,), _C.FACTORS | _C.TORQUE_LIMIT) for index in (0x6075, 0x6076)),
    *((index, (0,), _C.OFFSETS) for index in (0x60B0, 0x60B1, 0x60B2)),
    *((index, (0,), _C.RAMPS | _C.MOTION_LIMITS) for index in (0x607F, 0x6080, 0x60C5, 0x60C6)),
    *((index, (0,), _C.RAMPS) for index in (0x6083, 0x6084)),
    (0x607C, (0,), _C.POSITION_LIMITS),  # because the limits count from home
    (0x607D, (1, 2), _C.POSITION_LIMITS),
    *((index, (0,), _C.FACTORS) for index in (0x608C, 0x608E, 0x60A8, 0x60A9)),
    *((index, (1, 2), _C.FACTORS) for index in (0x607B, 0x608F, 0x6091, 0x6092, 0x6096, 0x6097)),
)


@final
class ObjectChanges:
    """The changes that are `pending`, as bits of `ObjectChange`; the drive clears them."""

    def __init__(self) -> None:
        self.pending: int = 0


@final
class Watch:
    """A writer that accepts every value and records its kind."""

    def __init__(self, changes: ObjectChanges, kind: int) -> None:
        self._changes = changes
        self._kind = kind

    def write(self, value: int) -> int:
        """Record the kind before the value is stored; always allowed."""
        self._changes.pending |= self._kind
        return OK


@final
class Choice:
    """A writer that accepts only values with an effect."""

    def __init__(
        self, allowed: frozenset[int], changes: ObjectChanges | None = None, kind: int = 0
    ) -> None:
        self._allowed = allowed
        self._changes = changes
        self._kind = kind

    def write(self, value: int) -> int:
        """Check a value before it is stored; return 0 or the abort code."""
        if value not in self._allowed:
            return _INVALID_VALUE
        if self._changes is not None:
            self._changes.pending |= self._kind
        return OK


def watch(od: ObjectDictionary, changes: ObjectChanges) -> None:
    """Install a writer in every visible object of the table."""
    for index, subindices, kind in _WATCHED:
        writer = Watch(changes, int(kind)).write
        for subindex in subindices:
            variable = od.get(index, subindex)
            if variable is not None:
                variable.writer = writer
