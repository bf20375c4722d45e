"""All PDOs of a node (CiA 301, 7.2.2) and their triggers."""

from typing import final

from emulators.canopen.emcy import COMMUNICATION, WINDOW_KEY, EmcyProducer
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.pdo_parameters import PdoParameters
from emulators.canopen.rpdo import LAST_SYNCHRONOUS, Rpdo
from emulators.canopen.shared import NEVER, NodeHost, Outbox
from emulators.canopen.sync import SyncService
from emulators.canopen.tpdo import SAMPLED_ON_REQUEST, Tpdo


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
