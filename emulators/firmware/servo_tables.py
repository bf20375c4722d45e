"""Constants for stepping the servo, per axis and load torque.

Ten steps of the current loop together are one linear map of the axis' state. The map is valid while
the voltage stays within the supply and the rotor does not pass through standstill. A servo tick
then costs one map instead of ten steps. This module builds that map by multiplying the ten steps.
It also derives *guards* from the same ten matrices. Guards are bounds, evaluated at the start of a
tick, that show if any of its steps could clip or stop. Where they cannot exclude that, the steps
are taken one by one. Both ways compute the same values to within rounding, and the choice depends
on the state alone.

The step, with voltage v held by the power stage for one period h of the current loop:

  e = current demand - current;  v = kp e + u;  u grows by ki h e   (u: the integrator [V])
  current, speed, position: exact, from `dc_motor.sample`

A tick's map acts on z = (current, u, speed, position, current demand, torque).

`ServoGains` has the gains (P position, PI velocity, PI current, feedforward) and their tuning.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Final, final

from motorhil.emulators.plant.dc_motor import (
    Matrix,
    MotorPlant,
    SampledMotor,
    dot,
    exponential,
    identity,
    product,
    sample,
)
from motorhil.frozen import frozen

# Flat tuples, in the order in which servo.run and servo.steps unpack them.
TickTable = tuple[float, ...]
StepTable = tuple[float, ...]
LoadTable = tuple[float, ...]

_CURRENT: Final = 0
_INTEGRATOR: Final = 1
_SPEED: Final = 2
_POSITION: Final = 3
_WANTED: Final = 4
_TORQUE: Final = 5

_DOUBLINGS: Final = 40
_VANISHING: Final = 1e-16  # entries of a power that adds less than rounding to any sum
_SLACK: Final = 1.0 + 1e-9  # guards must hold in rounded arithmetic too
_LEAST: Final = 1e-6  # a guard of 0, as of a current loop without gains, bounds nothing


@final
@frozen(kw_only=True)
class ServoGains:
    """Gains of the cascade; velocities in encoder increments per second.

    Attributes:
        position_kp_1_s: velocity demand per increment of following error.
        velocity_kp_a_s_inc: current demand per inc/s of velocity error.
        velocity_ki_a_inc: growth of that current per second and inc/s of velocity error.
        current_kp_v_a: voltage per ampere of current error.
        current_ki_v_a_s: growth of that voltage per second and ampere of current error.
        velocity_feedforward: share of the velocity demand that is fed forward, 0..1.
        acceleration_feedforward_a_s2_inc: current per inc/s^2 of the acceleration demand.
    """

    position_kp_1_s: float
    velocity_kp_a_s_inc: float
    velocity_ki_a_inc: float
    current_kp_v_a: float
    current_ki_v_a_s: float
    velocity_feedforward: float = 1.0
    acceleration_feedforward_a_s2_inc: float = 0.0

    @staticmethod
    def tuned(plant: MotorPlant, tick_ns: int, current_steps: int) -> "ServoGains":
        """Return gains that track well and stand still, derived from the plant's parameters.

        Current loop: zero on the pole of L and R, closed-loop pole at 0.6 per step. Velocity loop:
        0.2 per tick (200 rad/s at 1 kHz) where the current loop is fast. Its integrator is at 2/7
        of that, the position loop at 1/3. The sensitivity then peaks at 1.6. With a coarse encoder
        the velocity loop is slower, so that one increment never demands more than 0.4 of the
        maximum current.
        """
        step_s = tick_ns / (1e9 * current_steps)
        tick_s = tick_ns / 1e9
        decay = exponential([[-step_s / plant.electrical_time_constant_s()]])[0][0]
        a_s2_inc = plant.inertia_kg_m2() / (
            plant.torque_constant_n_m_a * plant.increments_per_rad()
        )
        per_tick = 0.2 * 1.65 / (1.5 + 1.5 / current_steps)
        noise_a = 0.5 * a_s2_inc / (tick_s * tick_s)  # current demand per increment, at 1 per tick
        per_tick = min(per_tick, 0.4 * plant.current_max_a / noise_a)
        bandwidth_1_s = per_tick / tick_s
        return ServoGains(
            position_kp_1_s=bandwidth_1_s / 3.0,
            velocity_kp_a_s_inc=bandwidth_1_s * a_s2_inc,
            velocity_ki_a_inc=bandwidth_1_s * bandwidth_1_s * a_s2_inc / 3.5,
            current_kp_v_a=0.4 * plant.resistance_ohm / (1.0 - decay),
            current_ki_v_a_s=0.4 * plant.resistance_ohm / step_s,
            acceleration_feedforward_a_s2_inc=a_s2_inc,
        )

    def shorted(self, plant: MotorPlant) -> "ServoGains":
        """Return gains with which the velocity loop brakes like a short-circuited motor.

        The current is the one that the back-EMF drives through the winding resistance. No energy
        flows back into the supply, so its voltage does not rise.
        """
        kp = plant.torque_constant_n_m_a / (plant.resistance_ohm * plant.increments_per_rad())
        return replace(
            self, velocity_kp_a_s_inc=min(kp, self.velocity_kp_a_s_inc), velocity_ki_a_inc=0.0
        )


@lru_cache(maxsize=64)
def _sampled(plant: MotorPlant, step_s: float) -> SampledMotor:
    """Return the model of the plant, which other gains do not change."""
    return sample(plant, step_s)


@lru_cache(maxsize=64)
def tables_of(
    plant: MotorPlant, gains: ServoGains, tick_ns: int, current_steps: int, clock_rate: float = 1.0
) -> "ServoTables":
    """Return the tables of such an axis, shared by equal axes; raises as `ServoTables`."""
    return ServoTables(plant, gains, tick_ns, current_steps, clock_rate)


@final
class ServoTables:
    """All constants for stepping one axis; immutable.

    The firmware's constants (integrators, gains per tick) are in ticks of its own clock, which
    counts `clock_rate` seconds per true second. The motor moves in true time.

    Raises:
        ValueError: the gains make the current loop unstable.

    Attributes:
        tick: the table for each call of `servo.run`.
        step: the table for single steps (`servo.steps`).
        current_steps: steps of the current loop in a servo tick.
    """

    def __init__(
        self,
        plant: MotorPlant,
        gains: ServoGains,
        tick_ns: int,
        current_steps: int,
        clock_rate: float = 1.0,
    ) -> None:
        self.current_steps = current_steps
        self._plant = plant
        step_s = tick_ns / (1e9 * current_steps)
        self._motor = _sampled(plant, step_s / clock_rate)
        self._kp = gains.current_kp_v_a
        self._ki = gains.current_ki_v_a_s * step_s
        self._powers = powers(self._closed_step(), current_steps)
        self._blocked_powers = powers(self._blocked_step(), current_steps)
        self._coasting = _sampled(plant, tick_ns / 1e9 / clock_rate).coasting
        self._voltage_guard, self._speed_guard = self._moving_guards()
        self.tick: TickTable = self._tick_table(gains, tick_ns / 1e9)
        self.step: StepTable = self._step_table()

    def load(self, load_torque_n_m: float) -> LoadTable:
        """Return the effects of a constant load torque at the output, ordered as in `servo.run`."""
        plant = self._plant
        load = load_torque_n_m / plant.gear_ratio
        friction = plant.coulomb_friction_n_m
        size = load if load > 0.0 else -load
        speed_top_rad_s = (
            2.0 * plant.supply_v + plant.resistance_ohm * plant.current_max_a
        ) / plant.torque_constant_n_m_a
        acceleration = (
            plant.torque_constant_n_m_a * plant.current_max_a
            + friction
            + size
            + plant.viscous_friction_n_m_s_rad * speed_top_rad_s
        ) / plant.inertia_kg_m2()
        voltage_max_v = plant.supply_v - self._voltage_guard[2] * acceleration * _SLACK
        last = self._powers[-1]
        table = [load, voltage_max_v, self._speed_guard[1] * acceleration * _SLACK]
        for torque in (-load - friction, -load + friction):  # turning forward, backward
            table += [last[row][_TORQUE] * torque for row in range(4)]
            table += [self._coasting[row][2] * torque for row in range(2)]
        return tuple(table)

    def _closed_step(self) -> Matrix:
        """Return one step of current loop and motor, not clipped, as a map of z."""
        step = identity(6)
        kp, ki = self._kp, self._ki
        rows = (_CURRENT, _SPEED, _POSITION)
        for row, (current, speed, position, voltage, torque) in zip(
            rows, self._motor.driven, strict=True
        ):
            step[row] = [
                current - voltage * kp,
                voltage,
                speed,
                position,
                voltage * kp,
                torque,
            ]
        step[_INTEGRATOR] = [-ki, 1.0, 0.0, 0.0, ki, 0.0]
        return step

    def _blocked_step(self) -> Matrix:
        """Return the step with a blocked rotor, as a map of (e, u - R * current demand)."""
        gain = self._motor.blocked_gain_a_v
        return [[self._motor.blocked_decay - gain * self._kp, -gain], [self._ki, 1.0]]

    def _moving_guards(self) -> tuple[tuple[float, float, float], tuple[float, float]]:
        """Return bounds on voltage and speed within a tick.

        In terms of e, d = u - R wanted - K speed (both 0 in steady motion) and the acceleration a0
        at the start, the voltage never departs from u by more than

          first[0] |e| + first[1] |d| + first[2] a_max   =: m + first[2] a_max

        and the speed never departs from the straight line between its two ends by more than
        second[0] * m + second[1] * a_max; a_max bounds |a0| for currents within the limit.
        """
        k = self._plant.torque_constant_n_m_a
        inertia = self._plant.inertia_kg_m2()
        unit_error = [-1.0, 0.0, 0.0, 0.0, 0.0, k]  # torque such that nothing accelerates
        unit_mismatch = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
        unit_acceleration = [0.0, 0.0, 0.0, 0.0, 0.0, inertia]
        voltages: list[float] = []
        bends: list[float] = []
        count = self.current_steps
        for unit in (unit_error, unit_mismatch, unit_acceleration):
            path = [[dot(row, unit) for row in power] for power in self._powers]
            volts = [self._kp * (z[_WANTED] - z[_CURRENT]) + z[_INTEGRATOR] for z in path[:count]]
            voltages.append(max(abs(v - unit[_INTEGRATOR]) for v in volts))
            end = path[count][_SPEED]
            bends.append(max(abs(z[_SPEED] - end * j / count) for j, z in enumerate(path)))
        per_ampere = k / inertia  # a current error e accelerates as well
        first = max(voltages[0] + voltages[2] * per_ampere, _LEAST) * _SLACK
        second = max(voltages[1], _LEAST) * _SLACK
        bend = max((bends[0] + bends[2] * per_ampere) / first, bends[1] / second) * _SLACK
        return (first, second, voltages[2]), (bend, bends[2])

    def _tick_table(self, gains: ServoGains, tick_s: float) -> TickTable:
        plant = self._plant
        last = self._powers[-1]
        maps: list[float] = []
        for row in (_CURRENT, _INTEGRATOR, _SPEED, _POSITION):
            maps += [last[row][column] for column in (_CURRENT, _INTEGRATOR, _SPEED, _WANTED)]
        blocked = self._blocked_powers[-1]
        steps = self._blocked_powers[: self.current_steps]
        kp = self._kp
        volts_e = max(_LEAST, *(abs(kp * power[0][0] + power[1][0]) for power in steps)) * _SLACK
        volts_s = max(_LEAST, *(abs(kp * power[0][1] + power[1][1]) for power in steps)) * _SLACK
        amperes = _SLACK * max(
            max(abs(power[0][0]) for power in self._blocked_powers) / volts_e,
            max(abs(power[0][1]) for power in self._blocked_powers) / volts_s,
        )
        per_tick = 1.0 / tick_s
        return (
            *maps,
            plant.resistance_ohm,
            plant.torque_constant_n_m_a,
            self._voltage_guard[0],
            self._voltage_guard[1],
            self._speed_guard[0],
            *blocked[0],
            *blocked[1],
            *shrinking_norm(blocked),
            volts_e,
            volts_s,
            plant.torque_constant_n_m_a * amperes,
            plant.supply_v,
            plant.coulomb_friction_n_m,
            self._coasting[0][0],
            self._coasting[1][0],
            gains.position_kp_1_s * tick_s,
            gains.velocity_feedforward,
            gains.velocity_kp_a_s_inc * per_tick,
            gains.velocity_ki_a_inc,
            gains.acceleration_feedforward_a_s2_inc * per_tick * per_tick,
        )

    def _step_table(self) -> StepTable:
        motor: SampledMotor = self._motor
        driven, coasting = motor.driven, motor.coasting
        return (
            *(driven[0][column] for column in (0, 1, 3, 4)),
            *(driven[1][column] for column in (0, 1, 3, 4)),
            *(driven[2][column] for column in (0, 1, 3, 4)),
            *(coasting[0][column] for column in (0, 2)),
            *(coasting[1][column] for column in (0, 2)),
            motor.blocked_decay,
            motor.blocked_gain_a_v,
            self._kp,
            self._ki,
            self._plant.resistance_ohm,
            self._plant.torque_constant_n_m_a,
            self._plant.supply_v,
            self._plant.coulomb_friction_n_m,
        )


def shrinking_norm(matrix: Matrix) -> tuple[float, float, float]:
    """Return a, b, c of a norm that each mapping shrinks (Lyapunov).

    Mapping (e, s) shrinks a e^2 + b e s + c s^2 by e^2 + s^2. The result is the sum of the
    squared sizes after n maps over all n, computed by doubling n.
    """
    total = identity(2)
    power = matrix
    for _ in range(_DOUBLINGS):
        (a, b), (c, d) = power
        if max(abs(a), abs(b), abs(c), abs(d)) < _VANISHING:
            break
        transposed = [[a, c], [b, d]]
        added = product(transposed, product(total, power))
        total = [[total[r][c] + added[r][c] for c in range(2)] for r in range(2)]
        power = product(power, power)
        if not total[0][0] + total[1][1] < 1e15:
            raise ValueError("current loop: unstable, or nearly so, with these gains")
    return total[0][0], total[0][1] + total[1][0], total[1][1]


def powers(matrix: Matrix, count: int) -> list[Matrix]:
    """Return the powers 0..count of the matrix."""
    found = [identity(len(matrix))]
    for _ in range(count):
        found.append(product(matrix, found[-1]))
    return found
