"""When a motion has begun and is over, by statuswords alone."""

import pytest

from motorapi.adaptations.motion_watch import (
    SETTLE_NS,
    HomingWatch,
    RestWatch,
    SetpointWatch,
    StreamWatch,
)

MS = 1_000_000
# statuswords of a drive in operation enabled (CiA 402-2): 0237h and bits 10, 12, 13
MOVING, REACHED = 0x0237, 0x0637
ACK, ACK_REACHED = 0x1237, 0x1637


def set_point(expected_ms: int = 100, tolerance: int | None = 10) -> SetpointWatch:
    watch = SetpointWatch(
        commanded_ns=None,
        expected_ns=expected_ms * MS,
        acknowledged=True,
        target_inc=1000,
        tolerance_inc=tolerance,
        distance_inc=1000,
    )
    watch.begin(5 * MS)
    return watch


def test_a_set_point_begins_with_its_acknowledge_and_ends_with_target_reached():
    watch = set_point()
    watch.see(REACHED, 0, 6 * MS)
    assert watch.started_ns is None
    watch.see(ACK, 0, 7 * MS)
    assert watch.started_ns == 7 * MS
    watch.see(MOVING, 500, 50 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 1000, 120 * MS)
    watch.see(REACHED, 1000, 140 * MS)
    assert watch.ended_ns == 120 * MS


def test_target_reached_of_the_motion_before_is_not_believed():
    watch = set_point()
    for time_ms in range(7, 27, 2):  # a drive that shows it 20 ms too long
        watch.see(ACK_REACHED, 0, time_ms * MS)
        assert watch.ended_ns is None
    watch.see(MOVING, 100, 30 * MS)
    watch.see(REACHED, 1000, 110 * MS)
    assert watch.ended_ns == 110 * MS


def test_a_status_of_before_that_was_late_on_its_way_is_not_believed():
    watch = SetpointWatch(
        commanded_ns=None,
        expected_ns=100 * MS,
        acknowledged=True,
        target_inc=1000,
        tolerance_inc=10,
        distance_inc=1000,
    )
    watch.begin(5 * MS)
    watch.see(ACK, 0, 7 * MS)
    watch.see(REACHED, 0, 8 * MS)  # sampled before the start
    watch.see(REACHED, 749, 9 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 750, 10 * MS)
    assert watch.ended_ns == 10 * MS


def test_a_bit_that_is_never_seen_low_counts_when_time_and_place_are_right():
    watch = set_point(expected_ms=100)
    watch.see(ACK_REACHED, 0, 10 * MS)
    watch.see(REACHED, 1000, 110 * MS - 1)
    assert watch.ended_ns is None
    watch.see(REACHED, 989, 110 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 990, 111 * MS)
    assert watch.ended_ns == 111 * MS


def test_a_move_of_length_zero_ends_at_its_acknowledge():
    watch = set_point(expected_ms=0)
    watch.see(ACK_REACHED, 1000, 7 * MS)
    assert (watch.started_ns, watch.ended_ns) == (7 * MS, 7 * MS)


def test_without_a_position_window_time_alone_decides():
    watch = set_point(expected_ms=100, tolerance=None)
    watch.see(ACK_REACHED, 0, 10 * MS)
    watch.see(REACHED, 0, 110 * MS)
    assert watch.ended_ns == 110 * MS


def test_a_target_velocity_counts_from_when_it_was_on_the_wire():
    watch = SetpointWatch(
        commanded_ns=None, expected_ns=0, acknowledged=False, target_inc=None, tolerance_inc=None
    )
    watch.see(MOVING, 0, 1 * MS)
    watch.see(REACHED, 0, 2 * MS)  # armed, not fired: both are of before
    assert watch.started_ns is None
    watch.begin(3 * MS)
    watch.begin(9 * MS)  # the first counts
    watch.see(REACHED, 0, 3 * MS)  # sampled before
    assert watch.started_ns is None
    watch.see(MOVING, 0, 4 * MS)
    watch.see(REACHED, 0, 50 * MS)
    assert (watch.started_ns, watch.ended_ns) == (4 * MS, 50 * MS)


def test_rest_needs_the_bit_and_a_position_that_stands_still():
    watch = RestWatch(commanded_ns=0, needs_bit=True)
    watch.see(REACHED, 0, 0)  # pv: at speed, the bit means the velocity is reached
    watch.see(REACHED, 50, 20 * MS)
    watch.see(MOVING, 80, 40 * MS)
    watch.see(MOVING, 81, 60 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 82, 61 * MS)  # within 2 increments for 20 ms
    assert watch.ended_ns == 61 * MS


def test_rest_after_a_quick_stop_is_seen_by_position_alone():
    watch = RestWatch(commanded_ns=0, needs_bit=False)
    watch.see(0x0217, 80, 40 * MS)
    watch.see(0x0217, 80, 40 * MS + SETTLE_NS - 1)
    assert watch.ended_ns is None
    watch.see(0x0217, 80, 40 * MS + SETTLE_NS)
    assert watch.ended_ns == 40 * MS + SETTLE_NS


@pytest.mark.parametrize("error", [False, True])
def test_a_homing_attained_before_is_not_believed_until_it_was_seen_low(error: bool):
    homed: list[bool] = []
    watch = HomingWatch(commanded_ns=10 * MS, on_success=lambda: homed.append(True))
    watch.see(ACK_REACHED, 0, 12 * MS)  # drives.md: 1400h is "completed", of the homing before
    assert watch.ended_ns is None
    watch.see(MOVING, 0, 14 * MS)
    watch.see(0x2237 if error else ACK_REACHED, 0, 16 * MS)
    assert watch.ended_ns == 16 * MS
    assert watch.failed is error
    assert homed == ([] if error else [True])


def test_a_homing_that_is_over_at_once_is_believed_after_the_settling_time():
    watch = HomingWatch(commanded_ns=10 * MS)
    watch.see(ACK_REACHED, 0, 10 * MS + SETTLE_NS - 1)
    assert watch.ended_ns is None
    watch.see(ACK_REACHED, 0, 10 * MS + SETTLE_NS)
    assert watch.ended_ns == 10 * MS + SETTLE_NS


def test_homing_attained_but_still_moving_is_not_over():
    watch = HomingWatch(commanded_ns=0)
    watch.see(MOVING, 0, 5 * MS)
    watch.see(ACK, 0, 6 * MS)  # 1000h: attained, target not reached
    assert watch.ended_ns is None
    watch.see(ACK_REACHED, 0, 9 * MS)
    assert watch.ended_ns == 9 * MS


def test_set_points_are_over_when_the_last_had_its_period_and_the_position_is_there():
    watch = StreamWatch(period_ns=5 * MS, tolerance_inc=10)
    watch.begin(10 * MS)
    assert watch.started_ns == 10 * MS
    watch.see(MOVING, 1000, 90 * MS)  # it is there, but there are more to come
    assert watch.ended_ns is None
    watch.arrive(1000, 100 * MS)
    watch.arrive(0, 101 * MS)  # once is enough
    watch.see(MOVING, 995, 104 * MS)  # the drive is still on its way to it
    assert watch.ended_ns is None
    watch.see(MOVING, 989, 105 * MS)
    assert watch.ended_ns is None
    watch.see(MOVING, 990, 106 * MS)
    watch.see(MOVING, 1000, 107 * MS)
    assert watch.ended_ns == 106 * MS


def test_without_a_window_set_points_are_over_when_the_motor_stands():
    watch = StreamWatch(period_ns=MS, tolerance_inc=None)
    watch.arrive(1000, 100 * MS)
    for time_ms, position in ((101, 900), (110, 950), (120, 951), (129, 951)):
        watch.see(MOVING, position, time_ms * MS)
        assert watch.ended_ns is None
    watch.see(MOVING, 951, 110 * MS + SETTLE_NS)
    assert watch.ended_ns == 110 * MS + SETTLE_NS


def test_set_points_that_go_on_at_a_velocity_are_over_as_they_arrive():
    watch = StreamWatch(period_ns=MS, tolerance_inc=10)
    watch.arrive(None, 100 * MS)
    watch.see(MOVING, 123, 101 * MS)
    assert watch.ended_ns == 101 * MS


def test_set_points_that_failed_are_over_when_the_motor_stands_from_then_on():
    watch = StreamWatch(period_ns=MS, tolerance_inc=10)
    told: list[int] = []
    watch.on_end = lambda: told.append(1)
    watch.see(MOVING, 5, 10 * MS)
    watch.fail(ValueError("no more"))
    watch.fail(ValueError("again"))
    watch.see(MOVING, 5, 50 * MS)
    assert watch.ended_ns is None
    watch.see(MOVING, 5, 50 * MS + SETTLE_NS - 1)
    assert watch.ended_ns is None
    watch.see(MOVING, 5, 50 * MS + SETTLE_NS)
    assert (watch.ended_ns, watch.failed, str(watch.error)) == (
        50 * MS + SETTLE_NS,
        True,
        "no more",
    )
    assert told == [1]
