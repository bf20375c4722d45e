"""Rigs with servos on the host, and the servo's theory."""

import math

from motorhil.emulators.plant.presets import PRESETS
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.trajectory import TrapezoidalTrajectory

WHEEL = PRESETS["wheel_60w"]
INC_PER_RAD = WHEEL.encoder_increments_rev * WHEEL.gear_ratio / (2 * math.pi)
TORQUE_CONSTANT = WHEEL.torque_constant_n_m_a * WHEEL.gear_ratio  # at the output
INERTIA_A_S2_RAD = WHEEL.inertia_kg_m2() * WHEEL.gear_ratio / WHEEL.torque_constant_n_m_a
FRICTION_A = WHEEL.coulomb_friction_n_m / WHEEL.torque_constant_n_m_a
BANDWIDTH = 60.0
VELOCITY_MAX = 3.0
ACCELERATION_MAX = 10.0

NODE = """
[controller.{name}]
kind = "cia401"
bus = "can0"
node_id = {node_id}
channels = {channels}
"""
MOTOR = """
[motor.{name}]
adaptation = "software"
controller = "{controller}"
channel = {channel}
current_per_volt_a_v = {ampere}
torque_constant_n_m_a = {torque}
{motor}
[motor.{name}.gains]
bandwidth_rad_s = {bandwidth}
acceleration_feedforward_a_s2_rad = {inertia}
friction_feedforward_a = {friction}
[motor.{name}.model]
name = "wheel"
velocity_max_rad_s = {velocity}
acceleration_max_rad_s2 = {acceleration}
increments_per_rad = {increments}
{model}
"""


def node(name: str, node_id: int, channels: int = 1, more: str = "") -> str:
    """Return the rig text of an I/O node; `more` may hold further tables of the controller."""
    return NODE.format(name=name, node_id=node_id, channels=channels) + more


def motor(
    name: str,
    controller: str,
    channel: int = 1,
    motor: str = "",
    model: str = "",
    **numbers: float,
) -> str:
    """Return the rig text of a motor on a channel of a node."""
    values = {
        "ampere": WHEEL.current_max_a / 10.0,
        "torque": TORQUE_CONSTANT,
        "bandwidth": BANDWIDTH,
        "inertia": INERTIA_A_S2_RAD,
        "friction": FRICTION_A,
        "velocity": VELOCITY_MAX,
        "acceleration": ACCELERATION_MAX,
        "increments": INC_PER_RAD,
        **numbers,
    }
    return MOTOR.format(
        name=name, controller=controller, channel=channel, motor=motor, model=model, **values
    )


def one(**numbers: object) -> str:
    """Return the rig text of a node with one motor, "left"."""
    return node("io", 1) + motor("left", "io", **numbers)  # type: ignore[arg-type]


def two(**numbers: object) -> str:
    """Return the rig text of two motors on one node, "left" and "right"."""
    left = motor("left", "io", 1, **numbers)  # type: ignore[arg-type]
    return node("io", 1, 2) + left + motor("right", "io", 2, **numbers)  # type: ignore[arg-type]


def enabled(rig: Rig, name: str = "left") -> Motor:
    """Return the motor, enabled and at rest."""
    chosen = rig.motors[name]
    chosen.enable()
    return chosen


def inc(rig: Rig, controller: str = "io", channel: int = 1) -> float:
    """Return the true present count of a channel's encoder."""
    prefix = "" if channel == 1 else f"channel_{channel}_"
    return rig.controllers[controller].snapshot()[f"{prefix}position_inc"]


class SyncTap:
    """The true position at every SYNC: (time, increments of channel 1)."""

    def __init__(self, rig: Rig, controller: str = "io") -> None:
        self.seen: list[tuple[int, float]] = []
        self._rig = rig
        self._controller = controller
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        if frame[:4] == b"\x80\x00\x00\x00":
            self.seen.append((time_ns, inc(self._rig, self._controller)))

    def since(self, time_ns: int) -> list[float]:
        """Return the counts, from the SYNC at this time on."""
        return [count for when, count in self.seen if when >= time_ns]


def lag_bound_inc(acceleration: float = ACCELERATION_MAX, period_s: float = 0.001) -> float:
    """Return the theoretical bound of the following error within these limits [inc].

    With all three poles at b, the error responds to an impulse of torque that changes the velocity
    by dv with at most 0.231 dv / b (maximum of t (1 - b t / 2) exp(-b t)). The impulses come where
    the acceleration steps, from 0 to a and back, or to -a: its feed-forward is late or early by one
    and a half cycles at most. So dv <= 1.5 a T, twice that from a to -a. To this are added one
    increment of the counter, one of its rounding in the demand, and the initial settling of the
    integral: viscous friction, which is not fed forward, divided by kp.
    """
    impulse = 0.231 * 2 * 1.5 * acceleration * period_s / BANDWIDTH
    viscous_a = WHEEL.viscous_friction_n_m_s_rad * VELOCITY_MAX * WHEEL.gear_ratio
    viscous_a /= WHEEL.torque_constant_n_m_a
    learned = viscous_a / (3 * INERTIA_A_S2_RAD * BANDWIDTH**2)
    return (impulse + learned) * INC_PER_RAD + 2.0


def commanded(chosen: Motor, mode: ControlMode, variable: ControlVariable, command) -> Motor:
    chosen.set_control_mode(mode, variable)
    if mode is ControlMode.SETPOINT:
        chosen.set_setpoint(command)
    else:
        chosen.set_trajectory(command)
    chosen.start()
    return chosen


def moving(rig: Rig, name: str = "left", distance: float = 2.0) -> Motor:
    """Start a trajectory, and return 0.2 s later."""
    chosen = enabled(rig, name)
    chosen.set_control_mode(ControlMode.TRAJECTORY)
    chosen.set_trajectory(TrapezoidalTrajectory(distance))
    chosen.start()
    rig.runtime.run_for(0.2)
    return chosen
