"""How the profile position mode of real drives deviates: modes that stand around `ProfilePosition`.

Each passes everything on but what it deviates in, so they can be put around one another; a drive
without quirks has none of them. Where each was seen stands in `emulators.cia402.quirk_catalogue`.
"""

from typing import final

from emulators.canopen.shared import NEVER
from emulators.cia402.mode import Mode
from emulators.cia402.profile_position import CHANGE_IMMEDIATELY, NEW_SET_POINT
from emulators.cia402.statusword import SET_POINT_ACKNOWLEDGE, TARGET_REACHED
from emulators.firmware.digital_inputs import Edge


class Around(Mode):
    """Passes everything on to the mode inside."""

    def __init__(self, inner: Mode) -> None:
        super().__init__(inner.axis, inner.objects, inner.tick_ns)
        self.inner = inner

    def enter(self, word: int, now_ns: int) -> None:
        """As the mode inside."""
        self.inner.enter(word, now_ns)
        self._copy()

    def leave(self) -> None:
        """As the mode inside."""
        self.inner.leave()
        self._copy()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """As the mode inside."""
        self.inner.obey(word, rising, now_ns)
        self._copy()

    def written(self, what: int, now_ns: int) -> None:
        """As the mode inside."""
        self.inner.written(what, now_ns)
        self._copy()

    def sees(self, edges: list[Edge]) -> None:
        """As the mode inside."""
        self.inner.sees(edges)
        self._copy()

    def synced(self, now_ns: int) -> bool:
        """As the mode inside."""
        is_news = self.inner.synced(now_ns)
        self._copy()
        return is_news

    def settle(self, now_ns: int) -> None:
        """As the mode inside."""
        self.inner.settle(now_ns)
        self._copy()

    def wake_ns(self) -> int:
        """As the mode inside."""
        return self.inner.wake_ns()

    def status_bits(self) -> int:
        """As the mode inside."""
        return self.inner.status_bits()

    def idle_bits(self) -> int:
        """As the mode inside."""
        return self.inner.idle_bits()

    def _copy(self) -> None:
        self.halted = self.inner.halted
        self.limited = self.inner.limited
        self.lost = self.inner.lost


@final
class InvertedAcknowledge(Around):
    """Set-point acknowledge is 1 while there is nothing to acknowledge, and 0 when there is."""

    def status_bits(self) -> int:
        """With bit 12 the other way round."""
        return self.inner.status_bits() ^ SET_POINT_ACKNOWLEDGE


@final
class SingleSetPoint(Around):
    """A set-point without *change immediately* (bit 5) is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """An offer without bit 5 is none."""
        if not word & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class EdgeOnlyBits(Around):
    """*Change immediately* is an edge, too: an offer with the bit left set is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """An offer counts if bit 5, where it is set, has risen with it."""
        if word & CHANGE_IMMEDIATELY and not rising & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class StaleTargetReached(Around):
    """*Target reached* of the motion before stands for a while after a set-point was taken."""

    def __init__(self, inner: Mode, for_ns: int) -> None:
        super().__init__(inner)
        self._for_ns = for_ns
        self._until_ns: int = NEVER  # when it goes; NEVER: it is not stale

    def enter(self, word: int, now_ns: int) -> None:
        """Nothing is stale."""
        self._until_ns = NEVER
        super().enter(word, now_ns)

    def leave(self) -> None:
        """Nothing is stale."""
        self._until_ns = NEVER
        super().leave()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """What is reached when a set-point is offered stays reached."""
        was_reached = self.inner.status_bits() & TARGET_REACHED != 0
        super().obey(word, rising, now_ns)
        if rising & NEW_SET_POINT and was_reached:
            self._until_ns = now_ns + self._for_ns

    def settle(self, now_ns: int) -> None:
        """It is over when its time is."""
        if now_ns >= self._until_ns:
            self._until_ns = NEVER
        super().settle(now_ns)

    def wake_ns(self) -> int:
        """The mode's own, or when the bit is to go."""
        wake_ns = self.inner.wake_ns()
        return wake_ns if wake_ns < self._until_ns else self._until_ns

    def status_bits(self) -> int:
        """Bit 10, stale or not."""
        bits = self.inner.status_bits()
        return bits if self._until_ns == NEVER else bits | TARGET_REACHED
