"""The Math Function API: functions as values, for trajectories of any profile.

Source: the paper, 3.3.1 and Figure 6. The class `Function` documents the common rules. This package
imports numpy; `motorapi` itself does not.
"""

from motorapi.errors import DomainError
from motorapi.functions.algebra import Composition, Product, Sum
from motorapi.functions.waves import Exponential
from motorapi.functions.base import Extrema, Function
from motorapi.functions.integrals import Integral
from motorapi.functions.transforms import Scaled, Shifted
from motorapi.functions.piecewise import Piecewise
from motorapi.functions.polynomial import Constant, Polynomial
from motorapi.functions.sampled import Interpolation, Sampled
from motorapi.functions.sampled import Ends
from motorapi.functions.waves import Cosine, Sine

__all__ = [
    "Composition",
    "Constant",
    "Cosine",
    "DomainError",
    "Ends",
    "Exponential",
    "Extrema",
    "Function",
    "Integral",
    "Interpolation",
    "Piecewise",
    "Polynomial",
    "Product",
    "Sampled",
    "Scaled",
    "Shifted",
    "Sine",
    "Sum",
]
