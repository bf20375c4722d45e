"""What a controller takes for the time: its oscillator is a little fast or slow, and out of phase.

Crystals are off by tens of ppm, each by its own amount, so no two drives agree on how long a
millisecond is, or on when the next one begins. Everything that a controller times by itself (servo
period, profile, heartbeat, timers) is so long by its own clock; the plant moves in true time.

The reckoning is in whole numbers, both ways, so that it is exact however long a run is.
"""

from dataclasses import dataclass
from typing import Final, final

ONE: Final = 10**12  # the rate of an ideal clock; an error of 1 ppm is a millionth of it


@final
@dataclass(frozen=True, slots=True)
class Oscillator:
    """A clock of constant rate.

    Attributes:
        error_1e12: how much faster than true it runs, in 1e-12; negative: slower. Above -1e12.
        phase_ns: what it shows at true time 0 [ns]; grids such as the servo's start from its 0.
        jitter_ns: by how much its timers fire late at most; see emulators.firmware.late_wakes.
        jitter_seed: from which each lateness follows.
    """

    error_1e12: int = 0
    phase_ns: int = 0
    jitter_ns: int = 0
    jitter_seed: int = 0

    def is_ideal(self) -> bool:
        """Whether it shows the true time, and its timers fire in time."""
        return self.shows_true_time() and not self.jitter_ns

    def shows_true_time(self) -> bool:
        """Whether there is nothing to translate."""
        return not self.error_1e12 and not self.phase_ns

    def rate(self) -> float:
        """Seconds it counts in a true second; exactly 1.0 without an error."""
        return (ONE + self.error_1e12) / ONE

    def own_ns(self, true_ns: int) -> int:
        """What it shows at the true time [ns], rounded down."""
        return self.phase_ns + true_ns + true_ns * self.error_1e12 // ONE

    def true_ns(self, own_ns: int) -> int:
        """The first true time at which it shows `own_ns` or more [ns]; not before 0."""
        passed_ns = own_ns - self.phase_ns
        if passed_ns <= 0:
            return 0
        return -(-passed_ns * ONE // (ONE + self.error_1e12))

    def told(self) -> str:
        """What is wrong with it, in words."""
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
