"""Profile position: the set-point handshake and the motion. CiA 402-2, profile position mode."""

import struct
from math import sqrt

import pytest

from tests.support.cia402.bench import MS, NODE, Bench

TARGET_REACHED = 0x0400
ACKNOWLEDGE = 0x1000
LIMIT = 0x0800
V, A = 40_960, 409_600  # 6081h and 6083h, 6084h of our file [inc/s, inc/s^2]


def duration_ns(distance: float, velocity: float = V, acceleration: float = A) -> int:
    """Return the duration of a move from rest to rest, in closed form."""
    if distance >= velocity * velocity / acceleration:
        return round(1e9 * (distance / velocity + velocity / acceleration))
    return round(1e9 * 2 * sqrt(distance / acceleration))


def offer(bench: Bench, target: int, extra: int = 0) -> None:
    """Send 607Ah and the edge in one RPDO 3 (6040h, 607Ah)."""
    bench.send(0x400 + NODE, struct.pack("<Hi", 0x1F | extra, target))


def withdraw(bench: Bench, extra: int = 0) -> None:
    bench.controlword(0x0F | extra)


def move(bench: Bench, target: int, extra: int = 0) -> None:
    offer(bench, target, extra)
    bench.run(1 * MS)
    withdraw(bench, extra)


@pytest.fixture
def bench() -> Bench:
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0})
    bench.enable(mode=1)
    bench.run(20 * MS)
    return bench


def test_handshake_matches_the_transcript(bench):
    """Check statuswords: 37h enabled | 200h remote | 400h reached | 1000h acknowledge."""
    assert bench.last(0x185) == bytes.fromhex("3706")
    count = len(bench.sent)
    offered_at = bench.now
    bench.send(0x405, bytes.fromhex("1F0010270000"))  # target 10,000
    assert bench.hex_since(count) == ["185#3712", "285#371201"]
    bench.run(10 * MS)
    bench.send(0x205, bytes.fromhex("0F00"))
    assert bench.hex_since(count + 2) == ["185#3702", "285#370201"]
    bench.run(2000 * MS)
    assert bench.hex_since(count + 4) == ["185#3706", "285#370601"]
    reached_at = bench.times(0x185)[-1]
    assert offered_at + duration_ns(10_000) < reached_at
    assert reached_at < offered_at + duration_ns(10_000) + 50 * MS
    assert bench.read(0x6062) == 10_000
    assert abs(bench.read(0x6064) - 10_000) <= 10


def test_demand_arrives_at_the_closed_form_time(bench):
    at = bench.now
    move(bench, 10_000)
    end = at + duration_ns(10_000)
    bench.run_until(end - 1 * MS)
    assert bench.truth("demand_inc") < 10_000
    bench.run_until(end + 2 * MS)  # the tick after the command, the tick after the end
    assert bench.truth("demand_inc") == 10_000


def test_nothing_moves_without_an_edge(bench):
    bench.set(0x607A, 0, 5000, 4)
    bench.run(500 * MS)
    assert bench.truth("position_inc") == 0
    bench.controlword(0x0F)
    bench.run(500 * MS)
    assert bench.truth("position_inc") == 0


def test_level_is_not_an_edge(bench):
    offer(bench, 1000)
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == 1000
    offer(bench, 3000)  # bit 4 still set
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == 1000
    assert bench.statusword() & ACKNOWLEDGE
    withdraw(bench)
    assert not bench.statusword() & ACKNOWLEDGE
    move(bench, 3000)
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == 3000


def test_target_reached_is_never_stale(bench):
    """Check from the edge on, also for a move of zero length."""
    move(bench, 2000)
    bench.run(1000 * MS)
    assert bench.statusword() & TARGET_REACHED
    count = len(bench.sent)
    offer(bench, 2000)  # the motor is already there
    assert bench.hex_since(count)[0] == "185#3712"
    bench.run(100 * MS)
    assert bench.statusword() & (TARGET_REACHED | ACKNOWLEDGE) == TARGET_REACHED | ACKNOWLEDGE


def test_second_set_point_waits_for_the_first(bench):
    at = bench.now
    move(bench, 10_000)
    move(bench, 4_000)
    assert bench.statusword() & ACKNOWLEDGE  # the only buffer place is occupied
    bench.run_until(at + duration_ns(10_000) + 1 * MS)
    assert bench.truth("demand_inc") == 10_000
    bench.run(3 * MS)
    assert not bench.statusword() & ACKNOWLEDGE
    assert not bench.statusword() & TARGET_REACHED  # until all are processed
    bench.run_until(at + duration_ns(10_000) + duration_ns(6_000) + 3 * MS)
    assert bench.truth("demand_inc") == 4_000
    words = [struct.unpack("<H", data)[0] for _, can_id, data in bench.sent if can_id == 0x185]
    bench.run(100 * MS)
    assert not any(word & TARGET_REACHED for word in words[-3:])
    assert bench.statusword() & TARGET_REACHED


def test_third_set_point_is_not_accepted(bench):
    for target in (10_000, 4_000, 7_000):
        move(bench, target)
    bench.run(3000 * MS)
    assert bench.truth("demand_inc") == 4_000


def test_change_immediately_discards_all_earlier_targets(bench):
    move(bench, 20_000)
    move(bench, 30_000)
    bench.run(200 * MS)
    passed = bench.truth("demand_inc")
    move(bench, 1_000, extra=0x20)
    assert not bench.statusword() & ACKNOWLEDGE
    bench.run(2000 * MS)
    assert 1_000 < passed < 20_000
    assert bench.truth("demand_inc") == 1_000
    assert bench.statusword() & TARGET_REACHED


def test_relative_target_counts_from_the_last_set_point(bench):
    move(bench, 3_000)
    move(bench, 500, extra=0x40)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 3_500
    move(bench, -1_500, extra=0x40)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 2_000


def test_relative_target_after_enabling_counts_from_actual(bench):
    move(bench, 3_000)
    bench.run(1000 * MS)
    bench.controlword(0x06)
    bench.enable()
    move(bench, 100, extra=0x40)
    bench.run(1000 * MS)
    assert abs(bench.truth("demand_inc") - 3_100) <= 10


def test_change_on_set_point_passes_at_speed(bench):
    at = bench.now
    move(bench, 20_000)
    bench.set(0x6081, 0, 20_480, 4)  # the second part at half the speed
    move(bench, 40_000, extra=0x200)
    through = 20_000
    bench.run_while(lambda: bench.truth("demand_inc") < through)
    assert bench.now - at < duration_ns(20_000)  # no deceleration for the first target
    bench.run(200 * MS)
    before = bench.truth("demand_inc")
    bench.run(100 * MS)
    assert bench.truth("demand_inc") - before == pytest.approx(2048, abs=1)  # rounded increments
    bench.run(3000 * MS)
    assert bench.truth("demand_inc") == 40_000
    assert bench.statusword() & TARGET_REACHED


def test_change_on_set_point_stops_where_it_reverses(bench):
    move(bench, 10_000)
    move(bench, 5_000, extra=0x200)
    highest = 0.0
    for _ in range(800):
        bench.run(1 * MS)
        highest = max(highest, bench.truth("demand_inc"))
    assert highest == 10_000
    assert bench.truth("demand_inc") == 5_000


@pytest.mark.parametrize(("word", "state"), [(0x00, 1), (0x02, 1), (0x06, 2), (0x07, 3)])
def test_drive_stopped_before_passing_continues_no_further(bench, word, state):
    move(bench, 10_000)
    move(bench, 20_000, extra=0x200)
    bench.run_while(lambda: bench.truth("demand_inc") < 9_000)
    bench.controlword(word)
    bench.run(10_000 * MS)  # the bench fails for a deadline that does not advance
    assert bench.drive.next_deadline_ns() is None
    assert bench.truth("state") == state
    assert bench.truth("position_inc") < 15_000  # at most coasting
    assert not bench.statusword() & 0x1000


def test_halt_stops_and_motion_continues_afterwards(bench):
    at = bench.now
    move(bench, 20_000)
    bench.run(200 * MS)
    bench.controlword(0x010F)
    bench.run(1 * MS)
    assert not bench.statusword() & TARGET_REACHED
    bench.run(300 * MS)
    stood_at = bench.truth("demand_inc")
    assert 0 < stood_at < 20_000
    assert bench.statusword() & TARGET_REACHED  # under halt: standstill
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == stood_at
    bench.controlword(0x0F)
    assert not bench.statusword() & TARGET_REACHED
    bench.run(2000 * MS)
    assert bench.truth("demand_inc") == 20_000
    assert bench.now > at + duration_ns(20_000)


def test_set_point_taken_under_halt_waits_for_its_end(bench):
    bench.controlword(0x010F)
    offer(bench, 2_000, extra=0x100)
    assert bench.statusword() & ACKNOWLEDGE
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == 0
    bench.controlword(0x0F)
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == 2_000


@pytest.mark.parametrize(("option", "deceleration"), [(1, A), (2, 819_200)])
def test_halt_option_code_selects_the_ramp(bench, option, deceleration):
    bench.set(0x605D, 0, option, 2)
    move(bench, 40_000)
    bench.run(300 * MS)
    bench.controlword(0x010F)
    at = bench.now
    start = bench.truth("demand_inc")
    bench.run_while(lambda: not bench.last(0x185)[1] & 0x04)
    braked = bench.truth("demand_inc") - start  # one tick at speed before braking starts
    assert braked == pytest.approx(V * V / 2 / deceleration + V / 1000, abs=2)
    assert bench.now - at == pytest.approx(1e9 * V / deceleration, abs=20e6)


def test_software_limits_limit_the_target(bench):
    bench.set(0x607D, 1, -1_000, 4)
    bench.set(0x607D, 2, 5_000, 4)
    move(bench, 5_000)
    bench.run(1000 * MS)
    assert not bench.statusword() & LIMIT
    move(bench, 5_001)
    assert bench.statusword() & LIMIT
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 5_000
    assert bench.statusword() & (LIMIT | TARGET_REACHED) == LIMIT | TARGET_REACHED
    move(bench, -2_000)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == -1_000
    move(bench, 0)
    assert not bench.statusword() & LIMIT


def test_limits_of_zero_limit_nothing(bench):
    move(bench, -30_000)
    bench.run(2000 * MS)
    assert bench.truth("demand_inc") == -30_000


@pytest.mark.parametrize(
    ("index", "value", "limit"), [(0x607F, 20_000, 20_000), (0x6080, 300, 300 * 2000 / 60)]
)
def test_max_velocity_limits_the_profile(bench, index, value, limit):
    bench.set(index, 0, value, 4)
    at = bench.now
    move(bench, 10_000)
    bench.run_until(at + duration_ns(10_000, limit) - 2 * MS)
    assert bench.truth("demand_inc") < 10_000
    bench.run(4 * MS)
    assert bench.truth("demand_inc") == 10_000


def test_profile_is_fixed_at_the_edge(bench):
    at = bench.now
    offer(bench, 10_000)
    bench.set(0x6081, 0, 1_000, 4)
    bench.run_until(at + duration_ns(10_000) + 2 * MS)
    assert bench.truth("demand_inc") == 10_000


def test_window_time_delays_target_reached(bench):
    bench.set(0x6068, 0, 300, 2)
    at = bench.now
    move(bench, 5_000)
    bench.run_until(at + duration_ns(5_000) + 290 * MS)
    assert not bench.statusword() & TARGET_REACHED
    bench.run(100 * MS)
    assert bench.statusword() & TARGET_REACHED


def test_mode_change_discards_set_points(bench):
    move(bench, 20_000)
    bench.run(100 * MS)
    bench.set(0x6060, 0, 6, 1)
    bench.run(500 * MS)
    stood_at = bench.truth("demand_inc")
    assert stood_at < 10_000
    bench.set(0x6060, 0, 1, 1)
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == stood_at


def test_units_come_from_the_factor_objects():
    """Check 6092h = 3600 units per output turn: 36 units are a hundredth of a turn."""
    bench = Bench(objects={"6092h:1": 3600, "6092h:2": 1})
    bench.enable(mode=1)
    move(bench, 36)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 1320  # 36 / 3600 * 66 * 2000
    assert bench.read(0x6062) == 36
    assert bench.read(0x6063) == pytest.approx(1320, abs=10)  # the servo's steady-state error


def test_later_factors_apply_to_targets_and_windows(bench):
    bench.set(0x6065, 0, 20, 4)
    bench.set(0x6092, 1, 3600, 4)  # 36.7 increments: the window is now 733
    move(bench, 36)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 1320
    bench.drive.stimulate("load_torque_n_m", 30.0, bench.now)
    while bench.truth("state") == 4:
        error = abs(bench.truth("following_error_inc"))
        bench.run(1 * MS)
    assert error > 733


def test_halt_with_a_slow_ramp_ends_within_software_limits():
    """Check Danfoss VLT servo drive ISD, 607Dh: position control never passes a limit."""
    bench = Bench()
    bench.enable(mode=1)
    for index, value in ((0x6081, 60_000), (0x6083, 600_000), (0x6084, 600_000)):
        bench.set(index, 0, value, 4)
    bench.set(0x607D, 1, -4_000, 4)
    bench.set(0x607D, 2, 4_000, 4)
    bench.set(0x607A, 0, 4_000, 4)
    bench.controlword(0x1F)
    bench.run(80 * MS)
    assert 0 < bench.truth("demand_inc") < 4_000
    bench.set(0x6084, 0, 100_000, 4)
    bench.controlword(0x011F)
    bench.run(500 * MS)
    assert bench.truth("demand_inc") == pytest.approx(4_000, abs=1)
