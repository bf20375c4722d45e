"""The part of a recorded controller that no protocol changes, and the times of its frames."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from motorhil.emulators.can.frame import FRAME_BYTES
from motorhil.harness.replay.frames import duration_ns
from motorhil.harness.replay.player import ExchangePlayer
from motorhil.traces.exchange.steps import ExchangeLog, Sent


class RecordedController:
    """Protocol-independent part of `motorhil.emulators.controller.Controller`.

    Args:
        player: the player of its exchange log.
        word: the word for it in messages: drive, unit.
        note: a remark about the recording, reported at power-on.

    Attributes:
        player: holds the matched commands and the mismatches.
    """

    def __init__(self, player: ExchangePlayer, word: str, note: str) -> None:
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


def timed_log(log: ExchangeLog, bit_ns: int, data_bit_ns: int) -> tuple[ExchangeLog, int]:
    """Return the log with frame durations at these bit times, and the number of omitted frames."""
    left_out = 0
    durations_ns: dict[int, int] = {}  # by identifier

    def timed(sent: list[Sent]) -> list[Sent]:
        nonlocal left_out
        kept = [
            Sent(one.delay_ns, one.data, duration_ns(one.data, bit_ns, data_bit_ns), one.goes_on)
            for one in sent
            if data_bit_ns or len(one.data) == FRAME_BYTES
        ]
        left_out += len(sent) - len(kept)
        durations_ns.update((_identifier(one), one.duration_ns) for one in kept)
        return kept

    steps = [
        replace(
            step,
            reactions=timed(step.reactions),
            answers=timed(step.answers),
            turns=[replace(turn, answers=timed(turn.answers)) for turn in step.turns],
        )
        for step in log.steps
    ]
    periods_ns = _carried(log.periods_ns, durations_ns)
    if periods_ns.keys() != log.periods_ns.keys():
        for step in steps:
            step.reactions = [
                one._replace(goes_on=one.goes_on and _identifier(one) in periods_ns)
                for one in step.reactions
            ]
    return replace(log, steps=steps, periods_ns=periods_ns), left_out


def _carried(periods_ns: Mapping[int, int], durations_ns: Mapping[int, int]) -> dict[int, int]:
    """Return the periods, longest first, of frames that fit on the bus together.

    More than that would fill the node's transmit queue, without end.
    """
    found: dict[int, int] = {}
    load = 0.0
    for identifier, period_ns in sorted(periods_ns.items(), key=lambda one: -one[1]):
        load += durations_ns.get(identifier, 0) / period_ns
        if load <= 1.0:
            found[identifier] = period_ns
    return found


def _identifier(sent: Sent) -> int:
    return int.from_bytes(sent.data[:4], "little")
