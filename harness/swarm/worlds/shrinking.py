"""Shrinking: the smallest world that still fails in the same way.

Disturbances are removed one by one, then numbers are made smaller and rounder, until nothing can
go. What counts as the same way: oracle, rule and role of the signature. State and last fault may
differ, because a smaller world reaches the failure by a shorter way.
"""

from collections.abc import Callable, Iterator
from typing import Final

from motorhil.harness.swarm.row import Row
from motorhil.harness.swarm.worlds.disturbance import FRAME_KINDS, Disturbance, World

TRIES_MAX: Final = 120
_SAME: Final = 3
_LOWEST: Final = 1e-6


def is_alike(one: Row, other: Row) -> bool:
    """Return True if both fail in the same way."""
    return one.is_bad and other.is_bad and cause_of(one) == cause_of(other)


def cause_of(row: Row) -> str:
    """Return oracle, rule and role of a failure."""
    return " | ".join(row.signature.split(" | ")[:_SAME])


def shrunk(row: Row, run: Callable[[World], Row], tries_max: int = TRIES_MAX) -> Row:
    """Return the row of the smallest world found that fails as this one does.

    Args:
        row: a failure, with its world.
        run: runs a world with the failure's seed.
        tries_max: number of runs, at most.
    """
    tried: dict[World, bool] = {row.world: True}
    best = row
    is_moving = True
    while is_moving:
        is_moving = False
        for world in _smaller(best.world):
            if world in tried:
                continue
            if len(tried) > tries_max:
                return best
            found = run(world)
            tried[world] = is_alike(found, row)
            if tried[world]:
                best, is_moving = found, True
                break
    return best


def _smaller(world: World) -> Iterator[World]:
    """Yield simpler worlds, the simplest first."""
    if len(world) > 1:
        for one in world:
            yield (one,)
    for place in range(len(world)):
        if len(world) > 1:
            yield world[:place] + world[place + 1 :]
    for place, one in enumerate(world):
        for other in _simpler(one):
            yield (*world[:place], other, *world[place + 1 :])


def _simpler(one: Disturbance) -> Iterator[Disturbance]:
    for key, value in one.values:
        if isinstance(value, str) or key in ("identifier", "code", "after"):
            continue
        if one.kind in FRAME_KINDS and key in ("skip", "limit"):
            least = 0 if key == "skip" else 1
            for smaller in dict.fromkeys((least, (int(value) + least) // 2, int(value) - 1)):
                if least <= smaller < value:
                    yield one.with_value(key, smaller)
            continue
        if isinstance(value, int):
            if value > 0:
                yield one.with_value(key, 0)
            continue
        for digits in (1, 2):
            rounded = float(f"{value:.{digits}g}")
            if rounded != value and abs(rounded) >= _LOWEST:
                yield one.with_value(key, rounded)
        if key in ("for_s", "delay_s") and value / 2 >= _LOWEST:
            yield one.with_value(key, float(f"{value / 2:.2g}"))
