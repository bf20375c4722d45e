"""Linear axes: variations of the kit's own benches whose motors slide.

The drives and their plants stay as they are. A leadscrew of 5 mm takes the place of each gear, so
that one radian becomes 52.5 mm.
"""

from collections.abc import Mapping, Sequence
from math import tau
from typing import Final

from motorhil.harness.conformance.benches.options import Change

_TURNS_PER_M: Final = 200.0
_GEAR_RATIO: Final = 66.0
_M_PER_RAD: Final = _GEAR_RATIO / tau / _TURNS_PER_M
_SLIDES: Final[Sequence[Change]] = (
    ("gear_ratio = 66.0", f"motor_turns_per_m = {_TURNS_PER_M}"),
    *(
        (f"[motor.{one}.model]", f'[motor.{one}.model]\nkind = "linear"')
        for one in ("left", "right")
    ),
    ("torque_max_n_m = 5.0", "force_max_n = 95.0"),
    ("velocity_max_rad_s = 2.0", "velocity_max_m_s = 0.1"),
    ("acceleration_max_rad_s2 = 4.0", "acceleration_max_m_s2 = 0.2"),
    ("long_move_rad = 1.0", "long_move_m = 0.05"),
)


def _facts(**values: float) -> list[Change]:
    """Return the changes of these distances of the bench, in radians, into metres."""
    return [
        (f"{name}_rad = {value}\n", f"{name}_m = {value * _M_PER_RAD:.3g}\n")
        for name, value in values.items()
    ]


def _units(rad_s: str, m_s: str) -> list[Change]:
    """Return the changes of the units of velocity and acceleration of a drive."""
    return [
        (f"velocity_unit_rad_s = {rad_s}\n", f"velocity_unit_m_s = {m_s}\n"),
        (f"acceleration_unit_rad_s2 = {rad_s}\n", f"acceleration_unit_m_s2 = {m_s}\n"),
    ]


def _axis(
    kind: str, window_rad: float, following_rad: float, unit_rad_s: str = "4.7599888690754445e-05"
) -> list[Change]:
    adaptation = f'adaptation = "{kind}"'
    return [
        (adaptation, adaptation),  # other kinds have the same places
        *_SLIDES,
        *_facts(window=window_rad, following=following_rad),
        *_units(unit_rad_s, "0.0000025"),
    ]


LINEAR_AXES: Final[Mapping[str, Sequence[Change]]] = {
    "linear axis of a moteus": _axis("moteus", 0.002, 0.02),
    "linear axis of a VESC": _axis("vesc", 0.003, 0.03),
    "linear axis of a dryve": _axis("dryve", 0.003, 0.06, "1.7453292519943296e-4"),
    "linear axis of a Leadshine drive": _axis("leadshine", 0.003, 0.06),
    "linear axis of an AZ drive": _axis("oriental_az", 0.003, 0.06),
    "linear axis of the host's servo": [
        *_axis("software", 0.001, 0.0002),
        ("torque_constant_n_m_a = 1.7094", "torque_constant_n_a = 32.5"),
        (
            "acceleration_feedforward_a_s2_rad = 0.038",
            "acceleration_feedforward_a_s2_m = 0.7235",
        ),
    ],
}
"""By name; each for one kind. Drives with CiA 402 have their own, with other numbers."""
