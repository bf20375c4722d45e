"""Parameters of a plant by output error, through an emulated drive that follows the recording.

The search starts from the inverse dynamic model, and minimises the pull that the drive needs
(`follower`). A delay between positions and efforts is a parameter of its own, because a delay of
one sample that is left in spoils the inertia first.

Two things keep the deviations honest. The derivatives come from a run without the noise of the
recorded efforts, as instruments do: otherwise noise would be in derivatives and residuals alike.
And the residuals e are correlated, so that with derivatives J the covariance is A^-1 B A^-1, where
A = J'J, and B sums J_i' J_k c(i - k) with the correlation c of e, weighted by Bartlett's window.

Source: Newey and West, "A Simple, Positive Semi-definite, Heteroskedasticity and Autocorrelation
Consistent Covariance Matrix", Econometrica 55 (1987); Janot, Vandanjon and Gautier, "A Generic
Instrumental Variable Approach for Industrial Robot Identification", IEEE Trans. CST 22 (2014).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from motorhil.frozen import frozen
from motorhil.harness.identification.follower import (
    LOOP_RAD_S,
    Motion,
    motion_of,
    plant_of,
    pull_of,
)
from motorhil.harness.identification.inverse_model import (
    DELAY,
    Fit,
    Parameter,
    fit_of,
    terms_of,
)
from motorhil.harness.identification.samples import Samples
from motorhil.harness.rig.config.toml import RigError

if TYPE_CHECKING:
    from numpy import bool_, float64
    from numpy.typing import NDArray

_REDUCED: Final = 5.0  # residuals in one period of the drive's loop, roughly
_EDGE_LOOPS: Final = 6.0  # left out at both ends, as an angle of the loop
_REST: Final = 0.01  # of the highest speed: below it the axis rests, and shows nothing
_DELAY_SAMPLES: Final = 20.0
_STEP: Final = 0.02  # of each parameter, for derivatives
_LEAST: Final = 0.02  # of the effort: the scale of a parameter that starts near zero
_SIZES: Final = ("viscous", "coulomb")  # never below zero
_WINDOW: Final = 3  # residuals over which their correlation is counted
_BIAS: Final = {"inertia": 5e-4, "viscous": 1e-3, "coulomb": 1e-3}
"""Share of each value by which samples and ticks bias it, as measured without any noise.

Slow samples make the drive's loop slow, and the bias grows with the square of its period.
"""
_ROUNDS: Final = 2
_RUNS: Final = 6  # of the drive in each round, beside those for derivatives


def refined(samples: Samples, start: Fit, loop_rad_s: float = LOOP_RAD_S) -> Fit:
    """Return the model that lets the emulated drive follow the samples with the least pull.

    Args:
        samples: the recording.
        start: its inverse dynamic model.
        loop_rad_s: natural frequency of the drive's loop.

    Raises:
        RigError: the samples do not show the inertia, without which no plant can be emulated.
    """
    inertia = start.parameters["inertia"]
    if inertia.unseen or not inertia.value > 0.0:
        why = inertia.unseen or "its effort contradicts its acceleration"
        raise RigError(
            samples.name,
            f"the recording does not show the inertia: {why}",
            inertia.remedy or "check the sign of torque and position",
        )
    values, deviations = _Search(samples, start, loop_rad_s).found()
    delay_s = float(values[-1])
    found = fit_of(values[:-1], deviations[:-1], terms_of(samples, delay_s, start.names))
    found.parameters[DELAY] = _delay(delay_s, float(deviations[-1]), samples.period_s)
    return replace(found, error=compared(samples, found, loop_rad_s).error())


def _delay(value: float, deviation: float, period_s: float) -> Parameter:
    if deviation <= period_s:
        return Parameter(DELAY, value, deviation)
    why = "the effort changes too slowly"
    return Parameter(DELAY, value, deviation, why, "accelerate harder, with several ramps")


@final
@frozen
class Comparison:
    """Recorded and emulated efforts of one motion, low-passed to the band of the drive's loop.

    Attributes:
        times_s: shape (n,), from the recording's beginning.
        recorded, emulated: at the output, shape (n,) each [N m or N].
    """

    times_s: "NDArray[float64]"
    recorded: "NDArray[float64]"
    emulated: "NDArray[float64]"

    def error(self) -> float:
        """Return the share of the recorded effort that the emulated plant does not explain."""
        rest = self.recorded - self.emulated
        return float(np.linalg.norm(rest) / np.linalg.norm(self.recorded))


def compared(samples: Samples, fit: Fit, loop_rad_s: float = LOOP_RAD_S) -> Comparison:
    """Return the efforts of the recording, and those of an emulated plant that moves alike."""
    values = {
        name: max(value, 0.0) if name in _SIZES else value
        for name, value in zip(fit.names, fit.values, strict=True)
    }
    delay_s = fit.delay_s
    motion = motion_of(samples, values["inertia"], loop_rad_s)
    times = np.arange(len(motion.position)) * motion.tick_s
    effort = np.interp(times + delay_s, times, motion.effort)
    pull = pull_of(motion, plant_of(motion, values), delay_s)
    recorded, added, at = (_reduced(motion, one) for one in (effort, pull, times))
    inertia = motion.inertia
    return Comparison(at, recorded * inertia, (recorded + added) * inertia)


@final
class _Search:
    """The search for the parameters of one recording, in units of their own size."""

    def __init__(self, samples: Samples, start: Fit, loop_rad_s: float) -> None:
        self._names = start.names
        first = start.values
        self._motion = motion_of(samples, first[0], loop_rad_s)
        velocity = _smoothed_velocity(self._motion)
        least = np.full(len(first), _LEAST * float(np.std(samples.effort)))
        least[0] = 0.0
        least[1] /= float(np.std(velocity))
        self._scale = np.append(np.maximum(np.abs(first), least), samples.period_s)
        self._start = np.append(first, 0.0) / self._scale
        self._smooth = replace(self._motion, effort=_predicted(self._motion, velocity, first))
        speed = np.abs(_reduced(self._motion, velocity))
        self._moves: NDArray[bool_] = speed > _REST * float(speed.max())

    def found(self) -> "tuple[NDArray[float64], NDArray[float64]]":
        """Return values and deviations of the parameters and the delay."""
        from scipy import optimize

        low = np.array([0.0 if name in _SIZES else -np.inf for name in (*self._names, DELAY)])
        high = np.full(len(low), np.inf)
        low[0], low[-1], high[-1] = 1e-3, -_DELAY_SAMPLES, _DELAY_SAMPLES
        place = np.clip(self._start, low, high)
        for _ in range(_ROUNDS):
            slopes = self._slopes(place)
            result = optimize.least_squares(
                lambda at: self._residuals(at, self._motion),
                place,
                _constant(slopes),
                bounds=(low, high),
                xtol=1e-4,
                ftol=1e-5,
                max_nfev=_RUNS,
            )
            place = result.x
        covariance = _covariance(slopes, result.fun, self._moves)
        slowness = (LOOP_RAD_S / min(LOOP_RAD_S, self._motion.loop_rad_s)) ** 2
        bias = slowness * np.array([_BIAS.get(name, 0.0) for name in (*self._names, DELAY)])
        variances = np.diag(covariance) + (bias * place) ** 2
        return place * self._scale, np.sqrt(variances) * self._scale

    def _residuals(self, place: "NDArray[float64]", motion: Motion) -> "NDArray[float64]":
        values = place * self._scale
        plant = plant_of(motion, dict(zip(self._names, values[:-1].tolist(), strict=True)))
        return _reduced(motion, pull_of(motion, plant, float(values[-1]))) * self._moves

    def _slopes(self, place: "NDArray[float64]") -> "NDArray[float64]":
        """Return the derivatives, shape (n, p), in a run on smooth efforts."""
        base = self._residuals(place, self._smooth)
        columns: Sequence[NDArray[float64]] = [
            (self._residuals(place + _STEP * unit, self._smooth) - base) / _STEP
            for unit in np.eye(len(place))
        ]
        return np.column_stack(columns)


def _reduced(motion: Motion, values: "NDArray[Any]") -> "NDArray[float64]":
    """Return a signal low-passed and decimated to the band of the drive's loop."""
    from scipy import signal

    angle = motion.loop_rad_s * motion.tick_s
    edge = min(round(_EDGE_LOOPS / angle), len(values) // 8)
    every = max(1, round(2.0 * np.pi / (_REDUCED * angle)))
    low = signal.butter(4, min(0.8, 0.8 / every))
    out: NDArray[float64] = signal.filtfilt(*low, values[edge:-edge])[::every]
    return out


def _constant(slopes: "NDArray[float64]") -> "Callable[[NDArray[float64]], NDArray[float64]]":
    return lambda _: slopes


def _covariance(
    slopes: "NDArray[float64]", rest: "NDArray[float64]", moves: "NDArray[bool_]"
) -> "NDArray[float64]":
    """Return the covariance (p, p) for derivatives (n, p) and residuals (n,), 0 at rest."""
    count, size = int(moves.sum()), slopes.shape[1]
    inverse = np.linalg.pinv(slopes.T @ slopes)
    middle = float(rest @ rest) / count * (slopes.T @ slopes)
    for lag in range(1, _WINDOW + 1):
        pairs = int((moves[:-lag] & moves[lag:]).sum())
        weight = (1.0 - lag / (_WINDOW + 1)) * float(rest[:-lag] @ rest[lag:]) / max(1, pairs)
        product = slopes[:-lag].T @ slopes[lag:]
        middle += weight * (product + product.T)
    out: NDArray[float64] = inverse @ middle @ inverse * (count / max(1, count - size))
    return out


def _smoothed_velocity(motion: Motion) -> "NDArray[float64]":
    from scipy import signal

    angle = motion.loop_rad_s * motion.tick_s
    position = signal.filtfilt(*signal.butter(4, min(0.8, 2.0 * angle)), motion.position)
    out: NDArray[float64] = np.gradient(position, motion.tick_s)
    return out


def _predicted(
    motion: Motion, velocity: "NDArray[float64]", first: Sequence[float]
) -> "NDArray[float64]":
    """Return the effort that the inverse model expects, divided as in `motion`."""
    inertia, viscous, coulomb, offset, *gravity = first
    slow = _REST * float(np.max(np.abs(velocity)))
    effort = inertia * np.gradient(velocity, motion.tick_s) + viscous * velocity + offset
    for factor, wave in zip(gravity, (np.sin, np.cos), strict=False):  # none, or both
        effort = effort + factor * wave(motion.position)
    out: NDArray[float64] = (effort + coulomb * np.clip(velocity / slow, -1.0, 1.0)) / (
        motion.inertia
    )
    return out
