"""Plan of a campaign: all that a worker needs to run any of its worlds.

A plan is a value. Its digest covers the rig, the program, the oracles and the build, so that
results of different plans never mix.
"""

import hashlib
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.recording import digest_of, files_of
from motorhil.harness.swarm.worlds.profile import Profile, profile_from
from motorhil.harness.version import source_digest, version

if TYPE_CHECKING:
    from motorhil.harness.rig.config.worlds import SwarmTable

SCRIPT: Final = "script"
FUNCTION: Final = "function"
PYTEST: Final = "pytest"
PROGRAMS: Final = "programs"
_BATCH_MAX: Final = 32
_BATCH_FRAMES: Final = 16_000
"""Frames of a batch: a second or so of computing."""
_END_S: Final = 60.0
_END_FACTOR: Final = 10
WALL_S: Final = 60.0
"""Time on the wall clock that one world may take, by default [s]."""


@final
@frozen
class Program:
    """The application of a campaign.

    Attributes:
        kind: SCRIPT, FUNCTION, PYTEST, or PROGRAMS for those of the rig.
        name: a file, "package.module:function", a node id of pytest, or the rig file.
        words: arguments of a script or of pytest.
    """

    kind: str
    name: str
    words: tuple[str, ...] = ()

    def contents(self) -> bytes:
        """Return what identifies its code: the Python files of its folder, or its name."""
        path = self._file()
        if path is None:
            return self.name.encode()
        folder = sorted(path.resolve().parent.glob("*.py"))
        return b"".join(one.name.encode() + b"\0" + one.read_bytes() for one in folder)

    def _file(self) -> Path | None:
        """Return the file of its code, without importing it; None if it is not found."""
        if self.kind != FUNCTION:
            path = Path(self.name.partition("::")[0])
            return path if path.is_file() else None
        module = Path(*self.name.partition(":")[0].split("."))
        names = (module.with_suffix(".py"), module / "__init__.py")
        places = [Path(place) / name for place in ("", *sys.path) for name in names]
        return next((place for place in places if place.is_file()), None)


@final
@frozen
class Plan:
    """A campaign, without its seeds.

    Attributes:
        rig: the rig file.
        program: the application.
        oracles: ids of the oracles that judge; empty: a safe choice.
        wall_s: time on the wall clock that one world may take [s].
        build: version and digest of the sources that made the plan.
        contents: digest of rig, its files and program.
        profile: the undisturbed run; None before it.
    """

    rig: str
    program: Program
    oracles: tuple[str, ...] = ()
    wall_s: float = WALL_S
    build: str = ""
    contents: str = ""
    profile: Profile | None = None

    def digest(self) -> str:
        """Return a short digest of the plan; results belong together if it is the same."""
        text = json.dumps(replace(self, rig="").as_table(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def batch(self) -> int:
        """Return how many worlds of a lane run one after the other in one process.

        Short worlds share a process, which costs as much as some of them. Sessions of pytest and
        programs with processes of their own share none.
        """
        if self.profile is None or self.program.kind not in (SCRIPT, FUNCTION):
            return 1
        frames = sum(one.frames for one in self.profile.traffic)
        return max(1, min(_BATCH_MAX, _BATCH_FRAMES // max(1, frames)))

    def end_ns(self, table: "SwarmTable") -> int:
        """Return the simulated time at which a run has failed [ns]."""
        if table.end_s is not None:
            return round(table.end_s * 1e9)
        usual = 0 if self.profile is None else self.profile.end_ns
        return max(round(_END_S * 1e9), _END_FACTOR * usual)

    def as_table(self) -> dict[str, object]:
        """Return it for JSON."""
        seen = None if self.profile is None else self.profile.as_table()
        return {**asdict(self), "profile": seen}


def plan_of(rig: Path, program: Program, oracles: tuple[str, ...], wall_s: float) -> Plan:
    """Return the plan of a campaign, without the profile of its undisturbed run.

    Raises:
        RigError: the rig cannot be used.
    """
    return Plan(str(rig), program, oracles, wall_s, build(), contents_of(rig, program))


def plan_from(table: Mapping[str, Any]) -> Plan:
    """Return the plan of `as_table`."""
    program = table["program"]
    profile = table["profile"]
    return Plan(
        table["rig"],
        Program(program["kind"], program["name"], tuple(program["words"])),
        tuple(table["oracles"]),
        table["wall_s"],
        table["build"],
        table["contents"],
        None if profile is None else profile_from(profile),
    )


def build() -> str:
    """Return the version, and the digest of the sources."""
    return f"{version()} {source_digest()}"


def contents_of(rig: Path, program: Program) -> str:
    """Return the digest of the rig, the files that it names, and the program."""
    return digest_of(files_of(describe(rig)), program.contents())[:16]
