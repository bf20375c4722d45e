"""Summary of a campaign: signatures, coverage, and what was never reached."""

from collections import Counter
from collections.abc import Iterable
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.worlds.shrinking import cause_of


@final
@frozen
class Cause:
    """Failures of one cause.

    Attributes:
        name: oracle, rule and role.
        rows: the failures, the best representative first: the earliest violation, then the fewest
            disturbances, then the lowest seed.
        signatures: signature to number of failures.
    """

    name: str
    rows: tuple[Row, ...]
    signatures: tuple[tuple[str, int], ...]

    @property
    def first(self) -> Row:
        """The best representative."""
        return self.rows[0]

    @property
    def lowest(self) -> int:
        """The lowest seed."""
        return min(row.seed for row in self.rows)


@final
@frozen
class Strikes:
    """Disturbances of one kind over a campaign.

    Attributes:
        worlds: number of worlds that have one.
        struck: number of worlds in which one struck.
        times: how often they struck in all worlds together.
    """

    worlds: int = 0
    struck: int = 0
    times: int = 0


@final
@frozen
class Summary:
    """Findings of a campaign.

    Attributes:
        counts: results and their numbers, without the canary.
        causes: failures by cause, the most frequent first.
        pairs: number of different (state, event) pairs.
        growth: (worlds, pairs) after each world that met a new pair, by seed.
        reached: conditions of `sometimes`, and in how many worlds they were true.
        ended_by: allowed errors that ended programs, and how often.
        strikes: disturbances by kind, the most frequent first.
        states: states of controllers in which something happened, as the pairs name them.
        canary: who found the canary; "" if nobody did; None if it has not run.
    """

    counts: dict[Result, int]
    causes: tuple[Cause, ...]
    pairs: int
    growth: tuple[tuple[int, int], ...]
    reached: dict[str, int]
    ended_by: dict[str, int]
    strikes: dict[str, Strikes]
    states: tuple[str, ...]
    canary: str | None

    @property
    def failures(self) -> int:
        """Number of failures."""
        return self.counts.get(Result.FAILED, 0) + self.counts.get(Result.TIMEOUT, 0)

    @property
    def found_canary(self) -> bool:
        """True if the campaign has found its planted defect, or has not looked for it yet."""
        return self.canary is None or "always" in self.canary

    @property
    def worlds(self) -> int:
        """Number of worlds that ran."""
        return sum(self.counts.values())


_NO_STRIKES: Final = Strikes()


def summary_of(rows: Iterable[Row]) -> Summary:
    """Return the summary of a campaign's rows, in any order."""
    canary: str | None = None
    strikes: dict[str, Strikes] = {}
    states: dict[str, None] = {}
    counts: Counter[Result] = Counter()
    ended_by: Counter[str] = Counter()
    reached: Counter[str] = Counter()
    by_cause: dict[str, list[Row]] = {}
    pairs: set[str] = set()
    growth: list[tuple[int, int]] = []
    for row in sorted(rows, key=lambda one: one.seed):
        if row.seed == CANARY:
            canary = row.text if row.is_bad else ""
            continue
        counts[row.result] += 1
        if row.ended_by:
            ended_by[row.ended_by] += 1
        for name, count in row.met:
            reached[name] += bool(count)
        for kind, count in row.acts:
            old = strikes.get(kind, _NO_STRIKES)
            strikes[kind] = Strikes(old.worlds + 1, old.struck + bool(count), old.times + count)
        new = [pair for pair in row.new if pair not in pairs]
        for pair in new:
            states.update(dict.fromkeys(pair.partition(" after ")[0].split("/")))
        if new:
            pairs.update(new)
            growth.append((counts.total(), len(pairs)))
        if row.is_bad:
            by_cause.setdefault(cause_of(row), []).append(row)
    causes = [_cause(name, found) for name, found in by_cause.items()]
    causes.sort(key=lambda one: (-len(one.rows), one.name))
    return Summary(
        dict(counts),
        tuple(causes),
        len(pairs),
        tuple(growth),
        dict(sorted(reached.items())),
        dict(ended_by.most_common()),
        dict(sorted(strikes.items(), key=lambda one: (-one[1].worlds, one[0]))),
        tuple(sorted(states)),
        canary,
    )


def _cause(name: str, rows: list[Row]) -> Cause:
    rows.sort(key=lambda one: (one.at_ns, len(one.world), one.seed))
    signatures = Counter(row.signature for row in rows)
    return Cause(name, tuple(rows), tuple(signatures.most_common()))
