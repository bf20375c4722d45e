"""CAN arbitration on one wire: pending frames compete by their arbitration field.

Modelled from ISO 11898-1: every frame takes its exact length (`can_bits`). Nodes with a pending
frame compete when the bus becomes free. Each frame is followed by 3 bits of intermission. A frame
that is submitted during the intermission, or within the first bit time of another node's start of
frame, still takes part. This needs no timer: `submit` repeats the arbitration.

Traffic statistics of a CAN bus.
"""

from heapq import heapify, heappop, heappush
from typing import final

from motorhil.emulators.can.bus.port import PORT_MASK, PORT_SHIFT, CanPort
from motorhil.emulators.can.controller_config import ONE, FrameSupport
from motorhil.emulators.can.frame import EFF_MASK, FRAME_BYTES, can_id_of
from motorhil.emulators.can.frame_length import (
    CLASSICAL_MAX,
    INTERMISSION_BITS,
    KEY_SHIFT,
    LENGTHS_MASK,
    can_id_of_key,
    measure,
    phases_of,
)
from motorhil.emulators.media.load import BusyTime


@final
class CanStatistics:
    """The counts and load of one bus. Only the bus writes it; a frame counts when it is complete.

    Grows by at most 16 bytes per frame (`BusyTime`) and an entry per different identifier.

    Attributes (read only): frames and bits (incl. stuff bits and intermission) of frames sent;
    busy, the time occupied by these, by failed frames and by intermissions; errors, the number of
    error detections by nodes; bits_lost, the bits of failed frames and error frames.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.bits = 0
        self.busy = BusyTime()
        self.errors = 0
        self.bits_lost = 0
        self.by_key: dict[int, int] = {}  # frames sent, by arbitration key
        self._collisions: dict[int, int] = {}

    def count(self, key: int, bits: int) -> None:
        """Count a sent frame."""
        self.frames += 1
        self.bits += bits
        counts = self.by_key
        counts[key] = counts.get(key, 0) + 1

    def count_collision(self, key: int) -> None:
        """Count a sent frame that had competed with another node's frame of the same key."""
        self._collisions[key] = self._collisions.get(key, 0) + 1

    def absorb(self, other: "CanStatistics") -> None:
        """Move the counts of another bus part here; its busy time is not moved."""
        self.frames += other.frames
        self.bits += other.bits
        self.errors += other.errors
        self.bits_lost += other.bits_lost
        other.give(self.by_key, self._collisions)
        other.frames = other.bits = other.errors = other.bits_lost = 0

    def give(self, counts: dict[int, int], collisions: dict[int, int]) -> None:
        """Move the counts by key into these dictionaries."""
        for own, others in ((self.by_key, counts), (self._collisions, collisions)):
            for key, count in own.items():
                others[key] = others.get(key, 0) + count
            own.clear()

    def busy_ns(self) -> int:
        """Return the total busy time [ns]."""
        return self.busy.busy_ns()

    def load(self, from_ns: int, until_ns: int) -> float:
        """Return the busy part of a window, 0.0 to 1.0.

        Raises:
            ValueError: the window is empty.
        """
        return self.busy.load(from_ns, until_ns)

    def peak_load(self, window_ns: int) -> float:
        """Return the highest load of any window of this length so far, 0.0 to 1.0.

        Raises:
            ValueError: window_ns is not above 0.
        """
        return self.busy.peak_load(window_ns)

    def counts(self) -> dict[int, int]:
        """Return the frames sent by can_id (identifier and flags), most urgent first."""
        return {can_id_of_key(key): count for key, count in sorted(self.by_key.items())}

    def collisions(self) -> dict[int, int]:
        """Return how often two nodes competed with one identifier and frame type, by can_id."""
        return {can_id_of_key(key): count for key, count in sorted(self._collisions.items())}


class CanArbitration:
    """The pending frames of all ports and the frame in flight. `CanBus` derives from it.

    Attributes (read only): name, bit_ns [ns], statistics; data_bit_ns, the duration of a bit at the
    data rate [ns], 0 on a classical bus.
    """

    __slots__ = (
        "_busy",
        "_collided",
        "_competing",
        "_end_ns",
        "_faulty",
        "_flight",
        "_free_ns",
        "_intermission_ns",
        "_is_skewed",
        "_joinable_ns",
        "_plain_max",
        "_ports",
        "_start_ns",
        "_starts",
        "bit_ns",
        "data_bit_ns",
        "name",
        "statistics",
    )

    def __init__(self, name: str, bit_ns: int, data_bit_ns: int = 0) -> None:
        self.name = name
        self.bit_ns = bit_ns
        self.data_bit_ns = data_bit_ns
        self.statistics = CanStatistics()
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

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Submit a frame (can_frame or canfd_frame) for transmission by this port.

        Raises:
            ValueError: a node cannot send this frame (see `can_bits.measure`); or it is a CAN FD
                frame and the bus or the node is classical.
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

    def _submit_held(self, node: CanPort, entry: int, frame: bytes, now_ns: int) -> bool:
        """Return whether faults keep the frame from the normal queue; overridden there."""
        return False

    def _leave_race(self, node: CanPort) -> None:
        """Withdraw the node's candidate, which is not in flight, and count its losses."""
        self._drop_out(node.entry)
        node.losses += self._starts - node.starts_seen

    def _drop_out(self, entry: int) -> None:
        """Remove this entry from the arbitration."""
        self._competing.remove(entry)
        heapify(self._competing)
