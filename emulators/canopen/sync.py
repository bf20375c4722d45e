"""SYNC (CiA 301, 7.2.5): its identifier, counter and window, and sending it.

Without 1005h SYNC is 080h. A SYNC carries a counter exactly if 1019h is not 0; one of another
length is left out and told (EMCY 8240h) until a right one comes. The counter runs from 1 to 1019h.

The window (1007h) begins with a SYNC and ends so many microseconds later; before the first SYNC
there is none. A synchronous RPDO that comes after its end and before the next SYNC is discarded. A
synchronous TPDO is handed to the bus in the instant of its SYNC; if the bus is so full that it
leaves after the window's end, that is told (EMCY 8100h): it cannot be called back from the bus.

With bit 30 of 1005h the node sends SYNC itself, every 1006h microseconds, in PRE-OPERATIONAL and
OPERATIONAL, the first one period after it may; its own PDOs go by it in the instant it is sent.

Source: CiA 301, 7.5.2.5 to 7.5.2.7 and 7.5.2.22; refusals as CANopenNode has them (301/CO_SYNC.c).
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.cob_id import UPPER_BITS, is_restricted
from emulators.canopen.emcy import SYNC_LENGTH, SYNC_LENGTH_KEY, EmcyProducer
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.canopen.shared import NEVER, US, Outbox
from emulators.media.can_frame import pack

COUNTER_MAX: Final = 240

_GENERATE: Final = 1 << 30
_PERIOD_MIN_US: Final = 100  # no drive sends SYNC more often; it would fill the bus


@final
class SyncWindow:
    """The time after a SYNC in which synchronous PDOs count.

    Attributes:
        length_ns: 1007h; 0: always.
        closes_ns: its end after the last SYNC; NEVER without one.
    """

    def __init__(self) -> None:
        self.length_ns = 0
        self.closes_ns: int = NEVER


@final
class SyncService:
    """Consumer and producer.

    Attributes:
        can_id: of SYNC.
        overflow: 1019h; 0: SYNC has no counter.
        counter: of the last SYNC sent; 0: none yet.
        window: of synchronous PDOs.
        deadline_ns: when the next SYNC is sent.
    """

    def __init__(self, od: ObjectDictionary, emcy: EmcyProducer, outbox: Outbox) -> None:
        self._od = od
        self._emcy = emcy
        self._outbox = outbox
        self._cob_id = od.ensure(0x1005, 0, DataType.UNSIGNED32, 0x80)
        self._cob_id.writer = self.check
        self._may_produce = od.get(0x1006) is not None
        self._period_ns = 0
        self._is_active = False  # the NMT state lets it send
        self._is_odd = False  # the last one's length was not what 1019h says
        self.can_id = 0x80
        self.overflow = 0
        self.counter = 0
        self.window = SyncWindow()
        self.deadline_ns: int = NEVER
        period = od.get(0x1006)
        if period is not None:
            period.writer = self.check_period
        overflow = od.get(0x1019)
        if overflow is not None:
            overflow.writer = self.check_overflow

    def configure(self, index: int, now_ns: int) -> None:
        """All is what the dictionary says now; a change of `index` 1005h or 1006h begins anew."""
        od = self._od
        self.can_id = self._cob_id.integer() & 0x7FF
        overflow = od.integer(0x1019, 0, 0)
        self.overflow = 0 if overflow < 2 else min(overflow, COUNTER_MAX)
        self.window.length_ns = od.integer(0x1007, 0, 0) * US
        if not self.window.length_ns:
            self.window.closes_ns = NEVER
        if index in (0x1005, 0x1006):
            self._begin(now_ns)

    def enter(self, is_active: bool, now_ns: int) -> None:
        """The NMT state lets SYNC be sent, or not; no SYNC has been heard in it."""
        self.window.closes_ns = NEVER
        if is_active != self._is_active:
            self._is_active = is_active
            self._begin(now_ns)

    def is_right(self, frame: bytes, now_ns: int) -> bool:
        """Whether a SYNC has the length it must have; told if not."""
        if frame[4] == (1 if self.overflow else 0):
            if self._is_odd:
                self._is_odd = False
                self._emcy.repair(SYNC_LENGTH_KEY, now_ns)
            return True
        self._is_odd = True
        self._emcy.find(SYNC_LENGTH_KEY, SYNC_LENGTH, frame[4:5], now_ns)
        return False

    def is_plain(self) -> bool:
        """Whether all there is to a SYNC is that it comes."""
        return not self.overflow and not self.window.length_ns and not self._is_odd

    def open_window(self, now_ns: int) -> None:
        """A SYNC came."""
        if self.window.length_ns:
            self.window.closes_ns = now_ns + self.window.length_ns

    def expire(self, now_ns: int) -> None:
        """A SYNC is sent; whoever was late by whole periods skips them."""
        payload = b""
        if self.overflow:
            self.counter = self.counter + 1 if self.counter < self.overflow else 1
            payload = bytes((self.counter,))
        self._outbox.frames.append(pack(self.can_id, payload))
        self.deadline_ns += self._period_ns
        if self.deadline_ns <= now_ns:
            self.deadline_ns = now_ns + self._period_ns
        self._outbox.deadlines_moved = True

    def check(self, value: int) -> int:
        """What is wrong with a new 1005h; 0 if nothing."""
        if value & UPPER_BITS or is_restricted(value & 0x7FF):
            return AbortCode.INVALID_VALUE
        if value & _GENERATE:
            if not self._may_produce:
                return AbortCode.INVALID_VALUE
            if self._cob_id.integer() & _GENERATE and value & 0x7FF != self.can_id:
                return AbortCode.INVALID_VALUE  # stop sending first
        return 0

    def check_period(self, value: int) -> int:
        """What is wrong with a new 1006h; 0 if nothing."""
        return AbortCode.VALUE_TOO_LOW if 0 < value < _PERIOD_MIN_US else 0

    def check_overflow(self, value: int) -> int:
        """What is wrong with a new 1019h; 0 if nothing. It stands still while 1006h is not 0."""
        if value == 1 or value > COUNTER_MAX:
            return AbortCode.INVALID_VALUE
        return AbortCode.NOT_STORED_DEVICE_STATE if self._od.integer(0x1006, 0, 0) else 0

    def _begin(self, now_ns: int) -> None:
        self.counter = 0
        self._period_ns = 0
        if self._is_active and self._cob_id.integer() & _GENERATE:
            self._period_ns = self._od.integer(0x1006, 0, 0) * US
        self.deadline_ns = now_ns + self._period_ns if self._period_ns else NEVER
        self._outbox.deadlines_moved = True
