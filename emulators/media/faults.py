"""What can go wrong on a CAN bus, on purpose: which frames are hit, how, and how often.

What a receiver can notice is modelled, in CAN's own terms where it has them:

- DROP: the sender believes the frame sent; the ports hit do not hear it (with some ports: CAN's
  inconsistent omission).
- DELAY: the ports hit hear it later, as behind a gateway or a slow driver; others may overtake it.
- DUPLICATE: an error in the last bit of the end of frame. The ports hit have accepted the frame by
  then, the sender has not and sends it again: an error flag and its delimiter (14 bits), and a new
  arbitration. Who was not hit hears it once (with some ports: CAN's inconsistent duplicate).
- CORRUPT: the ports hit hear other data than were sent. No CRC catches it: it happened in a
  gateway's or a node's memory. (What the CRC catches is repeated by CAN itself, and belongs to
  error confinement.)
- CUT: ports are off the bus for a time. They hear nothing, and what they want to send waits; a
  frame of theirs in flight is destroyed and sent again afterwards. Ports cut are alone, each.

A plan is asked once per complete frame. Its rules are tried in order; the first that fires decides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_frame import EFF_FLAG, EFF_MASK, RTR_FLAG, can_id_of

# (time [ns], rule, what happened, the frame hit; no bytes for a cut)
FaultEvent = tuple[int, str, str, bytes]

NEVER_NS: Final = -1


class FaultKind(Enum):
    """What happens to a frame, or to a port."""

    DROP = "drop"
    DELAY = "delay"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    CUT = "cut"


@final
@dataclass(frozen=True, slots=True)
class FaultRule:
    """Which frames are hit, and how. A rule without conditions hits every frame.

    Attributes:
        name: how records and counts call it; one of a kind in a plan.
        kind: what happens.
        identifier: hit frames whose can_id agrees with this one under `mask`; None: all.
        mask: the bits of can_id that must agree; by default the identifier and its format.
        sender: hit only frames of the port with this name; None: of all.
        ports: names of the receivers hit; empty: all. CUT: the ports that lose the bus.
        from_ns: hit frames that end at this time or later [ns]. CUT: when it begins.
        until_ns: hit frames that end before this time [ns]; None: no end. CUT: when it is over.
        probability: of firing, for each frame that meets all conditions; 1.0 draws nothing.
        skip: so many frames that would be hit are spared first.
        limit: it fires no more often than this; None: no limit.
        delay_ns: DELAY: how much later the frame is heard [ns].
        flip: CORRUPT: the data bits that change, from the first byte on; empty: one bit, drawn.

    Raises:
        ValueError: values that make no sense, by name.
    """

    name: str
    kind: FaultKind
    identifier: int | None = None
    mask: int = EFF_FLAG | EFF_MASK
    sender: str | None = None
    ports: tuple[str, ...] = ()
    from_ns: int = 0
    until_ns: int | None = None
    probability: float = 1.0
    skip: int = 0
    limit: int | None = None
    delay_ns: int = 0
    flip: bytes = b""

    def __post_init__(self) -> None:
        cut = self.kind is FaultKind.CUT
        if not 0.0 <= self.probability <= 1.0:
            self._refuse(f"probability {self.probability} is not 0.0 to 1.0")
        if self.from_ns < 0 or (self.until_ns is not None and self.until_ns <= self.from_ns):
            self._refuse(f"from_ns {self.from_ns} until_ns {self.until_ns} is no span of time")
        if self.skip < 0 or (self.limit is not None and self.limit < 1):
            self._refuse(f"skip {self.skip} is below 0, or limit {self.limit} below 1")
        if (self.delay_ns > 0) is not (self.kind is FaultKind.DELAY) or self.delay_ns < 0:
            self._refuse(f"delay_ns is {self.delay_ns}; a delay has one above 0, others have none")
        if self.flip and (self.kind is not FaultKind.CORRUPT or not any(self.flip)):
            self._refuse("flip is for corrupt, and has a bit set")
        if cut and not self.ports:
            self._refuse("a cut names the ports that lose the bus")
        conditional = self.identifier is not None or self.sender is not None or self.skip > 0
        if cut and (conditional or self.limit is not None or self.probability < 1.0):
            self._refuse("a cut has no condition but its time")

    def _refuse(self, reason: str) -> None:
        raise ValueError(f"fault {self.name}: {reason}")

    def is_met_by(self, can_id: int, sender: str, now_ns: int) -> bool:
        """Whether all conditions but chance and number hold."""
        return (
            now_ns >= self.from_ns
            and (self.until_ns is None or now_ns < self.until_ns)
            and (self.identifier is None or not (can_id ^ self.identifier) & self.mask)
            and (self.sender is None or self.sender == sender)
        )


@final
class FaultPlan:
    """The rules of one bus, with what they did so far.

    Same rules, same frames and same draws: same faults. `random` answers 0.0 <= x < 1.0; it is the
    bus's own stream of the run's seed, drawn from once per frame and rule whose conditions are met
    (and once more for a bit to flip).

    Memory grows by one event per firing until `take_events` is called.
    """

    def __init__(self, rules: Sequence[FaultRule], random: Callable[[], float]) -> None:
        self._random = random
        self._rules: list[FaultRule] = []
        self._cuts: list[FaultRule] = []
        self._met: dict[str, int] = {}
        self._fired: dict[str, int] = {}
        self._cut_now: dict[str, FaultRule] = {}  # by rule name: cuts that have begun and not ended
        self._events: list[FaultEvent] = []
        for rule in rules:
            self.add(rule)

    def add(self, rule: FaultRule) -> None:
        """The rule holds from now on, after those before it.

        Raises:
            ValueError: a rule of that name was there before.
        """
        if rule.name in self._fired:
            raise ValueError(f"fault {rule.name}: there is a rule of that name already")
        self._met[rule.name] = 0
        self._fired[rule.name] = 0
        if rule.kind is FaultKind.CUT:
            self._cuts.append(rule)
        else:
            self._rules.append(rule)

    def remove(self, name: str) -> None:
        """The rule holds no longer; its count stays.

        Raises:
            ValueError: there is no rule of that name.
        """
        if name not in [rule.name for rule in self._rules + self._cuts]:
            raise ValueError(f"there is no fault rule {name}")
        self._rules = [rule for rule in self._rules if rule.name != name]
        self._cuts = [rule for rule in self._cuts if rule.name != name]

    def is_empty(self) -> bool:
        """Whether no rule holds and no cut is on."""
        return not (self._rules or self._cuts or self._cut_now)

    def fired(self) -> dict[str, int]:
        """How often each rule has fired, by name, in the order of adding."""
        return dict(self._fired)

    def take_events(self) -> list[FaultEvent]:
        """What happened since last asked, in order."""
        events = self._events
        self._events = []
        return events

    def verdict(self, frame: bytes, sender: str, now_ns: int) -> FaultRule | None:
        """The rule that hits this frame, complete at `now_ns`; None: it gets through."""
        can_id = can_id_of(frame)
        for rule in self._rules:
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
        if rule.probability < 1.0 and self._random() >= rule.probability:
            return False
        self._met[name] += 1
        return self._met[name] > rule.skip

    def corrupted(self, rule: FaultRule, frame: bytes) -> bytes:
        """The frame as those hit hear it; its data differ."""
        length = frame[4]
        data = bytearray(frame)
        if rule.flip:
            for index in range(min(length, len(rule.flip))):
                data[8 + index] ^= rule.flip[index]
        else:
            bit = int(self._random() * length * 8)
            data[8 + (bit >> 3)] ^= 1 << (bit & 7)
        return bytes(data)

    def keep_cuts(self, now_ns: int) -> list[str]:
        """The names of the ports cut off at `now_ns`; what has begun or ended is recorded."""
        on: dict[str, FaultRule] = {}
        for rule in self._cuts:
            if rule.from_ns <= now_ns and (rule.until_ns is None or now_ns < rule.until_ns):
                on[rule.name] = rule
        for name, rule in self._cut_now.items():
            if name not in on:
                self._events.append((now_ns, name, f"{', '.join(rule.ports)} back", b""))
        for name, rule in on.items():
            if name not in self._cut_now:
                self._record(now_ns, rule, f"{', '.join(rule.ports)} cut off", b"")
        self._cut_now = on
        return self.cut_ports()

    def cut_ports(self) -> list[str]:
        """The names of the ports cut off when `keep_cuts` was last called."""
        return [port for rule in self._cut_now.values() for port in rule.ports]

    def next_cut_ns(self, now_ns: int) -> int:
        """When a cut begins or ends next, after `now_ns`; NEVER_NS if none does."""
        next_ns = NEVER_NS
        for rule in self._cuts:
            for time_ns in (rule.from_ns, rule.until_ns):
                if time_ns is not None and time_ns > now_ns and not 0 <= next_ns <= time_ns:
                    next_ns = time_ns
        return next_ns

    def _record(self, now_ns: int, rule: FaultRule, what: str, frame: bytes) -> None:
        self._fired[rule.name] += 1
        self._events.append((now_ns, rule.name, what, frame))


def _corruptible(rule: FaultRule, frame: bytes) -> bool:
    """Whether the frame has data bits to flip."""
    if frame[3] & RTR_FLAG >> 24:
        return False
    return any(rule.flip[: frame[4]]) if rule.flip else frame[4] > 0
