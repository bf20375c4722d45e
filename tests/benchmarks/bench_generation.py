"""Costs of trajectory generation, compared with ruckig."""

from collections.abc import Callable
from time import process_time

import numpy as np

from motorhil.motorapi.commands import DerivativeLimits
from motorhil.motorapi.errors import UnsupportedError
from motorhil.motorapi.generation import (
    ProfileLimits,
    feasible,
    generate,
    jerk_limited,
    through_waypoints,
    trapezoid,
)
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory

FEW = 20_000


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    return [*single(), *others()]


def best(work: Callable[[], object], times: int = 7) -> float:
    """Return the least of several CPU times [s]; other load only adds time."""
    found = []
    for _ in range(times):
        start = process_time()
        work()
        found.append(process_time() - start)
    return min(found)


def single() -> list[tuple[str, float, str]]:
    """Measure one trapezoid; its limits are created each time, as ruckig's are."""

    def at_rest() -> None:
        for _ in range(FEW):
            trapezoid(10.0, ProfileLimits((-1.0, 2.0), (-3.0, 4.0)))

    def moving() -> None:
        for _ in range(FEW):
            trapezoid(
                10.0,
                ProfileLimits((-1.0, 2.0), (-3.0, 4.0)),
                initial=1.0,
                initial_velocity=0.5,
                final_velocity=-0.25,
            )

    def prepared() -> None:
        limits = ProfileLimits((-1.0, 2.0), (-3.0, 4.0))
        for _ in range(FEW):
            trapezoid(10.0, limits)

    def asked() -> None:
        limits = ProfileLimits((-1.0, 2.0), (-3.0, 4.0))
        for _ in range(FEW):
            trapezoid(10.0, limits, duration_s=9.0)

    def sampled() -> None:
        profile = trapezoid(10.0, ProfileLimits((-1.0, 2.0), (-3.0, 4.0)))
        for k in range(FEW):
            profile.value(k * 2.5e-4)

    figures = {work: best(work) / FEW * 1e6 for work in (at_rest, moving, prepared, asked, sampled)}
    rows = [
        ("a trapezoid from rest to rest, with its limits", figures[at_rest], "us"),
        ("a trapezoid between two velocities, with its limits", figures[moving], "us"),
        ("a trapezoid from rest to rest, of prepared limits", figures[prepared], "us"),
        ("a trapezoid of a given duration, of prepared limits", figures[asked], "us"),
        ("its value at one moment", figures[sampled], "us"),
    ]
    for name, states, ours in (
        ("from rest to rest", False, at_rest),
        ("moving and turning round", True, moving),
    ):
        peer = ruckig_loop([10.0] * FEW, [2.0] * FEW, [4.0] * FEW, [3.0] * FEW, moving=states)
        if peer is None:
            continue
        theirs = best(peer) / FEW * 1e6
        rows.append((f"the same by ruckig, {name}", theirs, "us"))
        demand = "" if states else " (to be <= 3)"
        rows.append((f"ours over ruckig's, {name}{demand}", figures[ours] / theirs, "x"))
    return rows


def others() -> list[tuple[str, float, str]]:
    """Measure generators that return functions, and functions that use a motor's model."""
    model = MotorModel(name="wheel", velocity_max=2.0, acceleration_max=4.0)
    asked = TrapezoidalTrajectory(1.0, 0.25)
    random = np.random.default_rng(2)
    points = random.uniform(-1.0, 1.0, 10)
    limits = DerivativeLimits(first=2.0, second=10.0)
    spline = through_waypoints(points, limits=limits)

    def times(work: Callable[[], object], count: int) -> float:
        def loop() -> None:
            for _ in range(count):
                work()

        return best(loop, 3) / count

    rows = [
        (
            "generate: a trajectory and a model",
            times(lambda: generate(asked, model), 2_000) * 1e6,
            "us",
        ),
        ("feasible: the same", times(lambda: feasible(asked, model), 2_000) * 1e6, "us"),
        (
            "feasible: a cubic spline through 10 points",
            times(lambda: feasible(spline, limits), 200) * 1e6,
            "us",
        ),
        (
            "a cubic spline through 10 points at given times",
            times(lambda: through_waypoints(points, range(10)), 200) * 1e6,
            "us",
        ),
        (
            "a cubic spline through 10 points, as soon as limits allow",
            times(lambda: through_waypoints(points, limits=limits), 3) * 1e3,
            "ms",
        ),
    ]
    try:
        jerk_limited(1.0, ProfileLimits(1.0, 2.0), 10.0)
    except UnsupportedError:
        return rows
    bounds = ProfileLimits(1.0, 2.0)
    rows += [
        (
            "a motion of limited jerk, by ruckig, judged, as a function",
            times(lambda: jerk_limited(1.0, bounds, 10.0), 500) * 1e6,
            "us",
        ),
    ]
    return rows


def ruckig_loop(
    ways: list[float],
    velocities: list[float],
    ups: list[float],
    downs: list[float],
    *,
    moving: bool,
) -> Callable[[], object] | None:
    """Return a loop that creates input and trajectory for each; None if ruckig is missing."""
    try:
        import ruckig
    except ImportError:
        return None
    generator = ruckig.Ruckig(1)

    def loop() -> list[float]:
        """Compute only the durations, which ours gives as well."""
        durations = []
        for way, velocity, up, down in zip(ways, velocities, ups, downs, strict=True):
            given = ruckig.InputParameter(1)
            given.target_position = [way]
            given.max_velocity = [velocity]
            given.max_acceleration = [up]
            given.min_acceleration = [-down]
            if moving:
                given.current_position = [1.0]
                given.current_velocity = [0.5]
                given.target_velocity = [-0.25]
            made = ruckig.Trajectory(1)
            generator.calculate(given, made)
            durations.append(made.duration)
        return durations

    return loop
