"""Inverse dynamic model of an axis, fitted by least squares (IDIM-LS).

    effort = inertia * a + viscous * v + coulomb * sign(v) + offset

A turning axis that travels far enough may have a pendulum's torque as well, with one parameter for
its sine and one for its cosine.

Position is filtered forwards and backwards, so that nothing is delayed, and differentiated by
central differences. Both sides are then low-passed and decimated alike: errors of what remains are
nearly independent, and standard deviations mean something.

Source: Janot, Gautier and Brunot, "Data Set and Reference Models of EMPS", 2019 workshop on
nonlinear system identification benchmarks; Gautier, "Dynamic identification of robots with power
model", ICRA 1997.
"""

import math
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from motorhil.frozen import frozen
from motorhil.harness.identification.samples import Samples
from motorhil.harness.rig.config.toml import RigError

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

NAMES: Final = ("inertia", "viscous", "coulomb", "offset")
GRAVITY: Final = ("gravity sine", "gravity cosine")
"""Torques in proportion to the sine and the cosine of the position."""
DELAY: Final = "delay"
SIDES: Final = ("viscous forwards", "viscous backwards", "coulomb forwards", "coulomb backwards")
"""Frictions of a model without offset, one for each direction."""
_ORDER: Final = 4
_CUT_SHARE: Final = 0.4  # of the Nyquist frequency: where the position's filter begins
_BOTH_SHARE: Final = 0.3  # likewise, of the filter of both sides, which must be the lower one
_DECIMATION_HZ: Final = 100.0
_EDGE: Final = 50  # samples at each end, which filters spoil
_SEEN: Final = 0.25
"""Relative standard deviation above which a parameter is not seen."""
_NOTHING: Final = 0.01  # share of the effort of a parameter that is known to be next to nothing
_TRAVEL_RAD: Final = 0.52  # 30 degrees: below it, gravity is a constant load
_SWINGS: Final = 0.8  # of the effort that is left without gravity: there is gravity
_MOVES: Final = 0.02  # of the highest speed: below it the axis rests, as far as friction goes


@final
@frozen
class Parameter:
    """A parameter of the model.

    Attributes:
        name: one of NAMES, of GRAVITY, or DELAY [s].
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

    @property
    def told(self) -> str:
        """Its value up to the second digit of its deviation, at least one digit.

        More digits would say nothing, and differ between processors, which round differently.
        """
        if not self.value or not 0.0 < self.deviation < math.inf:
            return f"{self.value:.5g}"
        digits = 2 + _exponent(self.value) - _exponent(self.deviation)
        return f"{self.value:.{max(1, digits)}g}"

    @property
    def share_told(self) -> str:
        """Its deviation in percent, with two digits; "-" without a value."""
        percent = 100.0 * self.relative
        if not 0.0 < percent < math.inf:
            return "-"
        decimals = 1 - _exponent(percent)
        return f"{round(percent, decimals):.{max(0, decimals)}f}%"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value)))


@final
@frozen
class Fit:
    """A fitted model.

    Attributes:
        parameters: by name: NAMES, GRAVITY if the axis has it, DELAY if it was searched.
        error: norm of the effort that the model does not explain, as a share of the effort's.
        condition: condition number of the scaled regressor.
        samples: number of decimated samples.
    """

    parameters: dict[str, Parameter]
    error: float
    condition: float
    samples: int

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters of the model's equation."""
        return tuple(name for name in self.parameters if name != DELAY)

    @property
    def values(self) -> list[float]:
        """The values of the parameters of the model's equation."""
        return [self.parameters[name].value for name in self.names]

    @property
    def delay_s(self) -> float:
        """The delay of the efforts [s]; 0.0: it was not searched."""
        return self.parameters[DELAY].value if DELAY in self.parameters else 0.0


@final
@frozen
class Terms:
    """Both sides of the model's equation, filtered and decimated.

    Attributes:
        names: the parameters.
        regressor: a column for each, shape (n, p).
        effort: shape (n,).
        velocity: shape (n,).
        scale: norms of the columns, shape (p,); 1 for a column of zeros.
    """

    names: tuple[str, ...]
    regressor: "NDArray[float64]"
    effort: "NDArray[float64]"
    velocity: "NDArray[float64]"
    scale: "NDArray[float64]"

    def effort_error(self, values: "NDArray[float64]") -> float:
        """Return the share of the effort that these values do not explain."""
        rest = self.effort - self.regressor @ values
        return float(np.linalg.norm(rest) / np.linalg.norm(self.effort))

    def condition(self) -> float:
        """Return the condition number of the scaled regressor."""
        return float(np.linalg.cond(self.regressor / self.scale))


def fitted(samples: Samples) -> Fit:
    """Return the model that explains the efforts of these samples best.

    Raises:
        RigError: scipy is not installed, or the motor does not move.
    """
    fit = _best(terms_of(samples))
    if samples.unit != "rad" or float(np.ptp(samples.position)) < _TRAVEL_RAD:
        return fit
    swinging = _best(terms_of(samples, names=(*NAMES, *GRAVITY)))
    return swinging if swinging.error < _SWINGS * fit.error else fit


def _best(terms: Terms) -> Fit:
    values, deviations = _solved(terms.regressor, terms)
    return fit_of(values, deviations, terms)


def friction_by_direction(
    samples: Samples, delay_s: float = 0.0, names: tuple[str, ...] = NAMES
) -> tuple[dict[str, Parameter], float]:
    """Return frictions of a model with one for each direction, and the effort it leaves.

    A constant load takes the place of a difference between the directions, so that this model has
    no offset. Where it leaves less effort than the other, friction depends on the direction.

    Returns:
        The parameters of SIDES, and the share of the effort that this model does not explain.
    """
    terms = terms_of(samples, delay_s, names)
    inertia, viscous, coulomb, _, *others = terms.regressor.T
    ahead, back = terms.velocity > 0.0, terms.velocity <= 0.0
    sides = (viscous * ahead, viscous * back, coulomb * ahead, coulomb * back)
    regressor = np.column_stack([inertia, *sides, *others])
    values, deviations = _solved(regressor, terms)
    rest = terms.effort - regressor @ values
    found = {
        name: Parameter(name, value, deviation)
        for name, value, deviation in zip(
            SIDES, values[1:5].tolist(), deviations[1:5].tolist(), strict=True
        )
        if deviation
    }
    return found, float(np.linalg.norm(rest) / np.linalg.norm(terms.effort))


def _solved(
    regressor: "NDArray[float64]", terms: Terms
) -> "tuple[NDArray[float64], NDArray[float64]]":
    """Return values and deviations of the columns' parameters; both 0 for a column of zeros."""
    scale = np.linalg.norm(regressor, axis=0)
    scale[scale == 0.0] = 1.0
    scaled = regressor / scale
    values, *_ = np.linalg.lstsq(scaled, terms.effort, rcond=None)
    rest = terms.effort - scaled @ values
    variance = float(rest @ rest) / max(1, len(rest) - len(scale))
    covariance = variance * np.linalg.pinv(scaled.T @ scaled)
    return values / scale, np.sqrt(np.diag(covariance)) / scale


def fit_of(values: "NDArray[float64]", deviations: "NDArray[float64]", terms: Terms) -> Fit:
    """Return a fit with these values; those that the recording does not show say so."""
    effort = float(np.linalg.norm(terms.effort))
    parameters = {}
    for name, value, deviation, scale in zip(
        terms.names, values.tolist(), deviations.tolist(), terms.scale.tolist(), strict=True
    ):
        share = abs(value) * scale / effort if effort else 0.0
        unseen, remedy = _unseen(name, value, deviation, share, terms.velocity)
        parameters[name] = Parameter(name, value, deviation, unseen, remedy)
    return Fit(parameters, terms.effort_error(values), terms.condition(), len(terms.effort))


def effort_error(fit: Fit, samples: Samples) -> float:
    """Return the share of the effort of other samples that the model does not explain."""
    return terms_of(samples, fit.delay_s, fit.names).effort_error(np.array(fit.values))


def terms_of(samples: Samples, delay_s: float = 0.0, names: tuple[str, ...] = NAMES) -> Terms:
    """Return both sides of the equation, with efforts that are recorded `delay_s` late.

    Raises:
        RigError: scipy is not installed, or the motor does not move.
    """
    signal = _signal()
    period = samples.period_s
    above, below = signal.butter(_ORDER, _CUT_SHARE)
    position = signal.filtfilt(above, below, samples.position)
    velocity = np.gradient(position, period)
    acceleration = np.gradient(velocity, period)
    columns = [acceleration, velocity, np.sign(velocity), np.ones_like(velocity)]
    if len(names) > len(columns):
        columns += [np.sin(position), np.cos(position)]
    edge = min(_EDGE, len(position) // 8)
    kept = slice(edge, -edge)
    every = max(1, round(1.0 / (period * _DECIMATION_HZ)))
    low = signal.butter(_ORDER, min(0.8 / every, _BOTH_SHARE))

    def reduced(values: "NDArray[float64]") -> "NDArray[float64]":
        out: NDArray[float64] = signal.filtfilt(*low, values[kept])[::every]
        return out

    regressor = np.column_stack([reduced(one) for one in columns])
    scale = np.linalg.norm(regressor, axis=0)
    if not scale[0] or not scale[1]:
        raise RigError(samples.name, "does not move in this recording", "record a motion")
    scale[scale == 0.0] = 1.0
    times = np.arange(len(position)) * period
    effort = np.interp(times + delay_s, times, samples.effort) if delay_s else samples.effort
    return Terms(names, regressor, reduced(effort), reduced(velocity), scale)


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
    return reasons.get(name, ("the axis turns too little", "turn by half a turn or more"))


def _signal() -> Any:
    try:
        from scipy import signal
    except ImportError:
        remedy = "install motorhil[identify]"
        raise RigError("identify", "scipy is not installed", remedy) from None
    return signal
