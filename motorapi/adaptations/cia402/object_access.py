"""A drive's object dictionary: typed access by name or index.

Values already written are not written again.

Gains and windows of a CiA 402 drive, kept per logical motor.

The paper, 3.2 and 3.5: parameters are what the application may modify, typed per adaptation. Those
of one logical motor do not affect another, "even if both refer to the same piece of motor
hardware". So they are written at `start()`, where they differ from the drive's values. Parameters
that a logical motor leaves open are restored at its start to the drive's original values.
"""

import difflib
from dataclasses import dataclass, fields
from math import isfinite
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.sdo import SdoAborted
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.cia402.objects import (
    KINDS,
    OBJECTS,
    Value,
    decode,
    encode,
    type_of,
)
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.cia402.units import DriveUnits
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor


@final
class DriveObjects:
    """Reads and writes by SDO, with a cache of written values while the motor keeps its owner."""

    def __init__(self, node: "DriveNode", physical: "PhysicalMotor") -> None:
        self._node: Final = node
        self.physical: Final = physical
        self._believed: dict[tuple[int, int], bytes] = {}
        self._token = -1

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object, as the drive sends them.

        Raises:
            SdoAborted, DeadlineExceeded, ProtocolViolation: see `SdoChannel`.
            LinkError: the drive is lost.
        """
        self._node.check_heard()
        return self._node.sdo.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes, *, stops: bool = False) -> None:
        """Write `data` to an object of the drive; with `stops`, without owning the motor.

        Raises:
            MotorBusyError: another program owns the drive now.
            SdoAborted, DeadlineExceeded, ProtocolViolation, LinkError: as `upload`.
        """
        self._node.check_heard()
        self._believed.pop((index, subindex), None)
        self._node.sdo.download(index, subindex, data, stops=stops)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """Return the value of an object; see `Cia402HwMotor.read`."""
        index, subindex, kind = place_of(what, subindex, kind)
        return decode(kind or "bytes", self.upload(index, subindex))

    def read_int(self, what: int | str, subindex: int = 0) -> int:
        """Return the integer in an object; raise UsageError if it does not hold one."""
        value = self.read(what, subindex)
        if not isinstance(value, int):
            raise UsageError(
                f"{self._node.label}: {what} does not hold an integer known to the standard"
            )
        return value

    def read_optional(self, index: int, subindex: int = 0) -> int | None:
        """Return the integer in an object, or None if the drive refuses to send it."""
        self._node.check_heard()
        return self._node.read_optional(index, subindex)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """Write a value to an object; see `Cia402HwMotor.write`."""
        index, subindex, kind = place_of(what, subindex, kind)
        if kind is None and not isinstance(value, bytes):
            raise UsageError(
                f"{index:04X}h:{subindex:02X}h is not in the standard: say kind=, one of"
                f" {' '.join(KINDS)}, or give bytes"
            )
        self.download(index, subindex, encode(kind or "bytes", value))

    def push(self, index: int, value: int, subindex: int = 0) -> bool:
        """Write a value unless the drive is believed to have it; return whether it was written.

        A written value is believed until the motor changes hands or boots.
        """
        return self.push_bytes(index, subindex, encode(type_of(index, subindex) or "u32", value))

    def push_bytes(self, index: int, subindex: int, data: bytes) -> bool:
        """Write encoded data as `push` does."""
        if self._believes(index, subindex, data):
            return False
        self.download(index, subindex, data)
        self._believed[index, subindex] = data
        return True

    def is_believed(self, index: int, value: int, subindex: int = 0) -> bool:
        """Return whether this value was written, and the motor has not changed hands since."""
        return self._believes(index, subindex, encode(type_of(index, subindex) or "u32", value))

    def _believes(self, index: int, subindex: int, data: bytes) -> bool:
        token = self.physical.token
        if token != self._token:
            self._believed.clear()
            self._token = token
        return self._believed.get((index, subindex)) == data

    def doubt(self, index: int | None = None, subindex: int = 0) -> None:
        """Forget the value written to an object, or (None) to any object."""
        if index is None:
            self._believed.clear()
        else:
            self._believed.pop((index, subindex), None)


def place_of(what: int | str, subindex: int, kind: str | None) -> tuple[int, int, str | None]:
    """Return (index, sub-index, data type) of an object by index or by the standard's name.

    Raises:
        UsageError: the name, the place or the type does not exist.
    """
    if kind is not None and (not isinstance(kind, str) or kind not in KINDS):
        raise UsageError(f"kind = {kind!r}: give one of {', '.join(KINDS)}")
    if not isinstance(subindex, int):
        raise UsageError(f"sub-index {subindex!r}: it is 0 to FFh")
    if not isinstance(what, int | str):
        raise UsageError(f"{what!r} is not an object: give an index, or the standard's name")
    if isinstance(what, int):
        return what, subindex, kind or type_of(what, subindex)
    known = OBJECTS.get(what)
    if known is None:
        near = difflib.get_close_matches(what, OBJECTS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else "; give its index"
        raise UsageError(f"the standard has no object named {what!r}{hint}")
    return known[0], known[1], kind or known[2]


Place = tuple[int, int]
"""The index and sub-index of an object."""

_GAINS: Final = {"current_gains": 0x60F6, "velocity_gains": 0x60F9, "position_gains": 0x60FB}
WINDOW_OFF: Final = 0xFFFF_FFFF  # 6065h, 6067h
HALT_OPTION: Final = 0x605D  # a drive may support only one value
_TIME_MAX_S: Final = 65.535  # in ms, 16 bits


@final
@dataclass(frozen=True, slots=True, kw_only=True)
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
    return increments


@final
class ParameterStore:
    """A drive's original parameters, and the writes that bring it to the values a motor wants.

    There is one store per hardware object. The store trusts its own writes only while the motor
    does not change hands.
    """

    def __init__(self, node: DriveNode, objects: DriveObjects) -> None:
        self._node = node
        self._objects = objects
        self._own: dict[Place, bytes] = {}  # before the first write
        self._boots = -1

    def apply(self, motor: str, wanted: dict[Place, int]) -> None:
        """Write `wanted` to the drive, and restore the original values of all others.

        Raises:
            UnsupportedError: the drive has no such object, or refuses the value.
        """
        if self._node.boots != self._boots:  # after a boot-up the drive has its original values
            self._boots = self._node.boots
            self._own.clear()
        for place, value in wanted.items():
            own = self._own_value(motor, place)
            self._push(motor, place, self._encoded(motor, place, value, len(own)))
        for place, data in self._own.items():
            if place not in wanted:
                self._push(motor, place, data)

    def forget(self) -> None:
        """Forget the original values, as other programs may have written to the drive."""
        self._own.clear()

    def own(self, place: Place) -> int | None:
        """Return the original value of an object written since, or None if it was not written."""
        data = self._own.get(place) if self._node.boots == self._boots else None
        return None if data is None else int.from_bytes(data, "little")

    def _own_value(self, motor: str, place: Place) -> bytes:
        own = self._own.get(place)
        if own is None:
            try:
                own = self._objects.upload(*place)
            except SdoAborted as error:
                raise UnsupportedError(motor=motor, feature=f"{_name(place)} ({error})") from error
            self._own[place] = own
        return own

    def _push(self, motor: str, place: Place, data: bytes) -> None:
        try:
            self._objects.push_bytes(*place, data)
        except SdoAborted as error:
            if place == (HALT_OPTION, 0):
                return  # the drive keeps its own halt option
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
