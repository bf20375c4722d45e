"""Demands of simple trajectories, from a textbook.

A ramp of velocity to the peak p at the rate a takes p/a, and with the jerk j p/a + a/j, or
2 sqrt(p/j) if it does not reach a. It covers p/2 times that, as it is symmetrical. A motion from
rest to rest is a ramp up, a constant velocity, and a ramp down. U is the unit of position.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 3.2.3
and 3.4.
"""

from collections.abc import Callable
from math import inf, sqrt
from typing import Final

from motorhil.motorapi import ControlVariable, Motor

Demand = Callable[[float], float]
"""The value at a time since the beginning [s]."""
_HALVINGS: Final = 60


def jerk_of(motor: Motor, variable: ControlVariable = ControlVariable.POSITION) -> float:
    """Return the jerk that simple trajectories of this motor keep [U/s³]; inf: no limit."""
    jerk = motor.model.jerk_max
    return jerk if jerk is not None and motor.logical.hooks.limits_jerk(variable) else inf


def ramp_s(peak: float, rate: float, jerk: float = inf) -> float:
    """Return the time of a ramp from rest to this velocity [s]."""
    if peak * jerk >= rate * rate:
        return peak / rate + rate / jerk
    return 2.0 * sqrt(peak / jerk)


def least_s(way: float, velocity: float, up: float, down: float, jerk: float = inf) -> float:
    """Return the shortest time of a rest-to-rest move within these limits [s]."""
    peak = _peak(abs(way), velocity, up, down, jerk)
    if peak == 0.0:
        return 0.0
    return abs(way) / peak + 0.5 * (ramp_s(peak, up, jerk) + ramp_s(peak, down, jerk))


def shortest(way: float, velocity: float, up: float, down: float, jerk: float = inf) -> Demand:
    """Return the position over time of the shortest move within these limits."""
    return _move(way, _peak(abs(way), velocity, up, down, jerk), up, down, jerk)


def trapezoid(way: float, duration_s: float, up: float, down: float, jerk: float = inf) -> Demand:
    """Return the position over time of a move of this duration, with these ramps."""
    twice_s = 1.0 / up + 1.0 / down
    peak = (duration_s - sqrt(max(0.0, duration_s**2 - 2.0 * twice_s * abs(way)))) / twice_s
    if jerk != inf:  # the faster its peak, the sooner it is there
        fast = 2.0 * abs(way) / duration_s
        peak = _root(lambda peak: duration_s - least_s(way, peak, up, down, jerk), fast)
    return _move(way, peak, up, down, jerk)


def slowed(demand: Demand, share: float) -> Demand:
    """Return the demand at this share of its speed."""
    return lambda at_s: demand(share * at_s)


def ramped(change: float, duration_s: float, rate: float, jerk: float = inf) -> Demand:
    """Return the position over time of a velocity that changes from 0 in this time, and stays.

    Its ramp is the steepest that rate and jerk allow, made slower.
    """
    size, side = abs(change), 1.0 if change >= 0.0 else -1.0
    least = ramp_s(size, rate, jerk)
    share = least / duration_s

    def position(at_s: float) -> float:
        at = share * max(at_s, 0.0)
        made = _ramped(at, size, least, rate, jerk) if at < least else size * (at - 0.5 * least)
        return side * made / share

    return position


def when_s(demand: Demand, goal: float, most_s: float) -> float:
    """Return the time at which a demand that rises from 0 until `most_s` is at this value [s]."""
    return _root(lambda at_s: demand(at_s) - goal, most_s)


def _root(rising: Demand, most: float) -> float:
    """Return where a function that rises from 0 to `most` is 0."""
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if rising(middle) >= 0.0 else (middle, high)
    return 0.5 * (low + high)


def _peak(way: float, velocity: float, up: float, down: float, jerk: float) -> float:
    """Return the largest velocity of the shortest move over this distance [U/s]."""
    if jerk == inf:
        return min(velocity, sqrt(2.0 * way / (1.0 / up + 1.0 / down)))

    def beyond(peak: float) -> float:
        return 0.5 * peak * (ramp_s(peak, up, jerk) + ramp_s(peak, down, jerk)) - way

    return velocity if beyond(velocity) <= 0.0 else _root(beyond, velocity)


def _move(way: float, peak: float, up: float, down: float, jerk: float) -> Demand:
    """Return the position over time of a move with this largest velocity."""
    length, side = abs(way), 1.0 if way >= 0.0 else -1.0
    up_s, down_s = ramp_s(peak, up, jerk), ramp_s(peak, down, jerk)
    duration_s = length / peak + 0.5 * (up_s + down_s) if peak else 0.0

    def position(at_s: float) -> float:
        at_s = min(max(at_s, 0.0), duration_s)
        if at_s < up_s:
            made = _ramped(at_s, peak, up_s, up, jerk)
        elif at_s <= duration_s - down_s:
            made = peak * (at_s - 0.5 * up_s)
        else:
            made = length - _ramped(duration_s - at_s, peak, down_s, down, jerk)
        return side * made

    return position


def _ramped(at_s: float, peak: float, whole_s: float, rate: float, jerk: float) -> float:
    """Return the way after this time of a ramp."""
    if at_s > 0.5 * whole_s:  # its second half is the first one, turned round
        return peak * (at_s - 0.5 * whole_s) + _ramped(whole_s - at_s, peak, whole_s, rate, jerk)
    bend_s = min(rate / jerk, 0.5 * whole_s)
    steepest = peak / (whole_s - bend_s)
    if at_s < bend_s:
        return steepest * at_s**3 / (6.0 * bend_s)
    late_s = at_s - bend_s
    return steepest * (bend_s**2 / 6.0 + 0.5 * bend_s * late_s + 0.5 * late_s**2)
