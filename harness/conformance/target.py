"""Target of an examination: the loaded adaptation and its rig.

A job names both, and is what a supervisor sends to its worker.
"""

import inspect
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, final

from motorhil.harness.conformance.bench import Opener
from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.benches.variations import (
    APART,
    OWN,
    READ,
    applicable,
    changes_of,
    parts_of,
    text_of,
)
from motorhil.harness.conformance.benches.worlds import fragment_of, is_world
from motorhil.harness.conformance.clause import Clause
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.places import home_of
from motorhil.harness.plugins import ADAPTATIONS, installed, is_target, named
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED, Facts
from motorhil.harness.rig.config.rig_file import RigDescription, parse_rig, read_rig
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError, Source, a_kind_of
from motorhil.harness.rig.reading import describe, installed_plugins
from motorhil.settings import listed, nearest

_LIVE_DEADLINE_S: Final = 120.0
OWN_RIGS: Final = Path(__file__).parent / "rigs"


@final
class Target:
    """The loaded adaptation and the rig of a job.

    Attributes:
        rig: the description, with the motors under test.
        seed: the seed of all random numbers.
        deadline_s: for one clause, in wall time [s].
        variations: the names of the variations that the rig can have.
        home: the folder of the adaptation's code (`places.home_of`).

    Raises:
        RigError: the adaptation or the rig cannot be used.
    """

    def __init__(self, job: Job) -> None:
        build = _loaded(job.adaptation) if job.adaptation else None
        described = _described(Path(job.rig) if job.rig else _own_rig(job.adaptation, build))
        self.rig: RigDescription = bench_description(described, job.adaptation or None)
        is_own = not job.rig and not job.on and described.source.path.parent == OWN_RIGS
        self.variations: Final = applicable(described.source.text) if is_own else ()
        self._described = described
        self._job = job
        self._varied: dict[str, RigDescription] = {OWN: self.rig}
        self.seed: int = described.seed if job.seed is None else job.seed
        first = self.rig.motors[self.rig.conformance.motors[0]]
        self._places = _places(job, self.rig) if job.on else None
        self.deadline_s: Final = _deadline_s(self.rig.conformance, is_live=bool(job.on))
        self.adaptation: Final = first.adaptation
        self.home: Final = home_of(getattr(build or _loaded(self.adaptation), "__module__", ""))

    def clauses(self) -> Mapping[str, Clause]:
        """Return the clauses for adaptations."""
        return all_clauses()

    def opener(self, record: Path | None = None, variation: str = OWN) -> Opener:
        """Return an opener for benches of this rig, varied, which record all to `record`."""
        if self._places is None:
            rig, parts = self._with(variation), parts_of(variation)
            return lambda: RigBench(
                rig,
                self.seed,
                record=record,
                is_observed=record is not None,
                is_read=READ in parts,
                is_apart=APART in parts,
            )
        from motorhil.harness.conformance.benches.wall_bench import WallBench

        places = self._places
        return lambda: WallBench(self.rig, places, self.seed, record=record)

    def _with(self, variation: str) -> RigDescription:
        found = self._varied.get(variation)
        if found is None:
            source = self._described.source
            if is_world(variation):
                text = f"{source.text}\n{fragment_of(variation, self._described)}"
            else:
                text = text_of(source.text, changes_of(variation))
            described = parse_rig(Source(source.path, text), installed_plugins())
            described = replace(described, name=f"{described.name}, {variation}")
            found = bench_description(described, self._job.adaptation or None)
            self._varied[variation] = found
        return found


def _described(path: Path) -> RigDescription:
    """Return the rig in a file; detecting a recording takes 0.1 s, so skip it for TOML files."""
    if path.suffix == ".toml":
        return read_rig(path, installed_plugins())
    return describe(path)


def _places(job: Job, rig: RigDescription) -> dict[str, str]:
    from motorhil.harness.conformance.benches.wall_bench import places_in

    return places_in(job.on, rig)


def _deadline_s(facts: Facts, is_live: bool) -> float:
    """Return the declared deadline; a live bench's default allows for the motions themselves."""
    is_declared = facts.deadline_s != NOTHING_DECLARED.deadline_s
    return facts.deadline_s if is_declared or not is_live else _LIVE_DEADLINE_S


def _loaded(adaptation: str) -> object:
    """Return the function that builds the adaptation's motors."""
    where = f"adaptation {adaptation}"
    known = list(installed(ADAPTATIONS))
    if not is_target(adaptation) and adaptation not in known:
        message = f"is not installed (known: {listed(known)})"
        remedy = nearest(adaptation, known)
        if not remedy.startswith("did"):
            remedy = "name one of these, or a function as package.module:function"
        raise RigError(where, message, remedy)
    try:
        loaded = named(ADAPTATIONS, adaptation).load()
    except (Exception, SystemExit) as error:
        raise BrokenPluginError(
            where,
            f"cannot be loaded: {type(error).__name__}: {error}",
            "correct the adaptation or its name",
        ) from error
    if not callable(loaded):
        raise BrokenPluginError(where, f"is {a_kind_of(loaded)}", "name a function")
    return loaded


def _own_rig(adaptation: str, build: object) -> Path:
    """Return the rig that comes with the adaptation."""
    own = OWN_RIGS / f"{adaptation}.toml"
    if own.exists():
        return own
    given = getattr(build, "conformance_rig", None)
    if not isinstance(given, str | os.PathLike):
        raise RigError(f"adaptation {adaptation}", "has no rig of its own", "add --rig RIG")
    module = inspect.getmodule(build)
    folder = Path(getattr(module, "__file__", None) or ".").parent
    return folder / given
