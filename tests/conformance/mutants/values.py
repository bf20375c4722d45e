"""Mistakes with models, errors, commands, profiles and declared traffic, which are values."""

from dataclasses import replace
from unittest.mock import patch

from motorhil.harness.conformance.clauses import traffic
from motorhil.motorapi import Motor, model
from motorhil.motorapi.commands import DerivativeLimits
from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.planning import functions, single_axis
from motorhil.motorapi.synchronization import skew
from motorhil.motorapi.synchronization.bus_load import CanTraffic
from tests.conformance.mutants import mutant, replaced


@mutant("ideal", "ERR-01")
def an_error_that_forgets_the_purpose():
    """The error about a motor of another owner does not have the owner's purpose."""

    def wrong(init):
        def without(error, *, purpose="", **facts):
            init(error, **facts)

        return without

    with replaced(MotorBusyError, "__init__", wrong):
        yield


@mutant("ideal", "MODEL-01")
def a_line_that_counts_from_zero():
    """The lines in errors about model files count from 0."""

    def wrong(line_of):
        return lambda text, key: (line_of(text, key) or 1) - 1

    with replaced(model, "_line_of", wrong):
        yield


@mutant("ideal", "MODEL-02")
def a_force_in_newton_metres():
    """The force of a linear motor has the unit of a torque."""

    def wrong(unit_of):
        return lambda motor, variable: unit_of(motor, variable).replace("N", "N·m")

    with replaced(MotorModel, "unit_of", wrong):
        yield


@mutant("ideal", "LIM-06")
def a_range_that_may_be_empty():
    """Limits of a derivative may exclude rest."""

    def wrong(init):
        def lax(limits, *, first=None, **others):
            init(limits, **others)
            object.__setattr__(limits, "first", first)

        return lax

    with replaced(DerivativeLimits, "__init__", wrong):
        yield


@mutant("ideal", "TIME-01")
def a_first_frame_that_is_the_worst():
    """The response time is that of the first frame of a busy period (Tindell et al., 1994)."""

    def wrong(response_times):
        def refuted(load, *further, **named):
            found = response_times(load, *further, **named)
            return tuple(
                replace(one, response_ns=one.response_ns - 1) if one.instance else one
                for one in found
            )

        return refuted

    with replaced(traffic, "response_times", wrong):
        yield


@mutant("ideal", "TIME-02")
def a_frame_without_stuff_bits():
    """The longest frame is as long as its bits without stuffing."""
    with patch.object(traffic, "longest", traffic.shortest):
        yield


@mutant("ideal", "TIME-03")
def a_sync_that_does_not_count():
    """The SYNC of this program is no traffic."""

    def wrong(with_own):
        return lambda declared, own, sync_period_s, *more: with_own(declared, own, None, *more)

    with replaced(CanTraffic, "with_own", wrong):
        yield


@mutant("ideal", "TRAJ-10")
def one_limit_for_both_directions():
    """A ramp in the negative direction has the limit of the positive one."""
    with replaced(single_axis, "_towards", lambda _: lambda limit, direction: limit[1]):
        yield


@mutant("ideal", "TRAJ-11")
def a_jerk_limit_that_is_twice_as_large():
    """A limit of the third derivative counts twice."""

    def wrong(bend_of):
        def twice(*what):
            bend = bend_of(*what)
            return None if bend is None else 2.0 * bend

        return twice

    with replaced(functions, "bend_of", wrong):
        yield


@mutant("ideal", "TRAJ-12")
def a_limit_that_nobody_sees():
    """After a final velocity, no position limit brakes the motor."""
    with replaced(functions, "_rest_at", lambda _: lambda *what: None):
        yield


@mutant("ideal", "TIME-04")
def a_clock_without_an_error():
    """The bound on the end skew takes the drives' clocks for perfect."""
    with patch.object(skew, "_PPM", 0.0):
        yield


@mutant("ideal", "ID-03")
def an_adaptation_that_may_replace_all():
    """Public methods of a motor may be replaced."""
    with patch.object(Motor, "__init_subclass__", classmethod(lambda cls: None)):
        yield


@mutant("ideal", "DONE-05")
def a_start_that_nobody_misses():
    """A wait for a command that was not started says nothing."""
    with replaced(LogicalMotor, "forgotten", lambda _: lambda motor: ""):
        yield


@mutant("ideal", "SET-10")
def a_set_point_with_the_slopes_of_the_model():
    """A velocity set-point does not use limits of its own."""

    def wrong(bounds):
        return lambda model, limits, target: bounds(model, None, target)

    with replaced(single_axis, "_velocity_bounds", wrong):
        yield
