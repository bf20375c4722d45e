"""All PDOs of a node (CiA 301, 7.2.2) and their triggers.

An RPDO of type 0..240 becomes active at the next SYNC: its frame is kept and unpacked then. A short
frame is ignored; of a long one the mapped bytes count. Both are errors (EMCY 8210h, 8220h) until a
frame of the right length arrives.

With an event timer (140Xh:5) an RPDO must arrive again before the timer expires. The first RPDO
starts the timer. A missing RPDO is an error (EMCY 8250h) until the next one.

A TPDO of type 1..240 is sampled at every n-th SYNC, of type 0 at the SYNC after an event. Types 254
and 255 are sent at an event, at most once per inhibit time and at least once per event timer. A
TPDO is queued for the bus only once. While the previous one has not left, the next one waits (254,
255) or is dropped and reported (synchronous ones; the bus is too full then).

If SYNC has a counter, a TPDO with a SYNC start value (180Xh:6) is first sent at the SYNC with that
counter, and then at every n-th. This spreads TPDOs over the SYNCs.

A remote frame requests a TPDO if its COB-ID allows it (bit 30 is 0). Types 252 and 253 have no
other trigger. Type 252 returns the sample of the last SYNC, 253 and all others the current values.
A TPDO already in flight serves as the response.
"""

from typing import Final, final

from motorhil.emulators.canopen.codes import INVALID
from motorhil.emulators.canopen.emcy import (
    COMMUNICATION,
    PDO_LENGTH_EXCEEDED,
    PDO_NOT_PROCESSED,
    RPDO_TIMEOUT,
    RPDO_TIMEOUT_KEY,
    WINDOW_KEY,
    EmcyProducer,
)
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import MS, NEVER, NodeHost, Outbox
from motorhil.emulators.canopen.pdo_mapping import PdoMapping, load
from motorhil.emulators.canopen.pdo_parameters import NO_REMOTE, PdoParameters
from motorhil.emulators.canopen.sync import SyncService, SyncWindow

LAST_SYNCHRONOUS: Final = 240

SAMPLED_ON_REQUEST: Final = 252

_LONG_AGO: Final = -NEVER
_WAITS: Final = -NEVER  # an unreachable number of SYNCs: it waits for its start value


@final
class Rpdo:
    """One receive PDO."""

    def __init__(
        self,
        parameters: PdoParameters,
        number: int,
        emcy: EmcyProducer,
        outbox: Outbox,
        window: SyncWindow,
        host: NodeHost,
    ) -> None:
        self.parameters = parameters
        self.number = number  # 1..512, as in the standard's names
        self.can_id: int = 0  # 0: it does not exist
        self.is_synchronous: bool = False
        self.mapping: PdoMapping = PdoMapping([])
        self.latched: bytes = b""
        self.event_ns: int = 0  # 0: no event timer
        self.deadline_ns: int = NEVER
        self._emcy = emcy
        self._outbox = outbox
        self._window = window
        self._host = host
        self._is_odd = False  # the last one had a wrong length
        self._is_late = False  # the last one arrived after its window

    def configure(self, od: ObjectDictionary, now_ns: int) -> list[tuple[int, int]]:
        """Configure the PDO from the dictionary and return its invalid mapping entries."""
        cob_id = self.parameters.cob_id()
        self.mapping, refused = load(od, self.parameters.mapping, receive=True)
        exists = not cob_id & INVALID and self.mapping.length_bytes
        self.can_id = cob_id & 0x7FF if exists else 0
        self.is_synchronous = self.parameters.transmission_type() <= LAST_SYNCHRONOUS
        self.event_ns = self.parameters.event_timer_ms() * MS if exists else 0
        self.forget()
        self._is_odd = self._is_late = False
        self._emcy.repair(self.number, now_ns)
        self._emcy.repair(RPDO_TIMEOUT_KEY + self.number, now_ns)
        return refused

    def is_plain(self) -> bool:
        """Return whether the RPDO has neither an event timer nor a window."""
        return not self.event_ns and not (self.is_synchronous and self._window.length_ns)

    def receive(self, frame: bytes, now_ns: int) -> None:
        """Process a frame with its identifier, in OPERATIONAL."""
        length = frame[4]
        mapped = self.mapping.length_bytes
        if length != mapped:
            self._is_odd = True
            code = PDO_NOT_PROCESSED if length < mapped else PDO_LENGTH_EXCEEDED
            vendor = bytes((self.number & 0xFF, length, mapped))
            self._emcy.find(self.number, code, vendor, now_ns)
            if length < mapped:
                return
        elif self._is_odd:
            self._is_odd = False
            self._emcy.repair(self.number, now_ns)
        if self.is_synchronous:
            self.latched = frame
        else:
            self.mapping.write(frame)
            self._host.on_write(now_ns)

    def receive_watched(self, frame: bytes, now_ns: int) -> None:
        """Process a frame of an RPDO with an event timer or a window."""
        if self.event_ns:
            self.deadline_ns = now_ns + self.event_ns
            self._outbox.deadlines_moved = True
            self._emcy.repair(RPDO_TIMEOUT_KEY + self.number, now_ns)
        if self.is_synchronous and now_ns > self._window.closes_ns:
            if not self._is_late:
                self._is_late = True
                late_us = (now_ns - self._window.closes_ns) / 1000
                text = f"RPDO {self.number} came {late_us:g} us after its window: left out"
                self._outbox.events.append(("warning", text))
            return
        self._is_late = False
        self.receive(frame, now_ns)

    def expire(self, now_ns: int) -> None:
        """Report that the RPDO did not arrive in time."""
        self.deadline_ns = NEVER
        self._outbox.deadlines_moved = True
        text = f"RPDO {self.number} did not come for {self.event_ns // MS} ms"
        self._outbox.events.append(("warning", text))
        vendor = bytes((self.number & 0xFF,))
        self._emcy.find(RPDO_TIMEOUT_KEY + self.number, RPDO_TIMEOUT, vendor, now_ns)

    def forget(self) -> None:
        """Discard a latched frame and stop the event timer."""
        self.latched = b""
        if self.deadline_ns != NEVER:
            self.deadline_ns = NEVER
            self._outbox.deadlines_moved = True


@final
class Tpdo:
    """One transmit PDO."""

    def __init__(
        self, parameters: PdoParameters, number: int, outbox: Outbox, host: NodeHost
    ) -> None:
        self.parameters = parameters
        self.number = number  # 1..512
        self.can_id: int = 0  # 0: it does not exist
        self.transmission_type: int = 0xFF
        self.may_be_asked: bool = False  # by a remote frame
        self.mapping: PdoMapping = PdoMapping([])
        self.sync_start: int = 0  # 0: it does not wait for a counter
        self.deadline_ns: int = NEVER
        self._outbox = outbox
        self._host = host
        self._inhibit_ns = 0
        self._event_ns = 0
        self._event_due_ns: int = NEVER
        self._sent_ns: int = _LONG_AGO
        self._is_wanted = False  # an event has happened since the last transmission
        self._is_in_flight = False
        self._overrun_told = False
        self._syncs = 0
        self._sample = b""  # of the last SYNC, for requests

    def configure(self, od: ObjectDictionary, has_counter: bool) -> list[tuple[int, int]]:
        """Configure the PDO from the dictionary and return its invalid mapping entries."""
        parameters = self.parameters
        cob_id = parameters.cob_id()
        self.mapping, refused = load(od, parameters.mapping, receive=False)
        exists = not cob_id & INVALID and self.mapping.length_bytes
        self.can_id = cob_id & 0x7FF if exists else 0
        self.transmission_type = parameters.transmission_type()
        self.may_be_asked = exists != 0 and not cob_id & NO_REMOTE
        self._inhibit_ns = parameters.inhibit_100us() * 100_000
        self._event_ns = parameters.event_timer_ms() * MS
        self.sync_start = parameters.sync_start() if has_counter else 0
        self.stop()
        return refused

    def is_event_driven(self) -> bool:
        """Return whether events trigger it: types 0, 254, 255."""
        return self.transmission_type == 0 or self.transmission_type >= 254

    def stop(self) -> None:
        """Forget events and stop all timers."""
        self._is_wanted = False
        self._is_in_flight = False
        self._overrun_told = False
        self._syncs = _WAITS if self.sync_start else 0
        self._sample = b""
        self._sent_ns = _LONG_AGO
        self._event_due_ns = NEVER
        self.deadline_ns = NEVER
        self._outbox.deadlines_moved = True

    def begin(self, now_ns: int) -> None:
        """Restart after entering OPERATIONAL or a change; event-driven ones report their state."""
        self.stop()
        if self.can_id and self.is_event_driven():
            self.want(now_ns)

    def want(self, now_ns: int) -> None:
        """Note an event; send the TPDO now if allowed."""
        self._is_wanted = True
        if self.transmission_type >= 254:
            self._send_if_allowed(now_ns)

    def confirm(self, now_ns: int) -> None:
        """Confirm that the one in flight has left the bus."""
        self._is_in_flight = False
        if self._is_wanted and self.transmission_type >= 254:
            self._send_if_allowed(now_ns)

    def abandon(self, now_ns: int) -> None:
        """Give up the one in flight after bus-off; an event-driven one is sent again."""
        if self._is_in_flight:
            self._is_in_flight = False
            if self.transmission_type >= 254:
                self.want(now_ns)

    def expire(self, now_ns: int) -> None:
        """Handle the expiry of the event timer or the inhibit time."""
        if self._event_due_ns <= now_ns:
            self._is_wanted = True
        self._send_if_allowed(now_ns)

    def count(self, counter: int) -> None:
        """Start at the SYNC with this counter if it is the start value."""
        if self._syncs < 0 and counter == self.sync_start:
            self._syncs = self.transmission_type - 1  # it is due now

    def is_due(self) -> bool:
        """Count a SYNC and return whether the TPDO is sampled at it."""
        if self.transmission_type == 0:
            if not self._is_wanted:
                return False
        else:
            self._syncs += 1
            if self._syncs < self.transmission_type:
                return False
            self._syncs = 0
        if not self._is_in_flight:
            return True
        if not self._overrun_told:
            self._overrun_told = True
            text = f"TPDO {self.number} had not left the bus at the SYNC that asked for the next"
            self._outbox.events.append(("warning", text))
        return False

    def transmit(self, now_ns: int) -> None:
        """Send the current values, which `before_read` has prepared."""
        self._outbox.frames.append(self.mapping.build(self.can_id))
        self._sent_ns = now_ns
        self._is_wanted = False
        self._is_in_flight = True
        if self._event_ns and self.transmission_type >= 254:
            self._event_due_ns = now_ns + self._event_ns
            self.deadline_ns = self._event_due_ns
            self._outbox.deadlines_moved = True

    def sample(self) -> None:
        """Keep the current values, which `before_read` has prepared, for later requests."""
        self._sample = self.mapping.build(self.can_id)

    def requested(self, _frame: bytes, now_ns: int) -> None:
        """Answer a remote frame."""
        if self._is_in_flight:
            return
        if self.transmission_type != SAMPLED_ON_REQUEST:
            self._host.before_read(now_ns)
            self.transmit(now_ns)
        elif self._sample:
            self._outbox.frames.append(self._sample)
            self._is_in_flight = True

    def _send_if_allowed(self, now_ns: int) -> None:
        deadline_ns = self._event_due_ns
        if self._is_in_flight:
            deadline_ns = NEVER  # `confirm` continues
        elif self._is_wanted:
            allowed_ns = self._sent_ns + self._inhibit_ns
            if allowed_ns <= now_ns:
                self._host.before_read(now_ns)
                self.transmit(now_ns)
                deadline_ns = self._event_due_ns
            else:
                deadline_ns = allowed_ns
        if deadline_ns != self.deadline_ns:
            self.deadline_ns = deadline_ns
            self._outbox.deadlines_moved = True


@final
class PdoService:
    """All PDOs of a node."""

    def __init__(
        self,
        od: ObjectDictionary,
        node_id: int,
        emcy: EmcyProducer,
        sync: SyncService,
        outbox: Outbox,
        host: NodeHost,
    ) -> None:
        self._od = od
        self._emcy = emcy
        self._sync = sync
        self._window = sync.window
        self._outbox = outbox
        self._host = host
        self._is_running = False
        window = self._window
        self.rpdos: list[Rpdo] = []
        self.tpdos: list[Tpdo] = []
        for index in od.indices():
            if 0x1400 <= index <= 0x15FF:
                number = index - 0x1400
                parameters = PdoParameters(od, number, True, node_id)
                self.rpdos.append(Rpdo(parameters, number + 1, emcy, outbox, window, host))
            elif 0x1800 <= index <= 0x19FF:
                number = index - 0x1800
                parameters = PdoParameters(od, number, False, node_id)
                self.tpdos.append(Tpdo(parameters, number + 1, outbox, host))
        self._latching: list[Rpdo] = []  # RPDOs that become active at SYNC
        self._sampled: list[Tpdo] = []  # TPDOs that SYNC may trigger
        self._kept: list[Tpdo] = []  # TPDOs that SYNC samples for later requests
        self._timed: list[Tpdo] = []  # TPDOs that may have a deadline
        self._is_late = False  # a late TPDO has been reported
        self._awaited: list[Rpdo] = []  # RPDOs with an event timer
        self._starting: list[Tpdo] = []  # TPDOs that wait for a SYNC counter
        self._watchers: dict[int, list[Tpdo]] = {}  # event-driven TPDOs by mapped variable
        self._by_can_id: dict[bytes, list[Tpdo]] = {}

    def configure_all(self, now_ns: int) -> None:
        """Configure all PDOs from the dictionary."""
        for rpdo in self.rpdos:
            self._tell(f"RPDO {rpdo.number}", rpdo.configure(self._od, now_ns))
        for tpdo in self.tpdos:
            refused = tpdo.configure(self._od, self._sync.overflow != 0)
            self._tell(f"TPDO {tpdo.number}", refused)
        self._sort()

    def configure_counter(self, now_ns: int) -> None:
        """Restart the TPDOs that wait for a SYNC counter after a write to 1019h."""
        for tpdo in self.tpdos:
            if tpdo.parameters.sync_start():
                self.configure(tpdo.parameters.communication, now_ns)

    def configure(self, index: int, now_ns: int) -> None:
        """Configure one PDO after a write to one of its objects."""
        for rpdo in self.rpdos:
            if index in (rpdo.parameters.communication, rpdo.parameters.mapping):
                rpdo.configure(self._od, now_ns)
        for tpdo in self.tpdos:
            if index in (tpdo.parameters.communication, tpdo.parameters.mapping):
                tpdo.configure(self._od, self._sync.overflow != 0)
                if self._is_running:
                    tpdo.begin(now_ns)
        self._sort()

    def start(self, now_ns: int) -> None:
        """Start the PDOs on entering OPERATIONAL."""
        self._is_running = True
        for rpdo in self.rpdos:
            rpdo.forget()
        for tpdo in self.tpdos:
            tpdo.begin(now_ns)

    def stop(self) -> None:
        """Stop the PDOs on leaving OPERATIONAL."""
        self._is_running = False
        for rpdo in self.rpdos:
            rpdo.forget()
        for tpdo in self.tpdos:
            tpdo.stop()

    def sync(self, now_ns: int) -> None:
        """Process SYNC in OPERATIONAL: write latched RPDOs, call the device, sample TPDOs."""
        host = self._host
        is_written = False
        for rpdo in self._latching:
            frame = rpdo.latched
            if frame:
                rpdo.latched = b""
                rpdo.mapping.write(frame)
                is_written = True
        if is_written:
            host.on_write(now_ns)
        host.on_sync(now_ns)
        is_fresh = False
        for tpdo in self._sampled:
            if tpdo.is_due():
                if not is_fresh:
                    is_fresh = True
                    host.before_read(now_ns)
                tpdo.transmit(now_ns)
        if self._kept:
            if not is_fresh:
                host.before_read(now_ns)
            for tpdo in self._kept:
                tpdo.sample()

    def count(self, counter: int) -> None:
        """Note the counter of the SYNC that is processed next."""
        for tpdo in self._starting:
            tpdo.count(counter)

    def changed(self, index: int, subindex: int, now_ns: int) -> None:
        """Trigger the event-driven TPDOs that map this changed variable."""
        if self._is_running:
            for tpdo in self._watchers.get(index << 8 | subindex, ()):
                tpdo.want(now_ns)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """Confirm that an own frame has left the bus."""
        for tpdo in self._by_can_id.get(frame[:4], ()):
            tpdo.confirm(now_ns)
            if self._window.length_ns and tpdo.transmission_type <= LAST_SYNCHRONOUS:
                self._judge(tpdo.number, now_ns)

    def abandon(self, now_ns: int) -> None:
        """Give up the TPDOs in the queue of a bus-off node."""
        for tpdo in self.tpdos:
            tpdo.abandon(now_ns)

    def deadline_ns(self) -> int:
        """Return the nearest event timer or end of an inhibit time [ns]."""
        deadline_ns = NEVER
        for rpdo in self._awaited:
            if rpdo.deadline_ns < deadline_ns:
                deadline_ns = rpdo.deadline_ns
        for tpdo in self._timed:
            if tpdo.deadline_ns < deadline_ns:
                deadline_ns = tpdo.deadline_ns
        return deadline_ns

    def expire(self, now_ns: int) -> None:
        """Send the TPDOs that are due and report the RPDOs that are overdue."""
        for rpdo in self._awaited:
            if rpdo.deadline_ns <= now_ns:
                rpdo.expire(now_ns)
        for tpdo in self._timed:
            if tpdo.deadline_ns <= now_ns:
                tpdo.expire(now_ns)

    def _sort(self) -> None:
        existing = [tpdo for tpdo in self.tpdos if tpdo.can_id]
        self._latching = [rpdo for rpdo in self.rpdos if rpdo.can_id and rpdo.is_synchronous]
        self._sampled = [tpdo for tpdo in existing if tpdo.transmission_type <= LAST_SYNCHRONOUS]
        self._kept = [tpdo for tpdo in existing if tpdo.transmission_type == SAMPLED_ON_REQUEST]
        self._starting = [tpdo for tpdo in self._sampled if tpdo.sync_start]
        self._awaited = [rpdo for rpdo in self.rpdos if rpdo.event_ns]
        self._timed = [tpdo for tpdo in existing if tpdo.transmission_type >= 254]
        self._watchers = {}
        self._by_can_id = {}
        for tpdo in existing:
            key = tpdo.can_id.to_bytes(4, "little")
            self._by_can_id.setdefault(key, []).append(tpdo)
            if tpdo.is_event_driven():
                for variable in tpdo.mapping.variables:
                    place = variable.index << 8 | variable.subindex
                    self._watchers.setdefault(place, []).append(tpdo)
        self._outbox.deadlines_moved = True

    def _tell(self, name: str, refused: list[tuple[int, int]]) -> None:
        for entry, code in refused:
            text = f"{name} maps {entry:08X}h, which cannot be ({code:08X}h); zeros stand there"
            self._outbox.events.append(("warning", text))

    def _judge(self, number: int, now_ns: int) -> None:
        """Report whether a synchronous TPDO has left the bus within its window."""
        late_ns = now_ns - self._window.closes_ns
        if (late_ns > 0) == self._is_late:
            return
        self._is_late = late_ns > 0
        if self._is_late:
            text = f"TPDO {number} left the bus {late_ns / 1000:g} us after its window"
            self._outbox.events.append(("warning", text))
            self._emcy.find(WINDOW_KEY, COMMUNICATION, bytes((number & 0xFF,)), now_ns)
        else:
            self._emcy.repair(WINDOW_KEY, now_ns)
