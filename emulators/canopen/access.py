"""Reading and writing the dictionary on a client's behalf, with the abort code of every refusal.

The SDO server uses it; so may any other service that reaches into a dictionary.
"""

from typing import Protocol, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NodeHost


class ConfigurationListener(Protocol):
    """Who must know that a communication object was written."""

    def configured(self, index: int, now_ns: int) -> None:
        """A sub-index of 1000h..1FFFh has a new value."""


@final
class DictionaryAccess:
    """One client's view of a dictionary: what is absent, read-only or too long is refused."""

    def __init__(
        self, od: ObjectDictionary, host: NodeHost, listener: ConfigurationListener
    ) -> None:
        self._od = od
        self._host = host
        self._listener = listener

    def upload(self, index: int, subindex: int, now_ns: int) -> bytes | int:
        """The value as it is now, or the abort code."""
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
        """Why a download of so many bytes cannot even begin; 0 if it can. None: size unknown."""
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
        """How many bytes the variable's numbers take; 0 if that varies or nothing is there."""
        variable = self._od.get(index, subindex)
        return 0 if variable is None else (variable.bits + 7) // 8

    def download(self, index: int, subindex: int, data: bytes, now_ns: int) -> int:
        """The value is written and everybody told: 0, or the abort code and nothing happened."""
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
