"""Fault plan of a CAN bus: rules, their firings and effects.

DROP, DELAY, DUPLICATE and CORRUPT are evaluated once per complete frame, ERROR once when a frame
has begun. Rules are tried in order; the first that fires decides.
"""

from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Final, final

from motorhil.emulators.can.bitlevel.encoder import DOMINANT, WireFrame, wire_frame
from motorhil.emulators.can.bitlevel.episode import ALL_PORTS, Disturbance, Effect
from motorhil.emulators.can.bus.port import DELIVERED, HEARD, LOST, NEVER_NS, Delivery, kind_without
from motorhil.emulators.can.error_confinement import ACK_SLOT, CRC_DELIMITER, DATA, DLC
from motorhil.emulators.can.fault_rules import LASTING, FaultKind, FaultRule, FrameError
from motorhil.emulators.can.frame import RTR_FLAG, can_id_of, pack
from motorhil.emulators.can.frame_length import INTERMISSION_BITS

STUFF_RUN: Final = 5
# the sender's error flag (6), the last bit of the overload flags that follow it, a delimiter (8)
ERROR_FRAME_BITS: Final = 15

# (time [ns], rule or node, event, the frame hit; no bytes without a frame)
FaultEvent = tuple[int, str, str, bytes]


def has_bit(frame: bytes, bit: int) -> bool:
    """Return whether the frame, or the intermission behind it, has a bit of this number."""
    return bit < len(wire_frame(frame).levels) + INTERMISSION_BITS


def struck(rule: FaultRule, frame: bytes, sender: int, ports: int) -> Disturbance | None:
    """Return the disturbance for an ERROR rule, or None if the frame has no place for it.

    Args:
        rule: the ERROR rule.
        frame: as it is sent.
        sender: its port.
        ports: mask of the ports that see it; ALL_PORTS: all that can detect it.
    """
    if rule.bit is not None:
        return Disturbance(rule.bit, ports=ports)
    wire = wire_frame(frame)
    receivers = ports if ports != ALL_PORTS else ~(1 << sender)
    match rule.error:
        case FrameError.BIT:
            return Disturbance(wire.places.index(DLC), ports=ports)
        case FrameError.STUFF:
            first = wire.places.index(DLC)
            return Disturbance(first, Effect.DOMINANT, STUFF_RUN + 1, receivers)
        case FrameError.FORM:
            return Disturbance(wire.places.index(CRC_DELIMITER), Effect.DOMINANT, 1, ports)
        case FrameError.ACK:
            return Disturbance(wire.places.index(ACK_SLOT), Effect.RECESSIVE, 1, 1 << sender)
        case FrameError.LAST:
            last = len(wire.levels) - 1
            if ports == ALL_PORTS:
                return Disturbance(last, Effect.DOMINANT, 1, 1 << sender)
            return Disturbance(last - 1, Effect.DOMINANT, 1, ports & ~(1 << sender))
        case _:
            place = _unnoticed_until_crc(wire)
            return None if place is None else Disturbance(place, ports=receivers)


def _unnoticed_until_crc(wire: WireFrame) -> int | None:
    """Return the last bit up to the CRC whose inversion leaves all stuff bits in place.

    In CAN FD the stuff bits of the CRC are fixed, and none is behind its last bit (ISO
    11898-1:2015).
    """
    end = wire.places.index(CRC_DELIMITER)
    if wire.is_fd:
        return end - 1
    data = [place for place, where in enumerate(wire.places) if where == DATA]
    for place in range(end - 1, data[0] if data else wire.places.index(DLC) + 4, -1):
        levels = bytearray(wire.levels[:end])
        levels[place] ^= 1
        if not wire.stuffed[place] and _stuff_bits(bytes(levels)) == list(wire.stuffed[:end]):
            return place
    return None


def _stuff_bits(levels: bytes) -> list[int]:
    """Return 1 for each level that a receiver takes for a stuff bit; empty after a stuff error."""
    stuffed: list[int] = []
    run, last, due = 0, 1 - DOMINANT, False
    for level in levels:
        if due and level == last:
            return []
        stuffed.append(1 if due else 0)
        run = 1 if due or level != last else run + 1
        last = level
        due = run == STUFF_RUN
    return stuffed


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
        self._ended: list[str] = []  # rules that can hit no frame any more
        self._next_end_ns = NEVER_NS  # of such a rule, at the earliest
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
            return
        if rule.until_ns is not None:
            self._end_at(rule.until_ns)
        if rule.kind is FaultKind.ERROR:
            self._errors.append(rule)
        else:
            self._rules.append(rule)

    def remove(self, name: str) -> None:
        """Remove a rule; its count stays.

        Raises:
            ValueError: the plan does not have a rule of that name.
        """
        if name in self._ended:
            self._ended.remove(name)
            return
        if name not in [rule.name for rule in self._rules + self._errors + self._lasting]:
            raise ValueError(f"fault {name}: unknown rule")
        self._rules = [rule for rule in self._rules if rule.name != name]
        self._errors = [rule for rule in self._errors if rule.name != name]
        self._lasting = [rule for rule in self._lasting if rule.name != name]

    def _end_at(self, now_ns: int) -> None:
        if self._next_end_ns < 0 or now_ns < self._next_end_ns:
            self._next_end_ns = now_ns

    def end_rules(self, now_ns: int) -> bool:
        """Set aside rules that can hit no frame any more; return whether there are any."""
        if not 0 <= self._next_end_ns <= now_ns:
            return False
        self._next_end_ns = NEVER_NS
        ended: list[str] = []
        for rule in self._rules + self._errors:
            if (rule.until_ns is not None and rule.until_ns <= now_ns) or (
                rule.limit is not None and self._fired[rule.name] >= rule.limit
            ):
                ended.append(rule.name)
            elif rule.until_ns is not None:
                self._end_at(rule.until_ns)
        self._rules = [rule for rule in self._rules if rule.name not in ended]
        self._errors = [rule for rule in self._errors if rule.name not in ended]
        self._ended += ended
        return bool(ended)

    def is_empty(self) -> bool:
        """Return whether the plan has no rule that may act, and no lasting rule is active."""
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
        if rule.limit is not None and self._fired[rule.name] >= rule.limit:
            self._end_at(now_ns)
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


@final
class FaultSeam:
    """The additional state of a bus with a fault plan; not used without faults.

    Memory grows with the delayed frames, and as `FaultPlan` says.

    Attributes: plan; deaf_mask, the ports (1 << number) that are alone and hear nothing (written by
    the bus).
    """

    def __init__(self, plan: FaultPlan) -> None:
        self.plan = plan
        self.deaf_mask = 0
        self._names: list[str] = []
        self._late: list[tuple[int, int, bytes, int, int]] = []  # heap: due, turn, frame, port, hit
        self._turn = 0
        self._next_change_ns = NEVER_NS

    def is_idle(self) -> bool:
        """Return whether no fault is active or possible."""
        return not self._late and self.plan.is_empty()

    def attach(self, name: str) -> None:
        """Add the next port, with this name."""
        self._names.append(name)

    def rename(self, number: int, name: str) -> None:
        """Give the port another name."""
        self._names[number] = name

    def is_late(self, number: int) -> bool:
        """Return whether a delayed frame of this port is still to be heard."""
        return any(port == number for _, _, _, port, _ in self._late)

    def next_ns(self) -> int:
        """Return when a rule changes or a late frame is heard; NEVER_NS if nothing is due."""
        if not self._late:
            return self._next_change_ns
        due_ns = self._late[0][0]
        return self._next_change_ns if 0 <= self._next_change_ns < due_ns else due_ns

    def is_change_due(self, now_ns: int) -> bool:
        """Return whether a rule begins or ends now, or should have before."""
        return 0 <= self._next_change_ns <= now_ns

    def keep(self, now_ns: int) -> bool:
        """Update the lasting rules and return whether they have changed since the last call."""
        changed = self.plan.keep(now_ns)
        self._next_change_ns = self.plan.next_change_ns(now_ns)
        return changed

    def babbles(self) -> list[tuple[int, bytes]]:
        """Return (port, frame) of each node that babbles now."""
        return [
            (self._names.index(rule.sender), pack(rule.identifier, rule.data))
            for rule in self.plan.lasting(FaultKind.BABBLE)
            if rule.sender in self._names and rule.identifier is not None
        ]

    def hear_late(self, now_ns: int, out: list[Delivery]) -> None:
        """Append the frames whose delay is over."""
        while self._late and self._late[0][0] <= now_ns:
            _, _, frame, port, hit = heappop(self._late)
            self._tell(out, frame, port, HEARD, hit & ~self.deaf_mask)

    def complete(
        self, frame: bytes, port: int, now_ns: int, ears: int, silent: bool, out: list[Delivery]
    ) -> bool:
        """Apply the fault rules to a complete frame and append the deliveries to `out`.

        Args:
            frame: as it was sent.
            port: of its sender.
            now_ns: when it was complete [ns].
            ears: mask of the ports that it has reached.
            silent: do not inform the sender, because the frame was not submitted.
            out: the deliveries of the bus.

        Returns:
            True if the sender believes that it failed, and sends it again.
        """
        rule = self.plan.verdict(frame, self._names[port], now_ns)
        if rule is None:
            self.deliver(frame, port, ears, silent, out)
            return False
        hit = self.mask(rule.ports) if rule.ports else -1
        if rule.kind is FaultKind.DUPLICATE:
            self.hear(frame, port, hit & ears, out)
            return True
        self.deliver(frame, port, ears & ~hit, silent, out)
        if rule.kind is FaultKind.DELAY:
            self._turn += 1
            heappush(self._late, (now_ns + rule.delay_ns, self._turn, frame, port, hit & ears))
        elif rule.kind is FaultKind.CORRUPT:
            self.hear(self.plan.corrupted(rule, frame), port, hit & ears, out)
        return False

    def deliver(
        self, frame: bytes, port: int, ears: int, silent: bool, out: list[Delivery]
    ) -> None:
        """Deliver the frame to these ports and confirm it to its sender."""
        self._tell(out, frame, port, HEARD if silent else DELIVERED, ears)

    def hear(self, frame: bytes, port: int, ears: int, out: list[Delivery]) -> None:
        """Deliver the frame to these ports without informing its sender."""
        self._tell(out, frame, port, HEARD, ears)

    def mask(self, names: Sequence[str]) -> int:
        """Return the mask of the ports with these names; unknown names are ignored."""
        mask = 0
        for number, name in enumerate(self._names):
            if name in names:
                mask |= 1 << number
        return mask

    def _tell(self, out: list[Delivery], frame: bytes, port: int, kind: int, ears: int) -> None:
        """Append a delivery to the ports of a mask; it is LOST if no port is left to hear it."""
        others = ((1 << len(self._names)) - 1) & ~(1 << port)
        if others & ears:
            out.append((frame, port, kind_without(kind, others & ~ears)))
        elif kind == DELIVERED:
            out.append((frame, port, LOST))
