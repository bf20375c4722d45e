"""Servo parameters from objects: current limits, gains and windows."""

from typing import final

from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains


@final
class ServoObjects:
    """Applies the objects to the axis, in every mode and only if they have changed."""

    def __init__(self, axis: Axis, objects: DriveObjects) -> None:
        self._axis = axis
        self._objects = objects
        self._gains: ServoGains = objects.settings.gains  # as set in the axis
        self._limits_a: tuple[float, float] = objects.torque.limits_a()
        axis.set_current_limit(*self._limits_a)
        self.apply_limits_and_gains()

    def apply_limits_and_gains(self) -> None:
        """Apply the current limits (6072h, 60E0h, 60E1h), and 60F6h, 60F9h, 60FBh."""
        limits_a = self._objects.torque.limits_a()
        if limits_a != self._limits_a:
            self._limits_a = limits_a
            self._axis.set_current_limit(limits_a[0], limits_a[1])
        gains = self._objects.control.gains()
        if gains != self._gains:
            self._gains = gains
            self._axis.set_gains(gains)

    def apply_windows(self) -> None:
        """Apply 6065h to 6070h."""
        windows = self._objects.windows.read()
        self._axis.set_windows(
            target_window_inc=windows[0],
            target_window_ns=windows[1],
            following_window_inc=windows[2],
            following_window_ns=windows[3],
            velocity_window_inc_s=windows[4],
            velocity_window_ns=windows[5],
            velocity_threshold_inc_s=windows[6],
            velocity_threshold_ns=windows[7],
        )
