"""The logical motor of a drive on CAN that makes no profiles: `StreamedMotion` and the hooks.

An adaptation derives its motor, and adds units, power and the reset of a fault. Its hardware object
sends single set-points.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from motorhil.motorapi.api.can_motor import CanMotor
from motorhil.motorapi.api.streamed_motion import can_stream, require_time
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotorBusyError

if TYPE_CHECKING:
    from motorhil.motorapi.api.can_drive import CanDrive
    from motorhil.motorapi.api.streamed_motion import StreamedMotion
    from motorhil.motorapi.commands import Setpoint
    from motorhil.motorapi.motion import Motion
    from motorhil.motorapi.ownership.fencing import BoundFence
    from motorhil.motorapi.runtime.can_link import Transmission
    from motorhil.motorapi.state import Fault, Measurement
    from motorhil.motorapi.synchronization.quality import MotionTimes
    from motorhil.motorapi.trajectory import Trajectory

_SUPPORTED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY, ControlVariable.CURRENT)


class StreamedHardware(Protocol):
    """The hardware object of such a drive; values in units of the drive."""

    @property
    def drive(self) -> "CanDrive":
        """Its connection."""

    @property
    def motions(self) -> "StreamedMotion":
        """The motion that is streamed to it."""

    @property
    def fault(self) -> "Fault | None":
        """Its fault until it is reset, or None."""

    def connect(self) -> None:
        """Wait until the drive is heard; free if it is."""

    def measurement(self, units: float) -> "Measurement | None":
        """Return the last measurement, with so many units of the drive per unit of the model."""

    def measured(self) -> tuple[float, float]:
        """Return position and velocity, extrapolated to the present."""

    def send(
        self, variable: ControlVariable, value: float, fence: "BoundFence | None"
    ) -> "Transmission":
        """Send a set-point, only while this program owns the motor."""

    def stop_anyway(self) -> object:
        """Stop by one frame, whoever owns the motor."""

    def forget(self) -> None:
        """Forget what the drive was told."""


HardwareT = TypeVar("HardwareT", bound=StreamedHardware)


class StreamedMotor(CanMotor[HardwareT]):
    """A logical motor whose motions the host streams; see `CanMotor`."""

    def _latest(self) -> "Measurement | None":
        return self.hardware.measurement(self._units)

    def _scale(self, variable: ControlVariable) -> float:
        """Return units of the drive per unit of this variable."""
        return 1.0 if variable is ControlVariable.CURRENT else self._units

    def _hold(self) -> None:
        """Hold the present position; return when the command is on the bus."""
        hardware = self.hardware
        sender = partial(hardware.send, ControlVariable.POSITION)
        hardware.drive.confirm(hardware.motions.hold(hardware.measured(), sender))

    def _rounded(self, motion: "Motion", steps: float) -> "Motion":
        """Return the motion with its target on the drive's grid of so many steps per unit.

        A motion that starts within the same step has no way at all.
        """
        target = round(motion.target * steps)
        if motion.variable is ControlVariable.POSITION and target == round(motion.start * steps):
            return replace(motion, target=motion.start)
        return replace(motion, target=target / steps)

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable in _SUPPORTED

    def _check_command(self, variable: ControlVariable, command: "Setpoint | Trajectory") -> None:
        if not can_stream(variable, command):
            super()._check_command(variable, command)

    def _command(self, motion: "Motion") -> None:
        require_time(self.name, motion)
        hardware, variable = self.hardware, motion.variable
        sender = partial(hardware.send, variable)
        scale = self._scale(variable)
        hardware.drive.confirm(hardware.motions.start(motion, scale, hardware.measured(), sender))

    def _stop(self) -> None:
        hardware = self.hardware
        if hardware.motions.variable is None:
            if hardware.drive.foreign_token() or not self._rests():
                hardware.stop_anyway()
            return
        slower = self._physical.stop_deceleration(self.model.deceleration) * abs(self._units)
        sender = partial(hardware.send, ControlVariable.POSITION)
        try:
            hardware.motions.stop(slower, hardware.measured(), sender)
        except MotorBusyError:  # another program has the motor
            hardware.stop_anyway()

    def _rests(self) -> bool:
        """Return True if a motor that nobody commands need not be stopped."""
        latest = self._latest()
        return latest is None or not latest.velocity

    def _motion_times(self) -> "MotionTimes | None":
        return self.hardware.motions.times()

    def _read_fault(self) -> "Fault | None":
        return self.hardware.fault

    def _read_reference(self) -> float:
        hardware = self.hardware
        if hardware.motions.variable is not ControlVariable.POSITION:
            return self._read_position()
        position, _ = hardware.motions.now(ControlVariable.POSITION, hardware.measured())
        return position / self._units

    def _is_done(self) -> bool:
        motions = self.hardware.motions
        is_over = super()._is_done()
        if motions.error is not None:
            raise motions.error
        return is_over and not motions.is_going

    def _open_low_level(self) -> HardwareT:
        self.hardware.motions.forget()
        return super()._open_low_level()

    def _close_low_level(self) -> None:
        self.hardware.forget()
