"""Constants for stepping a nonlinear plant, per axis and temperature.

All values are on the motor's side of the gear: torques in N m, positions in encoder increments. The
load is treated as if it turned with the motor.

A step of the current loop is divided into equal substeps of `h` seconds. In a substep each body
moves exactly as its differential equations say while voltage and external torques are held. The
maps are matrix exponentials, as for a linear plant. Position-dependent torques are handled in two
ways.

The spring acts with its mean over the substep (see `nonlinear_servo.coupling`), which is stable for
any stiffness. Its oscillation comes out too slow by (omega h)^2 / 24. A plant is
refused if omega h would exceed `OMEGA_H_MAX` even with `SUBSTEPS_MAX` substeps.

Waves (cogging, gravity) act with their value at the start of the substep. A spring as stiff as the
wave's steepest slope holds the body there, so that a step never gains energy from a wave.
"""

from functools import lru_cache
from typing import Final, final

from motorhil.emulators.firmware.servo_tables import (
    LoadTable,
    ServoGains,
    StepTable,
    TickTable,
    powers,
    shrinking_norm,
)
from motorhil.emulators.plant.dc_motor import PI, Matrix, MotorPlant, exponential
from motorhil.emulators.plant.nonlinear import NEVER_RAD, REFERENCE_C

OMEGA_H_MAX: Final = 0.5
SUBSTEPS_MAX: Final = 16
WAVE_STEEPEST: Final = 6.4  # slope of `wave`, per period
SLOW_S: Final = 0.02  # interval of temperature and I2t updates [s]
STEPS_OF_TEMPERATURE: Final = 4.0  # resistance steps per kelvin
_HEAT_COUNTS: Final = float(1 << 26)  # counts of i^2 at the largest current
_LOAD_FRICTION_MIN: Final = (
    1e-6  # share of the motor's largest torque; brings a swinging load to rest
)
_FAR: Final = 1e300

# Conditions: values that can change without new tables. Load torque at the motor [N m], the
# source's voltage [V]. Thresholds: DC link above and below [V], winding limit and warning [degC],
# I2t warning. The gate: the least output count inside, and the least count beyond it.
Conditions = tuple[float, float, float, float, float, float, float, float, float]


@final
class StepNumbers:
    """Constants of one substep at one winding temperature; `nonlinear_servo` uses the names."""

    ii: float
    iw: float
    iv: float
    it: float
    wi: float
    ww: float
    wv: float
    wt: float
    xi: float
    xw: float
    xv: float
    xt: float
    coast_w: float
    coast_wt: float
    coast_x: float
    coast_xt: float
    load_w: float
    load_wt: float
    load_x: float
    load_xt: float

    def __init__(self, plant: MotorPlant, h: float, step_s: float, resistance_ohm: float) -> None:
        """Compute all constants; the function is long because it is a list of numbers."""
        extras = plant.extras
        gear = plant.gear_ratio
        inc_rad = plant.increments_per_rad()
        self.two_bodies: bool = extras.has_two_bodies()
        load_inertia = plant.load_inertia_kg_m2 / (gear * gear)
        load_viscous = extras.output_viscous_friction_n_m_s_rad / (gear * gear)
        load_friction = extras.output_coulomb_friction_n_m / gear
        self.k: float = plant.torque_constant_n_m_a
        self.resistance: float = resistance_ohm
        self.cogging: float = extras.cogging_torque_n_m
        self.cogging_inc: float = extras.cogging_periods_rev / plant.encoder_increments_rev
        self.gravity: float = extras.gravity_torque_n_m / gear
        self.gravity_inc: float = 1.0 / (plant.encoder_increments_rev * gear)
        self.gravity_zero: float = extras.gravity_zero_rad / (2.0 * PI)
        size = self.gravity if self.gravity > 0.0 else -self.gravity
        steep_rotor = self.cogging * self.cogging_inc * WAVE_STEEPEST
        steep_load = size * self.gravity_inc * WAVE_STEEPEST

        inertia, viscous = plant.rotor_inertia_kg_m2, plant.viscous_friction_n_m_s_rad
        self.coulomb: float = plant.coulomb_friction_n_m
        if not self.two_bodies:
            inertia += load_inertia
            viscous += load_viscous
            self.coulomb += load_friction
            steep_rotor += steep_load
        static = max(extras.static_friction_n_m, plant.coulomb_friction_n_m)
        self.more: float = static - plant.coulomb_friction_n_m  # excess at standstill
        self.stribeck: float = 1.0 / (extras.stribeck_speed_rad_s * extras.stribeck_speed_rad_s)

        # the rotor: rows current, speed, position; columns current, speed, voltage, torque
        inductance = plant.inductance_h
        driven = [
            [-resistance_ohm / inductance, -self.k / inductance, 0.0, 1.0 / inductance, 0.0],
            [self.k / inertia, -viscous / inertia, -steep_rotor / inertia, 0.0, 1.0 / inertia],
            [0.0, inc_rad, 0.0, 0.0, 0.0],
            [0.0] * 5,
            [0.0] * 5,
        ]
        m = exponential([[value * h for value in row] for row in driven])
        self.ii, self.iw, self.iv, self.it = m[0][0], m[0][1], m[0][3], m[0][4]
        self.wi, self.ww, self.wv, self.wt = m[1][0], m[1][1], m[1][3], m[1][4]
        self.xi, self.xw, self.xv, self.xt = m[2][0], m[2][1], m[2][3], m[2][4]
        m = _body(inertia, viscous, steep_rotor, inc_rad, h)
        self.coast_w, self.coast_wt = m[0][0], m[0][2]
        self.coast_x, self.coast_xt = m[1][0], m[1][2]
        self.decay: float = exponential([[-resistance_ohm / inductance * h]])[0][0]
        self.gain: float = (1.0 - self.decay) / resistance_ohm

        # the load: rows speed, position; columns speed, torque
        top = self.k * plant.current_max_a
        self.load_coulomb: float = max(load_friction, _LOAD_FRICTION_MIN * top)
        m = _body(load_inertia or inertia, load_viscous, steep_load, inc_rad, h)
        self.load_w, self.load_wt = m[0][0], m[0][2]
        self.load_x, self.load_xt = m[1][0], m[1][2]
        self.gap: float = 0.5 * extras.backlash_rad * gear * inc_rad
        self.spring: float = _stiffness(plant, step_s) / (gear * gear * inc_rad)
        self.damper: float = extras.coupling_damping_n_m_s_rad / (gear * gear * inc_rad) / h
        self.low: float = _end(extras.stop_low_rad, plant)
        self.high: float = _end(extras.stop_high_rad, plant)
        self.restitution: float = extras.stop_restitution


@final
class ExtrasTables:
    """All constants of one axis with a nonlinear plant; immutable except for its cache.

    Raises:
        ValueError: the gains make the current loop unstable, or the coupling is too stiff to be
            stepped. The message begins with the plant's key in the second case.

    Attributes:
        servo, no_steps, no_load: tables with which `servo.run` moves nothing and steps the servo.
        count, substeps: current loop steps in a tick, and substeps in each step.
        kp, ki: gains of the current loop; ki per step.
        slow_ticks: ticks between updates of temperature and I2t.
        heat_scale: counts per A^2.
    """

    def __init__(
        self,
        plant: MotorPlant,
        gains: ServoGains,
        tick_table: TickTable,
        tick_ns: int,
        current_steps: int,
        clock_rate: float = 1.0,
    ) -> None:
        extras = plant.extras
        tick_s = tick_ns / 1e9
        self.count: Final[int] = current_steps
        self._plant = plant
        self._step_s: float = tick_s / current_steps / clock_rate
        self.substeps: Final[int] = substeps_for(plant, self._step_s)
        self.kp: float = gains.current_kp_v_a
        self.ki: float = gains.current_ki_v_a_s * tick_s / current_steps
        # Rows that map current, integrator and speed onto themselves and add nothing to the
        # position; all guards hold. The rest of the table is the servo's own.
        self.servo: TickTable = (
            *(1.0, 0.0, 0.0, 0.0),
            *(0.0, 1.0, 0.0, 0.0),
            *(0.0, 0.0, 1.0, 0.0),
            *(0.0, 0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0, 0.0, 0.0),
            *(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            *(_FAR, -_FAR, 1.0, 0.0),
            *tick_table[-5:],
        )
        self.no_steps: StepTable = (0.0,) * 24
        self.no_load: LoadTable = (0.0, _FAR, 0.0, *(0.0,) * 12)
        self._numbers: dict[int, StepNumbers] = {}
        self._norms: dict[int, tuple[float, float, float]] = {}

        self.has_dc_link: Final[bool] = extras.has_dc_link()
        self.per_farad: float = self._step_s / extras.dc_link_capacitance_f
        self.source_1_ohm: float = _conductance(extras.source_resistance_ohm)
        self.bleed_1_ohm: float = _conductance(extras.dc_link_bleed_ohm)
        self.chopper_1_ohm: float = _conductance(extras.chopper_resistance_ohm)
        self.chopper_v: float = extras.chopper_threshold_v

        self.slow_ticks: Final[int] = max(1, round(SLOW_S / tick_s))
        self.has_heat: Final[bool] = extras.has_heat()
        self.has_i2t: Final[bool] = extras.has_i2t()
        self.heat_scale: float = _HEAT_COUNTS / (plant.current_max_a * plant.current_max_a)
        self.follows_copper: Final[bool] = extras.copper_coefficient_1_k > 0.0
        self.ambient_c: float = extras.ambient_c
        slow_s = self.slow_ticks * tick_s / clock_rate
        self.warming: tuple[float, float, float, float, float, float] = _warming(plant, slow_s)
        continuous, peak = extras.i2t_continuous_a, extras.i2t_peak_a
        room = (peak * peak - continuous * continuous) * extras.i2t_peak_s
        self.i2t_square: float = continuous * continuous
        self.i2t_rise: float = slow_s / room if room > 0.0 else 0.0
        self.low: float = _end(extras.stop_low_rad, plant)
        self.high: float = _end(extras.stop_high_rad, plant)
        self.at(self.index(self.ambient_c))  # raises for unstable gains

    def index(self, winding_c: float) -> int:
        """Return the index of the constants for this winding temperature."""
        if not self.follows_copper:
            return 0
        return int((winding_c - REFERENCE_C) * STEPS_OF_TEMPERATURE // 1.0)

    def resistance_ohm(self, index: int) -> float:
        """Return the winding resistance at the temperature of `index` [ohm]."""
        warmer = index / STEPS_OF_TEMPERATURE
        factor = 1.0 + self._plant.extras.copper_coefficient_1_k * warmer
        return self._plant.resistance_ohm * (factor if factor > 0.1 else 0.1)

    def at(self, index: int) -> StepNumbers:
        """Return the constants of `index`, computing them once."""
        found = self._numbers.get(index)
        if found is None:
            h = self._step_s / self.substeps
            resistance = self.resistance_ohm(index)
            found = StepNumbers(self._plant, h, self._step_s, resistance)
            self._norms[index] = self._norm(resistance)
            self._numbers[index] = found
        return found

    def norm(self, index: int) -> tuple[float, float, float]:
        """Return the norm in which a blocked motor's deviations shrink (see `servo.run`)."""
        self.at(index)
        return self._norms[index]

    def _norm(self, resistance_ohm: float) -> tuple[float, float, float]:
        decay = exponential([[-resistance_ohm / self._plant.inductance_h * self._step_s]])[0][0]
        gain = (1.0 - decay) / resistance_ohm
        step = [[decay - gain * self.kp, -gain], [self.ki, 1.0]]
        return shrinking_norm(powers(step, self.count)[-1])


def substeps_for(plant: MotorPlant, step_s: float) -> int:
    """Return the number of substeps per step of the current loop.

    Raises:
        ValueError: more than SUBSTEPS_MAX are necessary; the message begins with the key.
    """
    stiffness = plant.extras.coupling_stiffness_n_m_rad
    if not stiffness:
        return 1
    omega = _omega(plant, stiffness)
    needed = -int(-omega * step_s / OMEGA_H_MAX // 1.0)
    if needed > SUBSTEPS_MAX:
        raise ValueError(
            f"coupling_stiffness_n_m_rad = {stiffness:g} N m/rad: oscillates at {omega:.0f} "
            f"rad/s with these inertias, too fast for steps of {step_s * 1e6:g} us; expected "
            f"at most {_stiffest(plant, step_s):.3g} N m/rad; use more current_steps or a "
            "shorter tick_s"
        )
    return max(1, needed)


def _stiffness(plant: MotorPlant, step_s: float) -> float:
    """Return the coupling stiffness at the output, given or as stiff as possible [N m/rad]."""
    extras = plant.extras
    if extras.coupling_stiffness_n_m_rad or not extras.backlash_rad:
        return extras.coupling_stiffness_n_m_rad
    return _stiffest(plant, step_s) / (SUBSTEPS_MAX * SUBSTEPS_MAX)


def _stiffest(plant: MotorPlant, step_s: float) -> float:
    omega = OMEGA_H_MAX * SUBSTEPS_MAX / step_s
    unit = _omega(plant, 1.0)
    return omega * omega / (unit * unit)


def _omega(plant: MotorPlant, stiffness: float) -> float:
    """Return the angular frequency of rotor against load, by Newton's iteration [rad/s]."""
    rotor = plant.rotor_inertia_kg_m2 * plant.gear_ratio * plant.gear_ratio
    load = plant.load_inertia_kg_m2 or rotor
    square = stiffness * (1.0 / rotor + 1.0 / load)
    root = square if square > 1.0 else 1.0
    for _ in range(200):
        root = 0.5 * (root + square / root)
    return root


def _end(position_rad: float, plant: MotorPlant) -> float:
    """Return the position of an end stop in the increments of `servo.run` (half of one ahead)."""
    if position_rad in (-NEVER_RAD, NEVER_RAD):
        return _FAR if position_rad > 0.0 else -_FAR
    return position_rad * plant.gear_ratio * plant.increments_per_rad() + 0.5


def _conductance(resistance_ohm: float) -> float:
    return 1.0 / resistance_ohm if resistance_ohm > 0.0 else 0.0


def _body(inertia: float, viscous: float, steepness: float, inc_rad: float, h: float) -> Matrix:
    """Return the map of a free body: rows speed, position; columns speed, position, torque."""
    rates = [
        [-viscous / inertia, -steepness / inertia, 1.0 / inertia],
        [inc_rad, 0.0, 0.0],
        [0.0] * 3,
    ]
    return exponential([[value * h for value in row] for row in rates])


def _warming(plant: MotorPlant, slow_s: float) -> tuple[float, float, float, float, float, float]:
    """Return the thermal map: rows winding, housing; columns both [K above ambient], losses [W].

    A data sheet's time constants are those of each node alone. The heat capacity is the time
    constant divided by the thermal resistance outwards.
    """
    extras = plant.extras
    if not extras.has_heat():
        return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0
    inner = extras.thermal_resistance_winding_housing_k_w
    outer = extras.thermal_resistance_housing_ambient_k_w
    winding_j_k = extras.thermal_time_constant_winding_s / inner
    housing_j_k = extras.thermal_time_constant_motor_s / outer
    rates = [
        [-1.0 / (inner * winding_j_k), 1.0 / (inner * winding_j_k), 1.0 / winding_j_k],
        [
            1.0 / (inner * housing_j_k),
            -(1.0 / inner + 1.0 / outer) / housing_j_k,
            0.0,
        ],
        [0.0] * 3,
    ]
    m = exponential([[value * slow_s for value in row] for row in rates])
    return m[0][0], m[0][1], m[0][2], m[1][0], m[1][1], m[1][2]


@lru_cache(maxsize=64)
def extras_tables(
    plant: MotorPlant,
    gains: ServoGains,
    tick_table: TickTable,
    tick_ns: int,
    current_steps: int,
    clock_rate: float,
) -> ExtrasTables | None:
    """Return the tables of a nonlinear plant, shared by equal axes; None for a linear plant."""
    if not plant.extras.is_any():
        return None
    return ExtrasTables(plant, gains, tick_table, tick_ns, current_steps, clock_rate)
