"""Gains of a servo on the host, typed and immutable.

Once a cycle, the servo computes the current for the amplifier:

    current = kp e + kd de/dt + integral of ki e dt
              + velocity feed-forward * v + acceleration feed-forward * a + friction, with v's sign

e is demand minus measured position. v and a are the trajectory's demands at the time when the
output acts, one and a half cycles later. U is the motor's unit of position: rad, or m if linear.
"""

from dataclasses import dataclass, fields, replace
from math import isfinite
from typing import Self, final

from motorapi.commands import as_number
from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PidGains:
    """Gains of one motor's servo, all >= 0.

    Attributes:
        kp: current per error [A/U].
        ki: growth of the current per error and time [A/(U s)].
        kd: current per rate of the error [A s/U].
        velocity_feedforward: current per demanded velocity [A s/U], against viscous friction.
        acceleration_feedforward: current per demanded acceleration [A s²/U], for the inertia.
        friction_feedforward: current against dry friction, in the direction of motion [A].
        derivative_filter_s: time constant of a low-pass for de/dt, against quantisation noise [s].

    Raises:
        UsageError: a gain is not a finite number >= 0, or kp is 0.
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    velocity_feedforward: float = 0.0
    acceleration_feedforward: float = 0.0
    friction_feedforward: float = 0.0
    derivative_filter_s: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            given = getattr(self, field.name)
            value = as_number(given)
            if not isfinite(value) or value < 0.0:
                raise UsageError(f"PidGains: {field.name} is {given!r}, not a number >= 0")
            object.__setattr__(self, field.name, value)
        if self.kp == 0.0:
            raise UsageError("PidGains: kp is 0: the servo could not hold the motor")

    @classmethod
    def tuned(
        cls,
        bandwidth_rad_s: float,
        current_per_acceleration: float,
        *,
        friction_a: float = 0.0,
        velocity_feedforward: float = 0.0,
    ) -> Self:
        """Return gains that place all three poles of an inertia under PID control at one point.

        Args:
            bandwidth_rad_s: the magnitude of the poles [rad/s]. At a servo rate f, about f / 16 is
                a good value. Above f / 8 the loop is not stable: sampling and holding cost two
                cycles.
            current_per_acceleration: the current per acceleration of the motor with its load [A
                s²/U].
            friction_a: the current that overcomes dry friction [A].
            velocity_feedforward: see above.

        Raises:
            UsageError: the bandwidth or the inertia is not a number > 0.
        """
        for name, given in (
            ("bandwidth_rad_s", bandwidth_rad_s),
            ("current_per_acceleration", current_per_acceleration),
        ):
            value = as_number(given)
            if not (isfinite(value) and value > 0.0):
                raise UsageError(f"PidGains.tuned: {name} is {given!r}, not a number > 0")
        bandwidth, inertia = float(bandwidth_rad_s), float(current_per_acceleration)
        return cls(
            kp=3.0 * inertia * bandwidth * bandwidth,
            ki=inertia * bandwidth * bandwidth * bandwidth,
            kd=3.0 * inertia * bandwidth,
            acceleration_feedforward=inertia,
            velocity_feedforward=velocity_feedforward,
            friction_feedforward=friction_a,
        )

    def per_increment(self, increments_per_unit: float) -> Self:
        """Return these gains for a servo that counts `increments_per_unit` increments per U."""
        size = abs(increments_per_unit)
        return replace(
            self,
            kp=self.kp / size,
            ki=self.ki / size,
            kd=self.kd / size,
            velocity_feedforward=self.velocity_feedforward / size,
            acceleration_feedforward=self.acceleration_feedforward / size,
        )
