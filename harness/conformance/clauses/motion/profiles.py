"""L1: profiles between states, under limits of their own: of slope, of jerk, of position."""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from math import inf, isclose, sqrt
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, ramp_s, ramped, shortest
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_moved,
    expect_rest,
    expect_speed,
    expect_tracks,
    failure_of,
    finish,
    follow,
    half_move,
    position_of,
    reached,
    rest_for,
    sample_positions,
    shortest_s,
    worst_deviation,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motion,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.api import demand_of

_AFTER_S: Final = 0.2
_STEP: Final = 1e-4
_SAMPLES: Final = 40
_KINK: Final = 0.02  # more than a smooth second derivative changes between two steps


@clause(
    "TRAJ-13",
    Level.L1,
    needs={Capability.VELOCITY_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, derivative limits: a range, so that each direction has its own",
)
def velocity_ramps_keep_limits_of_each_direction(bench: RigProtocol) -> None:
    """Within limits of its own, a velocity ramp is as steep as its direction allows."""
    motor, model = bench.motor, bench.motor.model
    gentle = min(model.acceleration_max, model.deceleration)
    falling, rising = 0.2 * gentle, 0.4 * gentle
    top = 0.4 * model.velocity_max
    motor.enable()
    jerk = jerk_of(motor, ControlVariable.VELOCITY)
    speed = 0.0
    for change in (top, -0.5 * top, -1.5 * top, 0.5 * top, 0.5 * top):
        rate = rising if change > 0.0 else falling
        ramp = TrapezoidalTrajectory(change, limits=DerivativeLimits(first=(-falling, rising)))
        duration_s = ramp_s(abs(change), rate, jerk)
        demand = ramped(change, duration_s, rate, jerk)
        before, asked_ns = position_of(bench, motor), bench.runtime.now_ns()
        follow(motor, ramp, ControlVariable.VELOCITY)
        late_s = elapsed_s(bench, asked_ns) + max(map(abs, bench.facts.latency_s)) + 0.01
        samples = sample_positions(bench, motor, duration_s + _AFTER_S)
        finish(bench, motor, duration_s)
        bound = bench.facts.following + 0.02 * abs(change) * duration_s
        bound += late_s * top  # it begins between the command and a latency after its return
        for at_s, position in samples:
            off = position - before - speed * at_s - demand(at_s)
            expect(
                abs(off) <= bound,
                f"{at_s:.3f} s into a ramp from {speed:g} by {change:g} {model.unit}/s at"
                f" {rate:g} {model.unit}/s²: {off:.5g} {model.unit} off; limit {bound:.5g}",
            )
        speed += change
    motor.stop()
    finish(bench, motor)


@clause(
    "TRAJ-14",
    Level.L1,
    needs={Capability.VELOCITY_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1: the same representation bounds one more derivative, a smoother motion",
)
def velocity_ramp_bends_as_allowed(bench: RigProtocol) -> None:
    """A limit of the second derivative of a velocity is refused, or used: no faster, no slower."""
    motor, model = bench.motor, bench.motor.model
    rate = 0.4 * min(model.acceleration_max, model.deceleration)
    bend, top = min(4.0 * rate, model.jerk_max or inf), 0.4 * model.velocity_max
    motor.enable()
    for change in (top, -top):
        duration_s = ramp_s(abs(change), rate, bend)
        ramp = TrapezoidalTrajectory(change, limits=DerivativeLimits(first=rate, second=bend))
        before = position_of(bench, motor)
        try:
            follow(motor, ramp, ControlVariable.VELOCITY)
        except UnsupportedError as error:
            raise NotApplicable(f"it bounds no second derivative: {error}") from None
        samples = sample_positions(bench, motor, duration_s + _AFTER_S)
        finish(bench, motor)
        expect_speed(bench, motor, change, 0.1, f"after {ramp!r}")
        motor.stop()
        finish(bench, motor)
        way = ramped(change, duration_s, rate, bend)
        shown = [(at_s, position - before) for at_s, position in samples]
        worst = worst_deviation(bench, shown, way)
        bound = bench.facts.following + 0.02 * abs(change) * duration_s
        expect(worst <= bound, f"{ramp!r}: {worst:.5g} {model.unit} off; limit {bound:.5g}")


@clause(
    "TRAJ-11",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.1, derivative limits; Biagiotti & Melchiorri 2008, 3.4: double S",
)
def jerk_limit_is_used_or_refused(bench: RigProtocol) -> None:
    """A limit of the third derivative is refused, or used: no faster, no slower than it allows."""
    motor, model = bench.motor, bench.motor.model
    if Capability.LIMITED_JERK in bench.facts.claims:
        keeps = motor.logical.hooks.limits_jerk(ControlVariable.POSITION)
        expect(keeps, "the rig claims limits of jerk, which the motor does not keep")
    gentle = min(model.acceleration_max, model.deceleration)
    jerk = min(2.0 * gentle, model.jerk_max or inf)
    motor.enable()
    for way in (0.05 * gentle, -0.05 * gentle):
        # Never at the largest velocity or acceleration: four equal parts of constant jerk.
        quarter_s = (abs(way) / (2.0 * jerk)) ** (1.0 / 3.0)
        slow = jerk * quarter_s**2 < model.velocity_max
        if not slow or jerk * quarter_s > gentle or abs(way) > abs(half_move(bench)) * 2.0:
            raise NotApplicable("its limits leave no room for a move that its jerk limits alone")
        limited = TrapezoidalTrajectory(way, limits=DerivativeLimits(third=jerk))
        before = position_of(bench, motor)
        try:
            follow(motor, limited)
        except UnsupportedError as error:
            raise NotApplicable(f"it limits no jerk: {error}") from None
        samples = sample_positions(bench, motor, 4.0 * quarter_s + _AFTER_S)
        finish(bench, motor)
        expect_moved(bench, motor, before, way, "with a limit of jerk")
        wanted = shortest(way, model.velocity_max, gentle, gentle, jerk)
        shown = [(at_s, position - before) for at_s, position in samples]
        expect_tracks(bench, shown, wanted, f"{limited!r}")


@clause(
    "TRAJ-12",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="TrapezoidalTrajectory: with a final velocity it continues, or to rest at a limit",
)
def final_velocity_brakes_at_limit(bench: RigProtocol) -> None:
    """After a final velocity, a motor comes to rest at a position limit, and not beyond it."""
    motor, model = bench.motor, bench.motor.model
    velocity = 0.4 * model.velocity_max
    brake = 0.5 * velocity**2 / model.deceleration
    way = 0.3 * half_move(bench) + velocity**2 / model.acceleration_max
    motor.enable()
    for side in (1.0, -1.0):
        begun = position_of(bench, motor)
        here = motor.position()
        room = side * (way + brake + 0.2 * velocity)  # 0.2 s at its final velocity
        ends = sorted((here - 0.1 * side * way, here + room))
        limits = DerivativeLimits(value=(ends[0], ends[1]))
        too_near = TrapezoidalTrajectory(
            side * (way + 0.5 * brake + 0.2 * velocity),
            limits=limits,
            final_derivatives=(side * velocity,),
        )
        onward = TrapezoidalTrajectory(
            side * way, limits=limits, final_derivatives=(side * velocity,)
        )
        try:
            error = failure_of(partial(follow, motor, too_near))
            if isinstance(error, UnsupportedError):
                raise error
            fastest = velocity / sqrt(2.0)  # that brakes in half of the distance
            expect(
                isinstance(error, LimitError)
                and error.high is not None
                and isclose(error.high, fastest, rel_tol=0.01),
                f"no room to brake from {velocity:g} {model.unit}/s: {error!r}; expected a refusal"
                f" that allows {fastest:g} {model.unit}/s",
            )
            follow(motor, onward)
        except UnsupportedError as error:
            raise NotApplicable(f"it ends at rest only: {error}") from None
        finish(bench, motor, shortest_s(motor, 2.0 * way))
        expect_speed(bench, motor, side * velocity, 0.1, "before its limit")
        samples = sample_positions(bench, motor, 0.1 + velocity / model.deceleration + 0.3)
        expect_rest(bench, motor, "at its limit")
        expect_moved(bench, motor, begun, room, "with a final velocity, to its limit", 2.0)
        steps = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(samples)]
        brakes = [a - b for a, b in pairwise(one * side for one in steps)]
        worst = max(sum(brakes[at : at + 8]) for at in range(len(brakes)))
        allowed = model.deceleration * 9.0 * 0.005 * 1.1 + 4.0 * bench.facts.following / 0.005
        expect(worst <= allowed, f"brakes by {worst:.5g} {model.unit}/s in 0.04 s")
        motor.stop()
        rest_for(bench, _AFTER_S)
        finish(bench, motor)


def _motions() -> tuple[Motion, ...]:
    """Return trajectories of every kind that a demand is made of, with their start and target."""
    from motorhil.motorapi.functions import Polynomial

    plain = Motion(
        *(ControlMode.TRAJECTORY, ControlVariable.POSITION, 0.5, -1.5, 1.0, 4.0, 3.0),
        trajectory=TrapezoidalTrajectory(-2.0),
    )
    ramp = replace(plain, variable=ControlVariable.VELOCITY, target=-0.7, duration_s=2.0)
    rise = Polynomial((0.0, 0.0, 0.0, 10.0, -15.0, 6.0))  # from 0 to 1 in 1 s, from rest to rest
    follows = replace(
        plain, target=1.5, duration_s=1.0, function=rise, offset=0.5, interval=(0.0, 1.0)
    )
    begins = Polynomial((0.0, 0.0, 1.0))  # to 1 in 1 s, with a final velocity of 2
    return (
        *(plain, ramp, replace(ramp, variable=ControlVariable.TORQUE, slope=2.0), follows),
        replace(follows, function=begins, final_velocity=2.0),
        replace(follows, function=begins, final_velocity=2.0, rest_at=2.5),
    )


@clause("TRAJ-16", Level.L1, source="the adaptation API, demand_of: value and two derivatives")
def demand_changes_by_its_derivatives(_: RigProtocol) -> None:
    """The demand that hosts sample changes by its derivatives, from its start to its target."""
    for motion in _motions():
        demand = demand_of(motion)
        begin, end = demand.initial_argument, demand.final_argument
        for at, wanted in (
            (begin - 0.1, motion.start),
            (begin, motion.start),
            (end, motion.target),
        ):
            found = demand.value(at)
            expect(isclose(found, wanted, abs_tol=1e-9), f"{motion}: {found:g} at {at:g} s")
        compared = 0
        for sample in range(_SAMPLES):
            at = begin + (sample + 0.4) * 1.7 * (end - begin) / _SAMPLES
            before, after = at - _STEP, at + _STEP
            around = [demand.second(at + steps * _STEP) for steps in (-2, 0, 2)]
            if max(around) - min(around) > _KINK:
                continue
            compared += 1
            for what, of, rate in (
                ("value", demand.value, demand.first(at)),
                ("first derivative", demand.first, demand.second(at)),
            ):
                found = (of(after) - of(before)) / (2.0 * _STEP)
                expect(
                    abs(found - rate) <= _KINK,
                    f"{motion}: at {at:g} s, its {what} changes by {found:g} per s; told {rate:g}",
                )
        reached(compared > _SAMPLES // 2, f"a comparison of most instants of {motion}")
