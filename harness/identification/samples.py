"""Samples of one motor's motion, evenly spaced, from a recording.

Positions and efforts come from what the application or the drive said, never from an emulated
drive's true state, unless this is asked for.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import numpy as np

from motorhil.harness.report.collect import collect
from motorhil.harness.report.motors import Line, Motor, motors_of
from motorhil.harness.rig.config.toml import RigError
from motorhil.settings import listed, nearest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

_LEAST: Final = 200
_EFFORTS: Final = ("N·m", "N")
_RATED: Final = "‰ of rated"
_PARTS: Final = 1000.0
_POSITIONS: Final = ("rad", "m")
_TRUTH: Final = "truth"


@final
@dataclass(frozen=True, slots=True)
class Samples:
    """Evenly spaced samples of one motor.

    Attributes:
        name: the motor.
        unit: "rad" or "m".
        period_s: time between two samples [s].
        position: at the output, shape (n,) [rad or m].
        effort: torque or force at the output, shape (n,) [N m or N].
        source: where they come from, as a text.
    """

    name: str
    unit: str
    period_s: float
    position: "NDArray[float64]"
    effort: "NDArray[float64]"
    source: str

    def __len__(self) -> int:
        return len(self.position)

    @property
    def duration_s(self) -> float:
        """Duration of the samples [s]."""
        return (len(self) - 1) * self.period_s


def samples_in(
    file: Path, motor: str | None = None, *, truth: bool = False, rated: float | None = None
) -> Samples:
    """Return the samples of a motor in a recording.

    Args:
        file: the recording.
        motor: its name; None: the only one.
        truth: use the true state of an emulated drive.
        rated: rated torque or force at the output [N m or N]; 6077h is told in parts of it.

    Raises:
        RigError: it has no such motor, or no position and effort of it in SI units.
    """
    try:
        with read_trace(file) as trace:
            motors = motors_of(collect(trace))
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    chosen = _chosen(file, motors, motor)
    position = _line(chosen, "position", _POSITIONS, truth)
    effort = _line(chosen, "torque", _EFFORTS if rated is None else (_RATED,), truth)
    for what, line in (("position", position), ("torque or force", effort)):
        if line is None:
            remedy = "give --rated for 6077h of a drive, or --truth for an emulated one"
            problem = f"holds no {what} of {chosen.name} in SI units"
            raise RigError(file, problem, remedy)
    assert position is not None
    assert effort is not None
    found = _even(file, chosen.name, position[1], position[0], effort[0])
    if rated is None:
        return found
    return replace(found, effort=found.effort * (rated / _PARTS))


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
    steps = np.diff(position.times_ns)
    steps = steps[steps > 0]
    period_ns = float(np.median(steps)) if len(steps) else 0.0
    count = int((end - begin) / period_ns) + 1 if period_ns else 0
    if count < _LEAST:
        problem = f"has {max(0, count)} samples of {name}; at least {_LEAST} are needed"
        raise RigError(file, problem, "record a longer motion")
    grid = begin + period_ns * np.arange(count)
    return Samples(
        name,
        unit,
        period_ns / 1e9,
        np.interp(grid, position.times_ns, position.values),
        np.interp(grid, effort.times_ns, effort.values),
        f"{position.source}, {effort.source}",
    )
