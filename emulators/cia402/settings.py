"""Settings of a CiA 402 drive in a rig, checked key by key.

A wrong key or value is a `SettingError` that names the keys and the expected value. The reader of
the file adds file and line.

The table `switches` has the positions of switches in the plant. Quirks are named deviations of real
drives from the standards, with their sources. A rig enables them by name, with the parameters
stated here or with its own:

  quirks = ["single_set_point_only"]
  quirks = { slow_sdo = { mean_s = 0.02 }, single_set_point_only = true }

All are off by default. They are added when the drive is built, around the parts that they change. A
drive without quirks is the same object as without this module.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

from motorhil.emulators.controller import SettingError
from motorhil.emulators.firmware.digital_inputs import (
    FAR,
    HOME_SWITCH,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    STIMULI,
    TOUCH_PROBE_1,
    TOUCH_PROBE_2,
    Switch,
)
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import PI, MotorPlant
from motorhil.emulators.plant.oscillator import IDEAL, Oscillator
from motorhil.emulators.plant.presets import PRESETS
from motorhil.emulators.settings.motor import MOTOR_KEYS, motor_in
from motorhil.emulators.settings.protection import (
    DEFAULT_PROTECTION,
    ProtectionSettings,
    protection_of,
)
from motorhil.emulators.settings.tables import (
    DEFAULT_PRESET,
    ObjectValue,
    duration_ns,
    eds_in,
    flag,
    memory_file_in,
    nearest,
    node_id_in,
    number,
    objects_of,
    refuse_unknown,
    table_in,
    whole,
)

# Active from one output position up to another; without the key, to the end of travel.
_RANGES: Final = (
    ("home_from_rad", "home_to_rad", HOME_SWITCH),
    ("touch_probe_1_from_rad", "touch_probe_1_to_rad", TOUCH_PROBE_1),
    ("touch_probe_2_from_rad", "touch_probe_2_to_rad", TOUCH_PROBE_2),
)
SWITCH_KEYS: Final = (
    "negative_limit_rad",
    "positive_limit_rad",
    *(key for low, high, _ in _RANGES for key in (low, high)),
    "index_rad",
    "index_pulse",
)
_NAMES: Final = {bit: name for name, bit in STIMULI.items()}
_PATH: Final = ("switches",)
_PLACE_MAX_RAD: Final = 1e9


def switches_in(
    table: Mapping[str, object], plant: MotorPlant
) -> tuple[tuple[Switch, ...], int | None]:
    """Return the switches of a table `switches` and the index pulse's count, in increments.

    Edges lie at the nearest change of the encoder's count, at most half an increment away.

    Raises:
        SettingError: a key is unknown, or a value is wrong.
    """
    refuse_unknown(table, SWITCH_KEYS, _PATH)
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    negative = _count(table, "negative_limit_rad", inc_rad, -FAR)
    positive = _count(table, "positive_limit_rad", inc_rad, FAR)
    if negative >= positive:
        message = f"{table['positive_limit_rad']} rad is not above the negative limit switch"
        remedy = "the negative one is active below its position, the positive one above"
        raise SettingError((*_PATH, "positive_limit_rad"), message, remedy)
    switches: list[Switch] = []
    if negative > -FAR:
        switches.append(Switch(NEGATIVE_LIMIT, -FAR, negative))
    if positive < FAR:
        switches.append(Switch(POSITIVE_LIMIT, positive, FAR))
    for low_key, high_key, bit in _RANGES:
        if low_key in table or high_key in table:
            low, high = _count(table, low_key, inc_rad, -FAR), _count(table, high_key, inc_rad, FAR)
            if low >= high:
                message = f"{table[high_key]} rad is not above {low_key}"
                remedy = f"at least an increment of {1.0 / inc_rad:.3g} rad"
                raise SettingError((*_PATH, high_key), message, remedy)
            switches.append(Switch(bit, low, high))
    return tuple(switches), _index(table, plant)


def out_of_reach(switches: tuple[Switch, ...], plant: MotorPlant) -> list[str]:
    """Return warnings about switches beyond the end stops, one line each.

    Such a switch is not necessarily an error of the rig: a limit switch can be mounted wrongly.
    """
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    low_rad, high_rad = plant.extras.stop_low_rad, plant.extras.stop_high_rad
    way = f"the ends of the way, {low_rad:g}..{high_rad:g} rad"
    return [
        f"switch {_NAMES[one.bit]} is beyond {way}: it stays off unless a stimulus says otherwise"
        for one in switches
        if one.low > high_rad * inc_rad or one.high <= low_rad * inc_rad
    ]


def _count(table: Mapping[str, object], key: str, inc_rad: float, absent: int) -> int:
    if key not in table:
        return absent
    place = number(table[key], (*_PATH, key), -_PLACE_MAX_RAD, _PLACE_MAX_RAD) * inc_rad
    if abs(place) >= 1 << 31:
        message = f"{place:.0f} increments do not fit 32 bits"
        remedy = f"at most {(1 << 31) / inc_rad:g} rad either way"
        raise SettingError((*_PATH, key), message, remedy)
    return int((place + 0.5) // 1.0)


def _index(table: Mapping[str, object], plant: MotorPlant) -> int | None:
    there = table.get("index_pulse", True)
    if not isinstance(there, bool):
        message = f"{there!r} is not true or false"
        raise SettingError((*_PATH, "index_pulse"), message, "write it without quotes")
    if not there:
        if "index_rad" in table:
            message = "the encoder has no index pulse"
            raise SettingError((*_PATH, "index_rad"), message, "take one of them out")
        return None
    angle = number(table.get("index_rad", 0.0), (*_PATH, "index_rad"), -2.0 * PI, 2.0 * PI)
    turn = plant.encoder_increments_rev
    return int((angle * turn / (2.0 * PI) + 0.5) // 1.0) % turn


_NS_PER_S: Final = 1_000_000_000
_QUIRK_PATH: Final = ("quirks",)
_TIME_MAX_S: Final = 3600.0

Quirks = Mapping[str, Mapping[str, float]]
"""The enabled quirks, each with all its parameters."""


@final
@dataclass(frozen=True, slots=True)
class Quirk:
    """One row of the catalogue.

    Attributes:
        name: the name in a rig.
        what: the behaviour of the drive.
        seen: the source.
        parameters: names with their units, and their default values.
    """

    name: str
    what: str
    seen: str
    parameters: Mapping[str, float]


CATALOGUE: Final = (
    Quirk(
        "inverted_set_point_acknowledge",
        "pp: statusword bit 12 is 1 from enabling on and 0 while a set-point is acknowledged",
        "canopen-python/canopen issue 678",
        {},
    ),
    Quirk(
        "single_set_point_only",
        "pp: a set-point without change immediately (controlword bit 5) is not executed",
        "Synapticon's documentation of profile position: single set-point only",
        {},
    ),
    Quirk(
        "edge_only_bits",
        "pp: controlword bit 5 left at 1 since the previous set-point: the next one is ignored",
        "nasa-jpl/jsd issue 103 (Elmo Gold)",
        {},
    ),
    Quirk(
        "stale_target_reached",
        "pp: target reached of the previous motion stays set for a while after a new set-point",
        "delmic/odemis pull request 1846 (Trinamic)",
        {"for_s": 0.01},
    ),
    Quirk(
        "halt_holds_mode",
        "6060h is ignored while controlword bit 8 (halt) is 1",
        "ros-industrial/ros2_canopen issue 234 (Engel HBI)",
        {},
    ),
    Quirk(
        "stray_emcy",
        "EMCY is sent as node 1's, on 081h, whatever the node-ID",
        "ros-industrial/ros2_canopen issue 214, recorded (Roboteq, node 12)",
        {},
    ),
    Quirk(
        "misplaced_error_register",
        "EMCY carries the error register in its fourth byte, behind a 0",
        "CANopenNode/CANopenNode issue 402",
        {},
    ),
    Quirk(
        "slow_sdo",
        "SDO responses are delayed by mean_s, give or take spread_s",
        "ros-industrial/ros2_canopen issue 194: some 10 ms after a master's timeout of 20 ms",
        {"mean_s": 0.02, "spread_s": 0.01},
    ),
    Quirk(
        "deaf_after_boot_up",
        "SDO requests are not answered for a while after the boot-up message",
        "canopen-python/canopen issue 401 (Nanotec CL4-E)",
        {"for_s": 2.0},
    ),
    Quirk(
        "late_boot_up",
        "the boot-up message is delayed by by_s",
        "ros-industrial/ros2_canopen issue 370: masters that wait too briefly for it",
        {"by_s": 5.0},
    ),
    Quirk(
        "heartbeat_jitter",
        "each heartbeat is delayed by up to max_s",
        "a recorded machine: node 63h, period 1.4 s, heartbeats 1.402 to 1.495 s apart",
        {"max_s": 0.095},
    ),
)
_BY_NAME: Final = {quirk.name: quirk for quirk in CATALOGUE}


def quirks_of(value: object) -> Quirks:
    """Return the quirks that a rig asks for.

    Args:
        value: a list of names, or a table of names with their parameters.

    Raises:
        SettingError: a quirk or parameter does not exist, or its value is wrong.
    """
    if isinstance(value, list):
        names = [_hashable(name) for name in value]
        for name in names:
            if names.count(name) > 1:
                raise SettingError(_QUIRK_PATH, f"{name} is listed twice", "take one out")
        asked: Mapping[object, object] = dict.fromkeys(names, True)
    elif isinstance(value, Mapping):
        asked = value
    else:
        example = value if value in _BY_NAME else CATALOGUE[0].name
        raise SettingError(_QUIRK_PATH, f"{value!r} is not a list of names", f'["{example}"]')
    on: dict[str, Mapping[str, float]] = {}
    for name, given in asked.items():
        quirk = _BY_NAME.get(name) if isinstance(name, str) else None
        if quirk is None:
            remedy = f"{nearest(name, tuple(_BY_NAME))}; motorhil list quirks shows them"
            raise SettingError(_QUIRK_PATH, f"there is no quirk {name!r}", remedy)
        path = (*_QUIRK_PATH, quirk.name)
        if given is False:
            continue
        if given is not True and not isinstance(given, Mapping):
            remedy = "true, or a table of: " + (", ".join(quirk.parameters) or "nothing")
            raise SettingError(path, f"{given!r} is not a valid value", remedy)
        own = given if isinstance(given, Mapping) else {}
        refuse_unknown(own, tuple(quirk.parameters), path)
        on[quirk.name] = {
            key: number(own.get(key, default), (*path, key), 0, _TIME_MAX_S)
            for key, default in quirk.parameters.items()
        }
    return on


def _hashable(name: object) -> object:
    return name if isinstance(name, str) else repr(name)


def told(quirks: Quirks) -> list[str]:
    """Describe the enabled quirks, one line each, for the record."""
    lines = []
    for name, values in quirks.items():
        given = ", ".join(f"{key} = {value:g}" for key, value in values.items())
        lines.append(f"quirk {name}" + (f" ({given})" if given else ""))
    return lines


def boot_up_later_ns(quirks: Quirks) -> int:
    """Return the delay of the boot-up message [ns]."""
    return parameter_ns(quirks, "late_boot_up", "by_s")


def parameter_ns(quirks: Quirks, name: str, key: str) -> int:
    """Return a parameter of a quirk [ns]; 0 if the quirk is off."""
    return round(quirks.get(name, {}).get(key, 0.0) * _NS_PER_S)


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
