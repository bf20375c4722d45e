"""Real threads: many logical motors of one physical motor, each with its own code.

The paper, 3.5: "the code written for single-threaded operation will operate correctly if the motor
resource is shared between multiple threads". To make it hard, threads switch every 20 us here.
"""

import sys
import threading
from contextlib import suppress

import pytest

from motorhil.motorapi import (
    ControlMode,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    TrapezoidalTrajectory,
    WallRuntime,
)
from motorhil.motorapi.outcome import Ending
from tests.support.motors.plain import PlainHwMotor, PlainMotor

THREADS = 8
LONG_S = 30.0
"""For a machine under load; without load, no step takes that long."""


class OneAtATime(PlainHwMotor):
    """A motor that detects two acting hooks at once, and accesses during low-level access.

    A stop may come while another hook runs, so data changed by both have a lock: the paper's "as
    long as the motor adaptation is implemented in a thread safe manner".
    """

    def __init__(self, runtime):
        self.lock = threading.RLock()
        super().__init__(runtime)
        self.inside = 0
        self.overlaps = 0
        self.held_by = None
        self.intrusions = []

    def act(self, name, *facts):
        self.check(name)
        self.inside += 1
        self.overlaps += self.inside > 1
        self.runtime.wait_until(lambda: False, 0.0003)  # gives other threads a chance
        self.overlaps += self.inside > 1
        self.inside -= 1

    def begin(self):
        with self.lock:
            super().begin()

    def freeze(self):
        with self.lock:
            super().freeze()

    def position(self):
        with self.lock:
            return super().position()

    def velocity(self):
        with self.lock:
            return super().velocity()

    def done(self):
        with self.lock:
            return super().done()

    def check(self, name):
        holder = self.held_by
        if holder is not None and holder != threading.get_ident():
            self.intrusions.append(name)


class Logical(PlainMotor):
    def _open_low_level(self):
        self.hw.held_by = threading.get_ident()
        return self.hw

    def _close_low_level(self):
        self.hw.held_by = None

    def _refresh(self):
        self.hw.check("_refresh")
        return super()._refresh()

    def _read_position(self):
        self.hw.check("_read_position")
        return super()._read_position()

    def _stop(self):
        self.hw.check("_stop")
        super()._stop()


@pytest.fixture
def runtime():
    before = sys.getswitchinterval()
    sys.setswitchinterval(20e-6)
    runtime = WallRuntime()
    yield runtime
    runtime.close()
    sys.setswitchinterval(before)


@pytest.fixture
def hw(runtime):
    return OneAtATime(runtime)


def run_in_threads(hw, work):
    """Run `work(motor)` in `THREADS` threads at once, with a logical motor each."""
    failures = []
    together = threading.Barrier(THREADS)

    def run(place):
        motor = Logical(hw, name=f"m{place}")
        together.wait()
        try:
            work(motor)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=run, args=(place,)) for place in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG_S)
        assert not thread.is_alive(), "it hangs"
    for error in failures:
        raise error


def start(motor, way):
    """Start in single-threaded code, except for the wait for other owners."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))
    while True:
        try:
            return motor.start()
        except MotorBusyError:
            motor.runtime.wait_until(lambda: False, 0.0005)


def test_motions_of_all_threads_end_at_their_own_targets(hw):
    rounds = 5
    ways = []

    def work(motor):
        for _ in range(rounds):
            start(motor, 0.0001)
            motor.wait_until_done(timeout_s=LONG_S)
            ways.append(0.0001)

    run_in_threads(hw, work)
    assert hw.overlaps == 0
    assert len(ways) == rounds * THREADS
    assert hw.position() == pytest.approx(sum(ways))  # sums of floats


def test_every_motion_has_one_outcome_with_concurrent_stops(hw):
    told = {}

    def work(motor):
        for turn in range(6):
            with suppress(MotorBusyError, MotionInterrupted):
                motor.set_control_mode(ControlMode.TRAJECTORY)
                motor.set_trajectory(TrapezoidalTrajectory(0.002))
                motor.start()
                outcomes = told.setdefault((motor.name, turn), [])
                motor.on_done(outcomes.append)
                motor.wait_until_done(timeout_s=LONG_S)
            if turn % 2:
                motor.stop()
                with suppress(MotionInterrupted):
                    motor.wait_until_done(timeout_s=LONG_S)

    run_in_threads(hw, work)
    assert hw.overlaps == 0
    assert told
    for outcomes in told.values():
        assert len(outcomes) == 1, told
        assert outcomes[0].ending in (Ending.DONE, Ending.INTERRUPTED)
    assert hw.physical.bell.listeners == []


def test_low_level_access_belongs_to_one_thread(hw):
    held = []

    def work(motor):
        for _ in range(4):
            with suppress(MotorBusyError, MotionInterrupted):
                motor.position()
                start(motor, 0.0001)
                motor.wait_until_done(timeout_s=LONG_S)
            with motor.low_level(timeout_s=LONG_S):
                assert hw.held_by == threading.get_ident()
                held.append(motor.name)
                motor.runtime.wait_until(lambda: False, 0.0005)
                assert hw.held_by == threading.get_ident()
                for refused in (motor.start, motor.stop, motor.enable):
                    with pytest.raises(MotorBusyError):
                        refused()
            with suppress(MotorBusyError):
                motor.stop()
            with suppress(MotorError):
                motor.wait_until_done(timeout_s=LONG_S)

    run_in_threads(hw, work)
    assert hw.overlaps == 0
    assert hw.intrusions == []
    assert len(held) == 4 * THREADS


def test_two_concurrent_acting_hooks_are_detected(hw, monkeypatch):
    """Check that the detection above works."""
    from contextlib import nullcontext

    for way in ("physical_motor.PhysicalMotor.transaction", "ownership.Ownership.owned"):
        monkeypatch.setattr(
            f"motorhil.motorapi.ownership.{way}", lambda *args, **kwargs: nullcontext()
        )

    def work(motor):
        for _ in range(10):
            with suppress(MotorError):
                motor.enable()
                motor.disable()

    run_in_threads(hw, work)
    assert hw.overlaps > 0
