"""Settings of a CiA 402 drive in a rig, checked key by key.

A wrong key or value is a `SettingError` that names the keys and the expected value. The reader of
the file adds file and line.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

from emulators.cia402.quirk_catalogue import Quirks, boot_up_later_ns, quirks_of
from emulators.cia402.switch_settings import switches_in
from emulators.controller import SettingError
from emulators.firmware.digital_inputs import Switch
from emulators.firmware.gains import ServoGains
from emulators.motor_settings import MOTOR_KEYS, motor_in
from emulators.plant.dc_motor import MotorPlant
from emulators.plant.oscillator import IDEAL, Oscillator
from emulators.plant.presets import PRESETS
from emulators.protection_settings import (
    DEFAULT_PROTECTION,
    ProtectionSettings,
    protection_of,
)
from emulators.setting_tables import (
    DEFAULT_PRESET,
    ObjectValue,
    duration_ns,
    eds_in,
    flag,
    memory_file_in,
    node_id_in,
    number,
    objects_of,
    refuse_unknown,
    table_in,
    whole,
)

OWN_EDS: Final = Path(__file__).parents[1] / "eds" / "motorhil_cia402.eds"

# Values of 6060h; the bit of a mode in 6502h is one less. Source: CiA 402-2, modes of operation.
MODES: Final[dict[str, int]] = {
    **{"pp": 1, "vl": 2, "pv": 3, "tq": 4, "hm": 6},
    **{"ip": 7, "csp": 8, "csv": 9, "cst": 10},
}
EMULATED_MODES: Final[dict[str, int]] = {
    name: MODES[name] for name in ("pp", "pv", "tq", "hm", "ip", "csp", "csv", "cst")
}

SYNC_LOST_PERIODS: Final = 0
SYNC_LOST_CODE: Final = 0xFF64

_KEYS: Final = (
    "node_id",
    "eds",
    *MOTOR_KEYS,
    "timing",
    "units",
    "objects",
    "supported_modes",
    "nonvolatile_memory",
    "node_id_by_lss",
    "protection",
    "quirks",
    "cyclic",
    "switches",
)
_TIMING_KEYS: Final = ("boot_up_s", "sdo_reply_s", "enable_s")
_CYCLIC_KEYS: Final = ("sync_lost_periods", "sync_lost_code")
_UNIT_KEYS: Final = ("position_unit_inc", "velocity_unit_inc_s", "acceleration_unit_inc_s2")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class DriveSettings:
    """One drive of a rig; every setting except the node-ID has a default.

    Attributes:
        node_id: 1..127.
        node_id_by_lss: True if the node-ID is unset until LSS assigns it.
        eds: the EDS of the object dictionary.
        nonvolatile_memory: file of the non-volatile memory, as named in the rig; None: the contents
            last as long as the rig.
        plant, gains: the motor and its servo.
        tick_ns, current_steps: servo period, and current loop steps per period.
        oscillator: the drive's own clock; all other times are by this clock.
        boot_up_ns: power-on to boot-up message.
        sdo_reply_ns: SDO request to response.
        enable_ns: time of the power stage from switched on to operation enabled.
        position_unit_inc, velocity_unit_inc_s, acceleration_unit_inc_s2: size of one unit in the
            objects; None: according to the EDS, else one increment (per second, squared).
        objects: power-on values that replace those of the EDS.
        supported_modes: names; None: according to the EDS, else all emulated modes.
        initial_position_rad: at the output, at power-on.
        protection: thresholds and reactions of the protective functions.
        quirks: deviations from the standards.
        sync_lost_periods: interpolation periods (60C2h) without SYNC that are a fault in a cyclic
            mode; 0: never (many hosts stop SYNC between two streams).
        sync_lost_code: error code of that fault; FF64h is Kollmorgen's (MKD and P7000, "Sync not
            received").
        switches: digital inputs along the output, in encoder increments.
        index_count: position of the index pulse within a turn; None: the encoder has none.
    """

    node_id: int
    eds: Path = OWN_EDS
    nonvolatile_memory: str | None = None
    node_id_by_lss: bool = False
    plant: MotorPlant = PRESETS[DEFAULT_PRESET]
    gains: ServoGains
    tick_ns: int = 1_000_000
    current_steps: int = 10
    oscillator: Oscillator = IDEAL
    boot_up_ns: int = 300_000_000
    sdo_reply_ns: int = 1_000_000
    enable_ns: int = 20_000_000
    position_unit_inc: float | None = None
    velocity_unit_inc_s: float | None = None
    acceleration_unit_inc_s2: float | None = None
    objects: tuple[ObjectValue, ...] = ()
    supported_modes: tuple[str, ...] | None = None
    initial_position_rad: float = 0.0
    protection: ProtectionSettings = DEFAULT_PROTECTION
    quirks: Quirks = field(default_factory=dict)
    sync_lost_periods: int = SYNC_LOST_PERIODS
    sync_lost_code: int = SYNC_LOST_CODE
    switches: tuple[Switch, ...] = ()
    index_count: int | None = 0


def read_settings(table: Mapping[str, object], folder: Path, stream: str = "") -> DriveSettings:
    """Read the settings of a rig's table.

    Args:
        table: the controller's table.
        folder: the start of relative paths.
        stream: the name of the stream of random draws.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    refuse_unknown(table, _KEYS, ())
    node_id = node_id_in(table)
    motor = motor_in(table, stream)
    plant = motor.plant
    timing = table_in(table, "timing")
    refuse_unknown(timing, _TIMING_KEYS, ("timing",))
    units = table_in(table, "units")
    refuse_unknown(units, _UNIT_KEYS, ("units",))
    quirks = quirks_of(table.get("quirks", []))
    boot_up_ns = duration_ns(timing, "boot_up_s", 0.3, ("timing",))
    cyclic = table_in(table, "cyclic")
    refuse_unknown(cyclic, _CYCLIC_KEYS, ("cyclic",))
    if "sync_lost_code" in cyclic and not cyclic.get("sync_lost_periods"):
        path = ("cyclic", "sync_lost_code")
        raise SettingError(
            path, "has no effect without sync_lost_periods", "add sync_lost_periods = 5"
        )
    switches, index_count = switches_in(table_in(table, "switches"), plant)
    return DriveSettings(
        node_id=node_id,
        eds=eds_in(table, folder, OWN_EDS),
        nonvolatile_memory=memory_file_in(table),
        node_id_by_lss=flag(table, "node_id_by_lss"),
        plant=plant,
        gains=motor.gains,
        tick_ns=motor.tick_ns,
        current_steps=motor.current_steps,
        oscillator=motor.oscillator,
        boot_up_ns=boot_up_ns + boot_up_later_ns(quirks),
        sdo_reply_ns=duration_ns(timing, "sdo_reply_s", 0.001, ("timing",)),
        enable_ns=duration_ns(timing, "enable_s", 0.02, ("timing",)),
        position_unit_inc=_positive(units, "position_unit_inc"),
        velocity_unit_inc_s=_positive(units, "velocity_unit_inc_s"),
        acceleration_unit_inc_s2=_positive(units, "acceleration_unit_inc_s2"),
        objects=objects_of(table_in(table, "objects")),
        supported_modes=_modes(table),
        initial_position_rad=motor.initial_position_rad,
        protection=protection_of(table_in(table, "protection"), plant),
        quirks=quirks,
        sync_lost_periods=_whole(cyclic, "sync_lost_periods", SYNC_LOST_PERIODS, 0, 1000),
        sync_lost_code=_whole(cyclic, "sync_lost_code", SYNC_LOST_CODE, 1, 0xFFFF),
        switches=switches,
        index_count=index_count,
    )


def _modes(table: Mapping[str, object]) -> tuple[str, ...] | None:
    value = table.get("supported_modes")
    if value is None:
        return None
    path = ("supported_modes",)
    known = f"known: {', '.join(EMULATED_MODES)}"
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise SettingError(path, f"{value!r} is not a list of modes", f'["pp", "pv"]; {known}')
    names: list[str] = []
    for name in value:
        if not isinstance(name, str) or name not in MODES:
            raise SettingError(path, f"there is no mode {name!r}", known)
        if name not in EMULATED_MODES:
            raise SettingError(path, f"mode {name} is not emulated", known)
        if name in names:
            raise SettingError(path, f"mode {name} is listed twice", "take one out")
        names.append(name)
    return tuple(names)


def _whole(table: Mapping[str, object], key: str, default: int, low: int, high: int) -> int:
    return whole(table[key], ("cyclic", key), low, high) if key in table else default


def _positive(table: Mapping[str, object], key: str) -> float | None:
    return number(table[key], ("units", key), 1e-12, 1e12) if key in table else None
