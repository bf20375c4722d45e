"""Access of a client to the object dictionary, with abort codes.

The SDO server uses it. Other services that access a dictionary may use it as well.
"""

from typing import Protocol, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NodeHost


class ConfigurationListener(Protocol):
    """A listener for writes to communication objects."""

    def configured(self, index: int, now_ns: int) -> None:
        """Handle a new value of a sub-index of 1000h..1FFFh."""


@final
class DictionaryAccess:
    """One client's view of a dictionary. Absent, read-only and oversized access is refused."""

    def __init__(
        self, od: ObjectDictionary, host: NodeHost, listener: ConfigurationListener
    ) -> None:
        self._od = od
        self._host = host
        self._listener = listener

    def upload(self, index: int, subindex: int, now_ns: int) -> bytes | int:
        """Return the present value, or the abort code."""
        variable = self._od.get(index, subindex)
        if variable is None:
            return self._absent(index)
        if not variable.is_readable():
            return AbortCode.WRITE_ONLY
        if index == 0x1003 and subindex > self._od.integer(0x1003, 0, 0):
            return AbortCode.NO_DATA
        self._host.before_read(now_ns)
        return variable.upload()

    def refusal(self, index: int, subindex: int, size_bytes: int | None) -> int:
        """Return the abort code for beginning a download of this size (None: unknown), or 0."""
        variable = self._od.get(index, subindex)
        if variable is None:
            return self._absent(index)
        if not variable.is_writable():
            return AbortCode.READ_ONLY
        if size_bytes is None or not variable.bits:
            return 0
        expected = (variable.bits + 7) // 8
        if size_bytes > expected:
            return AbortCode.LENGTH_TOO_HIGH
        return AbortCode.LENGTH_TOO_LOW if size_bytes < expected else 0

    def size_bytes(self, index: int, subindex: int) -> int:
        """Return the size of the variable [bytes]; 0 if it varies or the variable is absent."""
        variable = self._od.get(index, subindex)
        return 0 if variable is None else (variable.bits + 7) // 8

    def download(self, index: int, subindex: int, data: bytes, now_ns: int) -> int:
        """Write the value and notify listeners; return 0, or the abort code without any effect."""
        code = self.refusal(index, subindex, len(data))
        if code:
            return code
        variable = self._od.get(index, subindex)
        assert variable is not None
        code = variable.download(data)
        if code:
            return code
        if 0x1000 <= index <= 0x1FFF:
            self._listener.configured(index, now_ns)
        self._host.on_write(now_ns)
        return 0

    def _absent(self, index: int) -> int:
        if self._od.has_index(index):
            return AbortCode.NO_SUCH_SUBINDEX
        return AbortCode.NO_SUCH_OBJECT
