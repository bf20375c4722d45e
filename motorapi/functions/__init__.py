"""The Math Function API: functions as values, for trajectories of any profile.

Source: the paper, 3.3.1 and Figure 6. The class `Function` documents the common rules. This package
imports numpy; `motorapi` itself does not.
"""

from motorhil.motorapi.errors import DomainError
from motorhil.motorapi.functions.algebra import Composition, Product, Sum
from motorhil.motorapi.functions.base import Extrema, Function
from motorhil.motorapi.functions.integrals import Integral
from motorhil.motorapi.functions.piecewise import Piecewise
from motorhil.motorapi.functions.polynomial import Constant, Polynomial
from motorhil.motorapi.functions.sampled import Ends, Interpolation, Sampled
from motorhil.motorapi.functions.transforms import Scaled, Shifted
from motorhil.motorapi.functions.waves import Cosine, Exponential, Sine

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
