"""A classical CAN bus with ports: who may send when, how long it takes, who hears it.

A core like a controller: told frames, told the time, asked for its next deadline. What it knows of
ISO 11898-1: every frame takes its exact length (`can_bits`); the nodes that have a frame pending
when the bus is free compete by their arbitration field; after a frame come 3 bits of intermission.
A frame submitted during the intermission, or within the first bit time of another node's start of
frame, still takes part; nothing is scheduled for that, `submit` decides again.

Two nodes that send one identifier and frame type break the rule of CAN that makes arbitration
work. On a real bus they destroy each other's frames. Here the lower port goes first, and
`collisions` counts it.

Left for later, and where: error frames, error counters and bus-off (in `expire`, where a frame is
complete; a sender nobody acknowledges succeeds here), CAN FD (`measure` tells frames apart by
their size; a second bit rate comes here).
"""

from enum import Enum
from heapq import heapify, heappop, heappush
from typing import Final, final

from emulators.media.can_bits import INTERMISSION_BITS, KEY_SHIFT, can_id_of_key, measure
from emulators.media.load import BusyTime

# What became of a frame: (frame, port that sent it, kind). A kind of 0 is all there is without
# faults. Otherwise its low two bits say what to do, and the bits above are the ports (1 << number)
# that do not hear this frame, see `hears`.
Delivery = tuple[bytes, int, int]
DELIVERED: Final = 0  # all others hear it, and the sender is told that it was sent
LOST: Final = 1  # the sender is told that it was sent; nobody hears it
HEARD: Final = 2  # all others hear it; the sender is told nothing (not its own doing, or not yet)
KIND_MASK: Final = 3
_KIND_BITS: Final = 2

# An entry in an arbitration: key << 24 | port << 8 | bits. The lowest wins.
_PORT_SHIFT: Final = 8
_PORT_MASK: Final = 0xFFFF
_BITS_MASK: Final = 0xFF


class QueueOrder(Enum):
    """Which of a node's pending frames competes for the bus."""

    FIFO = "fifo"  # the oldest: most drives, and Linux
    PRIORITY = "priority"  # the one whose identifier wins; the oldest of several alike


def hears(kind: int, port: int) -> bool:
    """Whether this port, not the sender's, hears a delivery of this kind."""
    return kind & KIND_MASK != LOST and not kind >> (_KIND_BITS + port) & 1


@final
class _Port:
    """One node's transmit side: a candidate, and the frames behind it."""

    def __init__(self, number: int, name: str, by_priority: bool) -> None:
        self.name = name
        self.tag = number << _PORT_SHIFT
        self.by_priority = by_priority
        self.entry = 0  # of the candidate, which competes or is in flight; 0: there is none
        self.frame = b""  # the candidate
        self.behind: list[tuple[int, int, int, bytes]] = []  # heap: (rank, turn, entry, frame)
        self.starts_seen = 0  # the bus's count of arbitrations before this candidate's first
        self.losses = 0


@final
class CanBus:
    """A classical CAN bus. Sans-I/O; times are int nanoseconds on one timeline that starts at 0.

    Whoever drives it calls `expire` with the time of each `next_deadline_ns` as it comes, and
    never submits at a time later than a deadline still due.

    Memory grows by at most 16 bytes per frame (`BusyTime`), by a dictionary entry per different
    identifier, and by what is submitted and not yet sent.

    Attributes (read only): name, bitrate_bit_s, bit_ns [ns]; frames and bits (incl. stuff bits and
    intermission) sent completely so far.
    """

    def __init__(self, name: str, bitrate_bit_s: int = 1_000_000) -> None:
        if bitrate_bit_s <= 0 or 1_000_000_000 % bitrate_bit_s:
            raise ValueError(
                f"bus {name}: a bit at {bitrate_bit_s} bit/s is no whole number of nanoseconds; "
                "1M, 800k, 500k, 250k, 125k, 100k, 50k, 20k and 10k are"
            )
        self.name = name
        self.bitrate_bit_s = bitrate_bit_s
        self.bit_ns = 1_000_000_000 // bitrate_bit_s
        self.frames = 0
        self.bits = 0
        self._ports: list[_Port] = []
        self._competing: list[int] = []  # heap of the entries of candidates not in flight
        self._flight = 0  # entry in flight; 0: idle
        self._start_ns = 0
        self._joinable_ns = 0  # until then (exclusive) others may still take part
        self._end_ns = 0  # end of EOF of the frame in flight
        self._free_ns = 0  # end of the last intermission
        self._turn = 0  # order of asking
        self._starts = 0  # arbitrations so far
        self._collided = False  # the frame in flight has won over one with its own key
        self._busy = BusyTime()
        self._counts: dict[int, int] = {}  # by key
        self._collisions: dict[int, int] = {}  # by key

    def attach(self, name: str, queue: QueueOrder = QueueOrder.FIFO) -> int:
        """A new node is on the bus; its port number, counted from 0.

        Raises:
            ValueError: the name is taken, or 65536 ports are attached.
        """
        number = len(self._ports)
        if number > _PORT_MASK:
            raise ValueError(f"bus {self.name}: no more than {_PORT_MASK + 1} ports")
        for port in self._ports:
            if port.name == name:
                raise ValueError(f"bus {self.name}: a port is called {name} already")
        self._ports.append(_Port(number, name, queue is QueueOrder.PRIORITY))
        return number

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """The frame (16-byte can_frame) waits for its turn at this port, or is on its way.

        Raises:
            ValueError: it is no classical frame that a node can send, see `can_bits.measure`.
        """
        node = self._ports[port]
        entry = measure(frame) | node.tag
        if node.entry:
            self._submit_behind(node, entry, frame, now_ns)
            return
        node.entry = entry
        node.frame = frame
        if not self._flight:
            self._starts += 1
            self._collided = False
            self._begin(entry, now_ns if now_ns > self._free_ns else self._free_ns)
        elif now_ns < self._joinable_ns:
            node.starts_seen = self._starts - 1
            self._join(node)
        else:
            node.starts_seen = self._starts
            heappush(self._competing, entry)

    def next_deadline_ns(self) -> int | None:
        """When the frame in flight is complete [ns]; None if the bus is idle."""
        return self._end_ns if self._flight else None

    def expire(self, now_ns: int) -> list[Delivery]:
        """What became complete up to `now_ns`, in order; the next arbitration is decided."""
        deliveries: list[Delivery] = []
        while self._flight and self._end_ns <= now_ns:
            entry = self._flight
            number = entry >> _PORT_SHIFT & _PORT_MASK
            node = self._ports[number]
            deliveries.append((node.frame, number, DELIVERED))
            self._account(entry)
            if node.behind:
                self._promote(node)
                node.starts_seen = self._starts
                heappush(self._competing, node.entry)
            else:
                node.entry = 0
            self._arbitrate()
        return deliveries

    def pending(self, port: int) -> int:
        """Frames of this port submitted and not yet sent completely."""
        node = self._ports[port]
        return len(node.behind) + (1 if node.entry else 0)

    def withdraw(self, port: int) -> int:
        """This port's pending frames are forgotten, except one in flight; how many they were."""
        node = self._ports[port]
        count = len(node.behind)
        node.behind.clear()
        if node.entry and node.entry != self._flight:
            self._drop_out(node.entry)
            node.losses += self._starts - node.starts_seen
            node.entry = 0
            count += 1
        return count

    def load(self, from_ns: int, until_ns: int) -> float:
        """The part of a window in which the bus was busy, intermissions included; 0.0 to 1.0.

        The frame in flight counts with its part in the window.

        Raises:
            ValueError: the window is empty.
        """
        load = self._busy.load(from_ns, until_ns)
        if self._flight:
            until_free_ns = self._end_ns + INTERMISSION_BITS * self.bit_ns
            overlap_ns = min(until_ns, until_free_ns) - max(from_ns, self._start_ns)
            if overlap_ns > 0:
                load += overlap_ns / (until_ns - from_ns)
        return load

    def peak_load(self, window_ns: int) -> float:
        """The highest load of any window of this length so far, without the frame in flight.

        Raises:
            ValueError: window_ns is not above 0.
        """
        return self._busy.peak_load(window_ns)

    def busy_ns(self) -> int:
        """How long complete frames and their intermissions took altogether [ns]."""
        return self._busy.busy_ns()

    def counts(self) -> dict[int, int]:
        """Frames sent completely, by can_id (identifier and flags), most urgent first."""
        return {can_id_of_key(key): count for key, count in sorted(self._counts.items())}

    def collisions(self) -> dict[int, int]:
        """Times two nodes competed with one identifier and frame type, by can_id."""
        return {can_id_of_key(key): count for key, count in sorted(self._collisions.items())}

    def arbitration_losses(self, port: int) -> int:
        """How often a frame of this port competed and had to wait for another node's."""
        node = self._ports[port]
        if node.entry and node.entry != self._flight:
            return node.losses + self._starts - node.starts_seen
        return node.losses

    def port_names(self) -> list[str]:
        """The names of the ports, by number."""
        return [port.name for port in self._ports]

    def _begin(self, entry: int, start_ns: int) -> None:
        """This entry has won (so far) and starts at `start_ns`."""
        bit_ns = self.bit_ns
        self._flight = entry
        self._start_ns = start_ns
        self._joinable_ns = start_ns + bit_ns
        self._end_ns = start_ns + ((entry & _BITS_MASK) - INTERMISSION_BITS) * bit_ns

    def _arbitrate(self) -> None:
        """The best of those competing starts when the bus is free; or it is idle."""
        competing = self._competing
        if not competing:
            self._flight = 0
            return
        entry = heappop(competing)
        node = self._ports[entry >> _PORT_SHIFT & _PORT_MASK]
        node.losses += self._starts - node.starts_seen
        self._starts += 1
        self._collided = bool(competing) and competing[0] >> KEY_SHIFT == entry >> KEY_SHIFT
        self._begin(entry, self._free_ns)

    def _join(self, node: _Port) -> None:
        """A candidate takes part in the arbitration that another node's frame has won so far."""
        entry = node.entry
        flight = self._flight
        if entry >> KEY_SHIFT == flight >> KEY_SHIFT:
            self._collided = True
        elif entry < flight:
            self._collided = False
        if entry > flight:
            heappush(self._competing, entry)
            return
        before = self._starts - 1
        node.losses += before - node.starts_seen
        self._ports[flight >> _PORT_SHIFT & _PORT_MASK].starts_seen = before
        heappush(self._competing, flight)
        self._begin(entry, self._start_ns)

    def _account(self, entry: int) -> None:
        """A frame is complete: statistics, and the intermission begins."""
        key = entry >> KEY_SHIFT
        bits = entry & _BITS_MASK
        self.frames += 1
        self.bits += bits
        self._counts[key] = self._counts.get(key, 0) + 1
        if self._collided:
            self._collisions[key] = self._collisions.get(key, 0) + 1
        self._free_ns = self._start_ns + bits * self.bit_ns
        self._busy.add(self._start_ns, self._free_ns)

    def _submit_behind(self, node: _Port, entry: int, frame: bytes, now_ns: int) -> None:
        """The node has a candidate already; the frame takes its place, or waits behind it."""
        self._turn += 1
        flying = node.entry == self._flight
        if (
            not node.by_priority
            or entry >> KEY_SHIFT >= node.entry >> KEY_SHIFT
            or (flying and now_ns >= self._joinable_ns)
        ):
            rank = entry >> KEY_SHIFT if node.by_priority else 0
            heappush(node.behind, (rank, self._turn, entry, frame))
            return
        # The old candidate is older than all behind it, hence a turn below theirs.
        old = node.entry
        heappush(node.behind, (old >> KEY_SHIFT, -self._turn, old, node.frame))
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

    def _drop_out(self, entry: int) -> None:
        """This entry competes no longer."""
        self._competing.remove(entry)
        heapify(self._competing)

    def _promote(self, node: _Port) -> None:
        """The best of the frames behind is the candidate."""
        _, _, node.entry, node.frame = heappop(node.behind)
