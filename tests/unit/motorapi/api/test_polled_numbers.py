"""Rounding of motions to numbers of a polled drive."""

from math import ceil, tau

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from motorhil.motorapi.api import MotionKind, MotorModel, Numbers, PolledHardware
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.motion import Motion

POSITION, VELOCITY = ControlVariable.POSITION, ControlVariable.VELOCITY
COUNTS = 1000.0
RPM = 60.0


class Drive(PolledHardware):
    """A drive with speeds in rpm, and ramps in rpm/s up to 5000."""

    NUMBER_MAX = 5000

    def __init__(self):
        self._counts = COUNTS
        self.prepared = None

    def connect(self, model):
        pass

    def _rates(self, model):
        rpm = abs(self._per_unit(model)) / COUNTS * RPM
        return rpm, rpm

    def _prepare(self, numbers, model):
        self.prepared = numbers

    def _none(self, *_):
        raise AssertionError("not used")

    _read_counts = poll = _read_alarm = enable = disable = reset_fault = home = _none
    trigger = _post_stop = _none
    is_referenced = False


class TimedDrive(Drive):
    """Its ramps are times [ms] for 1000 rpm."""

    def _ramp(self, rate):
        return ceil(1e6 / rate - 1e-4)

    def _rate_of(self, ramp):
        return 1e6 / ramp


class OneRampDrive(Drive):
    HAS_ONE_RAMP = True


def model(gear_ratio=tau):
    limits = {"velocity_max": 1.0, "acceleration_max": 1.0}
    return MotorModel(name="wheel", kind=MotionKind.ROTARY, gear_ratio=gear_ratio, **limits)


def motion(target, variable=POSITION, velocity=1.01, acceleration=2.5, deceleration=0.001):
    own = (velocity, acceleration, deceleration)
    return Motion(ControlMode.SETPOINT, variable, 0.0, target, *own)


def prepared(drive, one, gear_ratio=tau):
    drive.prepare(one, model(gear_ratio))
    return drive.prepared


def test_position_is_nearest_and_rates_are_below():
    # One turn per U: 1000 counts, 60 rpm per U/s. A rate of 0.06 becomes 1, as 0 is none.
    assert prepared(Drive(), motion(0.5006)) == Numbers(501, 60, 150, 1)
    assert prepared(Drive(), motion(0.5006), -tau) == Numbers(-501, 60, 150, 1)
    assert prepared(Drive(), motion(0.5, acceleration=100.0)).faster == 5000


def test_velocity_is_rounded_to_0_with_the_sign_of_the_drive():
    assert prepared(Drive(), motion(1.01, VELOCITY)) == Numbers(None, 60, 150, 1)
    assert prepared(Drive(), motion(-1.01, VELOCITY)).speed == -60
    assert prepared(Drive(), motion(1.01, VELOCITY), -tau).speed == -60
    assert prepared(Drive(), motion(0.001, VELOCITY)).speed == 0


def test_quantised_motion_is_that_of_the_numbers():
    one = Drive().quantised(motion(0.5006), model())
    assert (one.target, one.velocity, one.acceleration) == (0.501, 1.0, 2.5)
    one = Drive().quantised(motion(-1.01, VELOCITY), model(-tau))
    assert (one.target, one.velocity) == (-1.0, 1.01)


def test_ramps_of_a_drive_with_times_or_with_one():
    assert prepared(TimedDrive(), motion(1.0))[2:] == (6667, 16_666_667)
    assert TimedDrive().quantised(motion(1.0), model()).acceleration == 1e6 / 6667 / RPM
    assert prepared(OneRampDrive(), motion(1.0))[2:] == (1, 1)


SIZES = st.floats(1e-3, 1e3)


@example(1.0, *(number * tau / (7.3 * RPM) for number in (47, 47, 94)), POSITION)
@given(st.floats(-1e3, 1e3), SIZES, SIZES, SIZES, st.sampled_from([POSITION, VELOCITY]))
def test_rounding_twice_changes_nothing_and_exceeds_nothing(target, v, up, down, variable):
    for drive in (Drive(), TimedDrive(), OneRampDrive()):
        one = motion(target, variable, v, up, down)
        rounded = drive.quantised(one, model(-7.3))
        assert drive.quantised(rounded, model(-7.3)) == rounded
        assert prepared(drive, rounded, -7.3) == prepared(drive, one, -7.3)
        least = 1.0 / drive._rates(model(-7.3))[0]
        assert rounded.acceleration <= max(up * (1 + 1e-9), least)
        if variable is VELOCITY:
            assert abs(rounded.target) <= abs(target) * (1 + 1e-9)
        else:
            assert rounded.velocity <= max(v * (1 + 1e-9), least)


def test_kind_without_a_preparation_is_told():
    class Unfinished(Drive):
        _prepare = PolledHardware._prepare

    with pytest.raises(TypeError, match=r"abstract class Unfinished.* _prepare"):
        Unfinished()
