"""The Math Function API: functions as values, for trajectories of any profile.

Source: the paper, 3.3.1 and Figure 6. What holds for all of them: `motorapi.functions.function`.
This package loads numpy; `motorapi` itself does not.
"""

from motorapi.errors import DomainError
from motorapi.functions.function import Extrema, Function
from motorapi.functions.piecewise import Piecewise
from motorapi.functions.polynomial import Constant, Polynomial

__all__ = ["Constant", "DomainError", "Extrema", "Function", "Piecewise", "Polynomial"]
