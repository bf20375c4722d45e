"""A drive has its own clock, and its motor moves in true time: measured on the truth.

Expected times are calculated here with fractions, from the clock error alone. With a clock that is
fast by e, a span s of its own time passes in s / (1 + e).
"""

import struct
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.cia402.drive import Cia402Drive, build
from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.firmware.clock import OwnTime
from tests.support.cia402.bench import BOOT_UP, ENABLE, MS, NODE, Bench

S = 1000 * MS
ERRORS_PPM = (-100_000, -2_000, -50, 0, 50, 2_000, 100_000)
POSITION_GAIN = (0x60FB, 1)
MILD = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}


def new(seed=1, name="drive", **settings):
    table = {"node_id": NODE, "plant": MILD, **settings}
    return build(table, ControllerContext(name=name, folder=Path(), seed=seed))


def bench_with(ppm, phase_s=0.0, **settings):
    oscillator = {"ppm": ppm, "phase_s": phase_s}
    return Bench(drive=new(oscillator=oscillator, **settings))


def true_ns(own_ns, ppm):
    return own_ns / (1 + Fraction(ppm) / 1_000_000)


def enabled(bench, mode):
    """Enable the drive as `Bench.enable` does, but allow for its clock error."""
    bench.run(2 * BOOT_UP)
    bench.nmt(0x01)
    bench.set(0x6060, 0, mode, 1)
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(2 * ENABLE)
    assert bench.truth("state") == 4
    return bench


# --- timers


@pytest.mark.parametrize("ppm", ERRORS_PPM)
def test_heartbeats_follow_the_drives_own_period(ppm):
    bench = bench_with(ppm, objects={"1017h": 100})
    bench.run(100 * S)
    times = bench.times(0x700 + NODE)
    assert len(times) > 850
    for count, time_ns in enumerate(times):
        exact_ns = true_ns(BOOT_UP + count * 100 * MS, ppm)
        assert 0 <= time_ns - exact_ns < 1  # the first whole nanosecond not before the exact time


@pytest.mark.parametrize("ppm", ERRORS_PPM)
def test_event_timer_follows_the_drives_own_clock(ppm):
    bench = bench_with(ppm, objects={"1800h:2": 255, "1800h:5": 10})
    bench.run(2 * BOOT_UP)
    bench.nmt(0x01)
    bench.run(20 * S)
    times = bench.times(0x180 + NODE)
    count = len(times) - 1
    assert count >= 1800
    mean_ns = Fraction(times[-1] - times[0], count)
    assert abs(mean_ns - true_ns(10 * MS, ppm)) <= 2  # each is read from a clock with whole ns


def test_consumed_heartbeat_times_out_by_the_own_clock():
    bench = bench_with(100_000)
    bench.run(2 * BOOT_UP)
    bench.set(0x1016, 1, 127 << 16 | 110, 4)
    bench.send(0x77F, b"\x05")
    heard = bench.now
    bench.run(S)
    (time_ns,) = bench.times(0x080 + NODE)
    assert time_ns - heard in (100 * MS, 100 * MS + 1)


def test_sdo_reply_delay_follows_the_own_clock():
    bench = bench_with(-100_000, timing={"sdo_reply_s": 0.009})
    bench.run(2 * BOOT_UP)
    asked = bench.now
    bench.read(0x6041)
    assert bench.now - asked in (10 * MS, 10 * MS + 1)


# --- motion


@pytest.mark.parametrize("ppm", ERRORS_PPM)
def test_profile_duration_follows_the_own_clock(ppm):
    """Accelerate 0.5 s, cruise, brake 0.5 s: 20 s by its own clock, to one servo tick."""
    bench = enabled(bench_with(ppm), 1)
    speed, distance = 50_000, 50_000 * 39 // 2
    for index, value in ((0x6081, speed), (0x6083, 2 * speed), (0x6084, 2 * speed)):
        bench.set(index, 0, value, 4)
    bench.set(0x607A, 0, distance, 4)
    bench.controlword(0x3F)
    began = bench.now
    assert bench.truth("demand_inc") == 0
    bench.run_until(began + int(true_ns(19_990 * MS, ppm)))
    assert bench.truth("demand_inc") < distance
    while bench.truth("demand_inc") < distance:
        bench.run(MS // 10)
    took_ns = bench.now - began
    assert abs(took_ns - true_ns(20 * S, ppm)) < true_ns(3 * MS, ppm)  # rounded at the slow end


@pytest.mark.parametrize("ppm", ERRORS_PPM)
def test_motor_at_constant_speed_gains_the_clock_error(ppm):
    bench = enabled(bench_with(ppm), 3)
    speed = 50_000
    bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, speed))
    bench.run(2 * S)
    start = bench.truth("position_inc")
    bench.run(100 * S)
    gone = bench.truth("position_inc") - start
    exact = speed * 100 * (1 + ppm / 1e6)
    tick = speed / 1000
    assert gone == pytest.approx(exact, abs=2 * tick)  # the observed value is up to one tick old
    assert bench.truth("velocity_rad_s") == pytest.approx(
        exact / 100 * 6.283185307179586 / (66 * 2000),
        rel=5e-3,  # the velocity has ripple
    )


@pytest.mark.parametrize("ppm", [-100_000, 100_000])
def test_motor_itself_moves_in_true_time(ppm):
    """Turn an unpowered motor by a load; 9, 10 and 11 ticks of the three clocks are 10 ms each."""
    own, true = bench_with(ppm), bench_with(0)
    for bench in (own, true):
        bench.run(S // 2)
        bench.set(*POSITION_GAIN, bench.read(*POSITION_GAIN[:2]) // 2, 4)  # a new servo
        bench.run_until(S)
        bench.drive.stimulate("load_torque_n_m", 5.0, bench.now)
        assert bench.truth("position_rad") == 0.0
    for _ in range(20):
        for bench in (own, true):
            bench.run(10 * MS)
        for key in ("position_rad", "velocity_rad_s"):
            assert own.truth(key) == pytest.approx(true.truth(key), rel=1e-9)
    assert abs(own.truth("position_rad")) > 0.1


@pytest.mark.parametrize("ppm", [-100_000, 100_000])
def test_torque_accelerates_in_true_time(ppm):
    gained = []
    for error in (ppm, 0):
        bench = enabled(bench_with(error), 4)
        bench.set(0x6087, 0, 0x7FFF_FFFF, 4)
        bench.set(0x6071, 0, 100, 2)
        bench.run_until((bench.now // (10 * MS) + 10) * 10 * MS)
        before = bench.truth("velocity_rad_s")
        bench.run(50 * MS)
        gained.append(bench.truth("velocity_rad_s") - before)
    assert gained[0] == pytest.approx(gained[1], rel=2e-2)  # the current loop is the firmware's


def test_cyclic_targets_are_followed_without_falling_behind():
    """Check 1000 ppm, five ticks in 5 s: the drive's tick grid drifts across the host's SYNCs."""
    objects = {"1402h:2": 1, "6065h": 0xFFFF_FFFF, "60C2h:1": 10}
    for ppm in (-1000, 1000):
        bench = enabled(bench_with(ppm, objects=objects), 8)
        for cycle in range(500):
            bench.send(0x400 + NODE, struct.pack("<Hi", 0x0F, 200 * cycle))
            bench.sync()
            behind = 200 * (cycle - 1) - bench.truth("demand_inc")
            assert cycle < 2 or -20 <= behind <= 40  # a tick is 20 increments
            bench.run(10 * MS)


# --- phase


@pytest.mark.parametrize("phase_s", [0.0, 0.000_25, 0.000_999])
def test_servo_periods_begin_at_the_configured_phase(phase_s):
    bench = enabled(bench_with(0, phase_s), 3)
    bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, 50_000))
    bench.run(S)
    changes = []
    before = bench.truth("position_inc")
    for _ in range(4000):
        bench.run(1000)
        seen = bench.truth("position_inc")
        if seen != before:
            changes.append((bench.now + round(phase_s * S)) % MS)
        before = seen
    assert changes == [0, 0, 0, 0]


@pytest.mark.parametrize("ppm", [-50, 1234.567891])
def test_observing_changes_nothing(ppm):
    """Check that the frames are the same, to the ns, however often the drive is observed."""
    sent = []
    for look_ns in (S, 370_001):
        bench = enabled(bench_with(ppm, 0.000_4, objects={"1017h": 7}), 1)
        bench.set(0x607A, 0, 30_000, 4)
        bench.controlword(0x3F)
        end = bench.now + 2 * S
        while bench.now < end:
            bench.run_until(min(end, bench.now + look_ns))
            bench.truth("position_rad")
        sent.append(bench.sent)
    assert sent[0] == sent[1]


# --- settings in a rig


def test_clock_that_shows_true_time_adds_no_layer():
    for oscillator in ({}, {"ppm": 0, "phase_s": 0.0}, {"ppm_max": 0}):
        assert isinstance(new(oscillator=oscillator), Cia402Drive)
    assert isinstance(new(oscillator={"ppm": 1e-6}), OwnTime)


def test_clock_properties_are_reported_to_the_recording():
    told = [("info", "its own clock runs 12.5 ppm slow and began at 0.3 ms")]
    assert bench_with(-12.5, 0.0003).events == told
    assert bench_with(0).events == []


@given(st.integers(0, 2**32 - 1), st.sampled_from(["left", "right"]))
def test_random_clock_depends_on_seed_and_name(seed, name):
    oscillator = {"ppm_max": 100, "phase_max_s": 0.001}
    clock = new(seed, name, oscillator=oscillator).oscillator
    assert -100e6 <= clock.error_1e12 <= 100e6
    assert 0 <= clock.phase_ns < MS
    assert clock == new(seed, name, oscillator=oscillator).oscillator
    for other in ((seed + 1, name), (seed, "other")):
        assert clock != new(*other, oscillator=oscillator).oscillator


def test_random_clocks_cover_the_allowed_range():
    clocks = [
        new(7, f"drive-{k}", oscillator={"ppm_max": 100, "phase_max_s": 0.001}).oscillator
        for k in range(200)
    ]
    errors = sorted(clock.error_1e12 / 1e6 for clock in clocks)
    assert errors[0] < -90
    assert errors[-1] > 90
    assert abs(sum(errors) / 200) < 15
    assert {clock.phase_ns * 10 // MS for clock in clocks} == set(range(10))


@pytest.mark.parametrize(
    ("oscillator", "told"),
    [
        (
            {"ppm": 100_001},
            "oscillator.ppm: 100001 ppm is out of range; allowed: -100000 to 100000 ppm",
        ),
        (
            {"ppm": "50"},
            'oscillator.ppm: must be a number [ppm], but is a string ("50"); allowed: -100000 to',
        ),
        (
            {"ppm": float("nan")},
            "oscillator.ppm: must be finite (nan); allowed: -100000 to 100000 ppm",
        ),
        ({"ppm_max": -1}, "oscillator.ppm_max: -1 ppm is out of range; allowed: 0 to 100000 ppm"),
        ({"phase_s": -0.1}, "oscillator.phase_s: -0.1 s is out of range; allowed: 0 to 1 s"),
        ({"phase_max_s": 2}, "oscillator.phase_max_s: 2 s is out of range; allowed: 0 to 1 s"),
        ({"ppb": 50}, "oscillator.ppb: unknown key"),
        (
            {"ppm": 1, "ppm_max": 1},
            "oscillator.ppm_max: has no effect, because ppm is given; remove one",
        ),
        (
            {"phase_s": 0, "phase_max_s": 0},
            "oscillator.phase_max_s: has no effect",
        ),
        (50, "oscillator: must be a table, but is an integer (50); write [oscillator]"),
    ],
)
def test_invalid_clock_is_rejected_with_the_key(oscillator, told):
    with pytest.raises(SettingError) as caught:
        new(oscillator=oscillator)
    assert str(caught.value).startswith(told)
