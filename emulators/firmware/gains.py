"""The servo's gains (P position, PI velocity, PI current, feedforward), tuned from the plant."""

from dataclasses import dataclass
from typing import final

from emulators.plant.dc_motor import MotorPlant


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
        """Gains that follow well and stand still, from the plant's own numbers."""
        step_s = tick_ns / (1e9 * current_steps)
        acceleration_a = plant.inertia_kg_m2() / (
            plant.torque_constant_n_m_a * plant.increments_per_rad()
        )
        bandwidth_1_s = 0.4 / (2.65e-9 * tick_ns)
        return ServoGains(
            position_kp_1_s=bandwidth_1_s / 4.0,
            velocity_kp_a_s_inc=bandwidth_1_s * acceleration_a,
            velocity_ki_a_inc=bandwidth_1_s * bandwidth_1_s * acceleration_a / 5.0,
            current_kp_v_a=0.4 * plant.inductance_h / step_s,
            current_ki_v_a_s=0.4 * plant.resistance_ohm / step_s,
            acceleration_feedforward_a_s2_inc=acceleration_a,
        )
