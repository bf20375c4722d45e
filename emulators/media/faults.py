"""Fault plan of a CAN bus: rules, their firings and recorded events.

DROP, DELAY, DUPLICATE and CORRUPT are evaluated once per complete frame, ERROR once when a frame
has begun. Rules are tried in order; the first that fires decides.
"""

from collections.abc import Callable, Sequence
from typing import Final, final

from emulators.media.can_frame import RTR_FLAG, can_id_of
from emulators.media.error_places import has_bit
from emulators.media.fault_rule import LASTING, FaultKind, FaultRule

__all__ = ["NEVER_NS", "FaultEvent", "FaultKind", "FaultPlan", "FaultRule"]

# (time [ns], rule or node, event, the frame hit; no bytes without a frame)
FaultEvent = tuple[int, str, str, bytes]

NEVER_NS: Final = -1


@final
class FaultPlan:
    """The rules of one bus and their effects so far.

    Same rules, same frames and same draws give the same faults. `random` returns 0.0 <= x < 1.0. It
    is the bus's own stream of the run's seed, drawn from once per frame and rule whose conditions
    are met (and once more for a bit to flip).

    Memory grows by one event per firing until `take_events` is called.
    """

    def __init__(self, rules: Sequence[FaultRule], random: Callable[[], float]) -> None:
        self._random = random
        self._rules: list[FaultRule] = []
        self._errors: list[FaultRule] = []
        self._lasting: list[FaultRule] = []
        self._met: dict[str, int] = {}
        self._fired: dict[str, int] = {}
        self._now: dict[str, FaultRule] = {}  # active lasting rules by name
        self._events: list[FaultEvent] = []
        for rule in rules:
            self.add(rule)

    def add(self, rule: FaultRule) -> None:
        """Add a rule behind the others, effective from now on.

        Raises:
            ValueError: the plan has had a rule of that name.
        """
        if rule.name in self._fired:
            raise ValueError(
                f"fault {rule.name}: name already used; expected one that is unique in the plan"
            )
        self._met[rule.name] = 0
        self._fired[rule.name] = 0
        if rule.kind in LASTING:
            self._lasting.append(rule)
        elif rule.kind is FaultKind.ERROR:
            self._errors.append(rule)
        else:
            self._rules.append(rule)

    def remove(self, name: str) -> None:
        """Remove a rule; its count stays.

        Raises:
            ValueError: the plan does not have a rule of that name.
        """
        if name not in [rule.name for rule in self._rules + self._errors + self._lasting]:
            raise ValueError(f"fault {name}: unknown rule")
        self._rules = [rule for rule in self._rules if rule.name != name]
        self._errors = [rule for rule in self._errors if rule.name != name]
        self._lasting = [rule for rule in self._lasting if rule.name != name]

    def is_empty(self) -> bool:
        """Return whether the plan has no rule and no lasting rule is active."""
        return not (self._rules or self._errors or self._lasting or self._now)

    def has_errors(self) -> bool:
        """Return whether the plan has an ERROR rule."""
        return bool(self._errors)

    def fired(self) -> dict[str, int]:
        """Return how often each rule has fired, by name, in the order of adding."""
        return dict(self._fired)

    def has_events(self) -> bool:
        """Return whether there are events since the last `take_events`."""
        return bool(self._events)

    def take_events(self) -> list[FaultEvent]:
        """Return the events since the last call, in order."""
        events = self._events
        self._events = []
        return events

    def verdict(self, frame: bytes, sender: str, now_ns: int) -> FaultRule | None:
        """Return the rule that hits this frame, complete at `now_ns`, or None."""
        return self._first(self._rules, frame, sender, now_ns)

    def strike(self, frame: bytes, sender: str, now_ns: int) -> FaultRule | None:
        """Return the ERROR rule that hits this frame, begun at `now_ns`, or None."""
        return self._first(self._errors, frame, sender, now_ns)

    def _first(
        self, rules: list[FaultRule], frame: bytes, sender: str, now_ns: int
    ) -> FaultRule | None:
        if not rules:
            return None
        can_id = can_id_of(frame)
        for rule in rules:
            if rule.is_met_by(can_id, sender, now_ns) and self._fires(rule, frame):
                self._record(now_ns, rule, rule.kind.value, frame)
                return rule
        return None

    def _fires(self, rule: FaultRule, frame: bytes) -> bool:
        name = rule.name
        if rule.limit is not None and self._fired[name] >= rule.limit:
            return False
        if rule.kind is FaultKind.CORRUPT and not _corruptible(rule, frame):
            return False
        if rule.bit is not None and not has_bit(frame, rule.bit):
            return False
        if rule.probability < 1.0 and self._random() >= rule.probability:
            return False
        self._met[name] += 1
        return self._met[name] > rule.skip

    def corrupted(self, rule: FaultRule, frame: bytes) -> bytes:
        """Return the frame as the ports hit receive it, with changed data."""
        length = frame[4]
        data = bytearray(frame)
        if rule.flip:
            for index in range(min(length, len(rule.flip))):
                data[8 + index] ^= rule.flip[index]
        else:
            bit = int(self._random() * length * 8)
            data[8 + (bit >> 3)] ^= 1 << (bit & 7)
        return bytes(data)

    def keep(self, now_ns: int) -> bool:
        """Update the lasting rules, record changes, and return whether there are any."""
        on: dict[str, FaultRule] = {}
        for rule in self._lasting:
            if rule.from_ns <= now_ns and (rule.until_ns is None or now_ns < rule.until_ns):
                on[rule.name] = rule
        if on == self._now:
            return False
        for name, rule in self._now.items():
            if name not in on:
                self._events.append((now_ns, name, _over(rule), b""))
        for name, rule in on.items():
            if name not in self._now:
                self.note(now_ns, name, _begun(rule), b"")
                if rule.kind is not FaultKind.NOISE:  # noise is counted by the bits it inverts
                    self._fired[name] += 1
        self._now = on
        return True

    def lasting(self, *kinds: FaultKind) -> list[FaultRule]:
        """Return the rules of these kinds active at the last `keep`, in the order of adding."""
        return [rule for rule in self._now.values() if rule.kind in kinds]

    def next_change_ns(self, now_ns: int) -> int:
        """Return when a lasting rule begins or ends next, after `now_ns`; NEVER_NS if none does."""
        next_ns = NEVER_NS
        for rule in self._lasting:
            for time_ns in (rule.from_ns, rule.until_ns):
                if time_ns is not None and time_ns > now_ns and not 0 <= next_ns <= time_ns:
                    next_ns = time_ns
        return next_ns

    def draw(self) -> float:
        """Return the next random number of this plan's stream, 0.0 <= x < 1.0."""
        return self._random()

    def note(self, now_ns: int, name: str, what: str, frame: bytes) -> None:
        """Record an event at a node, or on the wire."""
        self._events.append((now_ns, name, what, frame))

    def inverted(self, now_ns: int, rule: FaultRule, what: str, frame: bytes) -> None:
        """Record a bit that noise has inverted."""
        self._record(now_ns, rule, what, frame)

    def _record(self, now_ns: int, rule: FaultRule, what: str, frame: bytes) -> None:
        self._fired[rule.name] += 1
        self._events.append((now_ns, rule.name, what, frame))


def _corruptible(rule: FaultRule, frame: bytes) -> bool:
    """Return whether the frame has data bits to flip."""
    if frame[3] & RTR_FLAG >> 24:
        return False
    return any(rule.flip[: frame[4]]) if rule.flip else frame[4] > 0


def _begun(rule: FaultRule) -> str:
    ports = ", ".join(rule.ports)
    on = f" of {ports}" if ports else ""
    return {
        FaultKind.CUT: f"{ports} cut off",
        FaultKind.SPLIT: f"{ports} split off",
        FaultKind.NOISE: f"bit error rate {rule.bit_error_rate:g}",
        FaultKind.BABBLE: f"{rule.sender} babbles",
        FaultKind.SHORT: f"the wire{on} is stuck {rule.level.value if rule.level else ''}",
    }[rule.kind]


def _over(rule: FaultRule) -> str:
    return {
        FaultKind.NOISE: "no more noise",
        FaultKind.BABBLE: f"{rule.sender} babbles no more",
        FaultKind.SHORT: "the wire is free",
    }.get(rule.kind, f"{', '.join(rule.ports)} back")
