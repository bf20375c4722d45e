"""The generators over arrays: many motions at once. Loads numpy.

Every array is of shape (n,), or a number that holds for all n motions. A motion that cannot be made
is an error that names its index; what the limits allow, `possible_durations` tells beforehand.
"""

from motorapi.generation.batch import Curves
from motorapi.generation.batch import LimitArrays
from motorapi.generation.batch import Profiles
from motorapi.generation.batch import jerk_limited
from motorapi.generation.batch import trapezoids
from motorapi.generation.batch import through_waypoints

__all__ = [
    "Curves",
    "LimitArrays",
    "Profiles",
    "jerk_limited",
    "through_waypoints",
    "trapezoids",
]
