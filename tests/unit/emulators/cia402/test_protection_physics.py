"""Faults with physical causes: I2t, a hot winding, DC link over-voltage and under-voltage.

Expected values are calculated here from the motor's data; codes and bits as in test_protection.
"""

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import MS, Bench
from tests.unit.emulators.cia402.test_protection import emergencies, state, stimulate

S = PdsState
FAST = 200_000  # inc/s: 20 V of back-EMF less 5 V at the resistance feed the link
NO_WINDOW = {"6065h": 0}
WALL = {"stop_high_rad": 0.01}
I2T = {"i2t_continuous_a": 2.0, "i2t_peak_a": 8.0, "i2t_peak_s": 0.5}
HEAT = {
    "thermal_resistance_winding_housing_k_w": 1.7,
    "thermal_resistance_housing_ambient_k_w": 6.0,
    "thermal_time_constant_winding_s": 1.62,
    "thermal_time_constant_motor_s": 20.0,
}
LINK = {"source_resistance_ohm": 0.5, "dc_link_capacitance_f": 5e-4, "dc_link_bleed_ohm": 200.0}


def plant(**extras: float) -> dict[str, object]:
    return {"preset": "wheel_60w", **extras}


def pushing(bench: Bench) -> int:
    """Push against the stop with the full 8 A; return the start time [ns]."""
    bench.enable(mode=1)
    bench.set(0x607A, 0, 50_000, 4)
    bench.controlword(0x1F)
    bench.run_while(lambda: bench.truth("current_a") < 7.99)
    return bench.now


def warned_at(bench: Bench) -> int:
    """Return when statusword bit 7 was first sent [ns]."""
    return next(time for time, can_id, data in bench.sent if can_id == 0x185 and data[0] & 0x80)


def test_i2t_warns_and_faults_after_the_peak_time():
    bench = Bench(plant=plant(**I2T, **WALL), objects=NO_WINDOW)
    began = pushing(bench)
    bench.run_while(lambda: state(bench) == S.OPERATION_ENABLED)
    # from rest to full in 0.5 s at 8 A, evaluated every 20 ms; it began while the current still
    # rose
    assert 450 * MS < bench.now - began <= 520 * MS
    assert 350 * MS < warned_at(bench) - began <= 420 * MS  # 80 % full
    assert emergencies(bench) == ["1023030000000000"]
    bench.run(1000 * MS)
    assert state(bench) == S.FAULT
    assert bench.truth("current_a") == 0.0
    bench.controlword(0x80)
    assert state(bench) == S.SWITCH_ON_DISABLED
    bench.run(20_000 * MS)
    assert not bench.last(0x185)[0] & 0x80
    bench.enable()


def test_hot_winding_warns_faults_and_bars_reset_until_cool():
    bench = Bench(plant=plant(**HEAT, **WALL), objects=NO_WINDOW)
    began = pushing(bench)
    bench.run_while(lambda: state(bench) == S.OPERATION_ENABLED)
    assert began < warned_at(bench) < bench.now
    assert emergencies(bench) == ["1043090000000000"]
    assert bench.drive.axis.winding_temperature_c() >= 125.0
    assert bench.drive.axis.winding_temperature_c() < 127.0
    bench.run(10 * MS)
    bench.controlword(0x80)
    assert state(bench) == S.FAULT
    while bench.drive.axis.winding_temperature_c() >= 125.0:
        bench.run(10 * MS)
        bench.truth("state")
    bench.controlword(0x00)
    bench.controlword(0x80)
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert bench.last(0x185)[0] & 0x80  # the warning remains
    bench.run(60_000 * MS)
    assert not bench.last(0x185)[0] & 0x80  # sent without a request
    assert emergencies(bench)[1:] == ["0000000000000000"]


def test_hard_braking_raises_the_dc_link_to_over_voltage():
    bench = Bench(plant=plant(**LINK, load_inertia_kg_m2=0.5))
    bench.enable(mode=3)
    bench.set(0x60FF, 0, FAST, 4)
    bench.run(2000 * MS)
    assert 23.0 < bench.drive.axis.dc_link_v() <= 24.0
    speed = bench.truth("velocity_rad_s")
    bench.set(0x6084, 0, 10_000_000, 4)
    bench.set(0x60FF, 0, 0, 4)
    bench.run_while(lambda: state(bench) == S.OPERATION_ENABLED)
    assert emergencies(bench) == ["1032050000000000"]
    assert state(bench) == S.FAULT  # no reaction: braking caused it
    assert bench.drive.axis.dc_link_v() > 30.0
    bench.run(2 * MS)
    assert bench.truth("current_a") == 0.0
    assert bench.truth("velocity_rad_s") > 0.2 * speed
    bench.controlword(0x80)
    assert state(bench) == S.FAULT
    bench.run(10_000 * MS)  # the link is emptied
    bench.controlword(0x00)
    bench.controlword(0x80)
    assert state(bench) == S.SWITCH_ON_DISABLED


def test_supply_sag_is_under_voltage_only_under_current():
    bench = Bench(plant=plant(**LINK))
    bench.operational()
    stimulate(bench, "supply_v", 12.0)
    bench.run(1000 * MS)
    assert state(bench) == S.SWITCH_ON_DISABLED  # no torque is wanted
    assert bench.drive.axis.dc_link_v() < 12.1
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(50 * MS)
    assert state(bench) == S.FAULT
    assert emergencies(bench) == ["2032050000000000"]
    bench.controlword(0x80)
    assert state(bench) == S.FAULT
    stimulate(bench, "supply_v", 24.0)
    bench.run(100 * MS)
    bench.controlword(0x00)
    bench.controlword(0x80)
    bench.enable()
    stimulate(bench, "supply_v", 12.0)
    bench.run(1000 * MS)
    assert state(bench) == S.FAULT
    assert emergencies(bench)[1:] == ["0000000000000000", "2032050000000000"]
    assert bench.truth("current_a") == 0.0


def test_thresholds_are_those_of_the_rig():
    bench = Bench(
        plant=plant(**LINK, **HEAT),
        protection={"under_voltage_v": 23.99, "winding_temperature_max_c": 200.0},
    )
    bench.operational()
    stimulate(bench, "supply_v", 23.9)
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(50 * MS)
    assert emergencies(bench) == ["2032050000000000"]


def test_supply_stimulus_needs_a_plant_with_a_dc_link():
    with pytest.raises(ValueError, match="source_resistance_ohm"):
        Bench().drive.stimulate("supply_v", 20.0, 0)
    with pytest.raises(ValueError, match=r"supply_v is 0.001\.\.1e\+06 V, not 0"):
        Bench(plant=plant(**LINK)).drive.stimulate("supply_v", 0, 0)


def test_plant_with_protection_at_rest_has_no_deadline():
    bench = Bench(plant=plant(**LINK, **HEAT, **I2T))
    bench.operational()
    bench.run(120_000 * MS)
    assert bench.drive.next_deadline_ns() is None
