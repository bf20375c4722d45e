"""Correct motors that differ from the kit's own: the kit must accuse none of them."""

import re
import tempfile
from math import radians
from pathlib import Path

from motorhil.harness.conformance.benches import variations
from motorhil.harness.conformance.benches.variations import (
    APART,
    NOT_BORNE,
    OWN,
    READ,
    VARIATIONS,
    Change,
    applicable,
    of_drive,
)
from tests.support.kit_benches import KINDS, RIGS

_SEEKING = "seeking_method = 17\n"
_WITHOUT_CONSUMER = '\n[conformance.without]\ndead_man = "the file has no heartbeat consumer"\n'
_ACCELERATION = "acceleration_max_rad_s2 = 4.0"
_GENTLY = [(_ACCELERATION, f"{_ACCELERATION}\ndeceleration_max_rad_s2 = 1.0")]
LIMITED_JERK = [(_ACCELERATION, f"{_ACCELERATION}\njerk_max_rad_s3 = 8.0")]
_BY_SDO = "".join(
    f'{one} = "it has no RPDO"\n'
    for one in ("complex_position", "complex_velocity", "common_trigger")
)
_UNIT = "4.7599888690754445e-05"
_FOLDER = tempfile.TemporaryDirectory()


def _own_eds() -> str:
    from tests.support.checkout import CHECKOUT

    return (CHECKOUT / "emulators" / "eds" / "motorhil_cia402.eds").read_text()


def _si_units() -> list[Change]:
    """Return the changes for drives in 0.01 degree and 0.01 degree/s, and a model without them.

    Their accelerations are in 0.04 degree/s², and their rated torque is not that of their rated
    current, either.
    """
    objects = ((0x60A8, "position", 0xFE41_0000), (0x60A9, "velocity", 0xFE41_0300))  # CiA 303-2
    path = Path(_FOLDER.name, "si_units.eds")
    path.write_text(
        _own_eds()
        + "".join(
            f"\n[{index:X}]\nParameterName=SI unit {what}\nObjectType=0x7\nDataType=0x0007\n"
            f"AccessType=ro\nPDOMapping=0\nDefaultValue={value}\n"
            for index, what, value in objects
        )
    )
    ramps = '"6081h" = 11459, "6083h" = 5730, "6084h" = 5730, "6085h" = 10000'
    steps = f"units = {{ acceleration_unit_inc_s2 = {4.0 * 132_000 / 36_000!r} }}"
    return [
        *of_drive(f'eds = "{path}"\nobjects = {{ {ramps}, "6076h" = 300 }}\n{steps}'),
        ("gear_ratio = 66.0\nencoder_increments_rev = 2000\n", ""),
        (f"velocity_unit_rad_s = {_UNIT}\n", ""),
        (f"unit_rad_s2 = {_UNIT}\n", f"unit_rad_s2 = {radians(0.04)!r}\n"),
    ]


def _without(*objects: str) -> Path:
    """Return a copy of the own drive's EDS without the objects of these patterns."""
    text = _own_eds()
    pattern = "|".join(objects)
    sections = re.split(r"(?m)^(?=\[)", text)
    kept = [one for one in sections if not re.match(rf"\[(?:{pattern})(?:sub\w+)?\]", one)]
    path = Path(_FOLDER.name, f"without_{'_'.join(objects)}.eds")
    path.write_text(re.sub(rf"(?m)^\d+=0x(?:{pattern})\n", "", "".join(kept)))
    return path


def _changed(eds: Path, **sections: str) -> Path:
    """Return a copy of an EDS with other entries in these sections.

    A section is the object's index and sub-index after an underscore, such as `_1A00sub1`; an
    entry is `KEY=VALUE`, and a space separates entries.
    """
    text = eds.read_text()
    for section, entries in sections.items():
        for entry in entries.split():
            begin = rf"(\[{section[1:]}\]\n(?:.+\n)*?){entry.partition('=')[0]}=.*"
            text, count = re.subn(begin, rf"\g<1>{entry}", text)
            assert count == 1, (section, entry)
    path = eds.with_stem(f"{eds.stem}_changed")
    path.write_text(text)
    return path


_FIXED = {f"_1A0{pdo}sub{place}": "AccessType=const" for pdo in range(4) for place in range(9)}
_FIXED |= {  # TPDO 2 has the position before the statusword, every 20 ms
    "_1A01sub0": "AccessType=const DefaultValue=2",
    "_1A01sub1": "AccessType=const DefaultValue=0x60640020",
    "_1A01sub2": "AccessType=const DefaultValue=0x60410010",
    "_1801sub5": "DefaultValue=20",
    "_6065": "AccessType=ro",
    "_605D": "AccessType=ro DefaultValue=2",
}
_NO_RPDOS = [
    *of_drive(f'eds = "{_without("140.", "160.", "60F4")}"'),
    ("latency_s = [0.0, 0.001]", "latency_s = [-0.03, 0.001]"),  # an SDO is answered afterwards
    (_SEEKING, f"{_SEEKING}\n[conformance.without]\n{_BY_SDO}"),
]
_NO_TPDOS = [
    *of_drive(f'eds = "{_without("180.", "1A0.")}"'),
    ("latency_s = [0.0, 0.001]", "latency_s = [-0.03, 0.001]"),  # its answers come afterwards
    NOT_BORNE,  # a wait that asks lasts longer
]
_TEN_MS = "AccessType=const DefaultValue=10"
_OWN_PERIOD = "its set-point period is fixed"
_STATUS_ALONE = [  # the position fits into no PDO, and set-points come every 10 ms
    *of_drive(
        f'eds = "{_changed(_without(), _6064="PDOMapping=0", _60C2sub1=_TEN_MS)}"',
    ),
    ("latency_s = [0.0, 0.001]", "latency_s = [-0.03, 0.001]"),
    NOT_BORNE,
    (
        _SEEKING,
        f'{_SEEKING}\n[conformance.without]\ncomplex_position = "{_OWN_PERIOD}"\n'
        f'complex_velocity = "{_OWN_PERIOD}"\n',
    ),
]
_CIA402 = (RIGS / "cia402.toml").read_text()
_PROGRAMS = (READ, APART)  # no change of the rig: benches that run further programs
VARIANTS = {name: VARIATIONS[name] for name in applicable(_CIA402) if name not in _PROGRAMS}
VARIANTS |= {"brakes gently": _GENTLY, "no RPDOs": _NO_RPDOS, "no TPDOs": _NO_TPDOS}
VARIANTS["SI units"] = _si_units()
VARIANTS["no heartbeat consumer"] = [
    *of_drive(f'eds = "{_without("1016")}"'),
    (_SEEKING, _WITHOUT_CONSUMER),
]
VARIANTS["position limits in the drive"] = of_drive(
    'objects = { "607Dh:1" = -210_000, "607Dh:2" = 210_000 }'
)
OF_ONE_PROGRAM = {
    "fixed TPDOs and window, no factors": [
        *of_drive(f'eds = "{_changed(_without("608F", "6091", "6092"), **_FIXED)}"'),
        ("latency_s = [0.0, 0.001]", "latency_s = [-0.02, 0.001]"),  # the status is heard later
    ],
    "no position in PDOs": _STATUS_ALONE,
}
"""Drives that refuse the PDOs of each program, which stops the node (NMT) to write them."""
BENCHES = {
    kind: (OWN, *applicable((RIGS / f"{kind}.toml").read_text()))
    for kind in KINDS
    if kind != "cia402"
}
BENCHES["cia402"] = _PROGRAMS
"""The benches of all other kinds, as they are and varied, and those with further programs."""
OTHERS = [
    (kind, name)
    for kind in ("cia402", "dynamixel", "mit", "robstride")
    for name in BENCHES[kind]
    if name
]
VENDORS = ("roboteq_v80.eds", "schunk_prl_erb_0_63.dcf", "technosoft_ipos.eds")


def of_vendor(file: Path) -> list[Change]:
    """Return the changes for drives with the object dictionary of this vendor's file."""
    watched = 'objects = { "6065h" = 20_000 }'  # some files switch the following error off
    return [*of_drive(f'eds = "{file}"\n{watched}'), (_SEEKING, _WITHOUT_CONSUMER)]


def text_of(changes: list[Change]) -> str:
    """Return the text of the kit's CiA 402 rig with these changes."""
    return variations.text_of(_CIA402, changes)
