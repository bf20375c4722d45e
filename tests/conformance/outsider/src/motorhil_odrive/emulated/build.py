"""Builder of an emulated ODrive; entry point `motorhil.controllers`, name `odrive`."""

from collections.abc import Mapping

from motorhil.emulators.api import Controller, ControllerContext, controller, on_own_time

from motorhil_odrive.emulated.drive import OdriveController
from motorhil_odrive.emulated.settings import read_settings


@controller(api=1)
def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive from its table in a rig.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: its name, and the run's seed.

    Raises:
        SettingError: a key or value is wrong; names the keys.
    """
    read = read_settings(settings, context)
    clock = read.motor.oscillator
    events = [] if clock.is_ideal() else [("info", clock.told())]
    return on_own_time(OdriveController(read, events), clock)
