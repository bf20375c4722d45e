"""Servo gains (P position, PI velocity, PI current, feedforward) and their tuning."""

from dataclasses import dataclass, replace
from typing import final

from emulators.plant.dc_motor import MotorPlant
from emulators.plant.discretisation import exponential


@final
@dataclass(frozen=True, slots=True, kw_only=True)
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
