"""The kit's rigs, one for each built-in kind of hardware."""

from functools import cache
from pathlib import Path

import motorhil.harness.conformance
from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.rig.config.rig_file import read_rig
from motorhil.harness.rig.reading import installed_plugins

RIGS = Path(motorhil.harness.conformance.__file__).parent / "rigs"
KINDS = tuple(sorted(path.stem for path in RIGS.glob("*.toml") if "\n[motor." in path.read_text()))
"""The kinds whose rigs have motors; the others are for controllers alone."""


@cache
def described(kind):
    """Return the rig of a kind as a bench description."""
    return bench_description(read_rig(RIGS / f"{kind}.toml", installed_plugins()), kind)


def opener(kind, seed=1, **options):
    """Return an opener of benches of this kind."""
    return lambda: RigBench(described(kind), seed, **options)


@cache
def claims(kind):
    """Return the claims of the motors of this kind."""
    return Claims(opener(kind))
