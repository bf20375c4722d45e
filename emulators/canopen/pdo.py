"""PDOs (CiA 301, 7.2.2): receiving, latching until SYNC, and sending on SYNC, event and timer.

An RPDO of type 0..240 takes effect at the next SYNC: its frame is kept as it came, and unpacked
then. One that is too short is left out, of one that is too long the mapped bytes count; both are
told (EMCY 8210h, 8220h) until one of the right length comes.

A TPDO of type 1..240 is sampled at every n-th SYNC, of type 0 at the SYNC after an event, of
types 254 and 255 at an event, at most once per inhibit time and at least once per event timer. A
TPDO does not go into the bus's queue twice: as long as the one before has not left, the next one
waits (254, 255) or is left out and told (synchronous ones; the bus is too full then).

A remote frame asks for a TPDO whose COB-ID allows it (bit 30 is 0); nothing else does for types
252 and 253. 252 answers with what the last SYNC sampled, 253 and all others with the values of now.
What is on its way already is the answer.
"""

from typing import Final, final

from emulators.canopen.emcy import PDO_LENGTH_EXCEEDED, PDO_NOT_PROCESSED, EmcyProducer
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.pdo_mapping import PdoMapping, load
from emulators.canopen.pdo_parameters import INVALID, NO_REMOTE, PdoParameters
from emulators.canopen.shared import MS, NEVER, NodeHost, Outbox

_LONG_AGO: Final = -NEVER
_SAMPLED_ON_REQUEST: Final = 252


@final
class Rpdo:
    """One receive PDO."""

    def __init__(
        self,
        parameters: PdoParameters,
        number: int,
        emcy: EmcyProducer,
        host: NodeHost,
    ) -> None:
        self.parameters = parameters
        self.number = number  # 1..512, as people count them
        self.can_id = 0  # 0: it does not exist
        self.is_synchronous = False
        self.mapping = PdoMapping([])
        self.latched = b""
        self._emcy = emcy
        self._host = host
        self._is_odd = False  # the last one's length was not the mapping's

    def configure(self, od: ObjectDictionary) -> list[tuple[int, int]]:
        """It is what the dictionary says now; answers with mapping entries that cannot be."""
        cob_id = self.parameters.cob_id()
        self.mapping, refused = load(od, self.parameters.mapping, receive=True)
        exists = not cob_id & INVALID and self.mapping.length_bytes
        self.can_id = cob_id & 0x7FF if exists else 0
        self.is_synchronous = self.parameters.transmission_type() <= 240
        self.latched = b""
        self._emcy.repair(self.number)
        return refused

    def receive(self, frame: bytes, now_ns: int) -> None:
        """A frame with its identifier came, in OPERATIONAL."""
        length = frame[4]
        mapped = self.mapping.length_bytes
        if length != mapped:
            self._is_odd = True
            code = PDO_NOT_PROCESSED if length < mapped else PDO_LENGTH_EXCEEDED
            self._emcy.find(self.number, code, bytes((self.number & 0xFF, length, mapped)))
            if length < mapped:
                return
        elif self._is_odd:
            self._is_odd = False
            self._emcy.repair(self.number)
        if self.is_synchronous:
            self.latched = frame
        else:
            self.mapping.write(frame)
            self._host.on_write(now_ns)

    def forget(self) -> None:
        """Nothing is latched."""
        self.latched = b""


@final
class Tpdo:
    """One transmit PDO."""

    def __init__(
        self, parameters: PdoParameters, number: int, outbox: Outbox, host: NodeHost
    ) -> None:
        self.parameters = parameters
        self.number = number  # 1..512
        self.can_id = 0  # 0: it does not exist
        self.transmission_type = 0xFF
        self.may_be_asked = False  # by a remote frame
        self.mapping = PdoMapping([])
        self.deadline_ns: int = NEVER
        self._outbox = outbox
        self._host = host
        self._inhibit_ns = 0
        self._event_ns = 0
        self._event_due_ns: int = NEVER
        self._sent_ns: int = _LONG_AGO
        self._is_wanted = False  # an event has happened since it was sent last
        self._is_in_flight = False
        self._overrun_told = False
        self._syncs = 0
        self._sample = b""  # of the last SYNC, for whoever asks

    def configure(self, od: ObjectDictionary) -> list[tuple[int, int]]:
        """It is what the dictionary says now; answers with mapping entries that cannot be."""
        parameters = self.parameters
        cob_id = parameters.cob_id()
        self.mapping, refused = load(od, parameters.mapping, receive=False)
        exists = not cob_id & INVALID and self.mapping.length_bytes
        self.can_id = cob_id & 0x7FF if exists else 0
        self.transmission_type = parameters.transmission_type()
        self.may_be_asked = exists != 0 and not cob_id & NO_REMOTE
        self._inhibit_ns = parameters.inhibit_100us() * 100_000
        self._event_ns = parameters.event_timer_ms() * MS
        self.stop()
        return refused

    def is_event_driven(self) -> bool:
        """Whether events matter to it: types 0, 254, 255."""
        return self.transmission_type == 0 or self.transmission_type >= 254

    def stop(self) -> None:
        """No event is kept, no timer runs."""
        self._is_wanted = False
        self._is_in_flight = False
        self._overrun_told = False
        self._syncs = 0
        self._sample = b""
        self._sent_ns = _LONG_AGO
        self._event_due_ns = NEVER
        self.deadline_ns = NEVER
        self._outbox.deadlines_moved = True

    def begin(self, now_ns: int) -> None:
        """OPERATIONAL is entered or the PDO changed: an event-driven one tells how things are."""
        self.stop()
        if self.can_id and self.is_event_driven():
            self.want(now_ns)

    def want(self, now_ns: int) -> None:
        """An event: it is to be sent, now if it may be."""
        self._is_wanted = True
        if self.transmission_type >= 254:
            self._send_if_allowed(now_ns)

    def confirm(self, now_ns: int) -> None:
        """The one in flight has left the bus."""
        self._is_in_flight = False
        if self._is_wanted and self.transmission_type >= 254:
            self._send_if_allowed(now_ns)

    def expire(self, now_ns: int) -> None:
        """The event timer or the inhibit time has run out."""
        if self._event_due_ns <= now_ns:
            self._is_wanted = True
        self._send_if_allowed(now_ns)

    def is_due(self) -> bool:
        """A SYNC came: whether it is to be sampled at this one."""
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
        """It goes out with the values of now, which `before_read` has made ready."""
        self._outbox.frames.append(self.mapping.build(self.can_id))
        self._sent_ns = now_ns
        self._is_wanted = False
        self._is_in_flight = True
        if self._event_ns and self.transmission_type >= 254:
            self._event_due_ns = now_ns + self._event_ns
            self.deadline_ns = self._event_due_ns
            self._outbox.deadlines_moved = True

    def sample(self) -> None:
        """SYNC: what it holds now is kept for whoever asks; `before_read` has made it ready."""
        self._sample = self.mapping.build(self.can_id)

    def requested(self, _frame: bytes, now_ns: int) -> None:
        """A remote frame asks for it."""
        if self._is_in_flight:
            return
        if self.transmission_type != _SAMPLED_ON_REQUEST:
            self._host.before_read(now_ns)
            self.transmit(now_ns)
        elif self._sample:
            self._outbox.frames.append(self._sample)
            self._is_in_flight = True

    def _send_if_allowed(self, now_ns: int) -> None:
        deadline_ns = self._event_due_ns
        if self._is_in_flight:
            deadline_ns = NEVER  # `confirm` goes on
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
        outbox: Outbox,
        host: NodeHost,
    ) -> None:
        self._od = od
        self._outbox = outbox
        self._host = host
        self._is_running = False
        self.rpdos: list[Rpdo] = []
        self.tpdos: list[Tpdo] = []
        for index in od.indices():
            if 0x1400 <= index <= 0x15FF:
                number = index - 0x1400
                parameters = PdoParameters(od, number, True, node_id)
                self.rpdos.append(Rpdo(parameters, number + 1, emcy, host))
            elif 0x1800 <= index <= 0x19FF:
                number = index - 0x1800
                parameters = PdoParameters(od, number, False, node_id)
                self.tpdos.append(Tpdo(parameters, number + 1, outbox, host))
        self._latching: list[Rpdo] = []  # RPDOs that take effect at SYNC
        self._sampled: list[Tpdo] = []  # TPDOs that SYNC may ask for
        self._kept: list[Tpdo] = []  # TPDOs that SYNC samples for whoever asks later
        self._timed: list[Tpdo] = []  # TPDOs that may have a deadline
        self._watchers: dict[int, list[Tpdo]] = {}  # event-driven TPDOs by what they map
        self._by_can_id: dict[bytes, list[Tpdo]] = {}

    def configure_all(self) -> None:
        """All PDOs are what the dictionary says now."""
        for rpdo in self.rpdos:
            self._tell(f"RPDO {rpdo.number}", rpdo.configure(self._od))
        for tpdo in self.tpdos:
            self._tell(f"TPDO {tpdo.number}", tpdo.configure(self._od))
        self._sort()

    def configure(self, index: int, now_ns: int) -> None:
        """An object of one PDO was written."""
        for rpdo in self.rpdos:
            if index in (rpdo.parameters.communication, rpdo.parameters.mapping):
                rpdo.configure(self._od)
        for tpdo in self.tpdos:
            if index in (tpdo.parameters.communication, tpdo.parameters.mapping):
                tpdo.configure(self._od)
                if self._is_running:
                    tpdo.begin(now_ns)
        self._sort()

    def start(self, now_ns: int) -> None:
        """OPERATIONAL is entered."""
        self._is_running = True
        for rpdo in self.rpdos:
            rpdo.forget()
        for tpdo in self.tpdos:
            tpdo.begin(now_ns)

    def stop(self) -> None:
        """OPERATIONAL is left."""
        self._is_running = False
        for rpdo in self.rpdos:
            rpdo.forget()
        for tpdo in self.tpdos:
            tpdo.stop()

    def sync(self, now_ns: int) -> None:
        """SYNC in OPERATIONAL: latched RPDOs take effect, the device acts, TPDOs are sampled."""
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

    def changed(self, index: int, subindex: int, now_ns: int) -> None:
        """A variable has changed: an event for the event-driven TPDOs that map it."""
        if self._is_running:
            for tpdo in self._watchers.get(index << 8 | subindex, ()):
                tpdo.want(now_ns)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """An own frame has left the bus."""
        for tpdo in self._by_can_id.get(frame[:4], ()):
            tpdo.confirm(now_ns)

    def deadline_ns(self) -> int:
        """The nearest event timer or end of an inhibit time [ns]."""
        deadline_ns = NEVER
        for tpdo in self._timed:
            if tpdo.deadline_ns < deadline_ns:
                deadline_ns = tpdo.deadline_ns
        return deadline_ns

    def expire(self, now_ns: int) -> None:
        """TPDOs whose time has come go out."""
        for tpdo in self._timed:
            if tpdo.deadline_ns <= now_ns:
                tpdo.expire(now_ns)

    def _sort(self) -> None:
        existing = [tpdo for tpdo in self.tpdos if tpdo.can_id]
        self._latching = [rpdo for rpdo in self.rpdos if rpdo.can_id and rpdo.is_synchronous]
        self._sampled = [tpdo for tpdo in existing if tpdo.transmission_type <= 240]
        self._kept = [tpdo for tpdo in existing if tpdo.transmission_type == _SAMPLED_ON_REQUEST]
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
