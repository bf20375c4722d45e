"""Single CAN frames for low-level access, beside the objects of a device."""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self, final

from motorapi.adaptations.canopen_link import can_frame
from motorapi.errors import DeadlineExceeded, UsageError
from motorapi.runtime import wait_until

if TYPE_CHECKING:
    from types import TracebackType

    from motorapi.adaptations.canopen_link import CanopenLink

_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_KEPT_MAX: Final = 10_000


@final
@dataclass(frozen=True, slots=True)
class RawFrame:
    """One received frame: identifier (11 bits, or 29 if `extended`), data, time of completion."""

    can_id: int
    data: bytes
    time_ns: int
    extended: bool = False


def raw_frame(can_id: int, data: bytes, *, extended: bool) -> bytes:
    """Return the Linux can_frame with an identifier of 11 bits (29 if `extended`) and 0 to 8 bytes.

    Raises:
        UsageError: the identifier or the data is not valid.
    """
    highest = 0x1FFF_FFFF if extended else 0x7FF
    if not isinstance(can_id, int) or not 0 <= can_id <= highest:
        hint = "" if extended else "; longer ones need extended=True"
        raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to {highest:X}h{hint}")
    if not isinstance(data, bytes | bytearray) or len(data) > 8:
        raise UsageError(f"data = {data!r}: a frame has up to 8 bytes")
    return can_frame(can_id | (_EFF if extended else 0), bytes(data))


@final
class FrameInbox:
    """Frames of other nodes received from now on, oldest first (the last 10,000), until `close`.

    Args:
        link: the link of the bus.
        can_ids: identifiers to receive, of 11 or 29 bits; none: all of them.
    """

    def __init__(self, link: "CanopenLink", can_ids: Collection[int]) -> None:
        for can_id in can_ids:
            if not isinstance(can_id, int) or not 0 <= can_id <= 0x1FFF_FFFF:
                raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to 1FFFFFFFh")
        self._link = link
        self._can_ids = frozenset(can_ids)
        self._frames: deque[RawFrame] = deque(maxlen=_KEPT_MAX)
        self._registration = link.runtime.listen(link.bus, self._on_frame)

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        word = int.from_bytes(frame[:4], "little")
        if transmitted or word & (_RTR | _ERR):
            return
        can_id = word & 0x1FFF_FFFF
        if not self._can_ids or can_id in self._can_ids:
            data = frame[8 : 8 + frame[4]]
            self._frames.append(RawFrame(can_id, data, time_ns, bool(word & _EFF)))

    def receive(self, timeout_s: float = 1.0) -> RawFrame:
        """Return the next frame.

        Raises:
            DeadlineExceeded: none came within `timeout_s` [s].
            LinkError: the bus is off.
        """
        frames, status = self._frames, self._link.status
        if not wait_until(self._link.runtime, lambda: bool(frames) or status.is_off, timeout_s):
            which = ", ".join(f"{can_id:03X}h" for can_id in sorted(self._can_ids)) or "any"
            raise DeadlineExceeded(
                awaited=f"a frame on {self._link.name} ({which})",
                timeout_s=timeout_s,
                last_heard="none of them",
            )
        if not frames:
            raise status.failure()
        return frames.popleft()

    def close(self) -> None:
        """Stop receiving."""
        self._registration.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: "type[BaseException] | None",
        error: BaseException | None,
        traceback: "TracebackType | None",
    ) -> None:
        self.close()
