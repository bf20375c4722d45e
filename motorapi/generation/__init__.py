"""Trajectory generators: boundary conditions and limits to profiles.

    generate             the profile of a simple trajectory for a motor with this model
    trapezoid            the same in plain numbers: shortest, or of a given duration
    possible_durations   the durations that are possible
    jerk_limited         shortest with a limit of the third derivative; with the extra `ruckig` also
                         between states other than rest
    through_waypoints    a smooth function through given values
    feasible             check of limits; lists each violation with time and amount
    shortest, stretched  trapezoids from rest to rest, in the fewest numbers

Importing this package does not import numpy. Generators that return functions import it when
called. Source: the paper, 3.3.2.
"""

from typing import TYPE_CHECKING

from motorhil.motorapi.generation.feasibility import Feasibility, Violation, feasible, generate
from motorhil.motorapi.generation.jerk_limited import jerk_limited
from motorhil.motorapi.generation.limits import ProfileLimits
from motorhil.motorapi.generation.trapezoid import (
    Profile,
    Trapezoid,
    possible_durations,
    shortest,
    stretched,
    trapezoid,
)

if TYPE_CHECKING:
    from motorhil.motorapi.generation.waypoints import through_waypoints

__all__ = [
    "Feasibility",
    "Profile",
    "ProfileLimits",
    "Trapezoid",
    "Violation",
    "feasible",
    "generate",
    "jerk_limited",
    "possible_durations",
    "shortest",
    "stretched",
    "through_waypoints",
    "trapezoid",
]


def __getattr__(name: str) -> object:
    """Import `through_waypoints` at its first use, with numpy."""
    if name != "through_waypoints":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from motorhil.motorapi.generation.waypoints import through_waypoints

    return through_waypoints
