"""PDO configuration of a drive by SDO (CiA 301: PDO mapping procedure).

PDOs that are already configured are left unchanged, so that a second program on the same drive
disturbs no other. Only differences are written, and then in PRE-OPERATIONAL.
"""

from collections.abc import Sequence
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.canopen.node import CanopenNode

SYNCHRONOUS: Final = 1  # acts at the next SYNC
EVENT_DRIVEN: Final = 255

_INVALID: Final = 0x8000_0000
_NO_RTR: Final = 0x4000_0000
_SLOTS: Final = 4


@final
@frozen
class PdoWish:
    """One requested PDO; `number` counts from 1; times as in the object (100 us, ms)."""

    transmit: bool
    number: int
    mapping: tuple[int, ...]
    transmission: int
    inhibit_100us: int = 0
    event_ms: int = 0

    @property
    def name(self) -> str:
        """The name in messages."""
        return f"{'TPDO' if self.transmit else 'RPDO'} {self.number}"

    @property
    def communication(self) -> int:
        """The index of its communication parameter."""
        return (0x1800 if self.transmit else 0x1400) + self.number - 1


@final
@frozen
class PdoFound:
    """One PDO of the drive; `inhibit_100us` and `event_ms` are None if the object is missing."""

    cob_id: int
    transmission: int
    mapping: tuple[int, ...]
    inhibit_100us: int | None
    event_ms: int | None

    @property
    def is_valid(self) -> bool:
        """True if the drive uses the PDO."""
        return not self.cob_id & _INVALID

    def fulfils(self, wish: PdoWish) -> bool:
        """Return whether the PDO is as requested, so that nothing has to be written."""
        return (
            self.is_valid
            and self.mapping == wish.mapping
            and self.transmission == wish.transmission
            and self.inhibit_100us in (None, wish.inhibit_100us)
            and self.event_ms in (None, wish.event_ms)
        )


def find_pdo(node: CanopenNode, *, transmit: bool, number: int) -> PdoFound | None:
    """Return a PDO of the drive, or None if it has none of that number."""
    index = (0x1800 if transmit else 0x1400) + number - 1
    cob_id = node.read_optional(index, 1)
    if cob_id is None:
        return None
    transmission = node.read_optional(index, 2)
    count = node.read_optional(index + 0x200, 0)
    mapping = tuple(
        node.read_optional(index + 0x200, place) or 0 for place in range(1, (count or 0) + 1)
    )
    return PdoFound(
        cob_id=cob_id,
        transmission=EVENT_DRIVEN if transmission is None else transmission,
        mapping=mapping,
        inhibit_100us=node.read_optional(index, 3) if transmit else None,
        event_ms=node.read_optional(index, 5) if transmit else None,
    )


@final
class PdoSetUp:
    """The configuration of a drive's PDOs, one by one; `finish` starts the node.

    Attributes:
        refusals: the settings that the drive refused, in words.
    """

    def __init__(self, node: CanopenNode) -> None:
        self._node = node
        self._paused = False
        self.refusals: list[str] = []

    def configure(self, wish: PdoWish) -> tuple[int, PdoFound] | None:
        """Return (identifier, resulting PDO), or None if the drive does not allow it."""
        node = self._node
        found = find_pdo(node, transmit=wish.transmit, number=wish.number)
        if found is None:
            self.refusals.append(f"it has no {wish.name}")
            return None
        can_id = self._identifier(wish, found)
        if found.fulfils(wish):
            return can_id, found
        self._pause()
        try:
            self._write(wish, found, can_id)
        except SdoAborted as error:
            self.refusals.append(f"{wish.name} cannot be mapped: {error}")
            self._try_to_restore(wish, found)
            return None
        now = PdoFound(
            cob_id=can_id,
            transmission=wish.transmission,
            mapping=wish.mapping,
            inhibit_100us=None if found.inhibit_100us is None else wish.inhibit_100us,
            event_ms=None if found.event_ms is None else wish.event_ms,
        )
        return can_id, now

    def switch_off(self, number: int, *, keep: int | None) -> None:
        """Disable this TPDO of the drive, unless its identifier is `keep`."""
        index = 0x1800 + number - 1
        cob_id = self._node.read_optional(index, 1)
        if cob_id is None or cob_id & _INVALID or cob_id & 0x7FF == keep:
            return
        self._pause()
        try:
            self._download(index, 1, cob_id | _INVALID, 4)
        except SdoAborted as error:
            self.refusals.append(f"TPDO {number} stays on: {error}")

    def finish(self) -> None:
        """Start the node (OPERATIONAL), and so its PDOs."""
        self._node.bus.nmt(0x01, self._node.node_id)

    def _pause(self) -> None:
        if not self._paused:
            self._node.sdo.check_writing()
            self._paused = True
            self._node.bus.nmt(0x80, self._node.node_id)

    def _identifier(self, wish: PdoWish, found: PdoFound) -> int:
        """Return the identifier of the PDO, or the predefined one (CiA 301) if it is invalid."""
        can_id = found.cob_id & 0x7FF
        if 0x181 <= can_id <= 0x57F:
            return can_id
        base = 0x180 if wish.transmit else 0x200
        return base + (wish.number - 1) * 0x100 + self._node.node_id

    def _write(self, wish: PdoWish, found: PdoFound, can_id: int) -> None:
        index = wish.communication
        flags = found.cob_id & _NO_RTR
        if found.is_valid:
            self._download(index, 1, can_id | flags | _INVALID, 4)
        if found.transmission != wish.transmission:
            self._download(index, 2, wish.transmission, 1)
        if found.inhibit_100us not in (None, wish.inhibit_100us):
            self._download(index, 3, wish.inhibit_100us, 2)
        if found.event_ms not in (None, wish.event_ms):
            self._download(index, 5, wish.event_ms, 2)
        if found.mapping != wish.mapping:
            self._map(index + 0x200, wish.mapping)
        self._download(index, 1, can_id | flags, 4)

    def _map(self, index: int, mapping: Sequence[int]) -> None:
        self._download(index, 0, 0, 1)
        for place, entry in enumerate(mapping, 1):
            self._download(index, place, entry, 4)
        self._download(index, 0, len(mapping), 1)

    def _try_to_restore(self, wish: PdoWish, found: PdoFound) -> None:
        """Restore the previous PDO, as far as the drive allows."""
        index = wish.communication
        try:
            self._map(index + 0x200, found.mapping)
            self._download(index, 2, found.transmission, 1)
            self._download(index, 1, found.cob_id, 4)
        except SdoAborted as error:
            self.refusals.append(f"{wish.name} is left switched off: {error}")

    def _download(self, index: int, subindex: int, value: int, size: int) -> None:
        self._node.sdo.download(index, subindex, value.to_bytes(size, "little"))


def usable_as_it_is(node: CanopenNode, wanted: Sequence[int]) -> tuple[int, PdoFound] | None:
    """Return (identifier, TPDO) of an event-driven TPDO that contains all of `wanted`."""
    for number in range(1, _SLOTS + 1):
        found = find_pdo(node, transmit=True, number=number)
        if found is None or not found.is_valid or found.transmission < 254:
            continue
        if all(entry in found.mapping for entry in wanted):
            return found.cob_id & 0x7FF, found
    return None
