"""The emulated motor: heat, I2t, DC link, end stops, gravity, friction, cogging, late wakes.

Other clauses compare with its true values. Here these are compared with physics: the plant that the
rig states, integrated once more, or in closed form.
"""

import struct
from collections.abc import Iterator
from itertools import pairwise
from math import asin, cos, hypot, log, pi, sin
from types import SimpleNamespace
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.homing import scale
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode, State

_STEP_S: Final = 0.001
_TRUE_SAMPLES: Final = 50
_HEAT: Final = (
    "thermal_resistance_winding_housing_k_w",
    "thermal_resistance_housing_ambient_k_w",
    "thermal_time_constant_winding_s",
    "thermal_time_constant_motor_s",
)
_I2T: Final = ("i2t_continuous_a", "i2t_peak_a", "i2t_peak_s")
_MODEL: Final = "The rig's plant; "
_COPPER_C: Final = 25.0
_HARD: Final = 0.6  # of the largest current
_LOAD_N_M: Final = 1.0
_FIRST: Final = 300  # steps after which an empty I2t stays empty
_RPM_MAX: Final = 1_000_000
_PUSH: Final = 1.2  # of the load at which the motor breaks away


def _plant(bench: DriveBench, *keys: str) -> SimpleNamespace:
    """Return the numbers of the plant.

    Raises:
        NotApplicable: the rig does not state these keys, or the drive is real.
    """
    bench.require_stated("plant", *keys)
    return SimpleNamespace(**bench.plant())


def _load_of(plant: SimpleNamespace, current_a: float) -> float:
    """Return the load that needs this current [N·m at the output]."""
    return current_a * float(plant.torque_constant_n_m_a * plant.gear_ratio)


def _friction(plant: SimpleNamespace) -> float:
    """Return all Coulomb friction [N·m at the output]."""
    motor = plant.coulomb_friction_n_m * abs(plant.gear_ratio)
    return float(motor + plant.output_coulomb_friction_n_m)


def _inertia(plant: SimpleNamespace) -> float:
    """Return the inertia of motor and load [kg·m² at the output]."""
    return float(plant.rotor_inertia_kg_m2 * plant.gear_ratio**2 + plant.load_inertia_kg_m2)


def _hold(bench: DriveBench) -> Drive:
    """Enable the drive where it stands."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.pace()
    drive.enable(Mode.PP)
    return drive


def _near(drive: Drive, seen: float, wanted: float, tolerance: float, what: str, unit: str) -> None:
    expected = f"{wanted:.4g} {unit} +- {tolerance:.2g}"
    drive.expect(abs(seen - wanted) <= tolerance, what, expected, f"{seen:.4g} {unit}")


# --- heat and I2t


class _Winding:
    """Winding and housing of a data sheet, by small steps of their differential equations."""

    def __init__(self, plant: SimpleNamespace) -> None:
        self._inner = plant.thermal_resistance_winding_housing_k_w
        self._outer = plant.thermal_resistance_housing_ambient_k_w
        self._winding_j_k = plant.thermal_time_constant_winding_s / self._inner
        self._housing_j_k = plant.thermal_time_constant_motor_s / self._outer
        self._ohm, self._copper = plant.resistance_ohm, plant.copper_coefficient_1_k
        self._ambient = plant.ambient_c
        self.winding_c = self.housing_c = plant.ambient_c

    def step(self, current_a: float, time_s: float) -> None:
        """Let a current flow for a short time."""
        ohm = self._ohm * (1.0 + self._copper * (self.winding_c - _COPPER_C))
        inwards = (self.winding_c - self.housing_c) / self._inner
        outwards = (self.housing_c - self._ambient) / self._outer
        self.winding_c += (ohm * current_a**2 - inwards) / self._winding_j_k * time_s
        self.housing_c += (inwards - outwards) / self._housing_j_k * time_s


def _currents(bench: DriveBench, limit_s: float) -> Iterator[float]:
    """Yield the mean true current of each step of time, for so long at most [A]."""
    for _ in range(round(limit_s / _STEP_S)):
        before_a = bench.truth("current_a")
        bench.drive.quiet(_STEP_S)
        yield 0.5 * (before_a + bench.truth("current_a"))


@drive_clause("PLANT-01", Level.L5, source=f"{_MODEL}CiA 402-1: 4310h; 6041h bit 7")
def winding_gets_warm(bench: DriveBench) -> None:
    """The winding gets warm as its data sheet says; the drive warns, has fault 4310h, and cools."""
    plant = _plant(bench, *_HEAT)
    limits = bench.stated.get("protection", {})
    warning_c = limits.get("winding_temperature_warning_c", 110.0)
    max_c = limits.get("winding_temperature_max_c", 125.0)
    drive, model = bench.drive, _Winding(plant)
    start_c = bench.truth("winding_temperature_c")
    _near(drive, start_c, plant.ambient_c, 0.01, "winding at power-on", "C")
    _hold(bench)
    bench.stimulate("load_torque_n_m", _load_of(plant, _HARD * plant.current_max_a))
    begin_ns = drive.now_ns
    seen: list[tuple[float, int]] = []
    for current_a in _currents(bench, 20.0):
        model.step(current_a, _STEP_S)
        true_c = bench.truth("winding_temperature_c")
        tolerance = 1.2 + 0.04 * abs(model.winding_c - plant.ambient_c)
        _near(drive, true_c, model.winding_c, tolerance, "winding with current", "C")
        if not len(seen) % 20:
            word = drive.statusword()
            after_c = bench.truth("winding_temperature_c")
            if true_c >= warning_c or after_c < warning_c:
                is_right = bool(word & od.WARNING) is (true_c >= warning_c)
                expected = f"6041h bit 7 = {int(true_c >= warning_c)} (warning at {warning_c:g} C)"
                drive.expect(is_right, f"winding at {true_c:.1f} C", expected, f"{word:04X}h")
        seen.append((true_c, drive.now_ns))
        if drive.emergencies(begin_ns):
            break
    drive.await_emergency(0x4310, begin_ns, f"winding at {seen[-1][0]:.1f} C", 0.1)
    hot_c = seen[-1][0]
    _near(drive, hot_c, max_c, 3.0, "winding at fault 4310h", "C")
    drive.await_state(State.FAULT, "winding too hot", "transition 14")
    bench.stimulate("load_torque_n_m", 0.0)
    drive.command(0)
    drive.command(od.FAULT_RESET)
    state = drive.state()
    drive.expect(state is State.FAULT, "fault reset while hot", "fault", f"{state}")
    before_c = bench.truth("winding_temperature_c")
    drive.quiet(20.0 * plant.thermal_time_constant_winding_s)
    cool_c = bench.truth("winding_temperature_c")
    is_cooling = plant.ambient_c < cool_c < min(before_c, max_c)
    drive.expect(is_cooling, "winding without current", "it cools", f"{cool_c:.1f} C")
    drive.command(0)
    drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")


class _I2t:
    """The integral of the square of the current above the continuous one, from empty to full."""

    def __init__(self, plant: SimpleNamespace) -> None:
        self._square = plant.i2t_continuous_a**2
        self._room = (plant.i2t_peak_a**2 - self._square) * plant.i2t_peak_s
        self.level = 0.0

    def step(self, current_a: float, time_s: float) -> None:
        """Let a current flow for a short time."""
        level = self.level + (current_a**2 - self._square) / self._room * time_s
        self.level = min(1.0, max(0.0, level))


def _follow_i2t(bench: DriveBench, model: _I2t, warning: float, begin_ns: int) -> float:
    """Compare level and warning with the model until a fault, for 3 s at most; return it."""
    drive, level = bench.drive, 0.0
    for number, current_a in enumerate(_currents(bench, 3.0), 1):
        model.step(current_a, _STEP_S)
        level = bench.truth("i2t_level")
        _near(drive, level, model.level, 0.05 + 0.05 * model.level, "I2t", "")
        if not number % 20 and abs(level - warning) > 0.05:
            word = drive.statusword()
            expected = f"6041h bit 7 = {int(level > warning)} (warning at {warning:g})"
            is_right = bool(word & od.WARNING) is (level > warning)
            drive.expect(is_right, f"I2t at {level:.2f}", expected, f"{word:04X}h")
        if drive.emergencies(begin_ns) or (number > _FIRST and not level):
            break
    return level


@drive_clause("PLANT-02", Level.L5, source=f"{_MODEL}CiA 402-1: 2310h; 6041h bit 7")
def current_is_integrated(bench: DriveBench) -> None:
    """I2t grows with the square of the current above the continuous one; full, it is a fault."""
    plant = _plant(bench, *_I2T)
    warning = bench.stated.get("protection", {}).get("i2t_warning", 0.8)
    drive, model = _hold(bench), _I2t(plant)
    bench.stimulate("load_torque_n_m", _load_of(plant, 0.5 * plant.i2t_continuous_a))
    drive.quiet(0.3)
    _near(drive, bench.truth("i2t_level"), 0.0, 0.02, "I2t at half the continuous current", "")
    middle_a = 0.5 * (plant.i2t_continuous_a + plant.i2t_peak_a)
    for _ in range(2):
        begin_ns = drive.now_ns
        bench.stimulate("load_torque_n_m", _load_of(plant, middle_a))
        level = _follow_i2t(bench, model, warning, begin_ns)
        drive.await_emergency(0x2310, begin_ns, f"I2t at {level:.2f}", 0.1)
        _near(drive, level, 1.0, 0.05, "I2t at fault 2310h", "")
        bench.stimulate("load_torque_n_m", 0.0)
        begin_ns = drive.now_ns
        _follow_i2t(bench, model, warning, begin_ns)
        drive.await_state(State.FAULT, "I2t was full", "transition 14")
        drive.enable(Mode.PP)


# --- supply


@drive_clause("PLANT-03", Level.L5, source=f"{_MODEL}CiA 402-1: 3210h, 3220h; 6079h [mV]")
def supply_has_a_resistance(bench: DriveBench) -> None:
    """Power lowers the voltage of the DC link and braking raises it, up to chopper or 3210h."""
    plant = _plant(bench, "source_resistance_ohm")
    limits = bench.stated.get("protection", {})
    drive = bench.drive
    drive.require_mode(Mode.PV)
    pace = drive.pace()
    bleed = plant.dc_link_bleed_ohm

    def loaded_v(power_w: float) -> float:
        """Return the voltage of the DC link while the motor takes this power."""
        link_v = float(plant.supply_v)
        for _ in range(50):
            leak_a = link_v / bleed if bleed else 0.0
            drop_v = plant.source_resistance_ohm * (power_w / link_v + leak_a)
            link_v = float(plant.supply_v - drop_v)
        return link_v

    def expect_v(wanted_v: float, tolerance_v: float, what: str) -> None:
        link_v = bench.truth("dc_link_v")
        _near(drive, link_v, wanted_v, tolerance_v, f"DC link, {what}", "V")
        shown = drive.find(od.DC_LINK)
        if shown is not None:
            _near(drive, shown / 1e3, link_v, 0.05 * wanted_v, f"6079h, {what}", "V")

    expect_v(loaded_v(0.0), 0.02, "at rest")
    drive.cruise(pace)
    bench.stimulate("load_torque_n_m", _load_of(plant, 0.4 * plant.current_max_a))
    drive.quiet(1.0)
    current_a, speed = bench.truth("current_a"), bench.truth("velocity_rad_s")
    back_v = plant.torque_constant_n_m_a * speed * plant.gear_ratio
    power_w = current_a * (plant.resistance_ohm * current_a + back_v)
    drive.expect(power_w > 1.0, "cruising against a load", "power > 1 W", f"{power_w:.2f} W")
    wanted_v = loaded_v(power_w)
    expect_v(wanted_v, 0.02 + 0.2 * abs(plant.supply_v - wanted_v), f"motor takes {power_w:.1f} W")
    begin_ns = drive.now_ns
    bench.stimulate("load_torque_n_m", -_load_of(plant, 0.3 * back_v / plant.resistance_ohm))
    _overhauled(bench, plant, limits, begin_ns)


def _overhauled(
    bench: DriveBench, plant: SimpleNamespace, limits: dict[str, float], begin_ns: int
) -> None:
    """Expect the chopper to hold the voltage of a motor that is driven, or fault 3210h."""
    drive = bench.drive
    over_v = limits.get("over_voltage_v", 1.25 * plant.supply_v)
    under_v = limits.get("under_voltage_v", 0.7 * plant.supply_v)
    most_v = 0.0
    for _ in range(1000):
        drive.quiet(_STEP_S)
        most_v = max(most_v, bench.truth("dc_link_v"))
        if drive.emergencies(begin_ns):
            break
    what = "a load drives the motor"
    if plant.chopper_resistance_ohm:
        threshold_v = plant.chopper_threshold_v
        _near(drive, most_v, threshold_v, 0.02 * threshold_v, f"DC link, {what}", "V")
        drive.expect(not drive.emergencies(begin_ns), what, "no fault: it has a chopper", "EMCY")
    else:
        drive.await_emergency(0x3210, begin_ns, what, 0.1)
        _near(drive, most_v, over_v, 0.03 * over_v, "DC link at fault 3210h", "V")
        drive.await_state(State.FAULT, what, "transition 14")
    bench.stimulate("load_torque_n_m", 0.0)
    drive.quiet(1.0)
    drive.enable(Mode.PV)
    for volts, is_fault in ((1.1 * under_v, False), (0.9 * under_v, True)):
        begin_ns = drive.now_ns
        bench.stimulate("supply_v", volts)
        drive.quiet(10.0)
        what = f"a supply of {volts:.1f} V, 3220h below {under_v:g} V"
        if is_fault:
            drive.await_emergency(0x3220, begin_ns, what, 0.1)
        else:
            drive.expect(not drive.emergencies(begin_ns), what, "no fault", "EMCY")
    bench.stimulate("supply_v", plant.supply_v)


# --- mechanics


def _free_track(bench: DriveBench, load_n_m: float, time_s: float) -> list[tuple[float, float]]:
    """Load the motor without current; return its true positions [rad] and speeds [rad/s]."""
    bench.stimulate("load_torque_n_m", load_n_m)
    track = []
    for _ in range(round(time_s / _STEP_S)):
        bench.drive.quiet(_STEP_S)
        track.append((bench.truth("position_rad"), bench.truth("velocity_rad_s")))
    return track


@drive_clause("PLANT-04", Level.L2, source=f"{_MODEL}stop_low_rad, stop_high_rad, stop_restitution")
def way_has_ends(bench: DriveBench) -> None:
    """A load stops at the ends of its way, rebounds with its share of speed, and rests there."""
    plant = _plant(bench, "stop_low_rad", "stop_high_rad")
    bench.add_end_stops()
    drive = bench.drive
    load_n_m = _friction(plant) + _LOAD_N_M
    share = plant.stop_restitution
    for sign, end_rad in ((1.0, plant.stop_high_rad), (-1.0, plant.stop_low_rad)):
        track = _free_track(bench, -sign * load_n_m, 3.0)
        farthest = max(sign * place for place, _ in track)
        what = f"pushed to the end at {end_rad:g} rad"
        _near(drive, sign * farthest, end_rad, 1e-4, what, "rad")
        _near(drive, track[-1][0], end_rad, 1e-3, f"{what}, at last", "rad")
        fastest = max(sign * speed for _, speed in track)
        back = max(-sign * speed for _, speed in track)
        expected = f"{share:g} +- 0.1 of {fastest:.2f} rad/s"
        is_right = fastest > 0.1 and abs(back - share * fastest) <= 0.1 * fastest
        drive.expect(is_right, f"{what}: rebound", expected, f"{back:.2f} rad/s")
        speed = track[-1][1]
        _near(drive, speed, 0.0, 0.02, f"{what}, speed at last", "rad/s")
    bench.stimulate("load_torque_n_m", 0.0)


@drive_clause("PLANT-05", Level.L2, source=f"{_MODEL}gravity_torque_n_m, gravity_zero_rad")
def pendulum_hangs(bench: DriveBench) -> None:
    """A pendulum falls to where it hangs, up to friction; elsewhere the motor holds it."""
    plant = _plant(bench, "gravity_torque_n_m", "gravity_zero_rad")
    drive, zero_rad, most = bench.drive, plant.gravity_zero_rad, plant.gravity_torque_n_m
    friction = _friction(plant)
    play_rad = asin(min(1.0, friction / most)) + 0.05
    _free_track(bench, 0.0, 6.0)
    _near(drive, bench.truth("position_rad"), zero_rad, play_rad, "released", "rad")
    _hold(bench)
    for load_n_m in (0.4 * most, -0.4 * most):
        drive.command(od.DISABLE_VOLTAGE)
        _free_track(bench, load_n_m, 6.0)
        angle_rad = -asin(load_n_m / most)
        what = f"pendulum of {most:g} N·m, loaded with {load_n_m:g} N·m"
        place = bench.truth("position_rad") - zero_rad
        _near(drive, place, angle_rad, play_rad + 0.05, what, "rad")
        drive.enable(Mode.PP)
        bench.stimulate("load_torque_n_m", 0.0)
        drive.quiet(0.5)
        place = bench.truth("position_rad") - zero_rad
        torque = bench.truth("torque_n_m")
        wanted = most * sin(place)
        _near(drive, torque, wanted, friction + 0.03 * most, f"held {place:.2f} rad beside", "N·m")
    bench.stimulate("load_torque_n_m", 0.0)


@drive_clause("PLANT-06", Level.L2, source=f"{_MODEL}static_friction_n_m, stribeck_speed_rad_s")
def friction_is_larger_at_rest(bench: DriveBench) -> None:
    """A motor at rest breaks away at its static friction, and then has its Coulomb friction."""
    plant = _plant(bench, "static_friction_n_m", "stribeck_speed_rad_s")
    drive, ratio = bench.drive, abs(plant.gear_ratio)
    static_n_m = plant.static_friction_n_m * ratio
    step = static_n_m / 100.0
    for sign in (1.0, -1.0):
        load_n_m, place = 0.5 * static_n_m, bench.truth("position_rad")
        while load_n_m < 2.0 * static_n_m and bench.truth("position_rad") == place:
            load_n_m += step
            bench.stimulate("load_torque_n_m", -sign * load_n_m)
            drive.quiet(0.002)
        what = f"breaking away, {sign:+g}"
        _near(drive, load_n_m, static_n_m, 2.5 * step, what, "N·m")
        load_n_m *= _PUSH
        track = _free_track(bench, -sign * load_n_m, 0.3)
        speed = [one for _, one in track]
        rate = sign * (speed[-1] - speed[-101]) / (100.0 * _STEP_S)
        middle = sign * 0.5 * (speed[-1] + speed[-101])
        viscous = plant.viscous_friction_n_m_s_rad * ratio**2 * middle
        wanted = (load_n_m - _friction(plant) - viscous) / _inertia(plant)
        fast = middle * ratio / plant.stribeck_speed_rad_s
        drive.expect(fast > 3.0, what, "3 times the Stribeck speed after 0.2 s", f"{fast:.1f}")
        _near(drive, rate, wanted, 0.2 * wanted, f"{what}: acceleration", "rad/s²")
        bench.stimulate("load_torque_n_m", 0.0)
        drive.quiet(3.0)
        _near(drive, bench.truth("velocity_rad_s"), 0.0, 0.0, f"{what}, then free", "rad/s")


@drive_clause("PLANT-07", Level.L2, source=f"{_MODEL}cogging_torque_n_m, cogging_periods_rev")
def motor_cogs(bench: DriveBench) -> None:
    """At slow speed the torque has the stated waves over a turn of the motor, and their size."""
    plant = _plant(bench, "cogging_torque_n_m", "cogging_periods_rev")
    drive = bench.drive
    drive.require_mode(Mode.PV)
    pace = drive.pace()
    drive.enable(Mode.PV)
    drive.write(od.TARGET_VELOCITY, max(1, pace.velocity // 10))
    drive.quiet(1.0)
    turn_rad = 2.0 * pi / abs(plant.gear_ratio)
    start = bench.truth("position_rad")
    track: list[tuple[float, float]] = []
    while len(track) < 20_000 and bench.truth("position_rad") - start < 2.0 * turn_rad:
        drive.quiet(_STEP_S)
        angle = (bench.truth("position_rad") - start) / turn_rad * 2.0 * pi
        track.append((angle, bench.truth("torque_n_m")))

    def part(periods: int) -> float:
        """Return the amplitude of so many waves in a turn [N·m at the output]."""
        sums = [0.0, 0.0]
        for (angle, torque), (after, _) in pairwise(track):
            width = after - angle
            sums[0] += torque * cos(periods * angle) * width
            sums[1] += torque * sin(periods * angle) * width
        return hypot(*sums) * 2.0 / (track[-1][0] - track[0][0])

    wanted = plant.cogging_torque_n_m * abs(plant.gear_ratio)
    periods = plant.cogging_periods_rev
    _near(drive, part(periods), wanted, 0.3 * wanted, f"{periods} waves in a turn", "N·m")
    for other in (periods - 1, periods + 1, 2 * periods):
        most = part(other)
        expected = f"below {0.3 * wanted:.3g} N·m"
        drive.expect(most < 0.3 * wanted, f"{other} waves in a turn", expected, f"{most:.3g} N·m")


@drive_clause("PLANT-08", Level.L2, source=f"{_MODEL}friction of the output")
def load_has_friction(bench: DriveBench) -> None:
    """A loaded motor without current turns as fast as viscous and Coulomb friction let it."""
    keys = ("output_viscous_friction_n_m_s_rad", "output_coulomb_friction_n_m")
    plant = _plant(bench, *keys)
    drive = bench.drive
    viscous = plant.viscous_friction_n_m_s_rad * plant.gear_ratio**2
    viscous += plant.output_viscous_friction_n_m_s_rad
    for sign in (1.0, -1.0):
        for more in (0.5, 1.0):
            load_n_m = _friction(plant) + more * _LOAD_N_M
            track = _free_track(bench, -sign * load_n_m, 10.0 * _inertia(plant) / viscous)
            wanted = sign * more * _LOAD_N_M / viscous
            what = f"loaded with {-sign * load_n_m:g} N·m"
            _near(drive, track[-1][1], wanted, 0.03 * abs(wanted), what, "rad/s")
        track = _free_track(bench, -0.9 * sign * _friction(plant), 5.0)
        _near(drive, track[-1][1], 0.0, 0.0, "a load below friction", "rad/s")
    bench.stimulate("load_torque_n_m", 0.0)


@drive_clause("PLANT-10", Level.L2, source=f"{_MODEL}supply_v, resistance_ohm and friction")
def full_voltage_limits_speed(bench: DriveBench) -> None:
    """At full voltage the motor turns in both directions at the speed that friction lets it."""
    plant = _plant(bench)
    drive = bench.drive
    drive.require_mode(Mode.TQ)
    drive.require(od.TARGET_TORQUE, od.TORQUE_MAX)
    if plant.source_resistance_ohm or plant.gravity_torque_n_m or plant.static_friction_n_m:
        raise NotApplicable("voltage or load change with speed: see the other clauses")
    drive.pace()
    if drive.find(od.MOTOR_SPEED_MAX) is not None:
        drive.set(od.MOTOR_SPEED_MAX, _RPM_MAX)
    torque, ratio = drive.read(od.TORQUE_MAX), abs(plant.gear_ratio)
    drive.write(od.TARGET_TORQUE, 0)
    drive.enable(Mode.TQ)
    ohm, k = plant.resistance_ohm, plant.torque_constant_n_m_a
    viscous = plant.viscous_friction_n_m_s_rad
    viscous += plant.output_viscous_friction_n_m_s_rad / ratio**2
    for sign in (1, -1):
        drive.write(od.TARGET_TORQUE, sign * min(torque, 0x7FFF))
        speed = 0.0
        for _ in range(100):
            before, speed = speed, bench.truth("velocity_rad_s")
            if sign * speed > 0.0 and abs(speed - before) < 1e-4 * abs(speed):
                break
            drive.quiet(0.1)
        else:
            raise NotApplicable(f"6071h = {sign * torque}: the motor speeds up for 10 s")
        against = (_friction(plant) + sign * plant.load_torque_n_m) / ratio
        wanted = (plant.supply_v - ohm * against / k) / (k + ohm * viscous / k) / ratio
        what = f"6071h = {sign * torque}, supply of {plant.supply_v:g} V"
        _near(drive, sign * speed, wanted, 0.003 * wanted, what, "rad/s")


@drive_clause("PLANT-11", Level.L2, source=f"{_MODEL}backlash_rad, damped")
def load_has_play(bench: DriveBench) -> None:
    """A load that is pushed to and fro at a motor that stands moves by the stated backlash."""
    plant = _plant(bench, "backlash_rad", "coupling_damping_n_m_s_rad")
    drive, ratio = _hold(bench), abs(plant.gear_ratio)
    drive.quiet(0.5)
    load_n_m = 2.0 * plant.output_coulomb_friction_n_m + _LOAD_N_M
    for _ in range(2):
        ends, motor = [], []
        for sign in (1.0, -1.0):
            track = _free_track(bench, -sign * load_n_m, 1.0)[-200:]
            ends.append(sum(place for place, _ in track) / len(track))
            motor.append(drive.read(od.POSITION))
            spread = max(place for place, _ in track) - min(place for place, _ in track)
            what, expected = f"{-sign * load_n_m:g} N·m at rest", "no motion beyond half the play"
            is_still = spread <= 0.5 * plant.backlash_rad
            drive.expect(
                is_still, what, expected, f"{spread:.2g} rad", "the load rebounds for ever"
            )
        turned = (motor[0] - motor[1]) * drive.units().position_inc
        turned_rad = turned / plant.encoder_increments_rev / ratio * 2.0 * pi
        wanted = plant.backlash_rad + turned_rad
        slack = 0.1 * plant.backlash_rad + 2.0 * pi / plant.encoder_increments_rev / ratio
        if plant.coupling_stiffness_n_m_rad:
            wanted += 2.0 * load_n_m / plant.coupling_stiffness_n_m_rad
            slack += 2.2 * plant.output_coulomb_friction_n_m / plant.coupling_stiffness_n_m_rad
        what = f"way of the load between {load_n_m:g} and -{load_n_m:g} N·m"
        _near(drive, ends[0] - ends[1], wanted, slack, what, "rad")
    bench.stimulate("load_torque_n_m", 0.0)


# --- time


@drive_clause("PLANT-09", Level.L0, source="The rig: oscillator.jitter_s")
def wakes_are_late(bench: DriveBench) -> None:
    """A drive with jitter is late by up to it, now more and now less, and keeps its mean period."""
    bench.require_stated("oscillator", "jitter_s")
    drive, jitter_ms = bench.drive, 1e3 * bench.stated["oscillator"]["jitter_s"]
    drive.require(od.HEARTBEAT_PRODUCER)
    period_ms = max(20, round(10.0 * jitter_ms))
    drive.write(od.HEARTBEAT_PRODUCER, period_ms)
    begin_ns = drive.now_ns
    drive.quiet(100.5 * period_ms / 1e3)
    heard = drive.client.heard(drive.error_control_id, begin_ns)[1:]
    count = len(heard)
    drive.expect(98 <= count <= 101, f"1017h = {period_ms}", "100 heartbeats", f"{count}")
    first_ns = heard[0].time_ns
    late_ms = [(one.time_ns - first_ns) / 1e6 - at * period_ms for at, one in enumerate(heard)]
    least = min(late_ms)
    spread = max(late_ms) - least
    expected = f"a spread of {0.8 * jitter_ms:.2f} ms to {jitter_ms + 0.3:.2f} ms"
    is_right = 0.8 * jitter_ms <= spread <= jitter_ms + 0.3
    drive.expect(is_right, f"jitter_s = {jitter_ms / 1e3:g}", expected, f"{spread:.2f} ms")
    mean = sum(late_ms) / count - least
    expected = f"{0.3 * jitter_ms:.2f} ms to {0.7 * jitter_ms:.2f} ms"
    is_right = 0.3 * jitter_ms <= mean <= 0.7 * jitter_ms
    drive.expect(is_right, "mean lateness", expected, f"{mean:.2f} ms", "lateness is not even")
    if drive.has_mode(Mode.PP):
        drive.write(od.HEARTBEAT_PRODUCER, max(1, round(3.0 * jitter_ms)))
        _expect_true_position(bench, jitter_ms / 1e3)
    drive.write(od.HEARTBEAT_PRODUCER, 0)


def _expect_true_position(bench: DriveBench, jitter_s: float) -> None:
    """Expect 6064h of a turning motor to be true, but for the time that it takes to tell."""
    drive = bench.drive
    span = drive.range_span()
    pace = drive.pace()
    per_rad = scale(bench, pace)
    drive.cruise(pace)
    slack = drive.window() + pace.speed * 2.0 * (pace.sample_s + jitter_s)
    first, first_rad = drive.read(od.POSITION), bench.true_position_rad()
    request = struct.pack("<BHB4x", 0x40, od.POSITION.index, od.POSITION.subindex)
    for _ in range(_TRUE_SAMPLES):
        asked = drive.client.send(0x600 + drive.node_id, request)
        true = (bench.true_position_rad() - first_rad) * per_rad
        drive.quiet(2.0 * (pace.sample_s + jitter_s))
        answers = drive.client.heard(0x580 + drive.node_id, asked.time_ns)
        drive.expect(bool(answers), "upload of 6064h in motion", "an answer", "none")
        told = int.from_bytes(answers[0].data[4:8], "little", signed=True) - first
        if 0 < span < 2.0 * abs(told - true):
            continue  # beyond an end of 607Bh
        _near(drive, told, true, slack, "6064h in motion, beside the true position", "units")
    drive.command(od.DISABLE_VOLTAGE)


@drive_clause("PLANT-12", Level.L2, source=f"{_MODEL}inertia and friction")
def motor_runs_out(bench: DriveBench) -> None:
    """Without current a turning motor slows down as inertia and friction let it, both ways."""
    plant = _plant(bench)
    drive = bench.drive
    drive.require_mode(Mode.PV)
    if plant.gravity_torque_n_m or plant.static_friction_n_m or plant.load_torque_n_m:
        raise NotApplicable("the load changes with position or speed, or pushes")
    pace, ratio = drive.pace(), plant.gear_ratio**2
    viscous = plant.viscous_friction_n_m_s_rad * ratio + plant.output_viscous_friction_n_m_s_rad
    friction, inertia = _friction(plant), _inertia(plant)
    if not viscous:
        raise NotApplicable("the motor has no viscous friction")
    for sign in (1, -1):
        drive.enable(Mode.PV)
        drive.write(od.TARGET_VELOCITY, sign * pace.velocity)
        drive.await_velocity(sign * pace.velocity, 3.0 * pace.ramp_s + 0.5)
        drive.command(od.DISABLE_VOLTAGE)
        drive.quiet()
        begin_ns, fast = drive.now_ns, abs(bench.truth("velocity_rad_s"))
        wanted = fast / 2.0
        torques = friction + viscous * fast, friction + viscous * wanted
        drive.quiet(inertia / viscous * log(torques[0] / torques[1]))
        slow = abs(bench.truth("velocity_rad_s"))
        what = f"{(drive.now_ns - begin_ns) / 1e9:.3f} s without current from {fast:.3g} rad/s"
        _near(drive, slow, wanted, 0.03 * fast, what, "rad/s")
