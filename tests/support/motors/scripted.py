"""A bus in memory with a scripted peer: expected frames, timed answers.

Frames are written as candump writes them: "601#4018100100000000", identifier and data in hex.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, final

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime

US: Final = 1_000
MS: Final = 1_000_000
FRAME_NS: Final = 100 * US
"""The time from sending a frame to its confirmation and its arrival at the peer [ns]."""

Answer = tuple[int, bytes]
"""(delay after the request arrived [ns], frame)"""
Peer = Callable[[bytes], Iterable[Answer]]


def frame(text: str) -> bytes:
    """Return the can_frame of "id#data" in hex; blanks in the data are ignored."""
    can_id, _, data = text.partition("#")
    payload = bytes.fromhex(data)
    return (
        int(can_id, 16).to_bytes(4, "little")
        + bytes((len(payload), 0, 0, 0))
        + payload.ljust(8, b"\0")
    )


def text_of(data: bytes) -> str:
    """Return a can_frame in the notation that `frame` reads."""
    can_id = int.from_bytes(data[:4], "little")
    return f"{can_id:03X}#{data[8 : 8 + data[4]].hex().upper()}"


@final
class ScriptedBus:
    """The bus interface for a runtime in virtual time; the peer receives the host's frames."""

    def __init__(self, peer: Peer | None = None, *, confirms: bool = True) -> None:
        self.queue = EventQueue()
        self.runtime = VirtualRuntime(self.queue)
        self.channel = "script0"
        self.channel_info = f"scripted bus {id(self)}"
        self.peer = peer
        self.sent: list[tuple[int, str]] = []
        self._confirms = confirms
        self._listeners: list[Callable[[bytes, int, bool], None]] = []

    @property
    def texts(self) -> list[str]:
        """The frames that the host has sent, without the times."""
        return [text for _, text in self.sent]

    def subscribe(self, on_frame: Callable[[bytes, int, bool], None]) -> "_Subscription":
        self._listeners.append(on_frame)
        return _Subscription(self._listeners, on_frame)

    def transmit(self, data: bytes) -> None:
        self.sent.append((self.queue.now_ns, text_of(data)))

        def on_wire(now_ns: int) -> None:
            if self._confirms:
                self._tell(data, now_ns, True)
            for delay_ns, answer in self.peer(data) if self.peer is not None else ():
                self.deliver(answer, delay_ns)

        self.queue.alarm(on_wire).set(self.queue.now_ns + FRAME_NS)

    def deliver(self, data: bytes | str, delay_ns: int = 0) -> None:
        """Complete a frame of the peer `delay_ns` from now."""
        raw = frame(data) if isinstance(data, str) else data
        self.queue.alarm(lambda now_ns: self._tell(raw, now_ns, False)).set(
            self.queue.now_ns + delay_ns
        )

    def confirm(self, text: str) -> None:
        """Report an own frame as transmitted."""
        self.queue.alarm(lambda now_ns: self._tell(frame(text), now_ns, True)).set(
            self.queue.now_ns
        )

    def _tell(self, data: bytes, now_ns: int, transmitted: bool) -> None:
        for listener in tuple(self._listeners):
            listener(data, now_ns, transmitted)


@final
class _Subscription:
    def __init__(
        self,
        listeners: list[Callable[[bytes, int, bool], None]],
        one: Callable[[bytes, int, bool], None],
    ) -> None:
        self._listeners = listeners
        self._one = one

    def cancel(self) -> None:
        if self._one in self._listeners:
            self._listeners.remove(self._one)


@final
class Transcript:
    """A peer that answers by a script of pairs ("601#40...", "581#43..."), in this order."""

    def __init__(self, exchanges: Sequence[tuple[str, str | None]], delay_ns: int = 1 * MS) -> None:
        self._exchanges = list(exchanges)
        self._delay_ns = delay_ns
        self.unexpected: list[str] = []

    def __call__(self, data: bytes) -> Iterable[Answer]:
        if not self._exchanges or frame(self._exchanges[0][0]) != data:
            self.unexpected.append(text_of(data))
            return ()
        answer = self._exchanges.pop(0)[1]
        return () if answer is None else ((self._delay_ns, frame(answer)),)

    @property
    def is_over(self) -> bool:
        """True if the whole script was played, and nothing else was sent."""
        return not self._exchanges and not self.unexpected
