"""Resonance of an axis whose load is coupled by a spring, from torque and position of its motor.

A rigid axis has the same inertia at every frequency. With an elastic coupling, the inertia that the
motor feels has an antiresonance, where the load moves alone, and above it a resonance:

    f_a = sqrt(k / J_load) / 2 pi,    f_r = f_a sqrt(1 + J_load / J_rotor)

The ratio of acceleration and effort, times the inertia, is 1 for a rigid axis. Only frequencies
count at which both are coherent: beyond them the motion shows nothing, and says so.

Source: Ellis, "Control System Design Guide" (2012), ch. 16, compliance and resonance; Bendat and
Piersol, "Random Data" (2010), ch. 6, frequency response by cross-spectra.
"""

from typing import TYPE_CHECKING, Final, final

import numpy as np

from motorhil.frozen import frozen
from motorhil.harness.identification.samples import Samples

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

_SEGMENT_S: Final = 2.0
_COHERENT: Final = 0.7
_LEAST_HZ: Final = 2.0  # below it, friction is most of the effort
_DIP: Final = 0.55  # of the ratio: a deeper one begins a search
_PEAK: Final = 1.8  # times the dip, behind it
_START: Final = 1.6  # times the antiresonance: where the search begins
_FLOOR: Final = 0.15  # dips and peaks are as deep as damping lets them
_SPREAD: Final = 0.3  # of the logarithms, within which a ratio counts fully
_APART: Final = 1.1  # resonance by antiresonance: a closer pair is a load of a sixth or less
_BIAS: Final = 0.03  # of both frequencies, as friction and the servo's ripple leave it
_UNSURE: Final = 0.1  # of the frequency: a larger deviation is not seen
_BINS: Final = 3  # in a row, which must be coherent
_TURN: Final = 2.0 * np.pi


@final
@frozen
class Resonance:
    """An elastic coupling, as seen from the motor.

    Attributes:
        seen_hz: the highest frequency at which the motion shows anything; 0.0: none.
        antiresonance_hz, resonance_hz: both; 0.0: none up to `seen_hz`.
        deviations_hz: the standard deviations of both.
    """

    seen_hz: float
    antiresonance_hz: float = 0.0
    resonance_hz: float = 0.0
    deviations_hz: tuple[float, float] = (0.0, 0.0)

    @property
    def is_seen(self) -> bool:
        """True if there is a resonance."""
        return self.resonance_hz > 0.0

    def load_share(self) -> float:
        """Return the share of the load in the inertia, 0 to 1; 0 if there is no resonance."""
        if not self.is_seen:
            return 0.0
        ratio = self.antiresonance_hz / self.resonance_hz
        return 1.0 - ratio * ratio

    def stiffness(self, inertia: float) -> float:
        """Return the stiffness at the output for this whole inertia [N m/rad or N/m]."""
        angular = _TURN * self.antiresonance_hz
        return angular * angular * self.load_share() * inertia

    def told(self) -> str:
        """Return what is seen, or why nothing is and which motion would show it, as a text."""
        if self.is_seen:
            return (
                f"resonance: {self.resonance_hz:.1f} Hz, deviation {self.deviations_hz[1]:.2g} Hz;"
                f" antiresonance: {self.antiresonance_hz:.1f} Hz,"
                f" deviation {self.deviations_hz[0]:.2g} Hz"
            )
        below = (
            f"none up to {self.seen_hz:.0f} Hz, and beyond" if self.seen_hz else "at no frequency"
        )
        return (
            f"resonance: not seen: {below} the motion has too little power;"
            " record a chirp of torque, or ramps that are shorter than its period"
        )


def resonance_in(samples: Samples, inertia: float) -> Resonance:
    """Return the resonance that these samples show, for an axis of this inertia."""
    from scipy import signal

    rate = 1.0 / samples.period_s
    acceleration = np.gradient(np.gradient(samples.position, samples.period_s), samples.period_s)
    size = min(len(acceleration) // 4, round(_SEGMENT_S * rate))
    frequencies, cross = signal.csd(samples.effort, acceleration, rate, nperseg=size)
    _, power = signal.welch(samples.effort, rate, nperseg=size)
    _, own = signal.welch(acceleration, rate, nperseg=size)
    coherence = np.abs(cross) ** 2 / np.maximum(power * own, np.finfo(float).tiny)
    ratio = abs(inertia) * np.abs(cross) / np.maximum(power, np.finfo(float).tiny)
    # Two central differences attenuate; what they lack is known.
    angle = np.pi * frequencies / rate
    ratio /= np.maximum(np.sinc(2.0 * angle / np.pi) ** 2, 0.05)
    kept = (frequencies >= _LEAST_HZ) & (frequencies < 0.4 * rate)
    return _found(frequencies[kept], ratio[kept], coherence[kept] >= _COHERENT)


def _found(
    frequencies: "NDArray[float64]", ratio: "NDArray[float64]", coherent: "NDArray[np.bool_]"
) -> Resonance:
    """Return the elastic coupling that explains the ratio best, if a dip shows one."""
    steady = np.convolve(coherent, np.ones(_BINS), "same") >= _BINS
    places = np.flatnonzero(steady)
    if not len(places):
        return Resonance(0.0)
    seen_hz = float(frequencies[places[-1]])
    low = ratio[: places[-1] + 1]
    bottom = int(np.argmin(low))  # little effort moves little: coherence may be low at the dip
    rest = low[bottom:]
    if low[bottom] > _DIP:
        return Resonance(seen_hz)
    below_hz = float(frequencies[max(0, bottom - 1)])  # the dip may be one, or not
    if float(np.median(rest[len(rest) // 2 :])) < _PEAK * low[bottom]:
        return Resonance(below_hz)
    start = np.log([1.0, frequencies[bottom], frequencies[bottom] * _START])
    kept = slice(0, int(places[-1]) + 1)
    found = _fitted(frequencies[kept], np.log(ratio[kept]), start)
    return Resonance(below_hz) if found is None else found


def _fitted(
    frequencies: "NDArray[float64]",
    logarithms: "NDArray[float64]",
    start: "NDArray[float64]",
) -> Resonance | None:
    """Return the coupling whose ratio of acceleration and effort is nearest; None: it is unsure."""
    from scipy import optimize

    def residuals(at: "NDArray[float64]") -> "NDArray[float64]":
        scale, antiresonance, resonance = np.exp(at)
        over = np.abs(1.0 - (frequencies / antiresonance) ** 2)
        under = np.abs(1.0 - (frequencies / resonance) ** 2)
        model = np.log(scale * np.maximum(over, _FLOOR) / np.maximum(under, _FLOOR))
        out: NDArray[float64] = model - logarithms
        return out

    result = optimize.least_squares(residuals, start, loss="soft_l1", f_scale=_SPREAD)
    freedom = max(1, len(frequencies) - len(start))
    covariance = np.linalg.pinv(result.jac.T @ result.jac) * 2.0 * result.cost / freedom
    _, antiresonance, resonance = np.exp(result.x).tolist()
    variances = np.diag(covariance)[1:] + _BIAS * _BIAS
    first, second = (np.sqrt(variances) * (antiresonance, resonance)).tolist()
    seen_hz = float(frequencies[-1])
    is_pair = result.success and _APART * antiresonance < resonance < seen_hz
    if not is_pair or max(first, second) > _UNSURE * resonance:
        return None
    return Resonance(seen_hz, antiresonance, resonance, (first, second))
