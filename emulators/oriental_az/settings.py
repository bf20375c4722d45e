"""Settings of an AZ drive in a rig."""

from dataclasses import replace
from typing import final

from motorhil.emulators.modbus.settings import ModbusDriveSettings, ModbusDriveTable
from motorhil.frozen import frozen
from motorhil.settings import flag


@final
@frozen(kw_only=True, slots=False)
class OrientalTable(ModbusDriveTable):
    """An AZ drive (Oriental Motor) with direct data operation on a Modbus line."""

    trigger_auto_clear: bool = flag(True, "The drive resets its trigger after each operation.")

    def settings(self, stream: str) -> ModbusDriveSettings:
        """Return the settings of the drive; random clock values come from `stream`."""
        return replace(super().settings(stream), trigger_auto_clear=self.trigger_auto_clear)
