"""Runtime of a program whose rig is in another process, and shares its virtual time.

The program's parties take turns by the rules of `motorhil.harness.virtual_time.runtime`, together
with those of all other programs of the rig. All frames and periods of the rig are called here at
their time, so that a program cannot see a difference to a rig of its own process.
"""

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from typing import TYPE_CHECKING, Final, final

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.records import Result, WaitFlags
from motorhil.harness.virtual_time.runtime import VirtualParty, VirtualRuntime, Waiter, never
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import FrameListener, Registration

_PARTIES: Final = int(WaitFlags.PARTIES | WaitFlags.DEAF)
_PROCESSES: Final = int(WaitFlags.PROCESSES)
_DEAF: Final = int(WaitFlags.DEAF)
_HELD_MAX: Final = 16_384  # bytes of records that are held
_TAKEN: Final = bytes([records.TAKEN])
GONE: Final = "the rig has ended, and with it the time of this program"


@final
class RemoteLink:
    """The connection to the rig.

    Attributes:
        is_open: False once either side has ended it.
    """

    def __init__(self, connection: socket.socket) -> None:
        self.is_open: bool = True
        self._connection: Final[socket.socket] = connection
        self._held: list[bytes] = []
        self._held_bytes = 0
        self._unread: list[bytes] = []  # the oldest last
        # Bound before the program's own waits for sockets are refused.
        self._send: Final[Callable[[bytes], int]] = connection.send
        self._receive: Final[Callable[[int], bytes]] = connection.recv

    def hold(self, record: bytes) -> None:
        """Send a record together with the next one, unless there are many."""
        if self._held_bytes + len(record) > _HELD_MAX:
            self._send_held()
        self._held.append(record)
        self._held_bytes += len(record) + records.LENGTH.size

    def send(self, record: bytes) -> None:
        """Send a record, after those that are held; raise UsageError if the rig has ended."""
        if self._held_bytes + len(record) > _HELD_MAX:
            self._send_held()
        held, self._held, self._held_bytes = self._held, [], 0
        self._send_message(records.batch([*held, record]))

    def _send_held(self) -> None:
        held, self._held, self._held_bytes = self._held, [], 0
        if held:
            self._send_message(records.batch(held))

    def _send_message(self, message: bytes) -> None:
        try:
            if self.is_open:
                self._send(message)
        except OSError:
            self.is_open = False
        if not self.is_open:
            raise UsageError(GONE)

    def receive(self) -> bytes:
        """Return the next record; raise UsageError if the rig has ended."""
        if self._unread:
            return self._unread.pop()
        if self.is_open:
            try:
                message = self._receive(records.RECORD_MAX)
            except OSError:
                message = b""
            if message:
                self._unread = [*records.split(message)][::-1]
                return self._unread.pop()
        self.is_open = False
        raise UsageError(GONE)

    def has_more(self) -> bool:
        """Return whether the last message has more records."""
        return bool(self._unread)

    def close(self) -> None:
        """Tell the rig that this program leaves, and close the connection."""
        if self.is_open:
            with suppress(UsageError):
                self.send(bytes([records.LEAVE]))
            self.is_open = False
        with suppress(OSError):  # the program itself may have closed it
            self._connection.close()


@final
class _Period:
    """A periodic action, until cancelled."""

    def __init__(self, periods: "dict[int, Callable[[], None]]", link: RemoteLink, number: int):
        self._periods = periods
        self._link = link
        self._number = number

    def cancel(self) -> None:
        """Stop the repetition."""
        if self._periods.pop(self._number, None) is not None and self._link.is_open:
            self._link.send(records.COUNTED.pack(records.CANCEL, self._number))


@final
class RemoteRuntime(VirtualRuntime):
    """The Runtime of a program in another process than its rig.

    Args:
        link: the connection.
        now_ns: the time at which it joined [ns].

    Attributes:
        ports: by number, the functions for frames and for error messages of that port.
    """

    def __init__(self, link: RemoteLink, now_ns: int) -> None:
        super().__init__(EventQueue())
        self.queue.run_until(now_ns)
        self.ports: dict[int, tuple[FrameListener, FrameListener]] = {}
        self._link: Final[RemoteLink] = link
        self._periods: dict[int, Callable[[], None]] = {}
        self._next_period = 1
        self._next_wait = 1
        self._told: dict[int, Waiter] = {}
        self._numbers: dict[VirtualParty, int] = {}
        self._on_processes: list[VirtualParty] = []

    def begin(self) -> None:
        """Wait for the first turn of the program."""
        self.enrol(self._party_here())
        waiter = self._waiters[-1]
        self._pump(waiter)
        if waiter.error is not None:
            raise waiter.error

    def every(self, period_s: float, action: Callable[[], None]) -> "Registration":
        """Call `action` every `period_s` [s], first after one period; it must not wait."""
        if not 1e-9 <= period_s <= 1e9:
            raise UsageError(f"period_s = {period_s}: must be 1e-9 to 1e9 s")
        number = self._next_period
        self._next_period += 1
        self._periods[number] = action
        self._link.send(records.PERIOD.pack(records.EVERY, number, round(period_s * 1e9)))
        return _Period(self._periods, self._link, number)

    @contextmanager
    def watching_processes(self) -> Iterator[None]:
        """Let waits of this party look again after each turn of another program.

        For what programs share outside the buses, such as locks in files.
        """
        party = self._party_here()
        self._on_processes.append(party)
        try:
            yield
        finally:
            self._on_processes.remove(party)

    def _run_to_next_turn(self, deadline_ns: int) -> Waiter:
        """Give the turn back to the rig; serve its calls until it grants the next one."""
        link = self._link
        self._tell_waits()
        link.send(records.COUNTED.pack(records.IDLE, self._first_ready()))
        while True:
            record = link.receive()
            kind = record[0]
            waiter, ready = None, -1
            if kind == records.GRANT:
                waiter = self._granted(record)
            elif kind == records.TRY:
                _, number, now_ns = records.PERIOD.unpack(record)
                self._advance(now_ns)
                ready = self._first_ready()
                if ready == number:
                    waiter = self._taken(number)
            else:
                self._serve(kind, record)
                if link.has_more():
                    continue
            if waiter is not None:
                return waiter
            if ready < 0:
                ready = self._first_ready()
            link.send(records.COUNTED.pack(records.IDLE, ready))

    def _granted(self, record: bytes) -> Waiter | None:
        _, number, now_ns, result = records.TURN.unpack_from(record)
        self._advance(now_ns)
        waiter = self._told.pop(number)
        if waiter not in self._waiters:
            return None
        waiter.result = result == Result.HOLDS
        if result == Result.REFUSED:
            waiter.error = UsageError(records.text_of(record, records.TURN.size))
        elif result == Result.INTERRUPTED:
            waiter.error = KeyboardInterrupt()
        return waiter

    def _taken(self, number: int) -> Waiter:
        """Take the turn for this wait; its next record to the rig says so."""
        self._link.hold(_TAKEN)
        waiter = self._told.pop(number)
        waiter.result = True
        return waiter

    def _advance(self, now_ns: int) -> None:
        if now_ns > self.queue.now_ns:
            self._polls = 0
            self.queue.run_until(now_ns)

    def _serve(self, kind: int, record: bytes) -> None:
        try:
            if kind == records.HEARD or kind == records.TOLD:
                _, number, time_ns, transmitted = records.DELIVERY.unpack_from(record)
                self._advance(time_ns)
                listeners = self.ports.get(number)
                if listeners is not None:  # else closed in the turn in which this was sent
                    listener = listeners[kind == records.TOLD]
                    listener(record[records.DELIVERY.size :], time_ns, bool(transmitted))
            elif kind == records.EXPIRED:
                _, number, time_ns = records.PERIOD.unpack(record)
                self._advance(time_ns)
                action = self._periods.get(number)
                if action is not None:
                    action()
            elif kind == records.CHECK:
                self._advance(records.CALL.unpack(record)[1])
        except Exception as error:  # of a listener: raised where a party waits
            self._waiters[-1].error = error

    def _tell_waits(self) -> None:
        """Tell the rig of waits that have begun or ended since the last turn."""
        for number, waiter in list(self._told.items()):
            if waiter not in self._waiters:
                del self._told[number]
                self._link.hold(records.COUNTED.pack(records.WITHDRAW, number))
        told = list(self._told.values())
        for waiter in self._waiters:
            if waiter not in told:
                number = self._next_wait
                self._next_wait += 1
                self._told[number] = waiter
                flags = _PARTIES if waiter.on_parties else _DEAF if waiter.done is never else 0
                if waiter.party in self._on_processes:
                    flags |= _PROCESSES
                party = self._number_of(waiter.party)
                self._link.hold(
                    records.WAITING.pack(records.WAIT, number, party, flags, waiter.deadline_ns)
                )

    def _number_of(self, party: VirtualParty) -> int:
        number = self._numbers.get(party)
        if number is None:
            number = self._numbers[party] = self._free_number(party)
            self._link.hold(records.numbered(records.PARTY, number, party.name))
        return number

    def _free_number(self, party: VirtualParty) -> int:
        """Return 0 for the first party; for others the lowest number that no running one has."""
        if party.is_first:
            return 0
        self._numbers = {one: at for one, at in self._numbers.items() if not one.finished}
        used = set(self._numbers.values())
        return next(number for number in count(1) if number not in used)

    def _first_ready(self) -> int:
        """Return the number of the first wait whose condition holds, or 0."""
        for waiter in self._waiters:
            try:
                is_ready = waiter.error is not None or waiter.done()
            except Exception as error:
                waiter.error, is_ready = error, True
            if is_ready:
                for number, one in self._told.items():
                    if one is waiter:
                        return number
        return records.NO_WAIT
