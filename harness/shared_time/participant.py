"""Participant: a program of another process, on the rig's side of its connection."""

import socket
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.emulators.can.frame import FD_FRAME_BYTES, FRAME_BYTES, as_driven
from motorhil.emulators.simulation.ownership_notice import unpack_owns
from motorhil.harness.python_can.send_limit import SendLimit
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.records import (
    LengthError,
    PortFlags,
    RecordError,
    Result,
    WaitFlags,
)
from motorhil.harness.virtual_time.runtime import END_NS, VirtualParty, VirtualRuntime, Waiter
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.emulators.simulation.endpoints import HostPort
    from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
    from motorhil.emulators.simulation.serial_network import LineHost
    from motorhil.emulators.simulation.world import World
    from motorhil.motorapi.runtime.api import Registration

_FRAME_SIZES: Final = (FRAME_BYTES, FD_FRAME_BYTES)
_PORTS_MAX: Final = 256  # open at one time
_PORT_NUMBERS: Final = 1 << 16
_PERIODS_MAX: Final = 4096
_PARTIES_MAX: Final = 1024
# Plain integers, since the arithmetic of flags is slow.
_PARTIES: Final = int(WaitFlags.PARTIES)
_PROCESSES: Final = int(WaitFlags.PROCESSES)
_DEAF: Final = int(WaitFlags.DEAF)
_QUIET: Final = int(PortFlags.QUIET)
_OTHERS: Final = int(PortFlags.OTHERS)
_TAKEN: Final = bytes([records.TAKEN])
_PENDING_MAX: Final = 16_384  # bytes of frames that a quiet program has not been told


class Seat(Protocol):
    """The rig of a participant, as far as it needs that."""

    turns: int
    """How many turns programs have had."""

    @property
    def world(self) -> "World":
        """The rig's buses."""

    @property
    def runtime(self) -> VirtualRuntime:
        """The rig's time."""

    def receive(self, participant: "Participant", is_first: bool) -> bytes:
        """Return the program's next message, the first of its turn; b"" if it has gone."""

    def repeatable(self, bus: str, notice: "OwnershipNotice", name: str) -> "OwnershipNotice":
        """Return the notice of a program without what differs in each run."""

    def admit(self, parent: "Participant", pid: int, name: str) -> str:
        """Wait until a child process has joined; return "", or why it has not."""

    def end_turn(self) -> None:
        """Take what programs have printed, before another one prints."""

    def look_for_deaths(self) -> None:
        """Note the programs that have died while they waited."""

    def departed(self, participant: "Participant", reason: str) -> None:
        """Close the connection of a program that has gone; `reason` is "" if it left by itself."""


@final
class Participant:
    """A program that has joined.

    Attributes:
        name: its name in the rig.
        connection: its socket.
        is_gone: True once it has left, or its connection is broken.
    """

    def __init__(self, name: str, connection: socket.socket, seat: Seat) -> None:
        self.name: Final[str] = name
        self.connection: Final[socket.socket] = connection
        self.is_gone: bool = False
        self._seat: Final[Seat] = seat
        self._has_turn = False
        self._is_served = False  # it acts, and would not look at a call
        self._has_taken = False
        self._is_urgent = False
        self._ready = records.NO_WAIT
        self._next_port = 0
        self._checked = 0
        self._parties: Final[dict[int, VirtualParty]] = {}
        self._waits: Final[dict[int, Waiter]] = {}
        self._ports: Final[dict[int, tuple[str, HostPort | LineHost]]] = {}
        self._limits: Final[dict[int, SendLimit]] = {}
        self._periods: Final[dict[int, Registration]] = {}
        self._flags: Final[dict[int, int]] = {}
        self._unread: Final[deque[bytes]] = deque()
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._takers: Final[dict[int, Callable[[bytes], None]]] = {
            records.OPEN: self._open,
            records.CLOSE: self._close_port,
            records.SEND: self._submit,
            records.NOTICE: self._note,
            records.EVERY: self._every,
            records.CANCEL: self._cancel,
            records.PARTY: self._name_party,
            records.WAIT: self._wait,
            records.WITHDRAW: self._withdraw,
            records.CHILD: self._admit,
            records.PORT: self._note_use,
        }

    def begin(self) -> None:
        """Let the program tell its first wait, which is for its first turn."""
        self._serve()

    # ---- the rig calls the program -----------------------------------------------------------

    def _take_turn(self, waiter: Waiter) -> None:
        """Give the program the turn for this wait; return when all its parties wait again."""
        number = next((key for key, one in self._waits.items() if one is waiter), None)
        if number is None or self.is_gone:
            return
        del self._waits[number]
        self._has_turn = self._is_served = True
        if self._has_taken:
            self._has_taken = False
        else:
            self._grant(number, waiter)
        self._serve()
        self._has_turn = self._is_served = False
        self._seat.turns += 1
        self._seat.look_for_deaths()
        if self._is_urgent:
            self._deliver()

    def _grant(self, number: int, waiter: Waiter) -> None:
        result = Result.HOLDS if waiter.result else Result.EXPIRED
        reason = ""
        if isinstance(waiter.error, KeyboardInterrupt):
            result = Result.INTERRUPTED
        elif waiter.error is not None:
            result, reason = Result.REFUSED, str(waiter.error)
        now_ns = self._seat.runtime.now_ns()
        turn = records.TURN.pack(records.GRANT, number, now_ns, result)
        self._send_pending(turn + reason.encode())

    def _call(self, record: bytes) -> None:
        """Send a record and serve the program until it has answered."""
        if self.is_gone:
            return
        self._pending.append(record)
        if self._is_served:  # time stands still; the program hears of it after its turn
            self._is_urgent = True
        else:
            self._deliver()

    def _deliver(self) -> None:
        """Send what is pending, and serve the program until it has answered."""
        self._is_urgent = self._is_served = True
        while self._is_urgent and not self.is_gone:
            self._is_urgent = False
            self._send_pending()
            self._serve()
        self._is_served = False

    def _hear(self, kind: int, port: int, frame: bytes, time_ns: int, transmitted: bool) -> None:
        flags = self._flags[port]
        if transmitted and flags & _OTHERS:
            return
        record = records.DELIVERY.pack(kind, port, time_ns, transmitted) + frame
        if not flags & _QUIET or self._pending_bytes > _PENDING_MAX:
            self._call(record)
        elif not self.is_gone:
            self._pending.append(record)
            self._pending_bytes += len(record)

    def _expire(self, number: int) -> None:
        now_ns = self._seat.runtime.now_ns()
        self._call(records.PERIOD.pack(records.EXPIRED, number, now_ns))

    def _holds(self, number: int, asks: bool, is_deaf: bool) -> bool:
        """Return whether the condition of a wait holds; ask again after turns of others."""
        if self.is_gone:
            return True  # its turn does nothing
        if asks and self._checked != self._seat.turns:
            self._checked = self._seat.turns
            self._call(records.CALL.pack(records.CHECK, self._seat.runtime.now_ns()))
        if self._pending and not is_deaf and self._ready != number:
            return self._takes_turn(number)
        return self._ready == number

    def _takes_turn(self, number: int) -> bool:
        """Tell the program what is pending; return whether it has taken the turn for this wait."""
        self._is_served = True
        now_ns = self._seat.runtime.now_ns()
        self._send_pending(records.PERIOD.pack(records.TRY, number, now_ns))
        answer = self._next_record(is_first=True)
        self._has_taken = answer[:1] == _TAKEN
        if not self._has_taken:
            if answer:
                self._unread.appendleft(answer)
            self._serve()
        self._is_served = False
        if self._is_urgent and not self._has_taken:
            self._deliver()
        return self._has_taken or self.is_gone or self._ready == number

    # ---- the program calls the rig -----------------------------------------------------------

    def _serve(self) -> None:
        """Take records of the program until it is idle, or has gone."""
        is_first = True
        while not self.is_gone:
            record = self._next_record(is_first)
            is_first = False
            if not record:
                return
            kind = record[0]
            try:
                if kind == records.IDLE:
                    _, self._ready = records.COUNTED.unpack(record)
                    if self._unread:
                        raise RecordError("more records after IDLE")
                    if not self._waits:
                        self._depart("it gave the turn back and waits for nothing")
                    self._seat.end_turn()
                    return
                if kind == records.LEAVE:
                    self._depart("")
                    return
                self._takers[kind](record)
            except (KeyError, ValueError, RecordError, LengthError, UsageError) as error:
                self._depart(f"its record {record[:24].hex()} is wrong: {error!r}")
                return

    def _next_record(self, is_first: bool) -> bytes:
        """Return the next record; b"" if the program has gone."""
        if not self._unread:
            message = self._seat.receive(self, is_first)
            if not message:
                self.died()
                return b""
            if message[0] != records.BATCH:
                return message
            try:
                self._unread.extend(records.split(message))
            except RecordError as error:
                self._depart(f"its record {message[:24].hex()} is wrong: {error!r}")
                return b""
        return self._unread.popleft()

    def _send_pending(self, *last: bytes) -> None:
        """Send as one message what is pending, and after it these records."""
        several, self._pending = [*self._pending, *last], []
        self._pending_bytes = 0
        self._send(records.batch(several))

    def _send(self, record: bytes) -> None:
        try:
            self.connection.send(record)
        except OSError:
            self.died()

    def _open(self, record: bytes) -> None:
        _, fd = records.NUMBERED.unpack_from(record)
        bus = records.text_of(record, records.NUMBERED.size)
        world = self._seat.world
        is_known = bus in world.bus_names() or bus in world.line_names()
        if not is_known or len(self._ports) == _PORTS_MAX:
            raise RecordError(f"bus {bus!r} cannot be opened; {len(self._ports)} ports are open")
        number = self._free_port()
        hear, told = (partial(self._hear, kind, number) for kind in (records.HEARD, records.TOLD))
        self._flags[number] = 0
        if bus in world.line_names():
            connection = world.add_line_host(bus, "host", hear)
            self._limits[number] = SendLimit(connection, bus, "characters")
            self._opened(number, bus, connection)
            return

        def hear_classical(frame: bytes, time_ns: int, transmitted: bool) -> None:
            if len(frame) == FRAME_BYTES:
                hear(frame, time_ns, transmitted)

        port = world.add_host(bus, "host", hear if fd else hear_classical, told)
        self._limits[number] = SendLimit(port, bus)
        self._opened(number, bus, port)

    def _free_port(self) -> int:
        """Return the number for a port; that of a closed one comes last."""
        while self._next_port in self._ports:
            self._next_port = (self._next_port + 1) % _PORT_NUMBERS
        number = self._next_port
        self._next_port = (number + 1) % _PORT_NUMBERS
        return number

    def _opened(self, number: int, bus: str, port: "HostPort | LineHost") -> None:
        self._ports[number] = bus, port
        self._send(records.numbered(records.OPENED, number, port.name))

    def _port(self, record: bytes) -> "tuple[str, HostPort | LineHost]":
        _, number = records.NUMBERED.unpack_from(record)
        return self._ports[number]

    def _close_port(self, record: bytes) -> None:
        _, number = records.NUMBERED.unpack_from(record)
        self._ports.pop(number)[1].close()
        del self._limits[number]

    def _note_use(self, record: bytes) -> None:
        _, number, flags = records.PORT_FLAGS.unpack(record)
        if number not in self._ports:
            raise RecordError(f"port {number}: not open")
        self._flags[number] = flags

    def _submit(self, record: bytes) -> None:
        _, number = records.NUMBERED.unpack_from(record)
        bus, port = self._ports[number]
        data = record[records.NUMBERED.size :]
        if bus not in self._seat.world.line_names():
            if len(data) not in _FRAME_SIZES:
                raise RecordError(f"frame of {len(data)} bytes")
            data = as_driven(data)
        port.send(data)
        self._limits[number].count()

    def _note(self, record: bytes) -> None:
        bus, port = self._port(record)
        notice = unpack_owns(record[records.NUMBERED.size :])
        if notice is None:
            raise RecordError("notice")
        self._seat.world.tell_ownership(
            bus, port.name, self._seat.repeatable(bus, notice, self.name)
        )

    def _every(self, record: bytes) -> None:
        _, number, period_ns = records.PERIOD.unpack(record)
        if len(self._periods) == _PERIODS_MAX or number in self._periods:
            raise RecordError(f"period {number}: used, or beyond {_PERIODS_MAX} periods")
        expire = partial(self._expire, number)
        self._periods[number] = self._seat.runtime.every(period_ns / 1e9, expire)

    def _cancel(self, record: bytes) -> None:
        _, number = records.COUNTED.unpack(record)
        self._periods.pop(number).cancel()

    def _name_party(self, record: bytes) -> None:
        _, number = records.NUMBERED.unpack_from(record)
        if number >= _PARTIES_MAX:
            raise RecordError(f"party {number}: expected 0 to {_PARTIES_MAX - 1}")
        own = records.text_of(record, records.NUMBERED.size)
        party = VirtualParty(f"{self.name}/{own}" if number else self.name, self._seat.runtime)
        party.is_first = number == 0
        party.take_turn = self._take_turn
        self._parties[number] = party

    def _wait(self, record: bytes) -> None:
        _, number, party, flags, deadline_ns = records.WAITING.unpack(record)
        if number in self._waits or len(self._waits) == _PARTIES_MAX or deadline_ns > END_NS:
            raise RecordError(f"wait {number}: used, beyond {_PARTIES_MAX} waits, or too long")
        asks, is_deaf = bool(flags & _PROCESSES), bool(flags & _DEAF)
        done = partial(self._holds, number, asks, is_deaf)
        on_parties = bool(flags & _PARTIES)
        runtime = self._seat.runtime
        self._waits[number] = runtime.wait_elsewhere(
            self._parties[party], done, deadline_ns, on_parties
        )

    def _withdraw(self, record: bytes) -> None:
        _, number = records.COUNTED.unpack(record)
        self._seat.runtime.withdraw(self._waits.pop(number))

    def _admit(self, record: bytes) -> None:
        _, pid = records.COUNTED.unpack_from(record)
        name = records.text_of(record, records.COUNTED.size)
        if not self._has_turn or not name.startswith(f"{self.name}/"):
            raise RecordError(f"child {name!r}")
        self._send(bytes([records.ADMITTED]) + self._seat.admit(self, pid, name).encode())

    # ---- its end -----------------------------------------------------------------------------

    def died(self) -> None:
        """End its part, since its connection has ended."""
        self._depart("its connection has ended")

    def _depart(self, reason: str) -> None:
        """End its part: no call, no turn, no period; frames that are queued are still sent."""
        if self.is_gone:
            return
        self.is_gone = True
        self._seat.turns += 1
        for period in self._periods.values():
            period.cancel()
        for _, port in self._ports.values():
            port.close()
        self._seat.departed(self, reason)
