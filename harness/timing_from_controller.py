"""A motor's assumptions on its drive's timing out of the emulated drive's table, when asked for.

Convenient, and a trap as `plant.from_motor_model` is: what the host assumes is then right by
construction, and a wrong assumption about the real drive stays hidden. So a rig has to ask for it
(`timing_from_controller = true`), what was taken is told, and what the motor says itself counts
more.
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
    """The motor's settings with what its emulated drive knows, and a note that tells it.

    Args:
        description: the rig.
        motor: one of its motors.
        controller: the emulated one behind it, if the rig has it.

    Raises:
        RigError: it asks for it, and there is no such drive; or it does not say true or false.
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
            path, "its controller is no emulated CiA 402 drive of this rig", "take it out"
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
    """What a host may assume; of a clock that is drawn within limits, the limit."""
    ppm = abs(drive.oscillator.error_1e12) / 1e6
    ppm_max = oscillator.get("ppm_max")
    if isinstance(ppm_max, int | float):
        ppm = float(ppm_max)
    return {
        "servo_period_ms": drive.tick_ns / 1e6,
        "oscillator_ppm": ppm,
        "sdo_reply_ms": drive.sdo_reply_ns / 1e6 / (1.0 - ppm * 1e-6),
    }
