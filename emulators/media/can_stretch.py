"""A stretch of cable with its nodes, under faults.

The fate of a frame is decided one bit after its start, the last moment at which another node could
have joined it. An undisturbed frame completes at its end, and counters go down. Otherwise the time
until all nodes agree again is an episode (`can_episode`). The episode is played bit by bit
(`Playback`), and computed again if something happens meanwhile.
"""

from dataclasses import replace
from heapq import heappush
from typing import Final

from emulators.media.can_bits import KEY_SHIFT
from emulators.media.can_episode import ALL_PORTS, Disturbance, Effect
from emulators.media.can_frame import FRAME_BYTES
from emulators.media.can_outcomes import NOBODY, CanOutcomes, bits_in
from emulators.media.can_port import CUT_OFF, PORT_MASK, PORT_SHIFT, CanPort
from emulators.media.can_presence import NEVER_NS, Presence, Role
from emulators.media.can_sampling import ONE, first_misread
from emulators.media.can_wire import wire_frame
from emulators.media.delivery import TOLD, Delivery
from emulators.media.error_message import ACK_SLOT
from emulators.media.error_places import struck
from emulators.media.fault_rule import WireLevel
from emulators.media.noise import NoiseSource
from emulators.media.playback import Playback

_LONGEST_BITS: Final = 1024  # more bits than any frame, including one that may still join
_EFFECTS: Final = {WireLevel.DOMINANT: Effect.DOMINANT, WireLevel.RECESSIVE: Effect.RECESSIVE}


class CanStretch(CanOutcomes):
    """One wire, and the nodes on it: a whole bus, or a part that is split off.

    The arguments are those of `CanMembers`.
    """

    __slots__ = ()

    def _is_calm(self) -> bool:
        """Return whether no fault is active or possible here."""
        return not (
            self._watchful
            or self._unwell
            or self._noises
            or self._collided
            or self._playback is not None
            or self._flight == NOBODY
        )

    # --- timing

    def due_ns(self) -> int:
        """Return the time of the next event here, or NEVER_NS if there is none."""
        due_ns = self._flight_due_ns()
        held_ns = self._held_due_ns() if self._held else NEVER_NS
        return due_ns if held_ns < 0 or 0 <= due_ns < held_ns else held_ns

    def _flight_due_ns(self) -> int:
        if not self._flight:
            return NEVER_NS
        if self._playback is not None:
            return self._playback.next_ns()
        if self._repeat_ns:
            return self._repeat_until_ns
        if self._flight == NOBODY:
            return NEVER_NS
        if self._decided == self._starts or self._is_quiet():
            return self._end_ns
        return self._joinable_ns

    def _held_due_ns(self) -> int:
        """Return when a held node may send again, or NEVER_NS if none can before an idle bus."""
        due_ns = NEVER_NS
        for node in self._held:
            node_ns = node.due_ns(self.bit_ns)
            if node_ns >= 0 and not 0 <= due_ns <= node_ns:
                due_ns = node_ns
        if self._flight and (due_ns > self._start_ns or self._decided == self._starts):
            return NEVER_NS
        return due_ns

    def _is_quiet(self) -> bool:
        """Return whether the frame in flight stays undisturbed, whatever may still join it."""
        if self._watchful or self._collided:
            return False
        return all(source.left >= _LONGEST_BITS for source in self._noises)

    def step(self, now_ns: int, out: list[Delivery]) -> None:
        """Process one event that is due now."""
        self._now_ns = now_ns
        if self._held and 0 <= self._held_due_ns() <= now_ns:
            for node in self._held:
                if 0 <= node.due_ns(self.bit_ns) <= now_ns:
                    self._release(node, now_ns, out)
                    return
        if self._playback is not None:
            event = self._playback.take(now_ns)
            if event is not None:
                self._happen(event, now_ns, out)
            elif not self._playback.go_on():
                self._finish(self._playback, out)
        elif self._repeat_ns:
            self.resume(now_ns)
        elif self._decided == self._starts or self._is_quiet():
            rivals = self._rivals(self._flight >> PORT_SHIFT & PORT_MASK)
            self._complete([rival.tag >> PORT_SHIFT for rival in rivals], out)
        else:
            self._decide(now_ns)

    def _release(self, node: Presence, now_ns: int, out: list[Delivery]) -> None:
        """Let the node take part again; it joins a frame that begins now."""
        if node.role is Role.OFF:
            out.append((node.recover(), node.number, TOLD))
            self._seam.plan.note(now_ns, node.name, "on the bus again", b"")
        node.role = Role.ON
        self.count_members()
        port = self._ports[node.number]
        if not port.promote():
            self.go_on_babbling(now_ns)
            return
        if self._flight:
            self._compete(port, now_ns)
            return
        port.starts_seen = self._starts
        heappush(self._competing, port.entry)
        self._arbitrate(max(now_ns, self._free_ns))

    # --- the fate of a frame

    def _decide(self, now_ns: int) -> None:
        """Decide the fate of the frame in flight, which no other node can join any more."""
        self._now_ns = now_ns
        self._decided = self._starts
        number = self._flight >> PORT_SHIFT & PORT_MASK
        port = self._ports[number]
        for node in self._held:
            node.dominant_from(self._start_ns, self.bit_ns)
        strikes = self._strikes(number, port.frame)
        rivals = self._rivals(number)
        if not self._is_struck(strikes, rivals, port):
            self._give_up_lost(now_ns)
            self._let_listen()
            return
        if self._repeats(number):
            return
        senders = [number, *(entry >> PORT_SHIFT & PORT_MASK for entry in self._competing)]
        if rivals:
            self.statistics.count_collision(self._flight >> KEY_SHIFT)
        if port.chip.shared:
            rank = self._flight >> KEY_SHIFT
            senders = [
                one
                for one in senders
                if one == number
                or self._ports[one].entry >> KEY_SHIFT != rank
                or not self._ports[one].chip.shared
            ]
        self._play(senders, strikes)
        self._let_listen()

    def _strikes(self, number: int, frame: bytes) -> list[Disturbance]:
        """Return the disturbances of this frame by fault rules."""
        strikes: list[Disturbance] = []
        seam = self._seam
        rule = seam.plan.strike(frame, self._nodes[number].name, self._start_ns)
        if rule is not None:
            ports = seam.mask(rule.ports) if rule.ports else ALL_PORTS
            strike = struck(rule, frame, number, ports)
            if strike is not None:
                strikes.append(strike)
        if self._is_apart and len(frame) == FRAME_BYTES:
            strikes += misreadings(frame, self._nodes[number], self.members)
        if self._level is not None:
            strikes.append(Disturbance(0, _EFFECTS[self._level], None))
        return strikes

    def _rivals(self, number: int) -> list[CanPort]:
        """Return other ports that send a frame of the same identifier and type now."""
        if not self._collided:
            return []
        rank = self._flight >> KEY_SHIFT
        own = self._ports[number].chip
        others = [
            self._ports[entry >> PORT_SHIFT & PORT_MASK]
            for entry in sorted(self._competing)
            if entry >> KEY_SHIFT == rank
        ]
        return [port for port in others if not (own.shared and port.chip.shared)]

    def _is_struck(self, strikes: list[Disturbance], rivals: list[CanPort], port: CanPort) -> bool:
        """Return whether anything disturbs the frame in flight."""
        if self._is_mixed and len(port.frame) > FRAME_BYTES:
            self.tell_mixed()
            return True
        number = port.tag >> PORT_SHIFT
        if len(port.frame) > FRAME_BYTES and self._nodes[number].confinement.is_passive():
            return True  # the frame shows this in ESI, which may change its stuff bits
        if strikes or any(rival.frame != port.frame for rival in rivals):
            return True
        bits = bits_in(self._flight)
        if any(source.left < bits for source in self._noises):
            return True
        senders = 1 << number
        for rival in rivals:
            senders |= 1 << (rival.tag >> PORT_SHIFT)
        return not self._ears_for(port.frame) & ~senders

    def _let_listen(self) -> None:
        """Let suspended nodes hear the frame that has begun and compete for the next one."""
        suspended = [node for node in self._held if node.role is Role.SUSPENDED]
        for node in suspended:
            node.role = Role.ON
            self._keep(node)
        if suspended:
            self.count_members()

    def _give_up_lost(self, now_ns: int) -> None:
        """Give up frames of one-shot nodes that have lost arbitration."""
        for entry in sorted(self._competing):
            port = self._ports[entry >> PORT_SHIFT & PORT_MASK]
            if port.chip.one_shot and entry >> KEY_SHIFT != self._flight >> KEY_SHIFT:
                self._leave_race(port)
                node = self._nodes[entry >> PORT_SHIFT & PORT_MASK]
                self._abort(node, port.frame, "lost arbitration")
                port.entry = CUT_OFF
                self._keep(node)

    # --- arrival and departure of nodes

    def enter(self, node: Presence, now_ns: int, integrated: bool) -> None:
        """Add the node to this wire from now on."""
        self.freeze(now_ns)
        self.resume(now_ns)
        if not integrated:
            node.integrate(now_ns)
        self._add(node)

    def leave(self, node: Presence, now_ns: int) -> None:
        """Remove the node from this wire, breaking off a frame that it is sending."""
        self.freeze(now_ns)
        self.resume(now_ns)
        number = node.number
        flight = self._flight
        port = self._ports[number]
        if self._playback is not None:
            self._playback.leave(number, now_ns)
        elif flight and flight != NOBODY and now_ns > self._start_ns:
            flying = port.entry == flight
            if flying and now_ns < self._joinable_ns:
                self._leave_at_start(node)
                return
            sender = self._nodes[flight >> PORT_SHIFT & PORT_MASK]
            if flying or not self._hearing & ~(1 << number | 1 << sender.number):
                self._play_from_start(None, now_ns).leave(number, now_ns)
        elif flight and port.entry == flight:
            self._leave_at_start(node)
            return
        self._remove(node)

    def _leave_at_start(self, node: Presence) -> None:
        """Remove a node whose frame is not visible yet, and arbitrate again without it."""
        self._put_back(self._ports[node.number])
        self._ports[node.number].entry = CUT_OFF
        self._remove(node)
        self._starts -= 1  # the same arbitration, without this node
        self._arbitrate(self._start_ns)

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether a frame is on the wire that no node can join any more."""
        return self._flight != 0 and self._joinable_ns <= now_ns

    def under_way(self, numbers: list[int], now_ns: int) -> tuple[int, bytes, int, bool] | None:
        """Return a frame of one of these ports that continues on the wire where they go.

        Returns:
            Its entry, the frame, its start of frame [ns], and whether it has been acknowledged.
            None if nothing continues; a disturbed frame does not.
        """
        self.resume(now_ns)
        entry = self._flight
        if not self.is_under_way(now_ns) or self._playback is not None or entry == NOBODY:
            return None
        number = entry >> PORT_SHIFT & PORT_MASK
        if number not in numbers:
            return None
        frame = self._ports[number].frame
        slot = wire_frame(frame).places.index(ACK_SLOT)
        acknowledged = self._bit_at(now_ns) > slot
        if acknowledged and not self._ears_for(frame) & ~(1 << number):
            return None  # a lone node's: not acknowledged
        return entry, frame, self._start_ns, acknowledged

    def go_on(self, entry: int, frame: bytes, start_ns: int, acknowledged: bool) -> None:
        """Continue a frame on this wire that began on another one."""
        number = entry >> PORT_SHIFT & PORT_MASK
        port = self._ports[number]
        if port.entry not in (0, entry):
            return
        if port.entry == entry and entry in self._competing:
            self._drop_out(entry)
        port.entry = entry
        port.frame = frame
        self._starts += 1
        self._begin(entry, start_ns)
        self._decided = self._starts
        slot = wire_frame(frame).places.index(ACK_SLOT)
        self._play([number], [Disturbance(slot, Effect.DOMINANT)] if acknowledged else [])

    def _submit_held(self, node: CanPort, entry: int, frame: bytes, now_ns: int) -> bool:
        number = node.tag >> PORT_SHIFT
        if self._nodes[number].role is Role.OFF:
            self._now_ns = now_ns
            self._abort(self._nodes[number], frame, "bus-off")
        elif node.entry == CUT_OFF or node.babbling:
            node.queue(entry, frame)
        else:
            if node.by_priority:
                self.resume(now_ns)
            return False
        return True

    # --- changes during a frame

    def set_level(self, level: WireLevel | None, now_ns: int) -> None:
        """Set the level at which the wire is stuck from now on; None: not stuck."""
        if level is self._level:
            return
        self.resume(now_ns)
        before, self._level = self._level, level
        self.count_members()
        playback = self._playback
        if before is not None:
            if playback is not None:
                playback.end_lasting(now_ns)
            elif self._flight == NOBODY:
                self._take_wire(now_ns)
                self._play([], [])
        if level is None:
            return
        playback = self._playback
        lasting = Disturbance(0, _EFFECTS[level], None)
        if playback is not None:
            playback.strike(replace(lasting, first=playback.bit_at(now_ns)))
        elif self._flight and self._joinable_ns <= now_ns:
            self._decided = self._starts
            self._play_from_start(replace(lasting, first=self._bit_at(now_ns)), now_ns)
        elif not self._flight and level is WireLevel.DOMINANT:
            self._take_wire(max(now_ns, self._free_ns))
            self._play([], [lasting])

    def _take_wire(self, now_ns: int) -> None:
        """Occupy the wire without a node's frame: no node can join."""
        self._begin(NOBODY, now_ns)
        self._joinable_ns = now_ns
        self._decided = self._starts

    def freeze(self, now_ns: int) -> None:
        """Keep the fate of an undisturbed frame in flight although rules change."""
        if self._flight and self._joinable_ns <= now_ns and not self._repeat_ns:
            self._decided = self._starts

    def _play_from_start(self, strike: Disturbance | None, now_ns: int) -> Playback:
        """Begin an episode for the frame in flight, which was undisturbed so far."""
        number = self._flight >> PORT_SHIFT & PORT_MASK
        rivals = self._rivals(number)
        senders = [number, *(rival.tag >> PORT_SHIFT for rival in rivals)]
        return self._play(senders, [] if strike is None else [strike], self._bit_at(now_ns))

    def _bit_at(self, now_ns: int) -> int:
        return (now_ns - self._start_ns + self.bit_ns - 1) // self.bit_ns

    def set_noises(self, noises: list[NoiseSource], now_ns: int) -> None:
        """Set the noise sources; new ones act from the next frame, removed ones end now."""
        self.resume(now_ns)
        self._noises = noises
        if self._playback is not None:
            self._playback.spare(noises, now_ns)

    def go_on_babbling(self, now_ns: int) -> None:
        """Let babbling nodes begin if the wire is free."""
        self._babble()
        if not self._flight and self._competing:
            self._arbitrate(max(now_ns, self._free_ns))


def misreadings(frame: bytes, sender: Presence, members: list[Presence]) -> list[Disturbance]:
    """Return the first misread bit of a classical frame, for each node with a large clock error."""
    levels = bytes(wire_frame(frame).expected)
    fast = ONE + sender.chip.clock_error_1e12
    found: list[Disturbance] = []
    for node in members:
        own = ONE + node.chip.clock_error_1e12
        drift = (fast - own) * ONE // own
        if node is sender or not node.hears() or abs(drift) <= node.chip.timing.tolerance_1e12():
            continue
        bit = first_misread(levels, drift, node.chip.timing)
        if bit is not None:
            found.append(Disturbance(bit, Effect.FLIP, 1, 1 << node.number))
    return found
