"""Deviating profile position modes: wrappers around `ProfilePosition`.

Each wrapper passes everything on except its own deviation, so wrappers can be nested. A drive
without quirks has none of them. The quirk catalogue lists their sources.
"""

from typing import final

from emulators.canopen.shared import NEVER
from emulators.cia402.mode import Mode
from emulators.cia402.profile_position import CHANGE_IMMEDIATELY, NEW_SET_POINT
from emulators.cia402.statusword import SET_POINT_ACKNOWLEDGE, TARGET_REACHED
from emulators.firmware.digital_inputs import Edge


class Around(Mode):
    """Passes everything on to the inner mode."""

    def __init__(self, inner: Mode) -> None:
        super().__init__(inner.axis, inner.objects, inner.tick_ns)
        self.inner = inner

    def enter(self, word: int, now_ns: int) -> None:
        """Enter the inner mode."""
        self.inner.enter(word, now_ns)
        self._copy()

    def leave(self) -> None:
        """Leave the inner mode."""
        self.inner.leave()
        self._copy()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Pass the controlword on."""
        self.inner.obey(word, rising, now_ns)
        self._copy()

    def written(self, what: int, now_ns: int) -> None:
        """Pass written objects on."""
        self.inner.written(what, now_ns)
        self._copy()

    def sees(self, edges: list[Edge]) -> None:
        """Pass edges on."""
        self.inner.sees(edges)
        self._copy()

    def synced(self, now_ns: int) -> bool:
        """Pass SYNC on."""
        is_news = self.inner.synced(now_ns)
        self._copy()
        return is_news

    def settle(self, now_ns: int) -> None:
        """Let the inner mode settle."""
        self.inner.settle(now_ns)
        self._copy()

    def wake_ns(self) -> int:
        """Return the inner mode's deadline [ns]."""
        return self.inner.wake_ns()

    def status_bits(self) -> int:
        """Return the inner mode's bits."""
        return self.inner.status_bits()

    def idle_bits(self) -> int:
        """Return the inner mode's bits."""
        return self.inner.idle_bits()

    def _copy(self) -> None:
        self.halted = self.inner.halted
        self.limited = self.inner.limited
        self.lost = self.inner.lost


@final
class InvertedAcknowledge(Around):
    """Inverts set-point acknowledge: 1 while there is nothing to acknowledge."""

    def status_bits(self) -> int:
        """Return the bits with bit 12 inverted."""
        return self.inner.status_bits() ^ SET_POINT_ACKNOWLEDGE


@final
class SingleSetPoint(Around):
    """A set-point without *change immediately* (bit 5) is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Ignore an offer without bit 5."""
        if not word & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class EdgeOnlyBits(Around):
    """*Change immediately* is edge-triggered too: an offer with the bit left set is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Ignore an offer if bit 5 is set but has not risen with it."""
        if word & CHANGE_IMMEDIATELY and not rising & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class StaleTargetReached(Around):
    """*Target reached* of the previous motion stays set for a while after a set-point was taken."""

    def __init__(self, inner: Mode, for_ns: int) -> None:
        super().__init__(inner)
        self._for_ns = for_ns
        self._until_ns: int = NEVER  # end of the stale bit; NEVER: it is not stale

    def enter(self, word: int, now_ns: int) -> None:
        """Clear the stale bit."""
        self._until_ns = NEVER
        super().enter(word, now_ns)

    def leave(self) -> None:
        """Clear the stale bit."""
        self._until_ns = NEVER
        super().leave()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Keep the bit if the target was reached when the set-point was offered."""
        was_reached = self.inner.status_bits() & TARGET_REACHED != 0
        super().obey(word, rising, now_ns)
        if rising & NEW_SET_POINT and was_reached:
            self._until_ns = now_ns + self._for_ns

    def settle(self, now_ns: int) -> None:
        """Clear the stale bit after its time."""
        if now_ns >= self._until_ns:
            self._until_ns = NEVER
        super().settle(now_ns)

    def wake_ns(self) -> int:
        """Return the inner mode's deadline or the end of the stale bit [ns]."""
        wake_ns = self.inner.wake_ns()
        return wake_ns if wake_ns < self._until_ns else self._until_ns

    def status_bits(self) -> int:
        """Return the bits with bit 10, stale or not."""
        bits = self.inner.status_bits()
        return bits if self._until_ns == NEVER else bits | TARGET_REACHED
