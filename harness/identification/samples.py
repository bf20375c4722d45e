"""Samples of one motor's motion, evenly spaced, from a recording.

Positions and efforts come from what the application or the drive said, never from an emulated
drive's true state, unless this is asked for.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, final

import numpy as np

from motorhil.frozen import frozen
from motorhil.harness.recording.conversion import open_recording
from motorhil.harness.report.collect import collect
from motorhil.harness.report.motors import Line, Motor, motors_of
from motorhil.harness.report.series import Track
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.recording import files_of
from motorhil.settings import listed, nearest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.records import Attachment

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

_LEAST: Final = 200
_PAUSE: Final = 1.5  # periods without a value: the same value was repeated
_EFFORTS: Final = ("N·m", "N")
_RATED: Final = "‰ of rated"
_PARTS: Final = 1000.0
_POSITIONS: Final = ("rad", "m")
_TRUTH: Final = "truth"
_RATED_CURRENT: Final = 0x6075
_RATED_TORQUE: Final = 0x6076
_TORQUE: Final = 0x6077
_CURRENT: Final = 0x6078
_LEAST_CURRENT: Final = 30.0  # thousandths of the rated one: below it, rounding is too much
_PAIRS: Final = 8
_NORMAL: Final = 1.4826  # standard deviation by median absolute deviation, of a normal law
_OF_MEDIAN: Final = 1.2533  # deviation of a median by that of a mean
_MILLI: Final = 1e-3  # 6076h counts in mN m


@final
class Told(NamedTuple):
    """A value that a drive tells, with its standard deviation [N m/A]."""

    value: float
    deviation: float


@final
@frozen
class Samples:
    """Evenly spaced samples of one motor.

    Attributes:
        name: the motor.
        unit: "rad" or "m".
        period_s: time between two samples [s].
        position: at the output, shape (n,) [rad or m].
        effort: torque or force at the output, shape (n,) [N m or N].
        source: where they come from, as a text.
        constant: the torque constant that the drive tells; None: it does not.
    """

    name: str
    unit: str
    period_s: float
    position: "NDArray[float64]"
    effort: "NDArray[float64]"
    source: str
    constant: Told | None = None

    def __len__(self) -> int:
        return len(self.position)

    @property
    def duration_s(self) -> float:
        """Duration of the samples [s]."""
        return (len(self) - 1) * self.period_s

    def part(self, begin: float, end: float) -> "Samples":
        """Return a part, from one share of the duration to another, 0 to 1."""
        kept = slice(round(begin * len(self)), round(end * len(self)))
        return replace(self, position=self.position[kept], effort=self.effort[kept])


@final
@frozen(kw_only=True)
class Reading:
    """How to read a recording.

    Attributes:
        truth: use the true state of an emulated drive.
        rated: rated torque or force at the output [N m or N], in parts of which a drive tells
            6077h; None: that of 6076h, if the recording has it.
        gear: motor turns per turn of the output; 6076h is a torque of the motor.
        rig: the rig whose models know the motors' units; None: that of the recording.
    """

    truth: bool = False
    rated: float | None = None
    gear: float = 1.0
    rig: Path | None = None


def samples_in(file: Path, motor: str | None = None, how: Reading | None = None) -> Samples:
    """Return the samples of a motor in a recording of any format.

    Args:
        file: the recording.
        motor: its name; None: the only one.
        how: where its units come from; None: from the recording.

    Raises:
        RigError: it has no such motor, or no position and effort of it in SI units.
    """
    how = how or Reading()
    chosen = _chosen(file, motors_in(file, how.rig), motor)
    position = _line(chosen, "position", _POSITIONS, how.truth)
    if position is None:
        remedy = "name a rig whose motor model has increments: --rig RIG"
        raise RigError(file, f"holds no position of {chosen.name} in SI units", remedy)
    found = None if how.rated is not None else _line(chosen, "torque", _EFFORTS, how.truth)
    if found is not None:
        even = _even(file, chosen.name, position[1], position[0], found[0])
        return replace(even, constant=_constant(chosen))
    told = _line(chosen, "torque", (_RATED,), how.truth)
    rated = how.rated if how.rated is not None else _rated(chosen, how.gear)
    if told is None or rated is None:
        remedy = "give --rated for 6077h of a drive, or --truth for an emulated one"
        problem = f"holds no torque or force of {chosen.name} in SI units"
        raise RigError(file, problem, remedy)
    parts = _even(file, chosen.name, position[1], position[0], told[0])
    return replace(parts, effort=parts.effort * (rated / _PARTS), constant=_constant(chosen))


def motors_in(file: Path, rig: Path | None = None) -> list[Motor]:
    """Return the motors in a recording of any format, with units by a rig if it has none.

    Raises:
        RigError: the recording cannot be read, or the rig cannot be used.
    """
    try:
        with open_recording(file, attachments=_attachments(rig)) as trace:
            return motors_of(collect(trace))
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None


def _attachments(rig: Path | None) -> list[Attachment]:
    if rig is None:
        return []
    return [Attachment(name, media, 0, data) for name, media, data in files_of(describe(rig))]


def _rated(motor: Motor, gear: float) -> float | None:
    """Return the rated torque at the output [N m] by 6076h; None: the drive has not told it."""
    track = None if motor.told is None else motor.told.tracks.get(_RATED_TORQUE)
    return _last(track) * _MILLI * gear or None


def _constant(motor: Motor) -> Told | None:
    """Return the torque constant that a drive tells, in pairs of 6077h and 6078h.

    Torque counts in thousandths of 6076h, current in those of 6075h. The pairs are of nearly the
    same time, so that the median counts.

    Returns:
        The constant; None: the drive tells too few pairs with enough current.
    """
    tracks = {} if motor.told is None else motor.told.tracks
    torque, current = tracks.get(_TORQUE), tracks.get(_CURRENT)
    unit = _last(tracks.get(_RATED_TORQUE)) / (_last(tracks.get(_RATED_CURRENT)) or np.inf)
    if torque is None or current is None or not unit:
        return None
    times, amperes = current.sorted()
    own, torques = torque.sorted()
    kept = (times >= own[0]) & (np.abs(amperes) >= _LEAST_CURRENT)
    if int(kept.sum()) < _PAIRS:
        return None
    ratios = torques[np.searchsorted(own, times[kept], "right") - 1] / amperes[kept]
    middle = float(np.median(ratios))
    spread = _NORMAL * float(np.median(np.abs(ratios - middle)))
    spread = max(spread, 0.5 / float(np.median(np.abs(amperes[kept]))))  # thousandths are whole
    return Told(middle * unit, _OF_MEDIAN * spread * unit / float(np.sqrt(len(ratios))))


def _last(track: Track | None) -> float:
    return 0.0 if track is None else track.last or 0.0


def _chosen(file: Path, motors: list[Motor], name: str | None) -> Motor:
    names = [one.name for one in motors]
    if name is None and len(motors) == 1:
        return motors[0]
    if name is None:
        raise RigError(file, f"has {len(motors)} motors", f"add --motor, one of: {listed(names)}")
    for one in motors:
        if one.name == name:
            return one
    raise RigError(file, f"has no motor {name!r} (known: {listed(names)})", nearest(name, names))


def _line(
    motor: Motor, quantity: str, units: tuple[str, ...], truth: bool
) -> tuple[Line, str] | None:
    for plot in motor.plots:
        if plot.quantity != quantity or plot.unit not in units:
            continue
        for line in plot.lines:
            if line.role == (_TRUTH if truth else "actual") and len(line.times_ns) > 1:
                return line, plot.unit
    return None


def _even(file: Path, name: str, unit: str, position: Line, effort: Line) -> Samples:
    """Return both lines on one grid, whose period is the usual one of the positions."""
    begin = max(int(position.times_ns[0]), int(effort.times_ns[0]))
    end = min(int(position.times_ns[-1]), int(effort.times_ns[-1]))
    period_ns = usual_period_ns(position)
    count = int((end - begin) / period_ns) + 1 if period_ns else 0
    if count < _LEAST:
        problem = f"has {max(0, count)} samples of {name}; at least {_LEAST} are needed"
        raise RigError(file, problem, "record a longer motion")
    grid = begin + period_ns * np.arange(count)
    return Samples(
        name,
        unit,
        period_ns / 1e9,
        on_grid(grid, position, period_ns),
        on_grid(grid, effort, period_ns),
        f"{position.source}, {effort.source}",
    )


def usual_period_ns(line: Line) -> float:
    """Return the median distance of a line's values [ns]; 0.0: all are at one time."""
    steps = np.diff(line.times_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def on_grid(grid: "NDArray[Any]", line: Line, period_ns: float) -> "NDArray[float64]":
    """Return a line on the grid; one that lacks repeated values keeps the last one meanwhile."""
    times, values = line.times_ns.astype(float), line.values
    if line.held:
        pauses = np.flatnonzero(np.diff(times) > _PAUSE * period_ns)
        times = np.insert(times, pauses + 1, times[pauses + 1] - period_ns)
        values = np.insert(values, pauses + 1, values[pauses])
    found: NDArray[float64] = np.interp(grid, times, values)
    return found
