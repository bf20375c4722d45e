"""Trajectory generators: from boundary conditions and limits to a motion at every moment.

Importing this loads no numpy; `motorapi.generation.batched`, which works on arrays, does.
Source: the paper, 3.3.2.
"""

from motorapi.generation.durations import possible_durations
from motorapi.generation.limits import ProfileLimits
from motorapi.generation.profile import Profile
from motorapi.generation.rest_to_rest import Trapezoid, shortest, stretched
from motorapi.generation.trapezoid import trapezoid

__all__ = [
    "Profile",
    "ProfileLimits",
    "Trapezoid",
    "possible_durations",
    "shortest",
    "stretched",
    "trapezoid",
]
