"""A second axis, written for clarity only, as an oracle for the firmware.

It solves the differential equations in small steps and runs the servo in plain sequence. Nothing is
lazy, and no steps are combined.
"""

import math
from dataclasses import dataclass, field

from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant


@dataclass
class ReferenceAxis:
    """Speed in rad/s, position in increments with the encoder's edges at half increments."""

    plant: MotorPlant
    gains: ServoGains
    load_n_m: float = 0.0
    tick_s: float = 1e-3
    current_steps: int = 10
    fine_steps: int = 8  # steps of the equations per step of the current loop

    current: float = 0.0
    speed: float = 0.0
    position: float = 0.0
    volts: float = 0.0  # integrator of the current loop
    amperes: float = 0.0  # integrator of the velocity loop
    wanted: float = 0.0
    counts: list[int] = field(default_factory=lambda: [0, 0, 0])

    def push(self, current: float) -> None:
        """Run one servo tick, then demand this current."""
        for _ in range(self.current_steps):
            self._current_step()
        self.wanted = current

    def tick(self, demand: int, velocity: float, acceleration: float) -> None:
        """Run one servo tick towards a demand [inc], with its velocity and acceleration [inc/s...].

        `velocity` is the demand's one tick ago: as old as the middle of the two-tick average.
        """
        for _ in range(self.current_steps):
            self._current_step()
        self.counts = [math.floor(self.position + 0.5), *self.counts[:2]]
        g = self.gains
        measured = (self.counts[0] - self.counts[2]) / (2 * self.tick_s)
        error = g.position_kp_1_s * (demand - self.counts[0]) + velocity - measured
        asked = (
            g.velocity_kp_a_s_inc * error
            + self.amperes
            + g.acceleration_feedforward_a_s2_inc * acceleration
        )
        limit = self.plant.current_max_a
        self.wanted = max(-limit, min(limit, asked))
        if asked == self.wanted or (asked > limit) == (error < 0.0):
            self.amperes += g.velocity_ki_a_inc * error * self.tick_s

    def _current_step(self) -> None:
        step_s = self.tick_s / self.current_steps
        error = self.wanted - self.current
        asked = self.gains.current_kp_v_a * error + self.volts
        supply = self.plant.supply_v
        voltage = max(-supply, min(supply, asked))
        for _ in range(self.fine_steps):
            self._fine_step(voltage, step_s / self.fine_steps)
        if asked == voltage or (asked > supply) == (error < 0.0):
            self.volts += self.gains.current_ki_v_a_s * error * step_s

    def _fine_step(self, voltage: float, h: float) -> None:
        """Apply the classical fourth-order rule; check for standstill at the end of the step."""
        p = self.plant
        k, j = p.torque_constant_n_m_a, p.inertia_kg_m2()
        load = self.load_n_m / p.gear_ratio
        if self.speed == 0.0:
            net = k * self.current - load
            drive = 0.0 if abs(net) <= p.coulomb_friction_n_m else math.copysign(1.0, net)
        else:
            drive = math.copysign(1.0, self.speed)
        friction = -drive * p.coulomb_friction_n_m

        def slope(i: float, w: float) -> tuple[float, float, float]:
            di = (voltage - p.resistance_ohm * i - k * w) / p.inductance_h
            if drive == 0.0:
                return di, 0.0, 0.0
            dw = (k * i - p.viscous_friction_n_m_s_rad * w + friction - load) / j
            return di, dw, w * p.encoder_increments_rev / (2 * math.pi)

        i, w = self.current, self.speed
        a = slope(i, w)
        b = slope(i + h / 2 * a[0], w + h / 2 * a[1])
        c = slope(i + h / 2 * b[0], w + h / 2 * b[1])
        d = slope(i + h * c[0], w + h * c[1])
        self.current += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        self.speed += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        self.position += h / 6 * (a[2] + 2 * b[2] + 2 * c[2] + d[2])
        if self.speed * drive < 0.0:
            self.speed = 0.0
