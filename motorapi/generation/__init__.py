"""Trajectory generators: from boundary conditions and limits to a motion at every moment.

    generate             what a simple trajectory asks for, of a motor with this model
    trapezoid            the same in plain numbers: shortest, or of a given duration
    possible_durations   which durations there are
    jerk_limited         shortest with a limit of the third derivative (extra `ruckig`)
    through_waypoints    a smooth function through given values
    feasible             whether limits are held; else which are not, when and by how much
    shortest, stretched  trapezoids from rest to rest, in the fewest numbers

Importing this loads no numpy; `motorapi.generation.batched` does, where trapezoids, jerk-limited
motions and functions through way-points are generated over arrays. So do generators that return
functions, when they are called. Source: the paper, 3.3.2.
"""

from motorapi.generation.closed_form import trapezoid
from motorapi.generation.durations import possible_durations
from motorapi.generation.feasibility import Feasibility, Violation, feasible
from motorapi.generation.generator import generate
from motorapi.generation.limits import ProfileLimits
from motorapi.generation.profile import Profile
from motorapi.generation.rest_to_rest import Trapezoid, shortest, stretched
from motorapi.generation.smooth import jerk_limited
from motorapi.generation.waypoints import through_waypoints

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
