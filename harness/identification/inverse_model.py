"""Inverse dynamic model of an axis, fitted by least squares (IDIM-LS).

    effort = inertia * a + viscous * v + coulomb * sign(v) + offset

Position is filtered forwards and backwards, so that nothing is delayed, and differentiated by
central differences. Both sides are then low-passed and decimated alike: errors of what remains are
nearly independent, and standard deviations mean something.

Source: Janot, Gautier and Brunot, "Data Set and Reference Models of EMPS", 2019 workshop on
nonlinear system identification benchmarks; Gautier, "Dynamic identification of robots with power
model", ICRA 1997.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from motorhil.harness.identification.samples import Samples
from motorhil.harness.rig.config.toml import RigError

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

NAMES: Final = ("inertia", "viscous", "coulomb", "offset")
_ORDER: Final = 4
_CUT_SHARE: Final = 0.4  # of the Nyquist frequency: where the position's filter begins
_BOTH_SHARE: Final = 0.3  # likewise, of the filter of both sides, which must be the lower one
_DECIMATION_HZ: Final = 100.0
_EDGE: Final = 50  # samples at each end, which filters spoil
_SEEN: Final = 0.25
"""Relative standard deviation above which a parameter is not seen."""
_NOTHING: Final = 0.01  # share of the effort of a parameter that is known to be next to nothing
_MOVES: Final = 0.02  # of the highest speed: below it the axis rests, as far as friction goes


@final
@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the model.

    Attributes:
        name: one of NAMES.
        value: in SI units of the output.
        deviation: its standard deviation, in the same unit.
        unseen: why the recording does not show it; "" if it does.
        remedy: the motion that would show it; "" if it is seen.
    """

    name: str
    value: float
    deviation: float
    unseen: str = ""
    remedy: str = ""

    @property
    def relative(self) -> float:
        """Standard deviation as a share of the value."""
        return abs(self.deviation / self.value) if self.value else float("inf")


@final
@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted model.

    Attributes:
        parameters: by name, in the order of NAMES.
        error: norm of the effort that the model does not explain, as a share of the effort's.
        condition: condition number of the scaled regressor.
        samples: number of decimated samples.
    """

    parameters: dict[str, Parameter]
    error: float
    condition: float
    samples: int


def fitted(samples: Samples) -> Fit:
    """Return the model that explains the efforts of these samples best.

    Raises:
        RigError: scipy is not installed, or the motor does not move.
    """
    regressor, effort, velocity = _prepared(samples)
    scale = np.linalg.norm(regressor, axis=0)
    if not scale[0] or not scale[1]:
        raise RigError(samples.name, "does not move in this recording", "record a motion")
    scale[scale == 0.0] = 1.0
    scaled = regressor / scale
    values, *_ = np.linalg.lstsq(scaled, effort, rcond=None)
    rest = effort - scaled @ values
    freedom = max(1, len(effort) - len(NAMES))
    variance = float(rest @ rest) / freedom
    covariance = variance * np.linalg.pinv(scaled.T @ scaled)
    deviations = np.sqrt(np.diag(covariance)) / scale
    values = values / scale
    parameters = {}
    for number, name in enumerate(NAMES):
        value, deviation = float(values[number]), float(deviations[number])
        share = abs(value) * float(scale[number]) / float(np.linalg.norm(effort))
        unseen, remedy = _unseen(name, value, deviation, share, velocity)
        parameters[name] = Parameter(name, value, deviation, unseen, remedy)
    error = float(np.linalg.norm(rest) / np.linalg.norm(effort))
    return Fit(parameters, error, float(np.linalg.cond(scaled)), len(effort))


def effort_error(fit: Fit, samples: Samples) -> float:
    """Return the share of the effort of other samples that the model does not explain."""
    regressor, effort, _ = _prepared(samples)
    values = np.array([fit.parameters[name].value for name in NAMES])
    return float(np.linalg.norm(effort - regressor @ values) / np.linalg.norm(effort))


def _prepared(
    samples: Samples,
) -> "tuple[NDArray[float64], NDArray[float64], NDArray[float64]]":
    """Return the decimated regressor (n, 4), efforts (n,) and velocities (n,)."""
    signal = _signal()
    period = samples.period_s
    above, below = signal.butter(_ORDER, _CUT_SHARE)
    position = signal.filtfilt(above, below, samples.position)
    velocity = np.gradient(position, period)
    acceleration = np.gradient(velocity, period)
    columns = [acceleration, velocity, np.sign(velocity), np.ones_like(velocity)]
    edge = min(_EDGE, len(position) // 8)
    kept = slice(edge, -edge)
    every = max(1, round(1.0 / (period * _DECIMATION_HZ)))
    low = signal.butter(_ORDER, min(0.8 / every, _BOTH_SHARE))

    def reduced(values: "NDArray[float64]") -> "NDArray[float64]":
        out: NDArray[float64] = signal.filtfilt(*low, values[kept])[::every]
        return out

    regressor = np.column_stack([reduced(one) for one in columns])
    return regressor, reduced(samples.effort), reduced(velocity)


def _unseen(
    name: str, value: float, deviation: float, share: float, velocity: "NDArray[float64]"
) -> tuple[str, str]:
    """Return why a parameter is not seen, and the motion that would show it.

    `share` is the part of the effort that it explains.
    """
    fastest = float(np.max(np.abs(velocity)))
    forwards = np.any(velocity > _MOVES * fastest)
    backwards = np.any(velocity < -_MOVES * fastest)
    if name in ("coulomb", "offset") and not (forwards and backwards):
        why = "the motor never reverses, so that friction and a constant load look alike"
        return why, "move there and back"
    if value and abs(deviation / value) <= _SEEN:
        return "", ""
    if share <= _NOTHING:
        return "", ""  # it is known to be next to nothing
    reasons = {
        "inertia": ("the motor hardly accelerates", "accelerate harder, with several ramps"),
        "viscous": ("all speeds are alike", "move at several speeds"),
        "coulomb": ("the motor moves too little", "move slowly, there and back"),
        "offset": ("noise hides a constant load", "move longer"),
    }
    return reasons[name]


def _signal() -> Any:
    try:
        from scipy import signal  # type: ignore[import-untyped] # it has no stubs of its own
    except ImportError:
        remedy = "install motorhil[identify]"
        raise RigError("identify", "scipy is not installed", remedy) from None
    return signal
