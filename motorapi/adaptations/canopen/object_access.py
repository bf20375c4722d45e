"""Reads and writes of a node's objects by name or index.

Values already written are not written again.
"""

from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.canopen.objects import KINDS, Value, encode
from motorhil.motorapi.adaptations.canopen.sdo import decode_answer
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor


@final
class ObjectAccess:
    """Reads and writes by SDO, with a cache of written values while the motor keeps its owner."""

    def __init__(self, node: CanopenNode, physical: "PhysicalMotor") -> None:
        self._node: Final = node
        self.physical: Final = physical
        self._believed: dict[tuple[int, int], bytes] = {}
        self._token = -1

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object, as the drive sends them.

        Raises:
            SdoAborted, DeadlineExceeded, ProtocolViolation: see `SdoChannel`.
            LinkError: the drive is lost.
        """
        self._node.check_heard()
        return self._node.sdo.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes, *, stops: bool = False) -> None:
        """Write `data` to an object of the drive; with `stops`, without owning the motor.

        Raises:
            MotorBusyError: another program owns the drive now.
            SdoAborted, DeadlineExceeded, ProtocolViolation, LinkError: as `upload`.
        """
        self._node.check_heard()
        self._believed.pop((index, subindex), None)
        self._node.sdo.download(index, subindex, data, stops=stops)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """Return the value of an object; see `ObjectTable.find`."""
        index, subindex, kind = self._node.objects.find(what, subindex, kind)
        data = self.upload(index, subindex)
        return decode_answer(self._node.node_id, (index, subindex), kind or "bytes", data)

    def read_int(self, what: int | str, subindex: int = 0) -> int:
        """Return the integer in an object; raise UsageError if it does not hold one."""
        value = self.read(what, subindex)
        if not isinstance(value, int):
            raise UsageError(
                f"{self._node.label}: {what} does not hold an integer known to the standard"
            )
        return value

    def read_optional(self, index: int, subindex: int = 0) -> int | None:
        """Return the integer in an object, or None if the drive refuses to send it."""
        self._node.check_heard()
        return self._node.read_optional(index, subindex)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """Write a value to an object; arguments as in `ObjectTable.find`."""
        index, subindex, kind = self._node.objects.find(what, subindex, kind)
        if kind is None and not isinstance(value, bytes):
            raise UsageError(
                f"{index:04X}h:{subindex:02X}h is not in the standard: say kind=, one of"
                f" {' '.join(KINDS)}, or give bytes"
            )
        self.download(index, subindex, encode(kind or "bytes", value))

    def push(self, index: int, value: int, subindex: int = 0) -> bool:
        """Write a value unless the drive is believed to have it; return whether it was written.

        A written value is believed until the motor changes hands or boots.
        """
        return self.push_bytes(
            index, subindex, encode(self._node.objects.type_of(index, subindex) or "u32", value)
        )

    def push_bytes(self, index: int, subindex: int, data: bytes) -> bool:
        """Write encoded data as `push` does."""
        if self._believes(index, subindex, data):
            return False
        self.download(index, subindex, data)
        self._believed[index, subindex] = data
        return True

    def is_believed(self, index: int, value: int, subindex: int = 0) -> bool:
        """Return whether this value was written, and the motor has not changed hands since."""
        return self._believes(
            index, subindex, encode(self._node.objects.type_of(index, subindex) or "u32", value)
        )

    def _believes(self, index: int, subindex: int, data: bytes) -> bool:
        token = self.physical.token
        if token != self._token:
            self._believed.clear()
            self._token = token
        return self._believed.get((index, subindex)) == data

    def doubt(self, index: int | None = None, subindex: int = 0) -> None:
        """Forget the value written to an object, or (None) to any object."""
        if index is None:
            self._believed.clear()
        else:
            self._believed.pop((index, subindex), None)
