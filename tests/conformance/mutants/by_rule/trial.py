"""Trials: a mutant against the clauses that execute it, until one kills it."""

import gc
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from importlib import import_module
from typing import Final

from tests.conformance.mutants.by_rule import benches
from tests.conformance.mutants.by_rule.children import Tell, answers, cpu_s, limit
from tests.conformance.mutants.by_rule.execution import Run
from tests.conformance.mutants.by_rule.loading import forget_results, load
from tests.conformance.mutants.by_rule.sources import Mutant

_LEAST_S: Final = 4.0
_TIMES: Final = 8.0
_WALL_S: Final = 60.0
"""A check hangs after this many times its cost, in processor time, or after a minute of waiting."""


class Outcome(Enum):
    """How a trial ended."""

    KILLED = "killed"
    HANGS = "hangs"
    WITHDRAWN = "withdrawn"  # no clause fails, but one is no longer applicable
    SURVIVED = "survived"
    NOT_EXECUTED = "not executed"

    @property
    def is_found(self) -> bool:
        """True if a user of the kit sees the mistake."""
        return self in (Outcome.KILLED, Outcome.HANGS)


@dataclass(slots=True)
class Trial:
    """The end of a mutant.

    Attributes:
        mutant: the mutant.
        outcome: how it ended.
        clause, bench: the last clause that was checked.
        seen, place: from its verdict.
        ran: all clauses that were checked, as "CLAUSE on BENCH".
        cpu_s: the processor time [s].
    """

    mutant: Mutant
    outcome: Outcome
    clause: str = ""
    bench: str = ""
    seen: str = ""
    place: str = ""
    ran: list[str] = field(default_factory=list)
    cpu_s: float = 0.0


def prepare(modules: Sequence[str] = ()) -> None:
    """Import everything that trials need, once, before they are forked."""
    for name in modules:
        with suppress(ImportError):
            import_module(name)
    for name in benches.names():
        benches.clauses(name)
        with benches.opener(name)():  # reads the files that benches are made of
            pass
    forget_results()
    assert threading.active_count() == 1, "a fork takes only one thread along"
    gc.collect()
    gc.freeze()


def tried(mutant: Mutant, plan: Sequence[Run], *, afresh: bool = False) -> Trial:
    """Return the trial of a mutant by these runs.

    Args:
        mutant: the mutant.
        plan: the runs, in order.
        afresh: import all modules again, since the mutant takes effect then.
    """
    if not plan:
        return Trial(mutant, Outcome.NOT_EXECUTED)
    trial = Trial(mutant, Outcome.SURVIVED)
    for answer in answers(lambda tell: _check(mutant, plan, afresh, tell)):
        if answer is None:
            trial.outcome, trial.seen = Outcome.HANGS, "ended by its limit of time"
        elif "raised" in answer:
            trial.outcome, trial.clause = Outcome.KILLED, trial.clause or "import"
            trial.seen, trial.place = answer["raised"], answer["at"]
        elif "begin" in answer:
            trial.clause, trial.bench = answer["begin"]
            trial.ran.append(f"{trial.clause} on {trial.bench}")
        else:
            trial.cpu_s = answer["cpu_s"]
            if answer["outcome"]:
                trial.outcome = Outcome(answer["outcome"])
                trial.seen, trial.place = answer["seen"], answer["place"]
                trial.clause, trial.bench = answer["of"]
    return trial


def _check(mutant: Mutant, plan: Sequence[Run], afresh: bool, tell: Tell) -> None:
    limit(2.0 * _LEAST_S, _WALL_S)
    begin_s = cpu_s()
    load(mutant, afresh=afresh)
    if afresh:
        for run in plan:
            benches.clauses(run.bench)
    withdrawn = None
    for run in plan:
        limit(max(_LEAST_S, _TIMES * run.cpu_s), _WALL_S)
        tell({"begin": (run.clause, run.bench)})
        verdict = benches.verdict(run.clause, run.bench)
        answer = {
            "of": (run.clause, run.bench),
            "seen": verdict.seen,
            "place": verdict.place,
            "cpu_s": cpu_s() - begin_s,
            "outcome": "",
        }
        if verdict.result.is_good is (run.result == "failed"):  # or a known finding has gone
            is_hanging = verdict.result.value == "hung"
            outcome = Outcome.HANGS if is_hanging else Outcome.KILLED
            seen = verdict.seen or f"no finding: {run.clause} fails on this drive"
            tell({**answer, "seen": seen, "outcome": outcome.value})
            return
        if verdict.result.value != run.result and withdrawn is None:
            withdrawn = {**answer, "outcome": Outcome.WITHDRAWN.value}
        tell(answer)
    if withdrawn is not None:
        tell({**withdrawn, "cpu_s": cpu_s() - begin_s})
