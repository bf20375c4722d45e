"""The rig table `switches` of a drive: positions of switches in the plant."""

from collections.abc import Mapping
from typing import Final

from emulators.controller import SettingError
from emulators.firmware.digital_inputs import (
    FAR,
    HOME_SWITCH,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    STIMULI,
    TOUCH_PROBE_1,
    TOUCH_PROBE_2,
    Switch,
)
from emulators.plant.dc_motor import PI, MotorPlant
from emulators.setting_tables import number, refuse_unknown

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
