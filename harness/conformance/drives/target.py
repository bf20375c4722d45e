"""Target of an examination of a drive: a controller of a rig."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, final

from motorhil.harness.conformance.benches.variations import OWN
from motorhil.harness.conformance.clause import Clause, NotApplicable
from motorhil.harness.conformance.drives.bench import EmulatedBench, RealBench, node_of
from motorhil.harness.conformance.drives.kit import drive_clauses
from motorhil.harness.conformance.drives.objects import Mode
from motorhil.harness.conformance.job import Job
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import describe
from motorhil.settings import listed, nearest

_DEADLINE_S: Final = 120.0
OWN_RIG: Final = Path(__file__).parent / "drive.toml"


@final
class DriveTarget:
    """The drive of a job: a controller of its rig, or of the kit's own rig.

    Attributes:
        rig: the description of the rig; `conformance.motors` has the name of the drive.
        seed: the seed of all random numbers.
        deadline_s: for one clause, in wall time [s].
        adaptation: the name of the drive, which stands where results name the adaptation.
        home: "": there is no code under test in this process.
        variations: none: the drive is judged on its own rig.

    Raises:
        RigError: the rig has no such drive, or cannot be used.
    """

    def __init__(self, job: Job) -> None:
        described = describe(Path(job.rig) if job.rig else OWN_RIG)
        found = described.controllers
        if job.controller not in found:
            known = list(found)
            remedy = nearest(job.controller, known)
            if not remedy.startswith("did"):
                remedy = f"use --controller {known[0]}, or a rig of yours: --rig RIG"
                if job.rig:
                    remedy = f"use a name, such as --controller {known[0]}"
            kinds = [f"{name} (of the kind {one.kind})" for name, one in found.items()]
            place = f"{described.source.path}" if job.rig else "the kit's own rig"
            problem = f"{place} has no such controller; it has {listed(kinds)}"
            raise RigError(f"--controller {job.controller}", problem, remedy)
        facts = replace(described.conformance, motors=(job.controller,))
        self.rig: Final = replace(described, conformance=facts)
        self.seed: Final = described.seed if job.seed is None else job.seed
        is_declared = facts.deadline_s != NOTHING_DECLARED.deadline_s
        self.deadline_s: Final = facts.deadline_s if is_declared else _DEADLINE_S
        self.adaptation: Final = job.controller
        self.home: Final = ""
        self.variations: Final[tuple[str, ...]] = ()
        controller = described.controllers[job.controller]
        node_of(controller)
        self._where: Final = _place(job, self.rig, controller.bus) if job.on else None

    def clauses(self) -> Mapping[str, Clause]:
        """Return the clauses for drives."""
        return drive_clauses()

    def opener(self, record: Path | None = None, variation: str = OWN) -> Callable[[], Any]:
        """Return an opener for benches with this drive, which record everything to `record`."""
        assert variation == OWN, variation
        where = self._where
        if where is None:
            return lambda: EmulatedBench(self.rig, self.adaptation, self.seed, record=record)
        return lambda: RealBench(self.rig, self.adaptation, where, self.seed, record=record)

    def claims(self) -> dict[str, str]:
        """Return by mode why 6502h does not claim it; "" if it does."""
        claims = {f"{mode}": "the drive does not tell" for mode in Mode}
        with self.opener()() as bench:
            for mode in Mode:
                with suppress(NotApplicable):
                    claims[f"{mode}"] = ""
                    bench.drive.require_mode(mode)
                    continue
                claims[f"{mode}"] = f"6502h bit {mode - 1} is 0"
        return claims


def _place(job: Job, rig: RigDescription, bus: str) -> str:
    """Return the place of the drive's bus."""
    from motorhil.harness.conformance.benches.wall_bench import places_of

    return places_of(job.on, [bus], rig)[bus]
