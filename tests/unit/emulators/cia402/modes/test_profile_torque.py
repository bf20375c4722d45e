"""Profile torque: 6071h applies live, with slope 6087h, in 1/1000 of 6076h. CiA 402-2, tq."""

import struct
from fractions import Fraction

import pytest

from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.emulators.plant.presets import WHEEL_60W
from tests.support.cia402.bench import MS, NODE, Bench

TARGET_REACHED = 0x0400
LIMIT_ACTIVE = 0x0800
MODE_BITS = 0x3000
K = WHEEL_60W.torque_constant_n_m_a
RATED_N_M = 0.207  # 6076h is in mN m: 8 A times K, rounded


def current_a(permille: int) -> float:
    return permille * 1e-3 * RATED_N_M / K


def new_bench(**settings) -> Bench:
    return Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}, **settings)


@pytest.fixture
def bench() -> Bench:
    """Return a bench with a flywheel: it needs time to reach the supply's speed limit."""
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.5})
    bench.enable(mode=4)
    bench.run(50 * MS)
    return bench


def test_standard_objects_exist_and_6502h_names_tq():
    bench = new_bench()
    bench.boot()
    assert bench.read(0x6502) >> 3 & 1
    assert bench.read(0x6075) == 8_000  # mA: the limit of the power stage
    assert bench.read(0x6076) == 207  # mN m
    assert bench.read(0x6071) == bench.read(0x6074) == bench.read(0x6077) == 0
    assert bench.read(0x6072) == 1_001  # rounded up: limits nothing by default
    assert bench.read(0x6087) == 100_000
    assert bench.read(0x6088) == 0
    assert bench.write(0x6088, 0, 1, 2) == 0x0609_0030  # sin^2 ramps: not implemented
    assert bench.write(0x6071, 0, 0, 4) == 0x0607_0012  # INTEGER16: length too high


def test_torque_follows_the_slope_and_is_reached(bench):
    bench.set(0x6087, 0, 5_000, 4)  # 500/1000 in 100 ms
    bench.set(0x6071, 0, 500, 2)
    at = bench.now
    assert not bench.statusword() & TARGET_REACHED
    bench.run_until(at + 50 * MS)
    assert bench.read(0x6074) == pytest.approx(250, abs=5 + 1)  # one tick, plus that of the reply
    bench.run_until(at + 95 * MS)
    assert not bench.statusword() & TARGET_REACHED
    bench.run_until(at + 105 * MS)
    assert bench.read(0x6074) == 500
    assert bench.statusword() & (TARGET_REACHED | LIMIT_ACTIVE | MODE_BITS) == TARGET_REACHED
    assert bench.truth("current_a") == pytest.approx(current_a(500), rel=0.05)


def test_torque_read_is_the_actual_torque(bench):
    """Check 6077h in 1/1000 of 6076h, 6078h in 1/1000 of 6075h, against the truth."""
    bench.set(0x6071, 0, 700, 2)
    bench.run(20 * MS)
    current = Fraction(bench.truth("current_a"))
    assert bench.read(0x6077) == round(current * Fraction(K) * 1000 / Fraction(207, 1000))
    assert bench.read(0x6078) == pytest.approx(float(current) * 1000 / 8.0, abs=1)


@pytest.mark.parametrize("rated_mn_m", [100, 207, 1_000])
def test_unit_is_the_present_rated_torque(bench, rated_mn_m):
    bench.set(0x6071, 0, 100, 2)
    bench.run(20 * MS)
    bench.set(0x6076, 0, rated_mn_m, 4)
    bench.run(20 * MS)
    assert bench.drive.axis.current_demand_a() == pytest.approx(0.1e-3 * rated_mn_m / K, rel=1e-12)
    assert bench.read(0x6074) == 100


def test_unloaded_motor_accelerates_by_its_torque():
    bench = new_bench()
    bench.enable(mode=4)
    bench.set(0x6071, 0, 400, 2)
    bench.run(20 * MS)
    before = bench.truth("velocity_rad_s") * WHEEL_60W.gear_ratio
    bench.run(10 * MS)
    gained = bench.truth("velocity_rad_s") * WHEEL_60W.gear_ratio - before
    torque = K * bench.truth("current_a") - WHEEL_60W.coulomb_friction_n_m
    rotor = WHEEL_60W.rotor_inertia_kg_m2
    assert gained / 0.010 == pytest.approx(torque / rotor, rel=0.05)  # a little viscous friction


def test_max_torque_limits_and_bit_11_reports_it(bench):
    bench.set(0x6072, 0, 300, 2)
    bench.set(0x6071, 0, -800, 2)
    bench.run(50 * MS)
    assert bench.read(0x6074) == -300
    assert bench.statusword() & (TARGET_REACHED | LIMIT_ACTIVE) == LIMIT_ACTIVE
    bench.set(0x6072, 0, 900, 2)  # live too
    bench.run(50 * MS)
    assert bench.read(0x6074) == -800
    assert not bench.statusword() & LIMIT_ACTIVE


def test_each_direction_has_its_own_limit(bench):
    """Check 60E0h and 60E1h, each within 6072h."""
    bench.set(0x60E0, 0, 400, 2)
    bench.set(0x60E1, 0, 250, 2)
    for asked, given, limited in ((800, 400, True), (-800, -250, True), (-200, -200, False)):
        bench.set(0x6071, 0, asked, 2)
        bench.run(30 * MS)
        assert bench.read(0x6074) == given
        assert (bench.statusword() & LIMIT_ACTIVE != 0) is limited
    bench.set(0x6072, 0, 100, 2)
    bench.run(30 * MS)
    assert bench.read(0x6074) == -100


def test_negative_limit_may_have_a_sign(tmp_path):
    """Elmo's 60E1h is a negative number of 16 bits."""
    own = OWN_EDS.read_text()
    before = "[60E1]\nParameterName=Negative torque limit value\nObjectType=0x7\nDataType=0x0006"
    assert before in own
    signed = own.replace(before, before[:-1] + "3").replace(
        "AccessType=rw\nDefaultValue=65535\nPDOMapping=1\n\n[60E3]",
        "AccessType=rw\nDefaultValue=-250\nPDOMapping=1\n\n[60E3]",
    )
    (tmp_path / "signed.eds").write_text(signed)
    bench = new_bench(folder=tmp_path, eds="signed.eds")
    bench.enable(mode=4)
    assert bench.read(0x60E1) == -250
    bench.set(0x6071, 0, -800, 2)
    bench.run(30 * MS)
    assert bench.read(0x6074) == -250


def test_max_torque_limits_position_control_too():
    bench = new_bench()
    bench.enable(mode=1)
    bench.set(0x6072, 0, 100, 2)
    bench.set(0x6083, 0, 10_000_000, 4)
    bench.set(0x607A, 0, 100_000, 4)
    bench.controlword(0x1F)
    most = 0.0
    for _ in range(60):
        bench.run(1 * MS)
        most = max(most, abs(bench.drive.axis.current_demand_a()))
    assert most == pytest.approx(current_a(100), rel=1e-12)


def test_max_torque_0_gives_no_torque(bench):
    bench.set(0x6072, 0, 0, 2)
    bench.set(0x6071, 0, 500, 2)
    bench.run(50 * MS)
    assert bench.truth("velocity_rad_s") == 0.0
    assert bench.read(0x6077) == 0


def test_halt_stops_the_motor_and_torque_continues_after(bench):
    bench.set(0x6071, 0, 200, 2)
    bench.run(50 * MS)
    assert bench.truth("velocity_rad_s") > 0.05
    bench.controlword(0x010F)
    bench.run(1 * MS)
    assert not bench.statusword() & TARGET_REACHED
    bench.set(0x6071, 0, 300, 2)  # noted, not obeyed
    bench.run(500 * MS)
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=1e-3)
    assert bench.statusword() & (TARGET_REACHED | LIMIT_ACTIVE) == TARGET_REACHED
    bench.controlword(0x000F)
    bench.run(20 * MS)
    assert bench.read(0x6074) == 300


@pytest.mark.parametrize(("option", "deceleration"), [(1, 0x6084), (2, 0x6085)])
def test_halt_brakes_on_the_ramp_named_by_605dh(bench, option, deceleration):
    bench.set(0x605D, 0, option, 2)
    bench.set(0x6084, 0, 100_000, 4)
    bench.set(0x6085, 0, 200_000, 4)
    bench.set(0x6071, 0, 900, 2)
    bench.run(300 * MS)
    speed = bench.read(0x606C)
    bench.controlword(0x010F)
    ns = round(1e9 * speed / bench.read(deceleration))
    at = bench.now
    bench.run_while(lambda: not bench.statusword() & TARGET_REACHED)
    # The speed at the halt is measured over 4 ms; speed zero (6070h) is detected 10 ms late.
    assert bench.now - at == pytest.approx(ns, abs=ns * 0.1 + 25 * MS)


def test_quick_stop_brakes_the_motor(bench):
    bench.set(0x6071, 0, 200, 2)
    bench.run(50 * MS)
    bench.controlword(0x02)
    bench.run(500 * MS)
    assert bench.truth("state") == 1  # switch on disabled: 605Ah is 2
    assert bench.truth("velocity_rad_s") == 0.0


def test_enabling_applies_the_present_target_torque():
    bench = new_bench()
    bench.operational()
    bench.set(0x6060, 0, 4, 1)
    bench.set(0x6071, 0, 150, 2)
    bench.run(100 * MS)
    assert bench.truth("current_a") == 0
    bench.enable()
    bench.run(20 * MS)
    assert bench.read(0x6074) == 150


def test_mode_can_change_in_motion_and_back(bench):
    bench.set(0x6071, 0, 200, 2)
    bench.run(50 * MS)
    bench.set(0x60FF, 0, 10_000, 4)
    bench.set(0x6060, 0, 3, 1)  # pv: by its ramp to 60FFh
    bench.run(300 * MS)
    assert bench.read(0x6061) == 3
    assert bench.read(0x606C) == pytest.approx(10_000, abs=2_000)
    assert bench.statusword() & TARGET_REACHED
    bench.set(0x6071, 0, -50, 2)
    assert bench.read(0x606B) == 10_000  # 6071h has no effect in pv
    bench.set(0x6060, 0, 4, 1)
    bench.run(20 * MS)
    assert bench.read(0x6074) == -50
    bench.set(0x6060, 0, 1, 1)  # pp: it comes to rest
    bench.run(500 * MS)
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=1e-3)


def test_target_torque_from_an_rpdo_applies_at_sync(bench):
    """Remap RPDO 4 to 6040h, 6071h with transmission type 1, as a group's start needs it."""
    bench.set(0x1403, 1, 0x8000_0500 + NODE, 4)
    bench.set(0x1603, 0, 0, 1)
    bench.set(0x1603, 1, 0x6040_0010, 4)
    bench.set(0x1603, 2, 0x6071_0010, 4)
    bench.set(0x1603, 0, 2, 1)
    bench.set(0x1403, 2, 1, 1)
    bench.set(0x1403, 1, 0x0000_0500 + NODE, 4)
    bench.send(0x500 + NODE, struct.pack("<Hh", 0x0F, -120))
    bench.run(50 * MS)
    assert bench.read(0x6074) == 0
    bench.sync()
    bench.run(20 * MS)
    assert bench.read(0x6074) == -120


def test_observing_does_not_change_target_reached_time():
    """Check that the drive wakes for the flag: TPDO 1 sends the statusword at the exact tick."""
    bench = Bench(
        objects={"1800h:3": 0, "6087h": 50_000},
        plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.5},
    )
    bench.enable(mode=4)
    bench.run(50 * MS)
    bench.set(0x6071, 0, 500, 2)
    at = bench.now
    bench.run(100 * MS)
    told = [
        (time, int.from_bytes(data, "little"))
        for time, can_id, data in bench.sent
        if can_id == 0x180 + NODE and time > at - 2 * MS
    ]
    assert [word & TARGET_REACHED for _, word in told] == [0, TARGET_REACHED]
    # commanded at or before `at` and obeyed from the next tick on: 10 ticks of 50 each, then the
    # current needs one tick to reach its demand.
    assert 9 * MS <= told[1][0] - told[0][0] <= 12 * MS
