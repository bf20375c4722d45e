"""Start of a motion, from arming to the frame that triggers it."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.api import (
    ControlVariable,
    Motion,
    Ramps,
    SentFrame,
    SetpointStream,
    demand_of,
)

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.watch import Arrival, Reached

if TYPE_CHECKING:
    from motorhil.motorapi.api import BoundFence, MotorModel

    from motorhil_odrive.host.hardware import OdriveHwMotor
    from motorhil_odrive.host.units import Units

_HEADROOM: Final = 1.1
"""Factor on the drive's velocity limit: a loop at its limit would never catch up."""


@final
class Start:
    """The trigger of one motion."""

    def __init__(
        self, hardware: "OdriveHwMotor", units: "Units", motion: Motion, model: "MotorModel"
    ) -> None:
        self.hardware = hardware
        self.units = units
        self.motion = motion
        self.model = model

    def fire(self) -> None:
        """Start the motion; return when its start is on the bus."""
        if self.motion.variable is ControlVariable.POSITION:
            self._go()
        else:
            self._run()

    def _go(self) -> None:
        hardware = self.hardware
        target = self.motion.target * self.units.rev
        estimate = hardware.heard.estimate
        assert estimate is not None  # connected before
        sent = hardware.tell(m.INPUT_POSITION, target, 0.0, 0.0)
        window = hardware.options.position_window_rev
        hardware.heard.follow(Arrival(sent, target, window, estimate.position))
        hardware.drive.confirm(sent)

    def _run(self) -> None:
        hardware, motion = self.hardware, self.motion
        is_velocity = motion.variable is ControlVariable.VELOCITY
        message = m.INPUT_VELOCITY if is_velocity else m.INPUT_TORQUE
        control = m.VELOCITY_CONTROL if is_velocity else m.TORQUE_CONTROL
        scale = self.units.of(motion.variable)
        goes_on = hardware.was_told(m.CONTROLLER_MODE, control, m.PASSTHROUGH)
        last = hardware.stream.last if goes_on and hardware.stream is not None else None
        before = 0.0 if last is None else last
        value, duration_s = profile(motion, before / scale)
        window = self.model.velocity_max * hardware.options.velocity_window * abs(scale)
        watch = Reached(motion.target * scale if is_velocity else None, window)
        hardware.end_stream()

        def send(setpoint: float, fence: "BoundFence | None" = None) -> SentFrame:
            values = (setpoint, 0.0) if is_velocity else (setpoint,)
            return hardware.tell(message, *values, fence=fence)

        if not goes_on:  # the input first: it is valid from the change of mode on
            send(value(0.0) * scale)
            hardware.tell(m.CONTROLLER_MODE, control, m.PASSTHROUGH)
        period_s = hardware.options.stream_period_ms / 1e3
        stream = hardware.stream = SetpointStream(
            hardware.drive, lambda s: value(s) * scale, duration_s, period_s, send, watch.arrive
        )
        hardware.heard.follow(watch)
        watch.sent = stream.begin()
        hardware.drive.confirm(watch.sent)


def prepare(start: Start) -> None:
    """Send all settings of the motion, and wait until they are on the bus; nothing moves."""
    hardware, motion, units = start.hardware, start.motion, start.units
    size = abs(units.rev)
    sent = []
    if start.model.current_max is not None:
        velocity = start.model.velocity_max * size * _HEADROOM
        sent.append(hardware.push(m.LIMITS, velocity, start.model.current_max))
    if motion.variable is ControlVariable.POSITION:
        hardware.end_stream()
        sent += [
            hardware.push(m.TRAJECTORY_VELOCITY, motion.velocity * size),
            hardware.push(
                m.TRAJECTORY_ACCELERATION, motion.acceleration * size, motion.deceleration * size
            ),
            hardware.push(m.CONTROLLER_MODE, m.POSITION_CONTROL, m.TRAPEZOID),
        ]
    last = next((one for one in reversed(sent) if one is not None), None)
    if last is not None:
        hardware.drive.confirm(last)


def profile(motion: Motion, before: float) -> tuple[Callable[[float], float], float]:
    """Return a ramp's value over the time since the start [s], and its end time [s]."""
    if motion.trajectory is not None:
        demand = demand_of(motion)
        return demand.value, demand.final_argument
    growing, shrinking = motion.slope, motion.slope
    if motion.variable is ControlVariable.VELOCITY:
        growing, shrinking = motion.acceleration, motion.deceleration
    ramps = Ramps(before, motion.target, growing, shrinking)

    def value(at_s: float) -> float:
        on_ramp = ramps.at(at_s)
        return motion.target if on_ramp is None else on_ramp[0]

    return value, ramps.duration_s
