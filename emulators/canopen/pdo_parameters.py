"""Rules for changing a PDO by SDO (CiA 301, 7.5.2.35 to 7.5.2.38).

The standard procedure: set the PDO invalid (bit 31 of its COB-ID), set sub-index 0 of the mapping
to 0, write the entries, set sub-index 0 to their number, set the PDO valid. Deviations are refused
with 0601 0000h, unmappable entries with 0604 0041h, too many bits with 0604 0042h.
"""

from typing import Final, final

from motorhil.emulators.canopen.codes import INVALID, UPPER_BITS, AbortCode, is_restricted
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.canopen.pdo_mapping import MAX_BITS, MAX_ENTRIES, entry_refusal
from motorhil.emulators.canopen.sync import COUNTER_MAX

NO_REMOTE: Final = 1 << 30
_PREDEFINED: Final = ((0x180, 0x280, 0x380, 0x480), (0x200, 0x300, 0x400, 0x500))


@final
class PdoParameters:
    """The communication and mapping objects of one PDO, with checks of writes."""

    def __init__(self, od: ObjectDictionary, number: int, receive: bool, node_id: int) -> None:
        self._od = od
        self._receive = receive
        self.communication: int = (0x1400 if receive else 0x1800) + number
        self.mapping: int = (0x1600 if receive else 0x1A00) + number
        predefined = _PREDEFINED[receive][number] + node_id if number < 4 else INVALID
        follows = predefined != INVALID
        self._cob_id = od.ensure(self.communication, 1, DataType.UNSIGNED32, predefined, follows)
        self._type = od.ensure(self.communication, 2, DataType.UNSIGNED8, 0xFF)
        self._count = od.ensure(self.mapping, 0, DataType.UNSIGNED8, self._stated_entries())
        self._own_entries = self._power_on_entries()
        self._attach()

    def cob_id(self) -> int:
        """Return the COB-ID with its flags."""
        return self._cob_id.integer()

    def is_valid(self) -> bool:
        """Return whether the PDO exists, by bit 31 of its COB-ID."""
        return not self.cob_id() & INVALID

    def transmission_type(self) -> int:
        """Return the transmission type, 0..255."""
        return self._type.integer()

    def inhibit_100us(self) -> int:
        """Return the inhibit time [100 us]."""
        return self._od.integer(self.communication, 3, 0)

    def event_timer_ms(self) -> int:
        """Return the event timer [ms]."""
        return self._od.integer(self.communication, 5, 0)

    def sync_start(self) -> int:
        """Return the SYNC start value, 1..240, or 0 for none."""
        value = 0 if self._receive else self._od.integer(self.communication, 6, 0)
        return value if value <= COUNTER_MAX else 0

    def _stated_entries(self) -> int:
        """Return the number of mapping entries with values, for files without a stated count."""
        od = self._od
        values = [od.integer(self.mapping, sub, 0) for sub in od.subindices(self.mapping) if sub]
        return values.index(0) if 0 in values else len(values)

    def _power_on_entries(self) -> tuple[int, ...]:
        """Return the device's own entries, which may be written again whatever they are."""
        variables = [self._od.get(self.mapping, sub) for sub in self._od.subindices(self.mapping)]
        defaults = [variable.default for variable in variables[1:] if variable is not None]
        return tuple(default for default in defaults if isinstance(default, int))

    def _refusal(self, entry: int) -> int:
        is_own = entry in self._own_entries
        return entry_refusal(self._od, entry, self._receive, any_length=is_own)

    def _attach(self) -> None:
        self._cob_id.writer = self._check_cob_id
        self._type.writer = self._check_transmission_type
        inhibit_time = self._od.get(self.communication, 3)
        if inhibit_time is not None:
            inhibit_time.writer = self._check_inhibit_time
        sync_start = self._od.get(self.communication, 6)
        if sync_start is not None and not self._receive:
            sync_start.writer = self._check_sync_start
        self._count.writer = self._check_count
        for subindex in self._od.subindices(self.mapping):
            variable = self._od.get(self.mapping, subindex)
            if variable is not None and subindex:
                variable.writer = self._check_entry

    def _check_cob_id(self, value: int) -> int:
        if value & UPPER_BITS:
            return AbortCode.INVALID_VALUE
        if value & INVALID:
            return 0
        if is_restricted(value & 0x7FF):
            return AbortCode.INVALID_VALUE
        if self.is_valid() and (self.cob_id() ^ value) & 0x7FF:
            return AbortCode.INVALID_VALUE  # set it invalid first
        return 0

    def _check_transmission_type(self, value: int) -> int:
        # 241..251 are reserved, 252 and 253 (on remote request) are for TPDOs.
        lowest = 254 if self._receive else 252
        return AbortCode.INVALID_VALUE if 240 < value < lowest else 0

    def _check_inhibit_time(self, value: int) -> int:
        if self._receive or not self.is_valid():
            return 0
        changed = value != self.inhibit_100us()
        return AbortCode.INVALID_VALUE if changed else 0  # not while the PDO exists

    def _check_sync_start(self, value: int) -> int:
        if value > COUNTER_MAX or (self.is_valid() and value != self.sync_start()):
            return AbortCode.INVALID_VALUE  # not while the PDO exists
        return 0

    def _check_count(self, value: int) -> int:
        if self.is_valid():
            return AbortCode.UNSUPPORTED_ACCESS
        od = self._od
        subindices = od.subindices(self.mapping)
        if value > min(len(subindices) - 1, MAX_ENTRIES):
            return AbortCode.PDO_TOO_LONG
        bits = 0
        for subindex in subindices[1 : value + 1]:
            entry = od.integer(self.mapping, subindex, 0)
            code = self._refusal(entry)
            if code:
                return code
            bits += entry & 0xFF
        return AbortCode.PDO_TOO_LONG if bits > MAX_BITS else 0

    def _check_entry(self, value: int) -> int:
        if self.is_valid() or self._count.integer() != 0:
            return AbortCode.UNSUPPORTED_ACCESS
        if value == 0:
            return 0  # an unused entry
        return self._refusal(value)
