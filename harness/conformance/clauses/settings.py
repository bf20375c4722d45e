"""L0: settings: a motor refuses, or uses, what it declares.

U is the unit of the motor's position, rad or m.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import partial
from inspect import getmembers, signature
from itertools import product
from math import inf, isfinite, nan, nextafter
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol, Stated
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
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
    stated_settings,
)
from motorhil.harness.conformance.clauses.motion.measurements import (
    expect_true_torque,
    expect_true_velocity,
)
from motorhil.harness.rig.config.buses import ADDRESS_KEYS
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    LimitError,
    Motor,
    MotorError,
    MotorState,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.settings import Number, SettingError, Text, declaration, shown

_UNIT_MAX: Final = 16  # characters
_CLASSICAL: Final = "CAN_20"  # python-can's name
_UNKNOWN: Final = "no_such_option"
_WRONG: Final[tuple[object, ...]] = (True, "", "no such word", 0.5, nan, inf, -inf, [], {}, b"1")
"""Values of all types; an option takes few of them, if any."""
_NO_ADDRESS: Final[tuple[object, ...]] = (True, -1, 0x1_0000, 1.5, "1", None)
_NO_PARAMETERS: Final[tuple[object, ...]] = ({}, None, 1, "parameters")
_SPEED: Final = 0.5  # of the model's velocity
_SUMMED: Final = 0.35  # of a long move
_SAMPLE_S: Final = 0.01
_AFTER_S: Final = 0.1
_EXACT: Final = 0.012
_HERE: Final = 35  # CiA 402-2, 6098h
_SETTLED_S: Final = 0.5
_UP: Final = 1.25
_FURTHER: Final = 0x20
_ASIDE: Final = 16
_HEARTBEAT, _HOST = "heartbeat_ms", "host_node_id"


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
    stated = stated_settings(bench)
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
    declared = stated_settings(bench).declaration
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
    "OPT-08",
    Level.L0,
    bench={Ability.SETTINGS},
    source="requirement 1: the facts of hardware are settings; its maker's range of addresses",
)
def addresses_end_where_those_of_drive_do(bench: RigProtocol) -> None:
    """The largest address that the motor takes is one that its drive can have."""
    motor, drive = stated_settings(bench), bench.stated(of_drive=True)
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
