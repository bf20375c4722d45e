"""The gate: a flag at the first tick at which the count has left a range."""

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware.flags import OUTSIDE_GATE
from tests.support.motion.axes import MS, new_axis, powered_axis

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
def test_gate_flag_comes_at_first_tick_outside(target, low, high, velocity, of_output, looks):
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


def test_gate_includes_lower_end_excludes_upper():
    axis = new_axis(initial_position_inc=100)
    for low, high, is_outside in ((100, 101, False), (101, 200, True), (0, 100, True)):
        axis.set_gate(low, high, -FAR, FAR)
        assert not outside(axis)  # not evaluated at the present tick
        axis.at((axis._time.tick + 1) * MS)
        assert outside(axis) is is_outside


def test_gate_works_without_power():
    axis = new_axis()
    axis.set_load(5.0)
    axis.set_gate(-50, 50, -FAR, FAR)
    wake = axis.next_event_ns()
    while wake is not None and not outside(axis):
        axis.at(wake)
        wake = axis.next_event_ns()
    assert outside(axis)
    assert axis.count() < -50


def test_new_gate_around_count_clears_flag():
    axis = new_axis()
    axis.set_gate(5, 9, -FAR, FAR)
    axis.at(1 * MS)
    assert outside(axis)
    axis.set_gate(-5, 9, -FAR, FAR)
    assert not outside(axis)
    assert axis.next_event_ns() is None


def test_set_position_does_not_move_gate():
    axis = new_axis()
    axis.set_gate(-5, 5, -FAR, FAR)
    axis.set_position(1_000)
    axis.at(1 * MS)
    assert (axis.count(), axis.output_count(), axis.position_inc()) == (0, 0, 1_000)
    assert not outside(axis)
    axis.set_position(7, count=-20)
    assert axis.position_inc() == 27
