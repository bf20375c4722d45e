"""Storing and restoring parameters (CiA 301, 1010h and 1011h).

"save" written to 1010h:n stores the present values: all (1), of communication (2: 1000h to 1FFFh),
of the application (3: 6000h to 9FFFh), of the manufacturer (4 and above: 2000h to 5FFFh). They are
the power-on values from then on. "load" written to 1011h:n deletes the stored values. "load" takes
effect after the next reset of the node, or of communication for communication parameters. Any other
signature is refused with 0800 0020h, without any effect.

Only values that differ from the device's own defaults are stored, so an unchanged COB-ID still
follows the node-ID. Set-points and commands are not parameters and are not stored.

The text format is readable and protected by a CRC:

    motorhil parameters 1
    identity 00000000 00000402      vendor-ID and product code (1018h:1, 1018h:2)
    node_id 5                       if LSS has stored one; 255: none
    bit_timing 0                    its index in CiA 305's table 0
    1017:00 6400                    a value in its wire format
    end 1 1A2B3C4D                  number of values, and the CRC-32 of all lines before

A text that ends early, was changed by hand, or belongs to another device is refused as a whole.
"""

import zlib
from typing import Final, final

from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Variable,
    decode,
    encode,
)
from motorhil.emulators.canopen.outbox import Outbox
from motorhil.emulators.controller import NonvolatileMemory

_FIRST: Final = "motorhil parameters 1"
UNSET: Final = -1
_NODE_IDS: Final = (*range(1, 128), 255)
_BIT_TIMING_MAX: Final = 9  # CiA 305's table 0

SAVE: Final = 0x6576_6173  # "save", little-endian
LOAD: Final = 0x6461_6F6C  # "load"
ON_COMMAND: Final = 1  # value of 1010h and 1011h without a stated one: on command

_ALL: Final = (0x1000, 0xFFFF)
_RANGES: Final = (_ALL, (0x1000, 0x1FFF), (0x6000, 0x9FFF))  # of sub-indices 1 to 3
_MANUFACTURER: Final = (0x2000, 0x5FFF)
_LAST: Final = 0x7F

# Errors, commands, set-points of CiA 402, outputs of CiA 401, counters' presets.
_NO_PARAMETERS: Final = (
    *(0x1001, 0x1003, 0x1010, 0x1011),
    *(0x6040, 0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1, 0x60FE, 0x60FF),
    *(0x6200, 0x6411, 0x6810),
)


@final
class StoredParameters:
    """The parameters that a device has stored.

    Attributes:
        identity: vendor-ID and product code.
        values: (index << 8 | sub-index) -> bytes as on the wire, in order of their places.
        node_id, bit_timing: set by LSS; UNSET if not stored.
    """

    def __init__(self, identity: tuple[int, int]) -> None:
        self.identity = identity
        self.values: dict[int, bytes] = {}
        self.node_id: int = UNSET
        self.bit_timing: int = UNSET

    def write(self) -> bytes:
        """Return the parameters as text."""
        lines = [_FIRST, self._identity()]
        if self.node_id != UNSET:
            lines.append(f"node_id {self.node_id}")
        if self.bit_timing != UNSET:
            lines.append(f"bit_timing {self.bit_timing}")
        for place in sorted(self.values):
            value = self.values[place].hex().upper()
            lines.append(f"{place >> 8:04X}:{place & 0xFF:02X} {value}")
        text = "\n".join(lines) + "\n"
        return f"{text}end {len(self.values)} {zlib.crc32(text.encode()):08X}\n".encode()

    def read(self, data: bytes) -> str:
        """Read all parameters from the text; return "", or the reason of a refusal."""
        lines = data.decode("latin-1").splitlines()
        if not lines or lines[0] != _FIRST:
            return f"it does not begin with {_FIRST!r}"
        last = lines[-1].split(" ")
        checked = data[: data.rfind(b"end ")]
        if last[0] != "end" or len(last) != 3 or not data.endswith(b"\n"):
            return "it ends early"
        if last[2] != f"{zlib.crc32(checked):08X}":
            return "it is damaged, or was changed by hand (its CRC is wrong)"
        identity = self._identity()
        if len(lines) < 3 or lines[1] != identity:
            return f"it is another device's: {lines[1]!r}, here {identity!r}"
        for line in lines[2:-1]:
            try:
                self._read_line(line)
            except ValueError:
                return f"{line!r} in it is no stored value"
        return ""

    def begins(self, data: bytes) -> bool:
        """Return whether the text is this device's, as far as it goes: whole, torn or empty.

        Some file systems leave zeros after a power failure during a write.
        """
        first = f"{_FIRST}\n{self._identity()}\n".encode()
        return data.startswith(first) or first.startswith(data) or not data.strip(b"\0")

    def _identity(self) -> str:
        return f"identity {self.identity[0]:08X} {self.identity[1]:08X}"

    def _read_line(self, line: str) -> None:
        """Read one of the lines between header and end.

        Raises:
            ValueError: the line is malformed.
        """
        key, _, value = line.partition(" ")
        if key == "node_id":
            self.node_id = int(value)
            if self.node_id not in _NODE_IDS:
                raise ValueError(value)
        elif key == "bit_timing":
            self.bit_timing = int(value)
            if not UNSET < self.bit_timing < _BIT_TIMING_MAX:
                raise ValueError(value)
        else:
            index, _, subindex = key.partition(":")
            self.values[int(index, 16) << 8 | int(subindex, 16)] = bytes.fromhex(value)


@final
class ParameterStore:
    """The parameters that a device keeps without power."""

    def __init__(self, od: ObjectDictionary, memory: NonvolatileMemory, outbox: Outbox) -> None:
        self._od = od
        self._memory = memory
        self._outbox = outbox
        self.stored: StoredParameters = StoredParameters((0, 0))
        self._is_foreign: bool = False  # the stored data belong to another device: do not overwrite
        for index, signature in ((0x1010, SAVE), (0x1011, LOAD)):
            for subindex in od.subindices(index):
                variable = od.get(index, subindex)
                is_only = len(od.subindices(index)) == 1
                if variable is not None and (subindex or is_only):
                    stated = variable.integer() if variable.has_default else ON_COMMAND
                    command = _Command(self, signature, subindex, stated)
                    variable.reader = command.read
                    variable.writer = command.write

    def load(self) -> None:
        """Load and report the stored values at power-on; leave out unreadable ones."""
        identity = (self._od.integer(0x1018, 1, 0), self._od.integer(0x1018, 2, 0))
        self.stored = StoredParameters(identity)
        data = self._memory.load()
        self._is_foreign = False
        if not data:
            return
        where = self._memory.where()
        wrong = self.stored.read(data)
        if wrong:
            self._is_foreign = not self.stored.begins(data)
            remedy = "it stays as it is, name another" if self._is_foreign else "save again (1010h)"
            self._tell("warning", f"{where} is left out, {wrong}; {remedy}")
            self.stored = StoredParameters(identity)
            return
        self._drop_what_does_not_fit(where)
        count, crc = len(self.stored.values), zlib.crc32(data)
        self._tell("info", f"{count} stored values, of {where} (CRC {crc:08X})")

    def apply(self, first: int, last: int) -> None:
        """Apply stored values to the indices `first`..`last`, which have just become defaults."""
        for place, data in self.stored.values.items():
            variable = self._od.get(place >> 8, place & 0xFF)
            if variable is not None and first <= variable.index <= last:
                variable.value = decode(variable.data_type, data)

    def save(self, subindex: int) -> int:
        """Store the present values of this sub-index of 1010h; return 0 or the abort code."""
        return self._change(subindex, keep=True)

    def restore(self, subindex: int) -> int:
        """Delete the stored values of this sub-index of 1011h; return 0 or the abort code."""
        return self._change(subindex, keep=False)

    def save_lss(self, node_id: int, bit_timing: int) -> bool:
        """Store the LSS configuration; return False if that is impossible."""
        stored = self.stored
        before = (stored.node_id, stored.bit_timing)
        stored.node_id, stored.bit_timing = node_id, bit_timing
        if self._is_written():
            return True
        stored.node_id, stored.bit_timing = before
        return False

    def _change(self, subindex: int, keep: bool) -> int:
        first, last = _range_of(subindex)
        before = self.stored.values
        values = {place: data for place, data in before.items() if not first <= place >> 8 <= last}
        if keep:
            for variable in self._od:
                is_meant = first <= variable.index <= last and _is_parameter(variable)
                if is_meant and variable.value != variable.default:
                    data = encode(variable.data_type, variable.value)
                    values[variable.index << 8 | variable.subindex] = data
        self.stored.values = values
        if not self._is_written():
            self.stored.values = before
            return AbortCode.HARDWARE_ERROR
        return 0

    def _is_written(self) -> bool:
        """Write all stored values to the nonvolatile memory and return whether that succeeded."""
        if not self._is_foreign and self._memory.save(self.stored.write()):
            return True
        why = "is not this device's" if self._is_foreign else "cannot be written"
        self._tell("warning", f"nothing is stored, {self._memory.where()} {why}")
        return False

    def _drop_what_does_not_fit(self, where: str) -> None:
        fitting: dict[int, bytes] = {}
        for place, data in self.stored.values.items():
            variable = self._od.get(place >> 8, place & 0xFF)
            if variable is not None and _fits(variable, data):
                fitting[place] = data
            else:
                name = f"{place >> 8:04X}h:{place & 0xFF:02X}h"
                self._tell(
                    "warning", f"{where}: {name} = {data.hex()} does not fit and is left out"
                )
        self.stored.values = fitting

    def _tell(self, level: str, text: str) -> None:
        self._outbox.events.append((level, text))


@final
class _Command:
    """One sub-index of 1010h or 1011h."""

    def __init__(self, store: ParameterStore, signature: int, subindex: int, stated: int) -> None:
        self._store = store
        self._signature = signature
        self._subindex = subindex
        self._stated = stated  # by the file: how the device stores or restores

    def read(self) -> int:
        return self._stated

    def write(self, value: int) -> int:
        if value != self._signature:
            return AbortCode.NOT_STORED
        if self._signature == SAVE:
            return self._store.save(self._subindex)
        return self._store.restore(self._subindex)


def _range_of(subindex: int) -> tuple[int, int]:
    """Return the first and last index that belong to a sub-index of 1010h and 1011h."""
    if subindex > _LAST or subindex == 0:
        return _ALL
    return _RANGES[subindex - 1] if subindex <= len(_RANGES) else _MANUFACTURER


def _is_parameter(variable: Variable) -> bool:
    return (
        variable.is_writable()
        and variable.is_readable()
        and variable.data_type != DataType.DOMAIN
        and variable.index not in _NO_PARAMETERS
    )


def _fits(variable: Variable, data: bytes) -> bool:
    if variable.bits and len(data) != (variable.bits + 7) // 8:
        return False
    value = decode(variable.data_type, data)
    if not isinstance(value, int):
        return _is_parameter(variable)
    is_low = variable.low is not None and value < variable.low
    is_high = variable.high is not None and value > variable.high
    return _is_parameter(variable) and not is_low and not is_high
