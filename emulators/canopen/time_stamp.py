"""TIME consumer (CiA 301, 7.2.6): the time of day from the bus.

With bit 31 of 1012h the node listens. TIME carries TIME_OF_DAY: milliseconds since midnight in 28
bits, four unused bits, days since 1 January 1984 in 16. A TIME of another length is ignored. The
last time can be read if the file has an object for it (ours: 2012h). The node does not send TIME.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.cob_id import UPPER_BITS, is_restricted
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.canopen.shared import MS, Outbox

TIME_OF_DAY: Final = 0x2012

_CONSUME: Final = 1 << 31
_PRODUCE: Final = 1 << 30
_LENGTH: Final = 6
_DAY_MS: Final = 86_400_000
_STEP_MS: Final = 100  # smaller deviations from the own clock do not cause an event


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
        self.can_id = 0
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
