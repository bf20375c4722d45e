"""Definite integrals of functions of any kind."""

from motorapi.functions.function import Function


def integrate(function: Function, low: float, high: float) -> float:
    """The integral over [low, high]."""
    raise NotImplementedError(function, low, high)
