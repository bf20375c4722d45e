"""Fault rules of a serial line: frames hit, effects and conditions.

- LOSE: no port hears the frame; the line is busy all the same.
- DELAY: the frame begins later, as from a busy server, or behind a converter.
- CORRUPT: bits are flipped; the checksum detects it.
- TRUNCATE: the frame ends early.
- PAUSE: there is a silence in the middle of the frame.
- REPEAT: the frame is sent once more, later, like the late response of a slow device.
- NOISE: characters are put in front of the frame.

A plan is evaluated once per sent frame. Its rules are tried in order; the first that fires decides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import final

# (characters, delay of their beginning [ns], pause after so many, pause [ns], whether heard)
Fate = tuple[bytes, int, int, int, bool]

# (time [ns], rule, event, the characters hit)
SerialFaultEvent = tuple[int, str, str, bytes]


def wrong_condition(
    probability: float, from_ns: int, until_ns: int | None, skip: int, limit: int | None
) -> str:
    """Return the error in the conditions of probability, time [ns] and number, or ""."""
    if not 0.0 <= probability <= 1.0:
        return f"probability {probability}: invalid; expected 0.0 to 1.0"
    if from_ns < 0 or (until_ns is not None and until_ns <= from_ns):
        return f"from_ns {from_ns} until_ns {until_ns}: invalid; expected 0 <= from_ns < until_ns"
    if skip < 0 or (limit is not None and limit < 1):
        return f"skip {skip} is below 0, or limit {limit} is below 1"
    return ""


@final
class SerialFaultKind(Enum):
    """The effect of a rule on the data that a port sends."""

    LOSE = "lose"
    DELAY = "delay"
    CORRUPT = "corrupt"
    TRUNCATE = "truncate"
    PAUSE = "pause"
    REPEAT = "repeat"
    NOISE = "noise"


_TIMED = (SerialFaultKind.DELAY, SerialFaultKind.PAUSE, SerialFaultKind.REPEAT)
_PLACED = (SerialFaultKind.TRUNCATE, SerialFaultKind.PAUSE)


@final
@dataclass(frozen=True, slots=True)
class SerialFaultRule:
    """A fault rule: the frames hit and the effect. A rule without conditions hits every frame.

    Attributes:
        name: the name in records and counts.
        kind: the effect.
        sender: hit only frames of this port; None: of all.
        unit: hit only frames of this server address.
        function: hit only frames with this function code (without the exception bit).
        from_ns, until_ns: hit frames sent from the first time on [ns], and before the second.
        probability: of firing; 1.0 draws nothing.
        skip: number of frames to spare before the first hit.
        limit: maximum number of firings; None: no limit.
        delay_ns: DELAY, PAUSE, REPEAT: how long [ns].
        after: TRUNCATE, PAUSE: after so many characters.
        flip: CORRUPT: the bits that change, from the first character on; empty: one bit, drawn.
        noise: NOISE: the characters put in front.

    Raises:
        ValueError: invalid values; the message names them.
    """

    name: str
    kind: SerialFaultKind
    sender: str | None = None
    unit: int | None = None
    function: int | None = None
    from_ns: int = 0
    until_ns: int | None = None
    probability: float = 1.0
    skip: int = 0
    limit: int | None = None
    delay_ns: int = 0
    after: int = 0
    flip: bytes = b""
    noise: bytes = b""

    def __post_init__(self) -> None:
        wrong = wrong_condition(
            self.probability, self.from_ns, self.until_ns, self.skip, self.limit
        )
        if wrong:
            self._refuse(wrong)
        if (self.delay_ns > 0) is not (self.kind in _TIMED) or self.delay_ns < 0:
            self._refuse(
                f"delay_ns {self.delay_ns}: invalid; expected above 0 for delay, "
                "pause and repeat, 0 for other kinds"
            )
        if (self.after > 0) is not (self.kind in _PLACED) or self.after < 0:
            self._refuse(
                f"after {self.after}: invalid; expected above 0 for truncate and "
                "pause, 0 for other kinds"
            )
        if self.flip and (self.kind is not SerialFaultKind.CORRUPT or not any(self.flip)):
            self._refuse("flip: invalid; only corrupt has it, with at least one bit set")
        if bool(self.noise) is not (self.kind is SerialFaultKind.NOISE):
            self._refuse("noise: invalid; kind noise requires it, other kinds do not have it")

    def _refuse(self, reason: str) -> None:
        raise ValueError(f"fault {self.name}: {reason}")

    def is_met_by(self, data: bytes, sender: str, now_ns: int, head: int = 0) -> bool:
        """Return whether all conditions but probability, skip and limit hold."""
        return (
            now_ns >= self.from_ns
            and (self.until_ns is None or now_ns < self.until_ns)
            and (self.sender is None or self.sender == sender)
            and (self.unit is None or data[head : head + 1] == bytes((self.unit,)))
            and (self.function is None or self._has_function(data[head + 1 : head + 2]))
        )

    def _has_function(self, code: bytes) -> bool:
        return bool(code) and code[0] & 0x7F == self.function


@final
class SerialFaultPlan:
    """The rules of one line and their effects so far.

    Same rules, same frames and same draws give the same faults. `random` returns 0.0 <= x < 1.0.
    """

    def __init__(self, rules: Sequence[SerialFaultRule], random: Callable[[], float]) -> None:
        self._random = random
        self._rules: list[SerialFaultRule] = []
        self._met: dict[str, int] = {}
        self._fired: dict[str, int] = {}
        self._events: list[SerialFaultEvent] = []
        for rule in rules:
            self.add(rule)

    def add(self, rule: SerialFaultRule) -> None:
        """Add a rule behind the others, effective from now on.

        Raises:
            ValueError: the plan has had a rule of that name.
        """
        if rule.name in self._fired:
            raise ValueError(
                f"fault {rule.name}: name already used; expected one that is unique in the plan"
            )
        self._met[rule.name] = self._fired[rule.name] = 0
        self._rules.append(rule)

    def remove(self, name: str) -> None:
        """Remove a rule; its count stays.

        Raises:
            ValueError: the plan does not have a rule of that name.
        """
        if name not in [rule.name for rule in self._rules]:
            raise ValueError(f"fault {name}: unknown rule")
        self._rules = [rule for rule in self._rules if rule.name != name]

    def fired(self) -> dict[str, int]:
        """Return how often each rule has fired, by name, in the order of adding."""
        return dict(self._fired)

    def take_events(self) -> list[SerialFaultEvent]:
        """Return the events since the last call, in order."""
        events, self._events = self._events, []
        return events

    def fates(self, data: bytes, sender: str, now_ns: int, head: int = 0) -> list[Fate]:
        """Return what is sent in place of these characters; unchanged if no rule fires.

        `head` is the number of bytes before the server address (6 in Modbus/TCP).
        """
        for rule in self._rules:
            if rule.is_met_by(data, sender, now_ns, head) and self._fires(rule):
                self._fired[rule.name] += 1
                self._events.append((now_ns, rule.name, rule.kind.value, data))
                return self._hit(rule, data)
        return [(data, 0, 0, 0, True)]

    def _fires(self, rule: SerialFaultRule) -> bool:
        if rule.limit is not None and self._fired[rule.name] >= rule.limit:
            return False
        if rule.probability < 1.0 and self._random() >= rule.probability:
            return False
        self._met[rule.name] += 1
        return self._met[rule.name] > rule.skip

    def _hit(self, rule: SerialFaultRule, data: bytes) -> list[Fate]:
        kind = rule.kind
        if kind is SerialFaultKind.LOSE:
            return [(data, 0, 0, 0, False)]
        if kind is SerialFaultKind.DELAY:
            return [(data, rule.delay_ns, 0, 0, True)]
        if kind is SerialFaultKind.CORRUPT:
            return [(self._flipped(rule, data), 0, 0, 0, True)]
        if kind is SerialFaultKind.TRUNCATE:
            return [(data[: rule.after], 0, 0, 0, True)]
        if kind is SerialFaultKind.PAUSE:
            return [(data, 0, rule.after, rule.delay_ns, True)]
        if kind is SerialFaultKind.REPEAT:
            return [(data, 0, 0, 0, True), (data, rule.delay_ns, 0, 0, True)]
        return [(rule.noise + data, 0, 0, 0, True)]

    def _flipped(self, rule: SerialFaultRule, data: bytes) -> bytes:
        out = bytearray(data)
        if rule.flip:
            for place, flip in enumerate(rule.flip[: len(out)]):
                out[place] ^= flip
        elif out:
            bit = int(self._random() * len(out) * 8)
            out[bit >> 3] ^= 1 << (bit & 7)
        return bytes(out)
