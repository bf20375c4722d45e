"""The size of one unit: exact, rounded to the nearest, from the source that the file gives."""

from dataclasses import replace
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.cia402.objects.units import Units, fill_factors, limited, units_of
from motorhil.emulators.plant.presets import WHEEL_60W

TURN = WHEEL_60W.encoder_increments_rev
U32 = DataType.UNSIGNED32
RATIOS = st.fractions(Fraction(1, 1000), Fraction(1000), max_denominator=1000)


def dictionary(**values: int) -> ObjectDictionary:
    od = ObjectDictionary()
    for key, value in values.items():
        od.ensure(int(key[1:5], 16), int(key[6:] or "0"), U32, value)
    return od


def units(od: ObjectDictionary, **given_units: float) -> Units:
    keys = ("position_unit_inc", "velocity_unit_inc_s", "acceleration_unit_inc_s2")
    return units_of(od, WHEEL_60W, **{key: given_units.get(key) for key in keys})


@given(RATIOS, st.integers(-(10**9), 10**9))
def test_positions_round_to_the_nearest(ratio, raw):
    made = Units(ratio.numerator, ratio.denominator, 1.0, 1.0)
    assert abs(Fraction(made.position_inc(raw)) - raw * ratio) <= Fraction(1, 2)
    small = raw % 1_000_000
    assert abs(Fraction(made.position_raw(small)) - small / ratio) <= Fraction(1, 2)


@given(st.fractions(1, 1000, max_denominator=50), st.integers(-(10**6), 10**6))
def test_position_survives_a_round_trip(ratio, raw):
    """Check that a value reads as written where a unit is at least an increment."""
    made = Units(ratio.numerator, ratio.denominator, 1.0, 1.0)
    assert made.position_raw(made.position_inc(raw)) == raw


def test_positions_wrap_at_32_bits():
    made = Units(1, 1, 1.0, 1.0)
    assert made.position_raw(2**31 - 1) == 2**31 - 1
    assert made.position_raw(2**31) == -(2**31)
    assert made.position_raw(-(2**31) - 1) == 2**31 - 1


@pytest.mark.parametrize(
    ("value", "whole"), [(0.49, 0), (0.5, 1), (-0.5, -1), (99.6, 100), (1e12, 127), (-1e12, -128)]
)
def test_numbers_are_rounded_and_limited(value, whole):
    assert limited(value, 127) == whole


def test_without_factors_every_unit_is_an_increment():
    assert units(ObjectDictionary()) == Units(1, 1, 1.0, 1.0)


def test_factors_apply_if_608fh_names_the_motors_encoder():
    """Check CiA 402-2: increments = 608Fh x 6091h / 6092h per position unit; then 6096h, 6097h."""
    told = {
        "_608F_1": TURN,
        "_608F_2": 1,
        "_6091_1": 66,
        "_6091_2": 1,
        "_6092_1": 3600,
        "_6092_2": 1,
    }
    assert units(dictionary(**told)) == Units(110, 3, 110 / 3, 110 / 3)
    factors = {"_6096_1": 3, "_6096_2": 2, "_6097_1": 10, "_6097_2": 1}
    made = units(dictionary(**told, **factors))
    assert (made.velocity_unit_inc_s, made.acceleration_unit_inc_s2) == (
        55.0,
        pytest.approx(1100 / 3),
    )
    assert units(dictionary(**{**told, "_608F_1": 1})) == Units(1, 1, 1.0, 1.0)  # not set


def test_si_units_of_60a8h_and_60a9h_apply():
    """Check CiA 303-2 codes (Nanotec): 41h degree (FFh: a tenth), B4h turns per 47h minute."""
    made = units(dictionary(_60A8_0=0xFF41_0000, _60A9_0=0x00B4_4700))
    assert Fraction(made.position_numerator, made.position_divisor) == Fraction(TURN, 3600)
    assert made.velocity_unit_inc_s == pytest.approx(TURN / 60)
    geared = units(dictionary(_60A8_0=0x0041_0000, _6091_1=66, _6091_2=1))
    assert Fraction(geared.position_numerator, geared.position_divisor) == Fraction(TURN * 66, 360)


def test_dimension_index_a4h_is_rpm_of_the_motor():
    made = units(dictionary(_608C_0=0xA4, _608E_0=0xA4))
    assert made.velocity_unit_inc_s == pytest.approx(TURN / 60)
    assert made.acceleration_unit_inc_s2 == pytest.approx(TURN / 60)
    assert made.position_numerator == made.position_divisor == 1


def test_settings_of_the_rig_have_precedence():
    od = dictionary(_608C_0=0xA4, _60A8_0=0xFF41_0000)
    made = units(od, position_unit_inc=0.5, velocity_unit_inc_s=7.0, acceleration_unit_inc_s2=8.0)
    assert made == Units(1, 2, 7.0, 8.0)


@pytest.mark.parametrize("gear", [1.0, 66.0, 3.7, 123.456])
def test_missing_factors_describe_the_motor(gear):
    od = ObjectDictionary()
    for index in (0x608F, 0x6091, 0x6092):
        for subindex in (1, 2):
            od.add(Variable(index, subindex, U32))
    plant = replace(WHEEL_60W, gear_ratio=gear)
    fill_factors(od, plant)
    assert od.integer(0x608F, 1, 0) == TURN
    assert od.integer(0x6091, 1, 0) / od.integer(0x6091, 2, 0) == gear
    assert od.integer(0x6092, 1, 0) / od.integer(0x6092, 2, 0) == pytest.approx(TURN * gear)
    made = units_of(
        od, plant, position_unit_inc=None, velocity_unit_inc_s=None, acceleration_unit_inc_s2=None
    )
    assert made == Units(1, 1, 1.0, 1.0)
