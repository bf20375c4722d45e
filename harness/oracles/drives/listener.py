"""Listener of the drives on one bus or line: messages of their kinds, passed to the oracles."""

from collections.abc import Sequence
from typing import Final, final

from motorhil.harness.oracles.base import Oracle, RecordingContext, hooks
from motorhil.traces.exchange.drive_kinds import Decode, Read, readers_of

_ERR: Final = 0x20  # in the highest byte of an identifier


@final
class DriveListener:
    """Listener that passes the messages of the known drives of one bus to the oracles.

    Attributes:
        count: number of known drives.
    """

    def __init__(self, name: str, context: RecordingContext, oracles: Sequence[Oracle]) -> None:
        self._name = name
        self._on_drive = hooks(oracles, "drive")
        self._drives: list[tuple[int, Decode, Read]] = []
        for (bus, node), table in context.drives.items():
            known = readers_of(str(table.get("kind")), node, table) if bus == name else None
            if known is not None:
                self._drives.append((node, *known))
        self.count: Final = len(self._drives)

    def take_frame(self, time_ns: int, frame: bytes, sender: str) -> bool:
        """Take a frame of a CAN bus; return True if it concerns a known drive."""
        return not frame[3] & _ERR and self._take(time_ns, frame, sender)

    def take_bytes(self, time_ns: int, data: bytes, sender: str) -> None:
        """Take what one sender sent on a serial line without a pause."""
        self._take(time_ns, data, sender)

    def _take(self, time_ns: int, frame: bytes, sender: str) -> bool:
        is_known = False
        for node, decode, read in self._drives:
            message = decode(frame)
            if message is None:
                continue
            is_known = True
            told = read(frame, message)
            for hook in self._on_drive:
                hook(time_ns, (self._name, node), told, sender)
        return is_known
