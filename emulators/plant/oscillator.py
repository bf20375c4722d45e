"""A controller's clock, with rate error and phase.

Crystals deviate by tens of ppm, each by its own amount. So no two drives agree on the length of a
millisecond, or on when the next one begins. The controller measures its own times (servo period,
profile, heartbeat, timers) with this clock. The plant moves in true time. Both conversions use
integers, and are exact however long a run is.
"""

from dataclasses import dataclass
from typing import Final, final

ONE: Final = 10**12  # rate of an ideal clock; 1 ppm is a millionth of it


@final
@dataclass(frozen=True, slots=True)
class Oscillator:
    """A clock of constant rate.

    Attributes:
        error_1e12: rate error in 1e-12; positive: fast, negative: slow. Above -1e12.
        phase_ns: own time at true time 0 [ns]; grids such as the servo's start at its 0.
        jitter_ns: maximum lateness of its timers [ns]; see `LateWakes`.
        jitter_seed: seed of the lateness.
    """

    error_1e12: int = 0
    phase_ns: int = 0
    jitter_ns: int = 0
    jitter_seed: int = 0

    def is_ideal(self) -> bool:
        """Return True if the clock shows true time and its timers have no jitter."""
        return self.shows_true_time() and not self.jitter_ns

    def shows_true_time(self) -> bool:
        """Return True if own time equals true time."""
        return not self.error_1e12 and not self.phase_ns

    def rate(self) -> float:
        """Return the own seconds per true second; exactly 1.0 without an error."""
        return (ONE + self.error_1e12) / ONE

    def own_ns(self, true_ns: int) -> int:
        """Return the own time at true time `true_ns` [ns], rounded down."""
        return self.phase_ns + true_ns + true_ns * self.error_1e12 // ONE

    def true_ns(self, own_ns: int) -> int:
        """Return the first true time >= 0 at which the clock shows `own_ns` or more [ns]."""
        passed_ns = own_ns - self.phase_ns
        if passed_ns <= 0:
            return 0
        return -(-passed_ns * ONE // (ONE + self.error_1e12))

    def told(self) -> str:
        """Describe the clock's errors in words."""
        words: list[str] = []
        if self.error_1e12:
            side = "fast" if self.error_1e12 > 0 else "slow"
            words.append(f"runs {abs(self.error_1e12) / 1e6:g} ppm {side}")
        if self.phase_ns:
            words.append(f"began at {self.phase_ns / 1e6:g} ms")
        if self.jitter_ns:
            words.append(f"wakes it up to {self.jitter_ns / 1e6:g} ms late")
        return f"its own clock {' and '.join(words) or 'shows the true time'}"


IDEAL: Final = Oscillator()
