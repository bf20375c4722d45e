"""Assumed drive timing, taken from the emulated drive on request.

This is convenient but risky, like `plant.from_motor_model`: the host's assumption is right by
construction, so that a wrong assumption about the real drive stays hidden. So a rig has to request
it (`timing_from_controller = true`), and a note reports the values taken. Values that the motor
gives itself take precedence.
"""

from collections.abc import Mapping
from typing import Final

from emulators.cia402.drive import Cia402Drive
from emulators.cia402.quirky_wire import QuirkyWire
from emulators.cia402.settings import DriveSettings
from emulators.controller import Controller
from emulators.firmware.late_wakes import LateWakes
from emulators.firmware.own_time import OwnTime
from harness.rig_file import MotorDescription, RigDescription

ASKED: Final = "timing_from_controller"
_KIND: Final = "cia402"


def with_timing(
    description: RigDescription, motor: MotorDescription, controller: Controller | None
) -> tuple[dict[str, object], str]:
    """Return the motor's settings completed from its emulated drive, and a note about it.

    Args:
        description: the rig.
        motor: one of its motors.
        controller: its emulated controller, if the rig has one.

    Raises:
        RigError: there is no suitable drive, or the key is not true or false.
    """
    settings = {key: value for key, value in motor.settings.items() if key != ASKED}
    asked = motor.settings.get(ASKED, False)
    path = ("motor", motor.name, ASKED)
    if not isinstance(asked, bool):
        raise description.error(path, f"must be true or false, but is {asked!r}", f"{ASKED} = true")
    if not asked:
        return settings, ""
    core = controller
    while isinstance(core, OwnTime | LateWakes | QuirkyWire):
        core = core.inner
    if motor.adaptation != _KIND or motor.controller is None or not isinstance(core, Cia402Drive):
        raise description.error(
            path, "its controller is not an emulated CiA 402 drive of this rig", "take it out"
        )
    table = description.controllers[motor.controller].settings.get("oscillator")
    numbers = _numbers(core.settings, table if isinstance(table, Mapping) else {})
    taken = {key: value for key, value in numbers.items() if key not in settings}
    told = ", ".join(f"{key} = {value:g}" for key, value in taken.items())
    line = description.source.line(path)
    note = (
        f"{description.source.path}:{line}: motor.{motor.name}: {told or 'nothing'} taken from"
        f' controller "{motor.controller}": a mistake in it is on both sides'
    )
    return {**settings, **taken}, note


def _numbers(drive: DriveSettings, oscillator: Mapping[str, object]) -> dict[str, float]:
    """Return the host's assumptions; for a random clock error, its limit."""
    ppm = abs(drive.oscillator.error_1e12) / 1e6
    ppm_max = oscillator.get("ppm_max")
    if isinstance(ppm_max, int | float):
        ppm = float(ppm_max)
    return {
        "servo_period_ms": drive.tick_ns / 1e6,
        "oscillator_ppm": ppm,
        "sdo_reply_ms": drive.sdo_reply_ns / 1e6 / (1.0 - ppm * 1e-6),
    }
