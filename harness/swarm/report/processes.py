"""Processes of a campaign: which of its worlds ran alone.

Short worlds share a process in batches. A world that does not pass runs again alone, and some that
pass run alone as well. If a result depends on the worlds before, all run anew, each one alone.
"""

from collections import Counter
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.swarm.lanes import batch_of, is_checked, lane_of
from motorhil.harness.swarm.plan import Plan
from motorhil.harness.swarm.results import Results
from motorhil.harness.swarm.row import CANARY, Result

KEEPS: Final = "the program keeps state, so each world has run in a process of its own"


@final
@frozen
class Processes:
    """How the worlds of a campaign were divided into processes.

    Attributes:
        batch: number of worlds that share a process, at most.
        alone: seeds whose results come from a process of their own, or were compared with one.
        keeps_state: True if all worlds ran anew alone, because the program keeps state.
        shown_by: a seed whose result depended on the worlds before it; None if none is known.
    """

    batch: int = 1
    alone: tuple[int, ...] = ()
    keeps_state: bool = False
    shown_by: int | None = None

    def told(self) -> str:
        """Return it in a sentence."""
        if self.keeps_state:
            known = self.shown_by is not None
            shown = f"The result of seed {self.shown_by} depends on the worlds before it. "
            return f"{shown if known else ''}{KEEPS[0].upper()}{KEEPS[1:]}."
        if self.batch == 1:
            return "Each world has run in a process of its own."
        return (
            f"Up to {self.batch} worlds have shared a process. Each that did not pass, and some "
            "that passed, have run alone as well, with the same result."
        )


def processes_of(plan: Plan, results: Results) -> Processes:
    """Return how the worlds of a folder were divided into processes."""
    rows = {seed: row for seed, row in results.rows.items() if seed != CANARY}
    batch = 1 if results.is_alone else plan.batch()
    sizes = Counter((lane_of(seed), batch_of(seed, batch)) for seed in rows)
    alone = tuple(
        seed
        for seed, row in sorted(rows.items())
        if row.result is not Result.PASSED
        or is_checked(seed, batch)
        or sizes[lane_of(seed), batch_of(seed, batch)] == 1
    )
    return Processes(batch, alone, results.is_alone, results.shown_by)
