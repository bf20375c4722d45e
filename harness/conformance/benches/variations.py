"""Variations of the kit's own benches, so that no clause depends on the bench being simple.

Each variation is the kit's rig with other text in some places. Most are of the CiA 402 rig. The
set grows with every correct motor that was accused. A user's rig is used as it is.
"""

import random
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from typing import Final

from motorhil.harness.conformance.benches.linear_axes import LINEAR_AXES
from motorhil.harness.conformance.benches.options import OPTIONS, Change
from motorhil.harness.conformance.benches.worlds import is_world

_PLANT = 'plant = { preset = "wheel_60w" }'
_FINE = "window_rad = 0.001\nfollowing_rad = 0.0005"


def of_drive(settings: str) -> list[Change]:
    """Return the change that gives both drives these settings."""
    return [(_PLANT, f"{_PLANT}\n{settings}")]


def of_plant(values: str) -> list[Change]:
    """Return the change that gives both plants these values."""
    return [(_PLANT, f'plant = {{ preset = "wheel_60w", {values} }}')]


def without_modes(supported: int) -> list[Change]:
    """Return the change that gives both drives these supported modes, 6502h."""
    return of_drive(f'objects = {{ "6502h" = {supported} }}')


_LINEAR: list[Change] = [
    ("gear_ratio = 66.0", "motor_turns_per_m = 200.0"),
    ("[motor.left.model]", '[motor.left.model]\nkind = "linear"'),
    ("[motor.right.model]", '[motor.right.model]\nkind = "linear"'),
    ("velocity_max_rad_s = 2.0", "velocity_max_m_s = 0.3"),
    ("acceleration_max_rad_s2 = 4.0", "acceleration_max_m_s2 = 1.0"),
    ("torque_max_n_m = 5.0", "force_max_n = 50.0"),
    ("velocity_unit_rad_s = 4.7599888690754445e-05", "velocity_unit_m_s = 0.0000025"),
    ("acceleration_unit_rad_s2 = 4.7599888690754445e-05", "acceleration_unit_m_s2 = 0.0000025"),
    ("window_rad = 0.001", "window_m = 0.0003"),
    ("following_rad = 0.0005", "following_m = 0.0002"),
    ("long_move_rad = 1.0", "long_move_m = 0.2"),
]
_TWO_BUSES: list[Change] = [
    ("[controller.left]", "[bus.can1]\nbitrate_bit_s = 500_000\n\n[controller.left]"),
    ('bus = "can0"\nnode_id = 2', 'bus = "can1"\nnode_id = 1'),
]
_PRIORITY = "".join(
    f'[bus.can0.node.{node}]\nqueue = "priority"\n\n' for node in ("host", "left", "right")
)
_THIRD = """[controller.third]
kind = "cia402"
bus = "can0"
node_id = 3
plant = { preset = "wheel_60w" }

[motor.third]
adaptation = "cia402"
controller = "third"
servo_period_ms = 1.0
[motor.third.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
torque_max_n_m = 5.0
current_max_a = 4.0
gear_ratio = 66.0
encoder_increments_rev = 2000
velocity_unit_rad_s = 4.7599888690754445e-05
acceleration_unit_rad_s2 = 4.7599888690754445e-05

"""
_THREE: list[Change] = [
    ("[group.both]", f"{_THIRD}[group.both]"),
    ('motors = ["left", "right"]', 'motors = ["left", "right", "third"]'),
]
_UNIT = "unit_rad_s{} = 4.7599888690754445e-05\n"
_OF_THE_DRIVE: list[Change] = [
    ("velocity_" + _UNIT.format(""), ""),
    ("acceleration_" + _UNIT.format("2"), ""),
]
_UNITS_OF_SPEED: list[Change] = [
    *of_drive(
        "units = { velocity_unit_inc_s = 2.0, acceleration_unit_inc_s2 = 4.0 }\n"
        'objects = { "6096h:1" = 2, "6097h:1" = 4 }'  # which say so, in one of two readings
    ),
    ("velocity_" + _UNIT.format(""), "velocity_unit_rad_s = 9.519977738150889e-05\n"),
    ("acceleration_" + _UNIT.format("2"), "acceleration_unit_rad_s2 = 1.9039955476301778e-04\n"),
]
_NO_IDENTIFIERS = ", ".join(f'"{index}h:1" = 0x80000000' for index in ("1400", "1401", "1800"))
_RATE_AND_LEFT: Final = "bitrate_bit_s = 1_000_000\n\n[controller.left]"
_MESSAGES: Final = "".join(
    f"[[bus.can0.message]]\nidentifier = {identifier}\nlength = 8\nperiod_s = 0.005\n\n"
    for identifier in (*range(0x90, 0x99), *range(0x6A0, 0x6A9))  # above the drives, and below
)
_LEFT: Final = 'bus = "can0"\nnode_id = 1'
_PREDEFINED: Final = "".join(  # by another device, which may send them if the drive does not
    f"[[bus.can0.message]]\nidentifier = {identifier}\nlength = 6\nperiod_s = 0.02\n\n"
    for identifier in (0x181, 0x201)
)
_OWN_IDENTIFIERS: list[Change] = [
    (_LEFT, f'{_LEFT}\nobjects = {{ "1800h:1" = 0x190, "1400h:1" = 0x210 }}'),
    (_RATE_AND_LEFT, _RATE_AND_LEFT.replace("[controller", f"{_PREDEFINED}[controller")),
]
_HEARD_LATE: Final = ("latency_s = [0.0, 0.001]", "latency_s = [-0.003, 0.001]")  # by start()
_ASKED_FOR: Final = (_HEARD_LATE[0], f"{_HEARD_LATE[1]}\ntime_tolerance_s = 0.15")
"""Ends that the host hears of by several answers of 10 to 30 ms."""
NOT_BORNE: Final = ("borne_s = 0.09\n", "")
"""A silence of this length is not borne."""
_BUSY: list[Change] = [  # half of the bus; too much for a slow one, so its rate is spelt otherwise
    (_RATE_AND_LEFT, f"bitrate_bit_s = 1000000\n\n{_MESSAGES}[controller.left]")
]
READ: Final = "a second program reads"
"""The variation in which another program reads the motors; see `RigBench`."""
APART: Final = "other users in a second program"
"""The variation in which other users of a motor are of another program; see `RigBench.apart`."""
_ELASTIC = (
    "backlash_rad = 0.0003, coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0"
)

_WATCHDOG: Final = "watchdog_s = 0.05\n"
_REGISTERS: Final = "registers = { return_delay_time = 25 }\n"
_VISCOUS: Final = "viscous_friction_n_m_s_rad = "
_OF_OTHER_MOTORS: Final[Mapping[str, Sequence[Change]]] = {
    "drive starts at 1 rad": [(_WATCHDOG, f"{_WATCHDOG}initial_position_rad = 1.0\n")],
    "drive with a fast clock": [(_WATCHDOG, f"{_WATCHDOG}oscillator = {{ ppm = 100.0 }}\n")],
    "more load than told": [("load_inertia_kg_m2 = 0.01", "load_inertia_kg_m2 = 0.012")],
    "more friction": [("coulomb_friction_n_m = 0.02 }", "coulomb_friction_n_m = 0.025 }")],
    "reversing servo": [("gear_ratio = 1.0", "gear_ratio = -1.0")],
    "servo starts at -2 rad": [(_REGISTERS, f"{_REGISTERS}initial_position_rad = -2.0\n")],
    "servo with a slow clock": [(_REGISTERS, f"{_REGISTERS}oscillator = {{ ppm = -100.0 }}\n")],
    "servo with more friction": [(f"{_VISCOUS}0.00366", f"{_VISCOUS}0.0046")],
}
"""Those of drives with impedance control, and of servos, whose rigs have other places."""

VARIATIONS: Final[Mapping[str, Sequence[Change]]] = {
    **_OF_OTHER_MOTORS,
    **LINEAR_AXES,
    **OPTIONS,
    "reversing gear": [("gear_ratio = 66.0", "gear_ratio = -66.0")],
    "linear axis": _LINEAR,
    "starts at 5 rad": of_drive("initial_position_rad = 5.0"),
    "starts near the end of the counter": of_drive("initial_position_rad = 102_000.0"),
    "starts near its other end": of_drive("initial_position_rad = -102_000.0"),
    "inverted positions": of_drive('objects = { "607Eh" = 0x80 }'),
    "inverted velocities": of_drive('objects = { "607Eh" = 0x40 }'),
    "inverted polarity": of_drive('objects = { "607Eh" = 0xC0 }'),
    "home offset": of_drive('objects = { "607Ch" = 1000 }'),
    "halt by the quick stop ramp": of_drive('objects = { "605Dh" = 2 }'),
    "torque limit in the drive": of_drive('objects = { "6072h" = 300 }'),
    "units of the drive": _OF_THE_DRIVE,
    "two units of speed": _UNITS_OF_SPEED,
    "identifiers of its own": _OWN_IDENTIFIERS,
    "PDOs without identifiers": of_drive(f"objects = {{ {_NO_IDENTIFIERS} }}"),
    "no csp": without_modes(0x2D),
    "no tq": without_modes(0xA5),
    "no pv": without_modes(0xA1),
    "only pp": without_modes(0x01),
    "fast clock": [(_PLANT, f"{_PLANT}\noscillator = {{ ppm = 100.0 }}")],
    "slow clock": [(_PLANT, f"{_PLANT}\noscillator = {{ ppm = -100.0 }}")],
    "clocks that drift apart": [
        ('bus = "can0"\nnode_id = 1', 'bus = "can0"\nnode_id = 1\noscillator = { ppm = 80.0 }'),
        ('bus = "can0"\nnode_id = 2', 'bus = "can0"\nnode_id = 2\noscillator = { ppm = -80.0 }'),
    ],
    "priority queues": [("[controller.left]", f"{_PRIORITY}[controller.left]")],
    "three motors": _THREE,
    "slow bus": [
        ("1_000_000", "125_000"),
        _HEARD_LATE,
    ],
    "busy bus": _BUSY,
    READ: [],
    APART: [],
    "quirk slow_sdo": [*of_drive('quirks = ["slow_sdo"]'), _ASKED_FOR],
    "slow SDO server": of_drive("timing = { sdo_reply_s = 0.005 }"),
    "friction": [
        *of_plant("coulomb_friction_n_m = 0.008"),
        ("following_rad = 0.0005", "following_rad = 0.001"),
    ],
    "backlash": [*of_plant(_ELASTIC), (_FINE, "window_rad = 0.006\nfollowing_rad = 0.006")],
    "two buses with equal node-IDs": _TWO_BUSES,
} | {
    f"quirk {name}": [*of_drive(f'quirks = ["{name}"]'), *changes]
    for name, changes in (
        ("inverted_set_point_acknowledge", []),
        ("single_set_point_only", []),
        ("edge_only_bits", []),
        ("stale_target_reached", []),
        ("halt_holds_mode", []),
        ("stray_emcy", []),
        ("misplaced_error_register", []),
        ("heartbeat_jitter", [NOT_BORNE]),  # two heartbeats may be 5 ms apart
    )
}

_GENERAL: Final = (
    *("reversing gear", "starts at 5 rad", "fast clock", "slow clock"),
    *_OF_OTHER_MOTORS,
    *LINEAR_AXES,
    *OPTIONS,
)
"""Variations that not only rigs with CiA 402 drives can have, if their text has the places."""
_CONTRADICTORY: Final = (
    {"limited jerk", "linear axis"},
    {"priority queues", "two buses with equal node-IDs"},
    {"slow bus", "quirk slow_sdo"},
    {"linear axis of the host's servo", "servo options of the host"},
    {"linear axis of the host's servo", "gains of the host's servo"},
)
"""Pairs whose texts fit together, but make no rig."""
_AND: Final = " + "
OWN: Final = ""
"""The name of the rig as it is."""
_FEWER: Final = ("6502h", 'mode = "velocity"')
"""The settings with which a motor claims less."""
_OWN_SHARE: Final = 3
"""The rig as it is checks one clause of so many."""


def applicable(text: str) -> tuple[str, ...]:
    """Return the names of the variations that the rig in this text can have."""
    is_cia402 = 'kind = "cia402"' in text
    return tuple(
        name
        for name, changes in VARIATIONS.items()
        if (is_cia402 or name in _GENERAL) and all(before in text for before, _ in changes)
    )


def text_of(text: str, changes: Sequence[Change]) -> str:
    """Return the text of a rig with these changes.

    Raises:
        ValueError: the text lacks a place to change.
    """
    for before, after in changes:
        if before not in text:
            raise ValueError(f"the rig has no {before!r} to change; use another rig")
        text = text.replace(before, after)
    return text


def parts_of(name: str) -> list[str]:
    """Return the variations of a pair, or the one; none for the rig as it is, or in a world."""
    return name.split(_AND) if name and not is_world(name) else []


def changes_of(name: str) -> list[Change]:
    """Return the changes of a variation, or of a pair of them, in their order."""
    return [change for part in parts_of(name) for change in VARIATIONS[part]]


def changes_claims(name: str) -> bool:
    """Return whether motors with this variation claim less than those of the rig as it is."""
    return any(one in after for _, after in changes_of(name) for one in _FEWER)


def pairs_of(text: str, names: Sequence[str]) -> list[str]:
    """Return the pairs of these variations that the rig in this text can have."""
    found = []
    for first, second in combinations(names, 2):
        if {first, second} in _CONTRADICTORY:
            continue
        for pair in (f"{first}{_AND}{second}", f"{second}{_AND}{first}"):
            with suppress(ValueError):  # one removes what the other changes, or both set one key
                tomllib.loads(text_of(text, changes_of(pair)))
                found.append(pair)
                break
    return found


def assigned(clauses: Sequence[str], names: Sequence[str], seed: int) -> dict[str, str]:
    """Return the variation, or the pair, for each clause; all have a clause if there are enough.

    The first clause is checked on the rig as it is, so that the first verdict comes soon. The same
    seed gives the same variations.
    """
    order = random.Random(f"benches {seed}")
    bag: list[str] = []
    found = {}
    for number, clause in enumerate(clauses):
        if number % _OWN_SHARE == 0 or not names:
            found[clause] = OWN
            continue
        if not bag:
            bag = order.sample(list(names), len(names))
        found[clause] = bag.pop()
    return found


def not_met(names: Sequence[str], met: Collection[str]) -> list[str]:
    """Return the variations that no checked clause has met.

    Of the pairs among `names` only their number is told.
    """
    parts = {part for one in met for part in parts_of(one)}
    pairs = [name for name in names if _AND in name]
    missing = [name for name in names if _AND not in name and name not in parts]
    if pairs:
        missing.append(f"{sum(one not in met for one in pairs)} of {len(pairs)} pairs")
    return missing
