"""SYNC (CiA 301, 7.2.5) and TIME (7.2.6) of a node.

Without 1005h the identifier is 080h. A SYNC has a counter exactly if 1019h is not 0. A SYNC of
another length is ignored and an error (EMCY 8240h) until a correct one arrives. The counter runs
from 1 to 1019h.

The window (1007h) begins with a SYNC and ends so many microseconds later; before the first SYNC
there is none. A synchronous RPDO between the end of the window and the next SYNC is discarded. A
synchronous TPDO is queued at the instant of its SYNC. If it leaves a busy bus after the end of the
window, that is an error (EMCY 8100h): it cannot be withdrawn from the bus.

With bit 30 of 1005h the node sends SYNC itself, every 1006h microseconds, in PRE-OPERATIONAL and
OPERATIONAL. The first one follows after one period. Its own PDOs are processed at the instant of
sending.

With bit 31 of 1012h the node listens. TIME carries TIME_OF_DAY: milliseconds since midnight in 28
bits, four unused bits, days since 1 January 1984 in 16. A TIME of another length is ignored. The
last time can be read if the file has an object for it (ours: 2012h). The node does not send TIME.

Source: CiA 301, 7.5.2.5 to 7.5.2.7 and 7.5.2.22; refusals as in CANopenNode (301/CO_SYNC.c).
"""

from typing import Final, final

from motorhil.emulators.can.frame import pack
from motorhil.emulators.canopen.codes import UPPER_BITS, AbortCode, is_restricted
from motorhil.emulators.canopen.emcy import SYNC_LENGTH, SYNC_LENGTH_KEY, EmcyProducer
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.canopen.outbox import MS, NEVER, US, Outbox

COUNTER_MAX: Final = 240

_GENERATE: Final = 1 << 30
_PERIOD_MIN_US: Final = 100  # drives do not send SYNC more often; it would fill the bus

TIME_OF_DAY: Final = 0x2012

_CONSUME: Final = 1 << 31
_PRODUCE: Final = 1 << 30
_LENGTH: Final = 6
_DAY_MS: Final = 86_400_000
_STEP_MS: Final = 100  # smaller deviations from the own clock do not cause an event


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
    """The SYNC consumer and producer.

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
        self._is_active = False  # the NMT state allows sending
        self._is_odd = False  # the last one had a wrong length by 1019h
        self.can_id: int = 0x80
        self.overflow: int = 0
        self.counter: int = 0
        self.window: SyncWindow = SyncWindow()
        self.deadline_ns: int = NEVER
        period = od.get(0x1006)
        if period is not None:
            period.writer = self.check_period
        overflow = od.get(0x1019)
        if overflow is not None:
            overflow.writer = self.check_overflow

    def configure(self, index: int, now_ns: int) -> None:
        """Read the dictionary again; a change of `index` 1005h or 1006h restarts the producer."""
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
        """Allow or forbid sending by NMT state; no SYNC has been heard in this state."""
        self.window.closes_ns = NEVER
        if is_active != self._is_active:
            self._is_active = is_active
            self._begin(now_ns)

    def is_right(self, frame: bytes, now_ns: int) -> bool:
        """Return whether a SYNC has the required length; report it if not."""
        if frame[4] == (1 if self.overflow else 0):
            if self._is_odd:
                self._is_odd = False
                self._emcy.repair(SYNC_LENGTH_KEY, now_ns)
            return True
        self._is_odd = True
        self._emcy.find(SYNC_LENGTH_KEY, SYNC_LENGTH, frame[4:5], now_ns)
        return False

    def is_plain(self) -> bool:
        """Return whether SYNC needs no check of counter, window and length."""
        return not self.overflow and not self.window.length_ns and not self._is_odd

    def open_window(self, now_ns: int) -> None:
        """Open the window at a SYNC."""
        if self.window.length_ns:
            self.window.closes_ns = now_ns + self.window.length_ns

    def expire(self, now_ns: int) -> None:
        """Send a SYNC; a delay of whole periods skips them."""
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
        """Return the abort code for a new value of 1005h, or 0."""
        if value & UPPER_BITS or is_restricted(value & 0x7FF):
            return AbortCode.INVALID_VALUE
        if value & _GENERATE:
            if not self._may_produce:
                return AbortCode.INVALID_VALUE
            if self._cob_id.integer() & _GENERATE and value & 0x7FF != self.can_id:
                return AbortCode.INVALID_VALUE  # stop sending first
        return 0

    def check_period(self, value: int) -> int:
        """Return the abort code for a new value of 1006h, or 0."""
        return AbortCode.VALUE_TOO_LOW if 0 < value < _PERIOD_MIN_US else 0

    def check_overflow(self, value: int) -> int:
        """Return the abort code for a new value of 1019h, or 0; refused while 1006h is not 0."""
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


@final
class TimeConsumer:
    """A consumer that keeps the last time.

    Attributes:
        can_id: of TIME; 0: the node does not listen to it.
    """

    def __init__(self, od: ObjectDictionary, outbox: Outbox) -> None:
        self._outbox = outbox
        self._cob_id = od.get(0x1012)
        self._shown = od.get(TIME_OF_DAY)
        self._told_ms: int = -1  # last received time since 1984; -1: none
        self._told_ns = 0
        self.can_id: int = 0
        if self._cob_id is not None:
            self._cob_id.writer = self.check

    def configure(self) -> None:
        """Read 1012h from the dictionary."""
        cob_id = 0 if self._cob_id is None else self._cob_id.integer()
        self.can_id = cob_id & 0x7FF if cob_id & _CONSUME else 0

    def receive(self, frame: bytes, now_ns: int) -> None:
        """Process a TIME message."""
        if frame[4] != _LENGTH:
            return
        since_midnight_ms = int.from_bytes(frame[8:12], "little") & 0x0FFF_FFFF
        days = int.from_bytes(frame[12:14], "little")
        shown = self._shown
        if shown is not None and shown.data_type == DataType.TIME_OF_DAY:
            shown.value = days << 32 | since_midnight_ms
        told_ms = days * _DAY_MS + since_midnight_ms
        expected_ms = self._told_ms + (now_ns - self._told_ns) // MS
        if self._told_ms < 0 or abs(told_ms - expected_ms) > _STEP_MS:
            seconds = since_midnight_ms / 1000
            text = f"TIME: day {days} since 1984, {seconds:.3f} s after midnight"
            self._outbox.events.append(("info", text))
        self._told_ms, self._told_ns = told_ms, now_ns

    def check(self, value: int) -> int:
        """Return the abort code for a new value of 1012h, or 0."""
        if value & UPPER_BITS or is_restricted(value & 0x7FF) or value & _PRODUCE:
            return AbortCode.INVALID_VALUE  # 29 bits, taken, or sending TIME
        if value & _CONSUME and self.can_id and value & 0x7FF != self.can_id:
            return AbortCode.INVALID_VALUE  # stop listening first
        return 0
