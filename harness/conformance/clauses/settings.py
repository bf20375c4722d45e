"""L0: settings: a motor refuses, or uses, what it declares, and refuses a drive that does not fit.

U is the unit of the motor's position, rad or m.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import partial
from inspect import getmembers, signature
from itertools import product
from math import inf, isfinite, nan, nextafter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol, Stated
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_moved,
    expect_raises,
    expect_state,
    failure_of,
    finish,
    follow,
    long_move,
    move_exactly,
    position_of,
    rest_for,
    shortest_s,
    speed,
    torque_of,
    turn,
)
from motorhil.harness.conformance.clauses.motion.measurements import (
    expect_true_torque,
    expect_true_velocity,
)
from motorhil.harness.rig.config.buses import ADDRESS_KEYS
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    DeadlineExceeded,
    DeviceFault,
    LimitError,
    Motor,
    MotorError,
    MotorModel,
    MotorState,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotionKind
from motorhil.settings import Number, SettingError, Text, declaration, shown

_UNIT_MAX: Final = 16  # characters
_CLASSICAL: Final = "CAN_20"  # python-can's name
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
_WRONG: Final[tuple[object, ...]] = (True, "", "no such word", 0.5, nan, inf, -inf, [], {}, b"1")
"""Values of all types; an option takes few of them, if any."""
_NO_ADDRESS: Final[tuple[object, ...]] = (True, -1, 0x1_0000, 1.5, "1", None)
_NO_PARAMETERS: Final[tuple[object, ...]] = ({}, None, 1, "parameters")
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
_SUMMED: Final = 0.35  # of a long move
_SAMPLE_S: Final = 0.01
_AFTER_S: Final = 0.1
_EXACT: Final = 0.012
_HERE: Final = 35  # CiA 402-2, 6098h
_SETTLED_S: Final = 0.5
_UP: Final = 1.25
_LEAST: Final = 0.7  # of the shortest time: done is told within the window
_FURTHER: Final = 0x20
_ASIDE: Final = 16
_HEARTBEAT, _HOST = "heartbeat_ms", "host_node_id"


def _stated(bench: RigProtocol) -> Stated:
    found = bench.stated()
    if found is None:
        raise NotApplicable("the adaptation declares no settings")
    return found


def _takes(kind: Any, value: object) -> bool:
    """Return whether a kind of value takes this one."""
    try:
        kind.read(value, ("value",))
    except SettingError:
        return False
    return True


def _outside(kind: Any) -> Iterator[tuple[object, float]]:
    """Yield the numbers nearest to a range that are not in it, and the limit that they pass."""
    if not isinstance(kind, Number):
        return
    for bound, way in ((kind.low, -1), (kind.high, 1)):
        if not isfinite(bound):
            continue
        if kind.is_whole:
            yield int(bound) + way, bound
        elif kind.above and way < 0:
            yield bound, bound
        else:
            yield nextafter(bound, way * inf), bound


def _refusal(bench: RigProtocol, settings: Mapping[str, object]) -> MotorError | None:
    """Return the error of a motor with these settings, or None if it was built."""
    try:
        built = bench.build(settings)
    except MotorError as error:
        return error
    built.close()
    return None


def _expect_refused(
    bench: RigProtocol, settings: Mapping[str, object], what: str, key: str
) -> MotorError | None:
    """Expect a motor with these settings to be refused by the name of the key; return the error."""
    error = _refusal(bench, settings)
    expect(error is not None, f"{what}: accepted; expected UsageError")
    expect(
        isinstance(error, UsageError) and key in f"{error}",
        f"{what}: {type(error).__name__}: {error}; expected UsageError with {key}",
    )
    return error


@clause(
    "OPT-01",
    Level.L0,
    bench={Ability.SETTINGS},
    source="requirement 1: the facts of hardware are settings; errors: value, limit, unit",
)
def wrong_settings_are_refused_by_name(bench: RigProtocol) -> None:
    """A setting out of range, of another type, missing or unknown is refused by its name."""
    stated = _stated(bench)
    right = dict(stated.values)
    built = bench.build(right)
    unit = built.model.unit
    built.close()
    for key, name in stated.declaration.names(unit).items():
        kind = stated.declaration.keys[name].kind
        for value, limit in _outside(kind):
            what = f"{key} = {value!r}, beyond its limit {limit:g}"
            error = _expect_refused(bench, {**right, key: value}, what, key)
            texts = {f"{limit:g}", f"{limit}", f"{limit:.0f}"}
            is_told = any(text in f"{error}" for text in texts)
            expect(is_told, f"{what}: {error}; expected its limit, {limit:g}")
        for wrong in _WRONG:
            if not _takes(kind, wrong):
                _expect_refused(bench, {**right, key: wrong}, f"{key} = {wrong!r}", key)
        if name not in stated.declaration.defaults:
            rest = {one: right[one] for one in right if one != key}
            _expect_refused(bench, rest, f"without {key}", key)
    _expect_ends(bench, stated, unit)
    _expect_ends_fit(bench, stated, unit)
    _expect_refused(bench, {**right, _UNKNOWN: 1}, f"the unknown key {_UNKNOWN}", _UNKNOWN)
    motor = bench.motor
    motor.enable()
    expect_state(motor, MotorState.ENABLED, "after wrong settings of others were refused")


def _names(text: str, key: str) -> bool:
    """Return whether a message names a key, and does not just have its word."""
    return key in text if "_" in key else f"{key} =" in text or f"{key}:" in text


def _expect_ends(bench: RigProtocol, stated: Stated, unit: str) -> None:
    """Expect the ends of each range to be accepted, or refused beside another setting."""
    names = stated.declaration.names(unit)
    values = dict(stated.values)
    for key in ADDRESS_KEYS:  # another place, since the bench has a motor in its own
        address = values.get(key)
        if isinstance(address, int):
            values[key] = address + _ASIDE
    for key, name in names.items():
        kind = stated.declaration.keys[name].kind
        if not isinstance(kind, Number):
            continue
        ends = (kind.low, kind.high)
        for end in (int(one) if kind.is_whole else one for one in ends if isfinite(one)):
            if not _takes(kind, end):
                continue
            error = _refusal(bench, {**values, key: end})
            is_other = any(_names(f"{error}", one) for one in names if one != key)
            expect(
                error is None or (isinstance(error, UsageError) and is_other),
                f"{key} = {end!r}, an end of its range: {type(error).__name__}: {error}",
            )


def _expect_ends_fit(bench: RigProtocol, stated: Stated, unit: str) -> None:
    """Expect the ends of each range to fit what the drive holds, or to be refused by name."""
    for key, name in stated.declaration.names(unit).items():
        kind = stated.declaration.keys[name].kind
        if not isinstance(kind, Number) or key in ADDRESS_KEYS:
            continue
        ends = [one for one in (kind.low, kind.high) if isfinite(one)]
        for end in (int(one) if kind.is_whole else one for one in ends):
            if not _takes(kind, end):
                continue
            with suppress(RigError), bench.altered({key: end}, {}):  # else refused beside another
                error = failure_of(bench.motor.enable)
                expect(
                    not isinstance(error, UsageError) or key in f"{error}",
                    f"{key} = {end:g}, an end of its range: {error}; expected a refusal by its"
                    " name",
                )


@clause(
    "OPT-02",
    Level.L0,
    bench={Ability.SETTINGS},
    source="motorhil.settings: default, range, unit and usual magnitudes of a setting",
)
def declared_settings_are_consistent(bench: RigProtocol) -> None:
    """The default of a setting is in its range and usual, and all that is usual is permitted."""
    declared = _stated(bench).declaration
    for name, key in declared.keys.items():
        kind, default = key.kind, declared.defaults.get(name)
        if default is not None and isinstance(kind, Number | Text):
            expect(_takes(kind, default), f"{name}: its default {shown(default)} is not allowed")
        if not isinstance(kind, Number):
            continue
        unit = kind.unit
        is_unit = len(unit) <= _UNIT_MAX and " " not in unit
        expect(is_unit, f"{name}: {unit!r} is not a unit; expected up to {_UNIT_MAX} characters")
        for usual in (kind.plausible, kind.plausible_m):
            if usual is None:
                continue
            least, most = usual
            text = f"{name}: usual are {least:g} to {most:g} {unit}"
            expect(0.0 < least < most, f"{text}; expected magnitudes, the smaller first")
            ends = max(abs(kind.low), abs(kind.high))
            expect(most <= ends, f"{text}; allowed: {kind.limits()}")
            if usual is kind.plausible and isinstance(default, int | float):
                expect(
                    kind.doubt(default, (name,)) is None,
                    f"{text}; its own default {default:g} is not",
                )


@clause(
    "OPT-03",
    Level.L0,
    needs={Capability.LOW_LEVEL},
    bench={Ability.SETTINGS},
    source="paper 3.5, no more than one physical motor object for any motor in the system",
)
def hardware_object_is_made_once_and_right(bench: RigProtocol) -> None:
    """A hardware object refuses wrong addresses and options; a drive has one, with its settings."""
    motor = bench.motor
    motor.enable()
    motor.disable()
    with motor.low_level() as found:
        hardware: Any = found
    _expect_parameters(motor)
    _expect_own_values(motor)
    _expect_options(getattr(hardware, "options", None))
    stated = bench.stated()
    if stated is not None:
        _expect_defaults(type(hardware), stated)
        _expect_shared(bench, motor, hardware, stated)
        _expect_addresses(bench, motor, hardware, stated)
    address = None if stated is None else _expect_one_heartbeat(bench, hardware, stated)
    motor.enable()
    expect_state(motor, MotorState.ENABLED, "after further hardware objects were refused")
    if stated is not None and address is not None:
        built = bench.build({**stated.values, "node_id": address, _HOST: hardware.node_id})
        motor.close()
        error = failure_of(built.enable)
        built.close()
        expect(
            not isinstance(error, UsageError),
            f"{_HOST} = {hardware.node_id}, once the motor with this node-ID is closed: {error}",
        )


def _expect_one_heartbeat(bench: RigProtocol, hardware: Any, stated: Stated) -> int | None:
    """Expect one period of the host's heartbeat on a bus, and no drive with its node-ID.

    Return the address of the second drive, which has no motor any more; None: not checked.
    """
    names = stated.declaration.names(bench.motor.model.unit)
    needed = {Ability.SECOND_MOTOR, Ability.SOLE_USER}
    if not {_HEARTBEAT, _HOST}.issubset(names) or not needed.issubset(bench.abilities):
        return None
    second = bench.motors[1]
    with second.low_level() as found:
        other: Any = found
    period_ms = stated.values.get(_HEARTBEAT, stated.declaration.defaults.get(names[_HEARTBEAT]))
    address, own = (getattr(one, "node_id", None) for one in (other, hardware))
    if not isinstance(period_ms, int) or not period_ms or address in (None, own):
        return None
    second.close()
    other_ms = 2 * period_ms
    built = bench.build({**stated.values, "node_id": address, _HEARTBEAT: other_ms})
    error = failure_of(built.enable)
    built.close()
    is_told = all(f"{one} ms" in f"{error}" for one in (period_ms, other_ms))
    expect(
        isinstance(error, UsageError) and is_told,
        f"the host's heartbeat is sent every {period_ms} ms; a second drive that wants it every"
        f" {other_ms} ms: {error}; expected UsageError with both",
    )
    built = bench.build({**stated.values, "node_id": address, _HOST: own})
    error = failure_of(built.enable)
    built.close()
    expect(
        isinstance(error, UsageError) and f"{own}" in f"{error}",
        f"a second drive with {_HOST} = {own}, the address of the first one: {error!r}; expected"
        " UsageError with it",
    )
    return int(address)


def _expect_defaults(kind: Callable[..., Any], stated: Stated) -> None:
    """Expect a hardware object that an application makes to have the defaults of a rig's."""
    for name, one in signature(kind).parameters.items():
        known = stated.declaration.defaults.get(name, one.default)
        if one.default not in (one.empty, None) and known is not None:
            told = f"{name}: {one.default!r} by default in {kind.__name__}, {known!r} in a rig"
            expect(one.default == known, told)


def _expect_addresses(bench: RigProtocol, motor: Motor, hardware: Any, stated: Stated) -> None:
    """Expect hardware objects with wrong addresses, and a second one, to be refused."""
    kind: Callable[..., Any] = type(hardware)
    known = signature(kind).parameters
    first, second, *others = [*known, "", ""]
    own = {"runtime": bench.runtime} if "runtime" in others else {}
    needed = {one.name for one in known.values() if one.default is one.empty} - {*own}
    if (first, second) not in (("bus", "node_id"), ("line", "unit")) or needed != {first, second}:
        return
    names = stated.declaration.names(motor.model.unit)
    declared = stated.declaration.keys[names[second]].kind if second in names else None
    least = 0xFF if getattr(bench.link, "framing", "") == "tcp" else 0  # its units: any byte
    beyond = [
        value
        for value, limit in _outside(declared)
        if isinstance(value, int) and (value > max(limit, least) or value < min(limit, 1 - least))
    ]
    for value in (*_NO_ADDRESS, *beyond):
        made = partial(kind, bench.link, value, **own)
        error = failure_of(made)
        expect(
            isinstance(error, UsageError) and repr(value) in f"{error}",
            f"{kind.__name__} with {second} = {value!r}: {error}; expected a UsageError with it",
        )
    again = _opened_again(bench.link) if Ability.ONE_PROGRAM in bench.abilities else None
    for link in (bench.link, again):
        if link is not None:
            error = failure_of(partial(kind, link, stated.values.get(second), **own))
            by = "" if link is bench.link else ", by another bus object on its bus"
            what = f"a second {kind.__name__} of {motor.name}{by}"
            expect(isinstance(error, UsageError), f"{what}: {error}; expected UsageError")
            if link is not bench.link:
                link.shutdown()


def _opened_again(link: Any) -> Any:
    """Return another bus object of python-can on the same bus, or None."""
    if not all(hasattr(link, name) for name in ("channel", "protocol", "shutdown")):
        return None
    is_fd = link.protocol.name != _CLASSICAL
    try:
        return type(link)(channel=link.channel, **({"fd": True} if is_fd else {}))
    except Exception:  # of any kind: its interface needs more, or allows only one
        return None


def _expect_parameters(motor: Any) -> None:
    """Expect what is not the motor's parameters to be refused by name, and no number in them."""
    set_parameters = getattr(motor, "set_parameters", None)
    if set_parameters is None:
        return
    before = motor.parameters
    kind: Callable[..., Any] = type(before)
    for value in _NO_PARAMETERS:
        error = failure_of(partial(set_parameters, value))
        is_told = isinstance(error, UsageError) and repr(value) in f"{error}"
        expect(is_told, f"{value!r} as parameters of {motor.name}: {error}; expected UsageError")
    expect(motor.parameters == before, f"parameters {motor.parameters} after a refusal")
    for one in fields(before) if is_dataclass(before) else ():
        for value in (nan, "no number", b"1"):
            what = f"parameters with {one.name} = {value!r} were accepted"
            made = partial(kind, **{one.name: value})
            expect_raises((UsageError, TypeError), made, what)
    set_parameters(before)


def _expect_own_values(motor: Any) -> None:
    """Expect values of a motor's kind, which are data classes, to be of their class always."""
    for name, one in getmembers(type(motor), lambda one: isinstance(one, property)):
        before = getattr(motor, name, None) if one.fset is not None else None
        if not is_dataclass(before):
            continue
        for value in (1, "no such value"):
            error = failure_of(partial(setattr, motor, name, value))
            what = f"{motor.name}: {name} = {value!r}"
            if error is None:
                found = getattr(motor, name)
                expect(isinstance(found, type(before)), f"{what}: {found!r}; expected a refusal")
            else:
                is_told = isinstance(error, UsageError) and repr(value) in f"{error}"
                expect(is_told, f"{what}: {error!r}; expected UsageError with it")
        setattr(motor, name, before)


def _expect_options(options: Any) -> None:
    """Expect options that an application makes to be checked as those of a rig."""
    made: Callable[..., Any] = type(options)
    declared = {} if options is None else _declared(options)
    for name, kind in declared.items():
        values = [value for value, _ in _outside(kind)]
        for value in [*values, *(one for one in _WRONG if not _takes(kind, one))]:
            error = failure_of(partial(made, **{name: value}))
            expect(
                isinstance(error, UsageError) and name in f"{error}",
                f"{made.__name__}({name}={value!r}): {error}; expected UsageError",
            )


def _declared(options: object) -> dict[str, Any]:
    """Return the kinds of the declared options of an object, by name."""
    if not is_dataclass(options):
        return {}
    return {name: key.kind for name, key in declaration(type(options)).keys.items()}


def _expect_shared(bench: RigProtocol, motor: Motor, hardware: Any, stated: Stated) -> None:
    """Expect a further motor on the drive to share its hardware object, with its settings."""
    second = bench.build(stated.values)
    with second.low_level() as found:
        expect(found is hardware, f"{motor.name}: its drive has a second hardware object")
    second.close()
    known = getattr(hardware, "options", hardware)
    for key, name in stated.declaration.names(motor.model.unit).items():
        kind, value = stated.declaration.keys[name].kind, getattr(known, name, None)
        if key == "name" or not isinstance(kind, Number) or not isinstance(value, int | float):
            continue
        other = value + 1 if kind.is_whole else _UP * value
        if other == value or not _takes(kind, other) or key in ADDRESS_KEYS:
            continue
        error = _refusal(bench, {**stated.values, key: other})
        expect(
            isinstance(error, UsageError),
            f"a further motor on the drive of {motor.name}, with {key} = {other:g} in the place of"
            f" {value:g}: {error}; expected UsageError, as the hardware object has one {key}",
        )


@clause(
    "OPT-04",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SETTINGS, Ability.TRUTH, Ability.LOAD},
    source="paper 3.2, the adaptation maps units of the drive; settings of motor and drive",
)
def common_settings_fit_for_each_value(bench: RigProtocol) -> None:
    """Whatever address, model or unit motor and drive both state, values are true, in SI units."""
    motor, drive = bench.stated(), bench.stated(of_drive=True)
    if motor is None or drive is None:
        raise NotApplicable("the adaptation, or its drive, declares no settings")
    found = False
    for key, of_drive, value in _common(motor, drive):
        found = True
        with bench.altered({key: value}, {of_drive: value}):
            what = f"{key} = {shown(value)} on both sides"
            _expect_true(bench, what, isinstance(value, str))
    if not found:
        raise NotApplicable("motor and drive have no setting in common")


def _common(motor: Stated, drive: Stated) -> Iterator[tuple[str, str, object]]:
    """Yield keys of motor and drive that state the same, each with another common value."""
    sides = [(one, one.declaration, one.declaration.names("rad")) for one in (motor, drive)]
    (own, declared, names), (its, of_drive, others) = sides
    for (key, name), (other, field) in product(names.items(), others.items()):
        kind, second = declared.keys[name].kind, of_drive.keys[field].kind
        value = own.values.get(key, declared.defaults.get(name))
        if value is None or value != its.values.get(other, of_drive.defaults.get(field)):
            continue
        if isinstance(kind, Text) and isinstance(second, Text):
            if len(kind.words) > 1 and kind.words == second.words:
                yield from ((key, other, word) for word in kind.words if word != value)
        elif key == other and isinstance(value, int | float) and isinstance(kind, Number):
            another = value + _FURTHER if kind.is_whole else _UP * value
            if another != value and _takes(kind, another) and _takes(second, another):
                yield key, other, another


def _expect_true(bench: RigProtocol, what: str, is_word: bool) -> None:
    """Expect positions, velocities and torques of the motor to be those of its output."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    try:
        motor.enable()
        before = position_of(bench, motor)
        move_exactly(bench, motor, way, what)
        expect_moved(bench, motor, before, way, what)
        if is_word:  # of a list, in which one scale may be a little wrong
            _expect_velocities_sum_up(bench)
        else:
            expect_true_velocity(bench, _SPEED * motor.model.velocity_max)
        with suppress(UnsupportedError):
            motor.home(_HERE)
            here = motor.position()
            expect(abs(here) <= bench.facts.window, f"at {here:g} after homing on the spot")
            move_exactly(bench, motor, way, "after homing on the spot")
        with suppress(UnsupportedError):
            motor.torque()
            expect_true_torque(bench, _SETTLED_S)
    except LimitError:
        return  # the model of the motor is too much for this one
    except Violated as violated:
        raise Violated(f"{what}: {violated}") from None


@clause(
    "OPT-08",
    Level.L0,
    bench={Ability.SETTINGS},
    source="requirement 1: the facts of hardware are settings; its maker's range of addresses",
)
def addresses_end_where_those_of_drive_do(bench: RigProtocol) -> None:
    """The largest address that the motor takes is one that its drive can have."""
    motor, drive = _stated(bench), bench.stated(of_drive=True)
    if drive is None:
        raise NotApplicable("the drive declares no settings")
    common = [
        key
        for key in ADDRESS_KEYS
        if key in motor.declaration.keys and key in drive.declaration.keys
    ]
    if not common:
        raise NotApplicable("the motor and its drive have no address in common")
    for key in common:
        own, its = motor.declaration.keys[key].kind, drive.declaration.keys[key].kind
        if isinstance(own, Number) and isinstance(its, Number):
            expect(
                own.high <= its.high,
                f"{key}: up to {own.high:g} for the motor, and {its.high:g} for its drive",
            )


@clause(
    "OPT-07",
    Level.L0,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.SETTINGS, Ability.TRUTH, Ability.LOAD},
    source="settings of the motor: damping in N·m·s/rad, at the output",
)
def stated_damping_is_true(bench: RigProtocol) -> None:
    """At a velocity set-point, a load changes the velocity by itself over the stated damping."""
    stated, motor = _stated(bench), bench.motor
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


def _expect_velocities_sum_up(bench: RigProtocol) -> None:
    """Expect the sum of measured velocities to be the distance: their scale is exactly right.

    One that is rounded to one side is too large in one direction, and too small in the other.
    """
    shares = []
    for way in (_SUMMED * long_move(bench), -_SUMMED * long_move(bench)):
        motor, before = bench.motor, position_of(bench, bench.motor)
        made = last = 0.0
        follow(motor, TrapezoidalTrajectory(way))
        at_ns = bench.runtime.now_ns()
        end_ns = at_ns + round((shortest_s(motor, way) + _AFTER_S) * 1e9)
        while at_ns < end_ns:
            rest_for(bench, _SAMPLE_S)
            velocity, now_ns = motor.velocity(), bench.runtime.now_ns()
            made += 0.5 * (velocity + last) * (now_ns - at_ns) / 1e9
            last, at_ns = velocity, now_ns
        finish(bench, motor)
        shares.append(made / (position_of(bench, motor) - before))
    share = 0.5 * sum(shares)
    expect(abs(share - 1.0) <= _EXACT, f"measured velocities sum up to {share:.2%} of the distance")


@clause(
    "MODEL-03",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SETTINGS, Ability.TRUTH},
    source="paper 3.2, the motor model; UsageError: the model does not suit the drive",
)
def model_without_scale_is_refused_or_right(bench: RigProtocol) -> None:
    """With a model that lacks a scale, a motor is refused by name, or moves as far as commanded."""
    values = _stated(bench).values
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
