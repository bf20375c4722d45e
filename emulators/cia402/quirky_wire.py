"""Deviations of real drives on the wire: a wrapper around the drive.

Outgoing frames are delayed or altered, and incoming frames ignored, by their function codes,
whatever the node-ID from LSS. The drive does not know about it. A drive without such quirks needs
no wrapper. The quirk catalogue lists the sources.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Final, final

from emulators.canopen.shared import NEVER
from emulators.controller import Controller

_EMCY: Final = 0x080
_SDO_RESPONSE: Final = 0x580
_SDO_REQUEST: Final = 0x600
_ERROR_CONTROL: Final = 0x700
_SYNC: Final = (0x080).to_bytes(4, "little")
_STRAY_EMCY: Final = (0x081).to_bytes(4, "little")


@final
class WireQuirks:
    """The deviations on the wire; 0 and False: none. Times [ns].

    Attributes:
        sdo_mean_ns, sdo_spread_ns: delay of SDO responses: mean -+ spread.
        heartbeat_ns: maximum delay of a heartbeat.
        deaf_ns: time after the boot-up message during which SDO requests are ignored.
        has_stray_emcy: EMCY is sent on 081h, whatever the node-ID.
        has_misplaced_register: 1001h is one byte too far right in EMCY.
    """

    def __init__(self) -> None:
        self.sdo_mean_ns: int = 0
        self.sdo_spread_ns: int = 0
        self.heartbeat_ns: int = 0
        self.deaf_ns: int = 0
        self.has_stray_emcy: bool = False
        self.has_misplaced_register: bool = False

    def are_any(self) -> bool:
        """Return True if anything deviates."""
        delays_ns = self.sdo_mean_ns + self.sdo_spread_ns + self.heartbeat_ns + self.deaf_ns
        return delays_ns > 0 or self.has_stray_emcy or self.has_misplaced_register


@final
class Draws:
    """A named stream of pseudo-random numbers, reproducible by its seed."""

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._count = 0

    def draw_ns(self, low_ns: int, high_ns: int) -> int:
        """Return the next number, evenly distributed from `low_ns` to `high_ns` [ns]."""
        self._count += 1
        digest = hashlib.sha256(f"{self._stream}:{self._count}".encode()).digest()
        return low_ns + int.from_bytes(digest[:8], "big") % (high_ns - low_ns + 1)


@final
class QuirkyWire:
    """Wraps a drive and implements `Controller` itself.

    Attributes:
        inner: the drive.
    """

    def __init__(self, inner: Controller, quirks: WireQuirks, stream: str) -> None:
        self.inner: Controller = inner
        self._quirks = quirks
        self._responses = Draws(f"{stream}:quirk:slow_sdo")
        self._heartbeats = Draws(f"{stream}:quirk:heartbeat_jitter")
        self._now_ns: int = 0
        self._deaf_until_ns: int = -1
        self._held: list[tuple[int, bytes]] = []  # each with the time when it is sent
        self._response_due_ns: int = 0  # of the last response: responses keep their order
        self._ready: list[bytes] = []

    def start(self, now_ns: int) -> None:
        """Power the drive on."""
        self._now_ns = now_ns
        self.inner.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Pass a received frame on, unless it is ignored."""
        self._now_ns = now_ns
        if now_ns < self._deaf_until_ns and _function(data) == _SDO_REQUEST:
            return
        self.inner.receive(data, now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Report that an own frame has left the bus."""
        self._now_ns = now_ns
        return self.inner.sent(data, now_ns)

    def wants_sent(self) -> bool:
        """Return the drive's answer."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return the drive's deadline, or when the first delayed frame is sent."""
        first_ns = NEVER
        for due_ns, _ in self._held:
            if due_ns < first_ns:
                first_ns = due_ns
        inner_ns = self.inner.next_deadline_ns()
        if inner_ns is not None and inner_ns < first_ns:
            return inner_ns
        return None if first_ns == NEVER else first_ns

    def expire(self, now_ns: int) -> None:
        """Release the frames that are due, and let the drive handle its deadlines."""
        self._now_ns = now_ns
        self._ready.extend(frame for due_ns, frame in self._held if due_ns <= now_ns)
        self._held = [one for one in self._held if one[0] > now_ns]
        inner_ns = self.inner.next_deadline_ns()
        if inner_ns is not None and inner_ns <= now_ns:
            self.inner.expire(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the drive's frames, delayed and altered."""
        frames = self._ready
        self._ready = []
        for frame in self.inner.take_output():
            function = _function(frame)
            if function == _SDO_RESPONSE:
                self._hold_response(frame, frames)
            elif function == _ERROR_CONTROL:
                self._hold_heartbeat(frame, frames)
            elif function == _EMCY and frame[:4] != _SYNC:
                frames.append(self._altered(frame))
            else:
                frames.append(frame)
        return frames

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the drive's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input of the drive; ValueError as from the drive."""
        self._now_ns = now_ns
        self.inner.stimulate(name, value, now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true internal state."""
        return self.inner.snapshot(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return the drive's identifiers."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """Return the drive's revision of its identifiers."""
        return self.inner.identifiers_revision()

    # --- internals

    def _hold_response(self, frame: bytes, frames: list[bytes]) -> None:
        quirks = self._quirks
        if quirks.sdo_mean_ns + quirks.sdo_spread_ns == 0:
            frames.append(frame)
            return
        low_ns = max(0, quirks.sdo_mean_ns - quirks.sdo_spread_ns)
        delay_ns = self._responses.draw_ns(low_ns, quirks.sdo_mean_ns + quirks.sdo_spread_ns)
        self._response_due_ns = max(self._response_due_ns, self._now_ns + delay_ns)
        self._held.append((self._response_due_ns, frame))

    def _hold_heartbeat(self, frame: bytes, frames: list[bytes]) -> None:
        """Delay a heartbeat; a boot-up message is sent at once and starts the deaf time."""
        if frame[8] == 0:
            self._deaf_until_ns = self._now_ns + self._quirks.deaf_ns
        elif self._quirks.heartbeat_ns:
            delay_ns = self._heartbeats.draw_ns(0, self._quirks.heartbeat_ns)
            self._held.append((self._now_ns + delay_ns, frame))
            return
        frames.append(frame)

    def _altered(self, frame: bytes) -> bytes:
        if self._quirks.has_stray_emcy:
            frame = _STRAY_EMCY + frame[4:]
        if self._quirks.has_misplaced_register:
            frame = frame[:10] + b"\0" + frame[10:15]
        return frame


def _function(frame: bytes) -> int:
    return int.from_bytes(frame[:4], "little") & ~0x7F
