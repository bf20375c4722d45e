"""Execution: which clause on which bench executes which statement, and at what cost.

Measured once for a state of the sources, and kept in `build`.
"""

import json
import sys
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

from tests.conformance.mutants.by_rule import benches
from tests.conformance.mutants.by_rule.children import Tell, answers, cpu_s, limit
from tests.conformance.mutants.by_rule.loading import hits, import_instrumented
from tests.conformance.mutants.by_rule.sources import Mutant
from tests.support.checkout import CHECKOUT, sources

KEPT: Final = CHECKOUT / "build" / "mutants" / "execution.json"
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
        """Return the runs that can kill a mutant, the cheapest first, of a limited cost.

        Every clause comes once before any comes for the second time, on another bench.
        """
        bit = 1 << mutant.statement if mutant.is_in_function else -1
        able = [one for one in self.runs if one.hits.get(mutant.file, 0) & bit]
        able.sort(key=lambda one: one.cpu_s)
        turns: dict[str, int] = {}
        ranked = []
        for one in able:
            turns[one.clause] = turns.get(one.clause, 0) + 1
            ranked.append((turns[one.clause], one))
        ranked.sort(key=lambda pair: pair[0])
        chosen, cost_s = [], 0.0
        for _, one in ranked:
            if chosen and cost_s + one.cpu_s > within_s:
                continue
            cost_s += one.cpu_s
            chosen.append(one)
        return chosen


def measured() -> Execution:
    """Return the execution of these sources: kept from before, or measured now, in minutes."""
    digest = _digest()
    if KEPT.exists():
        kept = json.loads(KEPT.read_text())
        if kept["digest"] == digest:
            return _unpacked(kept)
    kept = {"digest": digest, **_measure()}
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    KEPT.write_text(json.dumps(kept))
    return _unpacked(kept)


def _unpacked(kept: dict[str, Any]) -> Execution:
    runs = [Run(**{**one, "hits": _bits(one["hits"])}) for one in kept["runs"]]
    return Execution(runs, _bits(kept["before"]), kept["modules"])


def _bits(texts: dict[str, str]) -> dict[str, int]:
    return {file: int(text, 16) for file, text in texts.items()}


def _texts(bits: dict[str, int]) -> dict[str, str]:
    return {file: f"{one:x}" for file, one in bits.items()}


def _digest() -> str:
    """Return a digest of everything that the measurement depends on."""
    rigs = sorted((CHECKOUT / "harness" / "conformance").rglob("*.toml"))
    own = [Path(__file__).with_name(f"{name}.py") for name in ("benches", "loading", "sources")]
    files = [*sources(), *rigs, CHECKOUT / "tests" / "conformance" / "variants.py", *own]
    state = blake2b(digest_size=16)
    for path in files:
        state.update(path.read_bytes())
    return state.hexdigest()


def _measure() -> dict[str, Any]:
    found: dict[str, Any] = {"runs": []}
    modules: set[str] = set()
    before: dict[str, int] = {}
    for bench in benches.names():
        print(f"measuring which statements the clauses execute: {bench}", file=sys.stderr)
        ended = False
        for answer in answers(lambda tell, bench=bench: _run_all(bench, tell)):
            if answer is None or "raised" in answer:
                raise RuntimeError(f"{bench}: measuring failed: {answer}")
            if "modules" in answer:
                modules.update(answer["modules"])
                for file, bits in _bits(answer["before"]).items():
                    before[file] = before.get(file, 0) | bits
                ended = True
            else:
                found["runs"].append(answer)
        assert ended, bench
    found["modules"] = sorted(modules)
    found["before"] = _texts(before)
    return found


def _run_all(bench: str, tell: Tell) -> None:
    """Run all clauses on a bench, in instrumented sources."""
    limit(_LONG_S, 10.0 * _LONG_S)
    import_instrumented()
    from motorhil.harness.conformance.kit import all_clauses

    clauses = list(all_clauses())
    benches.opener(bench)
    before = hits(clear=True)
    for clause in clauses:
        begin_s = cpu_s()
        verdict = benches.verdict(clause, bench, claims_anew=True)
        cost_s = cpu_s() - begin_s
        if verdict.result.is_good:
            tell(
                {
                    "bench": bench,
                    "clause": clause,
                    "cpu_s": round(cost_s, 4),
                    "result": verdict.result.value,
                    "hits": _texts(hits(clear=True)),
                }
            )
    own = ("motorhil", "numpy", "can", "canopen", "pymodbus", "hypothesis")
    modules = [name for name in sys.modules if name.partition(".")[0] in own]
    tell({"modules": modules, "before": _texts(before)})
