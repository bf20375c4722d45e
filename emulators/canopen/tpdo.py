"""Transmit PDOs (CiA 301, 7.2.2): sent on SYNC, event, timer and request.

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

from emulators.canopen.cob_id import INVALID
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.pdo_mapping import PdoMapping, load
from emulators.canopen.pdo_parameters import NO_REMOTE, PdoParameters
from emulators.canopen.shared import MS, NEVER, NodeHost, Outbox

SAMPLED_ON_REQUEST: Final = 252

_LONG_AGO: Final = -NEVER
_WAITS: Final = -NEVER  # an unreachable number of SYNCs: it waits for its start value


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
        self.sync_start = 0  # 0: it does not wait for a counter
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
