"""L0: settings of a rig: loads, inputs, scales and drives fit the motor, or are refused.

U is the unit of the motor's position, rad or m.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_moved,
    expect_state,
    failure_of,
    finish,
    long_move,
    move_exactly,
    position_of,
    rest_for,
    shortest_s,
    speed,
    stated_settings,
    torque_of,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    DeadlineExceeded,
    DeviceFault,
    MotorModel,
    MotorState,
    UsageError,
)
from motorhil.motorapi.model import MotionKind
from motorhil.settings import shown

_LOAD, _POWER = "load_torque_n_m", "power"
_TOO_MUCH: Final = 1e12  # N·m
_RANGED: Final = ("supply_v",)
_SWITCHES: Final = ("negative_limit", "positive_limit", "home", "interlock")
"""Digital inputs, which follow their switches while they are released."""
_RELEASED: Final = -1.0
_NEITHER: Final = 1e9 + 0.5
_IN_UNITS: Final = ("temperature_c", "supply_v")
"""Ends of the names of inputs that have a limit on every drive."""
_LEGIBLE: Final = 1000  # characters of an error
_ALLOWED: Final = re.compile(r"expected (-?\d[-\d.e+, to]*)")
_BOOTED_S: Final = 0.5
_STIFFNESS: Final = "coupling_stiffness_n_m_rad"
_TOO_STIFF: Final = 1e9
_STIFFEST: Final = re.compile(r"at most (\S+) N m/rad")
_UNKNOWN: Final = "no_such_option"
_SCALE: Final = "increments_per_unit"
_SCALES: Final = (
    *(("gear_ratio", _SCALE), ("encoder_increments_rev", _SCALE)),  # which are made into a scale
    ("gear_ratio", "encoder_increments_rev", _SCALE),
    *(("velocity_unit",), ("acceleration_unit",)),
)
"""Facts of a model that a motor may need, each with what a model derives from it."""
_SPEED: Final = 0.5  # of the model's velocity
_DAMPING: Final = "kd_n_m_s_rad"
_DAMPING_SHARE: Final = 0.25
_LOADED: Final = 0.2  # of the largest torque
_SETTLED_S: Final = 0.5
_LEAST: Final = 0.7  # of the shortest time: done is told within the window


@clause(
    "OPT-07",
    Level.L0,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.SETTINGS, Ability.TRUTH, Ability.LOAD},
    source="settings of the motor: damping in N·m·s/rad, at the output",
)
def stated_damping_is_true(bench: RigProtocol) -> None:
    """At a velocity set-point, a load changes the velocity by itself over the stated damping."""
    stated, motor = stated_settings(bench), bench.motor
    name = stated.declaration.names(motor.model.unit).get(_DAMPING)
    if name is None:
        raise NotApplicable(f"the motor has no setting {_DAMPING}")
    damping: Any = stated.values.get(_DAMPING, stated.declaration.defaults.get(name))
    torque, found = torque_of(motor, _LOADED), []
    turn(motor, _SPEED * motor.model.velocity_max)
    for load in (-torque, torque):
        bench.load(motor, load)
        rest_for(bench, _SETTLED_S)
        found.append(speed(bench, motor, _SETTLED_S))
    bench.load(motor, 0.0)
    motor.stop()
    finish(bench, motor)
    true = 2.0 * torque / (found[0] - found[1])
    expect(
        abs(true - damping) <= _DAMPING_SHARE * damping,
        f"{_DAMPING} = {damping:g}: loads of {torque:g} N·m either way made velocities of"
        f" {found[0]:g} and {found[1]:g} rad/s, which is a damping of {true:g}",
    )


@clause(
    "MODEL-03",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SETTINGS, Ability.TRUTH},
    source="paper 3.2, the motor model; UsageError: the model does not suit the drive",
)
def model_without_scale_is_refused_or_right(bench: RigProtocol) -> None:
    """With a model that lacks a scale, a motor is refused by name, or moves as far as commanded."""
    values = stated_settings(bench).values
    built = bench.build(values)
    model = built.model
    bench.true_position(built)  # its scale is that of the whole model
    built.close()
    for names in _SCALES:
        known = [getattr(model, name) for name in names if getattr(model, name) is not None]
        if known and min(known) > 0.0:  # a negative one is the direction, too
            without: dict[str, Any] = dict.fromkeys(names)
            lacking = replace(model, name="incomplete", **without)
            what = f"a model without {', '.join(names)}"
            _expect_refused_or_right(bench, values, lacking, what)
    other = MotionKind.LINEAR if model.kind is MotionKind.ROTARY else MotionKind.ROTARY
    error = failure_of(lambda: bench.build(values, replace(model, kind=other)).close())
    expect(
        error is None or isinstance(error, UsageError),
        f"a model of the kind {other.value}: {type(error).__name__}: {error}; expected UsageError",
    )


def _expect_refused_or_right(
    bench: RigProtocol, values: Mapping[str, object], model: MotorModel, what: str
) -> None:
    """Expect a UsageError that names the model or its motor, or a true move."""
    try:
        motor = bench.build(values, model)
    except UsageError as error:
        names = model.name, f"{values.get('name', model.name)}"
        is_named = any(one in f"{error}" for one in names)
        expect(is_named, f"{what}: {error}; expected the name {' or '.join(names)}")
        return
    try:
        motor.enable()
        before, way = position_of(bench, motor), 0.1 * long_move(bench)
        begun_ns = bench.runtime.now_ns()
        move_exactly(bench, motor, way, what)
        took_s, least_s = elapsed_s(bench, begun_ns), _LEAST * shortest_s(motor, way)
        expect_moved(bench, motor, before, way, what)
        expect(took_s >= least_s, f"{what}: a move took {took_s:.3f} s; its limits need more")
    except UsageError as error:
        is_named = model.name in f"{error}" or motor.name in f"{error}"
        expect(is_named, f"{what}: {error}; expected the name {motor.name}")
    finally:
        motor.close()


@clause(
    "FIT-01",
    Level.L0,
    bench={Ability.SETTINGS},
    source="PeerError: the device is not as expected; [conformance] unfit",
)
def unfit_drive_is_refused(bench: RigProtocol) -> None:
    """A drive that the adaptation cannot control is refused before anything else, and not moved."""
    if not bench.facts.unfit:
        raise NotApplicable("the rig states no drive that does not fit ([conformance] unfit)")
    for number, settings in enumerate(bench.facts.unfit):
        words = "".join(bench.facts.unfit_texts[number : number + 1])
        with bench.altered({}, settings):
            motor = bench.motor
            told = ", ".join(f"{key} = {shown(value)}" for key, value in settings.items())
            for operation in (motor.position, motor.enable):
                error = failure_of(operation)
                expect(error is not None, f"a drive with {told} was accepted")
                expect(
                    not isinstance(error, DeviceFault | DeadlineExceeded),
                    f"a drive with {told}: {type(error).__name__}: {error}; expected its refusal",
                )
                expect(words in f"{error}", f"a drive with {told}: {error}; expected {words!r}")


@clause(
    "OPT-05",
    Level.L0,
    bench={Ability.SETTINGS},
    source="[[stimulus]] of a rig: a physical event at a controller; errors: value, limit, unit",
)
def impossible_inputs_are_refused_with_limits(bench: RigProtocol) -> None:
    """An emulated drive refuses physical inputs that cannot be; what it allows, it takes."""
    motor = bench.motor
    unknown = bench.refusal(motor, _UNKNOWN, 0.0)
    expect(_UNKNOWN in unknown, f"the physical input {_UNKNOWN} was taken, or refused: {unknown}")
    known = unknown.partition("known: ")[2].split(", ")
    for name, value in ((_LOAD, _TOO_MUCH), (_LOAD, -_TOO_MUCH), (_POWER, 2.0)):
        expect(name in known, f"no physical input {name}; the drive has {', '.join(known)}")
        text = bench.refusal(motor, name, value)
        is_told = name in text and any(one in text for one in (f"{value:g}", f"{value}"))
        expect(is_told, f"{name} = {value:g}: {text or 'taken'}; expected a refusal with the value")
    for name in (*_SWITCHES, *known):
        if name in (_LOAD, _POWER) or name not in known:
            continue
        if name in _SWITCHES:
            for value in (0.0, 1.0, _RELEASED):
                text = bench.refusal(motor, name, value)
                expect(not text, f"{name} = {value:g} (off, on or released): {text}")
        text = bench.refusal(motor, name, _NEITHER)
        size = f"{len(text)} characters; expected <= {_LEGIBLE}"
        expect(len(text) <= _LEGIBLE, f"{name} = {_NEITHER:g} is refused with {size}")
        if name.endswith(_IN_UNITS):
            values, told = (f"{_NEITHER:g}", f"{_NEITHER}"), text or "taken"
            is_told = name in text and any(one in text for one in values)
            expect(is_told, f"{name} = {_NEITHER}: {told}; expected a refusal with the value")
        found = _ALLOWED.search(text)
        if found is None or name in _RANGED:
            continue
        numbers = [float(one) for one in found[1].replace(" to ", ", ").split(", ")]
        for value in numbers:
            allowed = bench.refusal(motor, name, value)
            expect(not allowed, f"{name} = {value:g}: {allowed}; but {name} = {_NEITHER}: {text}")
    bench.afresh()
    motor = bench.motor
    motor.enable()
    expect_state(motor, MotorState.ENABLED, "switched off and on, after wrong inputs")


@clause(
    "OPT-06",
    Level.L0,
    bench={Ability.SETTINGS},
    source="the rig file: a mistake is named with its key; what is odd is in the record",
)
def odd_settings_of_a_drive_are_told(bench: RigProtocol) -> None:
    """An emulated drive refuses settings that cannot be, by their key, and tells what is odd."""
    stated = bench.stated(of_drive=True)
    if stated is None:
        raise NotApplicable("the controller declares no settings")
    keys, values = stated.declaration.keys, stated.values
    if "oscillator" in keys:
        _expect_told(bench, {"oscillator": {"ppm": -250.0}}, "250 ppm slow")
    plant: dict[str, object] = dict(values.get("plant", {}))  # type: ignore[call-overload]
    if {"objects", "switches"} <= set(keys):
        _expect_switches_told(bench, plant)
    if not {"objects", "quirks"} <= set(keys):
        return
    _expect_told(bench, {"quirks": {"statusword_bits": {"bits": 0x4000}}}, "bits = 0x4000")
    _expect_told(bench, {"quirks": {"late_boot_up": {"by_s": 0.125}}}, "by_s = 0.125")
    if "eds" not in values:  # its own one claims no other modes
        _expect_told(bench, {}, "not emulated", not_so=True)
    objects = dict(values.get("objects", {}))  # type: ignore[call-overload]
    _expect_told(bench, {"objects": {**objects, "1A00h:1": 0xFFFF_0008}}, "FFFF0008h")
    for key, wrong in (("6081h", "fast"), ("6081h", 1.5), ("6081h", -1)):
        _expect_not_built(bench, {"objects": {**objects, key: wrong}}, key)
    _expect_not_built(bench, {"eds": "no such file.eds"}, "no such file.eds")
    with TemporaryDirectory() as folder:
        broken = Path(folder, "broken.eds")
        broken.write_text("[DeviceInfo]\n\n[6040\n")
        _expect_not_built(bench, {"eds": str(broken)}, f"{broken}:3")
    _expect_stiffness(bench, plant)


def _expect_switches_told(bench: RigProtocol, plant: Mapping[str, object]) -> None:
    """Expect a switch beyond the end stops to be told, and one within them not."""
    stops = {**plant, "stop_low_rad": -2.0, "stop_high_rad": 2.0}
    switches = {"home_from_rad": 2.5, "home_to_rad": 3.0}
    stopped = {"plant": stops, "initial_position_rad": 0.0}
    text = _expect_told(bench, {**stopped, "switches": switches}, "home is beyond")
    expect(
        not text or "-2..2 rad" in text,
        f"the home switch is at {switches}, the ends at 2 rad: {text}",
    )
    switches = {"home_from_rad": 0.5, "home_to_rad": 1.0}
    _expect_told(bench, {**stopped, "switches": switches}, "home is beyond", not_so=True)


def _expect_told(
    bench: RigProtocol, drive: Mapping[str, object], text: str, *, not_so: bool = False
) -> str:
    """Expect a drive with these settings to tell this, or not; return what it tells."""
    try:
        with bench.altered({}, drive):
            rest_for(bench, _BOOTED_S)
            told = " | ".join(bench.told(bench.motor))
    except RigError:  # beside its other settings
        return ""
    is_so = (text in told) is not not_so
    expect(is_so, f"with {drive}: told is {told!r}; expected {'no ' if not_so else ''}{text!r}")
    return told


def _not_built(bench: RigProtocol, drive: Mapping[str, object]) -> str:
    """Return the error of a rig whose drive has these settings; "" if it is built."""
    try:
        with bench.altered({}, drive):
            return ""
    except RigError as error:
        return str(error)


def _expect_not_built(bench: RigProtocol, drive: Mapping[str, object], text: str) -> None:
    """Expect a rig whose drive has these settings to be refused with this text."""
    error = _not_built(bench, drive)
    expect(text in error, f"with {drive}: {error or 'built'}; expected a refusal with {text}")


def _expect_stiffness(bench: RigProtocol, plant: Mapping[str, object]) -> None:
    """Expect a coupling that is too stiff to be refused with the stiffest one, which is built."""
    if _not_built(bench, {"plant": {**plant, _STIFFNESS: 1.0}}):  # beside its other settings
        return
    error = _not_built(bench, {"plant": {**plant, _STIFFNESS: _TOO_STIFF}})
    found = _STIFFEST.search(error)
    expect(_STIFFNESS in error and found is not None, f"{_STIFFNESS} = {_TOO_STIFF:g}: {error}")
    most = 0.0 if found is None else float(found[1])
    for share, is_built in ((0.99, True), (1.02, False)):
        error = _not_built(bench, {"plant": {**plant, _STIFFNESS: share * most}})
        what = f"{_STIFFNESS} = {share * most:g}, {share:g} times the stiffest one"
        expect((not error) is is_built, f"{what}: {error or 'built'}")


@clause(
    "FIT-02",
    Level.L0,
    bench={Ability.SETTINGS},
    source="DeadlineExceeded: what was awaited, how long, last heard; [conformance] slow",
)
def slow_drive_is_reported_in_time(bench: RigProtocol) -> None:
    """A drive that is not enabled in time is reported as such, after the time in the error."""
    slow = bench.facts.slow
    if not slow:
        raise NotApplicable("the rig states no drive that is too slow ([conformance] slow)")
    with bench.altered({}, slow):
        motor = bench.motor
        motor.position()
        begun_ns = bench.runtime.now_ns()
        error = failure_of(motor.enable)
        took_s = elapsed_s(bench, begun_ns)
        told = f"a drive that is too slow: enable() ended with {error!r} after {took_s:.3f} s"
        expect(error is not None, told)
        expect(
            "None" not in f"{error}".replace(motor.name, ""),
            f"{told}: {error}; expected no 'None' for what there is not",
        )
        if isinstance(error, DeadlineExceeded):
            late_s = took_s - error.timeout_s
            is_then = 0.0 <= late_s <= bench.facts.time_tolerance_s
            expect(is_then, f"{told}; expected {error.timeout_s:g} s")
        state = motor.state()
        expect(state is not MotorState.ENABLED, f"{told}, and the state is {state.value}")
