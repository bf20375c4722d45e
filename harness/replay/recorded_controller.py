"""Common base of recorded controllers, for any kind of bus."""

from collections.abc import Mapping, Sequence
from typing import Final

from harness.replay.player import TapePlayer


class RecordedController:
    """Protocol-independent part of `emulators.controller.Controller`.

    Args:
        player: the player of its exchange log.
        word: the word for it in messages: drive, unit.
        note: a remark about the recording, reported at power-on.

    Attributes:
        player: holds the matched commands and the mismatches.
    """

    def __init__(self, player: TapePlayer, word: str, note: str) -> None:
        self.player: Final = player
        self._word = word
        self._output: list[bytes] = []
        self._events: list[tuple[str, str]] = [("warning", note)] if note else []

    def start(self, now_ns: int) -> None:
        """Start the playback at `now_ns`."""
        self.player.start(now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Ignore the transmission of a frame."""
        return False

    def wants_sent(self) -> bool:
        """Return False: transmissions are ignored."""
        return False

    def next_deadline_ns(self) -> int | None:
        """Return when the next frame is due [ns], or None."""
        return self.player.next_deadline_ns()

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to send now."""
        output, self._output = self._output, []
        return output

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the events since the last call: commands without an answer."""
        events, self._events = self._events, []
        return events

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Refuse the stimulus: a recorded controller has no inputs.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"stimulus {name!r}: a recorded {self._word} has no inputs")

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the numbers of matched commands and of mismatches."""
        mismatches = len(self.player.mismatches)
        return {"matched": float(self.player.matched), "mismatches": float(mismatches)}

    def identifiers_revision(self) -> int:
        """Return 0: the identifiers never change."""
        return 0
