"""L0: what errors and models say: facts in attributes and in words, files with line and key."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from math import inf, isclose, tau
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from motorhil.harness.conformance.bench import RigProtocol
from motorhil.harness.conformance.clause import Level, clause, expect
from motorhil.harness.conformance.clauses.helpers import expect_raises
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DerivativeLimits,
    DeviceFault,
    DomainError,
    Fault,
    FileError,
    LimitError,
    LinkError,
    Measurement,
    Motion,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    MotorModel,
    MotorPosition,
    MotorState,
    PluginError,
    Setpoint,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotionKind
from motorhil.motorapi.outcome import Ending, Outcome, Progress

_NS: Final = 1_250_000_000
_SINCE: Final = "1.250000 s"
_TOO_MUCH: Final = 16_000_001  # characters of a model file

_ERRORS: Final[tuple[tuple[type[MotorError], dict[str, Any], str], ...]] = (
    (
        LimitError,
        {
            "motor": "m",
            "quantity": "velocity",
            "value": 3.0,
            "low": -2.0,
            "high": 2.5,
            "unit": "rad/s",
        },
        "m: velocity 3 rad/s, allowed is -2 to 2.5 rad/s",
    ),
    (
        LimitError,
        {
            "motor": "m",
            "quantity": "way",
            "value": 3.0,
            "low": 4.0,
            "high": None,
            "unit": "m",
            "reason": "why",
        },
        "m: way 3 m, allowed is at least 4 m (why)",
    ),
    (
        LimitError,
        {"motor": "m", "quantity": "way", "value": 3.0, "low": None, "high": 2.0, "unit": "m"},
        "m: way 3 m, allowed is at most 2 m",
    ),
    (
        DomainError,
        {"argument": 3.0, "low": 0.0, "high": inf, "function": "a sine"},
        "the argument 3.0 lies outside the domain, 0.0 to inf, of a sine",
    ),
    (
        StateError,
        {"motor": "m", "operation": "start", "state": "it is off", "remedy": "enable it"},
        "m: start refused, it is off; enable it",
    ),
    (UnsupportedError, {"motor": "m", "feature": "torque"}, "m does not support torque"),
    (
        UnsupportedError,
        {"motor": "m", "feature": "torque", "supported": "velocity"},
        "m does not support torque; it supports velocity",
    ),
    (
        FileError,
        {"path": "a.toml", "line": 3, "key": "kind", "problem": "is odd", "remedy": "correct it"},
        "a.toml:3: kind: is odd; correct it",
    ),
    (
        FileError,
        {"path": "a.toml", "line": None, "key": None, "problem": "is odd", "remedy": "correct it"},
        "a.toml: is odd; correct it",
    ),
    (
        MotorBusyError,
        {"motor": "m", "holder": "a", "since_ns": _NS},
        f"m is held by a since {_SINCE}",
    ),
    (
        MotorBusyError,
        dict(
            **{
                "motor": "m",
                "holder": "a",
                "since_ns": _NS,
                "purpose": "lunch",
                "process": (7, "prog"),
            },
            **{"since": "noon", "taken_over": "on demand", "remedy": "wait"},
        ),
        "m was taken over (on demand) by a for lunch since noon; wait",
    ),
    (
        MotionInterrupted,
        {"motor": "m", "by": "stop() of b", "at_ns": _NS},
        f"m: the motion was ended by stop() of b at {_SINCE}",
    ),
    (
        DeviceFault,
        {"motor": "m", "code": 0x2310, "text": "overcurrent", "since_ns": _NS},
        f"m: fault 2310h (overcurrent) since {_SINCE}; remove the cause, then reset_fault()",
    ),
    (LinkError, {"link": "can0", "reason": "bus off"}, "can0: bus off"),
    (
        LinkError,
        {"link": "can0", "reason": "bus off", "since_ns": _NS, "remedy": "wait"},
        f"can0: bus off since {_SINCE}; wait",
    ),
    (
        DeadlineExceeded,
        {"awaited": "rest of m", "timeout_s": 0.5, "last_heard": "1 rad/s"},
        "rest of m: did not happen within 0.5 s; last heard: 1 rad/s",
    ),
    (PluginError, {"plugin": "P", "where": "_arm", "problem": "returned 1"}, "P: _arm: returned 1"),
)


@clause("ERR-01", Level.L0, source="errors: attributes carry the facts; messages carry them, too")
def errors_carry_their_facts(_: RigProtocol) -> None:
    """Each error has its facts in its attributes and its message, also after pickling."""
    for kind, facts, text in _ERRORS:
        made = kind(**facts)
        for error in (made, pickle.loads(pickle.dumps(made))):
            told = {name: getattr(error, name) for name in facts}
            expect(told == facts, f"{kind.__name__} has {told}; expected {facts}")
            expect(str(error) == text, f"{kind.__name__}: {str(error)!r}; expected {text!r}")
    busy = MotorBusyError(motor="m", holder="a", since_ns=_NS, process=(7, "prog"))
    expect((busy.pid, busy.program, busy.since) == (7, "prog", _SINCE), f"{busy!r}: its process")
    lone = MotorBusyError(motor="m", holder="a", since_ns=_NS)
    expect((lone.pid, lone.program) == (None, ""), f"{lone!r}: a process that nobody named")


_TEXT: Final = """\
name = "wheel"
kind = "linear"
velocity_max_m_s = 2.0
acceleration_max_m_s2 = 4.0
deceleration_max_m_s2 = 3.0
jerk_max_m_s3 = 50.0
force_max_n = 12.0
current_max_a = 5.0
position_min_m = -1.5
position_max_m = 2.5
position_tolerance_m = 0.002
motor_turns_per_m = -100.0
encoder_increments_rev = 2000
velocity_unit_m_s = 0.001
acceleration_unit_m_s2 = 0.01
requires_referencing = true
"""
_MODEL: Final = MotorModel(
    name="wheel",
    kind=MotionKind.LINEAR,
    velocity_max=2.0,
    acceleration_max=4.0,
    deceleration_max=3.0,
    jerk_max=50.0,
    torque_max=12.0,
    current_max=5.0,
    position_min=-1.5,
    position_max=2.5,
    position_tolerance=0.002,
    gear_ratio=-100.0,
    encoder_increments_rev=2000.0,
    velocity_unit=0.001,
    acceleration_unit=0.01,
    requires_referencing=True,
)
_MISTAKES: Final[tuple[tuple[str, str, int | None, str | None, str], ...]] = (
    # (a line of the file, the line in its place, line and key of the error, a part of its text)
    ("velocity_max_m_s = 2.0", "velocity_max_m_s = -2.0", 3, "velocity_max_m_s", "-2"),
    ("velocity_max_m_s = 2.0\n", "", None, "velocity_max_m_s", "missing"),
    ("jerk_max_m_s3 = 50.0", "jerk_max_rad_s3 = 50.0", 6, "jerk_max_rad_s3", ""),
    ("motor_turns_per_m = -100.0", "motor_turns_per_m = 0", 12, "motor_turns_per_m", "0"),
    ("position_min_m = -1.5", "position_min_m = 2.5", 9, "position_min_m", "2.5"),
    ("name", "increments_per_m = 200000.0\nname", 1, "increments_per_m", "-200000"),
    ("current_max_a = 5.0", "current_max_a = [\n1]", 9, "current_max_a", ""),
    ("current_max_a = 5.0", "current_max_a = = 5", 8, None, "not TOML"),
    ("requires_referencing = true", "requires_referencing = 1", 16, "requires_referencing", ""),
    ("kind", "\ud800", None, None, "UTF-8"),
    ("kind", "x = " + "[" * 9000 + "\n", None, None, "nested"),
)


@clause("MODEL-01", Level.L0, source="paper 3.2, the motor model; MotorModel.load, FileError")
def model_file_is_read_as_written(bench: RigProtocol) -> None:
    """A model file is read and saved as written; its mistakes are named by line, key and value."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "axle.toml")

        def load(text: str) -> MotorModel:
            path.write_bytes(text.encode(errors="surrogatepass"))
            return MotorModel.load(path)

        for text, model in ((_TEXT, _MODEL), (f"\ufeff{_TEXT}", _MODEL)):
            found = load(text)
            expect(found == model, f"the file has {model!r}; read was {found!r}")
        for model in (_MODEL, bench.motor.model, replace(bench.motor.model, name='a "b" \\ é')):
            model.save(path)
            expect(MotorModel.load(path) == model, f"{model!r} was saved and read as another one")
        named = load("velocity_max_rad_s = 1\nacceleration_max_rad_s2 = 2")
        expect(named.name == "axle", f"a model of the file axle.toml has the name {named.name}")
        for line, instead, wanted_line, key, part in _MISTAKES:
            error = _file_error(partial(load, _TEXT.replace(line, instead, 1)))
            what = f"{instead!r} in the place of {line!r}"
            expect(error.path == str(path), f"{what}: the error names {error.path}")
            expect(
                (error.line, error.key) == (wanted_line, key) and part in str(error),
                f"{what}: {error}; expected line {wanted_line}, key {key}, and {part!r}",
            )
            expect(bool(error.remedy), f"{what}: no remedy")
        for missing in (
            partial(load, _TEXT + "#" * (_TOO_MUCH - len(_TEXT))),
            partial(MotorModel.load, Path(folder, "absent.toml")),
            partial(MotorModel.load, folder),
        ):
            error = _file_error(missing)
            expect(bool(error.path), f"{error}; expected a refusal of the file")
            expect(error.line is None and error.key is None, f"{error}: a line")


def _file_error(operation: Callable[[], object]) -> FileError:
    try:
        operation()
    except FileError as error:
        return error
    return FileError(path="", line=None, key=None, problem="no error was raised", remedy="")


@clause("MODEL-02", Level.L0, source="paper 3.2: limits and units of the model, the same for all")
def model_has_its_units(_: RigProtocol) -> None:
    """Units, resolution, tolerance and default deceleration of a model are those of its kind."""
    for kind, unit, force, turn, tolerance in (
        (MotionKind.ROTARY, "rad", "N·m", tau, 0.01),
        (MotionKind.LINEAR, "m", "N", 1.0, 0.0001),
    ):
        plain = MotorModel(kind=kind, velocity_max=2.0, acceleration_max=4.0)
        word: Any = kind.value
        expect(replace(plain, kind=word).unit == unit, f"of the kind {word!r}, another unit")
        made = replace(plain, gear_ratio=-5.0, encoder_increments_rev=400.0)
        what = f"{kind.value}: {made!r}"
        units = [made.unit_of(one) for one in ControlVariable]
        expect(units == [unit, f"{unit}/s", force, "A"], f"{what}: units {units}")
        expect(
            isclose(made.increments_per_unit or 0.0, -2000.0 / turn),
            f"{what}: {made.increments_per_unit}",
        )
        expect(
            isclose(made.resolution or 0.0, turn / 2000.0), f"{what}: resolution {made.resolution}"
        )
        expect(plain.resolution is None, f"{what}: resolution {plain.resolution}")
        expect(plain.deceleration == 4.0, f"{what}: deceleration {plain.deceleration}")
        expect(replace(plain, deceleration_max=3.0).deceleration == 3.0, what)
        expect(plain.start_tolerance == tolerance, f"{what}: {plain.start_tolerance}")
        expect(replace(plain, position_tolerance=0.5).start_tolerance == 0.5, what)
        expect(
            repr(replace(plain, name="n", jerk_max=9.0))
            == "MotorModel(name='n', "
            + ("" if kind is MotionKind.ROTARY else "kind=MotionKind.LINEAR, ")
            + "velocity_max=2.0, acceleration_max=4.0, jerk_max=9.0)",
            f"shown as {replace(plain, name='n', jerk_max=9.0)!r}",
        )
        near = 2000.0 / turn * (1.0 + 0.9e-6)
        replace(plain, gear_ratio=5.0, encoder_increments_rev=400.0, increments_per_unit=near)
        for wrong in _wrong_models(turn):
            expect_raises(UsageError, partial(replace, plain, **wrong), f"{wrong} was accepted")


def _wrong_models(turn: float) -> Sequence[dict[str, Any]]:
    numbers = [one.name for one in fields(MotorModel)][2:-1]
    far = 2000.0 / turn * (1.0 + 1.1e-6)
    return (
        *({name: value} for name in numbers for value in (inf, "1")),
        *({name: 0.0} for name in numbers if not name.startswith("position_m")),
        *({"position_min": 1.0, "position_max": one} for one in (1.0, 0.5)),
        {"gear_ratio": 5.0, "encoder_increments_rev": 400.0, "increments_per_unit": far},
        *({"name": one} for one in (1, "a\nb")),
        *({"velocity_max": None}, {"requires_referencing": 1}),
    )


_NAN: Final = float("nan")
_PAIR: Final = DerivativeLimits(value=(-1.0, 2.0), first=3, second=(-4.0, 5.0), third=6.0)
_WHOLE: Final = TrapezoidalTrajectory(
    *(2.0, -1.0),
    limits=_PAIR,
    duration_s=4,
    initial_derivatives=(3.0, -4.0),
    initial_argument=1,
)
_LIMITS: Final[tuple[dict[str, Any], ...]] = (
    *({"value": one} for one in (1.0, (1.0,), (2.0, 1.0), (1.0, _NAN), ("0", 1.0), [0.0, 1.0])),
    {"value": (0.0, 1.0, 2.0)},
    *(
        {name: one}
        for name in ("first", "second", "third")
        for one in (0.0, -1.0, _NAN, "1", (0.0, 1.0), (-1.0, 0.0), (1.0, 2.0), (-1.0,), (-1, "1"))
    ),
)
_TRAJECTORIES: Final[tuple[dict[str, Any], ...]] = (
    *({name: one} for name in ("final", "initial", "duration_s") for one in (inf, _NAN, "1")),
    *({"duration_s": 0.0}, {"duration_s": -1.0}, {"initial_argument": _NAN}),
    *({"limits": 1.0}, {"initial": -1.5, "limits": _PAIR}, {"final": 2.5, "initial": 0.0}),
    *({"final": 0.5, "final_derivatives": one} for one in ((3.5,), (-3.5,), (0.0, 5.5))),
    *({"final": 0.5, "initial_derivatives": one} for one in ((3.5,), (0.0, -4.5))),
    *({"final_derivatives": one} for one in ((1.0, 1.0, 0.0), ("1",), (_NAN,), 1.0)),
)
_SHOWN: Final[tuple[tuple[object, str], ...]] = (
    (
        DerivativeLimits(value=(-1.0, 2.0), first=3),
        "DerivativeLimits(value=(-1.0, 2.0), first=(-3.0, 3.0))",
    ),
    (
        _WHOLE,
        "<TrapezoidalTrajectory from -1.0 to 2.0, in 4.0 s, initial first derivative 3.0, initial"
        " second derivative -4.0, beginning at 1.0 s, value -1.0 to 2.0, first derivative at most"
        " 3.0, second derivative -4.0 to 5.0, third derivative at most 6.0>",
    ),
    (TrapezoidalTrajectory(2.0), "<TrapezoidalTrajectory by 2.0, as fast as allowed>"),
    (Setpoint(1.0), "Setpoint(value=1.0)"),
    (
        Motion(ControlMode.TRAJECTORY, ControlVariable.POSITION, 0.0, 1.0, 2.0, 4.0, 3.0),
        "<Motion trajectory of position: 0 to 1, velocity up to 2, acceleration 4, deceleration 3>",
    ),
    (
        Motion(ControlMode.SETPOINT, ControlVariable.VELOCITY, 0.0, -1.0, 1.0, 4.0, 3.0),
        "<Motion setpoint of velocity: 0 to -1, acceleration 4, deceleration 3>",
    ),
    (
        Motion(ControlMode.SETPOINT, ControlVariable.TORQUE, 0.5, 1.0, 1.0, 1.0, 1.0, slope=2.0),
        "<Motion setpoint of torque: 0.5 to 1, 2 per s>",
    ),
    (Setpoint(1.0, True), "Setpoint(value=1.0, relative=True)"),
)
_TOLD: Final[tuple[tuple[object, str], ...]] = (
    (
        Motion(
            *(ControlMode.TRAJECTORY, ControlVariable.TORQUE, 0.0, 1.0, 1.0, 1.0, 1.0),
            duration_s=2.5,
        ),
        "<Motion trajectory of torque: 0 to 1 in 2.5 s>",
    ),
    (Fault(0x2310, "overcurrent", _NS), f"<Fault 2310h (overcurrent) since {_SINCE}>"),
    (
        Outcome("m", "start() of m", Ending.DONE, _NS),
        f"<Outcome of start() of m: done at {_SINCE}>",
    ),
    (
        Outcome("m", "start() of m", Ending.FAILED, _NS, LinkError(link="can0", reason="bus off")),
        f"<Outcome of start() of m: failed at {_SINCE}: can0: bus off>",
    ),
    (
        Measurement(_NS, MotorState.ENABLED, 1.5, torque=0.5),
        f"<Measurement at {_SINCE}: enabled, position 1.5, torque 0.5>",
    ),
    (
        Progress("start() of m", 0.25, 1.0, 0.75, 0.25, 0.5, 2.0),
        "<Progress of start() of m: 0.250 s of 1.000 s, 25.0%, at 0.5 on the way to 2>",
    ),
    (
        Progress("home() of m", 0.25, None, None, None, 0.5, None),
        "<Progress of home() of m: 0.250 s>",
    ),
)


@clause("TEXT-01", Level.L0, source="Motor.fault, latest, progress, on_done: what they return")
def results_tell_their_facts(_: RigProtocol) -> None:
    """Motions, ends, faults, progress and measurements tell their facts in words, times in s."""
    for value, text in _TOLD:
        expect(repr(value) == text, f"shown as {value!r}; expected {text}")
    end = Outcome("m", "start() of m", Ending.DONE, _NS)
    expect(str(end) == f"start() of m: done at {_SINCE}", f"an outcome in words: {end}")


@clause("LIM-07", Level.L2, source="paper 3.3.1: derivative limits, boundary conditions")
def invalid_values_are_refused_at_once(_: RigProtocol) -> None:
    """Limits and trajectories with impossible numbers are refused when they are made."""
    ranges = (_PAIR.value, _PAIR.first, _PAIR.second, _PAIR.third)
    expect(ranges == ((-1.0, 2.0), (-3.0, 3.0), (-4.0, 5.0), (-6.0, 6.0)), f"limits {ranges}")
    DerivativeLimits(value=(1.0, 1.0), first=(-inf, inf))
    for values in _LIMITS:
        expect_raises(UsageError, partial(DerivativeLimits, **values), f"{values} was accepted")
    for values in _TRAJECTORIES:
        arguments: dict[str, Any] = {"final": 1.0, "limits": _PAIR, **values}
        made = partial(TrapezoidalTrajectory, **arguments)
        expect_raises(UsageError, made, f"a trajectory with {values} was accepted")
    untyped: Any = "left"
    expect_raises(UsageError, partial(MotorPosition, untyped), "the text left as a motor")
    bare = TrapezoidalTrajectory(3.5, limits=_PAIR, final_derivatives=(-3.0, 5.0))
    for one, wanted in ((_WHOLE, (False, 3.0, 0.0, 5.0)), (bare, (True, 0.0, -3.0, None))):
        found = (one.is_relative, one.initial_velocity, one.final_velocity, one.final_argument)
        expect(found == wanted, f"{one!r}: {found}; expected {wanted}")
    for value, text in _SHOWN:
        expect(repr(value) == text, f"shown as {value!r}; expected {text}")
