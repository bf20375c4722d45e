"""One Modbus drive as a hardware object has it: its registers, and who may command it.

Between processes two locks keep order, as on CAN: one says who may command the drive, one keeps
the exchanges on its line apart.
"""

from collections.abc import Hashable
from typing import TYPE_CHECKING, Final, final

from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from motorapi.adaptations.modbus_answers import Exchange
from motorapi.adaptations.modbus_errors import ModbusProtocolViolation, is_silence
from motorapi.adaptations.modbus_line import ByteLine, ModbusLine
from motorapi.errors import DeadlineExceeded, LinkError, MotorError, PeerError, UsageError
from motorapi.lock_names import line_name
from motorapi.process_lock import ProcessLock, can_share_time
from motorapi.sharing import register_physical_motor, release_physical_motor

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

    from motorapi.fencing import Owned
    from motorapi.runtime import Runtime

_LINES: Final[dict[int, ModbusLine]] = {}  # by id(line), which stays its own while we hold it


def _open(line: ByteLine, runtime: "Runtime") -> ModbusLine:
    known = _LINES.get(id(line))
    if known is None:
        where = line_name(line) if can_share_time(runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-exchange", f"the line {line.name}")
        known = _LINES[id(line)] = ModbusLine(line, runtime, lock)
    known.users += 1
    return known


def _release(line: ModbusLine) -> None:
    line.users -= 1
    if line.users == 0:
        _LINES.pop(id(line.line), None)
        line.close()


@final
class ModbusUnit:
    """The registers of one unit, and the record of its motor.

    Args:
        line: where it is.
        unit: its server address, 1..247 (on TCP 255 too: the only one there).
        runtime: where to wait.
        hardware: the hardware object that speaks for the motor.
        timeout_s: how long to wait for an answer.

    Raises:
        UsageError: there is a hardware object for it already, or no such unit.
    """

    def __init__(
        self, line: ByteLine, unit: int, runtime: "Runtime", hardware: object, timeout_s: float
    ) -> None:
        highest = 255 if line.framing == "tcp" else 247
        if isinstance(unit, bool) or not isinstance(unit, int) or not 1 <= unit <= highest:
            raise UsageError(f"unit = {unit!r}: must be a server address, 1 to {highest}")
        own = getattr(line, "wall", getattr(line, "runtime", None))
        if own is not None and own is not runtime:
            raise UsageError(f"{line.name} is read by another runtime: hand on the line's own")
        self.unit: Final = unit
        self.runtime: Final = runtime
        self.timeout_s: Final = timeout_s
        self.label: Final = f"{line.name} unit {unit}"
        where = line_name(line) if can_share_time(runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-unit{unit}", self.label)
        self._key: Hashable = (id(line) if where is None else where, unit)
        self.physical: Final = register_physical_motor(self._key, self.label, hardware, lock)
        self._hardware = hardware
        self.line: Final = _open(line, runtime)
        self.is_closed = False
        self.silences = 0  # how often it did not answer: each time it may have been without power

    def close(self) -> None:
        """It is used no more; closing again does nothing."""
        if not self.is_closed:
            self.is_closed = True
            release_physical_motor(self._key, self._hardware)
            _release(self.line)

    def _require_open(self) -> None:
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    @property
    def standing(self) -> tuple[int, int]:
        """While this is the same nobody else had the motor, and it always answered.

        What was read of it, and what it was told, is true for so long only.
        """
        return self.physical.token, self.silences

    def _ask(self, request: "ModbusPDU", owned: "Owned | None" = None) -> "ModbusPDU":
        try:
            return self.line.ask(request, self.unit, self.timeout_s, owned)
        except MotorError as error:
            self.silences += is_silence(error)
            raise

    def read(self, address: int, count: int = 1) -> list[int]:
        """The contents of holding registers, 0 to FFFFh each.

        Raises: as `ModbusLine.ask`.
        """
        self._require_open()
        request = ReadHoldingRegistersRequest(address=address, count=count)
        answer = self._ask(request)
        if len(answer.registers) != count:
            raise ModbusProtocolViolation(
                line=self.line.name,
                unit=self.unit,
                problem=f"{len(answer.registers)} registers for {count} at {address:04X}h",
                heard=b"",
            )
        return list(answer.registers)

    def first_read(self, address: int, patience_s: float) -> int:
        """One register of a drive that may still be starting: asked again until it answers.

        Raises: as `read`, after `patience_s` [s].
        """
        end_ns = self.runtime.now_ns() + round(patience_s * 1e9)
        while True:
            try:
                return self.read(address)[0]
            except (DeadlineExceeded, PeerError) as error:
                is_odd = isinstance(error, ModbusProtocolViolation)
                if not (is_odd or is_silence(error)) or self.runtime.now_ns() >= end_ns:
                    raise

    def read_i32(self, address: int) -> int:
        """A signed 32-bit value, upper register first."""
        return as_i32(*self.read(address, 2))

    def write(self, address: int, *values: int) -> None:
        """Holding registers from `address` on hold these; one alone by function 06h.

        A commanding write: it goes out only while this process owns the motor, if others can.

        Raises: as `ModbusLine.ask`; MotorBusyError if the motor was taken over.
        """
        self._require_open()
        request = self._request(address, values)
        self._ask(request, self.physical.ownership)

    def post(self, address: int, *values: int) -> Exchange:
        """As `write`, without waiting and whoever owns the motor: for stops."""
        self._require_open()
        return self.line.post(self._request(address, values), self.unit, self.timeout_s)

    def _request(self, address: int, values: tuple[int, ...]) -> "ModbusPDU":
        if len(values) == 1:
            return WriteSingleRegisterRequest(address=address, registers=[values[0] & 0xFFFF])
        registers = [value & 0xFFFF for value in values]
        return WriteMultipleRegistersRequest(address=address, registers=registers)


def as_i32(upper: int, lower: int) -> int:
    """The signed number that two registers hold."""
    value = upper << 16 | lower
    return value - (1 << 32) if value & 0x8000_0000 else value


def words(*values: int) -> tuple[int, ...]:
    """32-bit numbers as registers, upper half first."""
    return tuple(half for value in values for half in (value >> 16 & 0xFFFF, value & 0xFFFF))
