"""Mistakes with refusals, errors, models, profiles and declared traffic."""

from contextlib import suppress
from dataclasses import replace
from math import isnan
from unittest.mock import patch

from motorhil.harness.conformance.clauses import traffic
from motorhil.harness.rig.rig import Rig, RigController
from motorhil.motorapi import Motor, execution, model
from motorhil.motorapi.adaptations.cia402 import measurements
from motorhil.motorapi.adaptations.cia402.csp import StreamedMotion
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.dryve.hardware import DryveHwMotor
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.mit import frames
from motorhil.motorapi.adaptations.moteus.motor import MoteusHwMotor, MoteusTable
from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor
from motorhil.motorapi.adaptations.vesc import motor as vesc
from motorhil.motorapi.api import polled_hardware, registration
from motorhil.motorapi.api.can_drive import CanDrive
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import DeadlineExceeded, MotorBusyError, UnsupportedError, UsageError
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.planning import functions, single_axis
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.synchronization import skew
from motorhil.motorapi.synchronization.bus_load import CanTraffic
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from motorhil.settings import declaration
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


@mutant("ideal", "LIM-07")
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


@mutant("ideal", "TRAJ-13")
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


@mutant("ideal", "SET-11")
def a_set_point_with_the_slopes_of_the_model():
    """A velocity set-point does not use limits of its own."""

    def wrong(bounds):
        return lambda model, limits, target: bounds(model, None, target)

    with replaced(single_axis, "_velocity_bounds", wrong):
        yield


@mutant("moteus", "OPT-01")
def unknown_settings_are_ignored():
    """Keys that the adaptation does not know are left out without a word."""

    def wrong(read_settings):
        def lenient(of, table, unit=""):
            known = declaration(of).names(unit)
            return read_settings(of, {key: table[key] for key in table if key in known}, unit)

        return lenient

    with replaced(registration, "read_settings", wrong):
        yield


@mutant("moteus", "OPT-02")
def usual_values_are_mixed_up():
    """The usual values of an option are given with the larger one first."""
    keys = declaration(MoteusTable).keys
    kind = replace(keys["poll_ms"].kind, plausible=(50.0, 1.0))
    with patch.dict(keys, {"poll_ms": replace(keys["poll_ms"], kind=kind)}):
        yield


@mutant("rmd", "OPT-03")
def second_settings_are_ignored():
    """A further motor on a drive gets the hardware object as it is, whatever its settings are."""

    def wrong(get):
        return lambda self, home, place, make, _: get(self, home, place, make, lambda _: True)

    with replaced(registration.Shared, "get", wrong):
        yield


@mutant("mit", "OPT-04")
def range_of_one_model_is_another_ones():
    """One of the models of the drive has the velocities of another one."""
    maker, ranges = frames.MODELS["ak80_9_v2"]
    with patch.dict(frames.MODELS, {"ak80_9_v2": (maker, ranges._replace(v=22.5))}):
        yield


@mutant("moteus", "FIT-01")
def any_register_map_will_do():
    """The adaptation controls a drive without a look at the version of its registers."""
    with replaced(MoteusHwMotor, "_connected", lambda _: lambda self: None):
        yield


@mutant("dryve", "FIT-02")
def a_wait_for_twice_as_long_as_told():
    """A wait for a state of the drive lasts for twice as long as its error tells."""

    def wrong(await_):
        def waited(self, what, is_met):
            try:
                await_(self, what, is_met)
            except DeadlineExceeded as error:
                timeout_s = 0.5 * error.timeout_s
                raise DeadlineExceeded(
                    awaited=error.awaited, timeout_s=timeout_s, last_heard=error.last_heard
                ) from error

        return waited

    with replaced(DryveHwMotor, "_await", wrong):
        yield


@mutant("mit", "TIME-05")
def commands_are_declared_too_rare():
    """The host declares a tenth of the commands that it sends."""

    def wrong(note_frames):
        def noted(self, sent, ours=()):
            note_frames(self, sent, [(one, length, 10.0 * period) for one, length, period in ours])

        return noted

    with replaced(CanDrive, "note_frames", wrong):
        yield


@mutant("leadshine", "MODEL-03")
def gear_is_one_if_unknown():
    """A model without a gear ratio counts as one of a motor without a gear."""

    def wrong(gear):
        return lambda model: 1.0 if model.gear_ratio is None else gear(model)

    with replaced(polled_hardware, "gear", wrong):
        yield


@mutant("vesc", "FAULT-09")
def fault_of_the_motor_is_one_of_the_transistors():
    """One code of the maker's list has the text of its neighbour."""
    with patch.dict(vesc.FAULTS, {6: vesc.FAULTS[5]}):
        yield


@mutant("oriental_az", "PAR-02")
def current_is_below_zero():
    """A stated current is written with the wrong sign, which the drive refuses."""

    def wrong(limit_current):
        return lambda self, current: limit_current(self, None if current is None else -current)

    with replaced(OrientalAzHwMotor, "limit_current", wrong):
        yield


@mutant("leadshine", "HOME-05")
def list_of_methods_has_a_wrong_one():
    """The refusal of a homing method lists one that the drive does not have."""

    def wrong(home):
        def homed(self, method, motor):
            try:
                home(self, method, motor)
            except UnsupportedError as error:
                known = error.supported.replace("35", "36")
                feature = f"homing by method {method}"
                raise UnsupportedError(motor=motor, feature=feature, supported=known) from None

        return homed

    with replaced(LeadshineHwMotor, "home", wrong):
        yield


@mutant("cia402", "LEAD-04")
def step_of_an_argument_is_in_another_unit():
    """The error about a step of an argument has its velocity in units of an acceleration."""

    def wrong(beyond):
        def told(motion, quantity, value, limit):
            error = beyond(motion, quantity, value, limit)
            error.unit += "²"
            return error

        return told

    with replaced(StreamedMotion, "_beyond", wrong):
        yield


@mutant("cia402", "LEAD-05")
def a_motor_leads_itself():
    """A motor whose own position leads it is started."""
    with replaced(execution, "_require_no_ring", lambda _: lambda *_: None):
        yield


@mutant("mit", "OPT-05")
def physical_inputs_are_not_checked():
    """Physical inputs that cannot be are ignored without a word."""

    def wrong(stimulate):
        def stimulated(drive, name, value):
            with suppress(ValueError):
                stimulate(drive, name, value)

        return stimulated

    with replaced(RigController, "stimulate", wrong):
        yield


@mutant("cia402", "OPT-06")
def clock_of_an_emulated_drive_is_ignored():
    """An emulated drive has an ideal clock, whatever its rig states."""

    def wrong(build):
        def built(rig, controller):
            own = {key: one for key, one in controller.settings.items() if key != "oscillator"}
            return build(rig, replace(controller, settings=own))

        return built

    with replaced(Rig, "_build_controller", wrong):
        yield


@mutant("ideal", "LIM-08")
def derivatives_of_a_ramp_are_ignored():
    """Derivatives at the ends of a ramp of velocity are accepted, and have no effect."""
    with replaced(single_axis, "_require_rest_at_ends", lambda _: lambda *_: None):
        yield


@mutant("cia402", "LIM-09")
def limits_of_the_drive_are_not_read():
    """The limits of velocity and acceleration that the drive itself has are not read."""

    def wrong(read):
        def unlimited(hardware):
            return replace(read(hardware), speed=None, acceleration=None, deceleration=None)

        return unlimited

    with replaced(measurements, "_read_limits", wrong):
        yield
