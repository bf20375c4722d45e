"""L1: what start() does, and what it begins from."""

from typing import TYPE_CHECKING, Final

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.motions import (
    aim,
    expect_at,
    expect_rest,
    finish,
    follow,
    least_s,
    long_move,
    place,
    rest_for,
    shortest_s,
    turn,
    watched,
    way_of_stopping,
)
from motorapi import (
    ControlMode,
    DerivativeLimits,
    StateError,
    TrapezoidalTrajectory,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

_EXAMPLES: Final = 6
_LONG: Final = 4.0
_TURN_RAD: Final = 6.3


@clause(
    "START-01",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.start: starting again repeats the command",
)
def starting_again_repeats_the_command(bench: RigProtocol) -> None:
    """Starting again repeats the command: what was a distance is one once more."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))
    motor.start()
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, 2.0 * way, f"after {way:g}, started twice")


@clause(
    "START-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="paper 3.5: start both sets the parameters to match the user's view and executes",
)
def each_start_has_the_settings_made_before_it(bench: RigProtocol) -> None:
    """Each motion goes by the settings made last before its own start, not by earlier ones."""
    motor, model = bench.motor, bench.motor.model
    way, tolerance_s = 0.3 * long_move(bench), bench.facts.time_tolerance_s
    motor.enable()
    for share in (0.3, 1.0, 0.5, 0.25):
        velocity, up, down = (
            share * most
            for most in (model.velocity_max, model.acceleration_max, model.deceleration)
        )
        limits = DerivativeLimits(first=velocity, second=(-down, up))
        expected_s = least_s(way, velocity, up, down)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(way, limits=limits))
        motor.start()
        begun_ns = bench.runtime.now_ns()
        finish(bench, motor, expected_s)
        taken_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        early_s, late_s = bench.facts.latency_s
        expect(
            early_s - tolerance_s <= taken_s - expected_s <= late_s + tolerance_s,
            f"with limits of {share:.0%} of the model's {way:g} {model.unit} take"
            f" {expected_s:.3f} s, it took {taken_s:.3f} s",
        )


@clause(
    "START-03",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    source="Motor.start: in mid-motion a set-point replaces a set-point of its variable",
)
def a_set_point_replaces_another_in_mid_motion(bench: RigProtocol) -> None:
    """A set-point of position that is started in mid-motion replaces the one before, at once."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    aim(motor, way)
    rest_for(bench, 0.3 * shortest_s(motor, way))
    left_at = motor.position()
    target = left_at + 0.3 * long_move(bench)
    aim(motor, target)
    farthest = max(at for _, at in watched(bench, motor, shortest_s(motor, way)))
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, target, f"after {way:g}, replaced by {target:g} half-way")
    brakes = way_of_stopping(motor, motor.model.velocity_max)
    expect(
        farthest <= max(target, left_at + brakes) + 0.15 * way,
        f"it went on to {farthest:.4g} {motor.model.unit}, and then back to {target:.4g}",
    )
    aim(motor, 0.0)
    rest_for(bench, 0.05)
    aim(motor, target)
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, target, "after it was called back on its way to 0")


@clause(
    "START-04",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH},
    source="Motor.start: what is said of velocity replaces what was said of the same",
)
def a_velocity_replaces_another(bench: RigProtocol) -> None:
    """A set-point of velocity that is started in mid-motion replaces the one before."""
    motor, unit = bench.motor, bench.motor.model.unit
    ramp_s = motor.model.velocity_max / motor.model.acceleration_max
    for share in (0.2, 0.5, -0.3):
        asked = share * motor.model.velocity_max
        turn(motor, asked)
        finish(bench, motor, 2.0 * ramp_s)
        rest_for(bench, 0.1)
        before, begun_ns = place(bench, motor), bench.runtime.now_ns()
        rest_for(bench, 0.3)
        found = (place(bench, motor) - before) / ((bench.runtime.now_ns() - begun_ns) / 1e9)
        expect(
            abs(found - asked) <= 0.05 * abs(asked),
            f"told {asked:g} {unit}/s in mid-motion, it goes at {found:g} {unit}/s",
        )
    motor.stop()
    finish(bench, motor)
    expect_rest(bench, motor, "after it was stopped")


@clause(
    "START-05",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.start: everything else starts from rest; paper 3.3.3, only without errors",
)
def what_cannot_be_replaced_is_not_disturbed(bench: RigProtocol) -> None:
    """A trajectory is refused while another one goes on, which ends as if nothing had happened."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    begin = motor.position()
    follow(motor, TrapezoidalTrajectory(way, duration_s=1.5 * shortest_s(motor, way)))
    rest_for(bench, 0.5 * shortest_s(motor, way))
    motor.set_trajectory(TrapezoidalTrajectory(-way))
    try:
        motor.start()
    except StateError:
        pass
    else:
        raise Violated("a second trajectory was started while the first one went on")
    finish(bench, motor, 1.5 * shortest_s(motor, way))
    expect_at(bench, motor, begin + way, "after another trajectory was refused")


@clause(
    "MOVE-01",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    bench={Ability.AFRESH},
    source="requirement 1: to achieve a motion target; paper 3.3, Figure 4",
)
def any_target_is_reached(bench: RigProtocol) -> None:
    """Whatever places within its limits a motor is told to go to, it goes to each in turn."""
    from hypothesis import Phase, given, seed, settings
    from hypothesis import strategies as st

    low, high = _room(bench)
    target = st.one_of(st.floats(low, high), st.floats(-1e-3, 1e-3).map(lambda share: share * high))
    quiet = settings(
        max_examples=_EXAMPLES,
        deadline=None,
        database=None,
        print_blob=False,
        report_multiple_bugs=False,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
    )

    @seed(bench.seed)
    @quiet
    @given(st.lists(target, min_size=1, max_size=2))
    def any_list(targets: "Sequence[float]") -> None:
        bench.afresh()
        for place_number, one in enumerate(targets):
            aim(bench.motor, one)
            finish(bench, bench.motor, shortest_s(bench.motor, high - low))
            expect_at(bench, bench.motor, one, f"target {place_number + 1} of {targets}")

    any_list()


def _room(bench: RigProtocol) -> tuple[float, float]:
    """Between which positions it may be sent: more than a turn to either side, if there is room."""
    model, far = bench.motor.model, _LONG * long_move(bench)
    if model.unit == "rad":
        far = max(far, 1.2 * _TURN_RAD)
    low = -far if model.position_min is None else max(-far, model.position_min)
    high = far if model.position_max is None else min(far, model.position_max)
    return low, high


@clause(
    "MOVE-02",
    Level.L1,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    source="requirement 1; Motor.wait_until_done: what was commanded last is over",
)
def moves_of_no_way_are_moves(bench: RigProtocol) -> None:
    """A move of nothing, or of less than can be counted, is done at once, and the next is made."""
    motor = bench.motor
    least = motor.model.resolution or 1e-6 * long_move(bench)
    way = 0.2 * long_move(bench)
    for tiny in (0.0, 0.4 * least, -1.2 * least):
        begin = motor.position()
        for simple in (True, False):
            if simple:
                follow(motor, TrapezoidalTrajectory(tiny))
            else:
                aim(motor, tiny, relative=True)
            begun_ns = bench.runtime.now_ns()
            finish(bench, motor)
            taken_s = (bench.runtime.now_ns() - begun_ns) / 1e9
            late_s = bench.facts.latency_s[1] + bench.facts.time_tolerance_s
            expect(
                taken_s <= late_s,
                f"a move of {tiny:g} {motor.model.unit} was over after {taken_s:.3f} s only",
            )
        follow(motor, TrapezoidalTrajectory(way))
        finish(bench, motor, shortest_s(motor, way))
        expect_at(bench, motor, begin + way + 2.0 * tiny, f"after moves of {tiny:g}, by {way:g}")
