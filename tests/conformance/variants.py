"""Correct motors that differ from the kit's own: the kit must accuse none of them."""

from pathlib import Path

from motorhil.harness.conformance.benches import variations
from motorhil.harness.conformance.benches.variations import VARIATIONS, Change, of_drive
from tests.support.kit_benches import RIGS

_SEEKING = "seeking_method = 17\n"
_WITHOUT_CONSUMER = '\n[conformance.without]\ndead_man = "the file has no heartbeat consumer"\n'
_ACCELERATION = "acceleration_max_rad_s2 = 4.0"
_GENTLY = [(_ACCELERATION, f"{_ACCELERATION}\ndeceleration_max_rad_s2 = 1.0")]
VARIANTS = {**VARIATIONS, "brakes gently": _GENTLY}
VENDORS = ("roboteq_v80.eds", "schunk_prl_erb_0_63.dcf", "technosoft_ipos.eds")


def of_vendor(file: Path) -> list[Change]:
    """Return the changes for drives with the object dictionary of this vendor's file."""
    return [*of_drive(f'eds = "{file}"'), (_SEEKING, _WITHOUT_CONSUMER)]


def text_of(changes: list[Change]) -> str:
    """Return the text of the kit's CiA 402 rig with these changes."""
    return variations.text_of((RIGS / "cia402.toml").read_text(), changes)
