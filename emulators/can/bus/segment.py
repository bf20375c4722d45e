"""One wire of a CAN bus: nodes, arbitration, fate of frames.

Arbitration (ISO 11898-1): every frame takes its exact length (`frame_length`). Nodes with a pending
frame compete when the bus becomes free. Each frame is followed by 3 bits of intermission. A frame
that is submitted during the intermission, or within the first bit time of another node's start of
frame, still takes part. This needs no timer: `submit` repeats the arbitration.

Faults: the fate of a frame is decided one bit after its start, the last moment at which another
node could have joined it. An undisturbed frame completes at its end, and counters go down.
Otherwise the time until all nodes agree again is an episode (`bitlevel.episode`). The episode is
played bit by bit (`Playback`), and computed again if something happens meanwhile. Nodes that may
not send keep their frames: the entry of their port is CUT_OFF.

A lone error passive node repeats its frame for ever without any change. This costs nothing here.

The class is long because all of it decides about one frame in flight.
"""

from collections.abc import Sequence
from dataclasses import replace
from heapq import heapify, heappop, heappush
from typing import Final

from motorhil.emulators.can.bitlevel.controller import SUSPEND_BITS
from motorhil.emulators.can.bitlevel.encoder import wire_frame
from motorhil.emulators.can.bitlevel.episode import (
    ALL_PORTS,
    Disturbance,
    Effect,
    Event,
    EventKind,
    Outcome,
)
from motorhil.emulators.can.bus.fault_plan import ERROR_FRAME_BITS, FaultSeam, struck
from motorhil.emulators.can.bus.playback import Playback
from motorhil.emulators.can.bus.port import (
    CUT_OFF,
    LOST,
    NEVER_NS,
    NOTED,
    PORT_MASK,
    PORT_SHIFT,
    TOLD,
    CanPort,
    Delivery,
    Presence,
    Role,
)
from motorhil.emulators.can.bus.statistics import CanStatistics
from motorhil.emulators.can.controller_config import ONE, CanNode, FrameSupport, first_misread
from motorhil.emulators.can.error_confinement import ACK_SLOT, MESSAGE_BUS_OFF
from motorhil.emulators.can.fault_rules import NoiseSource, WireLevel
from motorhil.emulators.can.frame import EFF_MASK, FRAME_BYTES, can_id_of
from motorhil.emulators.can.frame_length import (
    CLASSICAL_MAX,
    INTERMISSION_BITS,
    KEY_SHIFT,
    LENGTHS_MASK,
    bits_of,
    measure,
    phases_of,
)

NOBODY: Final = (1 << 62) - 1  # in flight while no node's frame occupies the wire
_TAIL_BITS: Final = 8  # ACK delimiter and end of frame: recessive, before the intermission
_LONGEST_BITS: Final = 1024  # more bits than any frame, including one that may still join
_EFFECTS: Final = {WireLevel.DOMINANT: Effect.DOMINANT, WireLevel.RECESSIVE: Effect.RECESSIVE}


class CanSegment:
    """One wire and the nodes on it: a whole bus, or a part that is split off.

    Args:
        name: the name of the bus.
        bit_ns: the duration of a bit [ns].
        data_bit_ns: the duration of a bit at the data rate [ns]; 0: the bus is classical.
        seam: the faults of the bus.
        nodes: the nodes of the whole bus, by number.

    Attributes (read only): name, bit_ns, data_bit_ns, statistics; members, the nodes on this wire,
    by number.
    """

    __slots__ = (
        "_accepted",
        "_accepted_frame",
        "_attempt",
        "_busy",
        "_collided",
        "_competing",
        "_decided",
        "_end_ns",
        "_faulty",
        "_flight",
        "_free_ns",
        "_hearing",
        "_hearing_fd",
        "_held",
        "_intermission_ns",
        "_is_alone",
        "_is_apart",
        "_is_mixed",
        "_is_mixed_told",
        "_is_skewed",
        "_joinable_ns",
        "_level",
        "_nodes",
        "_noises",
        "_now_ns",
        "_plain_max",
        "_playback",
        "_ports",
        "_repeat_ns",
        "_repeat_until_ns",
        "_seam",
        "_senders",
        "_sent",
        "_sent_bit",
        "_start_ns",
        "_starts",
        "_unwell",
        "_watchful",
        "bit_ns",
        "data_bit_ns",
        "members",
        "name",
        "statistics",
    )

    def __init__(
        self, name: str, bit_ns: int, data_bit_ns: int, seam: FaultSeam, nodes: list[Presence]
    ) -> None:
        self.name: str = name
        self.bit_ns: int = bit_ns
        self.data_bit_ns: int = data_bit_ns
        self.statistics: CanStatistics = CanStatistics()
        self._busy = self.statistics.busy
        self._ports: list[CanPort] = []
        self._competing: list[int] = []  # heap of the entries of candidates not in flight
        self._flight = 0  # entry in flight; 0: idle
        self._start_ns = 0
        self._joinable_ns = 0  # other nodes may join until then (exclusive)
        self._end_ns = 0  # end of EOF of the frame in flight
        self._free_ns = 0  # end of the last intermission
        self._intermission_ns = INTERMISSION_BITS * bit_ns
        self._starts = 0  # number of arbitrations so far
        self._collided = False  # the frame in flight has beaten one with the same key
        self._is_skewed = False  # a node's clock has an error
        self._plain_max = CLASSICAL_MAX  # the duration of longer frames comes from `_duration_ns`
        self._faulty = False  # a fault is active or possible
        self._seam = seam
        self._nodes = nodes
        self.members: list[Presence] = []
        self._held: list[Presence] = []  # members that may not send now
        self._hearing = 0  # mask of the members that hear and acknowledge
        self._hearing_fd = 0  # those of them that receive CAN FD frames
        self._watchful = False  # faults other than noise can strike a frame
        self._unwell = False  # a member has an error counter above 0
        self._is_mixed = False  # a member that hears destroys CAN FD frames
        self._is_mixed_told = False  # these members have been reported
        self._is_apart = False  # the clocks of two members differ by more than both tolerate
        self._noises: list[NoiseSource] = []
        self._level: WireLevel | None = None  # level at which the wire is stuck
        self._now_ns = 0  # time of the current step
        self._is_alone = False  # the missing acknowledgement has been reported
        self._decided = -1  # number of the arbitration whose frame's fate is decided
        self._playback: Playback | None = None
        self._senders: list[int] = []  # ports whose frames take part in the playback
        self._sent: list[int] = []  # those of them whose frames were sent
        self._sent_bit = -1  # bit in which the last of these was sent
        self._accepted = 0  # mask of the receivers of the last sent frame, until it is delivered
        self._accepted_frame = b""
        self._attempt = (0, 0, 0, 0, 0)  # of a lone node: entry, TEC, REC, bits, ns to the next
        self._repeat_ns = 0  # period of these attempts; 0: none
        self._repeat_until_ns = NEVER_NS

    # --- arbitration

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Submit a frame (can_frame or canfd_frame) for transmission by this port.

        Raises:
            ValueError: a node cannot send this frame (see `measure`); or it is a CAN FD frame and
                the bus or the node is classical.
        """
        node = self._ports[port]
        entry = measure(frame) | node.tag
        if len(frame) > FRAME_BYTES:
            self._require_fd(node, frame)
        if node.entry:
            self._submit_behind(node, entry, frame, now_ns)
            return
        node.entry = entry
        node.frame = frame
        if self._flight:
            self._compete(node, now_ns)
        else:
            self._starts += 1
            self._collided = False
            self._begin(entry, now_ns if now_ns > self._free_ns else self._free_ns)

    def pending(self, port: int) -> int:
        """Return the number of submitted frames of this port that are not yet sent completely."""
        return self._ports[port].pending()

    def withdraw(self, port: int) -> int:
        """Discard this port's pending frames, except one in flight, and return their number."""
        node = self._ports[port]
        count = len(node.behind)
        node.behind.clear()
        if node.entry > 0 and node.entry != self._flight:
            self._leave_race(node)
            node.entry = 0
            count += 1
        return count

    def arbitration_losses(self, port: int) -> int:
        """Return how often a frame of this port competed and had to wait for another node's."""
        node = self._ports[port]
        if node.entry > 0 and node.entry != self._flight:
            return node.losses + self._starts - node.starts_seen
        return node.losses

    def port_names(self) -> list[str]:
        """Return the names of the ports, by number."""
        return [port.name for port in self._ports]

    def _begin(self, entry: int, start_ns: int) -> None:
        """Start the frame that has won so far at `start_ns`."""
        bit_ns = self.bit_ns
        self._flight = entry
        self._start_ns = start_ns
        self._joinable_ns = start_ns + bit_ns
        lengths = entry & LENGTHS_MASK
        if lengths <= self._plain_max:
            self._end_ns = start_ns + lengths * bit_ns - self._intermission_ns
        else:
            self._end_ns = start_ns + self._duration_ns(entry)

    def _duration_ns(self, entry: int) -> int:
        """Return the frame's duration without intermission, by its sender's clock [ns]."""
        lengths, number = entry & LENGTHS_MASK, entry >> PORT_SHIFT & PORT_MASK
        whole_ns = self._fd_ns(lengths) if lengths > CLASSICAL_MAX else lengths * self.bit_ns
        duration_ns = whole_ns - self._intermission_ns
        if not self._is_skewed or number >= len(self._ports):  # or no node's frame
            return duration_ns
        return duration_ns * ONE // (ONE + self._ports[number].chip.clock_error_1e12)

    def _skew(self) -> None:
        """Compute frame durations from the sender's clock from now on."""
        self._is_skewed = True
        self._plain_max = 0

    def _fd_ns(self, lengths: int) -> int:
        """Return the duration of a CAN FD frame, intermission included [ns]."""
        bits, data_bits = phases_of(lengths)
        return bits * self.bit_ns + data_bits * self.data_bit_ns

    def _require_fd(self, node: CanPort, frame: bytes) -> None:
        """Check that the node may send this CAN FD frame on this bus."""
        number = f"CAN FD frame {can_id_of(frame) & EFF_MASK:X}h"
        if not self.data_bit_ns:
            raise ValueError(
                f"{number}: bus {self.name} is classical CAN; give it a data bit rate "
                "(data_bitrate_bit_s)"
            )
        if node.chip.frames is not FrameSupport.FD:
            raise ValueError(
                f"{number}: {node.name} on bus {self.name} has a classical CAN controller (frames "
                f'= "{node.chip.frames.value}"); an FD one sends it'
            )

    def _arbitrate(self, start_ns: int) -> None:
        """Start the best competing frame; leave the bus idle if there is none."""
        competing = self._competing
        if not competing:
            self._flight = 0
            return
        entry = heappop(competing)
        node = self._ports[entry >> PORT_SHIFT & PORT_MASK]
        node.losses += self._starts - node.starts_seen
        self._starts += 1
        self._collided = False
        if competing and competing[0] >> KEY_SHIFT == entry >> KEY_SHIFT:
            self._collide()
        self._begin(entry, start_ns)

    def _compete(self, node: CanPort, now_ns: int) -> None:
        """Add a candidate to the current arbitration if it can still join, else to the next."""
        if now_ns < self._joinable_ns:
            node.starts_seen = self._starts - 1
            self._join(node)
        else:
            node.starts_seen = self._starts
            heappush(self._competing, node.entry)

    def _join(self, node: CanPort) -> None:
        """Let a candidate join the arbitration that another node's frame has won so far."""
        entry = node.entry
        flight = self._flight
        if entry >> KEY_SHIFT == flight >> KEY_SHIFT:
            self._collide()
        elif entry < flight:
            self._collided = False
        if entry > flight:
            heappush(self._competing, entry)
            return
        before = self._starts - 1
        node.losses += before - node.starts_seen
        self._ports[flight >> PORT_SHIFT & PORT_MASK].starts_seen = before
        heappush(self._competing, flight)
        self._begin(entry, self._start_ns)

    def _collide(self) -> None:
        """Record that two nodes send frames of one identifier and type at once."""
        self._collided = True
        self._faulty = True

    def _succeed(self, node: CanPort, entry: int, bits: int) -> None:
        """Count a sent frame of this many bits and let the node's next frame compete."""
        key = entry >> KEY_SHIFT
        statistics = self.statistics  # inlined `count`; the call would cost 4 % of the frame
        statistics.frames += 1
        statistics.bits += bits
        counts = statistics.by_key
        counts[key] = counts.get(key, 0) + 1
        if self._collided:
            statistics.count_collision(key)
        free_ns = self._free_ns = self._end_ns + self._intermission_ns
        self._busy.add(self._start_ns, free_ns)
        if not node.behind:
            node.entry = 0
        elif node.promote():
            node.starts_seen = self._starts
            heappush(self._competing, node.entry)

    def _occupy(self, more_bits: int) -> None:
        """Keep the bus busy for the frame in flight and `more_bits` nominal bits."""
        self._free_ns = self._end_ns + self._intermission_ns + more_bits * self.bit_ns
        self._busy.add(self._start_ns, self._free_ns)

    def _submit_behind(self, node: CanPort, entry: int, frame: bytes, now_ns: int) -> None:
        """Queue a frame of a node that has a candidate; it may replace the candidate."""
        if self._faulty and self._submit_held(node, entry, frame, now_ns):
            return
        flying = node.entry == self._flight
        if (
            not node.by_priority
            or entry >> KEY_SHIFT >= node.entry >> KEY_SHIFT
            or (flying and now_ns >= self._joinable_ns)
        ):
            node.queue(entry, frame)
            return
        old = node.entry
        node.put_back()
        node.entry = entry
        node.frame = frame
        if flying:
            self._collided = False
            self._begin(entry, self._start_ns)
            return
        self._drop_out(old)
        if now_ns < self._joinable_ns:
            self._join(node)
        else:
            heappush(self._competing, entry)

    def _leave_race(self, node: CanPort) -> None:
        """Withdraw the node's candidate, which is not in flight, and count its losses."""
        self._drop_out(node.entry)
        node.losses += self._starts - node.starts_seen

    def _drop_out(self, entry: int) -> None:
        """Remove this entry from the arbitration."""
        self._competing.remove(entry)
        heapify(self._competing)

    # --- nodes on this wire

    def add_port(self, port: CanPort) -> None:
        """Add a port of the bus; its node is not on this wire yet."""
        self._ports.append(port)

    def take_port(self, number: int, other: "CanSegment") -> None:
        """Take over the frames that wait at this port on the other wire."""
        self._ports[number].adopt(other.port(number))

    def port(self, number: int) -> CanPort:
        """Return the transmit side of this node on this wire."""
        return self._ports[number]

    def _add(self, node: Presence) -> None:
        """Add a node to this wire."""
        if node.chip.clock_error_1e12:
            self._skew()
        self.members.append(node)
        self.members.sort(key=_number_of)
        self._keep(node)
        before = self._is_apart
        self.count_members()
        if self._is_apart and not before:
            told = "its clock and another node's are too far apart: not all frames can be read"
            self._seam.plan.note(self._now_ns, node.name, told, b"")

    def _remove(self, node: Presence) -> None:
        """Remove a node from this wire, with its frame in flight."""
        port = self._ports[node.number]
        if port.entry > 0:
            if port.entry != self._flight:
                self._leave_race(port)
            self._put_back(port)
        port.entry = CUT_OFF
        self.members.remove(node)
        self.count_members()

    def _keep(self, node: Presence) -> None:
        """Let the node compete with its frames, or not, according to its role."""
        port = self._ports[node.number]
        if node.role is Role.ON:
            if port.entry == CUT_OFF and port.promote():
                port.starts_seen = self._starts
                heappush(self._competing, port.entry)
        elif port.entry != CUT_OFF:
            if port.entry > 0:
                self._leave_race(port)
                self._put_back(port)
            port.entry = CUT_OFF
        if node.role is Role.OFF:
            self._abort_all(node)

    def count_members(self) -> None:
        """Recompute the flags and masks that depend on the members."""
        members = self.members
        self._held = [node for node in members if node.role is not Role.ON]
        hearing = 0
        unwell = False
        fd = 0
        mixed = False
        for node in members:
            if node.hears():
                hearing |= 1 << node.number
                mixed = mixed or node.chip.frames is FrameSupport.CLASSICAL
                if node.chip.frames is FrameSupport.FD:
                    fd |= 1 << node.number
            unwell = unwell or not node.is_well()
        self._is_mixed = mixed and self.data_bit_ns != 0
        self._is_apart = self._is_skewed and clocks_are_apart([node.chip for node in members])
        self._hearing = hearing
        self._hearing_fd = fd
        self._unwell = unwell
        self._watchful = (
            hearing & (hearing - 1) == 0
            or bool(self._held)
            or self._is_apart
            or self._is_mixed
            or (self.data_bit_ns != 0 and fd & (fd - 1) == 0)
            or (self.data_bit_ns != 0 and any(node.confinement.is_passive() for node in members))
            or self._level is not None
            or self._seam.plan.has_errors()
            or any(node.chip.one_shot for node in members)
        )
        self._is_alone = self._is_alone and hearing & (hearing - 1) == 0

    def tell_mixed(self) -> None:
        """Report, once, the nodes that destroy the CAN FD frame being sent."""
        if self._is_mixed_told:
            return
        self._is_mixed_told = True
        for node in self.members:
            if node.hears() and node.chip.frames is FrameSupport.CLASSICAL:
                told = "destroys CAN FD frames: its CAN controller is classical"
                self._seam.plan.note(self._now_ns, node.name, told, b"")

    def _ears_for(self, frame: bytes) -> int:
        """Return the mask of the members that hear and acknowledge this frame."""
        return self._hearing_fd if len(frame) > FRAME_BYTES else self._hearing

    def _put_back(self, port: CanPort) -> None:
        """Put the candidate back into the queue; discard a babbled frame."""
        if port.babbling:
            port.babbling = False
            port.entry = 0
        else:
            port.put_back()

    def _abort_all(self, node: Presence) -> None:
        """Give up the frames of a bus-off node; they would be stale after recovery."""
        port = self._ports[node.number]
        for _, _, _, frame in sorted(port.behind):
            self._abort(node, frame, "bus-off")
        port.behind.clear()

    def _abort(self, node: Presence, frame: bytes, why: str) -> None:
        """Give up the frame and record it."""
        node.aborted += 1
        self._seam.plan.note(self._now_ns, node.name, f"not sent: {why}", frame)

    # --- undisturbed frames

    def _complete(self, merged: Sequence[int], out: list[Delivery]) -> None:
        """Complete the frame in flight; `merged` are ports that sent the very same frame."""
        entry = self._flight
        number = entry >> PORT_SHIFT & PORT_MASK
        port = self._ports[number]
        end_ns = self._end_ns
        for source in self._noises:
            source.pass_by(bits_in(entry))
        ears = self._ears_for(port.frame) & ~(1 << number)
        for other in merged:
            ears &= ~(1 << other)
        if self._must_repeat(number, ears, out):
            self._occupy(ERROR_FRAME_BITS)
            self._withdraw_candidate(number, again=True)
        else:
            self._count_good(number, merged, ears, out)
            for other in merged:
                out.append((port.frame, other, LOST))
                self._withdraw_candidate(other, again=False)
            port.babbling = False
            self._succeed(port, entry, bits_in(entry))
        for node in self._held:
            node.recessive_from(end_ns - _TAIL_BITS * self.bit_ns, 0)
        sender = self._nodes[number]
        if sender.confinement.is_passive():
            sender.suspend(self._free_ns + SUSPEND_BITS * self.bit_ns)
            self._keep(sender)
            self.count_members()
        self._go_on(self._free_ns)

    def _must_repeat(self, number: int, ears: int, out: list[Delivery]) -> bool:
        """Deliver the frame as the rules allow and return whether its sender sends it again."""
        port = self._ports[number]
        seam = self._seam
        if port.frame in port.repeated:
            port.repeated.remove(port.frame)
            seam.deliver(port.frame, number, ears, port.babbling, out)
            return False
        if seam.complete(port.frame, number, self._end_ns, ears, port.babbling, out):
            port.repeated.add(port.frame)
            return True
        return False

    def _count_good(
        self, number: int, merged: Sequence[int], ears: int, out: list[Delivery]
    ) -> None:
        """Decrement the counters after a successful frame (ISO 11898-1, rules g and h)."""
        if not self._unwell:
            return
        for node in self.members:
            if node.number == number or node.number in merged:
                node.confinement.sent()
            elif ears >> node.number & 1:
                node.confinement.received()
            else:
                continue
            message = node.change()
            if message:
                out.append((message, node.number, TOLD))
        self.count_members()

    def _withdraw_candidate(self, number: int, again: bool) -> None:
        """Withdraw the port's candidate: it is sent, or with `again` will be sent again."""
        port = self._ports[number]
        if port.entry <= 0:
            return
        if port.entry != self._flight:
            self._leave_race(port)
        if again:
            self._put_back(port)
        port.babbling = False
        port.entry = CUT_OFF
        self._keep(self._nodes[number])

    def _go_on(self, free_ns: int) -> None:
        """Free the wire at `free_ns` and arbitrate the next frame."""
        self._free_ns = free_ns
        self._babble()
        self._arbitrate(free_ns)

    def _babble(self) -> None:
        """Queue the frames of babbling nodes."""
        for number, frame in self._seam.babbles():
            node = self._nodes[number]
            port = self._ports[number]
            if node not in self.members or node.role is not Role.ON or port.babbling:
                continue
            if port.entry > 0:
                if port.entry == self._flight and self._flight:
                    continue
                self._leave_race(port)
                port.put_back()
            port.babbling = True
            port.entry = measure(frame) | port.tag
            port.frame = frame
            port.starts_seen = self._starts
            heappush(self._competing, port.entry)

    # --- disturbed frames

    def _play(self, senders: list[int], strikes: list[Disturbance], past: int = 0) -> Playback:
        """Begin an episode with the frames of these ports, at the start of frame.

        The first `past` bits are over: noise that has begun since strikes none of them.
        """
        self._senders = senders
        self._sent = []
        self._sent_bit = -1
        stations = [
            node.station((self._ports[node.number].frame,) if node.number in senders else ())
            for node in self.members
            if node.role is not Role.OFF
        ]
        rates_ns = (self.bit_ns, self.data_bit_ns or self.bit_ns)
        noises = [source for source in self._noises if source.left >= past]
        playback = Playback(self._start_ns, rates_ns, stations, strikes, noises)
        self._playback = playback
        return playback

    def _happen(self, event: Event, now_ns: int, out: list[Delivery]) -> None:
        """Apply an event of an episode at the end of its bit."""
        node = self._nodes[event.port]
        kind = event.kind
        if kind is EventKind.ACCEPTED:
            self._accepted |= 1 << event.port
            self._accepted_frame = event.frame
        elif kind is EventKind.SENT:
            self._sent.append(event.port)
            self._deliver_sent(event, now_ns, out)
        elif kind is EventKind.FAILED:
            self._deliver_in_vain(event.port, out)
        elif kind is EventKind.ERROR:
            node.errors += 1
            self.statistics.errors += 1
            out.append((event.frame, event.port, TOLD if node.chip.error_reporting else NOTED))
        elif kind is EventKind.STATE:
            out.append((event.frame, event.port, TOLD))
            if can_id_of(event.frame) & MESSAGE_BUS_OFF:
                self._seam.plan.note(now_ns, node.name, "bus-off", b"")

    def _deliver_sent(self, event: Event, now_ns: int, out: list[Delivery]) -> None:
        port = self._ports[event.port]
        ears = self._accepted & ~(1 << event.port)
        if event.bit == self._sent_bit:  # another node has sent the very same bits
            out.append((event.frame, event.port, LOST))
            return
        self._sent_bit = event.bit
        self._accepted = 0
        silent = port.babbling
        frame = event.frame
        if ears and self._accepted_frame != frame:  # it shows that its sender is error passive
            self._seam.complete(self._accepted_frame, event.port, now_ns, ears, True, out)
            if not silent:
                out.append((frame, event.port, LOST))
        elif self._seam.complete(frame, event.port, now_ns, ears, silent, out) and not silent:
            out.append((frame, event.port, LOST))

    def _deliver_in_vain(self, sender: int, out: list[Delivery]) -> None:
        """Deliver the frame to the nodes that accepted it; its sender will send it again."""
        if self._accepted:
            self._seam.hear(self._accepted_frame, sender, self._accepted, out)
        self._accepted = 0

    def _finish(self, playback: Playback, out: list[Delivery]) -> None:
        """Finish an episode: all nodes agree again."""
        over_ns = playback.over_ns
        end = playback.end
        if self._accepted:
            self._deliver_in_vain(self._senders[0] if self._senders else 0, out)
        self._note_noise(playback)
        self.statistics.busy.add(self._start_ns, over_ns)
        self.statistics.bits_lost += end.bits
        for node in self._held:
            if node.role is Role.OFF:
                node.recessive_from(over_ns - end.recessive_bits * self.bit_ns, end.recessive_runs)
        for outcome in end.outcomes:
            node = self._nodes[outcome.port]
            if node in self.members:
                node.end(outcome, over_ns, playback.off_ns(outcome), self.bit_ns)
        self._playback = None
        self._remember_attempt(playback)
        self._settle_senders(end.outcomes)
        for node in self.members:
            self._keep(node)
        self.count_members()
        self._free_ns = over_ns
        if self._level is WireLevel.DOMINANT:
            self._flight = NOBODY
            self._decided = self._starts
        else:
            self._go_on(over_ns)

    def _settle_senders(self, outcomes: Sequence[Outcome]) -> None:
        """Settle the frames that took part: sent, to be sent again, or given up."""
        kept = {outcome.port: outcome.frames for outcome in outcomes}
        for number in self._senders:
            port = self._ports[number]
            entry = port.entry
            if entry <= 0 or self._nodes[number] not in self.members:
                continue
            if number in self._sent:
                self.statistics.count(entry >> KEY_SHIFT, bits_in(entry))
                self.statistics.bits_lost -= bits_in(entry)
            elif not kept.get(number, (port.frame,)):
                self._abort(self._nodes[number], port.frame, "one-shot")
            again = number not in self._sent and bool(kept.get(number, (port.frame,)))
            self._withdraw_candidate(number, again)

    def _note_noise(self, playback: Playback) -> None:
        """Record the bits that noise has inverted and advance the noise sources."""
        frame = self._ports[self._senders[0]].frame if self._senders else b""
        for time_ns, bit, rule in playback.inverted():
            self._seam.plan.inverted(time_ns, rule, f"bit {bit}", frame)
        playback.pass_noise_by()

    # --- missing acknowledgement

    def _remember_attempt(self, playback: Playback) -> None:
        """Remember the failed attempt of a lone node, to predict the next one."""
        self._attempt = (0, 0, 0, 0, 0)
        outcomes = playback.end.outcomes
        if len(outcomes) != 1 or len(self._senders) != 1 or self._sent:
            return
        before, after = playback.stations[0], outcomes[0]
        node = self._nodes[after.port]
        if node not in self.members:
            return
        port = self._ports[after.port]
        if not self._is_alone:
            self._is_alone = True
            self._seam.plan.note(playback.over_ns, node.name, "nobody acknowledges", port.frame)
        if (before.tec, before.rec, None) == (after.tec, after.rec, after.off_at):
            bits = playback.end.bits
            period_ns = playback.over_ns - playback.start_ns + after.suspended * self.bit_ns
            self._attempt = (port.entry, after.tec, after.rec, bits, period_ns)

    def _repeats(self, number: int) -> bool:
        """Return whether this attempt repeats the one before; if so, start the fast repetition."""
        counters = self._nodes[number].confinement
        entry, tec, rec, bits, period_ns = self._attempt
        if (entry, tec, rec) != (self._flight, counters.tec, counters.rec):
            return False
        if self._level is not None or self._seam.plan.has_errors():
            return False
        if any(node.since_ns != NEVER_NS for node in self._held):
            return False
        self._repeat_until_ns = NEVER_NS
        self._repeat_ns = period_ns
        if self._noises:
            count = min(source.left // bits for source in self._noises)
            if not count:
                self._repeat_ns = 0
                return False
            self._repeat_until_ns = self._start_ns + count * self._repeat_ns
        return True

    def resume(self, now_ns: int) -> None:
        """End the fast repetition of a lone node before a change; one attempt is then under way."""
        if not self._repeat_ns:
            return
        count = (now_ns - self._start_ns) // self._repeat_ns
        bits = self._attempt[3]
        if count > 0:
            self.statistics.bits_lost += count * bits
            start_ns = self._start_ns + count * self._repeat_ns
            self.statistics.busy.add(self._start_ns, start_ns)
            for source in self._noises:
                source.pass_by(count * bits)
            self._begin(self._flight, start_ns)
        self._repeat_ns = 0
        self._attempt = (0, 0, 0, 0, 0)
        self._decided = -1

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
        """Return whether faults keep the frame from the normal queue; it is then dealt with."""
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


def bits_in(entry: int) -> int:
    """Return the number of bits of a frame at either rate, intermission included."""
    lengths = entry & LENGTHS_MASK
    return bits_of(lengths) if lengths > CLASSICAL_MAX else lengths


def clocks_are_apart(chips: list[CanNode]) -> bool:
    """Return whether two of these may misread each other's frames because of their clocks."""
    if not chips:
        return False
    errors = [chip.clock_error_1e12 for chip in chips]
    slowest = min(errors)
    drift = (max(errors) - slowest) * ONE // (ONE + slowest)
    return drift > min(chip.timing.tolerance_1e12() for chip in chips)


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


def _number_of(node: Presence) -> int:
    return node.number
