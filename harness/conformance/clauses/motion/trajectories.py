"""L1: trajectories are followed at every instant."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import pairwise
from math import copysign, fsum, inf, sqrt
from statistics import stdev

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.demands import (
    Demand,
    jerk_of,
    least_s,
    ramp_s,
    ramped,
    shortest,
    slowed,
    trapezoid,
)
from motorhil.harness.conformance.clauses.helpers import (
    cubic_step,
    elapsed_s,
    expect_at,
    expect_moved,
    expect_raises,
    expect_rest,
    expect_speed,
    expect_tracks,
    expect_unmoved,
    failing_function,
    failure_of,
    finish,
    follow,
    long_move,
    move,
    position_of,
    reached,
    rest_for,
    sample_positions,
    shortest_s,
    torque_of,
    worst_deviation,
)
from motorhil.harness.conformance.clauses.motion.limits import expect_unit
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    LinkError,
    Motor,
    MotorGroup,
    MotorPosition,
    PluginError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)

_AFTER_S = 0.2
_GEAR = 0.5  # of a led motor
_LEADS = 0.1  # of the largest velocity, that of a leader
_SLOWLY = 0.025
_SLIGHTLY = 0.01  # of the model's velocity
_SOON_S = 0.02
_PASSES_S = 0.08  # a start may last as long
_PASSED_S = 0.1  # what it may have passed of the trajectory meanwhile
_LOOKS = 12
_LOOK_S = 0.007
_SWEEP_S = 0.5
_STREAM_S = 0.02  # between set-points, at most
_FAILS_S = 0.5
_PROBLEM = "a gear without teeth"
_LED_S = 2.0
_FEW_S = 0.02  # a few samples


def _expect_profile(
    bench: RigProtocol,
    trajectory: TrapezoidalTrajectory,
    *allowed: tuple[float, Demand],
) -> None:
    """Check that a relative trajectory is followed as one of these demands, of so many seconds."""
    motor = bench.motor
    motor.enable()
    before = position_of(bench, motor)
    follow(motor, trajectory)
    longest_s = max(duration_s for duration_s, _ in allowed)
    samples = [(t, at - before) for t, at in sample_positions(bench, motor, longest_s + _AFTER_S)]
    finish(bench, motor)
    demands = [demand for _, demand in allowed]
    nearest = min(demands, key=lambda demand: worst_deviation(bench, samples, demand))
    expect_tracks(bench, samples, nearest, f"{trajectory!r}")
    reached(
        worst_deviation(bench, samples, slowed(nearest, 1.0 / 1.3)) > bench.facts.following,
        "a move long enough to distinguish two profiles",
    )


@clause(
    "TRAJ-01",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="paper 3.3.1, boundary conditions; Figure 5",
)
def absolute_trajectory_ends_at_final_value(bench: RigProtocol) -> None:
    """With an initial value, a trajectory is absolute, and is refused from another position."""
    motor, one = bench.motor, 0.4 * long_move(bench)
    origin = motor.position()
    move(bench, motor, one)
    for initial, final in (
        (origin + one, origin + 1.5 * one),
        (origin + 1.5 * one, origin + 0.5 * one),
    ):
        follow(motor, TrapezoidalTrajectory(final, initial))
        finish(bench, motor, shortest_s(motor, one))
        expect_at(bench, motor, final, f"after a trajectory from {initial:g} to {final:g}")
    elsewhere = origin + 2.0 * one + motor.model.start_tolerance
    motor.set_trajectory(TrapezoidalTrajectory(origin + one, elsewhere))
    expect_raises(StateError, motor.start, "a trajectory from another position was started")
    expect_at(bench, motor, origin + 0.5 * one, "after a refused trajectory")
    motor.disable()
    follow(motor, TrapezoidalTrajectory(origin + one, motor.position()))
    finish(bench, motor, shortest_s(motor, one))
    expect_at(bench, motor, origin + one, "after a trajectory that began without power")


@clause(
    "TRAJ-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, simple trajectories, Figure 5; 3.3: follows a prescribed profile",
)
def simple_trajectory_takes_given_duration(bench: RigProtocol) -> None:
    """In both directions, a simple trajectory of given duration is followed at every instant."""
    model, way = bench.motor.model, 0.7 * long_move(bench)
    limits = model.acceleration_max, model.deceleration, jerk_of(bench.motor)
    duration_s = 1.8 * shortest_s(bench.motor, way)
    for signed in (way, -way):
        trajectory = TrapezoidalTrajectory(signed, duration_s=duration_s)
        allowed = [trapezoid(signed, duration_s, *limits)]
        if limits[-1] != inf:  # a slower peak, or more time for all
            allowed.append(slowed(shortest(signed, model.velocity_max, *limits), 1.0 / 1.8))
        _expect_profile(bench, trajectory, *((duration_s, one) for one in allowed))


@clause(
    "TRAJ-03",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, derivative limits: the allowed ranges; 3.2, the model's by default",
)
def simple_trajectory_uses_its_limits(bench: RigProtocol) -> None:
    """Within its velocity and acceleration limits, a simple trajectory is as fast as possible."""
    model, way = bench.motor.model, 0.7 * long_move(bench)
    up, down = 0.6 * model.acceleration_max, 0.15 * model.deceleration
    velocity = 0.5 * model.velocity_max
    limits = DerivativeLimits(first=velocity, second=(-down, up))
    gentle = min(up, down)  # of a drive with one ramp for both
    bounds = [(velocity, *ramps, jerk_of(bench.motor)) for ramps in ((up, down), (gentle, gentle))]
    allowed = [(least_s(way, *one), shortest(way, *one)) for one in bounds]
    _expect_profile(bench, TrapezoidalTrajectory(way, limits=limits), *allowed)


@clause(
    "TRAJ-04",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH},
    source="paper 3.3.1, complex trajectories, Figure 6",
)
def complex_trajectory_is_followed(bench: RigProtocol) -> None:
    """Complex position trajectories are followed at every instant, from any start position."""
    from motorhil.motorapi.functions import Polynomial

    motor, model = bench.motor, bench.motor.model
    duration_s = 2.0
    gentle = min(model.acceleration_max, model.deceleration)
    size = min(0.5 * long_move(bench), 0.4 * model.velocity_max, 0.1 * gentle)
    if model.jerk_max is not None:
        size = min(size, 0.04 * model.jerk_max)  # 195.6 of it by the time cubed
    motor.enable()
    begin = motor.position()
    place = begin + 0.2 * size
    follow(motor, TrapezoidalTrajectory(place, initial=begin))
    finish(bench, motor, shortest_s(motor, size))
    # A hump, 16 s^2 (1 - s)^2, on a smooth step, 3 s^2 - 2 s^3, of 0.3: at rest at both ends.
    # It begins at 0.7: relative, only the differences count.
    shape = Polynomial((0.7, 0.0, 16.9, -32.6, 16.0)).restricted(0.0, 1.0)
    function = shape.scaled(duration_s) * size
    before = position_of(bench, motor)
    follow(motor, ComplexTrajectory(function, relative=True))
    samples = [(t, at - before) for t, at in sample_positions(bench, motor, duration_s + _AFTER_S)]
    finish(bench, motor)

    def wanted(at_s: float) -> float:
        s = min(max(at_s / duration_s, 0.0), 1.0)
        return size * (16.0 * (s * (1.0 - s)) ** 2 + 0.3 * s**2 * (3.0 - 2.0 * s))

    expect_tracks(bench, samples, wanted, "a complex trajectory")
    _expect_way_back(bench, motor, place)
    straight = trapezoid(wanted(duration_s), duration_s, model.acceleration_max, model.deceleration)
    reached(worst_deviation(bench, samples, straight) > bench.facts.following, "a curved motion")


def _expect_way_back(bench: RigProtocol, motor: Motor, place: float) -> None:
    """Expect a move to the place of the last one to be made, although others were in between."""
    follow(motor, TrapezoidalTrajectory(place, initial=motor.position()))
    finish(bench, motor, shortest_s(motor, long_move(bench)))
    expect_at(bench, motor, place, "back where it was before a complex trajectory")


@clause(
    "TRAJ-10",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH},
    source="paper 3.3.1, boundary conditions; 3.2, the model's acceleration and deceleration",
)
def complex_trajectory_is_led_in_within_limits(bench: RigProtocol) -> None:
    """A motor a little beside the beginning of a complex trajectory is led there, or takes it."""
    from motorhil.motorapi.functions import Polynomial

    motor, model = bench.motor, bench.motor.model
    reach = 0.8 * model.start_tolerance
    if reach <= 3.0 * bench.facts.following:
        raise NotApplicable("model.start_tolerance is too small to see a motion within it")
    motor.enable()
    way = 0.1 * long_move(bench)
    time_s = max(_LED_S, 8.0 * shortest_s(motor, way))  # slow: the lead-in takes whole periods
    limits = model.velocity_max, model.acceleration_max, model.deceleration
    lead_s = least_s(reach, *limits)
    for away in (reach, -reach):
        cubic = (motor.position() + away, 0.0, 3.0 * way / time_s**2, -2.0 * way / time_s**3)
        before = position_of(bench, motor)
        try:
            follow(motor, ComplexTrajectory(Polynomial(cubic).restricted(0.0, time_s)))
        except StateError:
            raise NotApplicable("complex trajectories are refused from elsewhere") from None
        sampled = sample_positions(bench, motor, lead_s + time_s + _AFTER_S)
        finish(bench, motor)
        samples = [(at_s, at - before) for at_s, at in sampled]
        step = _led(0.0, way, time_s, partial(_held, away))
        late = [one for one in samples if one[0] > _AFTER_S]
        if worst_deviation(bench, late, step) <= max(bench.facts.following, bench.facts.window):
            continue  # its control evens out the difference
        wanted = _led(lead_s, way, time_s, shortest(away, *limits))
        expect_tracks(bench, samples, wanted, "a complex trajectory, led in")


def _held(away: float, _at_s: float) -> float:
    return away


def _led(
    lead_s: float, way: float, time_s: float, lead: Callable[[float], float]
) -> Callable[[float], float]:
    """Return the position over time of a cubic step after a lead-in."""

    def position(at_s: float) -> float:
        s = min(max((at_s - lead_s) / time_s, 0.0), 1.0)
        return lead(at_s) + way * s**2 * (3.0 - 2.0 * s)

    return position


@clause(
    "TRAJ-05",
    Level.L1,
    needs={Capability.VELOCITY_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1: the function value can be of any control variable; Figure 5",
)
def velocity_trajectory_is_ramp(bench: RigProtocol) -> None:
    """Velocity trajectories reach their velocity in the given time, and keep it."""
    motor = bench.motor
    motor.enable()
    model = motor.model
    rate, jerk = model.acceleration_max, jerk_of(motor, ControlVariable.VELOCITY)
    asked = 0.5 * model.velocity_max
    duration_s = max(1.0, 1.1 * ramp_s(asked, rate, jerk))
    before = position_of(bench, motor)
    ramp = TrapezoidalTrajectory(asked, duration_s=duration_s)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(ramp)
    asked_ns = bench.runtime.now_ns()
    motor.start()
    started_s = elapsed_s(bench, asked_ns)  # the ramp has begun at any time of this
    samples = sample_positions(bench, motor, 1.3 * duration_s)
    finish(bench, motor)
    expect_speed(bench, motor, asked, 0.2, "after the ramp")
    motor.stop()
    finish(bench, motor)
    unit = motor.model.unit
    spare_s = 0.05 + max(map(abs, bench.facts.latency_s))
    made = ramped(asked, duration_s, rate, jerk)
    for at_s, position in samples:
        early, late = made(at_s + started_s + spare_s), made(at_s - spare_s)
        spare = bench.facts.following
        expect(
            late - spare <= position - before <= early + spare,
            f"{at_s:.3f} s into a ramp to {asked:g} {unit}/s in {duration_s:g} s,"
            f" moved {position - before:.5g} {unit};"
            f" expected {late:.5g} to {early:.5g} {unit}",
        )
    _expect_slight_ramp(bench, motor, _SLIGHTLY * model.velocity_max, duration_s)


def _expect_slight_ramp(bench: RigProtocol, motor: Motor, asked: float, duration_s: float) -> None:
    """Check that a ramp to a velocity within the window of its drive takes its time, too."""
    motor.set_trajectory(TrapezoidalTrajectory(asked, duration_s=duration_s))
    begun_ns = bench.runtime.now_ns()
    try:
        motor.start()
    except UsageError:  # slower than the hardware can
        return
    finish(bench, motor, duration_s)
    took_s, unit = elapsed_s(bench, begun_ns), motor.model.unit
    motor.stop()
    finish(bench, motor)
    expect(
        took_s >= 0.5 * duration_s,
        f"a ramp to {asked:g} {unit}/s in {duration_s:g} s was done after {took_s:.3f} s",
    )


@clause(
    "TRAJ-06",
    Level.L1,
    needs={Capability.TORQUE_TRAJECTORY},
    bench={Ability.LOAD, Ability.TRUTH},
    source="paper 3.3.1: the function value can be of any control variable; Motor.is_done",
)
def torque_trajectory_is_ramp(bench: RigProtocol) -> None:
    """Torque trajectories reach their torque in the given time: half of it at half-time."""
    motor = bench.motor
    motor.enable()
    asked, duration_s = torque_of(motor, 0.8), 0.6
    ramp = TrapezoidalTrajectory(asked, duration_s=duration_s)
    follow(motor, ramp, ControlVariable.TORQUE)
    bench.load(motor, 0.5 * asked)
    samples = sample_positions(bench, motor, 0.9 * duration_s)
    expect(not motor.is_done(), f"a torque ramp of {duration_s:g} s was done after 90% of that")
    bench.load(motor, 0.0)
    motor.stop()
    finish(bench, motor)
    # The load pushes the motor back from the beginning, ever faster, until the torque equals the
    # load. Friction supports the motor, so the turn comes earlier.
    steps = pairwise(samples)
    falls = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in steps]
    at_s = samples[falls.index(min(falls))][0]
    reached(falls[-1] > min(falls), "a torque larger than the load")
    expect(
        min(falls) < 0.0 and 0.25 * duration_s <= at_s <= 0.65 * duration_s,
        f"a torque ramp of {duration_s:g} s reached half of its torque after {at_s:.3f} s",
    )


@clause(
    "TRAJ-07",
    Level.L1,
    needs={Capability.COMPLEX_VELOCITY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, complex trajectories: any control variable; Figure 6, integrals",
)
def complex_velocity_position_is_integral(bench: RigProtocol) -> None:
    """Complex velocity trajectories are followed: the position is their integral at all times."""
    from motorhil.motorapi.functions import Polynomial

    motor, model = bench.motor, bench.motor.model
    duration_s = 2.0
    gentle = min(model.acceleration_max, model.deceleration)
    peak = min(0.4 * model.velocity_max, 0.2 * gentle * duration_s)  # slope <= 4
    if model.jerk_max is not None:
        peak = min(peak, 0.1 * model.jerk_max * duration_s**2)  # bend 8
    motor.enable()
    before = position_of(bench, motor)
    hump = Polynomial((0.0, 4.0, -4.0)).restricted(0.0, 1.0)  # up to 1 and back
    follow(motor, ComplexTrajectory(hump.scaled(duration_s) * peak), ControlVariable.VELOCITY)
    samples = [(t, at - before) for t, at in sample_positions(bench, motor, duration_s + _AFTER_S)]
    motor.stop()
    finish(bench, motor)

    def wanted(at_s: float) -> float:
        s = min(max(at_s / duration_s, 0.0), 1.0)
        return peak * duration_s * (2.0 * s**2 - 4.0 / 3.0 * s**3)

    worst, unit = worst_deviation(bench, samples, wanted), model.unit
    bound = bench.facts.following + 0.02 * wanted(duration_s)  # no position control corrects this
    expect(
        worst <= bound,
        f"complex velocity trajectory: {worst:.5g} {unit} off its integral;"
        f" limit {bound:.5g} {unit}",
    )


@clause(
    "TRAJ-08",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, boundary conditions: initial and final values of derivatives",
)
def velocities_at_ends_are_met_or_refused(bench: RigProtocol) -> None:
    """A velocity at an end of a trajectory is refused, or is the motor's there."""
    motor, way = bench.motor, 0.3 * long_move(bench)
    velocity = 0.4 * motor.model.velocity_max
    motor.enable()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    try:
        motor.set_trajectory(TrapezoidalTrajectory(way, final_derivatives=(velocity,)))
        motor.start()
    except UnsupportedError:
        expect_rest(bench, motor, "after a refused trajectory with a final velocity")
        return
    finish(bench, motor, shortest_s(motor, 2.0 * way))
    expect_speed(bench, motor, velocity, _AFTER_S, "after a trajectory with a final velocity")
    follow(motor, TrapezoidalTrajectory(way, initial_derivatives=(velocity,)))
    before = position_of(bench, motor)
    rest_for(bench, _SOON_S)
    expect(
        position_of(bench, motor) - before >= 0.5 * velocity * _SOON_S,
        f"a trajectory that begins at {velocity:g} {motor.model.unit}/s begins at rest",
    )
    finish(bench, motor, shortest_s(motor, 2.0 * way))
    expect_rest(bench, motor, "after a trajectory that ends at rest")
    _expect_passed(bench, motor, -way, -velocity)
    motor.set_trajectory(TrapezoidalTrajectory(way, initial_derivatives=(velocity,)))
    expect_raises(StateError, motor.start, "a motor at rest began with a velocity")


def _expect_passed(bench: RigProtocol, motor: Motor, way: float, velocity: float) -> None:
    """Check that a trajectory with an initial value passes its final value at this velocity."""
    here = motor.position()
    there = (velocity,)
    follow(motor, TrapezoidalTrajectory(here + way, initial=here, final_derivatives=there))
    finish(bench, motor, shortest_s(motor, 2.0 * way))
    passed, unit = motor.position() - here, motor.model.unit
    late = abs(velocity) * (bench.facts.time_tolerance_s + max(map(abs, bench.facts.latency_s)))
    expect(
        abs(passed - way) <= bench.facts.window + late,
        f"from {here:g} {unit}, by {way:g} {unit}: done was reported after {passed:g} {unit}",
    )
    _expect_taken_over_in_motion(bench, motor, way, velocity)


def _expect_taken_over_in_motion(
    bench: RigProtocol, motor: Motor, way: float, velocity: float
) -> None:
    """Check that a trajectory begins where the motor is as it passes, and not where it was."""
    here, unit = motor.position(), motor.model.unit

    def start_from(begin: float) -> None:
        made = TrapezoidalTrajectory(begin + way, initial=begin, initial_derivatives=(velocity,))
        motor.set_trajectory(made)
        motor.start()

    if abs(way) > 4.0 * (motor.model.start_tolerance + _PASSED_S * abs(velocity)):
        what = f"passing {here:g} {unit} at {velocity:g} {unit}/s, began {0.5 * way:g} before that"
        expect_raises(StateError, partial(start_from, here - 0.5 * way), what)
    seen_ns, here = bench.runtime.now_ns(), motor.position()
    try:
        start_from(here)
    except StateError as error:
        took_s = elapsed_s(bench, seen_ns)
        expect(took_s > _PASSES_S, f"after {took_s:g} s at {velocity:g} {unit}/s: {error}")
        motor.stop()  # the wall clock has gone on
        finish(bench, motor)
        return
    finish(bench, motor, shortest_s(motor, 2.0 * way))
    expect_at(bench, motor, here + way, f"after a trajectory from {here:g} {unit}, in motion")


@clause(
    "TRAJ-09",
    Level.L1,
    needs={Capability.COMPLEX_VELOCITY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, complex trajectories: the final value; Motor.wait_until_done",
)
def last_sample_of_stream_is_executed(bench: RigProtocol) -> None:
    """Complex velocity trajectories of a few samples end at their final velocity, and keep it."""
    from motorhil.motorapi.functions import Polynomial

    motor, model = bench.motor, bench.motor.model
    steepest = 0.5 * min(model.acceleration_max, model.deceleration)
    if model.jerk_max is not None:
        steepest = min(steepest, 0.4 * model.jerk_max * _FEW_S)
    motor.enable()
    for sign in (1.0, -1.0):
        final = sign * steepest * _FEW_S  # of a parabola, twice as steep at its end
        rise = Polynomial((0.0, 0.0, final / _FEW_S**2)).restricted(0.0, _FEW_S)
        follow(motor, ComplexTrajectory(rise), ControlVariable.VELOCITY)
        finish(bench, motor, _FEW_S)
        rest_for(bench, _AFTER_S)
        begun_ns, before = bench.runtime.now_ns(), bench.true_position(motor)
        rest_for(bench, 1.0)
        found = (bench.true_position(motor) - before) / elapsed_s(bench, begun_ns)
        motor.stop()
        finish(bench, motor)
        spare = 0.02 * abs(final) + 2.0 * bench.facts.following
        expect(
            abs(found - final) <= spare,
            f"a trajectory to {final:g} {model.unit}/s in {_FEW_S:g} s continues at {found:.6g}"
            f" {model.unit}/s; expected within {spare:.3g} {model.unit}/s",
        )


@clause(
    "LEAD-01",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH, Ability.SECOND_MOTOR},
    source="paper 3.3.1: the argument can be another quantity than time; Argument, MotorPosition",
)
def led_motor_follows_its_leader(bench: RigProtocol) -> None:
    """A motor that another one leads follows it both ways, and is done at the end of the range."""
    led, leader = bench.motors[:2]
    led.set_control_mode(ControlMode.TRAJECTORY)
    try:
        _expect_known_leader(bench, led, leader)
        try:
            _follow_there_and_back(bench, led, leader, _LEADS)
        except LimitError:  # the leader is heard too seldom for this velocity
            finish(bench, leader)
            _lead(bench, leader, -0.5 * long_move(bench), _SLOWLY)
            _follow_there_and_back(bench, led, leader, _SLOWLY)
    except UnsupportedError as error:
        raise NotApplicable(f"no motor can lead this one: {error}") from None


def _follow_there_and_back(bench: RigProtocol, led: Motor, leader: Motor, share: float) -> None:
    """Let a motor follow to the middle of a range, half back, and beyond its end."""
    from motorhil.motorapi.functions import Polynomial

    way, origin = long_move(bench), leader.position()
    gear = Polynomial((0.0, _GEAR)).restricted(origin, origin + way)
    led.set_trajectory(ComplexTrajectory(gear, relative=True), MotorPosition(leader))
    before = position_of(bench, led)
    led.start()
    progress = led.progress()
    expect(
        progress is None or progress.expected_s is None,
        f"its leader decides how long a led motion takes: {progress!r}",
    )
    made = 0.0
    for part in (0.5, -0.25):
        _lead(bench, leader, part * way, share, led)
        rest_for(bench, _AFTER_S)
        made += part
        expect(not led.is_done(), f"done was reported at {made:.0%} of the leader's range")
        expect_moved(bench, led, before, _GEAR * made * way, f"its leader moved by {part:g}")
    _lead(bench, leader, way, share)  # to the end of the range, and beyond
    finish(bench, led)
    expect_moved(bench, led, before, _GEAR * way, "its leader left the range")


def _expect_known_leader(bench: RigProtocol, led: Motor, leader: Motor) -> None:
    """Check that a leader is refused until its position is known."""
    from motorhil.motorapi.functions import Polynomial

    gear = Polynomial((0.0, _GEAR)).restricted(-1.0, 1.0)
    led.set_trajectory(ComplexTrajectory(gear, relative=True), MotorPosition(leader))
    error, latest = failure_of(led.start), leader.latest()
    if isinstance(error, UnsupportedError):
        raise error
    is_known = latest is not None and latest.position is not None
    expect(
        is_known if error is None else isinstance(error, UsageError | LinkError),
        f"a leader whose position is known: {is_known}; start() ended with {error!r}",
    )
    led.stop()
    finish(bench, led)


def _lead(
    bench: RigProtocol, leader: Motor, way: float, share: float, led: Motor | None = None
) -> None:
    """Move slowly: the position of a leader is known in steps, which a gentle brake must follow.

    A motor that is led must report its velocity at half of the way.
    """
    model = leader.model
    slow = share * model.velocity_max * min(1.0, model.deceleration / model.acceleration_max)
    follow(leader, TrapezoidalTrajectory(way, limits=DerivativeLimits(first=slow)))
    if led is not None:
        begun_ns = bench.runtime.now_ns()
        while elapsed_s(bench, begun_ns) < 0.5 * abs(way) / slow:
            leader.position()  # some are known only when they are asked
            rest_for(bench, _LOOK_S)
        wanted, unit = copysign(_GEAR * slow, way), led.model.unit
        told = []
        with suppress(UnsupportedError):
            for _ in range(_LOOKS):  # it follows in steps
                leader.position()
                told.append(led.velocity())
                rest_for(bench, _LOOK_S)
            mean = fsum(told) / _LOOKS
            error = 2.0 * stdev(told) / sqrt(_LOOKS)  # single ones scatter as much as they are
            expect(
                abs(mean - wanted) <= 0.9 * abs(wanted) + error,
                f"led at {wanted:g} {unit}/s, its mean velocity is {mean:g} {unit}/s",
            )
    finish(bench, leader, shortest_s(leader, way) + abs(way) / slow)


class _Failing:
    """An argument at rest; from `begin` it grows with time squared, then fails with this error.

    Without an error, it steps by `step` in the place of that.
    """

    name = "failing argument"
    rate_max = 1.0

    def __init__(self, bench: RigProtocol, error: Exception | None, step: float = 0.0) -> None:
        self._bench, self._error, self._step = bench, error, step
        self._begun_ns: int | None = None

    def begin(self) -> None:
        """Let it grow: a drive may take long to start."""
        self._begun_ns = self._bench.runtime.now_ns()

    def value(self) -> float:
        """Return the square of the time since `begin`, or raise the error after a while."""
        if self._begun_ns is None:
            return 0.0
        passed_s = elapsed_s(self._bench, self._begun_ns)
        if passed_s <= _FAILS_S:
            return passed_s**2
        if self._error is not None:
            raise self._error
        return passed_s**2 + self._step


@clause(
    "LEAD-02",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    source="Argument.value: raises; errors: LinkError, PluginError; Motor.wait_until_done",
)
def failing_argument_ends_the_motion(bench: RigProtocol) -> None:
    """If its argument fails, a motion fails with the error of the argument, and the motor stops."""
    from motorhil.motorapi.functions import Polynomial

    motor = bench.motor
    motor.enable()
    slow = _LEADS * motor.model.velocity_max
    ramp = Polynomial((0.0, slow)).restricted(0.0, 1.0)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    broken = LinkError(link=motor.name, reason="an argument that fails")
    for error, expected in ((broken, LinkError), (ZeroDivisionError("no"), PluginError)):
        argument = _Failing(bench, error)
        try:
            motor.set_trajectory(ComplexTrajectory(ramp, relative=True), argument)
            motor.start()
            argument.begin()
        except UnsupportedError as refused:
            raise NotApplicable(f"no argument can lead this motor: {refused}") from None
        expect_raises(
            expected,
            partial(finish, bench, motor, 2.0 * _FAILS_S),
            f"the argument failed with {error!r}, and the wait returned",
        )
        motor.stop()
        finish(bench, motor)
        expect_rest(bench, motor, "after its argument failed")


@clause(
    "TRAJ-15",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    source="paper 3.3.1, complex trajectories; errors: PluginError; Motor.wait_until_done",
)
def failing_function_ends_the_motion(bench: RigProtocol) -> None:
    """If the function of a trajectory fails in a motion, so does the motion; the motor holds."""
    motor, way = bench.motor, long_move(bench)
    duration_s = 2.0 * shortest_s(motor, way)
    motor.enable()
    for sign in (1.0, -1.0):
        before = position_of(bench, motor)
        function, fail = failing_function(cubic_step(sign * way, duration_s), _PROBLEM)
        follow(motor, ComplexTrajectory(function, relative=True))
        rest_for(bench, 0.4 * duration_s)
        fail()
        try:
            finish(bench, motor, duration_s)
        except PluginError as error:
            expect(_PROBLEM in f"{error}", f"a function failed with {_PROBLEM!r}: {error}")
        else:  # it was evaluated before
            expect_moved(bench, motor, before, sign * way, "a function failed after its last use")
            continue
        rest_for(bench, motor.model.velocity_max / motor.model.deceleration + _AFTER_S)
        expect_rest(bench, motor, "after its function failed")
        with suppress(UnsupportedError):
            off, most = motor.following_error(), 1.5 * bench.facts.window
            what = f"after its function failed: {off:g} {motor.model.unit} off its demand, at rest"
            expect(abs(off) <= most, f"{what}; expected at most {most:g} {motor.model.unit}")
    move(bench, motor, 0.1 * way)  # no stop is needed before


class _Sweep:
    """An argument at 0; from `begin` it grows to 1 within a time, and goes on."""

    name = "sweep"
    rate_max = 1.0 / _SWEEP_S

    def __init__(self, bench: RigProtocol) -> None:
        self._bench = bench
        self.begun_ns: int | None = None

    def begin(self) -> None:
        """Let it grow: a drive may take long to start."""
        self.begun_ns = self._bench.runtime.now_ns()

    def value(self) -> float:
        """Return the share of the time that has passed."""
        if self.begun_ns is None:
            return 0.0
        return elapsed_s(self._bench, self.begun_ns) / _SWEEP_S


@clause(
    "LEAD-03",
    Level.L1,
    needs={Capability.COMPLEX_VELOCITY},
    bench={Ability.TRUTH},
    source="paper 3.3.1: complex trajectories of any control variable, over any argument",
)
def led_velocity_is_that_of_the_function(bench: RigProtocol) -> None:
    """A velocity over an argument is the function's, both ways, and stays at its final value."""
    from motorhil.motorapi.functions import Polynomial

    motor, model = bench.motor, bench.motor.model
    motor.enable()
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    top = 0.3 * min(model.velocity_max, min(model.acceleration_max, model.deceleration) * _SWEEP_S)
    for velocity in (top, -top):
        sweep = _Sweep(bench)
        rise = Polynomial((0.0, 0.0, 3.0 * velocity, -2.0 * velocity)).restricted(0.0, 1.0)
        try:
            motor.set_trajectory(ComplexTrajectory(rise), sweep)
            motor.start()
        except UnsupportedError as error:
            raise NotApplicable(f"no argument can lead its velocity: {error}") from None
        before = position_of(bench, motor)
        sweep.begin()
        rest_for(bench, 0.5 * _SWEEP_S)
        what = "led by an argument"
        expect(not motor.is_done(), f"{what}: done was reported at half of its range")
        finish(bench, motor, _SWEEP_S)
        made, passed_s = position_of(bench, motor) - before, elapsed_s(bench, sweep.begun_ns or 0)
        wanted, unit = velocity * (passed_s - 0.5 * _SWEEP_S), model.unit
        late_s = 2.0 * _STREAM_S + max(map(abs, bench.facts.latency_s))
        expect(
            abs(made - wanted) <= late_s * abs(velocity) + bench.facts.window,
            f"{what}: moved {made:g} {unit} in {passed_s:g} s; expected {wanted:g} {unit}",
        )
        expect_speed(bench, motor, velocity, _AFTER_S, f"{what}, after its range")
        motor.stop()
        finish(bench, motor)


def _expect_rate_is_heeded(bench: RigProtocol, motor: Motor) -> None:
    """Check that a function is refused which an argument at its maximum rate makes too fast."""
    from motorhil.motorapi.functions import Polynomial

    fast = 2.0 * motor.model.velocity_max * _SWEEP_S
    step = Polynomial((0.0, 0.0, 3.0 * fast, -2.0 * fast)).restricted(0.0, 1.0)
    try:
        motor.set_trajectory(ComplexTrajectory(step, relative=True), _Sweep(bench))
        motor.start()
    except UnsupportedError as error:
        raise NotApplicable(f"no argument can lead this motor: {error}") from None
    except LimitError:
        return
    raise Violated(f"up to {1.5 * fast / _SWEEP_S:g} {motor.model.unit}/s by its argument: started")


@clause(
    "LEAD-04",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH},
    source="LimitError: value, limit, unit; Argument: one that steps moves no motor beyond a limit",
)
def step_of_argument_is_refused_truly(bench: RigProtocol) -> None:
    """If its argument steps, a motion fails; an error about a limit has the quantity's unit."""
    from motorhil.motorapi.functions import Polynomial

    motor, way = bench.motor, 0.5 * long_move(bench)
    motor.enable()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    _expect_rate_is_heeded(bench, motor)
    slow = _LEADS * motor.model.velocity_max
    reach = 2.0 * way / slow
    ramp = Polynomial((0.0, slow)).restricted(-reach, reach)
    for step in (0.5 * reach, -0.5 * reach):
        argument = _Failing(bench, None, step)
        try:
            motor.set_trajectory(ComplexTrajectory(ramp, relative=True), argument)
            motor.start()
        except UnsupportedError as error:
            raise NotApplicable(f"no argument can lead this motor: {error}") from None
        argument.begin()
        ending = failure_of(partial(motor.wait_until_done, 2.0 * _FAILS_S))
        expect(ending is not None, f"its argument stepped by {step:g}, and done was reported")
        if isinstance(ending, LimitError):
            expect_unit(ending, motor)
            expect(ending.motor == motor.name, f"a step of the argument of {motor.name}: {ending}")
        motor.stop()
        if failure_of(partial(finish, bench, motor)) is None:  # a motor with a fault coasts
            expect_rest(bench, motor, "after its argument stepped")
        motor.reset_fault()
        motor.enable()


@clause(
    "LEAD-05",
    Level.L1,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH, Ability.SECOND_MOTOR, Ability.SEVERAL_USERS, Ability.ONE_PROGRAM},
    source="MotorPosition; StateError: motor, state, remedy; nothing was sent",
)
def motor_that_leads_itself_is_refused(bench: RigProtocol) -> None:
    """A motor that would lead itself, also through others, is refused with all names in order."""
    from motorhil.motorapi.functions import Polynomial

    first, second = bench.motors[:2]
    again = bench.another_user_of(first)
    gear = ComplexTrajectory(Polynomial((0.0, _GEAR)).restricted(-1.0, 1.0), relative=True)
    places = []
    for motor in (first, second):
        motor.enable()
        motor.position()
        places.append(position_of(bench, motor))
        motor.set_control_mode(ControlMode.TRAJECTORY)
    again.position()
    for leaders, ring in (
        ({first: first}, (first, first)),
        ({first: again}, (first, again)),
        ({first: second, second: first}, (first, second, first)),
    ):
        try:
            for led, leader in leaders.items():
                led.set_trajectory(gear, MotorPosition(leader))
            error = failure_of(MotorGroup(*leaders).start)
        except UnsupportedError as refused:
            raise NotApplicable(f"no motor can lead this one: {refused}") from None
        if isinstance(error, UnsupportedError):
            raise NotApplicable(f"no motor can lead this one: {error}")
        told = " follows ".join(one.name for one in ring)
        told += ", the same motor;" if ring[-1] is again else ";"
        expect(
            isinstance(error, StateError) and told in f"{error}" and error.motor == first.name,
            f"a motor that leads itself: {error!r}; expected StateError with {told!r}",
        )
    for motor, place in zip((first, second), places, strict=True):
        expect_unmoved(bench, motor, place, f"{motor.name}, after a ring was refused")
