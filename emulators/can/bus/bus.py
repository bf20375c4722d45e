"""A CAN bus with ports: arbitration, transmission time, delivery and faults.

The bus is a sans-I/O core like a controller: it receives frames and the time, and returns its next
deadline. `CanSegment` decides which node sends, and what happens to a frame under faults. Without
an active or possible fault all of this costs one flag.

Here the wire may be split. Each part is a `CanSegment` with its own arbitration (the bus itself is
the part that all others have left). A node that moves to another part first listens until it has
heard 11 recessive bits. The frame that it was sending is sent again.
"""

from typing import final

from motorhil.emulators.can.bitlevel.episode import ALL_PORTS
from motorhil.emulators.can.bus.fault_plan import FaultEvent, FaultPlan, FaultSeam
from motorhil.emulators.can.bus.port import (
    CUT_OFF,
    DELIVERED,
    NEVER_NS,
    PORT_MASK,
    PORT_SHIFT,
    CanPort,
    Delivery,
    Presence,
    Role,
    kind_without,
)
from motorhil.emulators.can.bus.segment import CanSegment
from motorhil.emulators.can.controller_config import PLAIN, CanNode, FrameSupport
from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import PARTING, FaultKind, FaultRule, NoiseSource
from motorhil.emulators.can.frame_length import CLASSICAL_MAX, LENGTHS_MASK, bits_of

_Place = tuple[str, ...]  # rules that separate a node from the others; empty: on the bus


@final
class CanBus(CanSegment):
    """A CAN bus. Sans-I/O; times are int nanoseconds on one timeline that starts at 0.

    The caller calls `expire` at each `next_deadline_ns`, and never submits at a time later than a
    deadline that is still due.

    Memory grows with `CanStatistics` (at most 16 bytes per frame), with the frames submitted and
    not yet sent, and with fault events until they are taken.

    Args:
        name: the name used in records.
        bitrate_bit_s: nominal bit rate [bit/s]; a bit must be a whole number of nanoseconds.
        faults: the faults to inject; None: no faults at all. An empty plan costs nothing either.
        data_bitrate_bit_s: bit rate of the data phase of CAN FD frames with a bit rate switch
            [bit/s]; a bit must be a whole number of nanoseconds, and the rate not below the nominal
            one. None: the bus is classical.

    Attributes (read only): name, bitrate_bit_s, bit_ns [ns], statistics; eventful, True if
    `take_fault_events` has any.

    Raises:
        ValueError: a bit is not a whole number of nanoseconds, or the data rate is too low.
    """

    __slots__ = (
        "_fd_kind",
        "_has_plan",
        "_parts",
        "_places",
        "_sources",
        "_where",
        "bitrate_bit_s",
        "data_bitrate_bit_s",
        "eventful",
    )

    def __init__(
        self,
        name: str,
        bitrate_bit_s: int = 1_000_000,
        faults: FaultPlan | None = None,
        data_bitrate_bit_s: int | None = None,
    ) -> None:
        bit_ns = _bit_ns(name, bitrate_bit_s)
        data_bit_ns = 0 if data_bitrate_bit_s is None else _bit_ns(name, data_bitrate_bit_s)
        if data_bit_ns > bit_ns:
            raise ValueError(
                f"bus {name}: the data bit rate of {data_bitrate_bit_s} bit/s is below the "
                f"nominal bit rate of {bitrate_bit_s} bit/s"
            )
        self._has_plan = faults is not None
        seam = FaultSeam(FaultPlan((), _no_chance) if faults is None else faults)
        super().__init__(name, bit_ns, data_bit_ns, seam, [])
        self.bitrate_bit_s: int = bitrate_bit_s
        self.data_bitrate_bit_s: int | None = data_bitrate_bit_s
        self._fd_kind = DELIVERED  # of a CAN FD frame: only FD nodes receive it
        self.eventful: bool = False
        self._parts: dict[_Place, CanSegment] = {}
        self._where: list[CanSegment] = []  # by port
        self._places: list[_Place] = []  # by port
        self._sources: dict[tuple[str, int, _Place], NoiseSource] = {}
        self._keep_rules(0)
        self._settle()

    def attach(self, name: str, chip: CanNode = PLAIN, now_ns: int = 0) -> int:
        """Add a node to the bus and return its port number, counted from 0.

        Raises:
            ValueError: the name is taken, or 4096 ports are attached.
        """
        number = len(self._ports)
        if number > PORT_MASK:
            raise ValueError(f"bus {self.name}: too many ports; the limit is {PORT_MASK + 1}")
        if name in self.port_names():
            raise ValueError(f"bus {self.name}: there is already a port named {name}")
        node = Presence(number, name, chip)
        self._nodes.append(node)
        self._seam.attach(name)
        self._ports.append(_empty_port(number, name, chip))
        if chip.frames is not FrameSupport.FD:
            self._fd_kind = kind_without(self._fd_kind, 1 << number)
        for part in self._parts.values():
            part.add_port(_empty_port(number, name, chip))
        place = self._place_of(name)
        where = self._segment(place)
        self._where.append(where)
        self._places.append(place)
        where.enter(node, now_ns, integrated=not (self._faulty and where.is_under_way(now_ns)))
        self._spread_rules(now_ns)
        self._settle()
        return number

    def hand_over(self, number: int, name: str, now_ns: int) -> bool:
        """Give a port that is no longer used to another program; return False if it must wait.

        It must wait while a frame of the port is pending or delayed, its CAN controller does not
        take part, or a rule has put the new name on another wire. The error counters stay.

        Raises:
            ValueError: another port has the name.
        """
        node = self._nodes[number]
        busy = self.pending(number) or self._seam.is_late(number) or node.role is not Role.ON
        if busy or self._place_of(name) != self._places[number]:
            return False
        if name == node.name:
            return True
        if name in self.port_names():
            raise ValueError(f"bus {self.name}: there is already a port named {name}")
        for port in (segment.port(number) for segment in self._segments()):
            port.name = name
        node.name = name
        self._seam.rename(number, name)
        self._spread_rules(now_ns)
        self._settle()
        return True

    def next_deadline_ns(self) -> int | None:
        """Return the time of the next completion or fault [ns], or None if nothing is pending."""
        due_ns = self.deadline_ns()
        return None if due_ns == NEVER_NS else due_ns

    def deadline_ns(self) -> int:
        """Return `next_deadline_ns`, with NEVER_NS (-1) for None."""
        if self._faulty:
            return self._deadline_with_faults_ns()
        return self._end_ns if self._flight else NEVER_NS

    def expire(self, now_ns: int) -> list[Delivery]:
        """Return the deliveries complete by `now_ns`, in order, and arbitrate the next frame."""
        deliveries: list[Delivery] = []
        if self._faulty:
            self._expire_with_faults(now_ns, deliveries)
            return deliveries
        while self._flight and self._end_ns <= now_ns:
            entry = self._flight
            number = entry >> PORT_SHIFT & PORT_MASK
            node = self._ports[number]
            bits, kind = entry & LENGTHS_MASK, DELIVERED
            if bits > CLASSICAL_MAX:
                bits, kind = bits_of(bits), self._fd_kind
            deliveries.append((node.frame, number, kind))
            self._succeed(node, entry, bits)
            if self._competing:
                self._arbitrate(self._free_ns)
                if self._collided:
                    break
            else:
                self._flight = 0
        return deliveries

    def pending(self, port: int) -> int:
        """Return the number of submitted frames of this port that are not yet sent completely."""
        where = self._where[port]
        return super().pending(port) if where is self else where.pending(port)

    def withdraw(self, port: int) -> int:
        """Discard this port's pending frames, except one in flight, and return their number."""
        where = self._where[port]
        return super().withdraw(port) if where is self else where.withdraw(port)

    def arbitration_losses(self, port: int) -> int:
        """Return how often a frame of this port competed and had to wait for another node's."""
        where = self._where[port]
        return super().arbitration_losses(port) if where is self else where.arbitration_losses(port)

    # --- nodes

    def node(self, port: int) -> Presence:
        """Return the state and counters of the node at this port. Read only."""
        return self._nodes[port]

    def error_state(self, port: int) -> ErrorState:
        """Return the error state: error active, warning, error passive or bus-off."""
        return self._nodes[port].state()

    def restart(self, port: int, now_ns: int) -> None:
        """Let a bus-off node begin to wait for the 128 runs of recessive bits.

        Raises:
            ValueError: the node is not bus-off.
        """
        node = self._nodes[port]
        if node.role is not Role.OFF:
            raise ValueError(f"bus {self.name}: {node.name} is not bus-off ({node.confinement})")
        self._where[port].resume(now_ns)
        node.leave(now_ns)
        node.since_ns = now_ns

    # --- with faults

    def inject(self, rule: FaultRule, now_ns: int) -> None:
        """Add a fault rule, effective from now on; `next_deadline_ns` may change.

        Raises:
            ValueError: the bus was made without a fault plan, or has had a rule of that name.
        """
        self._require_plan()
        self._seam.plan.add(rule)
        self._recheck(now_ns)

    def lift(self, name: str, now_ns: int) -> None:
        """Remove the rule with this name; frames that it has delayed still arrive.

        Raises:
            ValueError: the bus was made without a fault plan, or does not have such a rule.
        """
        self._require_plan()
        self._seam.plan.remove(name)
        self._recheck(now_ns)

    def take_fault_events(self) -> list[FaultEvent]:
        """Return (time [ns], rule or node, what, frame) of each fault since the last call."""
        self.eventful = False
        return self._seam.plan.take_events()

    def faults_fired(self) -> dict[str, int]:
        """Return how often each rule has fired, by name, in the order of adding."""
        return self._seam.plan.fired()

    def _require_plan(self) -> None:
        if not self._has_plan:
            raise ValueError(f"bus {self.name} has no fault plan; give it one, which may be empty")

    def _segments(self) -> list[CanSegment]:
        return [self, *self._parts.values()]

    def _recheck(self, now_ns: int) -> None:
        """Apply changed rules to all parts of the bus."""
        for segment in self._segments():
            segment.freeze(now_ns)
            segment.resume(now_ns)
        self._keep_rules(now_ns)
        for segment in self._segments():
            segment.count_members()
        self._settle()

    def _settle(self) -> None:
        """Set the flag that selects the path with faults or the one without."""
        for part in self._parts.values():
            self.statistics.absorb(part.statistics)
        self.eventful = self._seam.plan.has_events()
        self._faulty = bool(self._parts) or not (self._seam.is_idle() and self._is_calm())
        if not self._faulty:
            for port in self._ports:
                port.repeated.clear()

    def _deadline_with_faults_ns(self) -> int:
        due_ns = self._seam.next_ns()
        for segment in self._segments():
            one_ns = segment.due_ns()
            if one_ns >= 0 and not 0 <= due_ns <= one_ns:
                due_ns = one_ns
        return due_ns

    def _expire_with_faults(self, now_ns: int, out: list[Delivery]) -> None:
        """Expire with faults; of what is due at one time, rules come first and late frames last."""
        seam = self._seam
        due_ns = self._deadline_with_faults_ns()
        while 0 <= due_ns <= now_ns:
            if seam.is_change_due(due_ns):
                self._keep_rules(due_ns)
            elif not self._step_one(due_ns, out):
                seam.hear_late(due_ns, out)
            due_ns = self._deadline_with_faults_ns()
        if seam.plan.end_rules(now_ns):
            for segment in self._segments():
                segment.count_members()
        self._settle()

    def _step_one(self, due_ns: int, out: list[Delivery]) -> bool:
        for segment in self._segments():
            if segment.due_ns() == due_ns:
                segment.step(due_ns, out)
                return True
        return False

    # --- lasting rules

    def _keep_rules(self, now_ns: int) -> None:
        """Apply the beginning and end of lasting rules: membership of wires, and faults there."""
        if self._seam.keep(now_ns):
            self._part(now_ns)
            self._spread_rules(now_ns)

    def _place_of(self, name: str) -> _Place:
        place: list[str] = []
        for rule in self._seam.plan.lasting(*PARTING):
            if name in rule.ports:
                place.append(rule.name if rule.kind is FaultKind.SPLIT else f"{rule.name}/{name}")
        return tuple(place)

    def _segment(self, place: _Place) -> CanSegment:
        if not place:
            return self
        part = self._parts.get(place)
        if part is None:
            part = CanSegment(self.name, self.bit_ns, self.data_bit_ns, self._seam, self._nodes)
            for node in self._nodes:
                part.add_port(_empty_port(node.number, node.name, node.chip))
            self._parts[place] = part
        return part

    def _part(self, now_ns: int) -> None:
        """Move ports to the wire where the rules put them."""
        moved: dict[tuple[_Place, _Place], list[Presence]] = {}
        for node in self._nodes:
            before, after = self._places[node.number], self._place_of(node.name)
            if before != after:
                moved.setdefault((before, after), []).append(node)
        for (before, after), nodes in moved.items():
            self._move(nodes, self._segment(before), self._segment(after), now_ns)
            for node in nodes:
                self._places[node.number] = after
        for place in [place for place in self._parts if place not in self._places]:
            self.statistics.absorb(self._parts.pop(place).statistics)
        self._seam.deaf_mask = 0
        for segment in self._parts.values():
            if len(segment.members) == 1:
                self._seam.deaf_mask |= 1 << segment.members[0].number

    def _move(
        self, nodes: list[Presence], source: CanSegment, target: CanSegment, now_ns: int
    ) -> None:
        """Move these nodes to another wire; a frame of theirs in flight may continue there."""
        going_on = None if target.members else source.under_way([n.number for n in nodes], now_ns)
        for node in nodes:
            source.leave(node, now_ns)
            target.take_port(node.number, source)
            self._where[node.number] = target
        for node in nodes:
            target.enter(node, now_ns, integrated=going_on is not None)
        if going_on is not None:
            target.go_on(*going_on)

    def _spread_rules(self, now_ns: int) -> None:
        """Give each wire its noise, stuck level and babbling nodes."""
        plan = self._seam.plan
        sources: dict[tuple[str, int, _Place], NoiseSource] = {}
        for place, segment in [((), self), *self._parts.items()]:
            noises: list[NoiseSource] = []
            for rule in plan.lasting(FaultKind.NOISE):
                for ports in self._ears(rule, segment):
                    key = (rule.name, ports, place)
                    sources[key] = self._sources.get(key) or NoiseSource(rule, ports, plan.draw)
                    noises.append(sources[key])
            segment.set_noises(noises, now_ns)
            names = [node.name for node in segment.members]
            rules = plan.lasting(FaultKind.SHORT)
            shorts = [rule for rule in rules if rule.shorts(names, segment is self)]
            segment.set_level(shorts[0].level if shorts else None, now_ns)
            segment.go_on_babbling(now_ns)
        self._sources = sources

    def _ears(self, rule: FaultRule, segment: CanSegment) -> list[int]:
        """Return port masks that see the inverted bits: one for all, or one per port."""
        if not rule.ports:
            return [ALL_PORTS]
        return [1 << node.number for node in segment.members if node.name in rule.ports]

    def _submit_held(self, node: CanPort, entry: int, frame: bytes, now_ns: int) -> bool:
        number = node.tag >> PORT_SHIFT
        where = self._where[number]
        if where is self:
            return super()._submit_held(node, entry, frame, now_ns)
        where.submit(number, frame, now_ns)
        return True


def _empty_port(number: int, name: str, chip: CanNode) -> CanPort:
    """Return the port of a node in a part of the bus where the node is not."""
    port = CanPort(number, name, chip)
    port.entry = CUT_OFF
    return port


def _no_chance() -> float:
    raise AssertionError("a bus without a fault plan draws no random numbers")


def _bit_ns(name: str, rate_bit_s: int) -> int:
    """Return the duration of a bit [ns]."""
    if rate_bit_s <= 0 or 1_000_000_000 % rate_bit_s:
        raise ValueError(
            f"bus {name}: a bit at {rate_bit_s} bit/s is not a whole number of nanoseconds; "
            "use 8M, 5M, 4M, 2M, 1M, 800k, 500k, 250k, 125k, 100k, 50k, 20k or 10k"
        )
    return 1_000_000_000 // rate_bit_s
