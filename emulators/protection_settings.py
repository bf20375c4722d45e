"""What a rig may say about how a drive protects itself: the table `protection`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

from emulators.controller import SettingError
from emulators.setting_tables import number, refuse_unknown, whole

STO_REACTIONS: Final = ("disable", "fault")
STO_ERROR: Final = 0x8A88
TEMPERATURE_RANGE_C: Final = (-273.15, 1000.0)
PROTECTION_KEYS: Final = (
    *("sto", "sto_error_code"),
    *("device_temperature_warning_c", "device_temperature_max_c"),
)
_PATH: Final = ("protection",)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ProtectionSettings:
    """Thresholds and vendor's choices.

    Attributes:
        sto_error_code: of the fault that safe torque off is; 0: it only disables.
        device_temperature_warning_c, device_temperature_max_c: of the power electronics.
    """

    sto_error_code: int = 0
    device_temperature_warning_c: float = 75.0
    device_temperature_max_c: float = 85.0


DEFAULT_PROTECTION: Final = ProtectionSettings()


def protection_of(table: Mapping[str, object]) -> ProtectionSettings:
    """The settings in a table `protection`.

    Raises:
        SettingError: a key is unknown, or a value is wrong.
    """
    refuse_unknown(table, PROTECTION_KEYS, _PATH)
    reaction = table.get("sto", "disable")
    if reaction not in STO_REACTIONS:
        known = " or ".join(f'"{one}"' for one in STO_REACTIONS)
        raise SettingError((*_PATH, "sto"), f"{reaction!r} is no reaction", f"write {known}")
    code = whole(table.get("sto_error_code", STO_ERROR), (*_PATH, "sto_error_code"), 0x1000, 0xFFFF)
    if reaction == "disable" and "sto_error_code" in table:
        raise SettingError(
            (*_PATH, "sto_error_code"), "there is no fault to tell", 'write sto = "fault", too'
        )
    own = DEFAULT_PROTECTION
    warning_c = _celsius(table, "device_temperature_warning_c", own.device_temperature_warning_c)
    max_c = _celsius(table, "device_temperature_max_c", own.device_temperature_max_c)
    if warning_c > max_c:
        key = "device_temperature_warning_c"
        raise SettingError((*_PATH, key), f"{warning_c} C is above the maximum, {max_c} C", "lower")
    return ProtectionSettings(
        sto_error_code=code if reaction == "fault" else 0,
        device_temperature_warning_c=warning_c,
        device_temperature_max_c=max_c,
    )


def _celsius(table: Mapping[str, object], key: str, default_c: float) -> float:
    return number(table.get(key, default_c), (*_PATH, key), *TEMPERATURE_RANGE_C)
