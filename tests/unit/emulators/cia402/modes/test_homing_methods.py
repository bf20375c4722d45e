"""Homing over switches and index pulse: home is where the standard's drawings place it.

`PICTURES` is read from the drawings of CiA 402-2, homing methods: the edge, and the side of it on
which the index pulse lies. The drive may choose its path.
"""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from tests.support.cia402.bench import MS, Bench
from tests.support.cia402.homing_bench import (
    ATTAINED,
    DONE,
    ERROR_AT_REST,
    ERROR_MOVING,
    IN_PROGRESS,
    INTERRUPTED,
    RAD,
    TURN,
    Track,
    bench_on,
    finish,
    home,
    home_count,
    status,
)

# Method: the edge of home, then the side of it with the relevant index pulse: left or right.
PICTURES = {
    1: ("negative limit", "right"),
    2: ("positive limit", "left"),
    3: ("home, left edge", "left"),
    4: ("home, left edge", "right"),
    5: ("home, right edge", "right"),
    6: ("home, right edge", "left"),
    7: ("home, left edge", "left"),
    8: ("home, left edge", "right"),
    9: ("home, right edge", "left"),
    10: ("home, right edge", "right"),
    11: ("home, right edge", "right"),
    12: ("home, right edge", "left"),
    13: ("home, left edge", "right"),
    14: ("home, left edge", "left"),
}
METHODS = (*range(1, 15), *range(17, 31), 33, 34)
FAST = st.sampled_from([10_000, 30_000, 120_000])
SLOW = st.sampled_from([1_500, 4_000, 9_000])


def pulses(track: Track, low: int, high: int) -> list[int]:
    return [count for count in range(low, high) if (count - track.index) % TURN == 0]


def prescribed(method: int, track: Track, start: int) -> int:
    if method == 33:
        return pulses(track, start - TURN, start + 1)[-1]
    if method == 34:
        return pulses(track, start + 1, start + TURN + 1)[0]
    edge_name, side = PICTURES[method if method < 15 else method - 16]
    left, right = track.home or (None, None)
    edge = {
        "negative limit": track.negative,
        "positive limit": track.positive,
        "home, left edge": left,
        "home, right edge": right,
    }[edge_name]
    if method > 15:
        return edge
    if side == "left":
        return pulses(track, edge - TURN + 1, edge + 1)[-1]
    return pulses(track, edge, edge + TURN)[0]


def track_for(method: int, left: int, width: int, index: int) -> Track:
    """Return a track; 3, 4: the home switch extends to the right end; 5, 6: to the left end."""
    row = method if method < 15 else method - 16
    home_switch = (left, None) if row in (3, 4) else (None, left) if row in (5, 6) else None
    return Track(home=home_switch or (left, left + width), index=index)


@given(
    st.sampled_from(METHODS),
    st.integers(-5_900, 5_900),
    st.integers(-3_000, 2_000),
    st.sampled_from([1, 30, 900]),
    st.integers(0, TURN - 1),
    FAST,
    SLOW,
    st.sampled_from([0.001, 0.0025, 0.0006]),
)
def test_home_is_where_the_drawings_place_it(method, start, left, width, index, fast, slow, tick_s):
    track = track_for(method, left, width, index)
    bench = bench_on(
        track, start, tick_s=tick_s, o6098=method, o6099_1=fast, o6099_2=slow, o609A=2_000_000
    )
    where = prescribed(method, track, bench.drive.axis.count())
    if method > 30 and not track.negative < where < track.positive:  # these methods do not reverse
        event("beyond the end of travel")
        assert home(bench, within_s=90.0) == ERROR_AT_REST
        return
    assert home(bench, within_s=90.0) == DONE
    event(f"method {method}")
    assert home_count(bench) == where


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", [-4_000, 0, 4_000])
def test_every_method_finds_home_from_any_side(method, start):
    track = track_for(method, -300, 700, 123)
    bench = bench_on(track, start, o6098=method)
    count = bench.drive.axis.count()
    assert home(bench) == DONE
    assert home_count(bench) == prescribed(method, track, count)


@pytest.mark.parametrize("tick_s", [0.001, 0.0006, 0.004])
@pytest.mark.parametrize("speed", [3_000, 10_000, 100_000])
def test_zero_is_the_same_for_any_tick_and_speed(tick_s, speed):
    for method, where in ((17, -6_000), (26, 400), (30, -300), (11, 700), (33, -1_300)):
        track = Track()
        bench = bench_on(
            track, -100, tick_s=tick_s, o6098=method, o6099_1=speed, o6099_2=speed, o609A=1_000_000
        )
        assert home(bench, within_s=60.0) == DONE
        assert home_count(bench) == where


def test_cam_passed_within_a_tick_is_detected():
    bench = bench_on(Track(home=(2_000, 2_003)), o6098=24, o6099_1=150_000, o609A=5_000_000)
    assert home(bench) == DONE
    assert home_count(bench) == 2_000


def test_zero_is_home_plus_offset_though_motor_overruns():
    bench = bench_on(Track(), 0, o6098=18, o607C=1_234, o6099_2=8_000, o609A=100_000)
    assert home(bench) == DONE
    stood = bench.drive.axis.count()
    assert 6_000 - stood == pytest.approx(8_000**2 / 2 / 100_000, abs=20)  # on the ramp 609Ah
    assert bench.read(0x6064) == stood - 6_000 - 1_234


def test_switch_search_is_fast_and_edge_search_slow():
    bench = bench_on(Track(), 3_000, o6098=17, o6099_1=20_000, o6099_2=1_000)
    bench.controlword(0x1F)
    bench.run(200 * MS)
    assert bench.read(0x606C) == pytest.approx(-20_000, abs=300)
    bench.run(550 * MS)
    assert bench.read(0x606C) == pytest.approx(1_000, abs=200)
    assert finish(bench) == DONE


def test_statusword_shows_attained_before_standstill():
    bench = bench_on(Track(), 0, o6098=24, o609A=50_000)
    seen = []
    bench.controlword(0x1F)
    while not seen or seen[-1] != DONE:
        if not seen or seen[-1] != status(bench):
            seen.append(status(bench))
        bench.run(MS)
        if seen[-1] != status(bench):
            seen.append(status(bench))
    assert seen == [IN_PROGRESS, ATTAINED, DONE]


# --- failures


FAILURES = {
    "home switch not there, both ends met": (Track(home=None), 0, {"o6098": 7}),
    "home switch not there, no turning round": (Track(home=None), 0, {"o6098": 19}),
    "the pulse lies beyond the limit switch": (Track(positive=600), 0, {"o6098": 34}),
    "no index pulse": (Track(index=None), 0, {"o6098": 34}),
    "no index pulse beyond the edge": (Track(index=None), 0, {"o6098": 8}),
    "speed for the switch is 0": (Track(), 0, {"o6098": 17, "o6099_1": 0}),
    "speed for zero is 0": (Track(), 0, {"o6098": 33, "o6099_2": 0}),
    "a reserved method": (Track(), 0, {"o6098": 36}),
}


@pytest.mark.parametrize("name", FAILURES)
def test_homing_that_cannot_succeed_reports_an_error(name):
    track, start, objects = FAILURES[name]
    bench = bench_on(track, start, **objects)
    count = len(bench.sent)
    assert home(bench) == ERROR_AT_REST
    assert bench.read(0x603F) == 0  # a homing error is not a fault
    assert all(can_id != 0x085 for _, can_id, _ in bench.sent[count:])
    bench.controlword(0x0F)
    assert status(bench) == ERROR_AT_REST  # until a new start
    bench.set(0x6098, 0, 37, 1)
    assert home(bench) == DONE


def test_search_without_pulse_ends_soon_after_one_turn():
    bench = bench_on(Track(index=None, negative=None, positive=None), 0, o6098=34)
    assert home(bench) == ERROR_AT_REST
    assert TURN < bench.drive.axis.count() < 1.1 * TURN


def test_both_limit_switches_active_make_homing_fail():
    bench = bench_on(Track(), 0, o6098=23)
    bench.drive.stimulate("negative_limit", 1, bench.now)
    bench.drive.stimulate("positive_limit", 1, bench.now)
    assert home(bench) == ERROR_AT_REST
    assert bench.drive.axis.count() == pytest.approx(0, abs=1)


def test_error_is_reported_while_still_moving():
    bench = bench_on(Track(home=None, positive=1_000), 0, o6098=19, o6099_1=30_000)
    bench.controlword(0x1F)
    bench.run_while(lambda: status(bench) == IN_PROGRESS)
    assert status(bench) == ERROR_MOVING
    assert finish(bench) == ERROR_AT_REST


# --- interruptions


def moving(bench) -> bool:
    return abs(bench.truth("velocity_rad_s")) > 100 * RAD


@pytest.mark.parametrize("how", ["bit 4", "halt", "quick stop", "mode", "off"])
def test_interrupted_homing_keeps_zero_and_limits(how):
    bench = bench_on(Track(), 0, o6098=17, o605A=6)
    bench.controlword(0x1F)
    bench.run(100 * MS)
    assert moving(bench)
    assert status(bench) == IN_PROGRESS
    if how == "mode":
        bench.set(0x6060, 0, 1, 1)
    else:
        word = {"bit 4": 0x0F, "halt": 0x011F, "quick stop": 0x0B, "off": 0x06}[how]
        bench.controlword(word)
    bench.run((500 if how != "off" else 20_000) * MS)
    assert not moving(bench)
    assert home_count(bench) == 0
    if how in ("bit 4", "halt"):
        assert status(bench) == INTERRUPTED
    bench.set(0x6060, 0, 3, 1)
    bench.set(0x60FF, 0, -50_000, 4)
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(1_000 * MS)
    assert not moving(bench)  # the limit switch is active again
    assert bench.read(0x60FD) == 1


def test_after_a_halt_only_a_new_start_continues():
    bench = bench_on(Track(), 0, o6098=17)
    bench.controlword(0x1F)
    bench.run(50 * MS)
    bench.controlword(0x011F)
    bench.run(500 * MS)
    bench.controlword(0x1F)
    bench.run(100 * MS)
    assert not moving(bench)
    assert home(bench) == DONE
    assert home_count(bench) == -6_000


def test_repeated_homing_finds_the_same_position():
    bench = bench_on(Track(), 2_500, o6098=11)
    for _ in range(3):
        before = bench.drive.axis.position_inc() - bench.drive.axis.count()
        assert home(bench) == DONE
        assert home_count(bench) == 700
        assert before in (0, -700)


def test_supported_methods_are_those_with_behaviour():
    bench = bench_on(Track())
    number = bench.read(0x60E3, 0)
    methods = [bench.read(0x60E3, place) for place in range(1, number + 1)]
    assert methods == [*range(1, 15), *range(17, 31), 33, 34, 35, 37]
    for method in methods:
        assert bench.write(0x6098, 0, method, 1) == 0
    for method in {*range(-5, 45)} - {0, *methods}:
        assert bench.write(0x6098, 0, method, 1) == 0x0609_0030


def test_switch_at_the_load_acts_behind_play_and_soft_shaft():
    """Check with an encoder at the motor: home is its count when the load is at the edge."""
    plant = {"preset": "wheel_60w", "backlash_rad": 200 * RAD, "coupling_stiffness_n_m_rad": 400.0}
    bench = Bench(
        plant=plant,
        switches=Track().table(),
        objects={"6098h": 26, "6099h:1": 10_000, "6099h:2": 1_000, "609Ah": 400_000},
    )
    bench.enable(mode=6)
    assert home(bench) == DONE
    assert home_count(bench) == pytest.approx(400, abs=110)  # half the play before, or after
    assert home_count(bench) != 400


@pytest.mark.parametrize(("option", "ramp"), [(1, 100_000), (2, 200_000)])
def test_halt_of_homing_slows_down_on_the_homing_ramp(option, ramp):
    """Check bit 8 in hm: the axis stops with 609Ah, where 605Dh says slow-down ramp.

    Technosoft's iPOS and the controlword of hm in DSP 402 do so; 605Dh = 2 is 6085h in any mode.
    """
    ramps = {"o6084": 400_000, "o6085": 200_000, "o609A": 100_000}
    bench = bench_on(Track(negative=-200_000), 0, o6098=17, o605D=option, **ramps)
    bench.controlword(0x0F)
    bench.controlword(0x1F)
    bench.run(500 * MS)
    assert bench.drive.axis.demand_velocity_inc_s() == -20_000
    begun = bench.now
    bench.controlword(0x11F)
    bench.run_while(lambda: bench.drive.axis.demand_velocity_inc_s() != 0.0)
    assert (bench.now - begun) / 1e9 == pytest.approx(20_000 / ramp, abs=0.002)
    bench.run(50 * MS)
    assert status(bench) == INTERRUPTED
