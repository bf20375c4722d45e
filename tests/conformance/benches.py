"""The kit's own rigs, one for each kind of hardware that is built in."""

from functools import cache
from pathlib import Path

import harness.conformance
from harness.conformance.claims import Claims
from harness.conformance.rig_bench import RigBench, bench_description
from harness.rig import installed_plugins
from harness.rig_file import read_rig

RIGS = Path(harness.conformance.__file__).parent / "rigs"
KINDS = tuple(sorted(path.stem for path in RIGS.glob("*.toml")))


@cache
def described(kind):
    """The rig of a kind, as a bench needs it."""
    return bench_description(read_rig(RIGS / f"{kind}.toml", installed_plugins()), kind)


def opener(kind, seed=1, **options):
    """What switches on a bench of this kind."""
    return lambda: RigBench(described(kind), seed, **options)


@cache
def claims(kind):
    """What its motors claim."""
    return Claims(opener(kind))
