"""Units of a drive's objects, as its dictionary declares them.

CiA 402-2, factor group: position unit = 608Fh x 6091h / 6092h increments; velocity unit = position
unit per second x 6096h; acceleration unit = position unit per second squared x 6097h. SI units
(60A8h, 60A9h) and dimension indices (608Ch, 608Eh: A4h = motor rpm) replace them. A rig's `units`
replace all of these, for drives whose dictionary does not declare its units.
"""

from collections.abc import Callable, Mapping
from math import pi
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.clause import NotApplicable
from motorhil.harness.conformance.drives.objects import Entry

Reader = Callable[[Entry], int | None]
"""Returns the value of an object, or None if the drive does not have it."""

_RPM: Final = 0xA4
_TURNS: Final = {
    0x10: 1 / (2 * pi),
    0x41: 1 / 360,
    0x42: 1 / 21_600,
    0x43: 1 / 1_296_000,
    0xB4: 1.0,
}
_SECONDS: Final = {0x00: 1.0, 0x03: 1.0, 0x47: 60.0}


@final
@frozen
class Units:
    """Ratios of a drive's units.

    Attributes:
        position_inc: increments of the encoder of one position unit.
        velocity: position units per second of one velocity unit.
        acceleration: velocity units per second of one acceleration unit.
    """

    position_inc: float
    velocity: float
    acceleration: float


def units_of(read: Reader, stated: Mapping[str, float]) -> Units:
    """Return the units of a drive; `stated` is the table `units` of its rig.

    Raises:
        NotApplicable: the dictionary declares rpm or SI units, but not the encoder or gear.
    """
    increments = _ratio(read, 0x608F)
    gear = _ratio(read, 0x6091) or 1.0
    feed = _ratio(read, 0x6092)

    def turn() -> float:
        if increments is None:
            message = "velocity unit unknown: 608Fh is absent; state `units` of the controller"
            raise NotApplicable(message)
        return increments

    def rate(dimension: int, factor: int) -> float:
        si = _si(read, 0x60A9)
        if si is not None:
            return turn() * gear * si
        if read(Entry(dimension, 0, "B", "dimension index")) == _RPM:
            return turn() / 60.0
        return position * (_ratio(read, factor) or 1.0)

    position_si = _si(read, 0x60A8)
    if "position_unit_inc" in stated:
        position = stated["position_unit_inc"]
    elif position_si is not None:
        position = turn() * gear * position_si
    else:
        position = increments * gear / feed if increments and feed else 1.0
    velocity = stated.get("velocity_unit_inc_s") or rate(0x608C, 0x6096)
    acceleration = stated.get("acceleration_unit_inc_s2") or rate(0x608E, 0x6097)
    return Units(position, velocity / position, acceleration / velocity)


def _ratio(read: Reader, index: int) -> float | None:
    numerator = read(Entry(index, 1, "I", "numerator"))
    divisor = read(Entry(index, 2, "I", "divisor"))
    return numerator / divisor if numerator and divisor else None


def _si(read: Reader, index: int) -> float | None:
    """Return an SI unit in turns (per second); None if the object is absent or another unit."""
    value = read(Entry(index, 0, "I", "SI unit")) or 0
    turns = _TURNS.get(value >> 16 & 0xFF)
    seconds = _SECONDS.get(value >> 8 & 0xFF)
    if turns is None or seconds is None:
        return None
    exponent = (value >> 24 ^ 0x80) - 0x80
    return float(turns * 10.0**exponent / seconds)
