"""The objects of interpolated position mode and of homing (CiA 402-2).

The zero position is 607Ch beyond home, so the position of home is -607Ch. CiA 402-2 defines it this
way, as do Elmo, Parker, Applied Motion, Fastech and Mitsubishi (MR-J5, Pr. PT08). KEB's F6 has the
opposite sign.

HOMING_METHODS has the homing methods as one table. Every method ends by passing an edge of one
switch in one direction, where the switch changes from `before` to the other state. Home is that
edge, or the first index pulse after it in the same direction. `search` is the direction of the
search if the switch is not active at the start. Methods 7 to 14 and 23 to 30 can meet a limit
switch first, and reverse there; their home switch is a cam in the middle. In 3 to 6 and 19 to 22
the home switch extends to the end of travel. 15, 16, 31 and 32 are reserved; 36 and the negative
ones are not emulated. 35 is obsolete and replaced by 37.
"""

from typing import Final, final

from motorhil.emulators.canopen.codes import OK, AbortCode
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.cia402.objects.changes import Choice, ObjectChange, ObjectChanges
from motorhil.emulators.cia402.objects.motion import MotionObjects
from motorhil.emulators.cia402.objects.units import DriveDefaults, FactorGroup
from motorhil.emulators.firmware.digital_inputs import HOME_SWITCH, NEGATIVE_LIMIT, POSITIVE_LIMIT

BUFFER_MAX: Final = 64
_BUFFER: Final = 16
_FIFO: Final = 0
_RING: Final = 1
_IP_DATA: Final = int(ObjectChange.IP_DATA)
_LINEAR: Final = frozenset((0,))
_D = DataType

_LEFT: Final = -1
_RIGHT: Final = 1
_ON: Final = True
_OFF: Final = False

# Methods 1 to 14; 17 to 30 are the same without the index pulse.
_BY_EDGE: Final = (
    (NEGATIVE_LIMIT, _RIGHT, _ON, _LEFT, False),  # 1, 17
    (POSITIVE_LIMIT, _LEFT, _ON, _RIGHT, False),  # 2, 18
    (HOME_SWITCH, _LEFT, _ON, _RIGHT, False),  # 3, 19: positive home switch
    (HOME_SWITCH, _RIGHT, _OFF, _RIGHT, False),  # 4, 20
    (HOME_SWITCH, _RIGHT, _ON, _LEFT, False),  # 5, 21: negative home switch
    (HOME_SWITCH, _LEFT, _OFF, _LEFT, False),  # 6, 22
    (HOME_SWITCH, _LEFT, _ON, _RIGHT, True),  # 7, 23: left edge, from inside
    (HOME_SWITCH, _RIGHT, _OFF, _RIGHT, True),  # 8, 24: left edge, from outside
    (HOME_SWITCH, _LEFT, _OFF, _RIGHT, True),  # 9, 25: right edge, from outside
    (HOME_SWITCH, _RIGHT, _ON, _RIGHT, True),  # 10, 26: right edge, from inside
    (HOME_SWITCH, _RIGHT, _ON, _LEFT, True),  # 11, 27: the same four, starting to the left
    (HOME_SWITCH, _LEFT, _OFF, _LEFT, True),  # 12, 28
    (HOME_SWITCH, _RIGHT, _OFF, _LEFT, True),  # 13, 29
    (HOME_SWITCH, _LEFT, _ON, _LEFT, True),  # 14, 30
)

_SWITCH_PART: Final = 4  # default 6099h:1 is 6081h divided by this
_ZERO_PART: Final = 40  # default 6099h:2 is 6081h divided by this


@final
class IpObjects:
    """60C0h, 60C1h:1 and 60C4h; records are converted with the units valid when they are taken."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, changes: ObjectChanges) -> None:
        ensure = od.ensure
        self._factors = factors
        self._changes = changes
        self._records: list[int] = []
        ensure(0x60C0, 0, _D.INTEGER16, 0).writer = Choice(_LINEAR).write
        ensure(0x60C1, 1, _D.INTEGER32, 0).writer = self._write_record
        ensure(0x60C4, 1, _D.UNSIGNED32, BUFFER_MAX)
        self._size = ensure(0x60C4, 2, _D.UNSIGNED32, _BUFFER)
        self._size.writer = self._write_size
        self._organisation = ensure(0x60C4, 3, _D.UNSIGNED8, _FIFO)
        self._organisation.writer = Choice(frozenset((_FIFO, _RING))).write
        position = od.get(0x60C4, 4)
        if position is not None:
            position.reader = self._free_place
        length = ensure(0x60C4, 5, _D.UNSIGNED8, 1)
        length.writer = Choice(frozenset((1,))).write
        self._access = ensure(0x60C4, 6, _D.UNSIGNED8, 1)
        self._access.writer = self._write_access

    def reload(self) -> None:
        """Clear the buffer after the objects were reset to their defaults (reset node)."""
        self._records.clear()

    def is_empty(self) -> bool:
        """Return True if the buffer is empty."""
        return not self._records

    def take_inc(self) -> int:
        """Remove and return the oldest record [increments].

        Raises:
            IndexError: the buffer is empty.
        """
        return self._factors.units.position_inc(self._records.pop(0))

    def _write_record(self, value: int) -> int:
        if self._access.integer() == 0:
            return AbortCode.NOT_STORED_DEVICE_STATE
        if len(self._records) >= self._room():
            if self._organisation.integer() != _RING:
                return AbortCode.NOT_STORED_DEVICE_STATE
            self._records.pop(0)
        self._records.append(value)
        self._changes.pending |= _IP_DATA
        return OK

    def _write_size(self, value: int) -> int:
        if not 1 <= value <= BUFFER_MAX:
            return AbortCode.INVALID_VALUE
        del self._records[value:]
        return OK

    def _write_access(self, value: int) -> int:
        if value not in (0, 1):
            return AbortCode.INVALID_VALUE
        if value == 0:
            self._records.clear()
        return OK

    def _room(self) -> int:
        return max(1, min(BUFFER_MAX, self._size.integer()))

    def _free_place(self) -> int:
        """Return 60C4h:4, the next free place in the buffer."""
        return len(self._records)


@final
class HomingMethod:
    """One row of the table.

    Attributes:
        switch: bit of the switch in 60FDh; 0: none.
        direction: direction in which home is passed, +1 or -1; 0: home is the present position.
        before: state of the switch before that edge.
        search: the first direction, if the switch is not active at the start.
        turns: True if the drive reverses at the limit switch in that direction.
        index: True if home is the first index pulse after the edge, not the edge.
    """

    def __init__(
        self, switch: int, direction: int, before: bool, search: int, turns: bool, index: bool
    ) -> None:
        self.switch = switch
        self.direction = direction
        self.before = before
        self.search = search
        self.turns = turns
        self.index = index


def _table() -> dict[int, HomingMethod]:
    table: dict[int, HomingMethod] = {}
    for first, index in ((1, True), (17, False)):
        for number, (switch, direction, before, search, turns) in enumerate(_BY_EDGE, first):
            table[number] = HomingMethod(switch, direction, before, search, turns, index)
    table[33] = HomingMethod(0, _LEFT, _OFF, _LEFT, False, True)
    table[34] = HomingMethod(0, _RIGHT, _OFF, _RIGHT, False, True)
    for number in (35, 37):
        table[number] = HomingMethod(0, 0, _OFF, 0, False, False)
    return table


HOMING_METHODS: Final[dict[int, HomingMethod]] = _table()


@final
class HomingObjects:
    """Method, speeds and offset of homing."""

    def __init__(
        self,
        od: ObjectDictionary,
        factors: FactorGroup,
        motion: MotionObjects,
        defaults: DriveDefaults,
    ) -> None:
        ensure = od.ensure
        self._factors = factors
        self._motion = motion
        self._home_offset = ensure(0x607C, 0, _D.INTEGER32, 0)
        self._method = ensure(0x6098, 0, _D.INTEGER8, 37)
        # 0, no method, is what most vendors' files begin with; homing then fails at its start.
        self._method.writer = Choice(frozenset((0, *HOMING_METHODS))).write
        velocity = defaults.velocity
        self._switch_speed = ensure(0x6099, 1, _D.UNSIGNED32, max(1, velocity // _SWITCH_PART))
        self._zero_speed = ensure(0x6099, 2, _D.UNSIGNED32, max(1, velocity // _ZERO_PART))
        self._acceleration = ensure(0x609A, 0, _D.UNSIGNED32, defaults.acceleration)

    def home_inc(self) -> int:
        """Return the position of home, according to 607Ch [increments]."""
        return -self._factors.units.position_inc(self._home_offset.integer())

    def method(self) -> int:
        """Return 6098h."""
        return self._method.integer()

    def switch_speed_inc_s(self) -> float:
        """Return 6099h:1, limited to the motor's maximum speed; 0 if it is 0."""
        return self._speed_inc_s(self._switch_speed.integer())

    def zero_speed_inc_s(self) -> float:
        """Return 6099h:2, limited to the motor's maximum speed; 0 if it is 0."""
        return self._speed_inc_s(self._zero_speed.integer())

    def acceleration_inc_s2(self) -> float:
        """Return 609Ah, or 6083h if it is 0; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._motion.acceleration_inc_s2()
        return raw * self._factors.units.acceleration_unit_inc_s2

    def _speed_inc_s(self, raw: int) -> float:
        speed = raw * self._factors.units.velocity_unit_inc_s
        return min(speed, self._motion.velocity_max_inc_s())
