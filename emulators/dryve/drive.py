"""An igus dryve D1: a CiA 402 drive whose objects are reached through Modbus TCP.

A telegram is function 43 with MEI type 13 ("CANopen gateway"). It reads or writes one object of up
to four bytes. The gateway passes it to the drive inside as an expedited SDO transfer, and returns
the answer of the drive, or an exception for its abort.

The statusword differs from the standard: bit 4 is never set, bit 9 is the input DI7 ("enable"), and
bits 10 and 12 (at rest, homed) are also shown while the power stage is off. Without DI7 the power
stage goes off, and a fault is not reset. 607Bh limits set-points: one outside is not executed.

Choices of this emulator, where no source is known: a write to a read-only object, or with another
length than the object's, is exception 03; csp (8) is not available, as nothing could pace it.

Source: igus, Operating Manual dryve D1 V2.4, pages 104 to 110; igus's sample program of 2020-12-04.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.api import (
    REQUIRED,
    Controller,
    ControllerContext,
    MotorTable,
    Number,
    SettingError,
    TablesByKey,
    can_id_of,
    controller,
    data_of,
    on_own_time,
    pack,
    read,
    setting,
    table,
    whole,
    with_crc,
    word,
)
from motorhil.emulators.canopen.files.eds import read_eds
from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Reader,
    Variable,
)
from motorhil.emulators.cia402.drive import STIMULI, Cia402Drive
from motorhil.emulators.cia402.settings import (
    OWN_EDS,
    DriveTimingTable,
    SwitchesTable,
    out_of_reach,
    read_settings,
)

FUNCTION: Final = 0x2B
MEI: Final = 0x0D
_ERROR: Final = 0x80
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE, _FAILURE = 1, 2, 3, 4
_HEAD: Final = 12  # of a telegram, from the function code to the byte count
_ABSENT_CODES: Final = (0x0602_0000, 0x0609_0011)  # of SDO aborts: no such object, no sub-index
_FAILURE_CODES: Final = 0x0800_0000  # and above
_SHORTEST: Final = 4  # unit, function, checksum

_NODE: Final = 1  # of the drive inside
_REQUEST, _ANSWER = 0x600 + _NODE, 0x580 + _NODE
_UPLOAD, _DOWNLOAD, _DONE, _ABORT = 0x40, 0x23, 0x60, 0x80
_CONTROLWORD, _STATUSWORD, _ERROR_CODE, _MODE, _TARGET = 0x6040, 0x6041, 0x603F, 0x6061, 0x607A
_DEMAND, _INPUTS, _HOMING_STATUS = 0x6062, 0x60FD, 0x2014
_LIMITS: Final = 0x2F7B  # where 607Bh is kept: CiA 402 has another meaning for it
_OBJECTS: Final = (
    *(0x1001, 0x1003, 0x2007, 0x2010, 0x2014, 0x603F, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064),
    *(0x6065, 0x6066, 0x6067, 0x6068, 0x606C, 0x607A, 0x607B, 0x607C, 0x6081, 0x6083, 0x6084),
    *(0x6091, 0x6092, 0x6098, 0x6099, 0x609A, 0x60A8, 0x60C2, 0x60C5, 0x60FD, 0x60FE, 0x60FF),
    0x6502,
)
_D: Final = DataType
_MOVED: Final = {0x607B: _LIMITS}
# Objects that a standard drive lacks: sub-index, type, access, value at power-on.
_OWN: Final = (
    (0x2007, 0, _D.UNSIGNED32, "rw", 0),
    (0x2010, 0, _D.UNSIGNED32, "rw", 0),
    (0x2014, 0, _D.UNSIGNED16, "ro", 0),
    (_LIMITS, 0, _D.UNSIGNED8, "ro", 2),
    (_LIMITS, 1, _D.INTEGER32, "rw", 0),
    (_LIMITS, 2, _D.INTEGER32, "rw", 0),
    (0x6066, 0, _D.UNSIGNED32, "rw", 0),
    (0x6068, 0, _D.UNSIGNED32, "rw", 0),
    (0x60A8, 0, _D.UNSIGNED32, "rw", 0xFB01_0000),  # linear, 100 per mm
    (0x60FE, 0, _D.UNSIGNED32, "rw", 0),
    (0x6092, 1, _D.UNSIGNED32, "rw", 5400),  # 54 mm a turn, as in the maker's sample program
    (0x6092, 2, _D.UNSIGNED32, "rw", 1),
)

_STATE_MASK, _FAULT, _ENABLED, _QUICK_STOP = 0x6F, 0x08, 0x27, 0x07
_VOLTAGE, _REMOTE, _REACHED, _HOMED, _DEVIATION = 0x0010, 0x0200, 0x0400, 0x1000, 0x2000
_MODE_BITS: Final = _REACHED | _HOMED | _DEVIATION
_FOLLOWING_ERROR: Final = 0x8611
_NEW_SET_POINT, _RELATIVE, _RESET, _PP = 0x0010, 0x0040, 0x0080, 1

_ENABLE: Final = 7
_INPUT_NAMES: Final = {f"di{number}": number for number in range(1, 11)}
_FIRST_INPUT: Final = 15  # bit of DI1 in 60FDh, less 1
_INTERLOCK: Final = 0x08  # DI7 in 60FDh, besides its own bit
_POSITIVE, _NEGATIVE = 8, 9
_LIMIT_INPUTS: Final = {_POSITIVE: "positive_limit", _NEGATIVE: "negative_limit"}
# Keys that the drive inside has too.
_SERVO: Final = ("plant", "servo", "oscillator", "initial_position_rad")
_OF_THE_DRIVE: Final = (*_SERVO, "timing", "switches")
_VELOCITY_UNITS: Final = ("position", "rpm")


@final
@dataclass(frozen=True, kw_only=True)
class DryveTable(MotorTable):
    """An igus dryve D1 on a Modbus TCP line of its own."""

    unit: int = whole(REQUIRED, 1, 247, "", "Unit identifier; alone, it heeds any.", example="1")
    timing: DriveTimingTable = table(DriveTimingTable, "Delays of the drive.")
    velocity_unit: str = word(
        "position",
        _VELOCITY_UNITS,
        "unit",
        "Unit of velocities and accelerations: position units per second, or 0.01 rpm.",
    )
    objects: Mapping[str, int] = setting(
        {},
        TablesByKey(
            Number(-(1 << 31), (1 << 32) - 1, is_whole=True),
            "[0-9A-Fa-f]{4}(:[0-9])?",
            "is not an object",
            'like "6065" or "607B:1"',
        ),
        "Power-on values of objects.",
    )
    switches: SwitchesTable = table(SwitchesTable, "Digital inputs along the output.")


def _checked(pdu: bytes) -> int:
    """Return the code of the exception that a telegram deserves by its form, or 0."""
    if pdu[0] != FUNCTION:
        return _ILLEGAL_FUNCTION
    if len(pdu) < _HEAD or pdu[1] != MEI or pdu[2] > 1 or any((*pdu[3:5], *pdu[8:11])):
        return _ILLEGAL_VALUE
    count = pdu[11]
    if not 1 <= count <= 4 or len(pdu) != _HEAD + (count if pdu[2] else 0):
        return _ILLEGAL_VALUE
    return 0 if int.from_bytes(pdu[5:7], "big") in _OBJECTS else _ILLEGAL_ADDRESS


@final
class Dryve:
    """The drive and its gateway; implements `Controller`."""

    def __init__(self, unit: int, drive: Cia402Drive) -> None:
        self.unit: Final = unit
        self.drive: Final = drive
        self._pending = b""  # the telegram that the drive works on
        self._output: list[bytes] = []
        self._inputs = 1 << _ENABLE  # by number
        self._status, self._switches = self._reader(_STATUSWORD), self._reader(_INPUTS)
        for index, reader in (
            (_STATUSWORD, self.statusword),
            (_INPUTS, self.digital_inputs),
            (_HOMING_STATUS, lambda: int(drive.is_homed())),
        ):
            self._variable(index).reader = reader

    def _variable(self, index: int, subindex: int = 0) -> Variable:
        variable = self.drive.od.get(index, subindex)
        assert variable is not None
        return variable

    def _reader(self, index: int) -> Reader:
        reader = self._variable(index).reader
        assert reader is not None
        return reader

    def _is_enabled(self) -> bool:
        return bool(self._inputs >> _ENABLE & 1)

    # --- values read -----------------------------------------------------------------------------

    def statusword(self) -> int:
        """Return 6041h as this drive shows it."""
        word = self._status() & ~(_VOLTAGE | _REMOTE)
        word |= _REMOTE if self._is_enabled() else 0
        if word & _STATE_MASK in (_ENABLED, _QUICK_STOP):
            return word
        word &= ~_MODE_BITS
        if word & _FAULT and self._reader(_ERROR_CODE)() == _FOLLOWING_ERROR:
            return word | _DEVIATION
        word |= _REACHED if self.drive.axis.stands() else 0
        return word | (_HOMED if self.drive.is_homed() else 0)

    def digital_inputs(self) -> int:
        """Return 60FDh: limit switches, DI7, and all ten inputs from bit 16 on."""
        limits = self._switches() & 3
        inputs = self._inputs | (limits >> 1) << _POSITIVE | (limits & 1) << _NEGATIVE
        return limits | (_INTERLOCK if self._is_enabled() else 0) | inputs << _FIRST_INPUT

    # --- telegrams -------------------------------------------------------------------------------

    def _ask_drive(self, pdu: bytes, now_ns: int) -> None:
        """Pass a telegram to the drive, as an SDO request."""
        self._pending = pdu
        index, data = int.from_bytes(pdu[5:7], "big"), pdu[_HEAD:]
        if index == _CONTROLWORD and len(data) == 2:
            data = self._admitted(int.from_bytes(data, "little")).to_bytes(2, "little")
        command = _DOWNLOAD | (4 - len(data)) << 2 if pdu[2] else _UPLOAD
        place = _MOVED.get(index, index).to_bytes(2, "little") + pdu[7:8]
        frame = pack(_REQUEST, bytes((command,)) + place + data.ljust(4, b"\0"))
        self.drive.receive(frame, now_ns)

    def _admitted(self, word: int) -> int:
        """Return a controlword without the bits that the drive ignores now."""
        if not self._is_enabled():
            word &= ~_RESET
        before = self.drive.od.integer(_CONTROLWORD, 0, 0)
        if word & ~before & _NEW_SET_POINT and self._reader(_MODE)() == _PP:
            low, high = (self.drive.od.integer(_LIMITS, which, 0) for which in (1, 2))
            target = self.drive.od.integer(_TARGET, 0, 0)
            target += self._reader(_DEMAND)() if word & _RELATIVE else 0
            if low < high and not low <= target <= high:
                word &= ~_NEW_SET_POINT
        return word

    def _hear_drive(self, now_ns: int) -> None:
        """Turn the answer of the drive into that of the gateway; it has no other messages."""
        for frame in self.drive.take_output():
            self.drive.sent(frame, now_ns)
            if can_id_of(frame) == _ANSWER and self._pending:
                request, self._pending = self._pending, b""
                self._answer(_answer_to(request, data_of(frame)))

    def _answer(self, pdu: bytes) -> None:
        self._output.append(with_crc(bytes((self.unit,)) + pdu))

    # --- Controller ------------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        """Power on."""
        self.drive.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a telegram, as the line delivers it: unit, PDU, checksum."""
        if len(data) < _SHORTEST or data[0] != self.unit or with_crc(data[:-2]) != data:
            return
        pdu = data[1:-2]
        code = _checked(pdu)
        if code:
            self._answer(bytes((pdu[0] | _ERROR, code)))
        else:
            self._ask_drive(pdu, now_ns)
            self._hear_drive(now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Ignore that an own telegram was sent."""
        return False

    def wants_sent(self) -> bool:
        """Return False: `sent` has no effect."""
        return False

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""
        return self.drive.next_deadline_ns()

    def expire(self, now_ns: int) -> None:
        """Process what is due."""
        self.drive.expire(now_ns)
        self._hear_drive(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the telegrams to send now."""
        output, self._output = self._output, []
        return output

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of each event since the last call."""
        return self.drive.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a digital input (di1 to di10), or a physical input of any CiA 402 drive.

        Raises:
            ValueError: the stimulus is unknown, or the value is invalid.
        """
        number = _INPUT_NAMES.get(name)
        if number is None and name not in STIMULI:
            known = ", ".join((*_INPUT_NAMES, *STIMULI))
            raise ValueError(f"there is no stimulus {name!r}; known: {known}")
        if number in _LIMIT_INPUTS:
            name = _LIMIT_INPUTS[number]
        elif number is not None:
            if value not in (0, 1):
                raise ValueError(f"{name} is 0 or 1, not {value}")
            self._inputs = self._inputs & ~(1 << number) | int(value) << number
            if number != _ENABLE:
                return
            name, value = "sto", 1 - value
        self.drive.stimulate(name, value, now_ns)
        self._hear_drive(now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true state at `now_ns`; rad and N m are behind the gear."""
        return self.drive.snapshot(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return None: it hears its line."""
        return None

    def identifiers_revision(self) -> int:
        """Return a constant."""
        return 0


def _answer_to(request: bytes, sdo: bytes) -> bytes:
    """Return the PDU for the SDO answer of the drive."""
    command, asked = sdo[0], request[11]
    if command == _ABORT:
        code = int.from_bytes(sdo[4:8], "little")
        absent, failed = code in _ABSENT_CODES, code >= _FAILURE_CODES
        exception = _ILLEGAL_ADDRESS if absent else _FAILURE if failed else _ILLEGAL_VALUE
        return bytes((FUNCTION | _ERROR, exception))
    data = b"" if command == _DONE else sdo[4 : 8 - (command >> 2 & 3)]
    if len(data) > asked:
        return bytes((FUNCTION | _ERROR, _ILLEGAL_VALUE))
    return request[:11] + bytes((len(data),)) + data


def _dictionary(own: DryveTable) -> ObjectDictionary:
    """Return the objects of the drive inside.

    Raises:
        SettingError: the rig sets an object that the drive does not have, or to a wrong value.
    """
    od = read_eds(OWN_EDS, _NODE).dictionary()
    for index, subindex, data_type, access, value in _OWN:
        od.add(Variable(index, subindex, data_type, access=access, default=value))
    for key, given in own.objects.items():
        number, _, part = key.partition(":")
        place = int(number, 16)
        found = od.get(_MOVED.get(place, place), int(part or "0"))
        if found is None or place not in _OBJECTS:
            raise SettingError(("objects", key), "is not an object of this drive", "take it out")
        try:
            found.set_default(given)
        except (TypeError, ValueError) as error:
            raise SettingError(("objects", key), str(error)) from error
    return od


@controller(api=1, bus_kinds=("modbus_tcp",))
def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: its name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong; names the keys.
    """
    own = read(DryveTable, settings)
    inner = {key: settings[key] for key in _OF_THE_DRIVE if key in settings}
    if own.velocity_unit == "rpm":
        rate = own.motor("").plant.encoder_increments_rev / 6000.0  # 0.01 rpm, and per second
        inner["units"] = {"velocity_unit_inc_s": rate, "acceleration_unit_inc_s2": rate}
    inner |= {"node_id": _NODE, "supported_modes": ["pp", "pv", "hm"]}
    inside = read_settings(inner, context.folder, context.stream())
    events = [("warning", line) for line in out_of_reach(inside.switches, inside.plant)]
    if not inside.oscillator.is_ideal():
        events.append(("info", inside.oscillator.told()))
    drive = Cia402Drive(_dictionary(own), inside, events)
    return on_own_time(Dryve(own.unit, drive), inside.oscillator)
