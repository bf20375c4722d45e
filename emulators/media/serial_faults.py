"""What can go wrong on a serial line, on purpose: which frames are hit, how, and how often.

- LOSE: nobody hears it; the line was busy all the same.
- DELAY: it begins later, as from a server that was busy, or behind a converter.
- CORRUPT: bits are flipped; the check sum catches it.
- TRUNCATE: it ends early.
- PAUSE: there is a silence in the middle of it.
- REPEAT: it is sent once more, later, as a late answer of somebody slow would be.
- NOISE: characters are glued in front of it.

A plan is asked once per frame somebody sends. Its rules are tried in order; the first that fires
decides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import final

from emulators.media.rule_conditions import wrong_condition

# (characters, how much later they begin [ns], pause after so many, pause [ns], whether heard)
Fate = tuple[bytes, int, int, int, bool]

# (time [ns], rule, what happened, the characters hit)
SerialFaultEvent = tuple[int, str, str, bytes]


@final
class SerialFaultKind(Enum):
    """What happens to what a port sends."""

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
    """Which frames are hit, and how. A rule without conditions hits every frame.

    Attributes:
        name: how records and counts call it.
        kind: what happens.
        sender: hit only what this port sends; None: all.
        unit: hit only frames of this server address.
        function: hit only frames with this function code (without the exception bit).
        from_ns, until_ns: hit what is sent from the one on [ns], and before the other.
        probability: of firing; 1.0 draws nothing.
        skip: so many frames that would be hit are spared first.
        limit: it fires no more often than this; None: no limit.
        delay_ns: DELAY, PAUSE, REPEAT: how long [ns].
        after: TRUNCATE, PAUSE: after so many characters.
        flip: CORRUPT: what changes, from the first character on; empty: one bit, drawn.
        noise: NOISE: what is glued in front.

    Raises:
        ValueError: values that make no sense, by name.
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
            self._refuse(f"delay_ns is {self.delay_ns}; delay, pause and repeat have one above 0")
        if (self.after > 0) is not (self.kind in _PLACED) or self.after < 0:
            self._refuse(f"after is {self.after}; truncate and pause have one above 0")
        if self.flip and (self.kind is not SerialFaultKind.CORRUPT or not any(self.flip)):
            self._refuse("flip is for corrupt, and has a bit set")
        if bool(self.noise) is not (self.kind is SerialFaultKind.NOISE):
            self._refuse("noise is for noise, which needs some")

    def _refuse(self, reason: str) -> None:
        raise ValueError(f"fault {self.name}: {reason}")

    def is_met_by(self, data: bytes, sender: str, now_ns: int, head: int = 0) -> bool:
        """Whether all conditions but chance and number hold; the address is at `head`."""
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
    """The rules of one line, with what they did so far.

    Same rules, same frames and same draws: same faults. `random` answers 0.0 <= x < 1.0.
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
        """The rule holds from now on, after those before it.

        Raises:
            ValueError: a rule of that name was there before.
        """
        if rule.name in self._fired:
            raise ValueError(f"fault {rule.name}: there is a rule of that name already")
        self._met[rule.name] = self._fired[rule.name] = 0
        self._rules.append(rule)

    def remove(self, name: str) -> None:
        """The rule holds no longer; its count stays.

        Raises:
            ValueError: there is no rule of that name.
        """
        if name not in [rule.name for rule in self._rules]:
            raise ValueError(f"there is no fault rule {name}")
        self._rules = [rule for rule in self._rules if rule.name != name]

    def fired(self) -> dict[str, int]:
        """How often each rule has fired, by name, in the order of adding."""
        return dict(self._fired)

    def take_events(self) -> list[SerialFaultEvent]:
        """What happened since last asked, in order."""
        events, self._events = self._events, []
        return events

    def fates(self, data: bytes, sender: str, now_ns: int, head: int = 0) -> list[Fate]:
        """What becomes of these characters; as they are, if no rule fires.

        `head`: so many stand before the server address (6 in Modbus/TCP).
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
