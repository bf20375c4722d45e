"""A serial line (RS-485, half duplex) to the bit time. Sans-I/O.

The line has no arbitration: a port that submits begins to send at once. Simultaneous characters are
garbled for listeners (a 0 from any sender prevails), and a sender hears nothing meanwhile. A
character takes start bit, 8 data bits, parity bit if any, and stop bits. Receivers of Modbus RTU
separate frames by silence: t3.5 ends a frame, and a pause longer than t1.5 within a frame spoils
it. Above 19,200 bit/s both are fixed, 1.750 ms and 750 us. Other protocols delimit their packets
themselves: without `silences`, a line delivers characters only.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, sections 2.5.1.1 and
3.3; TIA-485 for the half duplex pair.
"""

from typing import Final, final

from motorhil.emulators.media.serial_faults import Fate, SerialFaultPlan

# (kind, characters, port that sent them, when their first bit was on the line [ns])
LineDelivery = tuple[int, bytes, int, int]
CHARACTERS: Final = 0
"""Characters that all but the sender have heard, complete now; hosts read them as they arrive."""
FRAME: Final = 1
"""A frame: t3.5 has passed after the last of the characters since the silence before."""
SPOILED: Final = 2
"""A frame with a pause or a collision in it."""
SENT: Final = 3
"""The end of the sender's last character, where silence begins."""

_FAST_BIT_S: Final = 19_200
_T15_NS: Final = 750_000
_T35_NS: Final = 1_750_000
_NS: Final = 1_000_000_000


@final
class _Burst:
    """The characters that one port sends without a pause."""

    __slots__ = ("data", "end_ns", "hears", "port", "start_ns")

    def __init__(self, port: int, start_ns: int, end_ns: int, data: bytes, hears: bool) -> None:
        self.port = port
        self.start_ns = start_ns
        self.end_ns = end_ns
        self.data = data
        self.hears = hears  # False: the burst is lost, but keeps the line busy


@final
class SerialLine:
    """One pair of wires with all its ports.

    Args:
        name: the name used in records.
        baud: bit rate [bit/s].
        parity: "E", "O" or "N".
        stop_bits: 1 or 2.
        faults: the faults to inject; None: no faults.
        silences: whether silences delimit frames.

    Attributes:
        has_silences: as given.
        bits: of a character, start and stop bits included.
        t15_ns, t35_ns: the two silences; 0 without silences.
        characters, frames, spoiled, collisions: counted since the beginning.
        busy_ns: the total time in which any port was sending.

    Raises:
        ValueError: invalid line settings.
    """

    def __init__(
        self,
        name: str,
        baud: int = 19_200,
        parity: str = "E",
        stop_bits: int = 1,
        faults: SerialFaultPlan | None = None,
        silences: bool = True,
    ) -> None:
        if (
            not 300 <= baud <= 10_000_000
            or parity not in ("E", "O", "N")
            or stop_bits not in (1, 2)
        ):
            raise ValueError(
                f"serial line {name}: {baud} bit/s, parity {parity!r}, {stop_bits} stop bits: "
                "invalid; expected 300 to 10000000 bit/s, parity E, O or N, 1 or 2 stop bits"
            )
        self.name: Final = name
        self.baud: Final = baud
        self.bits: Final = 9 + (parity != "N") + stop_bits
        self.has_silences: Final = silences
        t15_ns, t35_ns = 3 * self.bits * _NS // (2 * baud), 7 * self.bits * _NS // (2 * baud)
        if baud > _FAST_BIT_S:
            t15_ns, t35_ns = _T15_NS, _T35_NS
        self.t15_ns: Final = t15_ns if silences else 0
        self.t35_ns: Final = t35_ns if silences else 0
        self.characters: int = 0
        self.frames: int = 0
        self.spoiled: int = 0
        self.collisions: int = 0
        self.busy_ns: int = 0
        self._plan: Final = faults
        self._names: list[str] = []
        self._free_ns: list[int] = []  # when each port has sent all it was given
        self._bursts: list[_Burst] = []  # on the line now, or soon (after a pause)
        self._frame = bytearray()  # heard since the last silence
        self._frame_port = 0
        self._frame_start_ns = 0
        self._is_spoiled = False
        self._quiet_ns = 0  # when the last character ended
        self._due_ns: int | None = None

    # ---- ports ----

    def attach(self, name: str) -> int:
        """Add a port of this name and return its number."""
        self._names.append(name)
        self._free_ns.append(0)
        return len(self._names) - 1

    def duration_ns(self, characters: int) -> int:
        """Return how long so many characters take without a pause [ns]."""
        return characters * self.bits * _NS // self.baud

    def silent_since_ns(self) -> int:
        """Return the end of the last character that was heard [ns]."""
        return self._quiet_ns

    def submit(self, port: int, data: bytes, now_ns: int) -> None:
        """Send these characters from this port, now or after what it is still sending."""
        start_ns = max(now_ns, self._free_ns[port])
        if self._plan is None:
            if data:
                self._put(port, data, start_ns, True)
        else:
            for fate in self._plan.fates(data, self._names[port], now_ns):
                self._send_as(port, fate, start_ns)
        self._settle()

    def _send_as(self, port: int, fate: Fate, start_ns: int) -> None:
        data, later_ns, pause_after, pause_ns, is_heard = fate
        if later_ns:  # characters sent meanwhile do not wait for it
            free_ns = self._free_ns[port]
            self._put(port, data, start_ns + later_ns, is_heard)
            self._free_ns[port] = free_ns
        elif pause_ns and 0 < pause_after < len(data):
            end_ns = self._put(port, data[:pause_after], start_ns, is_heard)
            self._put(port, data[pause_after:], end_ns + pause_ns, is_heard)
        elif data:
            self._put(port, data, start_ns, is_heard)

    def _put(self, port: int, data: bytes, start_ns: int, hears: bool) -> int:
        """Put a burst on the line and return its end [ns]."""
        end_ns = start_ns + self.duration_ns(len(data))
        self._bursts.append(_Burst(port, start_ns, end_ns, data, hears))
        self._free_ns[port] = end_ns
        self.characters += len(data)
        self.busy_ns += end_ns - start_ns
        return end_ns

    def hand_over(self, port: int, name: str) -> bool:
        """Give a port that is no longer used another name; return False while it is heard."""
        if self.pending(port) or (self._frame and self._frame_port == port):
            return False
        self._names[port] = name
        return True

    def pending(self, port: int) -> int:
        """Return the number of characters of this port that are not yet on the line whole."""
        return sum(len(burst.data) for burst in self._bursts if burst.port == port)

    # ---- time ----

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called [ns], or None if the line is silent."""
        return self._due_ns

    def expire(self, now_ns: int) -> list[LineDelivery]:
        """Return the deliveries complete by `now_ns`, in order."""
        out: list[LineDelivery] = []
        while self._due_ns is not None and self._due_ns <= now_ns:
            due_ns = self._due_ns
            if self._frame and due_ns == self._quiet_ns + self.t35_ns:
                self._end_frame(out)
            else:
                self._end_cluster(due_ns, out)
            self._settle()
        return out

    def _settle(self) -> None:
        """Compute the next completion: of a burst without interference, or of a frame."""
        cluster_end_ns = self._cluster()[1]
        due_ns = cluster_end_ns
        if self._frame:
            frame_ns = self._quiet_ns + self.t35_ns
            first_ns = min((burst.start_ns for burst in self._heard()), default=None)
            ends_before = first_ns is None or first_ns >= frame_ns
            if ends_before and (due_ns is None or frame_ns <= due_ns):
                due_ns = frame_ns
        self._due_ns = due_ns

    def _heard(self) -> list[_Burst]:
        return [burst for burst in self._bursts if burst.hears]

    def _cluster(self) -> tuple[list[_Burst], int | None]:
        """Return the first burst with all that overlap it, and when the last of them ends."""
        if not self._bursts:
            return [], None
        ordered = sorted(self._bursts, key=_start_of)
        cluster, end_ns = [ordered[0]], ordered[0].end_ns
        for burst in ordered[1:]:
            if burst.start_ns >= end_ns:
                break
            cluster.append(burst)
            end_ns = max(end_ns, burst.end_ns)
        return cluster, end_ns

    def _end_cluster(self, now_ns: int, out: list[LineDelivery]) -> None:
        cluster, _ = self._cluster()
        for burst in cluster:
            self._bursts.remove(burst)
        heard = [burst for burst in cluster if burst.hears]
        senders = list(dict.fromkeys(burst.port for burst in cluster))
        if heard:
            first = heard[0]
            collides = len({burst.port for burst in heard}) > 1
            data = self._garbled(heard) if len(heard) > 1 else first.data
            self._hear(first, data, max(burst.end_ns for burst in heard), collides)
            out.append((CHARACTERS, data, -1 if collides else first.port, first.start_ns))
        for port in senders:
            if self._free_ns[port] <= now_ns:
                out.append((SENT, b"", port, now_ns))

    def _hear(self, first: _Burst, data: bytes, end_ns: int, collides: bool) -> None:
        if not self._frame:
            self._frame_start_ns = first.start_ns
            self._frame_port = first.port
            self._is_spoiled = False
        elif first.start_ns - self._quiet_ns > self.t15_ns:
            self._is_spoiled = True
        if collides:
            self.collisions += 1
            self._is_spoiled = True
        if self.has_silences:
            self._frame += data
        self._quiet_ns = end_ns

    def _garbled(self, bursts: list[_Burst]) -> bytes:
        """Return the characters that a listener reads from overlapping bursts: a 0 prevails."""
        char, start_ns = self.bits * _NS, bursts[0].start_ns
        slots: list[int] = []
        for burst in bursts:
            at = (2 * (burst.start_ns - start_ns) * self.baud + char) // (2 * char)
            slots.extend([0xFF] * (at + len(burst.data) - len(slots)))
            for place, value in enumerate(burst.data, at):
                slots[place] &= value
        return bytes(slots)

    def _end_frame(self, out: list[LineDelivery]) -> None:
        kind = SPOILED if self._is_spoiled else FRAME
        self.frames += 1
        self.spoiled += self._is_spoiled
        out.append((kind, bytes(self._frame), self._frame_port, self._frame_start_ns))
        self._frame.clear()


def _start_of(burst: _Burst) -> int:
    return burst.start_ns
