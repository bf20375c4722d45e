"""While an axis rests with the same number, its readings do not change."""

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import WHEEL_60W

MS = 1_000_000
GAINS = ServoGains.tuned(WHEEL_60W, MS, 10)
COMMANDS = {
    "look": lambda axis, value: None,
    "wait": lambda axis, value: axis.next_event_ns(),
    "off": lambda axis, value: axis.power(False),
    "on": lambda axis, value: axis.power(True),
    "move": lambda axis, value: axis.move_to(100 * value, 1e5, 1e6, 1e6),
    "load": lambda axis, value: axis.set_load(0.01 * value),
    "zero": lambda axis, value: axis.set_position(value),
    "follow": lambda axis, value: axis.follow(value, MS),
}
STEPS = st.lists(
    st.tuples(
        st.sampled_from(sorted(COMMANDS)), st.integers(-30, 30), st.sampled_from([0, 1, 7, 1000])
    ),
    max_size=25,
)


def readings(axis: Axis) -> list[float]:
    names = (
        "position_inc velocity_inc_s demand_inc demand_velocity_inc_s following_error_inc "
        "current_a torque_n_m output_position_rad output_velocity_rad_s"
    )
    return [getattr(axis, name)() for name in names.split()] + [axis.flags]


@given(STEPS)
def test_same_rest_number_means_same_readings(steps):
    axis = Axis(WHEEL_60W, GAINS)
    axis.power(True)
    now, number, shown = 0, -1, [0.0]
    for name, value, wait_ms in steps:
        try:
            COMMANDS[name](axis, value)
        except RuntimeError:
            continue  # the power is off
        now += wait_ms * MS
        axis.at(now)
        if axis.rest() >= 0 and axis.rest() == number:
            event("rests on")
            assert readings(axis) == shown
        number, shown = axis.rest(), readings(axis)


def test_standing_axis_rests():
    axis = Axis(WHEEL_60W, GAINS)
    axis.power(True)
    assert axis.rest() == -1
    axis.at(5_000 * MS)
    first = axis.rest()
    assert first >= 0
    axis.at(9_000 * MS)
    assert axis.rest() == first
    axis.set_position(5)
    assert axis.rest() != first
