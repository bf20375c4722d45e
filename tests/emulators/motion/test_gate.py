"""The gate: a flag that comes at the first tick at which the count has left a range."""

from hypothesis import event, given
from hypothesis import strategies as st

from emulators.firmware.flags import OUTSIDE_GATE
from tests.emulators.motion.axes import MS, new_axis, powered_axis

FAR = 1e300


def outside(axis) -> bool:
    return axis.flags & OUTSIDE_GATE != 0


@given(
    st.integers(-2000, 2000),
    st.integers(-1500, 0),
    st.integers(1, 1500),
    st.floats(500.0, 100_000.0),
    st.booleans(),
    st.lists(st.integers(1, 400), max_size=4),
)
def test_it_comes_at_the_first_tick_outside_however_it_is_looked_at(
    target, low, high, velocity, of_output, looks
):
    ranges = (-FAR, FAR, low, high) if of_output else (low, high, -FAR, FAR)
    lazy, plain = powered_axis(), powered_axis()
    for axis in (lazy, plain):
        axis.set_gate(*ranges)
        axis.move_to(target, velocity, 1e6, 1e6)
    left = None
    for tick in range(51, 5_000):
        plain.at(tick * MS)
        inside = low <= plain.count() < high
        assert outside(plain) is not inside
        if not inside:
            left = tick
            break
    event("left" if left else "stays inside")
    for look in looks:
        if left is None or 50 + look < left:
            lazy.at(max(50 + look, lazy._time.tick) * MS)
    wake = lazy.next_event_ns()
    while wake is not None and not outside(lazy):
        lazy.at(wake)
        wake = lazy.next_event_ns()
    assert outside(lazy) is (left is not None)
    if left is not None:
        assert lazy._time.tick == left
        assert lazy.count() == plain.count()


def test_the_range_holds_its_lower_end_and_not_its_upper():
    axis = new_axis(initial_position_inc=100)
    for low, high, is_outside in ((100, 101, False), (101, 200, True), (0, 100, True)):
        axis.set_gate(low, high, -FAR, FAR)
        assert not outside(axis)  # at the present tick nothing is said yet
        axis.at((axis._time.tick + 1) * MS)
        assert outside(axis) is is_outside


def test_a_motor_without_power_that_its_load_turns_leaves_it_too():
    axis = new_axis()
    axis.set_load(5.0)
    axis.set_gate(-50, 50, -FAR, FAR)
    wake = axis.next_event_ns()
    while wake is not None and not outside(axis):
        axis.at(wake)
        wake = axis.next_event_ns()
    assert outside(axis)
    assert axis.count() < -50


def test_a_new_gate_around_the_count_takes_the_flag_back_and_asks_for_no_tick_at_rest():
    axis = new_axis()
    axis.set_gate(5, 9, -FAR, FAR)
    axis.at(1 * MS)
    assert outside(axis)
    axis.set_gate(-5, 9, -FAR, FAR)
    assert not outside(axis)
    assert axis.next_event_ns() is None


def test_what_a_position_is_called_moves_no_gate():
    axis = new_axis()
    axis.set_gate(-5, 5, -FAR, FAR)
    axis.set_position(1_000)
    axis.at(1 * MS)
    assert (axis.count(), axis.output_count(), axis.position_inc()) == (0, 0, 1_000)
    assert not outside(axis)
    axis.set_position(7, count=-20)
    assert axis.position_inc() == 27
