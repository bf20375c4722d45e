"""Who did what with one motor, when, and what came of it: what sharing is judged by.

Every use is noted twice, before it can have an effect and after it cannot any more; so a note that
was never completed (whoever made it died, or waits still) is a use that *may* have had its effect,
up to the end of the one who made it. Times are of one clock that all share.

A use is one of these. The answer says what came of it:

| action  | done                                | refused                       | lost             |
| ------- | ----------------------------------- | ----------------------------- | ---------------- |
| TAKE    | the motor is his, under a token;    | somebody else has it, or      |                  |
|         | also from a living one, if `forced` | waits for it and was first    |                  |
| GIVE    | he has it no more                   |                               |                  |
| COMMAND | the motor does what he says         | it was never his              | he had lost it   |
| READ    | `value` was commanded last          |                               |                  |
| DIE     | he, and whatever he had, is gone    |                               |                  |
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import Final, final


class SharingViolated(AssertionError):  # noqa: N818 -- it says what happened, as a verdict does
    """What must hold of motors that are shared did not; the message names the uses."""


@final
class Action(Enum):
    """What somebody did."""

    TAKE = "take"
    GIVE = "give"
    COMMAND = "command"
    READ = "read"
    DIE = "die"


@final
class Answer(Enum):
    """What came of it. UNKNOWN: whoever asked never said."""

    DONE = "done"
    REFUSED = "refused"
    LOST = "lost"
    UNKNOWN = "unknown"


@final
@dataclass(frozen=True, slots=True)
class Use:
    """One use of one motor by one who uses nothing else meanwhile.

    called_ns: before it could have an effect.
    returned_ns: after it could not any more.
    queued_ns: TAKE: when he was in the queue at the latest, where that was seen; else None.
    token: TAKE, done: what he owns it under; 0: not told.
    value: COMMAND: what he said; READ: what he read.
    forced: TAKE: from a living owner, as a lease that ended or an explicit takeover allow.
    """

    who: str
    motor: str
    action: Action
    called_ns: int
    returned_ns: int
    answer: Answer = Answer.DONE
    queued_ns: int | None = None
    token: int = 0
    value: int = 0
    forced: bool = False

    def __str__(self) -> str:
        words = [f"{self.who} {self.action.value} {self.motor}: {self.answer.value}"]
        if self.token:
            words.append(f"token {self.token}")
        if self.forced:
            words.append("from a living owner")
        if self.action in (Action.COMMAND, Action.READ):
            words.append(f"value {self.value}")
        return f"{', '.join(words)} [{self.called_ns / 1e9:.9f} to {self.returned_ns / 1e9:.9f} s]"


@final
class Note:
    """A use that goes on; `returned` completes it."""

    __slots__ = ("_history", "_place", "_use")

    def __init__(self, history: "History", place: int, use: Use) -> None:
        self._history = history
        self._place = place
        self._use = use

    def queued(self) -> None:
        """He is in the queue now."""
        self._use = replace(self._use, queued_ns=self._history.now_ns())
        self._history.replace(self._place, self._use)

    def returned(
        self, answer: Answer = Answer.DONE, *, token: int = 0, value: int = 0, forced: bool = False
    ) -> Use:
        """It had its effect, or none, and this is what came of it."""
        use = replace(
            self._use,
            returned_ns=self._history.now_ns(),
            answer=answer,
            token=token,
            value=value or self._use.value,
            forced=forced or self._use.forced,
        )
        self._history.replace(self._place, use)
        return use


@final
class History:
    """Uses, in the order of their calls.

    Args:
        now_ns: the clock that all share.
        tell: is told every use as soon as it is called, and again when more is known of it.
    """

    def __init__(
        self, now_ns: Callable[[], int], tell: Callable[[Use], None] | None = None
    ) -> None:
        self.now_ns: Final = now_ns
        self._tell: Final = tell
        self._uses: list[Use] = []

    def __len__(self) -> int:
        return len(self._uses)

    def __iter__(self) -> Iterator[Use]:
        return iter(self._uses)

    def call(
        self, who: str, motor: str, action: Action, *, value: int = 0, forced: bool = False
    ) -> Note:
        """`who` is about to do it. Until the note is completed nobody knows what came of it."""
        now_ns = self.now_ns()
        use = Use(
            who, motor, action, now_ns, FOREVER_NS, Answer.UNKNOWN, value=value, forced=forced
        )
        self._uses.append(use)
        if self._tell is not None:
            self._tell(use)
        return Note(self, len(self._uses) - 1, use)

    def replace(self, place: int, use: Use) -> None:
        """The use that was noted there is this one."""
        self._uses[place] = use
        if self._tell is not None:
            self._tell(use)

    def uses(self) -> tuple[Use, ...]:
        """All, those of the dead ended by their death."""
        return ended_by_death(self._uses)


FOREVER_NS: Final = 1 << 62


def ended_by_death(uses: Iterable[Use]) -> tuple[Use, ...]:
    """What somebody began and never completed has had its effect by the end of his death, or none.

    Where he died in the middle of several motors, he died at each of them.
    """
    uses = list(uses)
    died = {use.who: use for use in uses if use.action is Action.DIE}
    result: list[Use] = []
    for use in uses:
        death = died.get(use.who)
        if use.action is Action.DIE:
            continue
        if use.answer is Answer.UNKNOWN and death is not None:
            use = replace(use, returned_ns=min(use.returned_ns, death.returned_ns))
        result.append(use)
    touched = dict.fromkeys((use.who, use.motor) for use in result if use.who in died)
    result += [replace(died[who], motor=motor) for who, motor in touched]
    return tuple(sorted(result, key=lambda use: use.called_ns))


def per_motor(uses: Iterable[Use]) -> dict[str, list[Use]]:
    """The uses of each motor, in the order of their calls."""
    motors: dict[str, list[Use]] = {}
    for use in sorted(uses, key=lambda use: use.called_ns):
        motors.setdefault(use.motor, []).append(use)
    return motors


def overtaken(uses: Sequence[Use]) -> list[tuple[Use, Use]]:
    """(first, second) of one motor: first was in the queue before second asked, and had it later.

    Judged by tokens, where both have one; whoever takes it from a living one needs no place.
    """
    found: list[tuple[Use, Use]] = []
    for of_motor in per_motor(uses).values():
        got = [
            use
            for use in of_motor
            if use.action is Action.TAKE and use.answer is Answer.DONE and not use.forced
        ]
        queued = [use for use in got if use.queued_ns is not None and use.token]
        queued.sort(key=lambda use: use.token, reverse=True)
        first: Use | None = None  # of those with a greater token, who was in the queue first
        for use in queued:
            if first is not None and _place_ns(first) < use.called_ns:
                found.append((first, use))
            if first is None or _place_ns(use) < _place_ns(first):
                first = use
    return found


def _place_ns(use: Use) -> int:
    return use.returned_ns if use.queued_ns is None else use.queued_ns


def tokens_that_did_not_grow(uses: Sequence[Use]) -> list[tuple[Use, Use]]:
    """(earlier, later) of one motor: the later one was taken afterwards, under no greater token."""
    found: list[tuple[Use, Use]] = []
    for of_motor in per_motor(uses).values():
        got = [use for use in of_motor if use.action is Action.TAKE and use.token]
        got.sort(key=lambda use: use.returned_ns)
        greatest: Use | None = None
        for use in got:
            if greatest is not None and use.token <= greatest.token:
                found.append((greatest, use))
            if greatest is None or use.token > greatest.token:
                greatest = use
    return found


def worst_gap_s(uses: Iterable[Use], begun_ns: int, ended_ns: int) -> float:
    """The longest time [s] in which nobody was given the motor."""
    times = sorted(
        use.returned_ns
        for use in uses
        if use.action is Action.TAKE and use.answer is Answer.DONE and use.returned_ns <= ended_ns
    )
    times = [begun_ns, *times, ended_ns]
    return max(after - before for before, after in pairwise(times)) / 1e9


def to_line(use: Use) -> str:
    """One line of JSON, without its end."""
    return json.dumps(
        [
            use.who,
            use.motor,
            use.action.value,
            use.called_ns,
            use.returned_ns,
            use.answer.value,
            use.queued_ns,
            use.token,
            use.value,
            use.forced,
        ]
    )


def from_lines(lines: Iterable[str]) -> list[Use]:
    """What somebody told line by line: of every use what he said of it last."""
    uses: dict[tuple[str, str, Action, int], Use] = {}
    for line in lines:
        use = from_line(line)
        uses[use.who, use.motor, use.action, use.called_ns] = use
    return list(uses.values())


def from_line(line: str) -> Use:
    """What `to_line` wrote."""
    who, motor, action, called, returned, answer, queued, token, value, forced = json.loads(line)
    return Use(
        who, motor, Action(action), called, returned, Answer(answer), queued, token, value, forced
    )
