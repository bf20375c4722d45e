"""Fast decoder of CanFrame messages with a cache of their beginnings.

In messages of our writer everything except the data is the same for one identifier, sender and
length, and precedes the data.
"""

from typing import Final, final

from traces.fields import can_frame_prefix, decode_can_frame
from traces.schema import Direction
from traces.traffic import Frame

_REMEMBERED: Final = 1 << 16


@final
class FrameDecoder:
    """Decoder that caches the beginnings of messages."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int], tuple[bytes, bytes, bytes, Direction, str]] = {}

    def decode(self, payload: bytes) -> tuple[bytes, Direction, str]:
        """Return can_frame or canfd_frame, direction and sender of a motorhil.CanFrame.

        Raises:
            ValueError: the payload is not a CanFrame.
        """
        key = (payload[:5], len(payload))
        before = self._known.get(key)
        if before is not None and payload.startswith(before[0]):
            prefix, head, padding, direction, sender = before
            return head + payload[len(prefix) :] + padding, direction, sender
        told = decode_can_frame(payload)
        head = told.frame[:8]
        sender_bytes = told.sender.encode()
        prefix, length = can_frame_prefix(head, len(told.frame), sender_bytes, told.direction)
        if len(prefix) + length == len(payload) and payload.startswith(prefix):
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            padding = bytes(len(told.frame) - 8 - length)
            self._known[key] = (prefix, head, padding, told.direction, told.sender)
        return told.frame, told.direction, told.sender

    def frame(self, payload: bytes, time_ns: int, bus: str) -> Frame:
        """Return the decoded frame with bus and time. Raises ValueError for an invalid payload."""
        frame, direction, sender = self.decode(payload)
        return Frame(time_ns, bus, frame, direction, sender)
