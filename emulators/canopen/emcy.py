"""EMCY producer (CiA 301, 7.2.7): emergency messages, the error register 1001h, the history 1003h.

A device reports its own errors with `report`. What the node finds itself (an RPDO too short, a
heartbeat lost) is kept by key until it is repaired, so that the error register tells the truth:
bit 0 (generic error) and bit 4 (communication error) stand while any such error stands.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.canopen.shared import Outbox
from emulators.canopen.sync import is_restricted
from emulators.media.can_frame import pack

ERROR_RESET: Final = 0x0000
PDO_NOT_PROCESSED: Final = 0x8210  # due to length error
PDO_LENGTH_EXCEEDED: Final = 0x8220
HEARTBEAT_LOST: Final = 0x8130

_GENERIC: Final = 0x01
_COMMUNICATION: Final = 0x10
_INVALID: Final = 1 << 31
_UPPER_BITS: Final = 0x7FFF_F800
_VENDOR_BYTES: Final = 5


@final
class EmcyProducer:
    """Keeps 1001h and 1003h and sends EMCY while `may_send` (PRE-OPERATIONAL, OPERATIONAL)."""

    def __init__(self, od: ObjectDictionary, node_id: int, outbox: Outbox) -> None:
        self._od = od
        self._outbox = outbox
        self._can_id = 0  # 0: EMCY does not exist
        self._device_register = 0
        self._standing: dict[int, int] = {}  # key -> error code
        self._history = tuple(sub for sub in od.subindices(0x1003) if sub)
        self.may_send = False
        self._cob_id = od.ensure(0x1014, 0, DataType.UNSIGNED32, 0x80 + node_id)
        self._cob_id.writer = self.check_cob_id
        count = od.get(0x1003)
        if count is not None:
            count.writer = self.check_history

    def configure(self) -> None:
        """The identifier is what 1014h says now."""
        cob_id = self._cob_id.integer()
        self._can_id = 0 if cob_id & _INVALID else cob_id & 0x7FF

    def reset(self, whole: bool) -> None:
        """The node's own findings are forgotten; the device's too after reset node."""
        self._standing.clear()
        if whole:
            self._device_register = 0
        self._keep_register()

    def report(self, code: int, register: int, vendor: bytes) -> None:
        """The device has this error; `register` are its own bits of 1001h from now on."""
        self._device_register = register
        self._emit(code, vendor)

    def stand(self, register: int) -> None:
        """The device has these errors from now on, which nobody could be told or was told."""
        self._device_register = register
        self._keep_register()

    def find(self, key: int, code: int, vendor: bytes) -> None:
        """The node has found a communication error; found again, it is not told again."""
        if self._standing.get(key) != code:
            self._standing[key] = code
            self._emit(code, vendor)

    def repair(self, key: int) -> None:
        """What was found under this key is no longer so."""
        if key in self._standing:
            del self._standing[key]
            self._emit(ERROR_RESET, b"")

    def history_length(self) -> int:
        """How many entries of 1003h hold an error."""
        return self._od.integer(0x1003, 0, 0)

    def check_cob_id(self, value: int) -> int:
        """What is wrong with a new 1014h; 0 if nothing."""
        old = self._cob_id.integer()
        if value & _UPPER_BITS:
            return AbortCode.INVALID_VALUE
        if not value & _INVALID:
            if is_restricted(value & 0x7FF):
                return AbortCode.INVALID_VALUE
            if not old & _INVALID and (old ^ value) & 0x7FF:
                return AbortCode.INVALID_VALUE  # set it invalid first
        return 0

    def check_history(self, value: int) -> int:
        """1003h:0 takes a 0, which clears the history."""
        return AbortCode.INVALID_VALUE if value else 0

    def _keep_register(self) -> int:
        register = self._device_register
        if self._standing:
            register |= _COMMUNICATION
        if register:
            register |= _GENERIC
        variable = self._od.get(0x1001)
        if variable is not None:
            variable.value = register
        return register

    def _emit(self, code: int, vendor: bytes) -> None:
        register = self._keep_register()
        if code != ERROR_RESET:
            self._remember(code | int.from_bytes(vendor[:2], "little") << 16)
        if self.may_send and self._can_id:
            head = bytes((code & 0xFF, code >> 8 & 0xFF, register))
            tail = vendor[:_VENDOR_BYTES].ljust(_VENDOR_BYTES, b"\0")
            self._outbox.frames.append(pack(self._can_id, head + tail))

    def _remember(self, entry: int) -> None:
        """Newest first, the oldest falls out."""
        count = self._od.get(0x1003)
        if count is None or not self._history:
            return
        held = min(self.history_length() + 1, len(self._history))
        values = [self._od.integer(0x1003, sub, 0) for sub in self._history[: held - 1]]
        for sub, value in zip(self._history[:held], [entry, *values], strict=True):
            variable = self._od.get(0x1003, sub)
            if variable is not None:
                variable.value = value
        count.value = held
