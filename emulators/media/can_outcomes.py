"""Results of the frame in flight: completion, or an episode.

A lone error passive node repeats its frame for ever without any change. This costs nothing here.
"""

from collections.abc import Sequence
from heapq import heappush
from typing import Final

from emulators.media.can_bits import CLASSICAL_MAX, KEY_SHIFT, bits_of, measure
from emulators.media.can_episode import Disturbance, Event, EventKind, Outcome
from emulators.media.can_frame import can_id_of
from emulators.media.can_members import CanMembers
from emulators.media.can_port import CUT_OFF, LENGTHS_MASK, PORT_MASK, PORT_SHIFT
from emulators.media.can_presence import NEVER_NS, Presence, Role
from emulators.media.can_station import SUSPEND_BITS
from emulators.media.delivery import LOST, NOTED, TOLD, Delivery
from emulators.media.error_message import BUS_OFF
from emulators.media.fault_rule import WireLevel
from emulators.media.fault_seam import ERROR_FRAME_BITS, FaultSeam
from emulators.media.playback import Playback

NOBODY: Final = (1 << 62) - 1  # in flight while no node's frame occupies the wire
_TAIL_BITS: Final = 8  # ACK delimiter and end of frame: recessive, before the intermission


class CanOutcomes(CanMembers):
    """One wire, and the results of the frames on it. The arguments are those of `CanMembers`."""

    __slots__ = (
        "_accepted",
        "_accepted_frame",
        "_attempt",
        "_decided",
        "_playback",
        "_repeat_ns",
        "_repeat_until_ns",
        "_senders",
        "_sent",
        "_sent_bit",
    )

    def __init__(
        self, name: str, bit_ns: int, data_bit_ns: int, seam: FaultSeam, nodes: list[Presence]
    ) -> None:
        super().__init__(name, bit_ns, data_bit_ns, seam, nodes)
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
            if can_id_of(event.frame) & BUS_OFF:
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


def bits_in(entry: int) -> int:
    """Return the number of bits of a frame at either rate, intermission included."""
    lengths = entry & LENGTHS_MASK
    return bits_of(lengths) if lengths > CLASSICAL_MAX else lengths
