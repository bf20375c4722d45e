"""Correct motors that differ from the kit's own: the kit must accuse none of them.

Each is the kit's CiA 402 rig with other text in some places. The set grows with every accusation.
"""

from pathlib import Path

from tests.support.kit_benches import RIGS

_PLANT = 'plant = { preset = "wheel_60w" }'
_ACCELERATION = "acceleration_max_rad_s2 = 4.0"
_FINE = "window_rad = 0.001\nfollowing_rad = 0.0005"
_SEEKING = "seeking_method = 17\n"
_WITHOUT_CONSUMER = '\n[conformance.without]\ndead_man = "the file has no heartbeat consumer"\n'

Change = tuple[str, str]


def of_drive(settings: str) -> list[Change]:
    """Return the change that gives both drives these settings."""
    return [(_PLANT, f"{_PLANT}\n{settings}")]


def of_plant(values: str) -> list[Change]:
    """Return the change that gives both plants these values."""
    return [(_PLANT, f'plant = {{ preset = "wheel_60w", {values} }}')]


def without_modes(supported: int) -> list[Change]:
    """Return the change that gives both drives these supported modes, 6502h."""
    return of_drive(f'objects = {{ "6502h" = {supported} }}')


def of_vendor(file: Path) -> list[Change]:
    """Return the changes for drives with the object dictionary of this vendor's file."""
    return [*of_drive(f'eds = "{file}"'), (_SEEKING, _WITHOUT_CONSUMER)]


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
_ELASTIC = (
    "backlash_rad = 0.0003, coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0"
)

VARIANTS: dict[str, list[Change]] = {
    "reversing gear": [("gear_ratio = 66.0", "gear_ratio = -66.0")],
    "linear axis": _LINEAR,
    "starts at 5 rad": of_drive("initial_position_rad = 5.0"),
    "starts near the end of the counter": of_drive("initial_position_rad = 102_000.0"),
    "starts near its other end": of_drive("initial_position_rad = -102_000.0"),
    "brakes gently": [(_ACCELERATION, f"{_ACCELERATION}\ndeceleration_max_rad_s2 = 1.0")],
    "inverted positions": of_drive('objects = { "607Eh" = 0x80 }'),
    "inverted velocities": of_drive('objects = { "607Eh" = 0x40 }'),
    "inverted polarity": of_drive('objects = { "607Eh" = 0xC0 }'),
    "home offset": of_drive('objects = { "607Ch" = 1000 }'),
    "halt by the quick stop ramp": of_drive('objects = { "605Dh" = 2 }'),
    "no csp": without_modes(0x2D),
    "no tq": without_modes(0xA5),
    "no pv": without_modes(0xA1),
    "only pp": without_modes(0x01),
    "fast clock": [(_PLANT, f"{_PLANT}\noscillator = {{ ppm = 100.0 }}")],
    "slow clock": [(_PLANT, f"{_PLANT}\noscillator = {{ ppm = -100.0 }}")],
    "slow bus": [("1_000_000", "125_000")],
    "slow SDO server": of_drive("timing = { sdo_reply_s = 0.005 }"),
    "friction": [
        *of_plant("coulomb_friction_n_m = 0.008"),
        ("following_rad = 0.0005", "following_rad = 0.001"),
    ],
    "backlash": [*of_plant(_ELASTIC), (_FINE, "window_rad = 0.006\nfollowing_rad = 0.006")],
    "two buses with equal node-IDs": _TWO_BUSES,
} | {
    f"quirk {name}": of_drive(f'quirks = ["{name}"]')
    for name in (
        "inverted_set_point_acknowledge",
        "single_set_point_only",
        "edge_only_bits",
        "stale_target_reached",
        "halt_holds_mode",
        "stray_emcy",
        "misplaced_error_register",
        "slow_sdo",
        "heartbeat_jitter",
    )
}

VENDORS = ("roboteq_v80.eds", "schunk_prl_erb_0_63.dcf", "technosoft_ipos.eds")


def text_of(changes: list[Change]) -> str:
    """Return the text of the kit's CiA 402 rig with these changes."""
    text = (RIGS / "cia402.toml").read_text()
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    return text
