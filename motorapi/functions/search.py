"""Extrema of functions of any kind, by bounds that can miss nothing."""

from motorapi.functions.function import Extrema, Function


def extrema(function: Function, low: float, high: float) -> Extrema:
    """The extrema over [low, high]."""
    raise NotImplementedError(function, low, high)
