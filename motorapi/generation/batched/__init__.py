"""The generators over arrays: many motions at once. Loads numpy.

Every array is of shape (n,), or a number that holds for all n motions. A motion that cannot be made
is an error that names its index; what the limits allow, `possible_durations` tells beforehand.
"""

from motorhil.motorapi.generation.batch import (
    Curves,
    LimitArrays,
    Profiles,
    jerk_limited,
    through_waypoints,
    trapezoids,
)

__all__ = [
    "Curves",
    "LimitArrays",
    "Profiles",
    "jerk_limited",
    "through_waypoints",
    "trapezoids",
]
