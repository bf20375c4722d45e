"""Result files of a run: JSON, JUnit XML and an HTML page.

The keys of the JSON document are stable:

    adaptation, rig, bench, motors, seed    what was tested; `rig` is its file, `bench` its name;
                        of a drive: `adaptation` and `motors` have its name
    passed              whether at least one clause was checked and all results are good
    counts              number of clauses by result
    claims              by capability, or by mode of a drive: why it is not claimed, or "";
                        null if the motors could not be asked
    groups              failures by cause, the first one to mend on top: `cause`; `first`, the id of
                        the most basic clause, and `others`; `told`, the lines about the first
    clauses             for each: `id`, `level` ("L2"), `promise`, `source`; `result` ("passed",
                        "failed", "not applicable", "crashed", "hung", "left behind"); `seen`, the
                        observation, or why it is not applicable; `place`, "file:line" or "";
                        `bench`, where it ran; `cause`, the likely cause, or null; `evidence`, the
                        observations behind it; `time_s`, in the bench's time; `wall_s`; `said`, the
                        last lines printed; `again`, the command that repeats it, or null; `record`,
                        its MCAP file, or null; `digest`, the record's digest, or null; `second`,
                        the `result` and `seen` of a second run with the same seed if they differ,
                        else null
    not_met             conditions that no clause has met, such as "backlash"
    first_verdict_s     from the start of the command to the first verdict, in wall time
    took_s              from the start of the command to the last verdict

Two runs with one seed differ only in `wall_s`, `first_verdict_s` and `took_s`.
"""

import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.examination import Finding
from motorhil.harness.conformance.job import Loaded
from motorhil.harness.conformance.verdicts.causes import (
    Group,
    cause_of,
    groups_of,
    more_of,
    told_in_full,
)
from motorhil.harness.report.picture import STYLE, picture_of
from motorhil.harness.rig.config.conformance import Capability

_NS: Final = 1e9
_ODD: Final = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot represent (2.2, Char)."""
_JUNIT: Final = {
    Result.FAILED: "failure",
    Result.CRASHED: "error",
    Result.HUNG: "error",
    Result.LEFT_BEHIND: "error",
    Result.NOT_APPLICABLE: "skipped",
}
_STYLE: Final = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em }
table { border-collapse: collapse; width: 100% }
th, td { text-align: left; vertical-align: top; padding: .3em .8em .3em 0 }
tr { border-top: 1px solid #8884 }
td:nth-child(4) { text-align: right; white-space: nowrap }
td:nth-child(1), td:nth-child(3) { white-space: nowrap }
.good { color: #287a2c } .bad { color: #b3261e; font-weight: bold } .none { color: #777 }
.source { color: #777; font-size: 87% } code { font-size: 87%; overflow-wrap: anywhere }
@media (prefers-color-scheme: dark) { body { background: #16181b; color: #ddd }
  .good { color: #7cc47f } .bad { color: #f2867e } a { color: #8ab4f8 } }
"""


_ASSUMED: Final = frozenset(one.key for one in Capability if one.is_assumed)


@final
@frozen
class Outcome:
    """The results of a run.

    Attributes:
        loaded: the job that was tested.
        findings: the findings in the order of the checks.
        claims: as `Supervisor.claims`; None if the motors could not be asked.
        first_verdict_s, took_s: in wall time [s].
        not_met: the conditions that no clause has met, such as "backlash".
    """

    loaded: Loaded
    findings: Sequence[Finding]
    claims: Mapping[str, str] | None
    first_verdict_s: float
    took_s: float
    not_met: tuple[str, ...] = ()

    @property
    def claimed(self) -> list[str]:
        """The capabilities that the motors, or the rig, claim; the modes of a drive."""
        return self._claimed(is_assumed=False)

    @property
    def assumed(self) -> list[str]:
        """The capabilities that count as claimed, as no motor can be asked for them."""
        return self._claimed(is_assumed=True)

    def _claimed(self, *, is_assumed: bool) -> list[str]:
        claims = self.claims or {}
        found = [name for name, why_not in claims.items() if not why_not]
        return [name for name in found if (name in _ASSUMED) is is_assumed]

    def count(self, result: Result) -> int:
        """Return the number of clauses with this result."""
        return sum(one.verdict.result is result for one in self.findings)

    @property
    def passed(self) -> bool:
        """True if at least one clause was checked and all results are good."""
        return not self.is_empty and all(one.verdict.result.is_good for one in self.findings)

    @property
    def is_empty(self) -> bool:
        """True if no clause was applicable."""
        return self.count(Result.NOT_APPLICABLE) == len(self.findings)


def as_json(outcome: Outcome) -> str:
    """Return the JSON document described in the module's docstring."""
    loaded = outcome.loaded
    document = {
        "adaptation": loaded.adaptation,
        "rig": loaded.rig,
        "bench": loaded.bench,
        "motors": list(loaded.motors),
        "seed": loaded.seed,
        "passed": outcome.passed,
        "counts": {result.value: outcome.count(result) for result in Result},
        "claims": None if outcome.claims is None else dict(outcome.claims),
        "groups": [
            {
                "cause": one.cause,
                "first": one.first.promise.id,
                "others": list(one.others),
                "told": told_in_full(one.first),
            }
            for one in groups_of(outcome.findings)
        ],
        "clauses": [_clause(one) for one in outcome.findings],
        "not_met": list(outcome.not_met),
        "first_verdict_s": round(outcome.first_verdict_s, 3),
        "took_s": round(outcome.took_s, 3),
    }
    return json.dumps(document, indent=1) + "\n"


def _clause(one: Finding) -> dict[str, object]:
    second, diagnosis = one.second, one.verdict.diagnosis
    return {
        "id": one.promise.id,
        "level": f"L{one.promise.level}",
        "promise": one.promise.promise,
        "source": one.promise.source,
        "result": one.verdict.result.value,
        "seen": one.verdict.seen,
        "place": one.verdict.place,
        "bench": one.verdict.bench,
        "cause": None if diagnosis is None else diagnosis.cause,
        "evidence": [] if diagnosis is None else list(diagnosis.evidence),
        "time_s": one.verdict.time_ns / _NS,
        "wall_s": round(one.wall_s, 3),
        "said": list(one.output),
        "again": one.again or None,
        "record": None if one.record is None else str(one.record),
        "digest": one.digest or None,
        "second": second and {"result": second.result.value, "seen": second.seen},
    }


def as_junit(outcome: Outcome) -> str:
    """Return a JUnit XML test suite with one test case for each clause."""
    counts = dict.fromkeys(("failure", "error", "skipped"), 0)
    cases = []
    for one in outcome.findings:
        word = _JUNIT.get(one.verdict.result)
        if word is not None:
            counts[word] += 1
        cases.append(_case(one, outcome.loaded.adaptation, word))
    suite = (
        f"<testsuite name={_quoted(f'conform {outcome.loaded.adaptation}')}"
        f' tests="{len(cases)}" failures="{counts["failure"]}" errors="{counts["error"]}"'
        f' skipped="{counts["skipped"]}" time="{outcome.took_s:.3f}">'
    )
    lines = ['<?xml version="1.0" encoding="utf-8"?>', suite, *cases, "</testsuite>"]
    return "\n".join(lines) + "\n"


def _case(one: Finding, adaptation: str, word: str | None) -> str:
    name = _quoted(f"{one.promise.id} {one.promise.promise}")
    group = _quoted(f"{adaptation}.L{one.promise.level}")
    case = f'<testcase classname={group} name={name} time="{one.wall_s:.3f}">'
    if word is not None:
        kind = _quoted(one.verdict.result.value)
        case += f"<{word} type={kind} message={_quoted(cause_of(one))}>"
        lines = more_of(one) if one.verdict.result.is_good else told_in_full(one)
        case += f"{_text(chr(10).join(lines))}</{word}>"
    return case + "</testcase>"


def as_page(outcome: Outcome, folder: Path) -> str:
    """Return a self-contained HTML page; its links to records are relative to `folder`."""
    loaded = outcome.loaded
    title = f"{loaded.adaptation}: {'passed' if outcome.passed else 'not passed'}"
    counts = ", ".join(
        f"{outcome.count(result)} {result.value}" for result in Result if outcome.count(result)
    )
    rows = "\n".join(_row(one, folder) for one in outcome.findings)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{_text(title)}</title>
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<style>{_STYLE}{STYLE}</style></head><body>
<h1>{_text(title)}</h1>
<p>On {_text(loaded.bench)} ({_text(loaded.rig)}), motors {_text(", ".join(loaded.motors))},
seed {loaded.seed}: {_text(counts)}.</p>
{"".join(map(_group, groups_of(outcome.findings)))}
<table><tr><th>clause</th><th>promise and observation</th><th>verdict</th><th>at</th></tr>
{rows}
</table>
{_claims(outcome)}
</body></html>
"""


def _group(group: Group) -> str:
    """Return the section of a group: its first clause in full, with the picture of the moment."""
    first = group.first
    lines = "".join(f"<br><code>{_text(line)}</code>" for line in told_in_full(first))
    others = f"<p>Also: {_text(', '.join(group.others))}</p>" if group.others else ""
    diagnosis = first.verdict.diagnosis
    picture = "" if diagnosis is None else picture_of(diagnosis.curves)
    return (
        f"<section><h2>{_text(group.cause)}</h2><p>{_text(first.promise.id)} "
        f'<span class="bad">{first.verdict.result.value}</span>{lines}</p>{picture}{others}'
        "</section>\n"
    )


def _row(one: Finding, folder: Path) -> str:
    result = one.verdict.result
    css_class = {Result.PASSED: "good", Result.NOT_APPLICABLE: "none"}.get(result, "bad")
    seen = (
        f'<br><span class="{css_class}">{_text(one.verdict.seen)}</span>'
        if one.verdict.seen
        else ""
    )
    more = "".join(f"<br><code>{_text(line)}</code>" for line in more_of(one))
    if one.record is not None:
        link = html.escape(os.path.relpath(one.record, folder))
        more += f'<br><a href="{link}">{_text(one.record.name)}</a>'
    return (
        f"<tr><td>{_text(one.promise.id)}</td>"
        f"<td>{_text(one.promise.promise)}"
        f' <span class="source">{_text(one.promise.source)}</span>{seen}{more}</td>'
        f'<td class="{css_class}">{result.value}</td>'
        f"<td>{one.verdict.time_ns / _NS:.3f} s</td></tr>"
    )


def _claims(outcome: Outcome) -> str:
    if outcome.claims is None:
        return ""
    words = dict.fromkeys(outcome.assumed, "assumed")
    rows = "".join(
        f"<tr><td>{_text(name)}</td><td>{_text(why_not or words.get(name, 'claimed'))}</td></tr>"
        for name, why_not in outcome.claims.items()
    )
    return f"<h2>Claims</h2><table>{rows}</table>"


def _text(text: str) -> str:
    return html.escape(_ODD.sub("\ufffd", text), quote=False)


def _quoted(text: str) -> str:
    return '"' + html.escape(_ODD.sub("\ufffd", text)).replace("\n", "&#10;") + '"'
