"""Builder of an ODrive motor; entry point `motorhil.adaptations`, name `odrive`."""

from typing import Final

from motorhil.motorapi.api import CanBuilder, adaptation

from motorhil_odrive.host.hardware import OdriveHwMotor
from motorhil_odrive.host.motor import OdriveMotor
from motorhil_odrive.host.options import OdriveMotorTable

build: Final = adaptation(api=1, rig="../rig.toml")(
    CanBuilder(OdriveMotorTable, OdriveHwMotor, OdriveMotor)
)
