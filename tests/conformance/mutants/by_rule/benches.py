"""Benches for mutants made by rule: the kit's own, and correct variants of one of them.

Everything here is imported late: a changed module must be imported in its place.
"""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any, Final

VARIANTS: Final = (
    *("linear axis", "inverted polarity", "inverted velocities", "brakes gently", "only pp"),
    *("halt by the quick stop ramp", "quirk halt_holds_mode", "starts near the end of the counter"),
    *("torque limit in the drive", "units of the drive", "PDOs without identifiers", "no RPDOs"),
    "position limits in the drive",
)
_OF: Final = "cia402: "


@cache
def names() -> tuple[str, ...]:
    """Return the names of all benches."""
    from tests.support.kit_benches import KINDS

    return (*KINDS, *(f"{_OF}{one}" for one in VARIANTS))


@cache
def opener(name: str) -> Any:
    """Return an opener of this bench."""
    from motorhil.harness.conformance.rig_bench import RigBench, bench_description
    from motorhil.harness.rig.config.rig_file import read_rig
    from motorhil.harness.rig.rig import installed_plugins
    from tests.conformance import variants
    from tests.support import kit_benches

    if not name.startswith(_OF):
        return kit_benches.opener(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rig.toml")
        path.write_text(variants.text_of(variants.VARIANTS[name.removeprefix(_OF)]))
        described = bench_description(read_rig(path, installed_plugins()), "cia402")
    return lambda: RigBench(described, 1)


@cache
def claims(name: str) -> Any:
    """Return the claims of the motors of this bench."""
    from motorhil.harness.conformance.run import Claims

    return Claims(opener(name))


def verdict(clause: str, name: str, *, claims_anew: bool = False) -> Any:
    """Return the verdict of a clause on a bench."""
    from motorhil.harness.conformance.kit import all_clauses
    from motorhil.harness.conformance.run import home_of, run_clause

    known = None if claims_anew else claims(name)
    return run_clause(all_clauses()[clause], opener(name), known, home_of("motorhil.motorapi"))


def forget() -> None:
    """Forget all benches, since their modules are imported again."""
    for one in (names, opener, claims):
        one.cache_clear()
