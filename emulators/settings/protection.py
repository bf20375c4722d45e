"""Protection settings of a drive in a rig: the table `protection`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.controller import SettingError
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.settings.tables import number, refuse_unknown, whole

STO_REACTIONS: Final = ("disable", "fault")
STO_ERROR: Final = 0x8A88
TEMPERATURE_RANGE_C: Final = (-273.15, 1000.0)
PROTECTION_KEYS: Final = (
    *("sto", "sto_error_code"),
    *("device_temperature_warning_c", "device_temperature_max_c"),
    *("winding_temperature_warning_c", "winding_temperature_max_c"),
    *("over_voltage_v", "under_voltage_v", "i2t_warning"),
)
VOLTAGE_RANGE_V: Final = (0.0, 1e6)
OVER_VOLTAGE: Final = 1.25  # of the supply's own voltage
UNDER_VOLTAGE: Final = 0.7
_WINDING_KEYS: Final = ("winding_temperature_warning_c", "winding_temperature_max_c")
_VOLTAGE_KEYS: Final = ("over_voltage_v", "under_voltage_v")
_PATH: Final = ("protection",)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ProtectionSettings:
    """Thresholds and the vendor's choices.

    Attributes:
        sto_error_code: error code of the fault on safe torque off; 0: it only disables.
        device_temperature_warning_c, device_temperature_max_c: of the power electronics.
        winding_temperature_warning_c, winding_temperature_max_c: of the motor, by its model.
        over_voltage_v, under_voltage_v: of the DC link.
        i2t_warning: fill level of the I2t integrator for a warning, 0..1; full is a fault.
    """

    sto_error_code: int = 0
    device_temperature_warning_c: float = 75.0
    device_temperature_max_c: float = 85.0
    winding_temperature_warning_c: float = 110.0
    winding_temperature_max_c: float = 125.0
    over_voltage_v: float = 30.0
    under_voltage_v: float = 16.8
    i2t_warning: float = 0.8


DEFAULT_PROTECTION: Final = ProtectionSettings()


def protection_of(table: Mapping[str, object], plant: MotorPlant) -> ProtectionSettings:
    """Read the settings from a table `protection` of a drive with this plant.

    Raises:
        SettingError: a key is unknown, a value is wrong, or the plant lacks the quantity.
    """
    refuse_unknown(table, PROTECTION_KEYS, _PATH)
    reaction = table.get("sto", "disable")
    if reaction not in STO_REACTIONS:
        known = " or ".join(f'"{one}"' for one in STO_REACTIONS)
        raise SettingError((*_PATH, "sto"), f"{reaction!r} is not a reaction", f"write {known}")
    code = whole(table.get("sto_error_code", STO_ERROR), (*_PATH, "sto_error_code"), 0x1000, 0xFFFF)
    if reaction == "disable" and "sto_error_code" in table:
        raise SettingError(
            (*_PATH, "sto_error_code"),
            "has no effect, because sto is not a fault",
            'write sto = "fault", too',
        )
    _refuse_idle(table, plant)
    own = DEFAULT_PROTECTION
    over_v = _volts(table, "over_voltage_v", OVER_VOLTAGE * plant.supply_v)
    under_v = _volts(table, "under_voltage_v", UNDER_VOLTAGE * plant.supply_v)
    if under_v >= over_v:
        key = "under_voltage_v" if "under_voltage_v" in table else "over_voltage_v"
        message = f"under-voltage at {under_v:g} V is not below over-voltage at {over_v:g} V"
        raise SettingError((*_PATH, key), message, f"the supply's own is {plant.supply_v:g} V")
    device_c = _temperatures(
        table, "device", own.device_temperature_warning_c, own.device_temperature_max_c
    )
    winding_c = _temperatures(
        table, "winding", own.winding_temperature_warning_c, own.winding_temperature_max_c
    )
    return ProtectionSettings(
        sto_error_code=code if reaction == "fault" else 0,
        device_temperature_warning_c=device_c[0],
        device_temperature_max_c=device_c[1],
        winding_temperature_warning_c=winding_c[0],
        winding_temperature_max_c=winding_c[1],
        over_voltage_v=over_v,
        under_voltage_v=under_v,
        i2t_warning=number(
            table.get("i2t_warning", own.i2t_warning), (*_PATH, "i2t_warning"), 0, 1
        ),
    )


def _refuse_idle(table: Mapping[str, object], plant: MotorPlant) -> None:
    """Refuse a threshold of a quantity that the plant lacks; it would never be reached."""
    extras = plant.extras
    for keys, has, remedy in (
        (_WINDING_KEYS, extras.has_heat(), "thermal_resistance_winding_housing_k_w and others"),
        (_VOLTAGE_KEYS, extras.is_any(), "source_resistance_ohm"),
        (("i2t_warning",), extras.has_i2t(), "i2t_continuous_a, i2t_peak_a and i2t_peak_s"),
    ):
        for key in keys:
            if key in table and not has:
                message = "the plant does not model this quantity"
                raise SettingError((*_PATH, key), message, f"give the plant {remedy}")


def _temperatures(
    table: Mapping[str, object], whose: str, warning_c: float, max_c: float
) -> tuple[float, float]:
    """Return the temperatures for a warning and for a fault."""
    key = f"{whose}_temperature_warning_c"
    warning_c = _celsius(table, key, warning_c)
    max_c = _celsius(table, f"{whose}_temperature_max_c", max_c)
    if warning_c > max_c:
        message = f"{warning_c:g} C is above the maximum, {max_c:g} C"
        raise SettingError((*_PATH, key), message, f"{key} = {max_c:g} at most")
    return warning_c, max_c


def _celsius(table: Mapping[str, object], key: str, default_c: float) -> float:
    return number(table.get(key, default_c), (*_PATH, key), *TEMPERATURE_RANGE_C)


def _volts(table: Mapping[str, object], key: str, default_v: float) -> float:
    return number(table.get(key, default_v), (*_PATH, key), *VOLTAGE_RANGE_V)
