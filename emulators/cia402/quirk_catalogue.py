"""Quirks: named deviations of real drives from the standards, with their sources.

A rig enables them by name, with the parameters stated here or with its own:

  quirks = ["single_set_point_only"]
  quirks = { slow_sdo = { mean_s = 0.02 }, single_set_point_only = true }

All are off by default. They are added when the drive is built, around the parts that they change. A
drive without quirks is the same object as without this module.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

from emulators.controller import SettingError
from emulators.setting_tables import nearest, number, refuse_unknown

_NS_PER_S: Final = 1_000_000_000
_PATH: Final = ("quirks",)
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
                raise SettingError(_PATH, f"{name} is listed twice", "take one out")
        asked: Mapping[object, object] = dict.fromkeys(names, True)
    elif isinstance(value, Mapping):
        asked = value
    else:
        example = value if value in _BY_NAME else CATALOGUE[0].name
        raise SettingError(_PATH, f"{value!r} is not a list of names", f'["{example}"]')
    on: dict[str, Mapping[str, float]] = {}
    for name, given in asked.items():
        quirk = _BY_NAME.get(name) if isinstance(name, str) else None
        if quirk is None:
            remedy = f"{nearest(name, tuple(_BY_NAME))}; motorhil list quirks shows them"
            raise SettingError(_PATH, f"there is no quirk {name!r}", remedy)
        path = (*_PATH, quirk.name)
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
