"""Trajectory generators: from boundary conditions and limits to a motion at every moment.

Importing this loads no numpy; `motorapi.generation.batched`, which works on arrays, does.
Source: the paper, 3.3.2.
"""

from motorapi.generation.rest_to_rest import Trapezoid, shortest, stretched

__all__ = ["Trapezoid", "shortest", "stretched"]
