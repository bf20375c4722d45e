"""Execution: which clause on which bench executes which statement, and at what cost.

Measured once for a state of the sources, and kept in `build`. A change of a clause has the clauses
of its module alone measured again.
"""

import ast
import json
import sys
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

from tests.conformance.mutants.by_rule import benches
from tests.conformance.mutants.by_rule.children import Tell, answers, cpu_s, limit
from tests.conformance.mutants.by_rule.loading import hits, import_all, import_instrumented
from tests.conformance.mutants.by_rule.sources import Mutant
from tests.support.checkout import CHECKOUT, sources

KEPT: Final = CHECKOUT / "build" / "mutants" / "execution.json"
_OF_DRIVES: Final = ("harness/conformance/drives", "tests/conformance/drives")
_CLAUSES: Final = ("harness/conformance/clauses/", "harness/conformance/drives/clauses/")
_LONG_S: Final = 600.0


@dataclass(frozen=True, slots=True)
class Run:
    """One clause on one bench, with correct sources.

    Attributes:
        bench, clause: their names.
        cpu_s: its cost in processor time, instrumented [s].
        result: its result.
        hits: the executed statements of each source, as the bits of an integer.
    """

    bench: str
    clause: str
    cpu_s: float
    result: str
    hits: dict[str, int]

    @property
    def is_able(self) -> bool:
        """False if it checks nothing: a clause for drives that is not applicable."""
        return not benches.is_of_drive(self.bench) or self.result != "not applicable"


@dataclass(frozen=True, slots=True)
class Execution:
    """Everything that was measured.

    Attributes:
        runs: all clauses on all benches.
        before: the statements of functions that are executed before a bench is opened.
        modules: all modules that were imported in the end.
    """

    runs: list[Run]
    before: dict[str, int]
    modules: list[str]

    def is_early(self, mutant: Mutant) -> bool:
        """Return whether the mutant takes effect before a bench is opened."""
        bits = self.before.get(mutant.file, 0)
        return not mutant.is_in_function or bool(bits >> mutant.statement & 1)

    def plan(self, mutant: Mutant, within_s: float) -> list[Run]:
        """Return the runs that can kill a mutant, of a limited cost.

        Every clause comes once, the cheapest first, before any comes for the second time, on
        another bench. As in a run of the kit, the first bench is any; here the mutant draws it. If
        a statement is executed only while modules are imported, each user of the module comes.
        """
        bit = 1 << mutant.statement if mutant.is_in_function else -1
        able = self._executing(mutant.file, bit)
        if not able and self.is_early(mutant):
            able = self._executing(mutant.file, -1)
        able.sort(key=lambda one: _drawn(mutant.function, mutant.change, one.clause, one.bench))
        turns: dict[tuple[bool, str], int] = {}
        ranked = []
        for one in able:
            key = benches.is_of_drive(one.bench), one.clause  # both kits have, e.g., a STOP-03
            turns[key] = turns.get(key, 0) + 1
            ranked.append((turns[key], one))
        ranked.sort(key=lambda pair: (pair[0], pair[1].cpu_s))
        chosen, cost_s = [], 0.0
        for _, one in ranked:
            if chosen and cost_s + one.cpu_s > within_s:
                continue
            cost_s += one.cpu_s
            chosen.append(one)
        return chosen

    def _executing(self, file: str, bits: int) -> list[Run]:
        """Return the runs that check something and execute one of these statements."""
        return [one for one in self.runs if one.hits.get(file, 0) & bits and one.is_able]


def _drawn(*words: str) -> bytes:
    return blake2b("\n".join(words).encode(), digest_size=8).digest()


def of_clauses(clauses: Collection[str], only: str = "") -> list[Run]:
    """Return the runs of these clauses with correct sources, without what they execute.

    Args:
        clauses: their ids.
        only: a part of the names of benches; the others take no part.
    """
    runs: list[Run] = []
    for bench in benches.names():
        if only not in bench or set(clauses).isdisjoint(benches.clauses(bench)):
            continue
        for answer in answers(partial(_run_these, bench, clauses)):
            if answer is None or "wrong" in answer or "raised" in answer:
                print(f"left out: {answer or bench}", file=sys.stderr)
            elif (run := Run(**answer, hits={})).is_able:
                runs.append(run)
    return runs


def before_benches(only: str = "") -> dict[str, int]:
    """Return the statements of functions that are executed before a bench is opened, by source.

    Args:
        only: a part of the names of benches; the others take no part.
    """

    def look(tell: Tell) -> None:
        limit(_LONG_S, 10.0 * _LONG_S)
        import_instrumented()
        for bench in benches.names():
            if only in bench:
                benches.opener(bench)
        import_all()
        tell(_texts(hits(clear=True)))

    (found,) = answers(look)
    return _bits(found)


def _run_these(bench: str, clauses: Collection[str], tell: Tell) -> None:
    limit(_LONG_S, 10.0 * _LONG_S)
    for clause in benches.clauses(bench):
        if clause in clauses:
            verdict, cost_s = _timed(clause, bench)
            if _is_as_wanted(verdict, clause, bench):
                tell(_answer(verdict, clause, bench, cost_s))
            else:
                tell({"wrong": f"{clause} on {bench}: {verdict.result.value}: {verdict.seen}"})


def measured(only: str = "") -> Execution:
    """Return the execution of these sources: kept from before, or measured now, in minutes.

    Args:
        only: a part of the names of benches; the others take no part.
    """
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    digests = {of_drive: _digest(of_drive) for of_drive in (False, True)}
    runs: list[Run] = []
    before: dict[str, int] = {}
    modules: set[str] = set()
    for bench in benches.names():
        if only not in bench:
            continue
        found = kept.get(bench, {})
        if found.get("digest") != digests[benches.is_of_drive(bench)]:
            found = {"digest": digests[benches.is_of_drive(bench)], "runs": {}}
        if _measure(bench, found):
            kept[bench] = found
            KEPT.parent.mkdir(parents=True, exist_ok=True)
            KEPT.write_text(json.dumps(kept))
        good = [run for _, run in found["runs"].values() if run is not None]
        runs += [Run(**{**one, "hits": _bits(one["hits"])}) for one in good]
        modules.update(found["modules"])
        for file, bits in _bits(found["before"]).items():
            before[file] = before.get(file, 0) | bits
    return Execution(runs, before, sorted(modules))


def _bits(texts: dict[str, str]) -> dict[str, int]:
    return {file: int(text, 16) for file, text in texts.items()}


def _texts(bits: dict[str, int]) -> dict[str, str]:
    return {file: f"{one:x}" for file, one in bits.items()}


def _digest(of_drive: bool) -> str:
    """Return a digest of what the measurement of one kit's benches depends on, but for clauses."""
    rigs = sorted((CHECKOUT / "harness" / "conformance").rglob("*.toml"))
    own = [Path(__file__).with_name(f"{name}.py") for name in ("benches", "loading", "sources")]
    tests = CHECKOUT / "tests" / "conformance"
    files = [*sources(), *rigs, tests / "variants.py", tests / "drives" / "rigs.py", *own]
    others = (*_CLAUSES, "motorapi") if of_drive else (*_CLAUSES, *_OF_DRIVES)
    state = blake2b(digest_size=16)
    for path in files:
        if not path.relative_to(CHECKOUT).as_posix().startswith(others):
            state.update(path.read_bytes())
    return state.hexdigest()


@cache
def _digest_of_clauses(module: str) -> str:
    """Return a digest of a module of clauses, and of those that it imports."""
    path = (CHECKOUT / Path(*module.split(".")[1:])).with_suffix(".py")
    if not path.exists() or not path.relative_to(CHECKOUT).as_posix().startswith(_CLAUSES):
        return ""
    text = path.read_bytes()
    nodes = ast.walk(ast.parse(text))
    named = sorted({one.module or "" for one in nodes if isinstance(one, ast.ImportFrom)})
    return blake2b("".join((text.decode(), *map(_digest_of_clauses, named))).encode()).hexdigest()


def _measure(bench: str, kept: dict[str, Any]) -> bool:
    """Measure the clauses that have changed since this was kept; return whether there were any."""
    wanted = {
        key: _digest_of_clauses(one.check.__module__) for key, one in benches.clauses(bench).items()
    }
    runs = {key: run for key, run in kept["runs"].items() if run[0] == wanted.get(key)}
    missing = [key for key in wanted if key not in runs]
    if runs.keys() == kept["runs"].keys() and not missing:
        return False
    if missing:
        print(
            f"measuring which statements {len(missing)} clauses execute: {bench}", file=sys.stderr
        )
    for answer in answers(lambda tell: _run_all(bench, missing, tell)) if missing else ():
        if answer is None or "raised" in answer:
            raise RuntimeError(f"{bench}: measuring failed: {answer}")
        if "modules" in answer:
            kept |= answer
        else:
            runs[answer["clause"]] = (wanted[answer["clause"]], answer["run"])
    kept["runs"] = {key: runs[key] for key in wanted}
    return True


def _run_all(bench: str, wanted: Collection[str], tell: Tell) -> None:
    """Run these clauses on a bench, in instrumented sources."""
    limit(_LONG_S, 10.0 * _LONG_S)
    import_instrumented()
    clauses = [key for key in benches.clauses(bench) if key in wanted]
    benches.opener(bench)
    import_all()
    before = hits(clear=True)
    for clause in clauses:
        verdict, cost_s = _timed(clause, bench)
        found, run = _texts(_of(bench, hits(clear=True))), None
        if _is_as_wanted(verdict, clause, bench):
            run = {**_answer(verdict, clause, bench, cost_s), "hits": found}
        tell({"clause": clause, "run": run})
    own = ("motorhil", "numpy", "can", "canopen", "pymodbus", "hypothesis")
    modules = [name for name in sys.modules if name.partition(".")[0] in own]
    tell({"modules": modules, "before": _texts(before)})


def _timed(clause: str, bench: str) -> tuple[Any, float]:
    """Return the verdict of a clause, and its cost in processor time [s]."""
    begin_s = cpu_s()
    return benches.verdict(clause, bench, claims_anew=True), cpu_s() - begin_s


def _is_as_wanted(verdict: Any, clause: str, bench: str) -> bool:
    is_good: bool = verdict.result.is_good
    return is_good or benches.has_known_finding(clause, bench)


def _answer(verdict: Any, clause: str, bench: str, cost_s: float) -> dict[str, Any]:
    result = verdict.result.value
    return {"bench": bench, "clause": clause, "cpu_s": round(cost_s, 4), "result": result}


def _of(bench: str, found: dict[str, int]) -> dict[str, int]:
    """Return the sources that clauses on this bench judge: those for drives, emulators alone."""
    of_drive = benches.is_of_drive(bench)
    return {file: n for file, n in found.items() if not of_drive or file.startswith("emulators/")}
