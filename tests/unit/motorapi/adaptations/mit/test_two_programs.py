"""Two programs with one motor: the former owner holds it until the next one does.

The drive does nothing without commands, so that a load would fall while nobody holds it.
"""

import pytest

from motorhil.harness.conformance.clauses.helpers import finish, move, rest_for, turn
from motorhil.motorapi.state import MotorState
from tests.support.kit_benches import opener

KINDS = pytest.mark.parametrize("kind", ["mit", "robstride"])
PERIOD_S = 0.005


def two_programs(bench):
    """Return the motor of each program; the first one has moved it, and holds it now."""
    bench.apart()
    motor, other = bench.motor, bench.another_user_of(bench.motor)
    other.position()
    motor.enable()
    move(bench, motor, 0.2)
    rest_for(bench, 0.1)
    return motor, other


def next_repetition_ns(bench):
    """Return when the first program will repeat its command."""
    sent = []
    bench.rig.world.tap_frames(
        lambda _bus, time_ns, sender, frame: sent.append(time_ns) if sender == "host" else None
    )
    rest_for(bench, 2.0 * PERIOD_S)
    return sent[-1] + round(2.0 * PERIOD_S * 1e9)


@KINDS
@pytest.mark.parametrize("before_ms", [0.1, 0.2, 0.3, 1.0, 2.0])
def test_former_owner_leaves_motor_to_the_next(kind, before_ms):
    with opener(kind)() as bench:
        _, other = two_programs(bench)
        time_ns = next_repetition_ns(bench) - round(before_ms * 1e6)
        rest_for(bench, (time_ns - bench.runtime.now_ns()) / 1e9)
        turn(other, 0.5)
        finish(bench, other)
        before = bench.true_position(other)
        rest_for(bench, 1.0)
        assert bench.true_position(other) - before == pytest.approx(0.5, abs=0.02)


@KINDS
def test_reserved_motor_stays_held(kind):
    with opener(kind)() as bench:
        motor, other = two_programs(bench)
        with other.reserve("survey"):
            rest_for(bench, 0.5)
            before = bench.true_position(motor)
            bench.load(motor, 1.0)
            rest_for(bench, 0.5)
            assert other.state() is MotorState.ENABLED
        assert abs(bench.true_position(motor) - before) < 0.05  # 1 N m over 50 N m/rad


def test_stop_of_another_programs_motor_holds_until_its_command():
    with opener("mit")() as bench:
        motor, other = two_programs(bench)
        with other.reserve("survey"):
            turn(other, 1.0)
            rest_for(bench, 0.5)
            motor.stop()
            finish(bench, motor)
            before = bench.true_position(motor)
            bench.load(motor, 1.0)
            rest_for(bench, 0.5)
            assert abs(bench.true_position(motor) - before) < 0.05
            bench.load(motor, 0.0)
        turn(other, 0.5)
        finish(bench, other)
        before = bench.true_position(other)
        rest_for(bench, 1.0)
        assert bench.true_position(other) - before == pytest.approx(0.5, abs=0.02)
