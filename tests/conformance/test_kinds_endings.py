"""End of motion and progress on every kind of hardware.

`tests.support.motors.kinds` lists the guarantees of each kind.
"""

import gc
from pathlib import Path

import pytest

from motorhil.motorapi import ControlMode, MotionInterrupted, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.canopen.bus import CanopenBus
from motorhil.motorapi.api.line_exchanges import ExchangeLine
from motorhil.motorapi.outcome import Ending
from tests.support import kit_benches
from tests.support.motors.kinds import KINDS, opened, true_position

DURATION_S = 1.0


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture
def rig(kind):
    with opened(kind, Path(f"{kind.name}.toml")) as rig:
        yield rig


@pytest.fixture
def moving(rig):
    """Return a motor on its way from 0 to 1 rad in `DURATION_S`."""
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=DURATION_S))
    motor.start()
    return motor


def test_end_is_reported_in_the_event_that_ends_the_wait(rig, kind, moving):
    told = []
    moving.on_done(lambda outcome: told.append((rig.runtime.now_ns(), outcome)))
    waited = []
    party = rig.runtime.spawn(
        "waiter", lambda: (moving.wait_until_done(timeout_s=5), waited.append(rig.runtime.now_ns()))
    )
    assert party.join(10.0)
    rig.runtime.run_for(0.1)
    ((told_ns, outcome),) = told
    assert outcome.ending is Ending.DONE
    assert outcome.time_ns == told_ns
    # A waiter for an ideal motor knows the end in advance; a callback learns of it every
    # millisecond.
    assert 0 <= told_ns - waited[0] <= (1_000_000 if kind.name == "ideal" else 0)
    assert abs(true_position(rig, "left") - 1.0) <= kind.window


def test_end_is_reported_without_a_waiter(rig, moving):
    told = []
    moving.on_done(told.append)
    rig.runtime.run_for(DURATION_S + 0.5)
    assert [outcome.ending for outcome in told] == [Ending.DONE]
    assert moving.is_done()


def test_stop_is_reported_before_it_returns(rig, moving):
    told = []
    moving.on_done(told.append)
    rig.runtime.run_for(0.3)
    now_ns = rig.runtime.now_ns()
    moving.stop()
    assert [(outcome.ending, outcome.time_ns) for outcome in told] == [(Ending.INTERRUPTED, now_ns)]
    assert isinstance(told[0].error, MotionInterrupted)
    moving.wait_until_done(timeout_s=5)


def test_progress_runs_from_zero_to_none(rig, kind, moving):
    seen = []
    timer = rig.runtime.every(0.05, lambda: seen.append(moving.progress()))
    moving.wait_until_done(timeout_s=5)
    timer.cancel()
    assert moving.progress() is None
    going = [progress for progress in seen if progress is not None]
    assert len(going) >= 18
    fractions = [progress.fraction for progress in going]
    assert fractions == sorted(fractions)
    assert fractions[0] < 0.1
    assert fractions[-1] > 0.9
    for progress in going:
        assert progress.target == 1.0
        assert progress.expected_s == pytest.approx(DURATION_S)  # steps of a drive are coarser
        assert progress.elapsed_s + progress.remaining_s == pytest.approx(
            max(progress.elapsed_s, DURATION_S)
        )


@pytest.mark.parametrize("name", kit_benches.KINDS)
def test_last_motor_that_is_closed_leaves_its_bus(name):
    with kit_benches.opener(name)() as bench:
        for motor in bench.motors:
            motor.position()
        things = gc.get_objects()
        lines = [one for one in things if isinstance(one, ExchangeLine)]
        buses = [one for one in things if isinstance(one, CanopenBus)]
        used = [one for one in lines if one.runtime is bench.runtime]
        used += [one for one in buses if one.link.runtime is bench.runtime]
        assert all(one.users for one in used)
        for motor in bench.motors:
            motor.close()
        assert [one.users for one in used] == [0] * len(used)
