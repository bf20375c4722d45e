"""Verdicts on a replay: commands without an answer, and the meaning of a recording."""

import re
import sys
from collections.abc import Callable, Iterator
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.harness.recording.conversion import open_recording
from motorhil.harness.replay.player import ExchangePlayer, Mismatch
from motorhil.harness.replay.recorded_controller import RecordedController
from motorhil.traces.decoding.attached_rig import RecordedNames
from motorhil.traces.decoding.narrative import Describe, Line
from motorhil.traces.exchange.steps import Step
from motorhil.traces.semantics.model import Meaning, meaning_of

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig

_SHOWN: Final = 5


@final
class Unanswered(NamedTuple):
    """A command that one recorded controller could not answer."""

    controller: str
    mismatch: Mismatch

    def __str__(self) -> str:
        return f"{self.controller} at {self.mismatch.time_ns / 1e9:.6f} s: {self.mismatch}"


def players(rig: "Rig") -> dict[str, ExchangePlayer]:
    """Return the players of the rig's recorded controllers, by name."""
    cores = {name: rig.controllers[name].core for name in rig.description.controllers}
    return {
        name: core.player for name, core in cores.items() if isinstance(core, RecordedController)
    }


def unanswered(rig: "Rig") -> list[Unanswered]:
    """Return the commands that recorded controllers could not answer, by time."""
    found = [
        Unanswered(name, mismatch)
        for name, player in players(rig).items()
        for mismatch in player.mismatches
    ]
    return sorted(found, key=_when)


def never_came(rig: "Rig") -> list[tuple[str, Step]]:
    """Return the recorded commands that the application never sent, with controllers, by time."""
    found = [(name, step) for name, player in players(rig).items() for step in player.never_came()]
    return sorted(found, key=lambda one: one[1].time_ns)


def summary(rig: "Rig", failure: str = "") -> Iterator[str]:
    """Yield the lines of a summary; none if the rig has no recorded controllers.

    Args:
        rig: open or closed.
        failure: the application's error text. The last answers of the controllers named in it are
            listed, since they may be the cause.
    """
    known = players(rig)
    if not known:
        return
    wrong = unanswered(rig)
    matched = sum(player.matched for player in known.values())
    whom = f"{len(known)} recorded controller{'s' if len(known) > 1 else ''}"
    if not wrong:
        yield f"{whom}: {matched} commands, all answered as recorded"
    else:
        asked = matched + len(wrong)
        yield f"{whom}: {len(wrong)} of {asked} commands not in the recording; first:"
        yield str(wrong[0])
        for text in wrong[0].mismatch.before:
            yield f"  answered before: {text}"
    for name, player in known.items():
        if re.search(rf"\b{re.escape(name)}\b", failure):
            for text in player.answered_last():
                yield f"  {name} answered last: {text}"
    missing = never_came(rig)
    if missing:
        count = f"{len(missing)} command{'s' if len(missing) > 1 else ''}"
        yield f"{count} of the recording never came; first:"
        for name, step in missing[:_SHOWN]:
            yield f"  {name}, at {step.time_ns / 1e9:.6f} s of it: {step.text}"


def _when(one: Unanswered) -> int:
    return one.mismatch.time_ns


def meaning_in(
    path: str | PathLike[str],
    verb: str,
    names: RecordedNames | None = None,
    is_report: Callable[[Line], bool] | None = None,
    describe: Describe | None = None,
) -> Meaning:
    """Return the recording's meaning; report a cut recording on stderr in the verb's name.

    Args:
        path: the recording.
        verb: the verb of the command line.
        names: as of `meaning_of`.
        is_report: as of `meaning_of`.
        describe: as of `meaning_of`.

    Raises:
        TraceError: the recording cannot be read, or is damaged.
    """
    tell = partial(print, f"motorhil {verb}:", file=sys.stderr)
    with open_recording(path, tell) as trace:
        meaning = meaning_of(trace, names, is_report, describe=describe)
        if trace.cut is not None:
            print(f"motorhil {verb}: {path}: {trace.cut}", file=sys.stderr)
    return meaning
