"""Failures grouped by cause, the first one to mend on top.

One mistake fails many clauses. The most basic clause shows it best, so that a group is told by
this one clause. Groups are ranked by the level of this clause, then by size, then by the order of
the kit.
"""

from collections.abc import Iterable, Sequence
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.clause import without_numbers
from motorhil.harness.conformance.examination import Finding

_NS: Final = 1e9


@final
@frozen
class Group:
    """Failures of one cause.

    Attributes:
        cause: the likely cause.
        findings: the failures; the most basic clause is the first.
    """

    cause: str
    findings: tuple[Finding, ...]

    @property
    def first(self) -> Finding:
        """The failure of the most basic clause."""
        return self.findings[0]

    @property
    def others(self) -> tuple[str, ...]:
        """The ids of the other clauses."""
        return tuple(one.promise.id for one in self.findings[1:])


def groups_of(findings: Iterable[Finding]) -> list[Group]:
    """Return the groups of the bad findings, which are in the order of the kit, by rank."""
    by_key: dict[str, list[Finding]] = {}
    for one in findings:
        if not one.verdict.result.is_good:
            by_key.setdefault(_key(one), []).append(one)
    groups = []
    for members in by_key.values():
        members.sort(key=lambda one: one.promise.level)
        groups.append(Group(cause_of(members[0]), tuple(members)))
    groups.sort(key=lambda group: (group.first.promise.level, -len(group.findings)))
    return groups


def cause_of(one: Finding) -> str:
    """Return the likely cause of a failure; without a diagnosis, the observation."""
    diagnosis = one.verdict.diagnosis
    return one.verdict.seen if diagnosis is None else diagnosis.cause


def _key(one: Finding) -> str:
    diagnosis, verdict = one.verdict.diagnosis, one.verdict
    if diagnosis is not None:
        return diagnosis.key
    return f"{verdict.result.value} {without_numbers(verdict.seen)} {verdict.place}"


def told_in_full(one: Finding) -> list[str]:
    """Return the lines about a failure: the promise, what was seen, when, where, and the rest."""
    verdict = one.verdict
    seen, _, expected = verdict.seen.partition("; expected ")
    lines = [f"promise: {one.promise.promise}"]
    if expected:
        lines.append(f"expected: {expected}")
    lines.append(f"seen: {seen}" if seen else f"seen: {verdict.result.value}")
    on = f" on {verdict.bench}" if verdict.bench else ""
    lines.append(f"when: at {verdict.time_ns / _NS:.3f} s{on}")
    if verdict.diagnosis is not None:
        lines += verdict.diagnosis.evidence
    return lines + more_of(one)


def more_of(one: Finding) -> list[str]:
    """Return further lines about a clause that did not pass: place, output, record, command."""
    lines = [one.verdict.place] if one.verdict.place else []
    lines += [f"printed: {line}" for line in one.output]
    if one.second is not None:
        second = f"{one.second.result.value} {one.second.seen}".rstrip()
        lines.append(f"not repeatable: a second run with the same seed ended differently: {second}")
    if one.record is not None:
        lines.append(f"record: {one.record}")
    if one.again:
        lines.append(f"again: {one.again}")
    return lines


def summary_of(groups: Sequence[Group]) -> list[str]:
    """Return the text of all groups: the first clause of each in full, the others as ids."""
    lines: list[str] = []
    for number, group in enumerate(groups, 1):
        count = len(group.findings)
        clauses = "1 clause" if count == 1 else f"{count} clauses"
        lines.append(f"{number}. {group.cause} ({clauses})")
        lines.append(f"   {group.first.promise.id} {group.first.verdict.result.value}")
        lines += [f"     {line}" for line in told_in_full(group.first)]
        if group.others:
            lines.append(f"   also: {', '.join(group.others)}")
    return lines
