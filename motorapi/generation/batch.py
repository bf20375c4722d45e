"""Many piecewise polynomials with as many pieces each, evaluated at once.

Many profiles of given durations. The formulas are those of
`motorhil.motorapi.generation.trapezoid`.

Limits of many profiles at once.

Many generated profiles, evaluated at once.

Many motions of limited jerk, by the package ruckig: all degrees of freedom of one call.

Polynomials through way-points, many sets of them at once.

A piece between two way-points is given by the states at both: value and first derivative make it
cubic, the second derivative too makes it quintic. What is not given is chosen so that as many
derivatives as possible go through without a step: the second for cubics (the classical spline); for
quintics the fourth where the first is free, the third where the second is. These are the conditions
for the least integral of the squared second or third derivative. Each is a linear equation that
holds the numbers of the neighbours only; all are solved in one sweep there and back.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 4.4
and 4.5 (cubic splines), 2.1.5 and 4.6 (polynomials of degree 5).

Many motions to be made, and their peaks.

How soon way-points can be gone through within limits of the derivatives.

Slowing a motion from rest to rest down by a factor s makes its first derivative s times smaller,
its second s² times, its third s³ times. So for given *ratios* of the times the shortest ones follow
at once. The ratios begin as what each piece would take alone; then each time in turn is tried
longer and shorter, as long as that gains something, with a step that shrinks (a pattern search; of
more than 32 pieces the first ratios stay). That ends near the optimum, not provably at it; the
limits are held to rounding either way.

Many trapezoidal profiles at once, by the formulas of `motorhil.motorapi.generation.trapezoid`.

Functions through way-points, many at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorhil.motorapi.commands import DerivativeLimits
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation.jerk_limited import (
    Phase,
    SmoothTask,
    fill,
    judge,
    load,
    phases_in,
    phases_of,
    pieces_of,
    task_of,
)
from motorhil.motorapi.generation.limits import ProfileLimits
from motorhil.motorapi.generation.trapezoid import task_of as task_of_of_closed_form
from motorhil.motorapi.planning.limits import ROUNDING

if TYPE_CHECKING:
    from motorhil.motorapi.functions.piecewise import Piecewise

FloatArray: TypeAlias = NDArray[np.float64]


@final
class LimitArrays:
    """As `ProfileLimits`, with an array or a number in each place; accelerations are sizes.

    Not to be changed once made, nor the arrays it was made of.

    Attributes:
        high: the highest velocity [U/s].
        rise, fall: sizes of the second derivative while the first is > 0 [U/s²].
        back_rise, back_fall: likewise while it is < 0.
        is_symmetric: backward motion is known to have the same limits as forward motion.

    Args:
        velocity: (low, high), or x for (-x, x).
        acceleration: a range (low, high) of the second derivative, or a size while speeding up.
        deceleration: the size while slowing down; None: as `acceleration`.

    Raises:
        UsageError: a range is empty, does not hold 0, or is given together with `deceleration`;
            names the first index.
    """

    __slots__ = ("_low", "back_fall", "back_rise", "fall", "high", "is_symmetric", "rise")

    def __init__(
        self,
        velocity: ArrayLike | tuple[ArrayLike, ArrayLike],
        acceleration: ArrayLike | tuple[ArrayLike, ArrayLike],
        deceleration: ArrayLike | None = None,
    ) -> None:
        self._low: FloatArray | None = None  # as -high
        if isinstance(velocity, tuple):
            self._low, self.high = _array(velocity[0]), _array(velocity[1])
        else:
            self.high = _array(velocity)
        if isinstance(acceleration, tuple):
            if deceleration is not None:
                raise UsageError("deceleration goes with a size of acceleration, not with a range")
            self.rise = self.back_rise = _array(acceleration[1])
            self.fall = self.back_fall = -_array(acceleration[0])
        else:
            self.rise = self.back_fall = _array(acceleration)
            self.fall = self.back_rise = self.rise if deceleration is None else _array(deceleration)
        self.is_symmetric = self._low is None and self.rise is self.back_fall
        if self._low is None:
            refuse_first(self.high, "velocity is not > 0")
        else:
            widths = np.where((self._low <= 0.0) & (self.high >= 0.0), self.high - self._low, -1.0)
            refuse_first(widths, "velocity range must hold 0 and more than 0")
        for sizes in (self.rise, self.fall):
            refuse_first(sizes, "acceleration range must hold 0 inside, and deceleration be > 0")

    @classmethod
    def of(cls, limits: ProfileLimits) -> "LimitArrays":
        """The same limits for all motions."""
        made = cls(limits.velocity, limits.forward)
        made.back_rise, made.back_fall = _array(limits.backward[1]), -_array(limits.backward[0])
        return made

    @property
    def low(self) -> FloatArray:
        """The lowest velocity [U/s]."""
        return -self.high if self._low is None else self._low


def refuse_first(sizes: FloatArray, why: str, first: int = 0) -> None:
    """Raises UsageError with the index of the first size that is not > 0; counts from `first`."""
    if sizes.min() > 0.0:
        return
    where = f"motion {first + int(np.argmin(sizes > 0.0))}: " if sizes.ndim else ""
    raise UsageError(f"{where}{why}")


def refuse_where(bad: NDArray[np.bool_], why: str, first: int) -> None:
    """Raises UsageError with the first index that is marked, if any is; counts from `first`."""
    if bad.any():
        raise UsageError(f"motion {first + int(np.argmax(bad))}: {why}")


def _array(numbers: ArrayLike) -> FloatArray:
    return np.asarray(numbers, dtype=np.float64)


_HALVINGS: Final = 36
"""Of a bracket of a zero: an extremum there is known to the square of what is left."""


@final
class Curves:
    """n functions of one argument, each of m pieces; their arrays are not to be written to.

    Attributes:
        breaks: shape (n, m + 1), where the pieces meet; pieces may be of no length.
        coefficients: shape (n, m, degree + 1), ascending, of the argument since each piece began.
    """

    __slots__ = ("breaks", "coefficients")

    def __init__(self, breaks: FloatArray, coefficients: FloatArray) -> None:
        self.breaks = breaks
        self.coefficients = coefficients

    def __len__(self) -> int:
        return len(self.breaks)

    def __repr__(self) -> str:
        count, pieces, terms = self.coefficients.shape
        return f"<{count} functions of {pieces} polynomials of degree {terms - 1}>"

    @property
    def duration_s(self) -> FloatArray:
        """How long each takes, shape (n,)."""
        return self.breaks[:, -1] - self.breaks[:, 0]

    def value(self, argument: ArrayLike, order: int = 0) -> FloatArray:
        """The values, or derivatives of some order; outside, those of the nearer end.

        Args:
            argument: shape (n,) or (n, m), or one number for all.
            order: of the derivative, >= 0.
        """
        points = np.asarray(argument, dtype=np.float64)
        rows = np.arange(len(self))[:, None] if points.ndim == 2 else np.arange(len(self))
        points = np.clip(
            np.broadcast_to(points, np.broadcast_shapes(points.shape, rows.shape)),
            self.breaks[:, 0][rows],
            self.breaks[:, -1][rows],
        )
        piece = np.zeros(points.shape, dtype=np.intp)
        for edge in self.breaks.T[1:-1]:
            piece += points >= edge[rows]
        local = points - self.breaks[rows, piece]
        terms = differentiated(self.coefficients, order)[rows, piece]
        found = np.zeros(points.shape)
        for power in range(terms.shape[-1] - 1, -1, -1):
            found = found * local + terms[..., power]
        return found

    def function(self, index: int) -> "Piecewise":
        """One of them as a function of `motorhil.motorapi.functions`."""
        from motorhil.motorapi.functions.piecewise import Piecewise

        edges, rows = [float(self.breaks[index, 0])], []
        for piece, edge in enumerate(self.breaks[index, 1:]):
            if edge > edges[-1]:
                edges.append(float(edge))
                rows.append([float(term) for term in self.coefficients[index, piece]])
        return Piecewise.of_polynomials(edges, rows)


def differentiated(coefficients: FloatArray, order: int) -> FloatArray:
    """The coefficients of a derivative; those of 0 if the order exceeds the degree."""
    for _ in range(order):
        powers = np.arange(1, coefficients.shape[-1])
        coefficients = coefficients[..., 1:] * powers
    return coefficients if coefficients.shape[-1] else np.zeros((*coefficients.shape[:-1], 1))


def ranges(coefficients: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(lowest, highest) values of polynomials over [0, length]; exact to rounding.

    Shapes: coefficients (..., degree + 1), lengths (...) and so are the answers.
    """
    points = _zeros(differentiated(coefficients, 1), lengths)
    ends = np.stack([np.zeros_like(lengths), lengths], axis=-1)
    points = np.concatenate([ends, points], axis=-1)
    values = _at(coefficients[..., None, :], points)
    lowest: FloatArray = values.min(axis=-1)
    highest: FloatArray = values.max(axis=-1)
    return lowest, highest


def _zeros(coefficients: FloatArray, lengths: FloatArray) -> FloatArray:
    """As many points as the degree, ascending, all zeros in [0, length] among them.

    Between two neighbouring zeros of its derivative a polynomial is monotone and has at most one
    zero, which is halved in on.
    """
    degree = coefficients.shape[-1] - 1
    if degree < 1:
        return np.zeros((*lengths.shape, 0))
    turns = _zeros(differentiated(coefficients, 1), lengths)
    ends = np.zeros((*lengths.shape, 1))
    knots = np.concatenate([ends, turns, lengths[..., None]], axis=-1)
    low, high = knots[..., :-1], knots[..., 1:]
    terms = coefficients[..., None, :]
    sign = np.sign(_at(terms, low))
    crossing = sign * np.sign(_at(terms, high)) < 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        left = np.sign(_at(terms, middle)) == sign
        low, high = np.where(left, middle, low), np.where(left, high, middle)
    return np.where(crossing, low, knots[..., :-1])


def _at(coefficients: FloatArray, points: FloatArray) -> FloatArray:
    found = np.zeros(points.shape)
    for power in range(coefficients.shape[-1] - 1, -1, -1):
        found = found * points + coefficients[..., power]
    return found


@final
class Profiles:
    """n trapezoidal profiles from argument 0 on; their arrays are not to be written to.

    Each ramps to its peak, holds it and ramps to its final velocity, either ramp in two pieces if
    it turns round.

    Attributes, shape (n,):
        peak: the velocity held, or reached between the ramps [U/s], signed.
        duration_s: how long it takes [s].
    """

    __slots__ = ("_hold_s", "_limits", "_rise_s", "_states", "_table", "duration_s", "peak")

    def __init__(self, count: int, states: list[FloatArray], limits: LimitArrays) -> None:
        """To be filled in by the generator; `states` are final, initial, and their velocities."""
        self._limits = limits
        self._states = states
        self._table: _Table | None = None
        self._rise_s: FloatArray | None = None
        self._hold_s: FloatArray | None = None
        self.peak = np.empty(count)
        self.duration_s = np.empty(count)

    @property
    def rise_s(self) -> FloatArray:
        """How long the ramps to the peaks take: when each plateau begins [s]."""
        return self._times()[0]

    @property
    def hold_s(self) -> FloatArray:
        """How long the peaks are held [s]."""
        return self._times()[1]

    def put_ramps(self, part: slice, rise_s: FloatArray, hold_s: FloatArray) -> None:
        """For the generator; without this, they are all from rest to rest."""
        if self._rise_s is None or self._hold_s is None:
            self._rise_s, self._hold_s = np.empty(len(self)), np.empty(len(self))
        self._rise_s[part], self._hold_s[part] = rise_s, hold_s

    def _times(self) -> tuple[FloatArray, FloatArray]:
        if self._rise_s is None or self._hold_s is None:
            limits, size = self._limits, np.abs(self.peak)
            back = np.signbit(self.peak)
            rise = 1.0 / np.where(back, limits.back_fall, limits.rise)
            fall = 1.0 / np.where(back, limits.back_rise, limits.fall)
            self._rise_s = size * rise
            self._hold_s = self.duration_s - (rise + fall) * size
        return self._rise_s, self._hold_s

    def __len__(self) -> int:
        return len(self.peak)

    def __repr__(self) -> str:
        return f"<{len(self)} profiles>"

    def value(self, argument: ArrayLike) -> FloatArray:
        """The function values [U]; arguments of shape (n,) or (n, m), or one number for all."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 0)

    def first(self, argument: ArrayLike) -> FloatArray:
        """The first derivatives [U/s]; outside the arguments those of the nearer ends."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 1)

    def second(self, argument: ArrayLike) -> FloatArray:
        """The second derivatives [U/s²]; where two pieces meet that of the later; outside, 0."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 2)

    def _as_table(self) -> "_Table":
        if self._table is None:
            self._table = _Table(self, self._states, self._limits)
        return self._table


@final
class _Table:
    """Five pieces for each, some of no duration: two to rise, one to hold, two to fall."""

    def __init__(self, made: Profiles, states: list[FloatArray], limits: LimitArrays) -> None:
        count = len(made)
        final, initial, begin, end = (np.broadcast_to(array, (count,)) for array in states)
        peak = made.peak
        zero = np.zeros(count)
        self.entries = np.stack([begin, _middle(begin, peak), peak, peak, _middle(peak, end)])
        self.exits = np.stack([self.entries[1], peak, peak, self.entries[4], end])
        self.accelerations = np.stack(
            [_slope(limits, self.entries[k], self.exits[k]) if k != 2 else zero for k in range(5)]
        )
        with np.errstate(all="ignore"):
            lasts = (self.exits - self.entries) / self.accelerations
        lasts[~np.isfinite(lasts)] = 0.0
        self.accelerations[lasts == 0.0] = 0.0  # without a limit, a ramp is a step
        # The kinks are within the ramps, whose ends are known more exactly.
        times = [zero, np.minimum(lasts[0], made.rise_s), made.rise_s, made.rise_s + made.hold_s]
        times += [np.minimum(times[3] + lasts[3], made.duration_s), made.duration_s]
        self.times = np.stack(times)
        steps = np.diff(self.times, axis=0) * 0.5 * (self.entries + self.exits)
        self.values = np.empty((6, count))
        self.values[0], self.values[5] = initial, final
        np.add(initial, steps[0], out=self.values[1])
        np.add(self.values[1], steps[1], out=self.values[2])
        np.subtract(final, steps[4], out=self.values[4])
        np.subtract(self.values[4], steps[3], out=self.values[3])
        self.ends = (begin, end)

    def values_at(self, argument: FloatArray, order: int) -> FloatArray:
        count = self.times.shape[1]
        rows = np.arange(count)
        if argument.ndim == 2:
            rows = rows[:, None]
        argument = np.broadcast_to(argument, np.broadcast_shapes(argument.shape, rows.shape))
        if order == 2:  # at the very end, that of the last piece
            at_end = argument == self.times[5][rows]
            argument = np.where(at_end, np.nextafter(argument, -np.inf), argument)
        piece = np.zeros(argument.shape, dtype=np.intp)
        for edge in self.times[1:5]:
            piece += argument >= edge[rows]
        times, last = self.times, self.times[5][rows]
        acceleration = self.accelerations[piece, rows]
        if order == 2:
            return np.where((argument < 0.0) | (argument > last), 0.0, acceleration)
        late = piece >= 3  # reckoned from the end of the piece
        corner = piece + late
        local = argument - times[corner, rows]
        entry, leave = self.entries[piece, rows], self.exits[piece, rows]
        velocity = np.where(late, leave, entry)
        if order == 1:
            found = velocity + acceleration * local
            low, high = np.minimum(entry, leave), np.maximum(entry, leave)
            before, after = (end[rows] for end in self.ends)
        else:
            with np.errstate(invalid="ignore"):
                found = self.values[corner, rows] + (velocity + 0.5 * acceleration * local) * local
            near, far = self.values[piece, rows], self.values[piece + 1, rows]
            low, high = np.minimum(near, far), np.maximum(near, far)
            before, after = self.values[0][rows], self.values[5][rows]
        found = np.clip(found, low, high)
        return np.where(argument <= 0.0, before, np.where(argument >= last, after, found))


def _middle(begin: FloatArray, end: FloatArray) -> FloatArray:
    """Where a ramp has its kink: at 0, or at its end if it does not turn round."""
    return np.where(np.sign(begin) * np.sign(end) < 0.0, 0.0, end)


def _slope(limits: LimitArrays, begin: FloatArray, end: FloatArray) -> FloatArray:
    """The second derivative of a ramp that does not turn round."""
    forward = np.maximum(begin, end) > 0.0
    rising = np.where(forward, limits.rise, limits.back_rise)
    falling = np.where(forward, limits.fall, limits.back_fall)
    return np.where(begin == end, 0.0, np.where(end > begin, rising, -falling))


_AT_ONCE: Final = 256


def jerk_limited(
    final: ArrayLike,
    limits: ProfileLimits | Sequence[ProfileLimits],
    jerk: ArrayLike,
    *,
    initial: ArrayLike = 0.0,
    initial_derivatives: Sequence[ArrayLike] = (),
    final_derivatives: Sequence[ArrayLike] = (),
    duration_s: ArrayLike | None = None,
) -> Curves:
    """What `motorhil.motorapi.generation.jerk_limited` makes of each, from argument 0 on.

    Args:
        final: shape (n,), as all arrays; a number holds for all.
        limits: one for all, or one for each.
        jerk: sizes of the third derivative [U/s³].
        initial: the initial values [U].
        initial_derivatives: arrays of first and second ones at the beginning.
        final_derivatives: likewise at the end.
        duration_s: how long they take [s]; None: as short as the limits allow.

    Raises:
        PluginError: the package finds no motion, or a wrong one.
        UnsupportedError: the package is not installed.
        UsageError: as for a single one; names the first index.
    """
    given = [final, jerk, initial, *initial_derivatives, *final_derivatives]
    arrays = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in given))
    rows = np.stack(arrays, axis=1).tolist()
    each = [limits] * len(rows) if isinstance(limits, ProfileLimits) else list(limits)
    if len(each) != len(rows):
        raise UsageError(f"{len(each)} limits for {len(rows)} motions")
    split = 3 + len(initial_derivatives)
    tasks = []
    for index, (row, bounds) in enumerate(zip(rows, each, strict=True)):
        try:
            task = task_of(row[0], bounds, row[1], row[2], row[3:split], row[split:])
        except UsageError as error:
            raise UsageError(f"motion {index}: {error}") from None
        tasks.append(task)
    phases: list[list[Phase]] = []
    if duration_s is not None:
        lasting = np.broadcast_to(np.asarray(duration_s, dtype=np.float64), (len(tasks),))
        for index, (task, asked_s) in enumerate(zip(tasks, lasting.tolist(), strict=True)):
            try:
                phases.append(phases_of(task, asked_s))
            except UsageError as error:
                raise UsageError(f"motion {index}: {error}") from None
        return _curves(tasks, phases)
    for begin in range(0, len(tasks), _AT_ONCE):
        phases += _phases_of(tasks[begin : begin + _AT_ONCE])
    return _curves(tasks, phases)


def _phases_of(tasks: list[SmoothTask]) -> list[list[Phase]]:
    ruckig = load()
    units = [task.units for task in tasks]
    given = ruckig.InputParameter(len(tasks))
    given.synchronization = ruckig.Synchronization.No
    fill(given, tasks, units)
    made = ruckig.Trajectory(len(tasks))
    try:
        worked = ruckig.Ruckig(len(tasks)).calculate(given, made) == ruckig.Result.Working
    except ruckig.RuckigError:
        worked = False
    if not worked:
        return [phases_of(task) for task in tasks]  # which tells the one that fails
    found = [
        phases_in(profile, length, time)
        for profile, (length, time) in zip(made.profiles[0], units, strict=True)
    ]
    for task, phases in zip(tasks, found, strict=True):
        judge(task, phases)
    return found


def _curves(tasks: list[SmoothTask], phases: list[list[Phase]]) -> Curves:
    width = max(1, *map(len, phases)) if phases else 1
    breaks = np.zeros((len(tasks), width + 1))
    coefficients = np.zeros((len(tasks), width, 4))
    for index, (task, parts) in enumerate(zip(tasks, phases, strict=True)):
        coefficients[index, :, 0] = task.end[0]
        for piece, (lasts_s, jerk, (value, velocity, acceleration)) in enumerate(
            pieces_of(task, parts)
        ):
            breaks[index, piece + 1] = breaks[index, piece] + lasts_s
            coefficients[index, piece] = (value, velocity, acceleration / 2.0, jerk / 6.0)
        breaks[index, len(parts) + 1 :] = breaks[index, len(parts)]
    return Curves(breaks, coefficients)


CUBIC: Final = 3
QUINTIC: Final = 5


def coefficients_of(
    values: FloatArray, times: FloatArray, first: FloatArray, second: FloatArray | None
) -> FloatArray:
    """The coefficients of the pieces, of the time since each began: shape (n, m - 1, degree + 1).

    Args:
        values: shape (n, m), what is gone through [U].
        times: shape (n, m), ascending [s].
        first: shape (n, m), first derivatives [U/s]; nan where they are free.
        second: likewise second ones [U/s²], for quintic pieces; None: cubic ones.
    """
    steps = np.diff(times)
    # In units of the mean step no power of a step is too large or too small.
    unit = steps.mean(axis=1, keepdims=True)
    h = steps / unit
    rise = np.diff(values)
    if second is None:
        v = _cubic_slopes(rise, h, first * unit)
        c2 = (3.0 * rise / h - 2.0 * v[:, :-1] - v[:, 1:]) / h
        c3 = (v[:, :-1] + v[:, 1:] - 2.0 * rise / h) / h**2
        rows = [values[:, :-1], v[:, :-1], c2, c3]
    else:
        v, a = _quintic_states(rise, h, first * unit, second * unit * unit)
        v0, v1, a0, a1 = v[:, :-1] * h, v[:, 1:] * h, a[:, :-1] * h * h, a[:, 1:] * h * h
        c3 = (20.0 * rise - (12.0 * v0 + 8.0 * v1) - (3.0 * a0 - a1)) / (2.0 * h**3)
        c4 = (-30.0 * rise + (16.0 * v0 + 14.0 * v1) + (3.0 * a0 - 2.0 * a1)) / (2.0 * h**4)
        c5 = (12.0 * rise - 6.0 * (v0 + v1) - (a0 - a1)) / (2.0 * h**5)
        rows = [values[:, :-1], v[:, :-1], 0.5 * a[:, :-1], c3, c4, c5]
    made = np.stack(rows, axis=-1)
    scaled: FloatArray = made / unit[:, :, None] ** np.arange(len(rows))
    return scaled


def _cubic_slopes(rise: FloatArray, h: FloatArray, first: FloatArray) -> FloatArray:
    """The first derivatives, with those that are free chosen."""
    count, points = first.shape
    lower, middle, upper = (np.zeros((count, points, 1, 1)) for _ in range(3))
    right = np.zeros((count, points, 1))
    inverse = 1.0 / h
    lower[:, 1:, 0, 0] = inverse
    upper[:, :-1, 0, 0] = inverse
    middle[:, 1:, 0, 0] += 2.0 * inverse
    middle[:, :-1, 0, 0] += 2.0 * inverse
    right[:, 1:, 0] += 3.0 * rise * inverse**2
    right[:, :-1, 0] += 3.0 * rise * inverse**2
    _fix(lower, middle, upper, right, first[..., None])
    return _solved(lower, middle, upper, right)[..., 0]


def _quintic_states(
    rise: FloatArray, h: FloatArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """First and second derivatives, with those that are free chosen."""
    count, points = first.shape
    lower, middle, upper = (np.zeros((count, points, 2, 2)) for _ in range(3))
    right = np.zeros((count, points, 2))
    # Row 0: the fourth derivative goes through; row 1: the third. Of a piece, at its end:
    # p'''' = 360 D/h⁴ - 168 v0/h³ - 192 v1/h³ - 24 a0/h² + 36 a1/h²
    # p'''  = 60 D/h³ - 24 v0/h² - 36 v1/h² - 3 a0/h + 9 a1/h
    # and at its beginning:
    # p'''' = -360 D/h⁴ + 192 v0/h³ + 168 v1/h³ + 36 a0/h² - 24 a1/h²
    # p'''  = 60 D/h³ - 36 v0/h² - 24 v1/h² - 9 a0/h + 3 a1/h
    for row, terms in (
        (0, ((-168.0, 3), (-24.0, 2), (-192.0, 3), (36.0, 2), (360.0, 4))),
        (1, ((-24.0, 2), (-3.0, 1), (-36.0, 2), (9.0, 1), (60.0, 3))),
    ):
        for (block, column), (factor, power) in zip(
            ((lower, 0), (lower, 1), (middle, 0), (middle, 1)), terms[:4], strict=True
        ):
            block[:, 1:, row, column] += factor / h**power
        right[:, 1:, row] -= terms[4][0] * rise / h ** terms[4][1]
    for row, terms in (
        (0, ((192.0, 3), (36.0, 2), (168.0, 3), (-24.0, 2), (-360.0, 4))),
        (1, ((-36.0, 2), (-9.0, 1), (-24.0, 2), (3.0, 1), (60.0, 3))),
    ):
        for (block, column), (factor, power) in zip(
            ((middle, 0), (middle, 1), (upper, 0), (upper, 1)), terms[:4], strict=True
        ):
            block[:, :-1, row, column] -= factor / h**power
        right[:, :-1, row] += terms[4][0] * rise / h ** terms[4][1]
    _fix(lower, middle, upper, right, np.stack([first, second], axis=-1))
    made = _solved(lower, middle, upper, right)
    return made[..., 0], made[..., 1]


def _fix(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray, given: FloatArray
) -> None:
    """Equations of numbers that are given say just that."""
    known = ~np.isnan(given)
    for block in (lower, middle, upper):
        block[known] = 0.0
    for column in range(given.shape[-1]):
        middle[..., column, column][known[..., column]] = 1.0
    right[known] = given[known]


def _solved(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray
) -> FloatArray:
    """The solution of block-tridiagonal equations, n of them at once: there and back."""
    points = right.shape[1]
    found = np.empty_like(right)
    factors = np.empty_like(upper)
    try:
        for k in range(points):
            block, side = middle[:, k], right[:, k]
            if k:
                block = block - lower[:, k] @ factors[:, k - 1]
                side = side - (lower[:, k] @ found[:, k - 1, :, None])[..., 0]
            both = np.linalg.solve(block, np.concatenate([upper[:, k], side[..., None]], axis=-1))
            factors[:, k], found[:, k] = both[..., :-1], both[..., -1]
    except np.linalg.LinAlgError:
        raise UsageError(
            "the way-points do not determine the derivatives that are free: give one more"
        ) from None
    for k in range(points - 2, -1, -1):
        found[:, k] -= (factors[:, k] @ found[:, k + 1, :, None])[..., 0]
    return found


UNBOUNDED: Final = "the limits allow no such motion, or do not bound it"
_LOST: Final = 64.0  # as for a single one
_ROUNDING: Final = 2.0**-50  # likewise


@final
@dataclass(frozen=True, slots=True, eq=False)
class Tasks:
    """Motions to be made, each mirrored where need be, so that its excess is >= 0.

    `first` is the index of the first of them; the others are as in `closed_form.Task`.
    """

    first: int
    sign: FloatArray
    excess: FloatArray
    begin: FloatArray
    end: FloatArray
    low: FloatArray
    high: FloatArray
    rise: FloatArray
    fall: FloatArray
    back_rise: FloatArray
    back_fall: FloatArray

    def ramp_s(self, begin: FloatArray, end: FloatArray, change: FloatArray) -> FloatArray:
        """How long a ramp takes; `change` is the difference, which may be known more exactly."""
        falling = change < 0.0
        forward = np.where(falling, self.fall, self.rise)
        backward = np.where(falling, self.back_fall, self.back_rise)
        size = np.abs(change)
        turning = np.where(
            begin < 0.0, end / forward - begin / backward, begin / forward - end / backward
        )
        straight = np.where((begin >= 0.0) & (end >= 0.0), size / forward, size / backward)
        return np.where(np.sign(begin) * np.sign(end) < 0.0, turning, straight)


def tasks_of(first: int, given: list[FloatArray], bounds: list[FloatArray]) -> Tasks:
    """The motions between the states (final, initial, initial and final velocity) in `given`.

    Raises:
        UsageError: a number is not finite, or a boundary velocity lies outside the limits.
    """
    final, initial, begin, end = given
    low, high, rise, fall, back_rise, back_fall = bounds
    refuse_where(~np.isfinite(final - initial), "the way is not a finite number", first)
    within = (low <= begin) & (begin <= high) & (low <= end) & (end <= high)
    outside = ~(within & np.isfinite(begin - end))
    refuse_where(outside, "a boundary velocity lies outside its limits", first)
    rising = end > begin
    forward = np.where(rising, rise, -fall)
    backward = np.where(rising, back_rise, -back_fall)
    to, since = np.maximum(end, 0.0), np.maximum(begin, 0.0)
    direct = (to - since) * (to + since) / forward
    to, since = np.minimum(end, 0.0), np.minimum(begin, 0.0)
    direct = 0.5 * (direct + (to - since) * (to + since) / backward)
    excess = (final - initial) - direct
    for index in np.flatnonzero(np.abs(excess) * _LOST < np.abs(direct)):
        excess[index] = _exactly(given, bounds, int(index))
    size = np.where(end > 0.0, forward, backward)
    lost = np.abs(initial) + np.abs(final) + (begin * begin + end * end) / np.abs(size)
    turning = (begin * end > 0.0) & (excess * end < 0.0) & (begin != end)
    excess = np.where(turning & (np.abs(excess) <= _ROUNDING * lost), 0.0, excess)
    back = excess < 0.0
    return Tasks(
        first,
        np.where(back, -1.0, 1.0),
        np.abs(excess),
        np.where(back, -begin, begin),
        np.where(back, -end, end),
        np.where(back, -high, low),
        np.where(back, -low, high),
        np.where(back, back_fall, rise),
        np.where(back, back_rise, fall),
        np.where(back, fall, back_rise),
        np.where(back, rise, back_fall),
    )


def peaks_of(task: Tasks) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(peak, how much velocity rises to it, how much it falls after, how long it is held [s])."""
    greater = np.maximum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    straight = task.excess == 0.0
    excess = task.excess + np.where(greater < 0.0, 0.5 * k_back * greater * greater, 0.0)
    base = np.where(straight, greater, np.maximum(greater, 0.0))
    gained = np.where(straight, 0.0, 2.0 * excess / k)
    peak = np.where(straight, base, np.sqrt(base * base + gained))
    gain = np.where(straight, 0.0, gained / (peak + base))
    clipped = (peak > task.high) | (peak == np.inf)
    refuse_where(clipped & ~((task.high > 0.0) & (task.high < np.inf)), UNBOUNDED, task.first)
    peak = np.where(clipped, task.high, peak)
    gain = np.where(clipped, task.high - base, gain)
    held = (excess - 0.5 * k * gain * (peak + base)) / peak
    hold_s = np.where(clipped, np.maximum(held, 0.0), 0.0)
    return peak, (base - task.begin) + gain, (base - task.end) + gain, hold_s


def _exactly(given: list[FloatArray], bounds: list[FloatArray], index: int) -> float:
    """The excess of one motion, signed, as the generator of single ones finds it."""
    final, initial, begin, end = (float(a[index] if a.ndim else a) for a in given)
    low, high, rise, fall, back_rise, back_fall = (float(a[index] if a.ndim else a) for a in bounds)
    limits = ProfileLimits.by_direction((low, high), (-fall, rise), (-back_fall, back_rise))
    sign, excess, *_ = task_of_of_closed_form(final, limits, initial, begin, end)
    return sign * excess


def peaks_lasting(
    task: Tasks, duration_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """(peak, how much velocity rises to it, falls after it, how long it is held, duration [s]).

    Raises:
        UsageError: a duration is not finite and >= 0, or not possible.
    """
    good = np.isfinite(duration_s) & (duration_s >= 0.0)
    refuse_where(~good, "the duration is not a finite number >= 0", task.first)
    found = peaks_of(task)
    shortest_s, lasting_s = _allowed(task, found, duration_s)
    direct_s = task.ramp_s(task.begin, task.end, task.end - task.begin)
    peak = np.clip(_peaks(task, lasting_s - direct_s), task.low, task.high)
    up, down = peak - task.begin, peak - task.end
    ramps_s = task.ramp_s(task.begin, peak, up) + task.ramp_s(peak, task.end, -down)
    chosen = (peak, up, down, np.maximum(lasting_s - ramps_s, 0.0))
    fastest = lasting_s <= shortest_s
    made = [np.where(fastest, one, other) for one, other in zip(found, chosen, strict=True)]
    return made[0], made[1], made[2], made[3], np.where(fastest, shortest_s, lasting_s)


def _peaks(task: Tasks, spare_s: FloatArray) -> FloatArray:
    excess = task.excess
    least, most = np.minimum(task.begin, task.end), np.maximum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    stop, rest_s = 0.5 * k * least * least, spare_s - k * least
    above = most + _roots(excess - most * spare_s, spare_s, -k)
    turned = _roots(excess + 0.5 * k_back * most * most, spare_s + k_back * most, -k)
    slower = least - _roots(least * spare_s - excess, spare_s, -k)
    stopping = _roots(excess - stop, rest_s, k)
    returning = -_roots(stop - excess, rest_s, -k_back)
    return np.select(
        [
            (excess > most * spare_s) & (most >= 0.0),
            excess > most * spare_s,
            excess >= least * spare_s,
            rest_s < 0.0,
            excess >= stop,
        ],
        [above, turned, excess / spare_s, slower, stopping],
        returning,
    )


def _roots(rest: FloatArray, slope: FloatArray, bend: FloatArray) -> FloatArray:
    square = np.maximum(slope * slope + 2.0 * bend * rest, 0.0)
    return np.where(rest > 0.0, 2.0 * rest / (slope + np.sqrt(square)), 0.0)


def _allowed(
    task: Tasks, found: tuple[FloatArray, ...], duration_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The shortest durations, and those asked for, or possible ones that rounding made of them."""
    peak, up, down, hold_s = found
    rise_s = task.ramp_s(task.begin, peak, up)
    shortest_s = rise_s + hold_s + task.ramp_s(peak, task.end, -down)
    excess, low = task.excess, task.low
    least = np.minimum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    direct_s = task.ramp_s(task.begin, task.end, task.end - task.begin)
    missing = 0.5 * k * least * least - excess
    slowest = np.sqrt(np.maximum(least * least - 2.0 * excess / k, 0.0))
    first_s = np.maximum(shortest_s, direct_s + 2.0 * excess / (least + slowest))
    back = np.minimum(np.sqrt(2.0 * missing / k_back), -low)
    held_s = np.where(back < -low, 0.0, (missing - 0.5 * k_back * low * low) / -low)
    second_s = np.where(low == 0.0, np.inf, direct_s + k * least + k_back * back + held_s)
    gap = (least > 0.0) & (missing > 0.0)
    asked = np.where(duration_s < shortest_s, shortest_s, duration_s)
    asked = np.where(gap & (asked > first_s) & (asked < second_s), first_s, asked)
    near = np.abs(asked - duration_s) <= ROUNDING * asked
    late = gap & ~near & (second_s - duration_s <= ROUNDING * second_s) & (second_s < np.inf)
    refuse_where(
        ~(near | late), "not possible in its duration (see possible_durations)", task.first
    )
    return shortest_s, np.where(late, np.maximum(second_s, duration_s), asked)


_ROUNDS: Final = 40
_TRIED_MOST: Final = 32  # pieces; the effort grows with the square
_LEAST_REACH: Final = 0.01  # relative change of a step that is tried last
_SLOWEST: Final = 2.0**40  # how much slower than at first it is tried with given velocities

Derivatives: TypeAlias = tuple[FloatArray, FloatArray | None]
"""First and second derivatives at the way-points, as for `coefficients_of`."""


def shortest_times(
    values: FloatArray, derivatives: Derivatives, limits: DerivativeLimits
) -> FloatArray:
    """Times from 0 on for the way-points, shape (n, m).

    Args:
        values: shape (n, m).
        derivatives: at the way-points.
        limits: of first, second and third derivative, at least one of them.

    Raises:
        UsageError: nothing is limited, no two neighbouring way-points differ, or velocities are
            given that no times keep within the limits.
    """
    bounds = [(k, x) for k, x in ((1, limits.first), (2, limits.second), (3, limits.third)) if x]
    if not any(np.isfinite(bound).any() for _, bound in bounds):
        raise UsageError("without times there must be a limit of a derivative")
    rise = np.abs(np.diff(values))
    if not (rise.sum(axis=1) > 0.0).all():
        raise UsageError("way-points that are all the same take no time: give times")
    steps: FloatArray = np.zeros(rise.shape)
    for order, (low, high) in bounds:
        size = min(-low, high)
        if np.isfinite(size):
            steps = np.maximum(steps, (rise / size) ** (1.0 / order))
    steps = np.maximum(steps, 0.05 * steps.mean(axis=1, keepdims=True))
    steps, _ = _nearly_scaled(values, derivatives, steps, bounds)
    if steps.shape[1] <= _TRIED_MOST:
        steps = _tried(values, derivatives, steps, bounds)
    steps = _scaled(values, derivatives, steps, bounds)
    times = np.zeros(values.shape)
    np.cumsum(steps, axis=1, out=times[:, 1:])
    return times


def _tried(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """The steps, with each in turn made longer or shorter as long as that gains something."""
    count, pieces = steps.shape
    changes = np.concatenate([np.eye(pieces), -np.eye(pieces)])
    tries = len(changes)
    many = np.repeat(values, tries, axis=0)
    first, second = derivatives
    wide = (
        np.repeat(first, tries, axis=0),
        None if second is None else np.repeat(second, tries, axis=0),
    )
    rows, reach = np.arange(count), np.full(count, 0.4)
    best = steps.sum(axis=1)
    for _ in range(_ROUNDS):
        tried = steps[:, None, :] * np.exp(reach[:, None, None] * changes)
        made = _nearly_scaled(many, wide, tried.reshape(-1, pieces), bounds)[0]
        made = made.reshape(count, tries, pieces)
        totals = made.sum(axis=2)
        choice = totals.argmin(axis=1)
        better = (totals[rows, choice] < best * (1.0 - 1e-6)) & (reach >= _LEAST_REACH)
        steps = np.where(better[:, None], made[rows, choice], steps)
        best = np.where(better, totals[rows, choice], best)
        reach = np.where(better, reach, 0.4 * reach)
        if (reach < _LEAST_REACH).all():
            break
    return steps


def _is_moving(derivatives: Derivatives) -> bool:
    """Whether a derivative is given that is not 0, so that slower does not scale everything."""
    first, second = derivatives
    return bool(np.nan_to_num(first).any() or (second is not None and np.nan_to_num(second).any()))


def _nearly_scaled(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> tuple[FloatArray, FloatArray]:
    """The steps, all longer or shorter so that the limits are just held, or nearly; how used."""
    for _ in range(4 if _is_moving(derivatives) else 1):
        used = _used(values, derivatives, steps, bounds)
        factor = used.max(axis=1, keepdims=True)
        steps = steps * factor
    return steps, used / factor


def _scaled(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """The steps, all longer or shorter by a factor so that the limits are just held."""
    if not _is_moving(derivatives):
        used = _used(values, derivatives, steps, bounds)
        longer: FloatArray = steps * used.max(axis=1, keepdims=True) * (1.0 + 1e-15)
        return longer

    def held(factor: FloatArray) -> NDArray[np.bool_]:
        most = _used(values, derivatives, steps * factor[:, None], bounds).max(axis=1)
        return np.asarray(most <= 1.0)

    high = np.ones(len(values))
    while not (enough := held(high)).all():
        high = np.where(enough, high, 2.0 * high)
        if high.max() > _SLOWEST:
            raise UsageError("no times keep the derivatives that are given within the limits")
    low = 0.5 * high
    for _ in range(60):
        middle = np.sqrt(low * high)
        enough = held(middle)
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return steps * high[:, None]


def _used(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """For each piece, the factor by which its limits would have it slower (< 1: quicker)."""
    times = np.concatenate([np.zeros((len(values), 1)), np.cumsum(steps, axis=1)], axis=1)
    coefficients = coefficients_of(values, times, *derivatives)
    used = np.zeros(steps.shape)
    for order, (low, high) in bounds:
        lowest, highest = ranges(differentiated(coefficients, order), steps)
        most = np.maximum(np.maximum(lowest / low, highest / high), 0.0)
        used = np.maximum(used, most ** (1.0 / order))
    return used


_AT_REST: Final = np.zeros(1)
_CHUNK: Final = 4096  # motions whose numbers fit the processor's cache


def trapezoids(
    final: ArrayLike,
    limits: LimitArrays | ProfileLimits,
    *,
    initial: ArrayLike = 0.0,
    initial_velocity: ArrayLike = 0.0,
    final_velocity: ArrayLike = 0.0,
    duration_s: ArrayLike | None = None,
) -> Profiles:
    """The profiles that `trapezoid` makes of each; numbers hold for all motions.

    Raises:
        UsageError: as for `trapezoid`; names the first index.
    """
    if isinstance(limits, ProfileLimits):
        limits = LimitArrays.of(limits)
    given = [
        np.asarray(numbers, dtype=np.float64)
        for numbers in (final, initial, initial_velocity, final_velocity)
    ]
    lasting = None if duration_s is None else np.asarray(duration_s, dtype=np.float64)
    at_rest = lasting is None and not (given[2].any() or given[3].any())
    low = limits.high if at_rest and limits.is_symmetric else limits.low
    sides = (low, limits.high, limits.rise, limits.fall, limits.back_rise, limits.back_fall)
    shape = np.broadcast_shapes(
        (1,), *(array.shape for array in (*given, *sides)), () if lasting is None else lasting.shape
    )
    made = Profiles(shape[0], given, limits)
    with np.errstate(all="ignore"):
        for begin in range(0, shape[0], _CHUNK):
            part = slice(begin, min(begin + _CHUNK, shape[0]))
            chunk = [array[part] if array.ndim else array for array in given]
            bounds = [array[part] if array.ndim else array for array in sides]
            if lasting is not None:
                task = tasks_of(begin, chunk, bounds)
                pieces_lasting(made, part, task, lasting[part] if lasting.ndim else lasting)
            elif at_rest:
                way = np.broadcast_to(chunk[0] - chunk[1], made.peak[part].shape)
                task = _from_rest(begin, way, bounds, limits.is_symmetric)
                _make_rest_to_rest(made, part, task)
            else:
                task = tasks_of(begin, chunk, bounds)
                peak, up, down, hold_s = peaks_of(task)
                _make(made, part, task, peak, up, down, hold_s)
    return made


def _from_rest(first: int, way: FloatArray, bounds: list[FloatArray], symmetric: bool) -> Tasks:
    low, high, rise, fall, back_rise, back_fall = bounds
    if not symmetric:
        back = way < 0.0
        rise, fall = np.where(back, back_fall, rise), np.where(back, back_rise, fall)
        high = np.where(back, 0.0 - low, high)  # never -0.0, which is no way to go
    # Of the sign only its sign counts; the limits of backward motion play no part.
    return Tasks(first, way, np.abs(way), _AT_REST, _AT_REST, low, high, rise, fall, rise, fall)


def _make_rest_to_rest(made: Profiles, part: slice, task: Tasks) -> None:
    """As `peaks_of` and `_make`, with all that is 0 left out, and no branch on each number.

    What follows from the peak, `Profiles` works out when it is asked for.
    """
    k = 1.0 / task.rise + 1.0 / task.fall
    gained = task.excess / k
    gained += gained
    fastest = np.sqrt(gained, out=gained)
    peak = np.minimum(fastest, task.high)
    ramps_s = k * peak
    hold_s = task.excess / peak
    hold_s -= 0.5 * ramps_s
    hold_s *= fastest > task.high
    np.fmax(hold_s, 0.0, out=hold_s)  # without a way, 0 / 0 as well
    lasts_s = np.add(ramps_s, hold_s, out=made.duration_s[part])
    np.copysign(peak, task.sign, out=made.peak[part])
    if not np.isfinite(lasts_s).all():
        refuse_where(~np.isfinite(task.excess), "the way is not a finite number", task.first)
        refuse_where(~np.isfinite(lasts_s), UNBOUNDED, task.first)


def _make(
    made: Profiles,
    part: slice,
    task: Tasks,
    peak: FloatArray,
    up: FloatArray,
    down: FloatArray,
    hold_s: FloatArray,
) -> None:
    rise_s, fall_s = task.ramp_s(task.begin, peak, up), task.ramp_s(peak, task.end, -down)
    made.peak[part] = task.sign * peak
    made.put_ramps(part, rise_s, hold_s)
    made.duration_s[part] = rise_s + hold_s + fall_s


def pieces_lasting(made: Profiles, part: slice, task: Tasks, duration_s: FloatArray) -> None:
    """Puts the profiles that take so long into `made`."""
    peak, up, down, hold_s, lasting_s = peaks_lasting(task, duration_s)
    _make(made, part, task, peak, up, down, hold_s)
    made.duration_s[part] = lasting_s


def through_waypoints(
    values: ArrayLike,
    times: ArrayLike | None = None,
    *,
    limits: DerivativeLimits | None = None,
    first: ArrayLike | None = None,
    second: ArrayLike | None = None,
    degree: int = CUBIC,
) -> Curves:
    """What `motorhil.motorapi.generation.through_waypoints` makes of each row of `values`.

    Args:
        values: shape (n, m), m >= 2 [U].
        times: shape (n, m) or (m,), ascending [s]; None: as short as `limits` allow, from 0 on.
        limits: of the derivatives, where there are no times.
        first: shape (n, m) or (m,), nan where it is free [U/s]; None: 0 at the ends.
        second: likewise [U/s²], for degree 5.
        degree: of the pieces, 3 or 5.

    Raises:
        UsageError: shapes do not fit, a number is not finite, times do not ascend, or see
            `through_waypoints`.
    """
    points = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if points.shape[1] < 2 or not np.isfinite(points).all():
        raise UsageError("way-points are at least two, and finite numbers")
    if degree not in (CUBIC, QUINTIC):
        raise UsageError(f"pieces are of degree 3 or 5, not {degree}")
    if second is not None and degree == CUBIC:
        raise UsageError("second derivatives are given to pieces of degree 5 only")
    slopes = _derivatives("first", first, points)
    bends = _derivatives("second", second, points) if degree == QUINTIC else None
    if not isinstance(limits, DerivativeLimits | None):
        raise UsageError(f"limits of way-points are DerivativeLimits, not {limits!r}")
    if limits is not None and (times is not None or limits.value is not None):
        what = "their value" if times is None else "way-points with times"
        raise UsageError(
            f"limits of {what} are not kept to: hold the function against them, by"
            " motorhil.motorapi.generation.feasible"
        )
    if times is None:
        if limits is None:
            raise UsageError("way-points need times, or limits that tell how soon they can be")
        edges = shortest_times(points, (slopes, bends), limits)
    else:
        edges = _fitting("times", times, points)
        if not (np.isfinite(edges).all() and (np.diff(edges) > 0.0).all()):
            raise UsageError("times must be finite numbers and ascend")
    return Curves(edges, coefficients_of(points, edges, slopes, bends))


def _derivatives(name: str, given: ArrayLike | None, points: FloatArray) -> FloatArray:
    if given is None:
        made = np.full(points.shape, np.nan)
        made[:, 0] = made[:, -1] = 0.0
        return made
    made = _fitting(f"{name} derivatives", given, points)
    if np.isinf(made).any():
        raise UsageError(f"{name} derivatives are finite, or nan where they are free")
    return made


def _fitting(name: str, given: ArrayLike, points: FloatArray) -> FloatArray:
    array = np.asarray(given, dtype=np.float64)
    if array.shape not in (points.shape, points.shape[1:]):
        raise UsageError(f"{name} have shape {array.shape}, way-points {points.shape}")
    return np.array(np.broadcast_to(array, points.shape))
