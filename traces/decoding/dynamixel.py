"""Packets of Dynamixel Protocol 2.0 in words: instructions, and statuses by what was asked.

Names of items are those of the X series. A status is understood by the last read of its servo, so
a recording is decoded in order. In a fast read each servo adds a block to one packet; the first
block follows the header.

Source: the maker's manual of Protocol 2.0.
"""

from collections.abc import Callable
from typing import Final, final

from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Layout, Signal

_HEADER: Final = b"\xff\xff\xfd\x00"
_HEAD: Final = 7  # bytes up to the length
_MARK: Final = _HEADER[:3]
_STATUS: Final = 0x55
_BROADCAST: Final = 0xFE
_ALERT: Final = 0x80
_NAMES: Final = {
    **{0x01: "Ping", 0x02: "Read", 0x03: "Write", 0x04: "Reg_Write", 0x05: "Action"},
    **{0x06: "Factory_Reset", 0x08: "Reboot", 0x10: "Clear", 0x20: "Control_Table_Backup"},
    **{0x82: "Sync_Read", 0x83: "Sync_Write", 0x8A: "Fast_Sync_Read"},
    **{0x92: "Bulk_Read", 0x93: "Bulk_Write", 0x9A: "Fast_Bulk_Read"},
}
_PING, _READ, _FAST = 0x01, 0x02, (0x8A, 0x9A)
_WRITES: Final = (0x03, 0x04)
_SYNC_READS, _SYNC_WRITE = (0x82, 0x8A), 0x83
_BULK_READS, _BULK_WRITE = (0x92, 0x9A), 0x93
_ERRORS: Final = (
    *("none", "Result_Fail", "Instruction", "CRC", "Data_Range", "Data_Length", "Data_Limit"),
    "Access",
)


_RPM: Final = "i32*0.2288818359375 rpm"  # 15.625 counts/s
_LAYOUT: Final = Layout(
    f"""
    @0 Model_Number i16; @6 Firmware_Version u8; ID u8; Baud_Rate u8; Return_Delay_Time u8*2 us;
    Drive_Mode u8; Operating_Mode u8; Secondary_ID u8; @20 Homing_Offset i32 count;
    Moving_Threshold {_RPM}; @31 Temperature_Limit u8 deg C; Max_Voltage_Limit i16*0.1 V;
    Min_Voltage_Limit i16*0.1 V; PWM_Limit i16; Current_Limit i16; @44 Velocity_Limit {_RPM};
    Max_Position_Limit i32 count; Min_Position_Limit i32 count; @60 Startup_Configuration u8;
    @63 Shutdown u8; Torque_Enable u8; LED u8; @68 Status_Return_Level u8;
    Registered_Instruction u8; Hardware_Error_Status u8; @98 Bus_Watchdog u8; @100 Goal_PWM i16;
    Goal_Current i16; Goal_Velocity {_RPM}; Profile_Acceleration i32; Profile_Velocity i32;
    Goal_Position i32 count; Realtime_Tick i16 ms; Moving u8; Moving_Status u8; Present_PWM i16;
    Present_Current i16; Present_Velocity {_RPM}; Present_Position i32 count;
    Velocity_Trajectory {_RPM}; Position_Trajectory i32 count; Present_Input_Voltage i16*0.1 V;
    Present_Temperature u8 deg C; Backup_Ready u8
    """
)
_ITEMS: Final = _LAYOUT.items


def build(node_id: int) -> Callable[[bytes], BusMessage | None]:
    """Return the decoder of the packets from and to one servo."""
    return _Servo(node_id).decode


def unit_of(data: bytes) -> int:
    """Return the id in a packet; 0 if these bytes do not begin one."""
    return data[4] if data.startswith(_HEADER) and len(data) > 4 else 0


@final
class Packets:
    """Bytes on a line, cut into packets."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the packets that these bytes complete.

        A sender begins each packet anew: if these bytes begin with a header, the rest is dropped.
        """
        rest = data if data.startswith(_HEADER) else self._rest + data
        found = list[bytes]()
        while (place := rest.find(_HEADER)) >= 0:
            rest = rest[place:]
            end = _HEAD + int.from_bytes(rest[_HEAD - 2 : _HEAD], "little")
            if len(rest) < max(end, _HEAD):
                break
            found.append(rest[:end])
            rest = rest[end:]
        self._rest = rest if place >= 0 else rest[1 - len(_HEADER) :]
        return found


@final
class _Servo:
    """Record of the requests to one servo."""

    def __init__(self, unit: int) -> None:
        self._unit = unit
        self._asked: tuple[int, int] | None = None  # address and length; None: a ping, or nothing
        self._is_fast = False
        self._is_ping = False

    def decode(self, data: bytes) -> BusMessage | None:
        """Return the message in the bytes of one sender, or None if it does not concern it."""
        if not data.startswith(_HEADER) or len(data) < 10:
            is_block = self._is_fast and len(data) >= 4 and data[1] == self._unit
            return self._block(data[:-2]) if is_block else None
        unit, instruction = data[4], data[7]
        if unit == _BROADCAST and instruction == _STATUS:
            return self._block(data[8:-2]) if data[9:10] == bytes((self._unit,)) else None
        if unit not in (self._unit, _BROADCAST):
            return None
        length = int.from_bytes(data[5:7], "little")
        name = "Status" if instruction == _STATUS else _NAMES.get(instruction, "")
        name = name or f"Instruction_{instruction:02X}h"
        if len(data) != _HEAD + length:
            return BusMessage(name, problem=f"{len(data)} bytes; {_HEAD + length} are announced")
        if _crc16(data[:-2]) != data[-2:]:
            return BusMessage(name, problem="wrong CRC")
        parameters = data[8:-2].replace(_MARK + b"\xfd", _MARK)
        if instruction == _STATUS:
            return self._status(parameters)
        return self._instruction(name, instruction, parameters)

    def _instruction(self, name: str, code: int, data: bytes) -> BusMessage | None:
        self._is_fast, self._is_ping = code in _FAST, code == _PING
        self._asked = None
        if code == _READ and len(data) == 4:
            self._asked = _word(data, 0), _word(data, 2)
            return BusMessage(name, tuple(_named(*self._asked)))
        if code in _WRITES and len(data) > 2:
            return BusMessage(name, tuple(_values(_word(data, 0), data[2:])))
        if code in _SYNC_READS or code == _SYNC_WRITE:
            return self._sync(name, code, data)
        if code in _BULK_READS or code == _BULK_WRITE:
            return self._bulk(name, code, data)
        return BusMessage(name, (Signal("Data", data.hex(" ").upper(), ""),) if data else ())

    def _sync(self, name: str, code: int, data: bytes) -> BusMessage | None:
        if len(data) < 4:
            return BusMessage(name, problem=f"{len(data)} bytes of parameters; 4 are needed")
        address, length = _word(data, 0), _word(data, 2)
        step = 1 + length if code == _SYNC_WRITE else 1
        for at in range(4, len(data), step):
            if data[at] == self._unit and code == _SYNC_WRITE:
                return BusMessage(name, tuple(_values(address, data[at + 1 : at + step])))
            if data[at] == self._unit:
                self._asked = address, length
                return BusMessage(name, tuple(_named(address, length)))
        return None

    def _bulk(self, name: str, code: int, data: bytes) -> BusMessage | None:
        at = 0
        while at + 5 <= len(data):
            address, length = _word(data, at + 1), _word(data, at + 3)
            mine = data[at] == self._unit
            at += 5
            if mine and code == _BULK_WRITE:
                return BusMessage(name, tuple(_values(address, data[at : at + length])))
            if mine:
                self._asked = address, length
                return BusMessage(name, tuple(_named(address, length)))
            at += length if code == _BULK_WRITE else 0
        return None

    def _block(self, data: bytes) -> BusMessage | None:
        """Return the block of a fast read: error, id, data."""
        return self._status(data[:1] + data[2:], "Fast_Status")

    def _status(self, data: bytes, name: str = "Status") -> BusMessage:
        if not data:
            return BusMessage(name, problem="no error byte")
        error = data[0] & ~_ALERT
        told = _ERRORS[error] if error < len(_ERRORS) else f"{error:02X}h"
        signals = [Signal("Error", told, "")] if error else []
        signals += [Signal("Alert", 1, "")] if data[0] & _ALERT else []
        if self._is_ping and len(data) == 4:
            model = Signal("Model_Number", _word(data, 1), "")
            signals += [model, Signal("Firmware_Version", data[3], "")]
        elif self._asked is not None and len(data) == 1 + self._asked[1]:
            signals += _values(self._asked[0], data[1:])
        elif len(data) > 1:
            signals += [Signal("Data", data[1:].hex(" ").upper(), "")]
        return BusMessage(name, tuple(signals))


def _word(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 2], "little")


def _named(address: int, length: int) -> list[Signal]:
    """Return what is read, without values."""
    item = _ITEMS.get(address)
    first = f"{address}" if item is None else item.name
    return [Signal("From", first, ""), Signal("Length", length, "")]


def _values(address: int, data: bytes) -> list[Signal]:
    """Return the items in the bytes from an address on."""
    signals, at = list[Signal](), 0
    while at < len(data):
        item = _ITEMS.get(address + at)
        if item is None or at + item.size > len(data):
            end = next((n for n in range(at + 1, len(data)) if address + n in _ITEMS), len(data))
            shown = data[at:end].hex(" ").upper()
            signals.append(Signal(f"Address_{address + at}", shown, ""))
            at = end
            continue
        value = _LAYOUT.value(item._replace(at=at), data)
        signals.append(Signal(item.name, value, item.unit))
        at += item.size
    return signals


def _crc16(data: bytes) -> bytes:
    """Return the CRC-16 with polynomial 8005h, not reflected."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x8005 if crc & 0x8000 else 0)) & 0xFFFF
    return crc.to_bytes(2, "little")
