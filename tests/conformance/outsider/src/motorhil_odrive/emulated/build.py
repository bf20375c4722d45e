"""Builder of an emulated ODrive; entry point `motorhil.controllers`, name `odrive`."""

from typing import Final

from motorhil.emulators.api import drive_builder

from motorhil_odrive.emulated.drive import OdriveController
from motorhil_odrive.emulated.settings import OdriveTable

build: Final = drive_builder(OdriveTable, OdriveController, api=1)
