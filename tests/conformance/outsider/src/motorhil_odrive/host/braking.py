"""Stops: the drive moves to the nearest possible position of rest.

The drive uses its own trapezoid, so that it slows down as commanded, then holds, without further
frames. Estop (02h) would be one frame, but it switches the current off, and a coasting motor stops
anywhere.
"""

from math import copysign
from typing import TYPE_CHECKING, Final

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.watch import Rest

if TYPE_CHECKING:
    from motorhil_odrive.host.hardware import OdriveHwMotor
    from motorhil_odrive.host.units import Units

_LEAD_S: Final = 0.004
"""Time until the frames arrive: a target too near would make the motor reverse."""
_STILL: Final = 0.05  # [rev/s]
_NOISE: Final = 0.25  # of an estimate [rev/s]
_FASTER: Final = 1.05


def brake(hardware: "OdriveHwMotor", deceleration: float, units: "Units") -> None:
    """Slow down at `deceleration` [U/s^2], then hold; do not wait."""
    hardware.end_stream()
    if not hardware.heard.is_in(m.CLOSED_LOOP, m.HOMING):
        hardware.heard.follow(None)
        return
    slower = deceleration * abs(units.rev)
    position, velocity = hardware.heard.at(hardware.drive.runtime.now_ns(), slower)
    watch, held = hardware.heard.watch, hardware.held
    rests = watch is None or watch.is_over()
    if held is None or not rests or abs(velocity) > _STILL:
        velocity = _likely(hardware, position, velocity)
        held = position + velocity * _LEAD_S + velocity * abs(velocity) / (2.0 * slower)
    if hardware.heard.is_in(m.HOMING):
        hardware.tell_anyway(m.AXIS_STATE, m.CLOSED_LOOP)
    hardware.tell_anyway(m.TRAJECTORY_VELOCITY, max(abs(velocity) * _FASTER, _STILL))
    hardware.tell_anyway(m.TRAJECTORY_ACCELERATION, slower, slower)
    if not hardware.was_told(m.CONTROLLER_MODE, m.POSITION_CONTROL, m.TRAPEZOID):
        hardware.tell_anyway(m.CONTROLLER_MODE, m.POSITION_CONTROL, m.TRAPEZOID)
    hardware.heard.follow(Rest(hardware.tell_anyway(m.INPUT_POSITION, held, 0.0, 0.0), _STILL))


def _likely(hardware: "OdriveHwMotor", position: float, velocity: float) -> float:
    """Return the likely velocity [rev/s], from the trapezoid if the estimate is mostly noise."""
    told, target = hardware.told(m.TRAJECTORY_VELOCITY), hardware.held
    if told is None or target is None or abs(velocity) > told[0] + _NOISE:
        return velocity
    if abs(velocity) < _NOISE:
        return copysign(min(told[0], _NOISE), target - position)
    return copysign(min(told[0], abs(velocity)), velocity)
