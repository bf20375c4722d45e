"""Gains and windows of a CiA 402 drive, kept per logical motor.

The paper, 3.2 and 3.5: parameters are what the application may modify, typed per adaptation. Those
of one logical motor do not affect another, "even if both refer to the same piece of motor
hardware". So they are written at `start()`, where they differ from the drive's values. Parameters
that a logical motor leaves open are restored at its start to the drive's original values.
"""

from dataclasses import fields
from math import isfinite
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.canopen.sdo import decode_answer
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.cia402.units import DriveUnits


Place = tuple[int, int]
"""The index and sub-index of an object."""

_GAINS: Final = {"current_gains": 0x60F6, "velocity_gains": 0x60F9, "position_gains": 0x60FB}
WINDOW_OFF: Final = 0xFFFF_FFFF  # 6065h, 6067h
POSITIONING_OPTION: Final = 0x60F2
QUICK_STOP_DECELERATION: Final = 0x6085
HALT_OPTION: Final = 0x605D  # a drive may support only one value
HOME_OFFSET: Final = 0x607C
_TIME_MAX_S: Final = 65.535  # in ms, 16 bits


@final
@frozen(kw_only=True)
class Cia402Parameters:
    """The tunable parameters of a drive; None leaves the drive's own value.

    Gains are the drive's own integers, by sub-index from 1 (None leaves one unchanged). Their
    meaning is manufacturer-specific (CiA 402-2). U is the motor's unit of position.

    Attributes:
        current_gains: 60F6h, current (torque) control parameter set.
        velocity_gains: 60F9h, velocity control parameter set.
        position_gains: 60FBh, position control parameter set.
        position_window: the distance within which a target counts as reached [U] (6067h).
        position_window_s: the time for which it must be within that window (6068h) [s].
        velocity_window: the difference within which a target velocity counts as reached [U/s]
            (606Dh).
        velocity_window_s: the time for which it must be within that window (606Eh) [s].
        following_error_window: the largest following error without a fault [U] (6065h); inf: no
            limit.
        following_error_s: the time for which it must be exceeded (6066h) [s].

    Raises:
        UsageError: a gain is not an integer, or a window is not a number > 0.
    """

    current_gains: tuple[int | None, ...] | None = None
    velocity_gains: tuple[int | None, ...] | None = None
    position_gains: tuple[int | None, ...] | None = None
    position_window: float | None = None
    position_window_s: float | None = None
    velocity_window: float | None = None
    velocity_window_s: float | None = None
    following_error_window: float | None = None
    following_error_s: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            if field.name in _GAINS:
                object.__setattr__(self, field.name, _gains(field.name, value))
                continue
            number = as_number(value)
            low = 0.0 if field.name.endswith("_s") else 5e-324
            high = _TIME_MAX_S if field.name.endswith("_s") else float("inf")
            may_be_off = field.name == "following_error_window"
            if not low <= number <= high or not (isfinite(number) or may_be_off):
                limit = f"0 to {high:g} s" if low == 0.0 else "> 0"
                raise UsageError(f"Cia402Parameters: {field.name} = {value!r}: must be {limit}")
            object.__setattr__(self, field.name, number)

    def objects(self, units: "DriveUnits") -> dict[Place, int]:
        """Return the raw values of all objects that these parameters set.

        Raises:
            LimitError: a window does not fit the drive.
            UsageError: a unit is not known.
        """
        wanted: dict[Place, int] = {}
        for name, index in _GAINS.items():
            for subindex, gain in enumerate(getattr(self, name) or (), 1):
                if gain is not None:
                    wanted[index, subindex] = gain
        for index, seconds in (
            (0x6068, self.position_window_s),
            (0x606E, self.velocity_window_s),
            (0x6066, self.following_error_s),
        ):
            if seconds is not None:
                wanted[index, 0] = round(seconds * 1e3)
        if self.position_window is not None:
            wanted[0x6067, 0] = _window("position_window", self.position_window, units)
        if self.following_error_window == float("inf"):
            wanted[0x6065, 0] = WINDOW_OFF
        elif self.following_error_window is not None:
            window = self.following_error_window
            wanted[0x6065, 0] = _window("following_error_window", window, units)
        if self.velocity_window is not None:
            wanted[0x606D, 0] = min(units.speed_raw(self.velocity_window), 0xFFFF)
        return wanted


def _gains(name: str, value: object) -> tuple[int | None, ...]:
    if not isinstance(value, tuple | list) or not all(
        one is None or (isinstance(one, int) and not isinstance(one, bool)) for one in value
    ):
        raise UsageError(
            f"Cia402Parameters: {name} = {value!r}: must be integers by sub-index, (p, i)"
        )
    return tuple(value)


def _window(name: str, window: float, units: "DriveUnits") -> int:
    increments = abs(units.position_inc(window))
    if increments < 1:
        raise LimitError(
            motor=units.motor,
            quantity=name,
            value=window,
            low=abs(units.position(1)),
            high=None,
            unit=units.unit,
            reason="the drive counts whole increments",
        )
    if increments >= WINDOW_OFF:
        raise LimitError(
            motor=units.motor,
            quantity=name,
            value=window,
            low=None,
            high=abs(units.position(WINDOW_OFF - 1)),
            unit=units.unit,
            reason="the drive's object has 32 bits",
        )
    return increments


@final
class ParameterStore:
    """A drive's original parameters, and the writes that bring it to the values a motor wants.

    There is one store per hardware object. The store trusts its own writes only while the motor
    does not change hands.

    Attributes:
        keeps_halt_option: whether the drive has refused a value of 605Dh, so that it is not asked
            again.
    """

    def __init__(self, node: DriveNode, objects: ObjectAccess) -> None:
        self._node = node
        self._objects = objects
        self._own: dict[Place, bytes] = {}  # before the first write
        self._boots = -1
        self.keeps_halt_option: bool = False
        self._home_offset: tuple[int, int] | None = None  # boot-ups, and the original value

    def apply(self, motor: str, wanted: dict[Place, int]) -> None:
        """Write `wanted` to the drive, and restore the original values of all others.

        Raises:
            UnsupportedError: the drive has no such object, or refuses the value.
        """
        if self._node.boots != self._boots:  # after a boot-up the drive has its original values
            self._boots = self._node.boots
            self.forget()
        for place, value in wanted.items():
            own = self._own_value(motor, place)
            if place != (HALT_OPTION, 0) or not self.keeps_halt_option:
                self._push(motor, place, self._encoded(motor, place, value, len(own)))
        for place, data in self._own.items():
            if place not in wanted and (place != (HALT_OPTION, 0) or not self.keeps_halt_option):
                self._push(motor, place, data)

    def forget(self) -> None:
        """Forget the original values, as other programs may have written to the drive."""
        self._own.clear()
        self.keeps_halt_option = False

    def home_here(self, motor: str, method: int) -> bool:
        """Write a home offset of 0, with which the present position becomes 0.

        The drive keeps it until `home_by_own_offset` or its boot-up, as its software position
        limits count from home. Return whether it was written.

        Raises:
            UnsupportedError: the drive refuses it.
        """
        own = self._objects.read_optional(HOME_OFFSET)
        if not own:
            return False
        try:
            self._objects.write(HOME_OFFSET, 0)
        except SdoAborted as error:
            raise UnsupportedError(
                motor=motor,
                feature=f"homing by method {method} with a position of 0: the drive's home offset"
                f" 607Ch is {own} ({error})",
                supported="home() without a method, by the drive's own method and offset",
            ) from error
        self._home_offset = (self._node.boots, own)
        return True

    def home_by_own_offset(self) -> bool:
        """Restore the original home offset; return whether it was written."""
        kept, self._home_offset = self._home_offset, None
        if kept is None or kept[0] != self._node.boots:
            return False
        if self._objects.read_optional(HOME_OFFSET) != 0:
            return False  # written by the application since
        self._objects.write(HOME_OFFSET, kept[1])
        return True

    def own(self, place: Place) -> int | None:
        """Return the original value of an object written since, or None if it was not written."""
        data = self._own.get(place) if self._node.boots == self._boots else None
        is_signed = place == (HALT_OPTION, 0)
        return None if data is None else int.from_bytes(data, "little", signed=is_signed)

    def _own_value(self, motor: str, place: Place) -> bytes:
        own = self._own.get(place)
        if own is None:
            try:
                own = self._objects.upload(*place)
            except SdoAborted as error:
                raise UnsupportedError(motor=motor, feature=f"{_name(place)} ({error})") from error
            kind = self._node.objects.type_of(*place)
            decode_answer(self._node.node_id, place, kind or "bytes", own)  # of the whole length
            self._own[place] = own
        return own

    def _push(self, motor: str, place: Place, data: bytes) -> None:
        try:
            self._objects.push_bytes(*place, data)
        except SdoAborted as error:
            if place == (HALT_OPTION, 0):
                self.keeps_halt_option = True
                return
            if self._objects.upload(*place) == self._own.get(place):
                del self._own[place]  # the drive keeps it, so that it need not be restored
            value = int.from_bytes(data, "little")
            raise UnsupportedError(
                motor=motor, feature=f"{_name(place)} = {value} ({error})"
            ) from error

    def _encoded(self, motor: str, place: Place, value: int, size: int) -> bytes:
        try:
            return value.to_bytes(size, "little", signed=value < 0)
        except OverflowError as error:
            feature = f"{_name(place)} = {value}: it has {size} bytes"
            raise UnsupportedError(motor=motor, feature=feature) from error


def _name(place: Place) -> str:
    index, subindex = place
    return f"{index:04X}h:{subindex}" if subindex else f"{index:04X}h"
