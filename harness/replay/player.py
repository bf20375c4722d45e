"""Player of an exchange log: the answers of one recorded controller.

The player is sans-I/O and independent of the protocol. Commands are found by key, the next one in
recorded order first. A skipped command may still come later. Spontaneous frames keep their recorded
delay after the command. When the recording has no more of them, periodic frames continue with their
period.

A host may be faster than the recorded one and cut short the remaining reactions. Then only the last
frame of each identifier is sent, at once.
"""

from bisect import bisect_right
from collections import deque
from heapq import heapify, heappop, heappush
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.exchange.steps import ExchangeLog, Key, Role, Sent, Step

LOOK_AHEAD: Final = 64
"""The number of commands that a host may skip at once; a later equal command is another one."""
_KEPT: Final = 8
_NEVER_NS: Final = 1 << 62
_OVERTIME: Final = 6  # quarters of a period after which a periodic frame counts as overdue


@final
@frozen
class Mismatch:
    """A command that the recording cannot answer.

    Attributes:
        time_ns: the time of the command [ns].
        came: the command, as a sentence.
        expected: the recorded step in its place; None if there is no such step.
        before: the last answers of the controller, oldest first.
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
class ExchangePlayer:
    """Player of one recorded controller.

    Attributes:
        matched: number of commands found in the recording.
        repeated: number of repeated commands, which are answered as before.
        mismatches: the commands without an answer.
    """

    def __init__(self, log: ExchangeLog) -> None:
        self.log = log
        self.matched: int = 0
        self.repeated: int = 0
        self.mismatches: list[Mismatch] = []
        self._steps = log.steps
        self._commands = [
            number for number, step in enumerate(self._steps) if step.role is Role.COMMAND
        ]
        self._used = [number == 0 for number in range(len(self._steps))]
        self._place = 0  # index in _steps of the furthest command
        self._next = 0  # index in _commands of the first one after it
        self._values: dict[tuple[str, int], bytes] = {}  # last value, by subject
        self._told: dict[Key, Step] = {}
        self._polls: dict[Key, deque[Step]] = {}  # remaining polls of the epoch
        self._answered: dict[Key, Step] = {}  # in the epoch
        self._latest: dict[Key, Step] = {}  # for keys without a dialogue: SYNC, remote frames
        self._constants = _constants(self._steps)
        self._anchor_ns = 0
        self._epoch_ns = 0  # when the furthest command arrived
        self._reactions: list[Sent] = []
        self._reaction = 0
        self._due: list[tuple[int, int, bytes]] = []  # answers, by time and order
        self._asked = 0
        self._periodic: dict[int, tuple[int, bytes]] = {}  # identifier: next due time, frame
        self._before: deque[str] = deque(maxlen=_KEPT)
        self._by_key: dict[Key, list[int]] = {}  # built when it is first needed

    def start(self, now_ns: int) -> None:
        """Start the playback at `now_ns`."""
        self._go_to(0, now_ns)

    # ------------------------------------------------------------------------- commands and polls

    def command(self, key: Key, now_ns: int) -> Step | None:
        """Return the step of this command, or None if the recording has no such command.

        A command that is not next in the recording but equals the last one is a repetition: it gets
        the same answer and has no other effect.
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
        """Return the step that answers this poll now, or None if the recording has none.

        Within an epoch, the recorded polls answer in order, and the last one repeats. Otherwise a
        poll with a constant answer gets that answer. A SYNC or a remote frame gets its last answer.
        Silence (before boot-up) lasts only until the recorded time, after the command, of the next
        frame sent or the next poll.
        """
        waiting = self._polls.get(key)
        while waiting and len(waiting) > 1 and _is_silent(waiting[0]):
            if now_ns - self._epoch_ns < self._silent_for_ns(waiting[0], waiting[1]):
                break
            waiting.popleft()
        step = waiting.popleft() if waiting else self._answered.get(key, self._constants.get(key))
        if step is None:
            step = self._latest.get(key)
        if step is not None:
            self._answered[key] = step
            if not step.turns:
                self._latest[key] = step
            self._has_answered(step)
        return step

    def nearest(self, key: Key) -> Step | None:
        """Return the last answered poll of this key up to the present place of the recording."""
        numbers = self._numbers_of(key)
        place = bisect_right(numbers, self._place)
        return self._steps[numbers[place - 1]] if place else None

    def forget(self) -> None:
        """Forget all earlier values and answers, after the controller's restart."""
        self._values.clear()
        self.forget_latest()

    def forget_latest(self) -> None:
        """Forget the last answers to SYNC and remote frames."""
        self._latest.clear()

    def commands_gone(self) -> int:
        """Return the number of recorded commands up to the last one found."""
        return self._next

    def is_next(self, key: Key) -> bool:
        """Return True if this is the recording's next command."""
        if self._next == len(self._commands):
            return False
        return self._steps[self._commands[self._next]].key == key

    def refuse(self, key: Key, came: str, now_ns: int) -> Mismatch:
        """Record a mismatch for a command that cannot be answered, and return it."""
        mismatch = Mismatch(now_ns, came, self._expected(key), self.answered_last())
        self.mismatches.append(mismatch)
        return mismatch

    def answered_last(self) -> tuple[str, ...]:
        """Return the last answers as sentences, oldest first."""
        return tuple(self._before)

    def never_came(self) -> list[Step]:
        """Return the recorded commands that no command has matched, in recorded order."""
        return [self._steps[number] for number in self._commands if not self._used[number]]

    # ------------------------------------------------------------------------- transmission

    def answer(self, sent: list[Sent], now_ns: int) -> None:
        """Schedule these frames, each at its delay from now."""
        for one in sent:
            self._asked += 1
            due_ns = now_ns + max(0, one.delay_ns - one.duration_ns)
            heappush(self._due, (due_ns, self._asked, one.data))

    def next_deadline_ns(self) -> int | None:
        """Return when the next frame is due [ns], or None."""
        due_ns = self._due[0][0] if self._due else None
        own_ns = self._own_ns()
        if due_ns is None or (own_ns is not None and own_ns < due_ns):
            return own_ns
        return due_ns

    def take(self, now_ns: int) -> list[bytes]:
        """Return the frames to send by now, in order."""
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
        """Cancel the pending answers with this identifier after an aborted transfer."""
        can_id = identifier.to_bytes(4, "little")
        self._due = [one for one in self._due if one[2][:4] != can_id]
        heapify(self._due)

    # -------------------------------------------------------------------------------- inside

    def _numbers_of(self, key: Key) -> list[int]:
        """Return the numbers of the answered polls of a key, in order."""
        if not self._by_key:
            for number, step in enumerate(self._steps):
                if step.role is Role.POLL and step.turns and not _is_silent(step):
                    self._by_key.setdefault(step.key, []).append(number)
        return self._by_key.get(key, [])

    def _has_answered(self, step: Step) -> None:
        """Keep the text of the answer; a PDO or a SYNC has no text."""
        if step.answer_text:
            self._before.append(step.answer_text)

    def _silent_for_ns(self, step: Step, later: Step) -> int:
        """Return how long `step` remained unanswered after the epoch's command [ns]."""
        command = self._steps[self._place]
        asked_ns = step.time_ns - command.time_ns
        spoke_ns = (sent.delay_ns for sent in command.reactions if sent.delay_ns > asked_ns)
        return min(next(spoke_ns, _NEVER_NS), later.time_ns - command.time_ns)

    def _find(self, key: Key) -> int | None:
        """Find the step of a command: first after the last one found, then among skipped ones."""
        ahead = self._commands[self._next : self._next + LOOK_AHEAD]
        left_out = self._commands[max(0, self._next - LOOK_AHEAD) : self._next]
        for number in (*ahead, *reversed(left_out)):
            if not self._used[number] and self._steps[number].key == key:
                return number
        return None

    def _go_to(self, number: int, now_ns: int) -> None:
        """Begin the command's epoch, unless the command is one that was skipped earlier."""
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
            self._polls.setdefault(poll.key, deque()).append(poll)
        if step.answers:  # repeated, a SYNC that triggered something is only a poll
            self._answered[step.key] = step
            self._latest[step.key] = step

    def _cut_short(self, now_ns: int) -> None:
        """Send the last pending frame of each identifier now and drop the others."""
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
        """Return when the next spontaneous frame is due [ns], or None."""
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
        """Schedule the next periodic frame after so many quarter periods; 0: stop it."""
        identifier = int.from_bytes(data[:4], "little")
        if quarters:
            period_ns = self.log.periods_ns[identifier]
            self._periodic[identifier] = (own_ns + period_ns * quarters // 4, data)
        else:
            self._periodic.pop(identifier, None)

    def _expected(self, key: Key) -> Step | None:
        """Return the recorded step in place of `key`: with the same object, else the next one."""
        ahead = self._commands[self._next : self._next + LOOK_AHEAD]
        for number in ahead:
            if self._steps[number].key[:2] == key[:2]:
                return self._steps[number]
        return self._steps[ahead[0]] if ahead else None


def _constants(steps: list[Step]) -> dict[Key, Step]:
    """Return the polls whose answers never change."""
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
