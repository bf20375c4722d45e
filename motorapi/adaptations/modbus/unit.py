"""The registers of one Modbus drive, and the ownership of its motor.

A read without a valid answer is repeated; reading has no effect, and the line separates late
answers from the next. A write is sent once, as it may have been executed.

Two locks coordinate processes, as on CAN: one for the ownership of the drive, one for the exchanges
on its line.
"""

from typing import TYPE_CHECKING, Final, final

from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from motorhil.motorapi.adaptations.modbus.client import (
    ByteLine,
    Exchange,
    ModbusLine,
    ModbusProtocolViolation,
    is_silence,
)
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorError, PeerError, UsageError
from motorhil.motorapi.locking.directory import line_name
from motorhil.motorapi.locking.process_lock import ProcessLock, can_share_time
from motorhil.motorapi.ownership.physical_motor import (
    register_physical_motor,
    release_physical_motor,
)

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

    from motorhil.motorapi.ownership.fencing import Owned
    from motorhil.motorapi.runtime.api import Runtime

_READS_MAX: Final = 2  # of the same registers
_READ_NS: Final = 2_000_000_000  # after this time a read is not repeated


def _open(line: ByteLine, runtime: "Runtime") -> ModbusLine:
    def make() -> ModbusLine:
        where = line_name(line) if can_share_time(runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-exchange", f"the line {line.name}")
        return ModbusLine(line, runtime, lock)

    known = context_of(line).parts.part(ModbusLine, make)
    known.users += 1
    return known


def _release(line: ModbusLine) -> None:
    line.users -= 1
    if line.users == 0:
        context_of(line.line).parts.drop(line)
        line.close()


@final
class ModbusUnit:
    """The registers of one unit, and the record of its motor.

    Args:
        line: the line of the unit.
        unit: its server address, 1..247 (on TCP 255 too: the only unit there).
        runtime: the runtime to wait with.
        hardware: the hardware object of the motor.
        timeout_s: the response timeout [s].

    Raises:
        UsageError: a hardware object for the unit exists already, or the address is not valid.
    """

    def __init__(
        self, line: ByteLine, unit: int, runtime: "Runtime", hardware: object, timeout_s: float
    ) -> None:
        highest = 255 if line.framing == "tcp" else 247
        if isinstance(unit, bool) or not isinstance(unit, int) or not 1 <= unit <= highest:
            raise UsageError(f"unit = {unit!r}: must be a server address, 1 to {highest}")
        own = getattr(line, "wall", getattr(line, "runtime", None))
        if own is not None and own is not runtime:
            raise UsageError(f"{line.name} is read by another runtime: use the line's own runtime")
        self.unit: Final = unit
        self.runtime: Final = runtime
        self.timeout_s: Final = timeout_s
        self.label: Final = f"{line.name} unit {unit}"
        where = line_name(line) if can_share_time(runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-unit{unit}", self.label)
        self.physical: Final = register_physical_motor(line, unit, self.label, hardware, lock)
        self._hardware = hardware
        self.line: Final = _open(line, runtime)
        self.is_closed: bool = False
        self.silences: int = 0  # requests without answer; each may mean a loss of power
        self.repeats: int = 0  # reads that were repeated
        self._answers = False  # False: reads are not repeated until the drive answers

    def close(self) -> None:
        """Close the unit; further calls do nothing."""
        if not self.is_closed:
            self.is_closed = True
            release_physical_motor(self.line.line, self.unit, self._hardware)
            _release(self.line)

    def _require_open(self) -> None:
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    @property
    def standing(self) -> tuple[int, int]:
        """A token that is constant while the motor keeps its owner and always answers.

        Values read from the drive, or written to it, are valid only that long.
        """
        return self.physical.token, self.silences + self.line.reconnections

    def _ask(self, request: "ModbusPDU", owned: "Owned | None" = None) -> "ModbusPDU":
        try:
            answer = self.line.ask(request, self.unit, self.timeout_s, owned)
        except MotorError as error:
            self.silences += is_silence(error)
            raise
        self._answers = True
        return answer

    def read(self, address: int, count: int = 1) -> list[int]:
        """Return the contents of holding registers, 0 to FFFFh each.

        A drive that answered before is asked once more, within 2 s.

        Raises: as `ModbusLine.ask`.
        """
        end_ns = self.runtime.now_ns() + _READ_NS
        left = _READS_MAX if self._answers else 1
        while True:
            left -= 1
            try:
                return self._read_once(address, count)
            except (DeadlineExceeded, PeerError) as error:
                if not _is_lost(error):
                    raise
                if not left or self.runtime.now_ns() >= end_ns:
                    self._answers = False
                    self.silences += is_silence(error)
                    raise
                self.repeats += 1

    def _read_once(self, address: int, count: int) -> list[int]:
        self._require_open()
        request = ReadHoldingRegistersRequest(address=address, count=count)
        answer = self.line.ask(request, self.unit, self.timeout_s)
        self._answers = True
        if len(answer.registers) != count:
            raise ModbusProtocolViolation(
                line=self.line.name,
                unit=self.unit,
                problem=f"{len(answer.registers)} registers for {count} at {address:04X}h",
                heard=b"",
            )
        return list(answer.registers)

    def first_read(self, address: int, patience_s: float) -> int:
        """Return one register of a drive that may still be booting; repeat until it answers.

        Raises: as `read`, after `patience_s` [s].
        """
        end_ns = self.runtime.now_ns() + round(patience_s * 1e9)
        while True:
            try:
                return self._read_once(address, 1)[0]
            except (DeadlineExceeded, PeerError) as error:
                self.silences += is_silence(error)
                if not _is_lost(error) or self.runtime.now_ns() >= end_ns:
                    raise

    def read_i32(self, address: int) -> int:
        """Return a signed 32-bit value, upper register first."""
        return as_i32(*self.read(address, 2))

    def write(self, address: int, *values: int) -> None:
        """Write holding registers from `address` on; a single one by function 06h.

        Writes are commands: they are sent only while this process owns the motor, if other
        processes can own it.

        Raises: as `ModbusLine.ask`; MotorBusyError if the motor was taken over, or if a motor on
            this unit has reserved or moves it, and this is not one of its operations.
        """
        self._require_open()
        self.physical.require_free()
        request = self._request(address, values)
        self._ask(request, self.physical.ownership)

    def post(self, address: int, *values: int) -> Exchange:
        """Write without waiting and without owning the motor: for stops."""
        self._require_open()
        return self.line.post(self._request(address, values), self.unit, self.timeout_s)

    def _request(self, address: int, values: tuple[int, ...]) -> "ModbusPDU":
        if len(values) == 1:
            return WriteSingleRegisterRequest(address=address, registers=[values[0] & 0xFFFF])
        registers = [value & 0xFFFF for value in values]
        return WriteMultipleRegistersRequest(address=address, registers=registers)


def _is_lost(error: MotorError) -> bool:
    """Return whether the error means that the answer was lost or spoiled."""
    return isinstance(error, ModbusProtocolViolation) or is_silence(error)


def as_i32(upper: int, lower: int) -> int:
    """Return the signed number in two registers."""
    value = upper << 16 | lower
    return value - (1 << 32) if value & 0x8000_0000 else value


def words(*values: int) -> tuple[int, ...]:
    """Return 32-bit numbers as registers, upper half first."""
    return tuple(half for value in values for half in (value >> 16 & 0xFFFF, value & 0xFFFF))
