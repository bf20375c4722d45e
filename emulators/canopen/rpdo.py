"""Receive PDOs (CiA 301, 7.2.2): processed at once or at SYNC.

An RPDO of type 0..240 becomes active at the next SYNC: its frame is kept and unpacked then. A short
frame is ignored; of a long one the mapped bytes count. Both are errors (EMCY 8210h, 8220h) until a
frame of the right length arrives.

With an event timer (140Xh:5) an RPDO must arrive again before the timer expires. The first RPDO
starts the timer. A missing RPDO is an error (EMCY 8250h) until the next one.
"""

from typing import Final, final

from emulators.canopen.cob_id import INVALID
from emulators.canopen.emcy import (
    PDO_LENGTH_EXCEEDED,
    PDO_NOT_PROCESSED,
    RPDO_TIMEOUT,
    RPDO_TIMEOUT_KEY,
    EmcyProducer,
)
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.pdo_mapping import PdoMapping, load
from emulators.canopen.pdo_parameters import PdoParameters
from emulators.canopen.shared import MS, NEVER, NodeHost, Outbox
from emulators.canopen.sync import SyncWindow

LAST_SYNCHRONOUS: Final = 240


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
        self.can_id = 0  # 0: it does not exist
        self.is_synchronous = False
        self.mapping = PdoMapping([])
        self.latched = b""
        self.event_ns = 0  # 0: no event timer
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
