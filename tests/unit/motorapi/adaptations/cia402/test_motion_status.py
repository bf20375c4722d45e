"""Begin and end of a motion, from statuswords alone."""

import pytest

from motorhil.motorapi.adaptations.cia402.motion_status import (
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


def test_set_point_begins_and_ends_by_its_bits():
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


def test_old_target_reached_is_ignored():
    watch = set_point()
    for time_ms in range(7, 27, 2):  # a drive that shows it 20 ms too long
        watch.see(ACK_REACHED, 0, time_ms * MS)
        assert watch.ended_ns is None
    watch.see(MOVING, 100, 30 * MS)
    watch.see(REACHED, 1000, 110 * MS)
    assert watch.ended_ns == 110 * MS


def test_delayed_old_status_is_ignored():
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


def test_bit_never_low_counts_by_duration_and_position():
    watch = set_point(expected_ms=100)
    watch.see(ACK_REACHED, 0, 10 * MS)
    watch.see(REACHED, 1000, 110 * MS - 1)
    assert watch.ended_ns is None
    watch.see(REACHED, 989, 110 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 990, 111 * MS)
    assert watch.ended_ns == 111 * MS


def test_move_of_length_zero_ends_at_its_acknowledge():
    watch = set_point(expected_ms=0)
    watch.see(ACK_REACHED, 1000, 7 * MS)
    assert (watch.started_ns, watch.ended_ns) == (7 * MS, 7 * MS)


def test_motion_without_position_window_ends_by_duration():
    watch = set_point(expected_ms=100, tolerance=None)
    watch.see(ACK_REACHED, 0, 10 * MS)
    watch.see(REACHED, 0, 110 * MS)
    assert watch.ended_ns == 110 * MS


def test_target_velocity_begins_when_on_the_wire():
    watch = SetpointWatch(
        commanded_ns=None, expected_ns=0, acknowledged=False, target_inc=None, tolerance_inc=None
    )
    watch.see(MOVING, 0, 1 * MS)
    watch.see(REACHED, 0, 2 * MS)  # armed, not fired: both are older
    assert watch.started_ns is None
    watch.begin(3 * MS)
    watch.begin(9 * MS)  # the first counts
    watch.see(REACHED, 0, 3 * MS)  # sampled before
    assert watch.started_ns is None
    watch.see(MOVING, 0, 4 * MS)
    watch.see(REACHED, 0, 50 * MS)
    assert (watch.started_ns, watch.ended_ns) == (4 * MS, 50 * MS)


def test_drive_at_rest_short_of_its_target_has_failed():
    watch = set_point()
    watch.see(ACK, 0, 7 * MS)
    watch.see(MOVING, 300, 50 * MS)
    watch.see(REACHED, 503, 60 * MS)  # may still be on its slow way, for 100 ms
    watch.see(REACHED, 500, 200 * MS)
    watch.see(REACHED, 503, 400 * MS)  # it still moves
    watch.see(REACHED, 503, 900 * MS - 1)
    assert watch.ended_ns is None
    watch.see(REACHED, 503, 900 * MS)
    assert (watch.failed, watch.ended_ns) == (True, 900 * MS)


def test_short_move_without_window_may_rest_beside_its_target():
    watch = SetpointWatch(
        commanded_ns=None,
        expected_ns=30 * MS,
        acknowledged=True,
        target_inc=-5538,
        tolerance_inc=None,
        distance_inc=3,
    )
    watch.begin(5 * MS)
    watch.see(ACK, -5541, 7 * MS)
    watch.see(REACHED, -5539, 40 * MS)
    assert (watch.failed, watch.ended_ns) == (False, 40 * MS)


def ramp(lasts_ms: int) -> SetpointWatch:
    watch = SetpointWatch(
        commanded_ns=None,
        expected_ns=0,
        acknowledged=False,
        target_inc=None,
        tolerance_inc=None,
        lasts_ns=lasts_ms * MS,
    )
    watch.begin(3 * MS)
    return watch


def test_ramp_within_its_window_is_not_over_early():
    watch = ramp(100)
    watch.see(MOVING, 0, 4 * MS)
    watch.see(REACHED, 0, 50 * MS)  # within the velocity window 606Dh
    watch.see(REACHED, 0, 103 * MS - 1)
    assert watch.ended_ns is None
    watch.see(REACHED, 0, 120 * MS)
    assert watch.ended_ns == 103 * MS


def test_ramp_reached_late_is_over_when_reached():
    watch = ramp(100)
    watch.see(REACHED, 0, 50 * MS)
    watch.see(MOVING, 0, 60 * MS)  # it has left the window again
    watch.see(MOVING, 0, 110 * MS)
    watch.see(REACHED, 0, 115 * MS)
    assert watch.ended_ns == 115 * MS


def test_rest_needs_the_bit_and_standstill():
    watch = RestWatch(commanded_ns=0, needs_bit=True)
    watch.see(REACHED, 0, 0)  # pv: at speed, the bit means that the velocity is reached
    watch.see(REACHED, 50, 20 * MS)
    watch.see(MOVING, 80, 40 * MS)
    watch.see(MOVING, 81, 60 * MS)
    assert watch.ended_ns is None
    watch.see(REACHED, 82, 61 * MS)  # within 2 increments for 20 ms
    assert watch.ended_ns == 61 * MS


def test_rest_after_quick_stop_is_seen_by_position():
    watch = RestWatch(commanded_ns=0, needs_bit=False)
    watch.see(0x0217, 80, 40 * MS)
    watch.see(0x0217, 80, 40 * MS + SETTLE_NS - 1)
    assert watch.ended_ns is None
    watch.see(0x0217, 80, 40 * MS + SETTLE_NS)
    assert watch.ended_ns == 40 * MS + SETTLE_NS


def test_rest_without_power_is_seen_by_position():
    watch = RestWatch(commanded_ns=0, needs_bit=True)
    for time_ms in range(0, 100, 10):
        watch.see(0x0250, 80 * time_ms, time_ms * MS)  # switch on disabled: the motor coasts
        assert watch.ended_ns is None
    watch.see(0x0250, 7201, 90 * MS + SETTLE_NS)
    assert watch.ended_ns == 90 * MS + SETTLE_NS


@pytest.mark.parametrize("error", [False, True])
def test_old_homing_attained_is_ignored_until_seen_low(error: bool):
    homed: list[bool] = []
    watch = HomingWatch(commanded_ns=10 * MS, on_success=lambda: homed.append(True))
    watch.see(ACK_REACHED, 0, 12 * MS)  # drives.md: 1400h is "completed", of the homing before
    assert watch.ended_ns is None
    watch.see(MOVING, 0, 14 * MS)
    watch.see(0x2237 if error else ACK_REACHED, 0, 16 * MS)
    assert watch.ended_ns == 16 * MS
    assert watch.failed is error
    assert homed == ([] if error else [True])


def test_immediate_homing_counts_after_the_settling_time():
    watch = HomingWatch(commanded_ns=10 * MS)
    watch.see(ACK_REACHED, 0, 10 * MS + SETTLE_NS - 1)
    assert watch.ended_ns is None
    watch.see(ACK_REACHED, 0, 10 * MS + SETTLE_NS)
    assert watch.ended_ns == 10 * MS + SETTLE_NS


def test_homing_attained_while_moving_is_not_over():
    watch = HomingWatch(commanded_ns=0)
    watch.see(MOVING, 0, 5 * MS)
    watch.see(ACK, 0, 6 * MS)  # 1000h: attained, target not reached
    assert watch.ended_ns is None
    watch.see(ACK_REACHED, 0, 9 * MS)
    assert watch.ended_ns == 9 * MS


def test_stream_is_over_after_last_period_and_at_position():
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


def test_stream_without_window_is_over_at_standstill():
    watch = StreamWatch(period_ns=MS, tolerance_inc=None)
    watch.arrive(1000, 100 * MS)
    for time_ms, position in ((101, 900), (110, 950), (120, 951), (129, 951)):
        watch.see(MOVING, position, time_ms * MS)
        assert watch.ended_ns is None
    watch.see(MOVING, 951, 110 * MS + SETTLE_NS)
    assert watch.ended_ns == 110 * MS + SETTLE_NS


def test_stream_with_final_velocity_is_over_at_arrival():
    watch = StreamWatch(period_ns=MS, tolerance_inc=10)
    watch.arrive(None, 100 * MS)
    watch.see(MOVING, 123, 101 * MS)
    assert watch.ended_ns == 101 * MS


def test_failed_stream_is_over_at_later_standstill():
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
