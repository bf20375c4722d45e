"""Contents of PDOs, learned from recorded SDO traffic or an EDS.

The identifier of each node's SYNC is learned too. Without either source the COB-ID is that of the
pre-defined connection set, and the objects are unknown: nothing is guessed.

Source: CiA 301, PDO communication parameter and mapping parameter, pre-defined connection set,
COB-ID SYNC message (1005h).
"""

from typing import Final, final

PdoKey = tuple[int, bool, int]
"""Node, True if the node transmits it, number from 1."""

Entry = tuple[int, int, int]
"""Index, sub-index, bits."""

_INVALID: Final = 0x8000_0000
_ID_MASK: Final = 0x1FFF_FFFF
_SYNC: Final = 0x080


@final
class PdoMaps:
    """The PDOs of all nodes on a bus.

    Attributes:
        version: changes whenever the answers of `of` or `objects` can change.
    """

    def __init__(self) -> None:
        self.version: int = 0
        self._identifiers: dict[PdoKey, int | None] = {}  # None: switched off
        self._entries: dict[PdoKey, dict[int, int]] = {}
        self._counts: dict[PdoKey, int] = {}
        self._types: dict[PdoKey, int] = {}
        self._by_identifier: dict[int, list[PdoKey]] = {}
        self._objects: dict[PdoKey, list[Entry] | None] = {}
        self._syncs: dict[int, int] = {}  # by node, if known

    def learn(self, node: int, index: int, subindex: int, value: int) -> None:
        """Learn from the value of a PDO parameter or of 1005h; ignore other objects."""
        if index == 0x1005 and subindex == 0:
            self._syncs[node] = value & _ID_MASK
        if not 0x1400 <= index < 0x1C00:
            return
        self.version += 1
        key = (node, index >= 0x1800, (index & 0x1FF) + 1)
        if index & 0x200:
            self._objects.pop(key, None)
            if subindex == 0:
                self._counts[key] = value
            else:
                self._entries.setdefault(key, {})[subindex] = value
        elif subindex == 1:
            self._identifiers[key] = None if value & _INVALID else value & _ID_MASK
            self._by_identifier.clear()
        elif subindex == 2:
            self._types[key] = value

    def forget(self, node: int) -> None:
        """Forget what was learned about a node, because it was reset."""
        self.version += 1
        for known in (self._identifiers, self._entries, self._counts, self._types):
            for key in [key for key in known if key[0] == node]:
                del known[key]
        self._syncs.pop(node, None)
        self._by_identifier.clear()
        self._objects.clear()

    def of(self, identifier: int) -> list[PdoKey]:
        """Return the PDOs with this identifier: a node's TPDO, or the RPDOs of all receivers."""
        found = self._by_identifier.get(identifier)
        if found is None:
            found = [key for key, own in self._identifiers.items() if own == identifier]
            usual = predefined(identifier)
            if usual is not None and not found and usual not in self._identifiers:
                found = [usual]
            if len(self._by_identifier) > 4096:
                self._by_identifier.clear()
            self._by_identifier[identifier] = found
        return found

    def sync_of(self, node: int) -> int:
        """Return the identifier of the SYNC that this node uses."""
        return self._syncs.get(node, _SYNC)

    def is_sync(self, identifier: int) -> bool:
        """Return True if the identifier is the SYNC of any node."""
        return identifier == _SYNC or identifier in self._syncs.values()

    def received_by(self, node: int) -> list[int]:
        """Return the known identifiers of the PDOs that a node receives."""
        own = [
            identifier
            for (number, is_sent, _), identifier in self._identifiers.items()
            if number == node and not is_sent and identifier is not None
        ]
        usual = [(function << 7) + node for function in (4, 6, 8, 10)]
        heard = [one for one in usual if any(key[:2] == (node, False) for key in self.of(one))]
        return sorted({*own, *heard})

    def transmission_type(self, key: PdoKey) -> int | None:
        """Return the transmission type: 0 to 240 synchronous; None: unknown."""
        return self._types.get(key)

    def objects(self, key: PdoKey) -> list[Entry] | None:
        """Return the mapped objects in order; None if unknown."""
        if key not in self._objects:
            self._objects[key] = self._listed(key)
        return self._objects[key]

    def _listed(self, key: PdoKey) -> list[Entry] | None:
        entries = self._entries.get(key)
        count = self._counts.get(key)
        if count is None and entries:
            count = len(entries)
        if not count:
            return None
        told = [(entries or {}).get(number) for number in range(1, count + 1)]
        if None in told:
            return None
        return [(value >> 16, value >> 8 & 0xFF, value & 0xFF) for value in told if value]

    def layout(self, identifier: int) -> tuple[list[tuple[PdoKey, int, Entry]], bool]:
        """Return the objects in PDOs of this identifier, each with its first bit.

        The second result is True if some of the mappings are unknown.
        """
        found: list[tuple[PdoKey, int, Entry]] = []
        unknown = False
        for key in self.of(identifier):
            entries = self.objects(key)
            unknown = unknown or entries is None
            at = 0
            for entry in entries or ():
                found.append((key, at, entry))
                at += entry[2]
        return found, unknown


def predefined(identifier: int) -> PdoKey | None:
    """Return the PDO of an identifier in the pre-defined connection set; None if it has none."""
    node, function = identifier & 0x7F, identifier >> 7
    if not node or not 3 <= function <= 10:
        return None
    return node, function % 2 == 1, (function - 1) // 2
