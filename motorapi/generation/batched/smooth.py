"""Many motions of limited jerk, by the package ruckig: all degrees of freedom of one call."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from motorapi.errors import UsageError
from motorapi.generation.batched.curves import Curves
from motorapi.generation.limits import ProfileLimits
from motorapi.generation.smooth import (
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
    """What `motorapi.generation.jerk_limited` makes of each, from argument 0 on.

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
