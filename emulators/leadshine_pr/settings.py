"""Settings of a PR-mode drive in a rig."""

from typing import final

from motorhil.emulators.modbus.settings import ModbusDriveTable
from motorhil.frozen import frozen


@final
@frozen(kw_only=True, slots=False)
class LeadshineTable(ModbusDriveTable):
    """A PR-mode drive (Leadshine) on a Modbus line."""
