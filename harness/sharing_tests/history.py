"""History of motor uses by several parties: the basis for judging sharing.

Every use is noted twice, before it can have an effect and after its effect has ended. A note may
remain incomplete, because its author died or still waits. Such a use *may* have had its effect,
until the end of its author. All times come from one common clock.

A use is one of these. The answer gives its result:

| action  | done                                  | refused                     | lost             |
| ------- | ------------------------------------- | --------------------------- | ---------------- |
| TAKE    | it owns the motor under a token;      | another one owns it, or     |                  |
|         | if `forced`, also from a living owner | waits for it and was first  |                  |
| GIVE    | it has released the motor             |                             |                  |
| COMMAND | the motor executes the command        | it never owned the motor    | it had lost it   |
| READ    | `value` is the last command           |                             |                  |
| DIE     | it is gone with everything it owned   |                             |                  |
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import Final, final

FOREVER_NS: Final = 1 << 62


class SharingViolated(AssertionError):  # noqa: N818 -- it says what happened, as a verdict does
    """A violated rule of motor sharing; the message names the uses."""


@final
class Action(Enum):
    """The kind of a use."""

    TAKE = "take"
    GIVE = "give"
    COMMAND = "command"
    READ = "read"
    DIE = "die"


@final
class Answer(Enum):
    """The result of a use. UNKNOWN: its author did not report it."""

    DONE = "done"
    REFUSED = "refused"
    LOST = "lost"
    UNKNOWN = "unknown"


@final
@dataclass(frozen=True, slots=True)
class Use:
    """One use of one motor, by an author with no other use in progress.

    Attributes:
        called_ns: a time before its effect [ns].
        returned_ns: a time after its effect [ns].
        queued_ns: TAKE: when the author was in the queue at the latest [ns]; None if not observed.
        token: TAKE, done: the token of the ownership; 0: unknown.
        value: COMMAND: the commanded value; READ: the value read.
        forced: TAKE: allowed from a living owner, by an expired lease or an explicit takeover.
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
    """A use in progress; `returned` completes it."""

    __slots__ = ("_history", "_place", "_use")

    def __init__(self, history: "History", place: int, use: Use) -> None:
        self._history = history
        self._place = place
        self._use = use

    def queued(self) -> None:
        """Note that the author is in the queue now."""
        self._use = replace(self._use, queued_ns=self._history.now_ns())
        self._history.replace(self._place, self._use)

    def returned(
        self, answer: Answer = Answer.DONE, *, token: int = 0, value: int = 0, forced: bool = False
    ) -> Use:
        """Complete the use with its result."""
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
    """Uses in the order of their calls.

    Args:
        now_ns: the common clock [ns].
        tell: called with every use when it begins, and again when more is known.
    """

    def __init__(
        self, now_ns: Callable[[], int], notify: Callable[[Use], None] | None = None
    ) -> None:
        self.now_ns: Final = now_ns
        self._notify: Final = notify
        self._uses: list[Use] = []

    def __len__(self) -> int:
        return len(self._uses)

    def __iter__(self) -> Iterator[Use]:
        return iter(self._uses)

    def call(
        self, who: str, motor: str, action: Action, *, value: int = 0, forced: bool = False
    ) -> Note:
        """Note that `who` is about to do it; the result is unknown until the note is completed."""
        now_ns = self.now_ns()
        use = Use(
            who, motor, action, now_ns, FOREVER_NS, Answer.UNKNOWN, value=value, forced=forced
        )
        self._uses.append(use)
        if self._notify is not None:
            self._notify(use)
        return Note(self, len(self._uses) - 1, use)

    def replace(self, place: int, use: Use) -> None:
        """Replace the use noted at this index."""
        self._uses[place] = use
        if self._notify is not None:
            self._notify(use)

    def uses(self) -> tuple[Use, ...]:
        """Return all uses; incomplete ones of the dead end with their death."""
        return ended_by_death(self._uses)


def ended_by_death(uses: Iterable[Use]) -> tuple[Use, ...]:
    """End the incomplete uses of the dead with their death.

    A death is copied to every motor that the dead party used.
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
    """Return the uses of each motor in the order of their calls."""
    motors: dict[str, list[Use]] = {}
    for use in sorted(uses, key=lambda use: use.called_ns):
        motors.setdefault(use.motor, []).append(use)
    return motors


def overtaken(uses: Sequence[Use]) -> list[tuple[Use, Use]]:
    """Return pairs of uses (first, second) of one motor where the second overtook the first.

    The first was in the queue before the second asked, but got the motor later. The order is that
    of their tokens, if both have one. A forced use from a living owner needs no place in the queue.
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
        first: Use | None = None  # the earliest in the queue among those with a greater token
        for use in queued:
            if first is not None and _place_ns(first) < use.called_ns:
                found.append((first, use))
            if first is None or _place_ns(use) < _place_ns(first):
                first = use
    return found


def _place_ns(use: Use) -> int:
    return use.returned_ns if use.queued_ns is None else use.queued_ns


def tokens_that_did_not_grow(uses: Sequence[Use]) -> list[tuple[Use, Use]]:
    """Return pairs of uses (earlier, later) of one motor where the later token is not greater.

    Notes are late: a party that was paused may report its token after that of the next owner. A
    use is later only if it was called after the other one's return. Whoever executed commands is
    left to `require_linearizable`: a lock without fencing is no lock with wrong tokens.
    """
    found: list[tuple[Use, Use]] = []
    for of_motor in per_motor(uses).values():
        called = [use for use in of_motor if use.action is Action.TAKE and use.token]
        returned = sorted(called, key=lambda use: use.returned_ns)
        tokens: dict[int, Use] = {}
        for use in returned:
            if tokens.setdefault(use.token, use) is not use:
                found.append((tokens[use.token], use))
        place, greatest = 0, None
        for use in called:
            while place < len(returned) and returned[place].returned_ns < use.called_ns:
                one = returned[place]
                greatest = one if greatest is None or one.token > greatest.token else greatest
                place += 1
            if greatest is not None and use.token < greatest.token:
                found.append((greatest, use))
    return found


def worst_gap_s(uses: Iterable[Use], begun_ns: int, ended_ns: int) -> float:
    """Return the longest time without a grant of the motor [s]."""
    times = sorted(
        use.returned_ns
        for use in uses
        if use.action is Action.TAKE and use.answer is Answer.DONE and use.returned_ns <= ended_ns
    )
    times = [begun_ns, *times, ended_ns]
    return max(after - before for before, after in pairwise(times)) / 1e9


def to_line(use: Use) -> str:
    """Return the use as one line of JSON, without a newline."""
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


def to_note(use: Use) -> bytes:
    """Return the use as a line for a file that several processes append to.

    A process that is killed in the middle leaves a part of it (write(2) ends early at a page of the
    file). So each note begins a line.
    """
    return f"\n{to_line(use)}\n".encode()


def from_notes(text: str) -> list[Use]:
    """Read uses from notes; a part of a note had no effect, and does not count."""
    return from_lines(line for line in text.splitlines() if line.endswith("]"))


def from_lines(lines: Iterable[str]) -> list[Use]:
    """Read uses from lines; the last line of each use counts."""
    uses: dict[tuple[str, str, Action, int], Use] = {}
    for line in lines:
        use = from_line(line)
        uses[use.who, use.motor, use.action, use.called_ns] = use
    return list(uses.values())


def from_line(line: str) -> Use:
    """Read a use from a line of `to_line`."""
    who, motor, action, called, returned, answer, queued, token, value, forced = json.loads(line)
    return Use(
        who, motor, Action(action), called, returned, Answer(answer), queued, token, value, forced
    )
