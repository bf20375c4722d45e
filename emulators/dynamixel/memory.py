"""The control table of one servo: values, access rules, indirect items.

Reads may start and end inside items, and gaps read as 0. Writes are of whole items; a write that is
refused writes nothing. A byte of an indirect data item stands for the byte to which its address
item points.
"""

from collections.abc import Callable, Mapping
from typing import Final, final

from motorhil.emulators.dynamixel.packets import Error
from motorhil.emulators.dynamixel.table import RAM, Item, Model, indirect_blocks, items_of

_KEPT_BY_BACKUP: Final = (
    *("velocity_i", "velocity_p", "position_d", "position_i", "position_p"),
    *("feedforward_2nd", "feedforward_1st", "profile_acceleration", "profile_velocity"),
)


@final
class Memory:
    """The memory of one servo; `memory[name]` is the value of an item.

    Args:
        model: the model of the servo.
        firmware: its firmware version.
        delivered: values as delivered that differ from the model's, by name.
    """

    def __init__(self, model: Model, firmware: int, delivered: Mapping[str, int]) -> None:
        items = items_of(model, firmware)
        self.items: Final = {item.name: item for item in items}
        self._at: Final = {item.address: item for item in items}
        self._blocks: Final = indirect_blocks(model, firmware)
        self._end: Final = max(item.address + item.size for item in items)
        self._delivered: Final = dict(delivered)
        self._bytes = bytearray(self._end)
        self._values: dict[str, int] = {}  # what the bytes of each item say
        self._backup: dict[str, int] = {}
        self.reset(tuple(self.items))

    def __getitem__(self, name: str) -> int:
        return self._values[name]

    def __setitem__(self, name: str, value: int) -> None:
        if self._values.get(name) == value:
            return
        item = self.items[name]
        data = item.pack(value)
        self._bytes[item.address : item.address + item.size] = data
        self._values[name] = item.unpack(data)

    def get(self, name: str, default: int) -> int:
        """Return the value of an item, or the default if this model does not have it."""
        return self[name] if name in self.items else default

    def reset(self, names: tuple[str, ...]) -> None:
        """Set these items as delivered."""
        for name in names:
            self[name] = self._delivered.get(name, self.items[name].initial)

    def power_on(self) -> None:
        """Set the RAM to its defaults, or some of it to the backup."""
        self.reset(tuple(item.name for item in self.items.values() if item.address >= RAM))
        self["backup_ready"] = bool(self._backup)
        if self["startup_configuration"] & 2:
            self._restore(RAM)

    def factory_reset(self, keep: tuple[str, ...]) -> None:
        """Set the EEPROM as delivered by the maker, except for the items to keep."""
        for item in self.items.values():
            if item.address < RAM and item.name not in keep:
                self[item.name] = item.initial

    def store(self) -> None:
        """Store the backup: the EEPROM, gains, profile and indirect addresses."""
        names = [
            item.name
            for item in self.items.values()
            if (item.address < RAM and item.low is not None)
            or item.name in _KEPT_BY_BACKUP
            or item.name.startswith("indirect_address")
        ]
        self._backup = {name: self[name] for name in names}
        self["backup_ready"] = 1

    def restore(self) -> bool:
        """Restore the EEPROM from the backup; return False without one."""
        self._restore(0)
        return bool(self._backup)

    def _restore(self, first: int) -> None:
        for name, value in self._backup.items():
            if self.items[name].address >= first:
                self[name] = value

    def read(self, address: int, length: int) -> bytes | None:
        """Return the bytes from an address on; None beyond the table."""
        if address + length > self._end:
            return None
        end = address + length
        if all(end <= data or data + count <= address for _, data, count in self._blocks):
            return bytes(self._bytes[address:end])
        return bytes(self._bytes[self._target(place)] for place in range(address, end))

    def write(
        self,
        address: int,
        data: bytes,
        check: Callable[[Item, int], Error],
        written: Callable[[Mapping[str, int]], None],
    ) -> Error:
        """Write whole items, unless `check` refuses one; return the error.

        `written` gets the new values by name, once they are in the memory.
        """
        bytes_at = {self._target(address + n): byte for n, byte in enumerate(data)}
        values: dict[str, int] = {}
        for place in sorted(bytes_at):
            item = self._item_over(place)
            if item is None:
                return Error.ACCESS
            if item.name in values:
                continue
            places = range(item.address, item.address + item.size)
            is_whole = all(one in bytes_at for one in places)
            own = bytes(bytes_at.get(one, 0) for one in places)
            value = item.unpack(own)
            error = check(item, value)
            if error is Error.ACCESS or is_whole:
                if error is not Error.NONE:
                    return error
            else:
                return Error.DATA_LENGTH
            values[item.name] = value
        for name, value in values.items():
            self[name] = value
        written(values)
        return Error.NONE

    def _item_over(self, place: int) -> Item | None:
        for start in range(place, max(place - 4, -1), -1):
            item = self._at.get(start)
            if item is not None:
                return item if place < start + item.size else None
        return None

    def _target(self, place: int) -> int:
        """Return the address for which a byte stands."""
        for address, data, count in self._blocks:
            if data <= place < data + count:
                at = address + 2 * (place - data)
                return int.from_bytes(self._bytes[at : at + 2], "little")
        return place
