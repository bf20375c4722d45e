"""Mistakes in refusals: limits, modes, invalid values."""

from dataclasses import replace
from math import isnan

from motorhil.motorapi import Motor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.conformance.mutants import mutant, replaced


@mutant("ideal", "LIM-01")
def limits_of_position_ignored_in_trajectories():
    """Position limits apply to set-points, but not to trajectories."""

    def wrong(plan):
        def planned(motor, model, variable, trajectory, reference, **options):
            if isinstance(trajectory, TrapezoidalTrajectory) and trajectory.limits is not None:
                own = trajectory.limits
                free = DerivativeLimits(first=own.first, second=own.second, third=own.third)
                trajectory = replace(trajectory, limits=free)
            return plan(motor, model, variable, trajectory, reference, **options)

        return planned

    with replaced(planning, "plan_trajectory", wrong):
        yield


@mutant("ideal", "LIM-02")
def limits_hold_upwards_only():
    """Limits are compared with the signed value: backwards nothing is too fast."""
    from motorhil.motorapi.planning import limits

    def wrong(value_range):
        def found(model, variable):
            return None, value_range(model, variable)[1]

        return found

    with replaced(limits, "value_range", wrong):
        yield


@mutant("cia402", "LIM-03")
def says_that_it_can_and_cannot():
    """Current trajectories are accepted, but the adaptation cannot make them."""

    def wrong(supports):
        def supported(self, mode, variable):
            asked = (mode, variable) == (ControlMode.TRAJECTORY, ControlVariable.CURRENT)
            return asked or supports(self, mode, variable)

        return supported

    with replaced(Cia402Motor, "_supports", wrong):
        yield


@mutant("ideal", "LIM-04")
def endless_set_points():
    """NaN is refused, but infinity is not."""
    with replaced(planning, "isfinite", lambda isfinite: lambda value: not isnan(value)):
        yield


@mutant("cia402", "LIM-05")
def limits_are_checked_at_fifty_places():
    """Complex trajectories are compared with the limits at 50 arguments, not at their extrema."""
    from motorhil.motorapi.functions import Extrema, Piecewise, Polynomial

    def wrong(extrema):
        def found(self, low, high):
            places = [low + (high - low) * (number + 0.5) / 50 for number in range(50)]
            values = [(self.value(place), place) for place in places]
            return Extrema(*min(values), *max(values))

        return found

    with replaced(Polynomial, "_extrema", wrong), replaced(Piecewise, "_extrema", wrong):
        yield


@mutant("oriental_az", "LIM-04")
def the_command_before_stays():
    """A refused set-point leaves the one before, which the next start makes."""

    def wrong(set_setpoint):
        def told(motor, value, relative=False, limits=None):
            before = motor.logical.command
            try:
                set_setpoint(motor, value, relative, limits)
            except UsageError:
                motor.logical.command = before
                raise

        return told

    with replaced(Motor, "set_setpoint", wrong):
        yield
