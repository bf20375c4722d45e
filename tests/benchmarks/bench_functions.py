"""Math functions compared with scipy and numpy; all figures are ratios.

A thousand pieces at a million points, in random and in ascending order; waves; samples; and one
number at a time, as for a motor's set-points. CPU time; each figure is the best of several.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from motorhil.motorapi.functions import Cosine, Interpolation, Piecewise, Sampled, Sine

PIECES = 1000
POINTS = 1_000_000
ROUNDS = 9
Figure = tuple[str, float, str]


def ratio(ours: Callable[[], object], theirs: Callable[[], object]) -> float:
    """Return our CPU time divided by theirs; the best of each, measured alternately."""
    best = [float("inf"), float("inf")]
    for _ in range(ROUNDS):
        for number, work in enumerate((ours, theirs)):
            start = time.process_time()
            work()
            best[number] = min(best[number], time.process_time() - start)
    return best[0] / best[1]


def by_pieces(draw: np.random.Generator) -> list[Figure]:
    """Compare evaluation of whole arrays with scipy.interpolate.PPoly."""
    figures: list[Figure] = []
    breaks = np.append(0.0, np.cumsum(draw.uniform(0.1, 1.0, PIECES)))
    points = draw.uniform(breaks[0], breaks[-1], POINTS)
    for degree in (1, 3, 5):
        rows = draw.normal(size=(degree + 1, PIECES))
        theirs = PPoly(rows, breaks)
        ours = Piecewise.of_polynomials(breaks.tolist(), rows[::-1].T.tolist())
        for order, x in (("any order", points), ("ascending", np.sort(points))):
            assert np.allclose(ours(x), theirs(x), rtol=1e-9)
            name = f"1,000 pieces of degree {degree} at 1e6 points in {order}, of PPoly's time"
            figures.append((name, ratio(partial(ours, x), partial(theirs, x)), "x"))
    return figures


def made_and_differentiated(draw: np.random.Generator) -> list[Figure]:
    """Compare construction of a spline with scipy.interpolate.CubicSpline."""
    x = np.cumsum(draw.uniform(0.1, 1.0, 1000)).tolist()
    y = draw.normal(size=1000).tolist()
    made = ratio(lambda: Sampled(x, y, Interpolation.CUBIC), lambda: CubicSpline(x, y))
    return [("a cubic spline made of 1,000 samples, of CubicSpline's time", made, "x")]


def waves(draw: np.random.Generator) -> list[Figure]:
    """Compare waves and their combinations with the same in numpy."""
    x = draw.uniform(-10.0, 10.0, POINTS)
    one, both = Sine(2.0, 3.0, 0.5), Sine(2.0, 3.0, 0.5) * Cosine(1.0, 2.0) + 1.0

    def by_hand() -> object:
        return 2.0 * np.sin(3.0 * x + 0.5) * np.cos(2.0 * x) + 1.0

    return [
        (
            "a sine at 1e6 points, of numpy's time",
            ratio(lambda: one(x), lambda: 2.0 * np.sin(3.0 * x + 0.5)),
            "x",
        ),
        ("sine * cosine + 1 at 1e6 points, of numpy's time", ratio(lambda: both(x), by_hand), "x"),
    ]


def one_by_one(draw: np.random.Generator) -> list[Figure]:
    """Compare evaluation of single numbers, as for set-points; a thousand of them."""
    breaks = np.append(0.0, np.cumsum(draw.uniform(0.1, 1.0, PIECES)))
    rows = draw.normal(size=(4, PIECES))
    theirs = PPoly(rows, breaks)
    ours = Piecewise.of_polynomials(breaks.tolist(), rows[::-1].T.tolist())
    arguments = draw.uniform(breaks[0], breaks[-1], 1000).tolist()
    value = ours.value

    def call_ours() -> None:
        for x in arguments:
            value(x)

    def call_theirs() -> None:
        for x in arguments:
            theirs(x)

    faster = 1.0 / ratio(call_ours, call_theirs)
    return [("1,000 pieces at one number, faster than a call of PPoly", faster, "x")]


def run() -> list[Figure]:
    """Return the figures as (name, figure, unit)."""
    draw = np.random.default_rng(3)
    return [*by_pieces(draw), *made_and_differentiated(draw), *waves(draw), *one_by_one(draw)]
