"""A nonlinear plant behind the axis: readers do not influence it, and rest is exact."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.cia402.drive import build as cia402_drive
from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.firmware import nonlinear_servo as extras_servo
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import (
    I2T_LIMIT,
    I2T_WARNING,
    OUTSIDE_GATE,
    OVER_TEMPERATURE,
    SPEED_ZERO,
    TEMPERATURE_WARNING,
    UNDER_VOLTAGE,
)
from motorhil.emulators.firmware.nonlinear_tables import StepNumbers, extras_tables
from motorhil.emulators.firmware.servo_tables import ServoGains, tables_of
from motorhil.emulators.leadshine_pr.drive import build as leadshine_drive
from motorhil.emulators.oriental_az.drive import build as oriental_drive
from motorhil.emulators.plant.nonlinear import PlantExtras
from motorhil.emulators.plant.presets import WHEEL_60W
from motorhil.emulators.settings.tables import plant_of

MS = 1_000_000
CONTEXT = ControllerContext(name="drive", folder=Path(), seed=1)
HEAT = {
    "thermal_resistance_winding_housing_k_w": 1.7,
    "thermal_resistance_housing_ambient_k_w": 6.0,
    "thermal_time_constant_winding_s": 1.62,
    "thermal_time_constant_motor_s": 20.0,
}
FEATURES = {
    "supply": {"source_resistance_ohm": 0.2, "dc_link_bleed_ohm": 1000.0},
    "heat": {**HEAT, "copper_coefficient_1_k": 0.0039},
    "i2t": {"i2t_continuous_a": 0.1, "i2t_peak_a": 1.0, "i2t_peak_s": 0.5},
    "stops": {"stop_low_rad": -0.2, "stop_high_rad": 0.3, "stop_restitution": 0.4},
    "friction": {"static_friction_n_m": 6e-3, "stribeck_speed_rad_s": 2.0},
    "cogging": {"cogging_torque_n_m": 2e-3, "cogging_periods_rev": 14},
    "gravity": {"gravity_torque_n_m": 1.5, "gravity_zero_rad": -0.1},
    "elastic": {
        "coupling_stiffness_n_m_rad": 500.0,
        "coupling_damping_n_m_s_rad": 2.0,
        "output_coulomb_friction_n_m": 0.02,
    },
    "backlash": {"backlash_rad": 0.01, "output_coulomb_friction_n_m": 0.02},
}
SETS = st.lists(st.sampled_from(sorted(FEATURES)), min_size=1, max_size=4, unique=True)


def plant_with(*names, **more):
    numbers = {key: value for name in names for key, value in FEATURES[name].items()}
    return replace(WHEEL_60W, extras=PlantExtras(**numbers, **more))


def axis_with(plant):
    return Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)


def readings(axis):
    return (
        *(axis.flags, axis.position_inc(), axis.demand_inc(), axis.velocity_inc_s()),
        *(axis.current_a(), axis.output_position_rad(), axis.output_velocity_rad_s()),
        *(axis.dc_link_v(), axis.winding_temperature_c(), axis.housing_temperature_c()),
        axis.i2t_level(),
    )


def thresholds(axis):
    axis.set_thresholds(
        over_voltage_v=24.5,
        under_voltage_v=23.5,
        temperature_warning_c=25.3,
        over_temperature_c=25.6,
        i2t_warning=0.5,
    )


def day(axis, looks):
    """Return readings after each command; readers act in between as `looks` says."""
    seen = []
    commands = (
        (10, lambda: axis.power(True)),
        (50, lambda: thresholds(axis)),
        (60, lambda: axis.move_to(9_000, 90_000.0, 600_000.0, 600_000.0)),
        (260, lambda: axis.set_load(0.8)),
        (400, lambda: axis.run_at(-40_000.0, 300_000.0, 300_000.0)),
        (500, lambda: axis.apply_current(0.9, 50.0)),
        (640, lambda: axis.move_to(0, 40_000.0, 500_000.0, 500_000.0)),
        (900, lambda: axis.power(False)),
        (1_300, lambda: axis.power(True)),
    )
    for k, command in (*commands, (1_600, lambda: None)):
        for look, ask in looks:
            if axis._time.tick < look < k:
                axis.at(look * MS)
                if ask:
                    axis.next_event_ns(None if ask == 1 else (look + ask) * MS)
        axis.at(k * MS)
        seen.append(readings(axis))
        command()
    return seen


@settings(max_examples=20)
@given(
    SETS,
    st.lists(st.tuples(st.integers(1, 1_600), st.sampled_from([0, 1, 7, 90])), max_size=40),
)
def test_nonlinear_plant_is_independent_of_readers(names, looks):
    plant = plant_with(*names)
    alone = day(axis_with(plant), ())
    assert day(axis_with(plant), sorted(looks)) == alone
    event(f"{len(names)} features")


def run_to_rest(axis, limit_ms):
    wakes = 0
    wake = axis.next_event_ns()
    while wake is not None:
        assert wake <= limit_ms * MS
        axis.at(wake)
        wakes += 1
        wake = axis.next_event_ns()
    return wakes


@settings(max_examples=12)
@given(SETS, st.integers(-15_000, 15_000), st.booleans())
def test_nonlinear_plant_comes_to_exact_rest(names, target, has_power):
    axis = axis_with(plant_with(*names))
    axis.power(True)
    axis.at(50 * MS)
    axis.move_to(target, 60_000.0, 400_000.0, 400_000.0)
    axis.at(900 * MS)
    if not has_power or {"stops", "friction"} & set(
        names
    ):  # stops before the target, or hunts around it
        axis.power(False)
        has_power = False
    run_to_rest(axis, 100_000_000)
    axis.at((axis._time.tick + 10**9) * MS)
    seen = readings(axis)
    assert axis.output_velocity_rad_s() == axis.velocity_inc_s() == 0.0
    assert axis.flags & SPEED_ZERO
    axis.at((axis._time.tick + 10**9) * MS)
    assert axis.rest() >= 0
    assert readings(axis) == seen
    event("held" if has_power else "without power")


def test_nonlinear_rest_maps_onto_itself():
    axis = axis_with(plant_with(*FEATURES))
    axis.power(True)
    axis.at(50 * MS)
    axis.move_to(3_000, 60_000.0, 400_000.0, 400_000.0)
    axis.at(2_000 * MS)
    axis.power(False)
    run_to_rest(axis, 100_000_000)
    axis.at(10**9 * MS)
    time = axis._time
    state = time.state
    for tick in range(time.tick, time.tick + 100):
        state, made, _ = time._run(tick, state, 1, False)
        assert made == 1
        assert repr(state[:19]) == repr(time.state[:19])
        assert repr(state[19][:6]) == repr(time.state[19][:6])


def test_losses_between_thermal_updates_are_kept():
    """Compare with single ticks, in which rest is never found, to the last bit."""
    heat = {**HEAT, "thermal_time_constant_winding_s": 0.2, "thermal_time_constant_motor_s": 0.3}
    axis = axis_with(replace(WHEEL_60W, extras=PlantExtras(**heat, stop_high_rad=0.0)))
    axis.power(True)
    axis.at(10 * MS)
    axis.apply_current(3.0, 1e3)
    axis.at(20 * MS)
    time = axis._time
    state, tick = time.state, time.tick
    while tick < 40_013:
        state, _, _ = time._run(tick, state, 1, False)
        tick += 1
    axis.at(40_013 * MS)
    assert axis.rest() >= 0
    axis.apply_current(1.0, 1e3)
    seen = []
    for k in range(40_014, 40_060):
        axis.at(k * MS)
        seen.append((axis.winding_temperature_c(), axis.housing_temperature_c()))
    again = []
    for k in range(40_013, 40_059):
        state, _, _ = time._run(k, state, 1, False)
        again.append((state[19][3], state[19][4]))
    assert again == seen


def test_cooling_motor_at_rest_needs_few_wakeups():
    """For an hour: one wake-up every ten seconds, until the temperature is steady."""
    axis = axis_with(plant_with("heat"))
    axis.power(True)
    axis.at(10 * MS)
    axis.set_load(4.8)  # held by 2.8 A
    axis.at(2_000 * MS)
    axis.set_load(0.0)
    axis.power(False)
    axis.at(2_100 * MS)
    assert axis.winding_temperature_c() > 27.0
    wakes = 0
    wake = axis.next_event_ns()
    while wake is not None:
        axis.at(wake)
        wakes += 1
        wake = axis.next_event_ns()
    axis.at(3_600_000 * MS)
    assert wakes < 50
    assert 25.0 <= axis.winding_temperature_c() < 25.1


@pytest.mark.pure("what compiled cores call cannot be counted")
@pytest.mark.parametrize("is_on", [False, True])
def test_cooling_motor_under_commands_is_not_run_ahead(is_on, monkeypatch):
    """With a command every 5 ms, the cooling hour ahead is not computed."""
    axis = axis_with(plant_with("heat"))
    axis.power(True)
    axis.at(10 * MS)
    axis.set_load(4.8)
    axis.at(1_000 * MS)
    axis.set_load(0.0)
    axis.at(1_500 * MS)
    axis.power(is_on)
    axis.at(2_000 * MS)
    made = 0
    reckon = extras_servo.reckon

    def counted(*arguments):
        nonlocal made
        made += 1
        return reckon(*arguments)

    monkeypatch.setattr(extras_servo, "reckon", counted)
    for k in range(400, 440):
        axis.at(5 * k * MS)
        axis.set_load(0.1 if k % 2 else 0.0)
        wake = axis.next_event_ns()
        while wake is not None and wake < 5 * (k + 1) * MS:
            axis.at(wake)
            wake = axis.next_event_ns()
    assert axis.winding_temperature_c() > 25.5
    assert 10 <= made < 200 / 20 * 10


@pytest.mark.parametrize("looks", [False, True])
def test_thresholds_wake_drive_at_their_tick(looks):
    """Every flag comes at a requested wake-up, and at the same tick with and without readers."""
    axis = axis_with(plant_with("heat", "i2t", "supply"))
    axis.power(True)
    axis.at(50 * MS)
    thresholds(axis)
    axis.apply_current(4.0, 1e3)
    came = {}
    while axis._time.tick < 2_000:
        wake = axis.next_event_ns()
        if looks:
            for ns in range(axis._time.tick * MS, wake, 3 * MS):
                axis.at(ns)
        before = axis.flags
        axis.at(wake)
        for flag in (
            UNDER_VOLTAGE,
            TEMPERATURE_WARNING,
            OVER_TEMPERATURE,
            I2T_WARNING,
            I2T_LIMIT,
        ):
            if axis.flags & ~before & flag:
                came.setdefault(flag, axis._time.tick)
    # 0.495 A^2 s of capacity, filled by 16 A^2 since 55 ms: half in 15 ms, updated every 20 ms
    assert came[I2T_WARNING] == 80
    assert came[I2T_LIMIT] == 100
    assert came[TEMPERATURE_WARNING] % 20 == came[OVER_TEMPERATURE] % 20 == 0
    assert came[TEMPERATURE_WARNING] < came[OVER_TEMPERATURE]
    assert came[UNDER_VOLTAGE] == 126


def test_backlash_alone_makes_two_bodies():
    plant = plant_with("backlash")
    assert plant.extras.has_two_bodies()
    axis = axis_with(plant)
    axis.at(10 * MS)
    assert axis.output_position_rad() == 0.0


def test_static_friction_halves_at_stribeck_speed():
    extras = FEATURES["friction"]
    plant = plant_with("friction")
    numbers = StepNumbers(plant, 1e-4, 1e-4, plant.resistance_ohm)
    more = extras["static_friction_n_m"] - plant.coulomb_friction_n_m
    speed = extras["stribeck_speed_rad_s"]
    assert numbers.more / (1.0 + speed * speed * numbers.stribeck) == pytest.approx(more / 2)


def test_heat_and_i2t_use_true_time():
    """A clock that is 25 % fast makes its ticks shorter, and less happens in one."""
    plant = plant_with("i2t")
    gains = ServoGains.tuned(plant, MS, 10)
    rises = []
    for clock_rate in (1.0, 1.25):
        tables = tables_of(plant, gains, MS, 10, clock_rate)
        found = extras_tables(plant, gains, tables.tick, MS, 10, clock_rate)
        assert found is not None
        rises.append(found.i2t_rise)
    assert rises[0] == pytest.approx(rises[1] * 1.25)


def test_linear_plant_reports_constants():
    axis = axis_with(WHEEL_60W)
    axis.power(True)
    axis.at(100 * MS)
    assert axis.dc_link_v() == WHEEL_60W.supply_v
    assert axis.winding_temperature_c() == axis.housing_temperature_c() == 25.0
    assert axis.i2t_level() == 0.0
    with pytest.raises(ValueError, match="supply_v = 20"):
        axis.set_supply(20.0)


def test_output_gate_is_behind_backlash():
    """A switch at the output closes at the load's position, at the tick at which it gets there."""
    axis = axis_with(plant_with("backlash"))
    axis.power(True)
    axis.at(50 * MS)
    axis.set_gate(-1e300, 1e300, -1e300, 500.0)
    axis.move_to(2_000, 20_000.0, 200_000.0, 200_000.0)
    while not axis.flags & OUTSIDE_GATE:
        behind = axis.output_count()
        axis.at(axis.next_event_ns())
        if not axis.flags & OUTSIDE_GATE:
            assert axis.output_count() < 500
    assert behind < 500 <= axis.output_count()
    half_inc = 0.005 * WHEEL_60W.gear_ratio * WHEEL_60W.increments_per_rad()
    ahead = axis.position_inc() - axis.output_count()
    assert half_inc - 10 < ahead < half_inc + 2  # the flanks touch, or nearly
    assert axis.count_when_output_was(500) - 500 == pytest.approx(ahead, abs=1)


@pytest.mark.parametrize("kind", ["cia402", "leadshine_pr", "oriental_az"])
def test_every_drive_accepts_nonlinear_plant(kind):
    table = {"preset": "mast_20w", "backlash_rad": 0.01, "stop_high_rad": 1.0}
    if kind == "cia402":
        drive = cia402_drive({"node_id": 1, "plant": table}, CONTEXT)
    elif kind == "leadshine_pr":
        drive = leadshine_drive({"unit": 1, "plant": table}, CONTEXT)
    else:
        drive = oriental_drive({"unit": 1, "plant": table}, CONTEXT)
    drive.start(0)
    drive.stimulate("load_torque_n_m", -50.0, 0)  # more than friction holds: to the upper end stop
    assert drive.snapshot(3_000 * MS)["position_rad"] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("table", "key", "told"),
    [
        (
            {"backlash_rad": -1},
            "backlash_rad",
            "plant.backlash_rad: -1 rad is out of range; allowed: 0 to 6.2832 rad",
        ),
        ({"backlash": 0.1}, "backlash", "did you mean backlash_rad?"),
        (
            {"cogging_periods_rev": 1.5},
            "cogging_periods_rev",
            "plant.cogging_periods_rev: must be an integer, but is a float (1.5)",
        ),
        ({"stop_low_rad": 2.0, "stop_high_rad": 1.0}, "stop_low_rad", "not below stop_high_rad"),
        (
            {"thermal_time_constant_winding_s": 2.0},
            "thermal_resistance_winding_housing_k_w",
            "other three",
        ),
        ({"copper_coefficient_1_k": 0.0039}, "copper_coefficient_1_k", "needs a thermal model"),
        ({"i2t_peak_a": 2.0, "i2t_continuous_a": 3.0}, "i2t_peak_a", "not above i2t_continuous_a"),
    ],
)
def test_invalid_plant_value_is_refused_with_key(table, key, told):
    with pytest.raises(SettingError) as caught:
        plant_of({"preset": "wheel_60w", **table})
    assert caught.value.path == ("plant", key)
    assert told in str(caught.value)


def test_initial_position_beyond_end_stop_is_refused():
    settings = {"node_id": 1, "plant": {"preset": "mast_20w", "stop_high_rad": 1.0}}
    with pytest.raises(SettingError, match="beyond the plant's end"):
        cia402_drive({**settings, "initial_position_rad": 1.5}, CONTEXT)
