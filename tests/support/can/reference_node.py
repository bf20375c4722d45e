"""An independent CAN controller written directly from the standard, as a coroutine.

`can_station` and its parts are compared with it. The coroutine yields the level to send in the next
bit, and receives the level sampled there. Its position in the code is its position in the protocol.
Errors are exceptions. The emulator shares no code with it.

The node works at one bit rate; `wired_and` handles two rates.
Source: ISO 11898-1:2015; where it leaves something open, the conformance tests of ISO 16845-1 (the
clause is named), and then the emulator's docstrings.
"""

from collections.abc import Generator
from dataclasses import dataclass

from tests.support.can import fd_frame_bits as wire_fd
from tests.support.can import frame_bits as wire

D, R = 0, 1  # dominant, recessive
Levels = Generator[int, int, None]
Heard = Generator[int, int, str]


@dataclass(frozen=True)
class Sent:
    """A frame to send: its bits, and the end of its arbitration."""

    fields: wire.Fields | wire_fd.FdFields

    def can_frame(self) -> bytes:
        return self.fields.can_frame()

    def is_fd(self) -> bool:
        return isinstance(self.fields, wire_fd.FdFields)

    def bits(self, passive: bool) -> str:
        fields = self.fields
        if isinstance(fields, wire.Fields):
            return wire.on_the_wire(fields)
        esi = fields.esi or passive
        said = wire_fd.FdFields(fields.identifier, fields.extended, fields.brs, esi, fields.data)
        return wire_fd.on_the_wire(said)

    def arbitration(self) -> str:
        """Return start of frame to RTR (in CAN FD: RRS), before stuffing."""
        fields = self.fields
        if fields.extended:
            word = f"{fields.identifier:029b}"
            head = "0" + word[:11] + "11" + word[11:]
        else:
            head = "0" + f"{fields.identifier:011b}"
        return head + ("1" if isinstance(fields, wire.Fields) and fields.remote else "0")


class FaultError(Exception):
    """An error was detected in the bit just sampled."""

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        self.kind = kind


class BusOffError(Exception):
    """TEC has passed 255."""


class LostArbitrationError(Exception):
    def __init__(self, heard: str) -> None:
        super().__init__(heard)
        self.heard = heard


class ReferenceNode:
    """A node with TEC, REC, and its events: (bit, what), in order."""

    def __init__(self, queue: list[Sent], tec: int, rec: int, support: str, once: bool) -> None:
        self.queue = queue
        self.tec = tec
        self.rec = rec
        self.support = support  # "classical", "tolerant" or "fd"
        self.once = once
        self.sender = False
        self.bit = -1
        self.told: list[tuple[int, str]] = []
        self.off_at = -1

    # --- counters

    def is_passive(self) -> bool:
        return self.tec > 127 or self.rec > 127

    def more(self, sender: int, receiver: int) -> None:
        if self.sender:
            self.tec += sender
        else:
            self.rec = min(255, self.rec + receiver)
        if self.tec > 255:
            raise BusOffError

    def note(self, what: str) -> None:
        self.told.append((self.bit, what))

    # --- main loop

    def live(self, integrating: int, suspended: int) -> Levels:
        try:
            if integrating:
                yield from self.integrate(integrating)
            while True:
                suspended = yield from self.one_frame(suspended)
        except BusOffError:
            self.off_at = self.bit
        while True:
            yield R

    def integrate(self, wanted: int) -> Levels:
        quiet = 0
        while quiet < wanted:
            level = yield R
            quiet, wanted = (quiet + 1, wanted) if level == R else (0, 11)

    def one_frame(self, suspended: int) -> Generator[int, int, int]:
        """Process one frame, from idle to idle; return the suspend time [bits]."""
        first = yield from self.wait_idle(suspended)
        while True:
            end = yield from self.frame_and_what_follows(first)
            if end == "exception":
                yield from self.integrate(11)
                return 0
            wait = 8 if self.sender and self.is_passive() else 0
            if end == "idle":
                return wait
            first = "join" if self.queue and not wait else "hear"

    def wait_idle(self, suspended: int) -> Heard:
        while suspended or not self.queue:
            level = yield R
            if level == D:
                return "hear"
            suspended -= suspended > 0
        return "send"

    def frame_and_what_follows(self, first: str) -> Heard:
        try:
            if first == "hear":
                yield from self.receive("0")
            else:
                yield from self.transmit(1 if first == "join" else 0)
        except LostArbitrationError as lost:
            try:
                yield from self.receive(lost.heard)
            except FaultError as fault:
                return (yield from self.after_fault(fault.kind))
        except FaultError as fault:
            return (yield from self.after_fault(fault.kind))
        return (yield from self.interframe("intermission"))

    def after_fault(self, kind: str) -> Heard:
        if kind == "exception":
            return "exception"
        if kind == "overload":
            self.note("error")
            return (yield from self.interframe("overload"))
        return (yield from self.interframe(kind))

    # --- sending

    def transmit(self, start: int) -> Levels:
        self.sender = True
        frame = self.queue[0]
        bits = frame.bits(self.is_passive())
        plain = wire.stuffed(frame.arbitration()[:-1] + "?").index("?")  # position of RTR
        ack = len(bits) - 9
        acknowledged = False
        number = start
        heard = bits[:start]
        while number < len(bits):
            sends = int(bits[number])
            level = yield sends
            heard += str(level)
            if number == ack and not acknowledged:
                if level == R:
                    if not frame.is_fd():
                        self.fail("ack")
                    # The CRC delimiter may have two bits (8.2.7); the error is in the second
                    # recessive bit (8.2.6).
                    if (yield R) == R:
                        self.fail("ack")
                    heard += "0"
                elif frame.is_fd():
                    acknowledged = True  # two ACK bits may overlap (8.2.7)
            elif level != sends:
                if number == ack + 1 and acknowledged:
                    acknowledged = False
                    continue
                if level == D and number <= plain:
                    if not is_stuff_bit(bits, number):
                        self.lose(heard)
                    self.fail("arbitration stuff")
                self.fail("bit")
            number += 1
        self.note("sent " + frame.can_frame().hex())
        self.queue.pop(0)
        self.tec -= self.tec > 0

    def drop(self, what: str) -> None:
        self.note(what)
        if self.once:
            self.queue.pop(0)

    def fail(self, kind: str) -> None:
        self.drop("failed")
        raise FaultError(kind)

    def lose(self, heard: str) -> None:
        self.drop("lost")
        raise LostArbitrationError(heard)

    # --- receiving

    def receive(self, heard: str) -> Levels:
        """Receive the rest of a frame whose beginning was already heard."""
        self.sender = False
        reader = Reader(heard)
        base = yield from reader.take(11)
        rtr = yield from reader.take(1)
        extended = (yield from reader.take(1)) == "1"
        if extended:
            base += yield from reader.take(18)
            rtr = yield from reader.take(1)
        fdf = yield from reader.take(1)
        if fdf == "1" and self.support == "tolerant":
            raise FaultError("exception")
        if fdf == "1" and self.support == "fd":
            yield from self.receive_fd(reader, int(base, 2), extended)
            return
        if extended:
            yield from reader.take(1)
        dlc = int((yield from reader.take(4)), 2)
        size = min(dlc, 8)
        data = yield from reader.take(0 if rtr == "1" else 8 * size)
        crc = yield from reader.take(15)
        yield from reader.last_stuff_bit()
        right = wire.with_crc(reader.plain[:-15])[-15:] == crc
        octets = bytes(int(data[i : i + 8], 2) for i in range(0, len(data), 8))
        fields = wire.Fields(int(base, 2), extended, rtr == "1", size, octets)
        yield from self.hear_tail(right, fields.can_frame(), False)

    def receive_fd(self, reader: "Reader", identifier: int, extended: bool) -> Levels:
        if (yield from reader.take(1)) == "1":
            raise FaultError("exception")
        brs = (yield from reader.take(1)) == "1"
        esi = (yield from reader.take(1)) == "1"
        size = wire_fd.LENGTHS[int((yield from reader.take(4)), 2)]
        data = yield from reader.take(8 * size)
        octets = bytes(int(data[i : i + 8], 2) for i in range(0, len(data), 8))
        fields = wire_fd.FdFields(identifier, extended, brs, esi, octets)
        heard = reader.raw
        stuff_bits = len(heard) - len(reader.plain)
        count = wire_fd.STUFF_COUNTS[stuff_bits % 8]
        generator, first = (
            (wire_fd.GENERATOR_17, 1 << 16) if size <= 16 else (wire_fd.GENERATOR_21, 1 << 20)
        )
        width = 17 if size <= 16 else 21
        wanted = count + f"{wire_fd.remainder(heard + count, generator, first):0{width}b}"
        last = heard[-1]
        said = ""
        while len(said) < len(wanted):
            fixed = str((yield R))
            if fixed == last:
                raise FaultError("form")
            last = fixed
            for _ in range(min(4, len(wanted) - len(said))):
                last = str((yield R))
                said += last
        yield from self.hear_tail(said == wanted, fields.can_frame(), True)

    def hear_tail(self, right: bool, frame: bytes, is_fd: bool) -> Levels:
        if (yield R) == D:
            raise FaultError("form")  # CRC delimiter
        level = yield D if right else R
        if right and level == R:
            raise FaultError("bit")
        if right:
            self.rec = 127 if self.rec > 127 else max(0, self.rec - 1)
        delimiter = yield R
        if is_fd and (delimiter == D or level == R):
            delimiter = yield R  # the second bit of the ACK slot came before (7.6.7, 7.6.10)
        if delimiter == D:
            raise FaultError("form")
        if not right:
            raise FaultError("crc")
        for _ in range(5):
            if (yield R) == D:
                raise FaultError("form")
        if (yield R) == D:
            raise FaultError("form")
        self.note("accepted " + frame.hex())
        if (yield R) == D:
            raise FaultError("overload")

    # --- between frames

    def interframe(self, cause: str) -> Heard:
        """Process flags, delimiters, intermission; return "idle", or "start" in its third bit."""
        while True:
            if cause != "intermission":
                yield from self.flags(cause)
                cause = yield from self.delimiter()
                if cause:
                    continue
            for number in range(3):
                level = yield R
                if level == D:
                    if number == 2:
                        return "start"
                    self.note("error")
                    break
            else:
                return "idle"
            cause = "overload"

    def flags(self, cause: str) -> Levels:
        """Process error flags or an overload flag, and the dominant bits after them."""
        overload = cause == "overload"
        passive = self.is_passive()
        doubtful = cause == "ack" and passive  # rule c, exception 1
        if not overload:
            self.note("error")
            if not doubtful and cause != "arbitration stuff":  # rule c, exception 2
                self.more(8, 1)
        while True:
            if overload or not passive:
                whole = yield from self.active_flag()
                if whole:
                    break
                passive = self.is_passive()
                self.note("error")
                self.more(8, 8)  # rules d and e
                overload = doubtful = False
            else:
                yield from self.passive_flag(doubtful)
                break
        dominant = 0
        while (yield R) == D:
            dominant += 1
            if dominant == 1 and not overload and not self.sender:
                self.more(0, 8)  # rule b
            if dominant % 8 == 0:
                full = not self.sender and self.rec == 255
                if not full:
                    self.note("error")
                    self.more(8, 8)  # rule f

    def active_flag(self) -> Generator[int, int, bool]:
        for _ in range(6):
            if (yield D) == R:
                return False
        return True

    def passive_flag(self, doubtful: bool) -> Levels:
        seen = ""
        while not (seen.endswith("000000") or seen.endswith("111111")):
            level = yield R
            seen += str(level)
            if level == D and doubtful:
                doubtful = False
                self.more(8, 0)

    def delimiter(self) -> Heard:
        """Process the delimiter after its first bit, and errors in it."""
        for number in range(2, 9):
            if (yield R) == D:
                if number == 8:
                    self.note("error")
                    return "overload"
                return "form"
        return ""


class Reader:
    """The bits of a frame without stuff bits; `plain` are those read, `raw` all heard."""

    def __init__(self, heard: str) -> None:
        self.raw = ""
        self.plain = ""
        self._pending = heard[1:]
        self._run = ""
        self._push("0")

    def _push(self, bit: str) -> None:
        self.raw += bit
        self._run = self._run + bit if self._run.endswith(bit) else bit

    def _next(self) -> Heard:
        if self._pending:
            bit, self._pending = self._pending[0], self._pending[1:]
        else:
            bit = str((yield R))
        if len(self._run) == 5:
            if bit == self._run[0]:
                raise FaultError("stuff")
            self.raw += bit
            self._run = bit
            return ""
        self._push(bit)
        return bit

    def take(self, count: int) -> Heard:
        taken = ""
        while len(taken) < count:
            taken += yield from self._next()
        self.plain += taken
        if len(self.plain) == len(taken):
            self.plain = "0" + self.plain
        return taken

    def last_stuff_bit(self) -> Levels:
        if len(self._run) == 5:
            yield from self._next()


def is_stuff_bit(bits: str, number: int) -> bool:
    """Return whether this bit follows five equal bits, none of them before a stuff bit."""
    run = 0
    last = ""
    for place in range(number + 1):
        if run == 5:
            if place == number:
                return True
            run, last = 1, bits[place]
        else:
            run = run + 1 if bits[place] == last else 1
            last = bits[place]
    return False
