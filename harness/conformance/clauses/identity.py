"""L0: motors match their models; identity and state are right."""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_state,
    expect_unmoved,
    finish,
    follow,
    long_move,
    move,
    position_of,
    reached,
    rest_for,
    shortest_s,
    torque_of,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import Motor, MotorState, PluginError, TrapezoidalTrajectory

_HOLDS = 0.3  # of the largest torque
_ODD: Final = "an odd number"
_STOP: Final = "_stop"


@clause(
    "UNIT-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.2, the motor model; 3.1, the adaptation maps logical to physical operations",
)
def motor_moves_commanded_distance(bench: RigProtocol) -> None:
    """Each motor moves, and reports, the commanded distance in its model's units and direction."""
    for motor in bench.motors:
        for share in (0.25, -0.4):
            _move_and_compare(bench, motor, share * long_move(bench))


def _move_and_compare(bench: RigProtocol, motor: Motor, way: float) -> None:
    before, reported = bench.true_position(motor), motor.position()
    move(bench, motor, way)
    unit, window = motor.model.unit, bench.facts.window
    for what, moved in (
        ("moved", bench.true_position(motor) - before),
        ("reported", motor.position() - reported),
    ):
        expect(
            abs(moved - way) <= window,
            f"{motor.name}: commanded {way:g} {unit}, {what} {moved:g} {unit};"
            f" window {window:g} {unit}",
        )


@clause(
    "ID-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.SECOND_MOTOR},
    source="paper 3.5, no more than one physical motor object for any motor in the system",
)
def only_commanded_motor_moves(bench: RigProtocol) -> None:
    """Only the commanded motor moves."""
    way = 0.25 * long_move(bench)
    for motor in bench.motors:
        before = [bench.true_position(one) for one in bench.motors]
        move(bench, motor, way)
        for one, was in zip(bench.motors, before, strict=True):
            if one is motor:
                moved = abs(bench.true_position(one) - was)
                reached(moved > 0.5 * abs(way), f"a move of {motor.name}")
            else:
                expect_unmoved(bench, one, was, f"{one.name}, during a move of {motor.name}")


@clause(
    "ID-02",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    source="requirement 1; Motor.latest: nothing is sent, so callbacks may call it",
)
def latest_state_is_returned_at_once(bench: RigProtocol) -> None:
    """Name, text and last known state are returned at once, also in callbacks, and agree."""
    names = [motor.name for motor in bench.motors]
    expect(len(set(names)) == len(names), f"two motors have one name: {', '.join(names)}")
    motor = bench.motor
    expect(motor.name in repr(motor), f"repr() is {motor!r}; expected the name {motor.name} in it")
    seen = []
    timer = bench.runtime.every(0.02, lambda: seen.append((motor.latest(), repr(motor))))
    way = 0.25 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    _expect_record_shown(bench, motor)
    finish(bench, motor, shortest_s(motor, way))
    shown = repr(motor.logical.physical)
    expect(": at rest>" in shown, f"a motor at rest: its record is shown as {shown}")
    timer.cancel()
    reached(len(seen) > 3, "a call of latest() during the motion")
    position, before_ns = motor.position(), bench.runtime.now_ns()
    latest = motor.latest()
    took_s = elapsed_s(bench, before_ns)
    most_s = bench.facts.time_tolerance_s  # a wall clock advances by itself
    expect(took_s <= most_s, f"latest() took {took_s:g} s; limit {most_s:g} s")
    if latest is None:
        return
    expect(latest.time_ns <= before_ns, "latest() has a time in the future")
    expect_state(motor, latest.state, "compared with latest()")
    expect(
        latest.position is None or abs(latest.position - position) <= bench.facts.window,
        f"latest() has position {latest.position}, position() is {position:g} {motor.model.unit}",
    )
    error = latest.following_error
    expect(
        error is None or abs(error) <= bench.facts.window,
        f"latest() has following error {error} at rest at the target; the window is"
        f" {bench.facts.window:g} {motor.model.unit}",
    )


def _expect_record_shown(bench: RigProtocol, motor: Motor) -> None:
    """Expect the texts of the physical motor and its motion to tell what is going on, since when.

    Authors of adaptations meet them: `register_physical_motor` returns the record.
    """
    physical = motor.logical.physical
    shown = repr(physical)
    expect(
        f"start() of {motor.name}>" in shown,
        f"in motion, the record of {motor.name} is shown as {shown}; expected its start()",
    )
    since_s = (bench.runtime.now_ns() if physical.run is None else physical.run.since_ns) / 1e9
    shown = repr(physical.run)
    expect(
        f" since {since_s:.6f} s: not known to have ended>" in shown,
        f"begun at {since_s:.6f} s, and going on; shown as {shown}",
    )


@clause(
    "STATE-01",
    Level.L0,
    source="paper 3.1, the base class; CiA 402-2, PDS FSA",
)
def enable_and_disable_set_state(bench: RigProtocol) -> None:
    """After enable() the motor is enabled, and after disable() disabled, also when repeated."""
    motor = bench.motor
    before = motor.state()
    expect(before is not MotorState.ENABLED, "state is enabled before the first enable()")
    for _ in range(2):
        motor.enable()
        expect_state(motor, MotorState.ENABLED, "after enable()")
    for _ in range(2):
        motor.disable()
        expect_state(motor, MotorState.DISABLED, "after disable()")


@clause(
    "STATE-02",
    Level.L0,
    bench={Ability.TRUTH, Ability.LOAD},
    source="Motor.enable: the power stage is on and the motor holds its position; Motor.disable",
)
def enabled_holds_load_and_disabled_gives_way(bench: RigProtocol) -> None:
    """When enabled, the motor holds its position against a load; when disabled, it gives way."""
    motor = bench.motor
    before = position_of(bench, motor)
    motor.enable()
    rest_for(bench, 0.2)
    expect_unmoved(bench, motor, before, "when enabled")
    bench.load(motor, torque_of(motor, _HOLDS))
    rest_for(bench, 1.0)
    expect_unmoved(bench, motor, before, f"enabled, with a load of {_HOLDS:.0%} of its torque")
    motor.disable()
    rest_for(bench, 0.5)
    moved = abs(position_of(bench, motor) - before)
    expect(
        moved > 10.0 * bench.facts.window,
        f"disabled, the motor still holds {_HOLDS:.0%} of its torque: the power stage is on",
    )


@clause("ID-03", Level.L0, source="motorapi.motor: an adaptation implements hooks, public is final")
def public_methods_are_final(bench: RigProtocol) -> None:
    """An adaptation that replaces a public method is refused; hooks, and more methods, are not."""
    for name in ("start", "stop", "state", "position", "wait_until_done", "reserve"):
        try:
            type("Mistaken", (Motor,), {name: None})
        except PluginError as error:
            expect((error.plugin, error.where) == ("Mistaken", name), f"refused with {error}")
        else:
            raise Violated(f"an adaptation has replaced {name}(), and was not refused")
    type("Correct", (Motor,), {"close": None, "_stop": None, "further": None})
    shown = repr(bench.motor)
    expect(
        bench.motor.name in shown and type(bench.motor).__name__ in shown,
        f"{bench.motor.name} is shown as {shown}",
    )


class _Failing:
    """A trigger whose author has forgotten that what it sends may fail."""

    def fire(self) -> None:
        raise ValueError(_ODD)


def _stop_wrongly(motor: Any) -> None:
    """Call the hook that stops this motor, in place of which another one fails."""
    setattr(motor, _STOP, _Failing().fire)
    try:
        motor.logical.hooks.stop()
    finally:
        delattr(motor, _STOP)


@clause("ERR-02", Level.L0, source="errors, PluginError: plugin, where, problem; its cause")
def error_of_hook_is_named(bench: RigProtocol) -> None:
    """If a hook or trigger raises an error of Python, the caller gets its class, place and text."""
    motor = bench.motor
    hooks: Any = motor.logical.hooks
    operations: tuple[tuple[str, str, Callable[[], object]], ...] = (
        ("fire", _ODD, partial(hooks.fire, _Failing())),
        (_STOP, _ODD, partial(_stop_wrongly, motor)),
    )
    for where, text, operation in operations:
        name = type(motor).__qualname__
        try:
            operation()
        except PluginError as error:
            told = f"{error}; expected {name}, {where}, {text!r}, and the error as its cause"
            expect((error.plugin, error.where) == (name, where) and text in error.problem, told)
            expect(isinstance(error.__cause__, ValueError | TypeError), told)
        else:
            raise Violated(f"{where} raised an error of Python, and the caller got none")
