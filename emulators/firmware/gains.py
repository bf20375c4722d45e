"""The servo's gains (P position, PI velocity, PI current, feedforward), tuned from the plant."""

from dataclasses import dataclass, replace
from typing import final

from emulators.plant.dc_motor import MotorPlant
from emulators.plant.discretisation import exponential


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ServoGains:
    """Gains of the cascade; velocities in increments of the encoder per second.

    Attributes:
        position_kp_1_s: velocity asked for per increment of following error.
        velocity_kp_a_s_inc: current asked for per inc/s of velocity error.
        velocity_ki_a_inc: growth of that current per second and inc/s of velocity error.
        current_kp_v_a: voltage per ampere of current error.
        current_ki_v_a_s: growth of that voltage per second and ampere of current error.
        velocity_feedforward: share of the demand's velocity passed on, 0..1.
        acceleration_feedforward_a_s2_inc: current per inc/s^2 of the demand's acceleration.
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
        """Gains that follow well and stand still, from the plant's own numbers.

        Current loop: zero on the pole of L and R, closed-loop pole at 0.6 per step. Velocity loop:
        0.2 per tick (200 rad/s at 1 kHz) where the current loop is fast; its integrator at 2/7 and
        the position loop at 1/3 of that. The sensitivity then peaks at 1.6. A coarse encoder makes
        it slower, so that one increment never asks for more than 0.4 of the current there is.
        """
        step_s = tick_ns / (1e9 * current_steps)
        tick_s = tick_ns / 1e9
        decay = exponential([[-step_s / plant.electrical_time_constant_s()]])[0][0]
        a_s2_inc = plant.inertia_kg_m2() / (
            plant.torque_constant_n_m_a * plant.increments_per_rad()
        )
        per_tick = 0.2 * 1.65 / (1.5 + 1.5 / current_steps)
        noise_a = 0.5 * a_s2_inc / (tick_s * tick_s)  # asked for per increment, with 1 per tick
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
        """The velocity loop brakes to standstill as a short circuit of the motor would.

        The current is that which the motor's own voltage drives through its resistance: none of
        its energy goes back into the supply, whose voltage does not rise.
        """
        kp = plant.torque_constant_n_m_a / (plant.resistance_ohm * plant.increments_per_rad())
        return replace(
            self, velocity_kp_a_s_inc=min(kp, self.velocity_kp_a_s_inc), velocity_ki_a_inc=0.0
        )
