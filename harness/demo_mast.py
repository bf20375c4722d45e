"""The demo's mast on Modbus: two PR-mode drives on a serial line.

They replace the CAN drives of pan and tilt.
"""

from typing import TYPE_CHECKING, Final

from harness.rig_file import Known, parse_rig
from harness.settings import RigError, Source
from harness.toml_text import with_table

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

MASTS: Final = ("can", "modbus")
LINE: Final = "rs485"
_UNITS: Final = {"pan": 1, "tilt": 2}
_LINE: Final = f"""
[bus.{LINE}]
kind = "modbus_rtu"
baud_bit_s = 115_200
parity = "N"
"""
_ON_CAN: Final = ("kind", "bus", "node_id", "adaptation", "servo_period_ms", "oscillator_ppm")


def with_modbus_mast(description: "RigDescription", known: Known) -> "RigDescription":
    """Return the rig with pan and tilt on a serial line; nothing else differs.

    The rig's text is changed accordingly, because a recording contains the text of the rig that
    ran.

    Raises:
        RigError: the rig has no such drives.
    """
    path, text = description.source.path, description.source.text
    for name, unit in _UNITS.items():
        controller = description.controllers.get(name)
        if controller is None or controller.kind != "cia402":
            problem = f"{name} is not a separate CiA 402 drive"
            raise RigError(path, problem, "use --mast with --rig rover")
        drive = f'kind = "leadshine_pr"\nbus = "{LINE}"\nunit = {unit}\n'
        text = with_table(text, f"controller.{name}", drive, _ON_CAN)
        text = with_table(text, f"motor.{name}", 'adaptation = "leadshine"\n', _ON_CAN)
    source = Source(path, text + _LINE)
    return parse_rig(source, known)
