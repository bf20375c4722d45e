"""Protection settings of a drive in a rig: the table `protection`."""

from dataclasses import fields
from typing import Any, ClassVar, Final, final

from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.frozen import frozen
from motorhil.settings import Rule, SettingError, number, whole, word

STO_ERROR: Final = 0x8A88
TEMPERATURE_RANGE_C: Final = (-273.15, 1000.0)
OVER_VOLTAGE: Final = 1.25  # of the supply's own voltage
UNDER_VOLTAGE: Final = 0.7
_PATH: Final = ("protection",)


@final
@frozen(kw_only=True)
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


def _celsius(default_c: float | None, doc: str) -> Any:
    return number(default_c, *TEMPERATURE_RANGE_C, "C", doc, plausible=(20.0, 250.0))


@final
@frozen(kw_only=True, slots=False)
class ProtectionTable:
    """When the drive disables itself, and how."""

    sto: str = word(
        "disable",
        ("disable", "fault"),
        "reaction",
        "Reaction to safe torque off: the drive is only disabled, or has a fault.",
    )
    sto_error_code: int = whole(STO_ERROR, 0x1000, 0xFFFF, "", "Error code of that fault.")
    device_temperature_warning_c: float = _celsius(75.0, "From here on statusword bit 7 is set.")
    device_temperature_max_c: float = _celsius(85.0, "From here on it is a fault, 4210h.")
    winding_temperature_warning_c: float | None = _celsius(
        None, "From here on the drive warns, if the plant has a thermal model; absent: 110 C."
    )
    winding_temperature_max_c: float | None = _celsius(
        None, "From here on it is a fault, 4310h; absent: 125 C."
    )
    over_voltage_v: float | None = number(
        None,
        0.0,
        1e6,
        "V",
        "DC link voltage of fault 3210h; absent: 1.25 times supply_v.",
        plausible=(1.0, 1500.0),
    )
    under_voltage_v: float | None = number(
        None,
        0.0,
        1e6,
        "V",
        "DC link voltage below which, with motor current, it is fault 3220h; absent: 0.7 times"
        " supply_v.",
        plausible=(0.5, 1000.0),
    )
    i2t_warning: float | None = number(
        None,
        0,
        1,
        "",
        "Fill level of the I2t integrator for a warning, if the plant has an I2t model; full is"
        " fault 2310h. Absent: 0.8.",
    )

    RULES: ClassVar = (
        Rule(
            "sto",
            ("fault",),
            otherwise=True,
            refused=("sto_error_code",),
            message="has no effect, because sto is not a fault",
            remedy='write sto = "fault", too',
        ),
    )


def protection_of(table: ProtectionTable, plant: MotorPlant) -> ProtectionSettings:
    """Return the protection of a drive with this plant.

    Raises:
        SettingError: two values do not go together, or the plant lacks the quantity.
    """
    _refuse_idle(table, plant)
    usual_v = {"over_voltage_v": OVER_VOLTAGE, "under_voltage_v": UNDER_VOLTAGE}
    values: dict[str, Any] = {}
    for one in fields(ProtectionSettings):
        value = getattr(table, one.name)
        if value is None:
            value = usual_v[one.name] * plant.supply_v if one.name in usual_v else one.default
        values[one.name] = value
    over_v, under_v = values["over_voltage_v"], values["under_voltage_v"]
    if under_v >= over_v:
        key = "under_voltage_v" if table.under_voltage_v is not None else "over_voltage_v"
        message = f"under-voltage at {under_v:g} V is not below over-voltage at {over_v:g} V"
        raise SettingError((*_PATH, key), message, f"the supply's own is {plant.supply_v:g} V")
    for whose in ("device", "winding"):
        key = f"{whose}_temperature_warning_c"
        max_c = values[f"{whose}_temperature_max_c"]
        if values[key] > max_c:
            message = f"{values[key]:g} C is above the maximum, {max_c:g} C"
            raise SettingError((*_PATH, key), message, f"{key} = {max_c:g} at most")
    code = table.sto_error_code if table.sto == "fault" else 0
    return ProtectionSettings(**{**values, "sto_error_code": code})


def _refuse_idle(table: ProtectionTable, plant: MotorPlant) -> None:
    """Refuse a threshold of a quantity that the plant lacks; it would never be reached."""
    extras = plant.extras
    winding = ("winding_temperature_warning_c", "winding_temperature_max_c")
    for keys, has, remedy in (
        (winding, extras.has_heat(), "thermal_resistance_winding_housing_k_w and others"),
        (("over_voltage_v", "under_voltage_v"), extras.is_any(), "source_resistance_ohm"),
        (("i2t_warning",), extras.has_i2t(), "i2t_continuous_a, i2t_peak_a and i2t_peak_s"),
    ):
        for key in keys:
            if getattr(table, key) is not None and not has:
                message = "the plant does not model this quantity"
                raise SettingError((*_PATH, key), message, f"give the plant {remedy}")
