"""Checks of clauses in this process, each on a new bench.

A check that never ends, or that ends the process, is handled by `Supervisor`. After a check the
process is searched for leaks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.conformance.bench import Opener
from motorhil.harness.conformance.benches.rig_bench import RigBench, TimeIsUp
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.conformance.clause import Clause, NotApplicable, Result, Verdict, Violated
from motorhil.harness.conformance.leaks import watched
from motorhil.harness.conformance.places import CLAUSES, raised_at
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED, Facts
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError
from motorhil.motorapi import LimitError, MotorError, MotorModel, PluginError, UnsupportedError

if TYPE_CHECKING:
    from motorhil.harness.conformance.bench import RigProtocol
    from motorhil.harness.conformance.verdicts.observation import Observation

_OPTIONAL: Final = ("hypothesis",)  # that some clauses need and motorhil does not


def run_clauses(clauses: Iterable[Clause], open_bench: Opener) -> Iterator[Verdict]:
    """Yield the verdict of each clause as soon as it is known."""
    claims = Claims(open_bench)
    for one in clauses:
        yield run_clause(one, open_bench, claims)


def run_clause(
    one: Clause, open_bench: Opener, claims: Claims | None = None, home: str = ""
) -> Verdict:
    """Return the verdict of one clause.

    Args:
        one: the clause.
        open_bench: switches on a bench for it.
        claims: the claims of the motors of such benches.
        home: the adaptation's folder, whose lines are preferred (`home_of`).

    Raises:
        RigError: the rig file cannot be used.
    """
    with watched() as watch:
        verdict = _checked(one, open_bench, claims or Claims(open_bench), _Judge(one, home))
        left = "; ".join(watch.left())
    if left and verdict.result is Result.PASSED:
        return replace(verdict, result=Result.LEFT_BEHIND, seen=left)
    if left:
        seen = f"{verdict.seen}; and left behind: {left}".lstrip("; ")
        return replace(verdict, seen=seen)
    return verdict


def _checked(one: Clause, open_bench: Opener, claims: Claims, judge: "_Judge") -> Verdict:
    """Return the verdict; keep no reference to the bench."""
    time_ns, name = 0, ""
    try:
        _require_claimed(one, claims)
        with open_bench() as bench:
            judge.facts = bench.facts
            name = bench.name if isinstance(bench, RigBench) else ""
            try:
                _require_able(one, bench)
                one.check(bench)
                verdict = Verdict(one.id, Result.PASSED)
            except BaseException as error:
                if isinstance(error, LimitError):  # asking for a motor connects it
                    judge.models = tuple(motor.model for motor in bench.motors)
                verdict = judge.verdict(error)
                if not verdict.result.is_good:
                    seen = bench.observation if isinstance(bench, RigBench) else None
                    if seen is not None:
                        seen.look(bench.runtime.now_ns())
                    verdict = judge.diagnosed(verdict, error, seen)
            time_ns = bench.runtime.now_ns()
    except BaseException as error:  # while the bench was switched on or off
        verdict = judge.verdict(error)
        if not verdict.result.is_good:
            verdict = judge.diagnosed(verdict, error, None)
    return replace(verdict, time_ns=time_ns, bench=name)


def _require_claimed(one: Clause, claims: Claims) -> None:
    for capability in one.needs:
        why_not = claims.why_not(capability)
        if why_not:
            raise NotApplicable(why_not)


def _require_able(one: Clause, bench: "RigProtocol") -> None:
    for ability in one.bench:
        if ability not in bench.abilities:
            raise NotApplicable(f"the bench cannot {ability.value}")


@final
class _Judge:
    """Derives a verdict from the error that ended a check."""

    def __init__(self, one: Clause, home: str) -> None:
        self._one = one
        self._home = home
        self.facts: Facts = NOTHING_DECLARED
        self.models: tuple[MotorModel, ...] = ()

    def verdict(self, error: BaseException) -> Verdict:
        """Return the verdict for this error.

        Raises:
            KeyboardInterrupt, RigError: the error itself.
        """
        if isinstance(error, RigError) and not isinstance(error, BrokenPluginError):
            raise error
        if isinstance(error, KeyboardInterrupt):
            raise error
        if isinstance(error, NotApplicable):
            return Verdict(self._one.id, Result.NOT_APPLICABLE, f"{error}")
        if isinstance(error, ModuleNotFoundError) and error.name in _OPTIONAL:
            why = f"{error.name} is not installed; pip install {error.name}"
            return Verdict(self._one.id, Result.NOT_APPLICABLE, why)
        if isinstance(error, LimitError) and self._is_no_room(error):
            why = f"no room for this move: {error}; a shorter long_move may fit"
            return Verdict(self._one.id, Result.NOT_APPLICABLE, why)
        place = raised_at(error, self._home)
        if isinstance(error, Violated):
            place = raised_at(error, CLAUSES)  # in the clause, not in a shared function
            return Verdict(self._one.id, Result.FAILED, f"{error}", place)
        if isinstance(error, TimeIsUp):
            return Verdict(self._one.id, Result.HUNG, f"{error}", place)
        if isinstance(error, UnsupportedError):
            for claimed in self._one.needs:
                if claimed in self.facts.claims:
                    seen = f"{claimed.value}: claimed by the rig, refused by the motor: {error}"
                    at = self.facts.claimed_at.get(claimed, place)
                    return Verdict(self._one.id, Result.FAILED, seen, at)
        if isinstance(error, RigError) and error.__cause__ is None:
            place = ""  # the message has the rig's line; the kit's line does not help
        seen = f"{error}" if isinstance(error, RigError) else f"{type(error).__name__}: {error}"
        if isinstance(error, MotorError) and not isinstance(error, PluginError):
            return Verdict(self._one.id, Result.FAILED, f"raised {seen}", place)
        return Verdict(self._one.id, Result.CRASHED, seen, place)

    def diagnosed(
        self, verdict: Verdict, error: BaseException, observation: "Observation | None"
    ) -> Verdict:
        """Return the verdict with a diagnosis."""
        from motorhil.harness.conformance.verdicts.diagnosis import diagnose

        diagnosis = diagnose(self._one, error, verdict.seen, self._home, observation)
        return replace(verdict, diagnosis=diagnosis)

    def _is_no_room(self, error: LimitError) -> bool:
        """Return whether the clause has asked for a position that the motors' models forbid."""
        return any(
            error.unit == model.unit
            and (
                (model.position_min is not None and error.value < model.position_min)
                or (model.position_max is not None and error.value > model.position_max)
            )
            for model in self.models
        )
