import pickle
from dataclasses import replace
from math import inf, nan, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi import ControlVariable, FileError, MotionKind, MotorModel, UsageError

WHEEL = """\
# A comment
name = "drive wheel"
velocity_max_rad_s = 6
acceleration_max_rad_s2 = 20.0
position_min_rad = -3.0
increments_per_rad = -10430.4
requires_referencing = true
"""


def refused(tmp_path, text):
    path = tmp_path / "m.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileError) as caught:
        MotorModel.load(path)
    assert caught.value.path == str(path)
    assert caught.value.remedy
    return caught.value


def test_model_is_read_with_its_units(tmp_path):
    path = tmp_path / "wheel.toml"
    path.write_text(WHEEL)
    model = MotorModel.load(path)
    assert model == MotorModel(
        name="drive wheel",
        velocity_max=6.0,
        acceleration_max=20.0,
        position_min=-3.0,
        increments_per_unit=-10430.4,
        requires_referencing=True,
    )
    assert model.deceleration == 20.0
    assert model.position_max is None


def test_linear_model_uses_metres_and_newtons(tmp_path):
    path = tmp_path / "slide.toml"
    path.write_text(
        'kind = "linear"\nvelocity_max_m_s = 0.5\nacceleration_max_m_s2 = 2.0\n'
        "force_max_n = 30.0\nincrements_per_m = 1e6\ndeceleration_max_m_s2 = 1.0\n"
    )
    model = MotorModel.load(path)
    assert (model.name, model.kind, model.unit) == ("slide", MotionKind.LINEAR, "m")
    assert (model.torque_max, model.increments_per_unit, model.deceleration) == (30.0, 1e6, 1.0)
    units = [model.unit_of(variable) for variable in ControlVariable]
    assert units == ["m", "m/s", "N", "A"]
    assert model.start_tolerance == 0.0001


@pytest.mark.parametrize(
    ("line", "key", "remedy"),
    [
        ("velocity_max_rads = 1.0", "velocity_max_rads", "did you mean velocity_max_rad_s?"),
        ("velocity_max_m_s = 1.0", "velocity_max_m_s", "did you mean velocity_max_rad_s?"),
        ("colour = 1", "colour", "take it out, or use one of these"),
        ("[motor]", "motor", "take it out, or use one of these"),
        ('jerk_max_rad_s3 = "1"', "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("jerk_max_rad_s3 = true", "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("jerk_max_rad_s3 = [\n1]", "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("jerk_max_rad_s3 = 0", "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("jerk_max_rad_s3 = -1", "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("jerk_max_rad_s3 = nan", "jerk_max_rad_s3", "allowed: more than 0 rad/s³"),
        ("position_max_rad = inf", "position_max_rad", "allowed: any finite number"),
        ("increments_per_rad = 0.0", "increments_per_rad", "allowed: any number but 0"),
        ('kind = "rotating"', "kind", "use one of these"),
        ("name = 3", "name", 'write name = "wheel"'),
        (r'name = "two\nlines"', "name", "write one line of text"),
        ("jerk_max_rad_s3 = 1" + 400 * "0", "jerk_max_rad_s3", "shorter"),
        ("requires_referencing = 1", "requires_referencing", "write requires_referencing = true"),
    ],
)
def test_invalid_key_error_names_file_line_key_and_remedy(tmp_path, line, key, remedy):
    good = "velocity_max_rad_s = 6.0 # [1]\n\nacceleration_max_rad_s2 = 20.0\n"
    error = refused(tmp_path, good + line + "\n")
    lines = 2 if "\n" in line else 1
    assert (error.line, error.key) == (3 + lines, key)
    assert remedy in error.remedy
    assert f"m.toml:{error.line}: {key}" in str(error)
    assert "\n" not in str(error)


def test_missing_limit_is_named(tmp_path):
    error = refused(tmp_path, "velocity_max_rad_s = 6.0\n")
    assert (error.line, error.key) == (None, "acceleration_max_rad_s2")


def test_empty_position_range_raises(tmp_path):
    error = refused(tmp_path, WHEEL + "position_max_rad = -3.0\n")
    assert (error.line, error.key) == (5, "position_min_rad")


def test_invalid_toml_error_names_its_line(tmp_path):
    error = refused(tmp_path, "velocity_max_rad_s = 6.0\nspeed: 3\n")
    assert error.line == 2


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("a = " + 100_000 * "[", "nested too deeply"),
        ("a." * 2000 + "a (", "nested too deeply"),
        ("a = 1" + 5000 * "0", "4300 digits"),
        (r'"a\nb" = 1', r"'a\nb': unknown key (known: name, kind, "),
    ],
)
def test_toml_limits_of_the_parser_raise_one_line(tmp_path, line, problem):
    error = refused(tmp_path, WHEEL + line)
    assert problem in str(error)
    assert "\n" not in str(error)


def test_byte_order_mark_is_accepted(tmp_path):
    (tmp_path / "m.toml").write_text(WHEEL, encoding="utf-8-sig")
    assert MotorModel.load(tmp_path / "m.toml").name == "drive wheel"


def test_missing_or_binary_file_raises(tmp_path):
    with pytest.raises(FileError, match="No such file"):
        MotorModel.load(tmp_path / "none.toml")
    with pytest.raises(FileError, match="null byte"):
        MotorModel.load("no\0ne.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(FileError, match="not UTF-8"):
        MotorModel.load(tmp_path / "binary.toml")


def test_table_of_another_file_error_names_its_line():
    table = {"velocity_max_rad_s": 1.0, "acceleration_max_rad_s2": 1.0, "speed": 2}
    with pytest.raises(FileError, match=r"rig\.toml:17: speed"):
        MotorModel.from_table(table, path="rig.toml", line_of={"speed": 17}.get)
    del table["speed"]
    assert MotorModel.from_table(table, path="rig.toml", default_name="left").name == "left"


def test_model_created_in_code_is_checked():
    for bad in (0.0, -1.0, nan, inf):
        with pytest.raises(UsageError, match="velocity_max"):
            MotorModel(name="x", velocity_max=bad, acceleration_max=1.0)
    for name in ("", "two\nlines", 3):
        with pytest.raises(UsageError, match="name: "):
            MotorModel(name=name, velocity_max=1.0, acceleration_max=1.0)
    with pytest.raises(UsageError, match="position_min"):
        MotorModel(
            name="x", velocity_max=1.0, acceleration_max=1.0, position_min=1.0, position_max=1.0
        )


POSITIVE = st.floats(1e-300, 1e300)


@given(
    st.builds(
        MotorModel,
        name=st.text(min_size=1).filter(str.isprintable),
        kind=st.sampled_from(MotionKind),
        velocity_max=POSITIVE,
        acceleration_max=POSITIVE,
        deceleration_max=st.none() | POSITIVE,
        torque_max=st.none() | POSITIVE,
        position_min=st.none() | st.floats(-1e9, -1.0),
        position_max=st.none() | st.floats(-0.5, 1e9),
        increments_per_unit=st.none() | POSITIVE,
        jerk_max=st.none() | POSITIVE,
        current_max=st.none() | POSITIVE,
        position_tolerance=st.none() | POSITIVE,
        encoder_increments_rev=st.none() | POSITIVE,
        velocity_unit=st.none() | POSITIVE,
        requires_referencing=st.booleans(),
    )
)
def test_saved_model_is_loaded_equal(tmp_path_factory, model):
    path = tmp_path_factory.getbasetemp() / "saved.toml"
    model.save(path)
    assert MotorModel.load(path) == model


def model_of(**numbers):
    return MotorModel(name="m", velocity_max=1.0, acceleration_max=1.0, **numbers)


def test_gear_and_encoder_determine_the_resolution():
    wheel = model_of(gear_ratio=66.0, encoder_increments_rev=2000.0)
    assert wheel.increments_per_unit == 66.0 * 2000.0 / (2.0 * pi)
    assert wheel.resolution == 1.0 / wheel.increments_per_unit
    reversing = model_of(gear_ratio=-66.0, encoder_increments_rev=2000.0)
    assert reversing.increments_per_unit == -wheel.increments_per_unit
    assert reversing.resolution == wheel.resolution
    slide = model_of(kind=MotionKind.LINEAR, gear_ratio=200.0, encoder_increments_rev=2000.0)
    assert slide.increments_per_unit == 400_000.0  # 5 mm of travel per turn of the motor
    assert model_of(gear_ratio=66.0).increments_per_unit is None
    assert model_of().resolution is None


@pytest.mark.parametrize("factor", [1.0 - 2e-6, 1.0 + 2e-6, -1.0])
def test_increments_that_contradict_gear_and_encoder_raise(tmp_path, factor):
    numbers = {"gear_ratio": 66.0, "encoder_increments_rev": 2000.0}
    right = model_of(**numbers).increments_per_unit
    assert model_of(**numbers, increments_per_unit=right * (1.0 + 5e-7))  # written with few digits
    with pytest.raises(
        UsageError,
        match=r"motor model m: increments_per_unit: is not 21008\.45249, which gear_ratio and",
    ):
        model_of(**numbers, increments_per_unit=right * factor)
    lines = [f"{key} = {value}" for key, value in numbers.items()]
    lines += ["velocity_max_rad_s = 1", "acceleration_max_rad_s2 = 1"]
    error = refused(tmp_path, "\n".join([f"increments_per_rad = {right * factor!r}", *lines]))
    assert (error.line, error.key) == (1, "increments_per_rad")
    assert "is not 21008.45249, which gear" in str(error)


def test_gear_of_a_linear_model_is_in_turns_per_metre(tmp_path):
    path = tmp_path / "slide.toml"
    slide = model_of(kind=MotionKind.LINEAR, gear_ratio=200.0, encoder_increments_rev=2000.0)
    slide.save(path)
    assert "motor_turns_per_m = 200.0" in path.read_text()
    assert MotorModel.load(path) == slide
    reason = "did you mean"
    assert reason in refused(tmp_path, path.read_text().replace("motor_turns", "turns")).remedy


def test_gear_must_not_be_0_and_encoder_must_be_positive():
    with pytest.raises(UsageError, match=r"motor model m: gear_ratio: 0\.0 is out of range"):
        model_of(gear_ratio=0.0)
    with pytest.raises(
        UsageError, match=r"motor model m: encoder_increments_rev: -1\.0 is out of range"
    ):
        model_of(encoder_increments_rev=-1.0)


def test_model_is_immutable_and_shared():
    wheel = model_of(gear_ratio=66.0)
    for change in ({"gear_ratio": 1.0}, {"colour": "red"}):
        with pytest.raises((AttributeError, TypeError)):
            setattr(wheel, *next(iter(change.items())))
    assert pickle.loads(pickle.dumps(wheel)) == wheel
    assert len({wheel, replace(wheel, velocity_max=2.0), model_of(gear_ratio=66.0)}) == 2
