"""60FDh, hardware limit switches in every mode, and touch probe: edges at the plant's positions.

Sources: CiA 402-2 for the bits of 60FDh, 60B8h and 60B9h; Novanta's stop manager and SMC's LECSN-T
for the effect of an active limit switch: motion into it is blocked, motion away from it is free,
statusword bit 11 is set.
"""

import struct

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from tests.support.cia402.bench import MS, NODE, Bench
from tests.support.cia402.homing_bench import RAD, Track, bench_on

LIMIT = 0x0800
PP, PV, TQ, CSP = 1, 3, 4, 8


def velocity_inc_s(bench: Bench) -> float:
    return bench.truth("velocity_rad_s") / RAD


def count(bench: Bench) -> int:
    bench.truth("position_rad")
    return bench.drive.axis.count()


def bench_in(mode: int, track: Track, start: int = 0) -> Bench:
    bench = bench_on(track, start, o6085=1_000_000)
    bench.set(0x6060, 0, mode, 1)
    bench.run(20 * MS)
    return bench


def command(bench: Bench, mode: int, way: int) -> None:
    """Command a motion in that direction, well beyond the switches."""
    if mode == PP:
        bench.set(0x6081, 0, 40_000, 4)
        bench.set(0x607A, 0, way * 100_000, 4)
        bench.controlword(0x3F)
        bench.controlword(0x0F)
    elif mode == PV:
        bench.set(0x60FF, 0, way * 40_000, 4)
    elif mode == TQ:
        bench.set(0x6071, 0, way * 40, 2)
    else:
        begun = bench.read(0x6062)
        for step in range(1, 251):
            data = struct.pack("<Hi", 0x000F, begun + way * 40 * step)
            bench.send(0x400 + NODE, data)
            bench.sync()
            bench.run(MS)


@pytest.mark.parametrize("way", [-1, 1])
@pytest.mark.parametrize("mode", [PP, PV, TQ, CSP])
def test_limit_switch_blocks_motion_into_it_and_not_away(mode, way):
    bench = bench_in(mode, Track(negative=-4_000, positive=4_000))
    errors = bench.times(0x080 + NODE)
    assert not bench.statusword() & LIMIT
    command(bench, mode, way)
    bench.run(1_000 * MS)
    stood = count(bench)
    assert 4_000 <= way * stood < 6_500
    assert velocity_inc_s(bench) == pytest.approx(0, abs=50)
    assert bench.read(0x60FD, signed=False) == (1 if way < 0 else 2)
    word = bench.statusword()
    assert word & 0x006F == 0x0027  # operation enabled
    assert word & LIMIT
    assert not (mode != CSP and word & 0x0400)  # the target is not reached
    command(bench, mode, way)  # again, towards the switch
    bench.run(500 * MS)
    assert count(bench) == pytest.approx(stood, abs=20)
    command(bench, mode, -way)
    bench.run(250 * MS)
    assert way * (count(bench) - stood) < -1_000
    assert bench.times(0x080 + NODE) == errors  # this is not a fault


def test_stop_begins_at_the_tick_with_the_quick_stop_ramp():
    bench = bench_in(PV, Track())
    bench.set(0x6084, 0, 10_000, 4)
    bench.set(0x60FF, 0, 40_000, 4)
    bench.run_while(lambda: not bench.drive._power_drive.inputs.bits & 2)
    assert 0 <= count(bench) - 6_000 < 50  # within one tick of 40 increments
    bench.run(500 * MS)
    assert count(bench) - 6_000 == pytest.approx(40_000**2 / 2 / 1_000_000, abs=80)


def test_set_point_away_from_an_active_switch_is_reached():
    bench = bench_in(PP, Track(), start=6_500)
    assert bench.statusword() & LIMIT
    bench.set(0x607A, 0, 5_000, 4)
    bench.controlword(0x1F)
    bench.run(1_000 * MS)
    assert bench.statusword() & (LIMIT | 0x0400) == 0x0400
    assert count(bench) == pytest.approx(5_000, abs=10)


def test_inputs_can_be_forced_and_trigger_their_tpdo():
    bench = Bench(switches=Track().table())
    bench.boot()
    for index, subindex, value, size in (
        (0x1800, 1, 0x80000185, 4),
        (0x1A00, 0, 0, 1),
        (0x1A00, 1, 0x60FD0020, 4),
        (0x1A00, 0, 1, 1),
        (0x1800, 1, 0x185, 4),
    ):
        bench.set(index, subindex, value, size)
    bench.nmt(0x01)
    bench.run(10 * MS)
    told = []
    for name, value, bits in (
        ("interlock", 1, 0x0C),  # the axis stands on the home switch
        ("positive_limit", 1, 0x0E),
        ("negative_limit", 1, 0x0F),
        ("home", 0, 0x0B),
        ("touch_probe_2", 1, 0x2000B),
        ("digital_input_31", 1, 0x8002000B),
        ("positive_limit", -1, 0x80020009),
        ("negative_limit", 0, 0x80020008),
        ("home", -1, 0x8002000C),
    ):
        bench.drive.stimulate(name, value, bench.now)
        bench._drain()
        bench.run(10 * MS)  # TPDO 1 has an inhibit time of 5 ms
        told.append((bench.last(0x185), struct.pack("<I", bits)))
    assert [got for got, _ in told] == [expected for _, expected in told]
    with pytest.raises(ValueError, match="home = 2: must be 0, 1 or -1"):
        bench.drive.stimulate("home", 2, bench.now)


def test_motor_turned_without_power_reports_its_switches():
    bench = Bench(switches=Track().table())
    bench.operational()
    bench.drive.stimulate("load_torque_n_m", 5.0, bench.now)
    assert bench.read(0x60FD) == 4
    bench.run_while(lambda: bench.drive._power_drive.inputs.bits == 4)
    assert -340 < count(bench) < -300
    bench.run_while(lambda: bench.drive._power_drive.inputs.bits == 0)
    assert count(bench) < -6_000
    assert bench.read(0x60FD) == 1


def test_drive_at_rest_between_switches_has_no_deadline():
    bench = Bench(switches=Track().table())
    bench.operational()
    bench.run(100 * MS)
    assert bench.drive.next_deadline_ns() is None


# --- touch probe

# 60B8h, for the first probe; 60B9h; then value and counter objects.
ON, EVERY, PULSE, BY_SOURCE, RISING, FALLING = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
PROBE = (1_000, 1_500)  # counts between which the input of probe 1 is active


def probing(function: int, **more: object) -> Bench:
    track = Track(negative=None, positive=None).table()
    track |= {"touch_probe_1_from_rad": PROBE[0] * RAD, "touch_probe_1_to_rad": PROBE[1] * RAD}
    bench = Bench(switches=track, objects={"6081h": 30_000}, **more)
    bench.enable(mode=PP)
    bench.set(0x60B8, 0, function, 2)
    return bench


def go(bench: Bench, target: int) -> None:
    bench.set(0x607A, 0, target, 4)
    bench.controlword(0x3F)
    bench.controlword(0x0F)
    bench.run(1_000 * MS)
    assert bench.statusword() & 0x0400


def shown(bench: Bench) -> list[int]:
    return [bench.read(index, signed=True) for index in (0x60B9, 0x60BA, 0x60BB, 0x60D5, 0x60D6)]


def test_first_event_is_latched_once_per_request():
    bench = probing(ON | RISING | FALLING)
    assert shown(bench) == [1, 0, 0, 0, 0]
    go(bench, 3_000)
    assert shown(bench) == [7, 1_000, 1_500, 1, 1]
    go(bench, 0)  # backwards, the rising edge is at 1500, the falling edge at 1000
    assert shown(bench) == [7, 1_000, 1_500, 1, 1]
    bench.set(0x60B8, 0, ON | FALLING, 2)
    assert shown(bench) == [5, 1_000, 1_500, 1, 1]
    bench.set(0x60B8, 0, ON | RISING | FALLING, 2)
    go(bench, 1_200)
    assert shown(bench) == [7, 1_000, 1_500, 2, 1]
    bench.set(0x60B8, 0, 0, 2)
    assert shown(bench)[0] == 0


def test_forced_switch_has_no_edges():
    bench = probing(ON | EVERY | RISING | FALLING)
    bench.drive.stimulate("touch_probe_1", 0, bench.now)
    go(bench, 3_000)
    bench.drive.stimulate("home", 1, bench.now)  # this evaluates all inputs
    assert shown(bench) == [1, 0, 0, 0, 0]


def test_every_event_is_latched_and_counted_when_requested():
    bench = probing(ON | EVERY | RISING)
    go(bench, 3_000)
    go(bench, 0)
    assert shown(bench) == [3, 1_500, 0, 2, 0]
    bench.set(0x60B8, 0, 0, 2)
    go(bench, 3_000)
    assert shown(bench)[3] == 2


def test_index_pulse_is_a_source_by_either_setting():
    for function in (ON | EVERY | PULSE | RISING, ON | EVERY | BY_SOURCE | RISING):
        bench = probing(function, initial_position_rad=0.0)
        bench.set(0x60D0, 1, 5, 2)
        go(bench, 3_000)
        assert shown(bench)[:4] == [3, 2_700, 0, 2]
        assert bench.write(0x60D0, 1, 3, 2) == 0x0609_0030


def test_index_pulse_passed_before_its_use_is_not_an_edge():
    bench = probing(0)
    go(bench, 3_000)  # the pulse is at 700 and 2700, the last switch at 1500
    bench.set(0x60B8, 0, ON | EVERY | PULSE | RISING, 2)
    go(bench, 3_500)
    assert shown(bench)[:4] == [1, 0, 0, 0]


def test_second_probe_has_the_upper_byte_and_own_inputs():
    bench = probing((ON | RISING | FALLING) << 8)
    bench.drive.stimulate("touch_probe_2", 1, bench.now)
    assert bench.read(0x60B9) == 0x0300
    go(bench, 700)
    bench.drive.stimulate("touch_probe_2", 0, bench.now)
    assert [bench.read(index) for index in (0x60B9, 0x60D7, 0x60D8)] == [0x0700, 1, 1]
    assert bench.read(0x60BC) == 0
    assert bench.read(0x60BD) == bench.read(0x6064)


def test_latched_positions_are_in_host_coordinates():
    bench = probing(ON | RISING)
    bench.set(0x6060, 0, 6, 1)
    bench.set(0x607C, 0, -50_000, 4)
    bench.controlword(0x1F)
    bench.run(50 * MS)
    bench.controlword(0x0F)
    bench.set(0x6060, 0, PP, 1)
    go(bench, 53_000)
    assert shown(bench)[1] == 51_000


@given(st.integers(1, 4_000), st.integers(1, 900), st.sampled_from([700, 30_000, 100_000]))
def test_latched_position_is_the_edge_at_any_speed(low, width, velocity):
    table = {"touch_probe_1_from_rad": low * RAD, "touch_probe_1_to_rad": (low + width) * RAD}
    bench = Bench(switches=table, objects={"6081h": velocity, "6083h": 3_000_000})
    bench.enable(mode=PP)
    bench.set(0x60B8, 0, ON | RISING | FALLING, 2)
    bench.set(0x607A, 0, low + 500, 4)
    bench.controlword(0x1F)
    bench.run_while(lambda: not bench.drive._power_drive.statusword() & 0x0400)
    left = width < 490
    event("through" if left else "into it")
    assert bench.read(0x60BA) == low
    assert bench.read(0x60BB) == (low + width if left else 0) or 490 <= width <= 510
