"""Properties of an ideal motor under any sequence of commands.

Position is the integral of velocity, no limit is exceeded, and a finished motion is at its goal.
"""

from contextlib import contextmanager

from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    MotorModel,
    TrapezoidalTrajectory,
    UsageError,
)
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.functions import Polynomial

VELOCITY_MAX, UP, DOWN = 2.0, 4.0, 8.0
MODEL = MotorModel(
    name="m", velocity_max=VELOCITY_MAX, acceleration_max=UP, deceleration_max=DOWN, torque_max=3.0
)
SHAPE = Polynomial((0.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)
STEP_S = 1e-3

VALUES = st.floats(-2.0, 2.0)
LIMITS = st.none() | st.floats(0.1, 2.0).map(lambda x: DerivativeLimits(first=x))
DURATIONS = st.floats(0.5, 3.0)
COMMANDS = st.one_of(
    st.tuples(st.just("aim"), st.sampled_from(ControlVariable), VALUES, LIMITS),
    st.tuples(st.just("trapezoid"), st.sampled_from(ControlVariable), VALUES, DURATIONS),
    st.tuples(st.just("complex"), st.sampled_from(ControlVariable), VALUES, DURATIONS),
    st.tuples(st.sampled_from(("stop", "quick_stop", "disable", "home"))),
)
STEPS = st.lists(st.tuples(COMMANDS, st.floats(0.0, 1.5)), min_size=1, max_size=6)


@contextmanager
def one_motor():
    runtime = VirtualRuntime(EventQueue())
    hardware = IdealHwMotor(runtime, "axis")
    try:
        yield IdealMotor(hardware, MODEL, name="m")
    finally:
        hardware.close()
        runtime.close()


def tell(motor, word, *rest):
    """Start the command; return whether it was allowed."""
    try:
        if word in ("stop", "quick_stop", "disable", "home"):
            getattr(motor, word)()
            return True
        variable, value, extra = rest
        if word == "aim":
            motor.set_control_mode(ControlMode.SETPOINT, variable)
            motor.set_setpoint(value, limits=extra)
        else:
            motor.set_control_mode(ControlMode.TRAJECTORY, variable)
            trajectory = TrapezoidalTrajectory(value, duration_s=extra)
            if word == "complex":
                trajectory = ComplexTrajectory(SHAPE.scaled(extra) * value, relative=True)
            motor.set_trajectory(trajectory)
        if motor.state().value == "stopped":
            motor.enable()
        motor.start()
    except UsageError:
        return False
    return True


V = ControlVariable.VELOCITY
FASTER = (
    (("aim", V, 1.0, None), 0.5),
    (("complex", V, 0.5, 1.0), 1.5),
    (("aim", V, -0.5, None), 0.1),
    (("aim", V, 0.5, None), 0.5),
)


@given(STEPS)
@example(FASTER)
@example(((("aim", ControlVariable.POSITION, 0.5e-9, None), 0.0),))
def test_position_is_the_integral_of_velocity(steps):
    with one_motor() as motor:
        runtime = motor.runtime
        for command, pause_s in steps:
            place = motor.position()
            allowed = tell(motor, *command)
            event(f"{command[0]}: {'done' if allowed else 'refused'}")
            before = motor.latest()
            if command[0] != "home":  # defines the present position as 0
                # A motion shorter than half a nanosecond is over at once.
                assert abs(before.position - place) <= 0.5e-9 * VELOCITY_MAX
            steps_left = int(pause_s / STEP_S)
            for _ in range(steps_left):
                runtime.run_for(STEP_S)
                now = motor.latest()
                assert abs(now.velocity) <= VELOCITY_MAX + 1e-9
                # Velocity may step, up to its limit, where a position set-point begins or ends.
                low, high = sorted((before.velocity, now.velocity))
                made = now.position - before.position
                slack = 0.5 * DOWN * STEP_S**2 + 1e-12
                assert low * STEP_S - slack <= made <= high * STEP_S + slack
                before = now


@given(COMMANDS, st.floats(0.0, 2.0))
def test_stop_takes_the_time_of_its_deceleration(command, after_s):
    with one_motor() as motor:
        if not tell(motor, *command) or motor.state().value != "enabled":
            event("nothing to stop")
            return
        runtime = motor.runtime
        runtime.run_for(after_s)
        before = motor.latest()
        motor.quick_stop()
        asked_ns = runtime.now_ns()
        motor.wait_until_done(10.0)
        event("moved" if before.velocity else "at rest")
        # From v at d: v/d, over v^2 / 2d; the end is exact to the nanosecond.
        took_s, size = (runtime.now_ns() - asked_ns) / 1e9, abs(before.velocity)
        assert abs(took_s - size / DOWN) <= 1e-9
        way = abs(motor.position() - before.position)
        assert abs(way - size**2 / (2.0 * DOWN)) <= 1e-9 * VELOCITY_MAX
        assert (motor.velocity(), motor.torque()) == (0.0, 0.0)


@given(COMMANDS.filter(lambda command: len(command) > 1))
def test_finished_motion_has_reached_its_goal(command):
    word, variable, value, _ = command
    with one_motor() as motor:
        if not tell(motor, *command):
            event("refused")
            return
        event(f"{word} of {variable.value}")
        motor.wait_until_done(1e3)
        reading = motor.latest()
        reached = {
            ControlVariable.POSITION: reading.position,
            ControlVariable.VELOCITY: reading.velocity,
            ControlVariable.TORQUE: reading.torque,
            ControlVariable.CURRENT: reading.torque,  # the torque constant is 1
        }[variable]
        assert abs(reached - value) <= 1e-12
