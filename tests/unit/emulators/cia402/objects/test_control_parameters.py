"""Gains as objects: 60F6h, 60F9h, 60FBh of our EDS; in a vendor's file they are the vendor's."""

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import WHEEL_60W
from tests.support.cia402.bench import MS, Bench, new_drive

GAINS = ServoGains.tuned(WHEEL_60W, MS, 10)
# object, sub-index, value of 1 (as in the EDS), the servo's gain
SETS = [
    (0x60F6, 1, 1e-6, "current_kp_v_a"),
    (0x60F6, 2, 1e-3, "current_ki_v_a_s"),
    (0x60F9, 1, 1e-9, "velocity_kp_a_s_inc"),
    (0x60F9, 2, 1e-9, "velocity_ki_a_inc"),
    (0x60FB, 1, 1e-3, "position_kp_1_s"),
    (0x60FB, 2, 1e-3, "velocity_feedforward"),
    (0x60FB, 3, 1e-12, "acceleration_feedforward_a_s2_inc"),
]


def applied(bench: Bench) -> ServoGains:
    return bench.drive._power_drive._servo._gains


@pytest.mark.parametrize(("index", "subindex", "unit", "name"), SETS)
def test_each_gain_object_shows_and_sets_the_servo_gain(index, subindex, unit, name):
    bench = Bench()
    bench.boot()
    exact = getattr(GAINS, name)
    shown = bench.read(index, subindex, signed=False)
    assert shown == pytest.approx(exact / unit, abs=0.5 + 1e-6)
    assert applied(bench) == GAINS  # exact to the last bit, not rounded
    changed = shown * 3 // 4
    bench.set(index, subindex, changed, 4)
    assert bench.read(index, subindex, signed=False) == changed
    for _, _, _, other in SETS:
        wanted = changed * unit if other == name else getattr(GAINS, other)
        assert getattr(applied(bench), other) == pytest.approx(wanted, rel=1e-12)
    bench.set(index, subindex, shown, 4)
    assert applied(bench) == GAINS


def test_unstable_gain_is_rejected_and_changes_nothing():
    bench = Bench()
    bench.enable()
    before = bench.read(0x60F6, 1, signed=False)
    assert bench.write(0x60F6, 1, 4_000_000_000, 4) == 0x0609_0030  # invalid value (CiA 301)
    assert bench.read(0x60F6, 1, signed=False) == before
    assert applied(bench) == GAINS
    assert bench.write(0x60FB, 2, 2001, 4) == 0x0609_0031  # feed-forward: value too high


@pytest.mark.parametrize("moving", [False, True])
def test_current_loop_without_gains_ends_in_a_following_error(moving):
    bench = Bench()
    bench.enable(mode=1)
    if moving:
        bench.set(0x607A, 0, 60_000, 4)
        bench.controlword(0x5F)
        bench.run(300 * MS)
    bench.set(0x60F6, 1, 0, 4)
    bench.set(0x60F6, 2, 0, 4)
    if not moving:
        bench.set(0x607A, 0, 60_000, 4)
        bench.controlword(0x5F)
    bench.run(1_500 * MS)
    assert bench.statusword() & 0x4F == 0x08  # fault
    assert bench.read(0x603F, signed=False) == 0x8611  # following error (CiA 402-2)


def test_reset_node_restores_the_initial_gains():
    bench = Bench()
    bench.boot()
    bench.set(0x60FB, 1, 20_000, 4)
    bench.nmt(0x81)
    bench.run(400 * MS)
    assert bench.read(0x60FB, 1) == 66_667
    assert applied(bench) == GAINS


def test_softer_position_loop_lags_by_velocity_over_gain():
    """Check that P control without feed-forward has the error v / kp (a type 1 loop)."""
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0})
    bench.enable(mode=1)
    bench.set(0x6081, 0, 40_000, 4)
    bench.set(0x60FB, 2, 0, 4)
    bench.set(0x60FB, 3, 0, 4)
    for kp in (50, 80):
        bench.set(0x60FB, 1, kp * 1000, 4)
        bench.set(0x607A, 0, 60_000, 4)
        bench.controlword(0x5F)
        bench.run(700 * MS)
        assert bench.read(0x606B) == 40_000
        assert bench.read(0x60F4) == pytest.approx(40_000 / kp, abs=3)
        bench.controlword(0x0F)
        bench.run(2_500 * MS)


def test_rig_may_give_gains_as_objects():
    bench = Bench(objects={"60FBh:1": 30_000})
    bench.boot()
    assert applied(bench).position_kp_1_s == pytest.approx(30.0, rel=1e-12)
    with pytest.raises(SettingError, match="unstable"):
        new_drive(objects={"60F6h:1": 4_000_000_000})
    with pytest.raises(SettingError, match="unstable"):
        new_drive(servo={"current_kp_v_a": 1e6})


@pytest.mark.data
def test_vendor_gains_are_stored_without_effect(shared):
    """Check maxon's 60FBh:1, a regulator gain with its own unit: 150 in its file."""
    bench = Bench(folder=shared / "data" / "eds", eds="maxon_epos2_50_5.eds")
    bench.boot()
    assert bench.read(0x60FB, 1) == 150
    bench.set(0x60FB, 1, 200, 2)
    assert bench.read(0x60FB, 1) == 200
    assert applied(bench) == GAINS
