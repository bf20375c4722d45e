"""L2: parameters of a drive, per logical motor, and what the hardware object of a drive tells.

Both differ between adaptations, so that a clause is applicable if it finds what it knows.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import partial
from math import inf, nan
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_raises,
    failure_of,
    finish,
    follow,
    long_move,
    move,
    move_exactly,
    rest_for,
    shortest_s,
    until_rest_s,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlVariable,
    LimitError,
    Motor,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)

_WINDOWS: Final = (0x6067, 0x6068, 0x6065, 0x6066, 0x606D, 0x606E)  # CiA 402-2
"""Window and time of position, following error and velocity."""
_WINDOW_TIME: Final = 0x6068
_POSITION, _STATUSWORD, _SHOWN = 0x6064, 0x6041, 0x6061
_DEVICE_TYPE, _IDENTITY, _NAME, _HEARTBEAT = 0x1000, 0x1018, 0x1008, 0x1017  # CiA 301
_STATE_BITS: Final = 0x6F
_FAULT_BITS, _FAULT = 0x4F, 0x08
_PP, _PV = 1, 3
_OFF: Final = 0xFFFF_FFFF
_LOOK_S: Final = 0.2
_VALUES: Final = (0.5, 5.0)
_TOO_LARGE: Final = 1e12
_ROUNDED: Final = 1e-5  # of a range whose ends are told in six digits
_TOLD_RANGE: Final = re.compile(r"must be (-?[\d.e+-]+) to (-?[\d.e+-]*\d)(?=$|;|\.$)")
_PERIOD_MS: Final = 95
_PDO_LENGTH: Final = 0x8210  # CiA 301, EMCY: PDO not processed due to length error
_FIRST_RPDO: Final = 0x200  # CiA 301, predefined connection set
_RAMP_S: Final = 0.5
_NAMES: Final = {  # CiA 402-2: factors, and others that many drives lack
    "velocity_factor_numerator": (0x6096, 1),
    "velocity_factor_divisor": (0x6096, 2),
    "acceleration_factor_numerator": (0x6097, 1),
    "acceleration_factor_divisor": (0x6097, 2),
    "vl_target_velocity": (0x6042, 0),
    "position_range_limit_min": (0x607B, 1),
    "position_range_limit_max": (0x607B, 2),
    "end_velocity": (0x6082, 0),
    "motion_profile_type": (0x6086, 0),
    "torque_profile_type": (0x6088, 0),
    "interpolation_sub_mode": (0x60C0, 0),
    "interpolation_data": (0x60C1, 1),
    "max_acceleration": (0x60C5, 0),
    "max_deceleration": (0x60C6, 0),
    "digital_outputs": (0x60FE, 1),
    "motor_type": (0x6402, 0),
}
_NO_GAIN: Final = 41  # a sub-index of 60F9h that no drive has
_VELOCITY_TPDO, _VELOCITY_MAP, _VELOCITY = 0x1801, 0x1A01, 0x606C  # CiA 301, TPDO 2; CiA 402-2


def _parameters_of(motor: Motor) -> tuple[Any, Callable[[Any], None]]:
    """Return the parameters of a motor, and the method that sets them.

    Raises:
        NotApplicable: it has none.
    """
    found, setter = getattr(motor, "parameters", None), getattr(motor, "set_parameters", None)
    if found is None:
        raise NotApplicable("the motor has no parameters")
    return found, setter or partial(setattr, motor, "parameters")


def _hardware_of(motor: Motor) -> Any:
    """Return the hardware object of a motor, which reads objects at any time.

    Raises:
        NotApplicable: it reads none.
    """
    motor.disable()
    with motor.low_level() as hardware:
        if not hasattr(hardware, "read"):
            raise NotApplicable("the hardware object reads no objects")
        return hardware


def _read_in_motion(bench: RigProtocol, motor: Motor, hardware: Any, way: float) -> list[int]:
    """Return the windows of the drive during a move."""
    follow(motor, TrapezoidalTrajectory(way))
    found = [hardware.read(index) for index in _WINDOWS]
    finish(bench, motor, shortest_s(motor, way))
    return found


@clause(
    "PAR-01",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    bench={Ability.SEVERAL_USERS, Ability.ONE_PROGRAM},
    source="paper, 3.2 and 3.5, motor parameters; CiA 402-2, 6065h to 6068h, 606Dh, 606Eh",
)
def parameters_belong_to_a_logical_motor(bench: RigProtocol) -> None:
    """Parameters are written for the next start of their motor, and not for that of another."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, 0.01 * way)
    own, set_parameters = _parameters_of(motor)
    names = ("position_window", "following_error_window", "velocity_window")
    if not all(hasattr(own, name) for name in names):
        raise NotApplicable("its parameters are not those of a CiA 402 drive")
    hardware = _hardware_of(motor)
    for index in _WINDOWS:
        error = failure_of(partial(hardware.read, index))
        if error is not None:
            raise NotApplicable(f"the drive lacks {index:04X}h: {error}")
    begin, begin_inc = motor.position(), hardware.read(_POSITION)
    at_first = [hardware.read(index) for index in _WINDOWS]
    before = _read_in_motion(bench, motor, hardware, way)
    per_unit = abs((hardware.read(_POSITION) - begin_inc) / (motor.position() - begin))
    kind = type(own)
    window, following = 0.02 * way, 0.5 * way
    stated = kind(
        position_window=window,
        position_window_s=0.007,
        following_error_window=following,
        following_error_s=0.03,
        velocity_window=0.1 * motor.model.velocity_max,
        velocity_window_s=0.009,
    )
    set_parameters(stated)
    expect(_parameters_of(motor)[0] == stated, "parameters are not those that were set")
    early = [hardware.read(index) for index in _WINDOWS]
    expect(early == before, f"parameters are written before a start: {early}; before: {before}")
    try:
        found = _read_in_motion(bench, motor, hardware, -way)
    except UnsupportedError as error:  # the drive keeps one of them
        raise NotApplicable(f"{error}") from None
    wanted = [window * per_unit, 7, following * per_unit, 30, None, 9]
    for index, seen, value, was in zip(_WINDOWS, found, wanted, before, strict=True):
        is_right = seen not in (was, 0) if value is None else abs(seen - value) <= 0.02 * value + 1
        text = "another value than before" if value is None else f"{value:.0f}"
        expect(is_right, f"a start with parameters: {index:04X}h is {seen}; expected {text}")
    _expect_whole_ramp(bench, motor)
    with motor.low_level():
        found = [hardware.read(index) for index in _WINDOWS]
    expect(found == at_first, f"low-level access finds {found} in the drive; before: {at_first}")
    _read_in_motion(bench, motor, hardware, way)
    motor.disable()
    found = [hardware.read(index) for index in _WINDOWS]
    expect(found == at_first, f"disable() leaves {found} in the drive; before: {at_first}")
    set_parameters(kind(following_error_window=inf))
    found = _read_in_motion(bench, motor, hardware, way)
    wanted = [*before[:2], _OFF, *before[3:]]
    expect(found == wanted, f"following_error_window = inf alone: {found}; expected {wanted}")
    found = _read_in_motion(bench, bench.another_user_of(motor), hardware, -way)
    expect(found == before, f"a start of another logical motor: {found}; expected {before}")
    _expect_refusals(motor, kind, set_parameters)
    _expect_changed_value_stays(bench, motor, hardware, way)


def _expect_changed_value_stays(
    bench: RigProtocol, motor: Motor, hardware: Any, way: float
) -> None:
    """Expect a value that low-level access has written to be the drive's own from then on."""
    for change in (2, -2):
        motor.disable()
        with motor.low_level():
            value = hardware.read(_WINDOW_TIME) + change
            if failure_of(partial(hardware.write, _WINDOW_TIME, value)) is not None:
                return  # the drive keeps its own
        found = _read_in_motion(bench, motor, hardware, way)[_WINDOWS.index(_WINDOW_TIME)]
        expect(
            found == value,
            f"{_WINDOW_TIME:04X}h is {found} after a start of a motor that does not set it;"
            f" low-level access wrote {value}",
        )


def _expect_whole_ramp(bench: RigProtocol, motor: Motor) -> None:
    """Expect that a wide window of velocity does not shorten a ramp: it is done at its end."""
    model = motor.model
    rate = min(model.acceleration_max, model.deceleration)
    asked = 0.5 * min(model.velocity_max, rate * _RAMP_S)
    begun_ns = bench.runtime.now_ns()
    try:
        ramp = TrapezoidalTrajectory(asked, duration_s=_RAMP_S)
        follow(motor, ramp, ControlVariable.VELOCITY)
    except UnsupportedError:
        return
    finish(bench, motor, _RAMP_S)
    took_s = elapsed_s(bench, begun_ns)
    motor.stop()
    finish(bench, motor)
    expect(
        took_s >= _RAMP_S, f"a velocity ramp of {_RAMP_S:g} s is reported done at {took_s:.3f} s"
    )


@clause(
    "PAR-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="paper, 3.2, motor parameters: written for the next start of their motor",
)
def motor_moves_with_each_parameter(bench: RigProtocol) -> None:
    """With each of its parameters, at a value that it accepts, a motor moves, or refuses to."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    own, set_parameters = _parameters_of(motor)
    if not is_dataclass(own):
        raise NotApplicable("the motor's parameters have no names")
    kind: Callable[..., Any] = type(own)
    found = False
    for name in (one.name for one in fields(own)):
        for value in _VALUES:
            try:
                stated = kind(**{name: value})
            except (UsageError, TypeError):
                continue
            found = True
            set_parameters(stated)
            given = motor.parameters  # type: ignore[attr-defined]  # of this adaptation
            expect(given == stated, f"{given} after {name} = {value:g} was set")
            way = -way
            with suppress(UsageError, UnsupportedError):  # too much for the model, or the drive
                move_exactly(bench, motor, way, f"with {name} = {value:g}")
            what = f"a parameter {name} = nan was accepted"
            expect_raises((UsageError, TypeError), partial(kind, **{name: nan}), what)
        _expect_told_range(kind, name)
    set_parameters(own)
    expect(found, f"no parameter accepts one of {', '.join(map(str, _VALUES))}")
    move_exactly(bench, motor, -way, "with its former parameters")


def _expect_told_range(kind: Callable[..., Any], name: str) -> None:
    """Expect the ends of the range that the refusal of a parameter tells to be accepted."""
    error: Exception | None = None
    try:
        kind(**{name: _TOO_LARGE})
    except (UsageError, TypeError, OverflowError) as refused:
        error = refused
    found = _TOLD_RANGE.search(f"{error}")
    if found is None:
        return
    low, high = map(float, found.groups())
    rounding = 0.0 if low.is_integer() and high.is_integer() else _ROUNDED * (high - low)
    for end in (low + rounding, high - rounding):
        value = end if rounding else int(end)
        refusal = failure_of(partial(kind, **{name: value}))
        expect(refusal is None, f"{name} = {value:g} was refused: {refusal}; but {error}")


def _expect_refusals(motor: Motor, kind: Any, set_parameters: Callable[[Any], None]) -> None:
    """Expect wrong parameters to be refused, when they are made or used."""
    expect_raises(UsageError, lambda: set_parameters({}), "a dict as parameters was accepted")
    for name, value in (
        ("position_window", 0.0),
        ("position_window", inf),
        ("position_window_s", -0.001),
        ("position_window_s", 66.0),
        ("following_error_window", -1.0),
        ("velocity_window", "1"),
        ("velocity_gains", 1),
        ("velocity_gains", (1.5,)),
        ("position_gains", (True,)),
    ):
        what = f"parameters with {name} = {value!r} were accepted"
        expect_raises((UsageError, TypeError), partial(kind, **{name: value}), what)
    for name in ("position_window", "following_error_window"):
        for value in (1e-12, 1e12):
            set_parameters(kind(**{name: value}))
            what = f"a start with {name} = {value:g} was accepted"
            expect_raises(LimitError, motor.start, what)
    if hasattr(kind(), "velocity_gains"):
        set_parameters(kind(velocity_gains=(*(None,) * (_NO_GAIN - 1), 1)))
        error = failure_of(motor.start)
        expect(
            isinstance(error, UnsupportedError) and f"60F9h:{_NO_GAIN}" in f"{error}",
            f"a start with gain {_NO_GAIN} of velocity: {error}; expected 60F9h:{_NO_GAIN} named",
        )
    set_parameters(kind())


@clause(
    "LOW-09",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY, Capability.FAULTS},
    bench={Ability.FAULT},
    source="paper 3.5, the hardware object; CiA 402-2, 6041h, 6060h, 6064h; CiA 301, SDO, EMCY",
)
def hardware_object_tells_its_drive(bench: RigProtocol) -> None:
    """The hardware object of a CiA 402 drive tells its status, modes, EMCYs and objects truly."""
    motor = bench.motor
    move(bench, motor, 0.1 * long_move(bench))
    motor.disable()
    with motor.low_level() as found:
        hardware: Any = found
        names = ("statusword", "state", "position_inc", "emergencies", "set_mode", "sdo", "listen")
        if not all(hasattr(hardware, name) for name in names):
            raise NotApplicable("the hardware object is not that of a CiA 402 drive")
        hardware.enable()
        hardware.refresh()
        word, position = hardware.read(_STATUSWORD), hardware.read(_POSITION)
        seen = hardware.statusword & _STATE_BITS, hardware.position_inc
        expect(
            seen[0] == word & _STATE_BITS and abs(seen[1] - position) <= 2,
            f"statusword and position_inc are {seen}; 6041h and 6064h are {word:04X}h, {position}",
        )
        expect("ENABLED" in str(hardware.state).upper(), f"enabled, the state is {hardware.state}")
        for mode in (_PV, _PP):
            with suppress(UnsupportedError):
                hardware.set_mode(mode)
                shown = hardware.read(_SHOWN)
                expect(shown == mode, f"set_mode({mode}): 6061h is {shown}")
        expect_raises(UsageError, partial(hardware.set_mode, 99), "mode 99 was accepted")
        _expect_objects(hardware)
        hardware.disable()
        rest_for(bench, _LOOK_S)
        count = len(hardware.emergencies)
        code = bench.fail(motor)
        rest_for(bench, _LOOK_S)
        codes = [getattr(one, "code", None) for one in hardware.emergencies]
        expect(code in codes[count:], f"fault {code:04X}h: the EMCYs are {codes}")
        hardware.refresh()
        word = hardware.statusword
        expect(word & _FAULT_BITS == _FAULT, f"fault {code:04X}h: the statusword is {word:04X}h")
        hardware.reset_fault()
        rest_for(bench, _LOOK_S)
        hardware.refresh()
        word = hardware.statusword
        expect(word & _FAULT_BITS != _FAULT, f"reset: the statusword is still {word:04X}h")
    before = motor.position()
    move(bench, motor, 0.1 * long_move(bench))
    expect(motor.position() != before, "the motor does not move any more")
    _expect_fault_outlasts_a_short_frame(bench, motor, hardware)
    if Ability.SILENCE_HOST in bench.abilities:
        _expect_cause_of_loss(bench, motor, hardware)


def _expect_cause_of_loss(bench: RigProtocol, motor: Motor, hardware: Any) -> None:
    """Expect the error of a motion to tell the EMCY by which its drive has left operational."""
    motor.enable()
    follow(motor, TrapezoidalTrajectory(long_move(bench)))
    rest_for(bench, _LOOK_S)
    before = len(hardware.emergencies)
    with bench.silence_host():
        error = failure_of(partial(finish, bench, motor))
        codes = [one.code for one in hardware.emergencies[before:]]
    is_of_nmt = bool(codes) and "NMT state" in f"{error}"
    expect(
        not is_of_nmt or any(f"{code:04X}h" in f"{error}" for code in codes),
        f"EMCYs {[f'{code:04X}h' for code in codes]} of a drive without its host: {error}",
    )
    rest_for(bench, until_rest_s(bench, motor))
    motor.reset_fault()


def _expect_fault_outlasts_a_short_frame(bench: RigProtocol, motor: Motor, hardware: Any) -> None:
    """Expect that a fault keeps its code although the drive reports a frame that is too short."""
    code = bench.fail(motor)
    rest_for(bench, _LOOK_S)
    hardware.send_frame(_FIRST_RPDO + hardware.node.node_id, bytes(1))
    rest_for(bench, _LOOK_S)
    fault = motor.fault()
    expect(
        fault is not None and fault.code == code,
        f"fault {code:04X}h, and then a PDO of 1 byte: fault() is {fault}; expected the fault",
    )
    told = [f"{one}" for one in hardware.emergencies if one.code == _PDO_LENGTH]
    expect(
        all("PDO" in one and "length" in one for one in told),
        f"EMCY {_PDO_LENGTH:04X}h is told as {told}; expected a PDO that has another length",
    )
    motor.reset_fault()


def _expect_objects(hardware: Any) -> None:
    """Expect the same objects by every way, and wrong accesses refused."""
    identity = hardware.upload(_IDENTITY, 1)
    with hardware.sdo() as sdo:
        seen = sdo.upload(_IDENTITY, 1)
        expect(seen == identity, f"canopen's client reads {seen!r} in 1018h:1, not {identity!r}")
        sdo.download(_HEARTBEAT, 0, (_PERIOD_MS).to_bytes(2, "little"))
        with sdo.open(_NAME, block_transfer=True) as stream:
            name = stream.read()
    whole = hardware.upload(_NAME)
    expect(name == whole, f"canopen's client reads {name!r} in 1008h by blocks, not {whole!r}")
    text = hardware.read(_NAME, kind="string")
    expect(text.encode() == whole, f"1008h as a string is {text!r}; its bytes are {whole!r}")
    period = hardware.read(_HEARTBEAT)
    expect(period == _PERIOD_MS, f"1017h is {period}; canopen's client wrote {_PERIOD_MS}")
    by_name = hardware.read("device_type")
    expect(by_name == hardware.read(_DEVICE_TYPE), f"device_type is {by_name:X}h")
    for name, (index, subindex) in _NAMES.items():
        told = [failure_of(partial(hardware.read, *one)) for one in ((name,), (index, subindex))]
        expect(f"{told[0]}" == f"{told[1]}", f"read() of {name}: {told[0]}; by index: {told[1]}")
    node = hardware.node.node_id
    with hardware.listen(0x580 + node) as inbox:
        hardware.send_frame(0x600 + node, bytes.fromhex("40 00 10 00 00 00 00 00"))
        answer = inbox.receive(1.0)
    expect(answer.data[:4] == bytes.fromhex("43 00 10 00"), f"listen(): {answer.data.hex(' ')}")
    for what, operation in (
        ("a name that no object has", partial(hardware.read, "no such name")),
        ("sub-index 256", partial(hardware.read, _DEVICE_TYPE, 256)),
        ("index 10000h", partial(hardware.upload, 0x10000)),
        ("an unknown kind", partial(hardware.read, _DEVICE_TYPE, 0, "u7")),
        ("a text for a number", partial(hardware.write, _HEARTBEAT, "x")),
        ("70000 for 16 bits", partial(hardware.write, _HEARTBEAT, 70_000)),
        ("a list for bytes", partial(hardware.download, _HEARTBEAT, 0, [1, 2])),
        ("9 bytes in a frame", partial(hardware.send_frame, 0x7FF, bytes(9))),
    ):
        expect_raises(UsageError, operation, f"the hardware object accepted {what}")
