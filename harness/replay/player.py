"""Plays a tape: finds what the controller is told in the recording, and says what comes of it.

Sans-I/O, of no protocol. Commands are found by key, the next one in the recording's order first;
one that was skipped may still come. What then comes by itself keeps its recorded delay behind the
command. When the recording has no more of it, what was periodic goes on as it was.

A host that is faster than the recorded one cuts short what would still have come: of each
identifier only the last is sent then, at once.
"""

from collections import deque
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import Final, final

from traces.tape import Key, Role, Sent, Step, Tape

LOOK_AHEAD: Final = 64
"""So many commands a host may leave out at once; further away, the same words mean another time."""
_KEPT: Final = 8
_NEVER_NS: Final = 1 << 62
_OVERTIME: Final = 6  # quarters of a period after which what was periodic is missed


@final
@dataclass(frozen=True, slots=True)
class Mismatch:
    """Something that was told, and that the recording cannot answer.

    Attributes:
        time_ns: when.
        came: what was told, as a sentence.
        expected: what the recording has in its place; None: nothing of the kind.
        before: what the controller had answered last, oldest first.
    """

    time_ns: int
    came: str
    expected: Step | None
    before: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.expected is None:
            place = "it is at its end, or has nothing of the kind"
        else:
            at_s = self.expected.time_ns / 1e9
            place = f"expected, as at {at_s:.6f} s of it: {self.expected.text}"
        return f"the recording cannot answer: {self.came}; {place}"


@final
class TapePlayer:
    """One recorded controller.

    Attributes:
        matched: how many commands were found in the recording.
        repeated: commands that were told again, and answered as before.
        mismatches: what could not be answered.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.matched = 0
        self.repeated = 0
        self.mismatches: list[Mismatch] = []
        self._steps = tape.steps
        self._commands = [
            number for number, step in enumerate(self._steps) if step.role is Role.COMMAND
        ]
        self._used = [number == 0 for number in range(len(self._steps))]
        self._place = 0  # in _steps: of the command that is furthest
        self._next = 0  # in _commands: the first behind it
        self._values: dict[tuple[str, int], bytes] = {}  # last told, by what it was about
        self._told: dict[Key, Step] = {}
        self._polls: dict[Key, list[Step]] = {}  # of the epoch, those still to come
        self._answered: dict[Key, Step] = {}  # of the epoch
        self._latest: dict[Key, Step] = {}  # what has no dialogue: SYNC, remote frames
        self._constants = _constants(self._steps)
        self._anchor_ns = 0
        self._epoch_ns = 0  # when the command that is furthest was told
        self._reactions: list[Sent] = []
        self._reaction = 0
        self._due: list[tuple[int, int, bytes]] = []  # answers, by time and order
        self._asked = 0
        self._periodic: dict[int, tuple[int, bytes]] = {}  # identifier: when next, frame
        self._before: deque[str] = deque(maxlen=_KEPT)

    def start(self, now_ns: int) -> None:
        """The recording begins."""
        self._go_to(0, now_ns)

    # ------------------------------------------------------------------------- what is told

    def command(self, key: Key, now_ns: int) -> Step | None:
        """The step of this command; None: the recording has none that could be meant.

        What is not the recording's next command, and was told just before with the same data, is
        the same again: it is answered as then, and nothing comes of it.
        """
        is_again = self._values.get(key[:2]) == key[2] and not self.is_next(key)
        number = None if is_again else self._find(key)
        if number is None:
            before = self._told.get(key)
            self.repeated += int(before is not None)
            return before
        step = self._steps[number]
        self._used[number] = True
        self._told[key] = step
        self._values[key[:2]] = key[2]
        self._has_answered(step)
        self.matched += 1
        self._go_to(number, now_ns)
        return step

    def poll(self, key: Key, now_ns: int) -> Step | None:
        """What is answered to this now; None: the recording does not tell.

        Within an epoch, what was asked in it, in order, and then the last of it again; besides,
        what never has another answer; to a SYNC or a remote frame, what it got last. That nothing
        was answered (it had not booted yet) holds only until the time, behind the command, at which
        it sent something, or was asked again.
        """
        waiting = self._polls.get(key)
        while waiting and len(waiting) > 1 and _is_silent(waiting[0]):
            if now_ns - self._epoch_ns < self._silent_for_ns(waiting[0], waiting[1]):
                break
            del waiting[0]
        step = waiting.pop(0) if waiting else self._answered.get(key, self._constants.get(key))
        if step is None:
            step = self._latest.get(key)
        if step is not None:
            self._answered[key] = step
            if not step.turns:
                self._latest[key] = step
            self._has_answered(step)
        return step

    def forget(self) -> None:
        """It has begun anew: what it was told before is nothing that it knows."""
        self._values.clear()
        self.forget_latest()

    def forget_latest(self) -> None:
        """What a SYNC or a remote frame got last is not what it would get now."""
        self._latest.clear()

    def commands_gone(self) -> int:
        """How many commands of the recording are not behind the last one found."""
        return self._next

    def is_next(self, key: Key) -> bool:
        """Whether the recording's next command is this."""
        if self._next == len(self._commands):
            return False
        return self._steps[self._commands[self._next]].key == key

    def refuse(self, key: Key, came: str, now_ns: int) -> Mismatch:
        """What came cannot be answered: that is noted, with what was expected."""
        mismatch = Mismatch(now_ns, came, self._expected(key), self.answered_last())
        self.mismatches.append(mismatch)
        return mismatch

    def answered_last(self) -> tuple[str, ...]:
        """What it has answered last, as sentences, oldest first."""
        return tuple(self._before)

    def left(self) -> list[Step]:
        """Commands of the recording, up to the last one found, that were never told."""
        return [
            self._steps[number]
            for number in self._commands
            if not self._used[number] and number < self._place
        ]

    def to_come(self) -> int:
        """How many commands of the recording are behind the last one found."""
        return len(self._commands) - self._next

    # ------------------------------------------------------------------------- what it sends

    def answer(self, sent: list[Sent], now_ns: int) -> None:
        """These are sent, each at its delay behind now."""
        for one in sent:
            self._asked += 1
            due_ns = now_ns + max(0, one.delay_ns - one.duration_ns)
            heappush(self._due, (due_ns, self._asked, one.data))

    def next_deadline_ns(self) -> int | None:
        """When something is to be sent [ns]."""
        due_ns = self._due[0][0] if self._due else None
        own_ns = self._own_ns()
        if due_ns is None or (own_ns is not None and own_ns < due_ns):
            return own_ns
        return due_ns

    def take(self, now_ns: int) -> list[bytes]:
        """What is to be sent by now, in order."""
        out: list[bytes] = []
        while True:
            own_ns = self._own_ns()
            answer_ns = self._due[0][0] if self._due else None
            if answer_ns is not None and (own_ns is None or answer_ns <= own_ns):
                if answer_ns > now_ns:
                    return out
                out.append(heappop(self._due)[2])
            elif own_ns is None or own_ns > now_ns:
                return out
            else:
                out.append(self._take_own(own_ns))

    def forget_answers(self, identifier: int) -> None:
        """What was to be answered by this identifier is not: the transfer has been given up."""
        can_id = identifier.to_bytes(4, "little")
        self._due = [one for one in self._due if one[2][:4] != can_id]
        heapify(self._due)

    # -------------------------------------------------------------------------------- inside

    def _has_answered(self, step: Step) -> None:
        """What it said is kept; a PDO or a SYNC, which say nothing, push nothing out."""
        if step.answer_text:
            self._before.append(step.answer_text)

    def _silent_for_ns(self, step: Step, later: Step) -> int:
        """How long behind the epoch's command what was told nothing to `step` stayed so."""
        command = self._steps[self._place]
        asked_ns = step.time_ns - command.time_ns
        spoke_ns = (sent.delay_ns for sent in command.reactions if sent.delay_ns > asked_ns)
        return min(next(spoke_ns, _NEVER_NS), later.time_ns - command.time_ns)

    def _find(self, key: Key) -> int | None:
        """The step of a command: the first behind the last one found, else one left out."""
        ahead = self._commands[self._next : self._next + LOOK_AHEAD]
        left_out = self._commands[max(0, self._next - LOOK_AHEAD) : self._next]
        for number in (*ahead, *reversed(left_out)):
            if not self._used[number] and self._steps[number].key == key:
                return number
        return None

    def _go_to(self, number: int, now_ns: int) -> None:
        """The command's epoch has begun, unless it is one that had been left out."""
        self._cut_short(now_ns)
        step = self._steps[number]
        self._anchor_ns, self._reactions, self._reaction = now_ns, step.reactions, 0
        if number < self._place:
            return
        self._place, self._epoch_ns = number, now_ns
        while self._next < len(self._commands) and self._commands[self._next] <= number:
            self._next += 1
        self._polls.clear()
        self._answered.clear()
        end = self._commands[self._next] if self._next < len(self._commands) else None
        for poll in self._steps[number + 1 : end]:
            self._polls.setdefault(poll.key, []).append(poll)
        if step.answers:  # asked once more, a SYNC that fired something only asks
            self._answered[step.key] = step
            self._latest[step.key] = step

    def _cut_short(self, now_ns: int) -> None:
        """Of what was still to come by itself, the last of each identifier is sent now."""
        last: dict[bytes, Sent] = {}
        for sent in self._reactions[self._reaction :]:
            last.pop(sent.data[:4], None)
            last[sent.data[:4]] = sent
        for sent in last.values():
            self._asked += 1
            heappush(self._due, (now_ns, self._asked, sent.data))
            self._keep_period(sent.data, now_ns, _OVERTIME if sent.goes_on else 0)
        self._reaction = len(self._reactions)

    def _own_ns(self) -> int | None:
        """When it next sends something by itself [ns]."""
        if self._reaction < len(self._reactions):
            sent = self._reactions[self._reaction]
            return self._anchor_ns + max(0, sent.delay_ns - sent.duration_ns)
        if not self._periodic:
            return None
        return min(self._periodic.values())[0]

    def _take_own(self, own_ns: int) -> bytes:
        if self._reaction < len(self._reactions):
            sent = self._reactions[self._reaction]
            self._reaction += 1
            self._keep_period(sent.data, own_ns, _OVERTIME if sent.goes_on else 0)
            return sent.data
        identifier = min(self._periodic, key=self._periodic.__getitem__)
        data = self._periodic[identifier][1]
        self._keep_period(data, own_ns, 4)
        return data

    def _keep_period(self, data: bytes, own_ns: int, quarters: int) -> None:
        """It is due again so many quarters of its period later; 0: not by itself."""
        identifier = int.from_bytes(data[:4], "little")
        if quarters:
            period_ns = self.tape.periods_ns[identifier]
            self._periodic[identifier] = (own_ns + period_ns * quarters // 4, data)
        else:
            self._periodic.pop(identifier, None)

    def _expected(self, key: Key) -> Step | None:
        """What the recording has where this came: the same object with other data, or the next."""
        ahead = self._commands[self._next : self._next + LOOK_AHEAD]
        for number in ahead:
            if self._steps[number].key[:2] == key[:2]:
                return self._steps[number]
        return self._steps[ahead[0]] if ahead else None


def _constants(steps: list[Step]) -> dict[Key, Step]:
    """Polls that are answered the same whenever they are asked."""
    found: dict[Key, Step | None] = {}
    for step in steps:
        if step.role is not Role.POLL or not step.turns:
            continue
        if step.key not in found:
            found[step.key] = step
            continue
        first = found[step.key]
        if first is not None and _answers(first) != _answers(step):
            found[step.key] = None
    return {key: step for key, step in found.items() if step is not None}


def _is_silent(step: Step) -> bool:
    return bool(step.turns) and not any(turn.answers for turn in step.turns)


def _answers(step: Step) -> list[list[bytes]]:
    return [[sent.data for sent in turn.answers] for turn in step.turns]
