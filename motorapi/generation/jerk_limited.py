"""Time-optimal jerk-limited motions: from rest to rest in closed form, others by a package.

From rest to rest, a ramp to the peak p takes p/a + a/j, or 2 sqrt(p/j) if it does not reach its
acceleration a, and covers p/2 times that. The peak is the velocity limit, or the p for which both
ramps cover the distance. It is found by bisection, which needs no root but the square root.

All other motions need the package ruckig (optional extra). Its tolerances are absolute. Therefore
problems are scaled to units in which the jerk and the longest of the relevant lengths are 1; the
results are scaled back.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 3.4;
L. Berscheid, T. Kröger, Jerk-limited Real-time Trajectory Generation with Arbitrary Target States
(2021).
"""

from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import pairwise
from math import inf, isfinite, sqrt
from typing import TYPE_CHECKING, Any, Final, TypeAlias, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import PluginError, UnsupportedError, UsageError
from motorhil.motorapi.generation.limits import ProfileLimits

if TYPE_CHECKING:
    from motorhil.motorapi.functions.piecewise import Piecewise

_ROUNDING: Final = 1e-9
_NAMES: Final = ("value", "velocity", "acceleration")

State: TypeAlias = tuple[float, float, float]
"""(value [U], first derivative [U/s], second derivative [U/s²])."""
Phase: TypeAlias = tuple[float, float]
"""(duration [s], third derivative [U/s³])."""


@final
@frozen
class SmoothTask:
    """Two states and the limits between them, checked.

    Attributes:
        begin, end: the states.
        velocity: range of the first derivative [U/s].
        acceleration: range of the second derivative [U/s²].
        jerk: maximum magnitude of the third derivative [U/s³].

    Raises:
        UsageError: a number is not finite, or a state lies outside the limits or inevitably leaves
            them.
    """

    begin: State
    end: State
    velocity: tuple[float, float]
    acceleration: tuple[float, float]
    jerk: float

    def __post_init__(self) -> None:
        if not all(map(isfinite, (*self.begin, *self.end))):
            raise UsageError(f"a number in {self.begin} or {self.end} is not finite")
        if not 0.0 < self.jerk < inf:
            raise UsageError(f"the limit of jerk is {self.jerk}, not finite and > 0")
        # The velocity inevitably reached before its derivative is 0, or reached since it was 0.
        for where, (_, velocity, acceleration), sense in (
            ("initial", self.begin, 1.0),
            ("final", self.end, -1.0),
        ):
            reached = velocity + sense * acceleration * abs(acceleration) / (2.0 * self.jerk)
            for name, number, (low, high) in (
                ("velocity", velocity, self.velocity),
                ("acceleration", acceleration, self.acceleration),
                ("velocity, by its acceleration,", reached, self.velocity),
            ):
                slack = 1e-12 * abs(number)
                if not low - slack <= number <= high + slack:
                    raise UsageError(
                        f"the {where} {name} {number:g} lies outside its limits,"
                        f" {low:g} to {high:g}"
                    )

    @property
    def units(self) -> tuple[float, float]:
        """(length, time) of the units in which the problem has size 1."""
        lengths = [abs(self.end[0] - self.begin[0])]
        for _, velocity, acceleration in (self.begin, self.end):
            lengths.append(abs(velocity) ** 1.5 / self.jerk**0.5)
            lengths.append(abs(acceleration) ** 3 / self.jerk**2)
        length = max(lengths) or 1.0
        return length, float((length / self.jerk) ** (1.0 / 3.0))


def jerk_limited(
    final: float,
    limits: ProfileLimits,
    jerk: float,
    *,
    initial: float = 0.0,
    initial_derivatives: Sequence[float] = (),
    final_derivatives: Sequence[float] = (),
    duration_s: float | None = None,
    initial_argument: float = 0.0,
) -> "Piecewise":
    """Return the shortest motion between two states within the limits, as cubic pieces.

    Value, first and second derivative are continuous except for rounding (1e-9 of the distance, at
    the last break): the last piece is computed from the end, so both boundary states are exact.

    Args:
        final: the final value [U]; the distance, if `initial` is 0.
        limits: of velocity and acceleration. If they differ between forward and backward motion,
            the tighter one applies to both, except from rest to rest: the package has one range
            only.
        jerk: maximum magnitude of the third derivative [U/s³].
        initial: the initial value [U].
        initial_derivatives: first and second at the beginning; missing ones are 0.
        final_derivatives: first and second at the end; missing ones are 0.
        duration_s: duration [s]; None: the shortest possible.
        initial_argument: argument at the beginning.

    Raises:
        PluginError: the package finds no motion, or a wrong one; each result is verified.
        UnsupportedError: the package is needed and not installed; names the extra.
        UsageError: a number is not finite, a state lies outside the limits or must leave them, or
            no motion has that duration, or the motion takes no time.
    """
    task = _task_of(final, limits, jerk, initial, initial_derivatives, final_derivatives)
    if not isfinite(initial_argument):
        raise UsageError(f"the initial argument is {initial_argument}, not a finite number")
    if duration_s is None and not any((*task.begin[1:], *task.end[1:])):
        phases = _from_rest_to_rest(final - initial, limits, jerk)
    else:
        phases = _phases_of(task, duration_s)
    return _function(task, phases, initial_argument)


def _from_rest_to_rest(distance: float, limits: ProfileLimits, jerk: float) -> list[Phase]:
    """Return the phases of the shortest motion over a distance."""
    if distance >= 0.0:
        high, (fall, rise), sign = limits.velocity[1], limits.forward, 1.0
    else:
        high, (fall, rise), sign = -limits.velocity[0], limits.backward, -1.0
        fall, rise = -rise, -fall
    way = abs(distance)

    def covered(peak: float) -> float:
        both_s = _lasts_s(_ramp(peak, rise, jerk)) + _lasts_s(_ramp(peak, -fall, jerk))
        return 0.5 * peak * both_s

    peak = _peak(way, high, covered)
    if peak == 0.0:
        return []
    hold_s = max(0.0, (way - covered(peak)) / peak) if peak == high else 0.0
    up = _ramp(peak, rise, jerk)
    down = [(lasts_s, -change) for lasts_s, change in _ramp(peak, -fall, jerk)]
    phases = [*up, (hold_s, 0.0), *down]
    return [(lasts_s, sign * change) for lasts_s, change in phases if lasts_s > 0.0]


def _peak(way: float, high: float, covered: Callable[[float], float]) -> float:
    """Return the velocity, at most `high`, whose ramps cover the distance, by bisection."""
    if way == 0.0 or (high < inf and covered(high) <= way):
        return high if way else 0.0
    low, above = 0.0, 1.0
    while covered(above) < way:
        low, above = above, 2.0 * above
    while low < (middle := 0.5 * (low + above)) < above:
        if covered(middle) <= way:
            low = middle
        else:
            above = middle
    return low


def _ramp(peak: float, acceleration: float, jerk: float) -> list[Phase]:
    """Return the phases of a ramp from 0 to a velocity."""
    if peak * jerk < acceleration * acceleration:
        bend_s = sqrt(peak / jerk)
        return [(bend_s, jerk), (bend_s, -jerk)]
    bend_s = acceleration / jerk
    return [(bend_s, jerk), (max(0.0, peak / acceleration - bend_s), 0.0), (bend_s, -jerk)]


def _lasts_s(phases: Sequence[Phase]) -> float:
    return sum(lasts_s for lasts_s, _ in phases)


def _task_of(
    final: float,
    limits: ProfileLimits,
    jerk: float,
    initial: float,
    initial_derivatives: Sequence[float],
    final_derivatives: Sequence[float],
) -> SmoothTask:
    """Return the states and limits, checked."""
    if not isinstance(limits, ProfileLimits):
        raise UsageError(f"limits is {limits!r}; give ProfileLimits(velocity, acceleration)")
    forward, backward = limits.forward, limits.backward
    acceleration = (max(forward[0], backward[0]), min(forward[1], backward[1]))
    begin = (initial, *_two(initial_derivatives))
    end = (final, *_two(final_derivatives))
    return SmoothTask(begin, end, limits.velocity, acceleration, jerk)


def _phases_of(task: SmoothTask, duration_s: float | None = None) -> list[Phase]:
    """Return the durations and jerks of the phases, in order.

    Raises:
        UnsupportedError: the package is not installed.
        PluginError: the package finds no motion, or a wrong one.
        UsageError: no motion has that duration.
    """
    ruckig = _load()
    length, time = task.units
    given = _input_of(ruckig, task, length, time)
    if duration_s is not None:
        if not (isfinite(duration_s) and duration_s >= 0.0):
            raise UsageError(f"the duration is {duration_s} s, not a finite number >= 0")
        given.minimum_duration = duration_s / time
    made = ruckig.Trajectory(1)
    try:
        result = ruckig.Ruckig(1).calculate(given, made)
    except ruckig.RuckigError as error:
        raise _failed(task, str(error).strip().splitlines()[0]) from None
    if result != ruckig.Result.Working:
        raise _failed(task, str(result))
    phases = phases_in(made.profiles[0][0], length, time)
    _judge(task, phases)
    takes_s = sum(lasts_s for lasts_s, _ in phases)
    if duration_s is not None and abs(takes_s - duration_s) > _ROUNDING * takes_s:
        raise UsageError(
            f"this motion cannot take {duration_s:g} s; the next possible duration is {takes_s:g} s"
        )
    return phases


def _judge(task: SmoothTask, phases: Sequence[Phase]) -> None:
    """Verify the result of the package to 1e-9.

    Raises:
        PluginError: it is wrong; observed if limits and states differ by more than three decades.
    """
    length, time = task.units
    pieces = _pieces_of(task, phases)
    reached = _pieces_of(task, [*phases, (1.0, 0.0)])[-1][2]
    ways = [abs(state[0] - task.begin[0]) for _, _, state in pieces]
    sizes = (max(ways, default=0.0), length / time, length / time**2)
    for name, found, asked, size in zip(_NAMES, reached, task.end, sizes, strict=True):
        if abs(found - asked) > _ROUNDING * (size + abs(asked)):
            raise _failed(task, f"its final {name} is {found:g}")
    for (lasts_s, jerk, (_, before, rate)), (_, _, (_, after, _)) in pairwise(
        [*pieces, (0.0, 0.0, task.end)]
    ):
        velocities = [before, after]
        if jerk and 0.0 < -rate / jerk < lasts_s:
            velocities.append(before - 0.5 * rate * rate / jerk)  # at zero acceleration
        for name, values, (low, high), size in (
            ("velocity", velocities, task.velocity, sizes[1]),
            ("acceleration", [rate], task.acceleration, sizes[2]),
        ):
            rounding = 1e-12 * size
            slack_low, slack_high = -_ROUNDING * low + rounding, _ROUNDING * high + rounding
            if min(values) < low - slack_low or max(values) > high + slack_high:
                raise _failed(task, f"its {name} goes from {min(values):g} to {max(values):g}")


def _failed(task: SmoothTask, problem: str) -> PluginError:
    """Return the error for a wrong result of the package."""
    return PluginError(
        plugin="ruckig",
        where="Ruckig.calculate",
        problem=f"no motion from {task.begin} to {task.end} (value, velocity, acceleration):"
        f" {problem}",
    )


def _load() -> Any:
    """Import and return the package.

    Raises:
        UnsupportedError: it is not installed; names the extra.
    """
    try:
        return import_module("ruckig")
    except ImportError:
        raise UnsupportedError(
            motor="this installation",
            feature="jerk-limited trajectories without the package ruckig",
            supported="them with the extra ruckig: pip install 'motorhil[ruckig]'",
        ) from None


def _input_of(ruckig: Any, task: SmoothTask, u: float, t: float) -> Any:
    """Return the input parameter of one degree of freedom in these units of length and time."""
    given = ruckig.InputParameter(1)
    given.current_position = [0.0]
    given.target_position = [(task.end[0] - task.begin[0]) / u]
    given.current_velocity = [task.begin[1] * t / u]
    given.target_velocity = [task.end[1] * t / u]
    given.current_acceleration = [task.begin[2] * t * t / u]
    given.target_acceleration = [task.end[2] * t * t / u]
    given.min_velocity = [task.velocity[0] * t / u]
    given.max_velocity = [task.velocity[1] * t / u]
    given.min_acceleration = [task.acceleration[0] * t * t / u]
    given.max_acceleration = [task.acceleration[1] * t * t / u]
    given.max_jerk = [task.jerk * t * t * t / u]
    return given


def phases_in(profile: Any, length: float, time: float) -> list[Phase]:
    """Return the phases of one degree of freedom in our units, without those of no duration."""
    jerk = length / time**3
    found: list[Phase] = []
    for part in (profile.brake, profile):
        found += [(lasts * time, third * jerk) for lasts, third in zip(part.t, part.j, strict=True)]
    return [phase for phase in found if phase[0] > 0.0]


def _pieces_of(task: SmoothTask, phases: Sequence[Phase]) -> list[tuple[float, float, State]]:
    """Return (duration, jerk, initial state) of each phase."""
    value, velocity, acceleration = task.begin
    found: list[tuple[float, float, State]] = []
    for lasts_s, jerk in phases:
        found.append((lasts_s, jerk, (value, velocity, acceleration)))
        value += (velocity + (acceleration / 2.0 + jerk / 6.0 * lasts_s) * lasts_s) * lasts_s
        velocity += (acceleration + jerk / 2.0 * lasts_s) * lasts_s
        acceleration += jerk * lasts_s
    return found


def _function(task: SmoothTask, phases: Sequence[Phase], initial_argument: float) -> "Piecewise":
    from motorhil.motorapi.functions.piecewise import Piecewise
    from motorhil.motorapi.functions.polynomial import Polynomial

    edges, polynomials = [initial_argument], []
    since_s = 0.0
    pieces = _pieces_of(task, phases)
    for index, (lasts_s, jerk, state) in enumerate(pieces):
        about = initial_argument + since_s
        since_s += lasts_s
        edge = initial_argument + since_s
        if index == len(pieces) - 1:
            about, state = edge, task.end
        if edge > edges[-1]:
            edges.append(edge)
            value, velocity, acceleration = state
            rest = (velocity, acceleration / 2.0, jerk / 6.0)
            polynomials.append(Polynomial((value, *rest), about))
    if not polynomials:
        raise UsageError(
            f"the motion from {task.begin} to {task.end} takes no time: it is not a function"
        )
    return Piecewise(edges, polynomials)


def _two(derivatives: Sequence[float]) -> tuple[float, float]:
    if len(derivatives) > 2:
        raise UsageError(f"derivatives are {derivatives!r}; expected (first,) or (first, second)")
    first, second = (*derivatives, 0.0, 0.0)[:2]
    return first, second
