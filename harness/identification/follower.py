"""An emulated drive that follows a recorded motion, and tells what its plant lacks.

The drive of `emulators.firmware` runs in impedance control. It feeds the recorded effort forward,
and pulls its plant to the recorded positions with a spring and a damper. If the plant is that of
the recording, it needs no pull. Otherwise the pull is the effort that the plant does not explain,
low-passed by the drive's loop. This is an output error: the plant runs forwards, with standstill,
backlash and elasticity as the emulator has them, and no position is differentiated.

Efforts are divided by the inertia from which the search starts, so that one encoder and one
amplifier suit every plant. The amplifier is nearly ideal: it adds no inertia and no delay.
"""

from collections.abc import Mapping
from math import atan2, hypot
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.nonlinear import NO_EXTRAS, PlantExtras
from motorhil.frozen import frozen
from motorhil.harness.identification.inverse_model import GRAVITY
from motorhil.harness.identification.samples import Samples

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray
    from scipy.interpolate import CubicSpline

LOOP_RAD_S: Final = 60.0
"""Natural frequency of the drive's loop; more for motions that are faster, such as chirps."""
_LOOP_SAMPLES: Final = 0.25  # the most of the loop's angle in one period of the recording
_DAMPING: Final = 0.7
_TICK_RAD: Final = 0.12  # of the loop's angle in one period of the drive
_STEPS: Final = 10
_INCREMENTS: Final = 1 << 31
_SUPPLY_V: Final = 1e6
_CURRENT_A: Final = 1e6
_BRAKED: Final = 1e-6  # share of the inertia that back-EMF may seem to add
_WINDING: Final = 0.05  # its time constant, as a share of a step of the current loop
_LAG_STEPS: Final = 0.5  # of the current loop, which reaches its demand in one step


@final
@frozen
class Motion:
    """A recorded motion at the ticks of the drive that follows it.

    Attributes:
        tick_ns: period of the drive.
        loop_rad_s: natural frequency of the loop that pulls the plant to the positions.
        position: at the output, shape (n,) [rad or m].
        effort: at the output, divided by `inertia`, shape (n,) [rad/s^2 or m/s^2].
        inertia: the inertia that efforts are divided by, at the output [kg m^2 or kg].
    """

    tick_ns: int
    loop_rad_s: float
    position: "NDArray[float64]"
    effort: "NDArray[float64]"
    inertia: float

    @property
    def tick_s(self) -> float:
        """The period of the drive [s]."""
        return self.tick_ns / 1e9


def motion_of(samples: Samples, inertia: float, loop_rad_s: float = LOOP_RAD_S) -> Motion:
    """Return the motion at the drive's ticks: averaged if it is faster, interpolated if slower.

    Args:
        samples: the recording.
        inertia: the inertia that efforts are divided by, at the output [kg m^2 or kg].
        loop_rad_s: natural frequency of the loop; lower if the samples need that.
    """
    position, effort, period = samples.position, samples.effort / inertia, samples.period_s
    loop_rad_s = min(loop_rad_s, _LOOP_SAMPLES / samples.period_s)
    shortest_s = _TICK_RAD / loop_rad_s
    together = round(shortest_s / period)
    apart = 1 if period < 1.5 * shortest_s else 2
    if together > 1:
        count = len(position) // together
        position, effort = (
            one[: count * together].reshape(count, together).mean(axis=1)
            for one in (position, effort)
        )
        period *= together
    tick_ns = round(period * 1e9 / apart / _STEPS) * _STEPS
    if apart > 1:
        times = np.arange(len(position)) * period
        ticks = np.arange(apart * (len(times) - 1) + 1) * (period / apart)
        position, effort = (_spline(times, one)(ticks) for one in (position, effort))
    return Motion(tick_ns, loop_rad_s, position, effort, inertia)


def plant_of(motion: Motion, values: Mapping[str, float]) -> MotorPlant:
    """Return the plant that the drive has, divided by the motion's inertia.

    Args:
        motion: the motion that it is to follow.
        values: parameters of the inverse model at the output.
    """
    step_s = motion.tick_s / _STEPS
    resistance = step_s / _BRAKED
    return MotorPlant(
        resistance_ohm=resistance,
        inductance_h=resistance * step_s * _WINDING,
        torque_constant_n_m_a=1.0,
        rotor_inertia_kg_m2=values["inertia"] / motion.inertia,
        encoder_increments_rev=_INCREMENTS,
        supply_v=_SUPPLY_V,
        current_max_a=_CURRENT_A,
        coulomb_friction_n_m=values["coulomb"] / motion.inertia,
        viscous_friction_n_m_s_rad=values["viscous"] / motion.inertia,
        load_torque_n_m=values["offset"] / motion.inertia,
        extras=pendulum_of(values, motion.inertia),
    )


def pendulum_of(values: Mapping[str, float], divisor: float = 1.0) -> PlantExtras:
    """Return the gravity of a plant with these parameters, divided; none: no effects at all."""
    sine, cosine = (values.get(name, 0.0) for name in GRAVITY)
    if not sine and not cosine:
        return NO_EXTRAS
    return PlantExtras(
        gravity_torque_n_m=hypot(sine, cosine) / divisor, gravity_zero_rad=atan2(-cosine, sine)
    )


def pull_of(motion: Motion, plant: MotorPlant, delay_s: float) -> "NDArray[float64]":
    """Return the effort that the drive adds to the recorded one, shape (n,), as in `motion`.

    Args:
        motion: the recorded motion.
        plant: the plant of the drive, by `plant_of`.
        delay_s: how much later than the positions the efforts are recorded.
    """
    tick_s, loop = motion.tick_s, motion.loop_rad_s
    per_rad = plant.increments_per_rad()
    stiffness = loop * loop / per_rad
    damping = 2.0 * _DAMPING * loop / per_rad
    fed: list[float] = _fed(motion, delay_s).tolist()
    wanted: list[float] = (motion.position * per_rad).tolist()
    # The drive's velocity is that of the last tick, by a central difference: so is this one.
    speeds = np.zeros(len(wanted))
    speeds[2:] = (motion.position[2:] - motion.position[:-2]) * (per_rad / 2.0 / tick_s)
    gains = ServoGains(
        position_kp_1_s=0.0,
        velocity_kp_a_s_inc=0.0,
        velocity_ki_a_inc=0.0,
        current_kp_v_a=plant.resistance_ohm,
        current_ki_v_a_s=plant.resistance_ohm * _STEPS / tick_s,
    )
    axis = Axis(plant, gains, motion.tick_ns, _STEPS, int(wanted[0]))
    axis.power(True)
    pull = np.zeros(len(wanted))
    for tick, (position, speed, effort) in enumerate(
        zip(wanted[1:], speeds.tolist()[1:], fed[1:], strict=True), start=1
    ):
        axis.follow_impedance(position, speed, stiffness, damping, effort)
        axis.at(tick * motion.tick_ns)
        pull[tick] = axis.current_demand_a() - effort
    return pull


def _fed(motion: Motion, delay_s: float) -> "NDArray[float64]":
    """Return the mean effort of each tick to come, for which the drive holds it."""
    times = np.arange(len(motion.effort) + 1) * motion.tick_s
    total = _spline(times[:-1], motion.effort).antiderivative()
    ahead_s = _LAG_STEPS / _STEPS * motion.tick_s + delay_s
    at = np.clip(times + ahead_s, 0.0, times[-2])
    fed: NDArray[float64] = np.diff(total(at)) / motion.tick_s
    return fed


def _spline(times: "NDArray[Any]", values: "NDArray[float64]") -> "CubicSpline":
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, values)
