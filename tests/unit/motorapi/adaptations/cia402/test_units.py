"""Units of a drive's objects, from the model or the drive."""

from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.adaptations.cia402.units import DriveUnits, drive_units
from motorhil.motorapi.errors import LimitError, UsageError
from motorhil.motorapi.model import MotionKind, MotorModel

Objects = dict[tuple[int, int], int]

# 4096 increments per turn of the motor, gear 33:1, position unit = 1 increment
TOLD: Objects = {
    (0x608F, 1): 4096, (0x608F, 2): 1,
    (0x6091, 1): 33, (0x6091, 2): 1,
    (0x6092, 1): 135_168, (0x6092, 2): 1,
    (0x6096, 1): 1, (0x6096, 2): 1,
    (0x6097, 1): 1, (0x6097, 2): 1,
}  # fmt: skip
PER_RAD = 135_168 / (2 * pi)


def model(**numbers: object) -> MotorModel:
    return MotorModel(name="wheel", velocity_max=3.0, acceleration_max=9.0, **numbers)


def units_of(objects: Objects, **numbers: object) -> DriveUnits:
    return drive_units(
        "left", model(**numbers), lambda index, subindex: objects.get((index, subindex))
    )


def test_feed_constant_gives_increments_per_turn_and_rates():
    units = units_of(TOLD)
    assert units.increments_per_unit == PER_RAD
    assert units.velocity_unit == units.acceleration_unit == 1 / PER_RAD
    assert units.sources[0] == "6092h = 135168 position units per turn"


def test_units_without_feed_constant_use_resolution_and_gear():
    objects = {key: value for key, value in TOLD.items() if key[0] != 0x6092}
    assert units_of(objects).increments_per_unit == PER_RAD


def test_si_unit_objects_give_all_units():
    # Nanotec C5-E: 60A8h = tenth of a degree, 60A9h = turns per minute (CiA 303-2 codes)
    units = units_of({**TOLD, (0x60A8, 0): 0xFF41_0000, (0x60A9, 0): 0x00B4_4700})
    assert units.increments_per_unit == pytest.approx(1800 / pi, rel=1e-15)  # float of a ratio
    assert units.velocity_unit == pytest.approx(2 * pi / 60, rel=1e-15)  # float of a ratio


@pytest.mark.parametrize(
    ("change", "missing", "why"),
    [
        ({(0x6092, 1): 1}, "increments_per_rad", "6092h is 1/1"),
        ({(0x6092, 1): None, (0x608F, 1): None}, "increments_per_rad", "lacks the factor objects"),
        ({(0x6092, 1): None, (0x608F, 1): 1}, "increments_per_rad", "608Fh is 1/1"),
        ({(0x6096, 1): 60}, "velocity_unit_rad_s", "6096h is 60, which vendors read both ways"),
        ({(0x6096, 1): None}, "velocity_unit_rad_s", "lacks the factor object 6096h"),
        ({(0x608C, 0): 0xA4}, "velocity_unit_rad_s", "608Ch = A4h names a unit of its own"),
        ({(0x60A9, 0): 0x00B4_4700}, "acceleration_unit_rad_s2", "none of acceleration"),
        ({(0x60A9, 0): 0x0001_0300}, "velocity_unit_rad_s", "not turns, degrees or radians"),
        ({(0x6097, 1): 2}, "acceleration_unit_rad_s2", "6097h is 2"),
    ],
)
def test_ambiguous_units_are_required_of_the_model(
    change: dict[tuple[int, int], int | None], missing: str, why: str
):
    objects = {key: value for key, value in (TOLD | change).items() if value is not None}
    with pytest.raises(UsageError, match=f"left: {missing} is not known") as caught:
        units_of(objects).require_all()
    assert why in str(caught.value)
    assert f"write {missing} into the motor model" in str(caught.value)


def test_model_units_precede_the_drives():
    units = units_of(TOLD, increments_per_unit=-100.0, velocity_unit=0.5, acceleration_unit=0.25)
    assert units.position_inc(1.0) == -100
    assert units.position(-100) == 1.0
    assert units.velocity_raw(2.0) == -4  # the drive counts in the opposite direction
    assert units.velocity(-4) == 2.0
    assert units.acceleration_raw(1.0) == 4
    assert units.sources == ("the motor model",) * 3


def test_metres_must_come_from_the_model():
    with pytest.raises(UsageError, match="the drive reports turns, not metres"):
        units_of(TOLD, kind=MotionKind.LINEAR).require_all()


def test_only_the_distance_of_a_move_has_32_bits():
    units = units_of({}, increments_per_unit=1e6, velocity_unit=1.0, acceleration_unit=1.0)
    assert units.position_inc(2147.483648) == 0x8000_0000
    units.require_distance(0x7FFF_FFFF)
    with pytest.raises(LimitError, match="607Ah has 32 bits"):
        units.require_distance(0x8000_0000)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e3))
def test_rates_are_rounded_down_but_never_to_0(value: float, unit: float):
    units = units_of({}, increments_per_unit=1.0, velocity_unit=unit, acceleration_unit=unit)
    if value / unit > 0xFFFF_FFFF:
        with pytest.raises(LimitError):
            units.speed_raw(value)
        return
    raw = units.speed_raw(value)
    assert raw >= 1
    assert raw == 1 or units.speed(raw) <= value * (1 + 1e-9) + 1e-9 * unit
    assert units.speed(raw + 1) > value


@given(st.integers(1, 0x7FFF_FFFF), st.floats(1e-6, 1e3))
def test_integer_number_of_steps_is_kept(raw: int, unit: float):
    units = units_of({}, increments_per_unit=1.0, velocity_unit=unit, acceleration_unit=unit)
    assert units.acceleration_raw(units.acceleration(raw)) == raw
    assert units.velocity_raw(units.velocity(-raw)) == -raw
