"""Gentle worlds: disturbances that every correct motor bears, drawn by seed.

Inertia, friction and resistance of plants differ by up to a tenth, clocks by 50 ppm, destroyed
frames are sent again, and parties that could continue at one instant take turns in a drawn order.
Each clause holds in each of these worlds; the name of a world stands for all that is drawn.
"""

import re
from collections.abc import Iterator
from random import Random
from typing import Final

from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.swarm.worlds.disturbance import Disturbance, World, fragment
from motorhil.harness.swarm.worlds.profile import Subject, subjects_of

_NAME: Final = re.compile(r"world (\d+)")
_TOLERANCE: Final = 0.1
_PPM: Final = 50.0
_TORQUE_CONSTANT: Final = "torque_constant_n_m_a"  # torques are measured by it
_FRAMES: Final = 300
_ERRORS: Final = ("stuff", "crc", "form")


def world_name(seed: int) -> str:
    """Return the name of the world of a seed, which stands for a variation."""
    return f"world {seed}"


def is_world(name: str) -> bool:
    """Return True if the name of a variation is that of a world."""
    return _NAME.fullmatch(name) is not None


def fragment_of(name: str, description: RigDescription) -> str:
    """Return the world of this name as TOML to append to the rig's text."""
    found = _NAME.fullmatch(name)
    assert found is not None
    return fragment(tuple(_drawn(Random(f"gentle {found[1]}"), description)))


def _drawn(random: Random, description: RigDescription) -> Iterator[Disturbance]:
    if random.random() < 0.5:
        yield Disturbance("interleaving", "", (("seed", random.randrange(1000)),))
    for one in subjects_of(description):
        if one.has_clock and random.random() < 0.5:
            yield Disturbance("clock", one.name, (("ppm", round(random.uniform(-_PPM, _PPM), 1)),))
        yield from _plant(random, one)
    for bus in description.buses.values():
        if not bus.is_line:
            for _ in range(random.randrange(3)):
                values = (("skip", random.randrange(_FRAMES)), ("limit", 1))
                yield Disturbance("error", bus.name, (*values, ("error", random.choice(_ERRORS))))


def _plant(random: Random, one: Subject) -> World:
    numbers = [(key, value) for key, value in one.plant if value and key != _TORQUE_CONSTANT]
    chosen = random.sample(numbers, min(len(numbers), random.randrange(3)))
    return tuple(
        Disturbance("plant", one.name, (("key", key), ("value", _varied(random, value))))
        for key, value in chosen
    )


def _varied(random: Random, value: float) -> float:
    return float(f"{value * random.uniform(1.0 - _TOLERANCE, 1.0 + _TOLERANCE):.3g}")
