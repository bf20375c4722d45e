"""What controllers out of a recording have in common, whatever they are on."""

from collections.abc import Mapping, Sequence
from typing import Final

from harness.replay.player import TapePlayer


class RecordedController:
    """The parts of `emulators.controller.Controller` that need no protocol.

    Args:
        player: of its tape.
        word: what it is called: a drive, a unit.
        note: what is to be known of the recording; it is told at power-on.

    Attributes:
        player: what was found, and what was not.
    """

    def __init__(self, player: TapePlayer, word: str, note: str) -> None:
        self.player: Final = player
        self._word = word
        self._output: list[bytes] = []
        self._events: list[tuple[str, str]] = [("warning", note)] if note else []

    def start(self, now_ns: int) -> None:
        """The recording begins."""
        self.player.start(now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Nothing comes of it."""
        return False

    def wants_sent(self) -> bool:
        """Nothing comes of it."""
        return False

    def next_deadline_ns(self) -> int | None:
        """When it sends something."""
        return self.player.next_deadline_ns()

    def take_output(self) -> Sequence[bytes]:
        """The frames to send now."""
        output, self._output = self._output, []
        return output

    def take_events(self) -> Sequence[tuple[str, str]]:
        """What could not be answered."""
        events, self._events = self._events, []
        return events

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Nothing can happen to it but what was recorded.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"stimulus {name!r}: a recorded {self._word} has no inputs")

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """How much of the recording has been told."""
        mismatches = len(self.player.mismatches)
        return {"matched": float(self.player.matched), "mismatches": float(mismatches)}

    def identifiers_revision(self) -> int:
        """Never changes."""
        return 0
