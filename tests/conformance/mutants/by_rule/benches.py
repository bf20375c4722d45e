"""Benches for mutants made by rule: the kit's own, correct variants of one of them, and drives.

On the benches of drives, the clauses for drives judge the emulated drive alone.

Everything here is imported late: a changed module must be imported in its place.
"""

import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, Final

VARIANTS: Final = (
    *("linear axis", "inverted polarity", "inverted velocities", "brakes gently", "only pp"),
    *("halt by the quick stop ramp", "quirk halt_holds_mode", "starts near the end of the counter"),
    *("torque limit in the drive", "two units of speed", "PDOs without identifiers", "no RPDOs"),
    *("position limits in the drive", "no TPDOs", "SI units", "no heartbeat consumer"),
    *("home offset", "fixed TPDOs and window, no factors", "no position in PDOs"),
)
VARIED: Final = {
    "cia402": (
        *("motor options", "lost host disables", "units of the drive + reversing gear"),
        *("limited jerk", "three motors + fast clock", "quirk inverted_set_point_acknowledge"),
        *("two buses with equal node-IDs", "identifiers of its own"),
    ),
    "dryve": (
        "dryve options + dryve drive options + velocities in rpm",
        "dryve awaited for longer",
        "linear axis of a dryve",
    ),
    "dynamixel": ("servo options + servo drive options",),
    "ideal": ("ideal motor begins at 0.3 rad + ideal motor with limited jerk",),
    "leadshine": (
        "Leadshine over TCP + Leadshine options + Leadshine drive options",
        "Leadshine awaited for longer",
        "linear axis of a Leadshine drive",
    ),
    "mit": ("impedance options + impedance drive options + other ranges",),
    "moteus": ("moteus options + moteus drive options", "linear axis of a moteus"),
    "oriental_az": ("AZ over TCP + AZ options + AZ drive options", "linear axis of an AZ drive"),
    "rmd": ("RMD options + RMD drive options",),
    "robstride": ("RobStride options + other ranges of a RobStride",),
    "software": (
        *("servo options of the host + gains of the host's servo", "amplifier options"),
        *("linear axis of the host's servo", "two amplifiers on two buses"),
    ),
    "vesc": ("VESC options + VESC drive options", "linear axis of a VESC"),
}
"""Further variations of the kit, by kind: those of options, and pairs of others."""
_FEW: Final = (
    *("UNIT-01", "STATE-01", "STATE-02", "MEAS-01", "MEAS-02", "MEAS-04", "SET-01", "SET-03"),
    *("TRAJ-01", "TRAJ-03", "TRAJ-13", "TRAJ-14", "SYNC-11", "SYNC-12", "SYNC-17", "LOW-09"),
    *("SET-05", "SET-10", "TRAJ-02", "TRAJ-04", "TRAJ-05", "TRAJ-11", "LEAD-01", "START-03"),
    *("LIM-02", "STOP-01", "STOP-03", "FAULT-01", "FAULT-03", "HEAR-02", "HEAR-03", "LOW-04"),
    *("SHARE-03", "SYNC-01", "SYNC-03", "SYNC-07", "OTHER-01", "OVER-01", "LOST-01", "LOST-03"),
    *("LOST-07", "LOST-13", "PAR-01", "SYNC-13", "SYNC-23", "HOME-01", "SET-14"),
)
"""The clauses on further variations, since all others say nothing new."""
OUTSIDERS: Final = ("new drive", "odrive", "few hooks")
"""Adaptations of packages: they keep most defaults of the bases, which our own replace."""
_OF: Final = "cia402: "
_DRIVE: Final = "drive: "


@cache
def names() -> tuple[str, ...]:
    """Return the names of all benches."""
    from tests.conformance.drives.rigs import DRIVES
    from tests.support.kit_benches import KINDS

    variants = (f"{_OF}{one}" for one in VARIANTS)
    varied = (f"{kind}: {name}" for kind, names in VARIED.items() for name in names)
    return (*KINDS, *OUTSIDERS, *variants, *varied, *(f"{_DRIVE}{one}" for one in DRIVES))


def is_of_drive(name: str) -> bool:
    """Return whether the clauses for drives judge this bench."""
    return name.startswith(_DRIVE)


def clauses(name: str) -> Any:
    """Return the clauses for this bench by id."""
    from motorhil.harness.conformance.drives.kit import drive_clauses
    from motorhil.harness.conformance.kit import all_clauses
    from tests.conformance.drives import rigs

    if not is_of_drive(name):
        kind, _, variation = name.partition(": ")
        is_further = variation in VARIED.get(kind, ())
        return {key: one for key, one in all_clauses().items() if key in _FEW or not is_further}
    own = rigs.CLAUSES.get(name.removeprefix(_DRIVE))
    return {key: one for key, one in drive_clauses().items() if own is None or key in own}


def has_known_finding(clause: str, name: str) -> bool:
    """Return whether this clause must fail on this bench: its drive deviates on purpose."""
    from tests.conformance.drives.rigs import known_finding

    return is_of_drive(name) and known_finding(name.removeprefix(_DRIVE)) == clause


@cache
def opener(name: str) -> Any:
    """Return an opener of this bench."""
    from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
    from motorhil.harness.conformance.job import Job
    from motorhil.harness.conformance.target import Target
    from motorhil.harness.rig.config.rig_file import read_rig
    from motorhil.harness.rig.reading import installed_plugins
    from tests.conformance import variants
    from tests.conformance.drives import rigs
    from tests.support import kit_benches

    if is_of_drive(name):
        return rigs.opener(name.removeprefix(_DRIVE))
    kind, _, variation = name.partition(": ")
    if variation in VARIED.get(kind, ()):
        return Target(Job(kind)).opener(None, variation)
    if name in OUTSIDERS:
        return _outsider(name)
    if not variation:
        return kit_benches.opener(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rig.toml")
        known = variants.VARIANTS | variants.OF_ONE_PROGRAM
        path.write_text(variants.text_of(known[name.removeprefix(_OF)]))
        described = bench_description(read_rig(path, installed_plugins()), "cia402")
    return lambda: RigBench(described, 1)


def _outsider(name: str) -> Any:
    """Return an opener of the bench of a package, which is not installed."""
    import motorhil.harness.examples.new_drive as new_drive
    from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
    from motorhil.harness.rig.config.rig_file import read_rig
    from motorhil.harness.rig.reading import installed_plugins
    from tests.support.outsider_source import OUTSIDER

    rig = Path(new_drive.__file__).with_name("rig.toml")
    text, adaptation = rig.read_text(), "motorhil.harness.examples.new_drive.host:build"
    if name == "few hooks":
        own = "tests.conformance.benches.template_drive:few_hooks"
        text, adaptation = text.replace(adaptation, own), own
        text = text.replace("window_rad = 0.002", "window_rad = 0.0015")  # for many tiny moves
    if name == "odrive":
        sources = str(OUTSIDER / "src")
        if sources not in sys.path:
            sys.path.append(sources)
        rig = Path(sources, "motorhil_odrive", "rig.toml")
        adaptation = "motorhil_odrive.host.build:build"
        text = rig.read_text().replace(
            'kind = "odrive"', 'kind = "motorhil_odrive.emulated.build:build"'
        )
        text = text.replace('adaptation = "odrive"', f'adaptation = "{adaptation}"')
    model = next(rig.parent.glob("*model.toml"))
    text = text.replace(f'"{model.name}"', f'"{model}"')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rig.toml")
        path.write_text(text)
        described = bench_description(read_rig(path, installed_plugins()), adaptation)
    return lambda: RigBench(described, 1)


@cache
def claims(name: str) -> Any:
    """Return the claims of the motors of this bench."""
    from motorhil.harness.conformance.claims import Claims

    return Claims(opener(name))


def verdict(clause: str, name: str, *, claims_anew: bool = False) -> Any:
    """Return the verdict of a clause on a bench."""
    from motorhil.harness.conformance.places import home_of
    from motorhil.harness.conformance.run import run_clause

    found = clauses(name)[clause]
    if is_of_drive(name):
        return run_clause(found, opener(name))
    known = None if claims_anew else claims(name)
    return run_clause(found, opener(name), known, home_of("motorhil.motorapi"))


def forget() -> None:
    """Forget all benches, since their modules are imported again."""
    for one in (names, opener, claims):
        one.cache_clear()
