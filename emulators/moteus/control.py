"""Position control of a moteus: its trajectory, and its motor, in turns of the output.

The firmware plans anew in each of its 30,000 periods a second. This module plans once, in
continuous time: the trajectory of least duration within the limits, which those steps approach.
It is relative to a target that moves with the commanded velocity.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import copysign, inf, isfinite, pi, sqrt
from typing import Final, final

from motorhil.emulators.api import Axis, MotorSettings, flags

Pieces = Sequence[tuple[float, float, float]]
"""(duration [s], velocity at its begin [rev/s], acceleration [rev/s²]), in their order."""

_LEAST_SCALE: Final = 1e-6  # of kd: the servo multiplies kp by it
_AT_ONCE: Final = 1e300  # a ramp without duration


@final
class Trajectory:
    """The control position from one command to the next.

    Args:
        start: the control position at its begin [rev].
        velocity: the control velocity at its begin [rev/s].
        target: the commanded position at its begin; None: only a velocity is commanded.
        final: the commanded velocity, of the target too.
        speed: the velocity limit, inf: none.
        acceleration: the acceleration limit [rev/s²], inf: none.
    """

    def __init__(
        self,
        start: float,
        velocity: float,
        target: float | None,
        final: float,
        speed: float,
        acceleration: float,
    ) -> None:
        self.final: Final = final
        is_free = speed == inf and acceleration == inf
        self._start = target if is_free and target is not None else start
        self._target = target
        self._pieces: Pieces = ()
        if target is not None and not is_free:
            self._pieces = _to(target - start, velocity, final, speed, acceleration)
        elif target is None and acceleration < inf:
            change = final - velocity
            self._pieces = ((abs(change) / acceleration, velocity, copysign(acceleration, change)),)
        self.duration_s: Final = sum(piece[0] for piece in self._pieces)

    def at(self, time_s: float) -> tuple[float, float]:
        """Return control position and velocity so long after its begin."""
        position = self._start
        if time_s >= self.duration_s and self._target is not None:
            return self._target + self.final * time_s, self.final
        for duration_s, velocity, acceleration in self._pieces:
            spent_s = min(time_s, duration_s)
            position += (velocity + acceleration * spent_s / 2) * spent_s
            if time_s < duration_s:
                return position, velocity + acceleration * spent_s
            time_s -= duration_s
        return position + self.final * time_s, self.final


def _to(way: float, velocity: float, final: float, speed: float, acceleration: float) -> Pieces:
    """Return the pieces over this way to a target that moves with the final velocity."""
    if acceleration == inf:
        side = copysign(1.0, way)
        gain = speed - side * final
        return ((abs(way) / gain if gain > 0 else inf, side * speed, 0.0),) if way else ()
    pieces = []
    if abs(velocity) > speed:
        time_s = (abs(velocity) - speed) / acceleration
        slowing = copysign(acceleration, -velocity)
        pieces.append((time_s, velocity, slowing))
        way += (final - velocity - slowing * time_s / 2) * time_s
        velocity = copysign(speed, velocity)
    lead = velocity - final
    side = 1.0 if way > lead * abs(lead) / (2 * acceleration) else -1.0
    peak = sqrt(max(0.0, acceleration * side * way + lead * lead / 2))
    most = max(0.0, speed - side * final)
    if peak > most:
        rest = side * way - (2 * most * most - lead * lead) / (2 * acceleration)
        cruise = (rest / most if most else inf, final + side * most, 0.0)
        peak = most
    else:
        cruise = (0.0, 0.0, 0.0)
    faster = (max(0.0, peak - side * lead) / acceleration, velocity, side * acceleration)
    slower = (peak / acceleration, final + side * peak, -side * acceleration)
    return (*pieces, faster, cruise, slower)


@final
class Servo:
    """The motor with its current, as position mode and the others drive it.

    Args:
        axis, motor: the motor of the rig.
        ratio: turns of the output per turn of the motor (`rotor_to_output_ratio`).
        gains: kp [N·m/rev] and kd [N·m/(rev/s)]; None: those of the rig's servo.
    """

    def __init__(
        self, axis: Axis, motor: MotorSettings, ratio: float, gains: tuple[float, float] | None
    ) -> None:
        self.axis: Final = axis
        self.tick_ns: Final = motor.tick_ns
        self._turn: Final = motor.plant.encoder_increments_rev
        self.inc: Final = self._turn / ratio  # per turn of the output
        self.constant: Final = motor.plant.torque_constant_n_m_a / ratio  # [N·m/A]
        self.speed_max: Final = (
            motor.plant.supply_v / motor.plant.torque_constant_n_m_a / (2 * pi) * ratio
        )
        own = replace(motor.gains, velocity_feedforward=0.0, acceleration_feedforward_a_s2_inc=0.0)
        if gains is not None:
            kp, kd = gains
            kd_a = kd / (self.constant * self.inc)
            own = replace(own, position_kp_1_s=kp / kd, velocity_kp_a_s_inc=kd_a)
            own = replace(own, velocity_ki_a_inc=0.0)
        self._own = own
        self.axis.set_gains(own)
        self.kp: Final = own.position_kp_1_s * own.velocity_kp_a_s_inc * self.inc * self.constant
        self.kd: Final = own.velocity_kp_a_s_inc * self.inc * self.constant
        self._scales = (1.0, 1.0, 1.0)

    # --- measured

    def position(self) -> float:
        """Return the position [rev]."""
        return self.axis.position_inc() / self.inc

    def velocity(self) -> float:
        """Return the velocity [rev/s]."""
        return self.axis.velocity_inc_s() / self.inc

    def torque(self) -> float:
        """Return the torque of the current [N·m]."""
        return self.axis.current_a() * self.constant

    def power_w(self) -> float:
        """Return the electrical power into the motor [W]."""
        return self.axis.current_a() * self.axis.winding_v()

    def is_saturated(self) -> bool:
        """Return whether the current is at its limit."""
        return bool(self.axis.flags & flags.CURRENT_SATURATED)

    # --- commanded

    def restart(self, knows_turns: bool) -> None:
        """Take the position of the encoder: of the output, or within half a turn of the motor."""
        count = self.axis.count()
        turns = 0 if knows_turns else round(count / self._turn)
        self.axis.set_position(count - turns * self._turn)

    def scale(self, kp: float, kd: float, integral: float) -> None:
        """Multiply the gains; a number that is not finite counts as 0."""
        kp, kd, integral = (one if isfinite(one) else 0.0 for one in (kp, kd, integral))
        if (kp, kd, integral) == self._scales:
            return
        self._scales = (kp, kd, integral)
        own, kd = self._own, max(kd, _LEAST_SCALE)
        scaled = replace(
            own,
            position_kp_1_s=own.position_kp_1_s * kp / kd,
            velocity_kp_a_s_inc=own.velocity_kp_a_s_inc * kd,
            velocity_ki_a_inc=own.velocity_ki_a_inc * integral,
        )
        self.axis.set_gains(scaled)

    def limit(self, torque_n_m: float) -> None:
        """Limit the torque; a number that is not finite, to the most that the drive has."""
        amps = abs(torque_n_m) / self.constant if isfinite(torque_n_m) else inf
        self.axis.set_current_limit(amps)

    def hold(self, position: float, velocity: float, torque_n_m: float) -> None:
        """Control this position until the next call, with this velocity and torque in addition."""
        axis = self.axis
        if not axis.flags & flags.POWERED:
            axis.power(True)
        axis.follow(round(position * self.inc), self.tick_ns, velocity * self.inc)
        axis.feed_current(torque_n_m / self.constant)

    def push(self, amps: float) -> None:
        """Control this current only [A]."""
        self.axis.power(True)
        self.axis.apply_current(amps, inf)

    def damp(self) -> None:
        """Control velocity 0, without a position."""
        self.axis.power(True)
        self.axis.run_at(0.0, _AT_ONCE, _AT_ONCE)

    def short(self) -> None:
        """Brake by a short circuit."""
        self.axis.power(True)
        self.axis.brake(True)

    def release(self) -> None:
        """Switch the current off."""
        self.axis.power(False)
