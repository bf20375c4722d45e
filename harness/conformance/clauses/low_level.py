"""L2 and L5: low-level access, and the hardware object that it gives."""

from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from inspect import Parameter, signature
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_at,
    expect_moved,
    expect_raises,
    expect_rest,
    expect_speed,
    expect_state,
    failure_of,
    finish,
    follow,
    long_move,
    midway_s,
    move,
    position_of,
    rest_for,
    shortest_s,
    smooth_move,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    DerivativeLimits,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    MotorState,
    PeerError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

_BACK_S: Final = 1.0
_SLOW: Final = 3.0
_PATIENCE_S: Final = 10.0
_LOOK_S: Final = 0.2
_LOST: Final = 3  # answers; a silence that is borne
_ADDRESSES: Final = (0xFFFE, 0xF0F0)
_DEVICE_TYPE, _IDENTITY, _HEARTBEAT = 0x1000, 0x1018, 0x1017  # CiA 301
_TPDO, _MAPPED = 0x1803, 0x1A03  # CiA 301, TPDO 4: its communication, and mapped objects
_INVALID: Final = 0x8000_0000  # CiA 301, COB-ID used by TPDO: it does not exist
_UNMAPPABLE: Final = 0x1000_0020  # the device type
_NO_OBJECT: Final = 0x5FFE
_NO_CODE: Final = "00000000h"  # no abort has it
_WRITE_ONLY: Final = (0x60C4, 6)  # CiA 402-2, buffer clear; many drives lack it
_MEANINGS: Final = {  # CiA 301, SDO abort codes
    0x0602_0000: "not exist",
    0x0609_0011: "sub",
    0x0601_0001: "write only",
    0x0601_0002: "read only",
    0x0604_0041: "mapped",
}
_NMT, _STOP = 0x000, 0x02  # CiA 301, NMT
_SDO_REQUEST, _SDO_ANSWER = 0x600, 0x580  # CiA 301
_FIRST_TPDO: Final = ((0x1800, 1), (0x1A00, 0), (0x1A00, 1))
_UPLOAD: Final = bytes.fromhex("40 00 10 00")  # of the device type
_POSITION: Final = 0x6064
_STREAM_S: Final = 0.01
_STREAMED: Final = 20  # positions, an increment apart
_MODE, _PROFILE, _PROFILE_VELOCITY = 0x6060, (0x6081, 0x6083, 0x6084), 3  # CiA 402-2


@clause(
    "LOW-01",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="requirement 2: no other part of the interface will have any effect",
)
def low_level_access_is_exclusive_and_ends(bench: RigProtocol) -> None:
    """Low-level access is exclusive; when it ends, the motor works as before."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    origin = motor.position()
    move(bench, motor, way)
    for _ in range(2):
        motor.disable()  # a servo loop on the host would have to send meanwhile
        with motor.low_level() as hardware:
            expect(hardware is not None, "low-level access: the hardware object is None")
            with motor.low_level() as again:
                expect(again is hardware, "a block within low-level access has another object")
            together = MotorGroup(motor).sync_capability
            for operation in (motor.start, motor.stop, motor.is_referenced, together):
                what = f"{operation.__name__}() was accepted during low-level access"
                expect_raises(MotorBusyError, operation, what)
            rest_for(bench, 0.3)
    expect_at(bench, motor, origin + way, "after unused low-level access")
    move(bench, motor, way)
    expect_at(bench, motor, origin + 2.0 * way, "moved after low-level access")


@clause("LOW-14", Level.L2, source="Motor.low_level: UnsupportedError; errors: motor, feature")
def low_level_access_is_given_or_refused(bench: RigProtocol) -> None:
    """Low-level access gives an object, or is refused by name and feature; the motor then works."""
    motor = bench.motor
    try:
        with motor.low_level() as hardware:
            expect(hardware is not None, f"low-level access of {motor.name} gives no object")
    except UnsupportedError as error:
        told = f"refused: {error}; expected {motor.name} and what it lacks"
        expect(error.motor == motor.name and bool(error.feature), told)
    motor.enable()
    expect_state(motor, MotorState.ENABLED, "after low-level access")


@clause(
    "LOW-15",
    Level.L2,
    needs={Capability.LOW_LEVEL},
    source="errors, LinkError: this hardware object is closed; docs: the motor interface",
)
def closed_hardware_object_ends_its_motor(bench: RigProtocol) -> None:
    """Once its hardware object was closed, a motor measures nothing and takes no command."""
    motor = bench.motor
    with motor.low_level() as hardware:
        close = _simple(hardware, "close")
    if getattr(motor, "hardware", hardware) is not hardware:
        raise NotApplicable("low-level access gives another object than the motor's hardware")
    motor.enable()
    motor.disable()
    motor.is_referenced()
    close()
    for operation in (
        *(motor.is_referenced, motor.position, motor.velocity, motor.enable, motor.disable),
        *(motor.reset_fault, MotorGroup(motor).sync_capability),
    ):
        what = f"{operation.__name__}() returned, although the hardware object was closed"
        expect_raises(MotorError, operation, what)


@clause(
    "LOW-02",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH},
    source="requirement 2; Motor.low_level: StateError, a motion of this motor is active",
)
def low_level_access_requires_rest(bench: RigProtocol) -> None:
    """Low-level access is refused while the motor moves; the motion continues undisturbed."""
    motor = bench.motor
    asked = 0.3 * motor.model.velocity_max
    turn(motor, asked)
    finish(bench, motor, 2.0)
    rest_for(bench, 0.1)
    expect_raises(
        (MotorBusyError, StateError),
        partial(_open_and_close, motor),
        "low-level access was granted while the motor moves",
    )
    expect_speed(bench, motor, asked, 0.3, "low-level access refused")
    motor.stop()
    finish(bench, motor)


def _open_and_close(motor: Motor) -> None:
    with motor.low_level():
        pass


@clause(
    "LOW-03",
    Level.L5,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.RESTART},
    source="Motor.low_level: afterwards nothing is assumed, the next start writes all its settings",
)
def changes_in_low_level_access_are_noticed(bench: RigProtocol) -> None:
    """If low-level access lost all settings of a drive, the next motion is as before."""
    motor, way = bench.motor, 0.3 * long_move(bench)
    limits = DerivativeLimits(first=0.5 * motor.model.velocity_max)
    follow(motor, TrapezoidalTrajectory(way, limits=limits))
    usual_s = finish(bench, motor, _SLOW * shortest_s(motor, way))
    motor.disable()
    with motor.low_level():
        bench.restart(motor)
        rest_for(bench, _BACK_S)
    expect(
        motor.state() is not MotorState.ENABLED,
        "restarted during low-level access: reported as enabled, but its power is off",
    )
    before = bench.true_position(motor)
    motor.start()
    took_s = finish(bench, motor, _SLOW * shortest_s(motor, way))
    expect_moved(bench, motor, before, way, "restarted during low-level access", 2.0)
    most_s = bench.facts.time_tolerance_s
    expect(
        abs(took_s - usual_s) <= most_s,
        f"restarted during low-level access: the same move took {took_s:.3f} s; expected"
        f" {usual_s:.3f} s within {most_s:g} s",
    )


def _simple(hardware: Any, name: str) -> Callable[[], object]:
    """Return the method of the hardware object of this name.

    Raises:
        NotApplicable: there is none that needs no arguments.
    """
    method: Callable[[], object] | None = getattr(hardware, name, None)
    if method is None:
        raise NotApplicable(f"the hardware object has no {name}()")
    if any(
        one.default is Parameter.empty and one.kind is not Parameter.VAR_POSITIONAL
        for one in signature(method).parameters.values()
    ):
        raise NotApplicable(f"{name}() of the hardware object needs arguments")
    return method


@clause(
    "LOW-04",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="Motor.low_level: the hardware object is for this thread; requirement 2 of the paper",
)
def hardware_object_does_what_it_is_told(bench: RigProtocol) -> None:
    """In low-level access, the hardware object enables, stops and disables the motor."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    with motor.low_level() as hardware, suppress(NotApplicable):
        _simple(hardware, "report")()  # statistics, which begin with the first motion
    move(bench, motor, way)
    for _ in range(2):
        motor.disable()
        with motor.low_level() as hardware:
            enable, disable = _simple(hardware, "enable"), _simple(hardware, "disable")
            enable()
            for name in ("halt", "quick_stop"):
                stop = getattr(hardware, name, None)
                if stop is not None:
                    stop()
                    rest_for(bench, _LOOK_S)
                    enable()
            rest_for(bench, _LOOK_S)
        expect_state(motor, MotorState.ENABLED, "the hardware object was enabled")
        with motor.low_level():
            disable()
            rest_for(bench, _LOOK_S)
        expect_state(motor, MotorState.DISABLED, "the hardware object was disabled")
        before = motor.position()
        move(bench, motor, way)
        expect_at(bench, motor, before + way, "moved after the hardware object was used")
    for name in ("halt", "quick_stop"):
        stop = getattr(hardware, name, None)
        if stop is not None:
            _expect_stopped(bench, f"{name}() of the hardware object", stop)
    _expect_interrupted(bench, hardware)


def _expect_interrupted(bench: RigProtocol, hardware: Any) -> None:
    """Expect that a drive which is switched off in a motion is told as such, with its state."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    motor.enable()
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, midway_s(motor, way, 0.3))
    if failure_of(hardware.disable) is not None:
        return
    error = failure_of(partial(finish, bench, motor, _SLOW * shortest_s(motor, way)))
    state = getattr(getattr(hardware, "state", None), "value", "")  # CiA 402-2, in words
    is_told = f"{state}" in f"{error}" or not isinstance(error, MotionInterrupted)
    expect(is_told, f"{error}; expected the state of the drive, {state!r}")
    motor.stop()
    finish(bench, motor)


def _expect_stopped(bench: RigProtocol, what: str, stop: Callable[[], object]) -> None:
    """Check that this call ends a motion, as any stop does, or is refused and leaves it alone."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    for trajectory in (TrapezoidalTrajectory(way), smooth_move(motor, -way)):
        motor.enable()
        before = position_of(bench, motor)
        try:
            follow(motor, trajectory)
        except UnsupportedError:
            continue
        rest_for(bench, midway_s(motor, way, 0.5))
        error = failure_of(stop)
        if error is not None:
            expect(isinstance(error, MotorBusyError), f"{what} in a motion: {error!r}")
            finish(bench, motor, _SLOW * shortest_s(motor, way))
            made = abs(position_of(bench, motor) - before)
            expect(abs(made - way) <= bench.facts.window, f"{what} was refused: moved {made:g}")
            continue
        rest_for(bench, motor.model.velocity_max / motor.model.deceleration + _LOOK_S)
        expect_rest(bench, motor, f"after {what} in {trajectory!r}")
        made, unit = abs(position_of(bench, motor) - before), motor.model.unit
        expect(made < 0.9 * way, f"{what} in {trajectory!r}: it made {made:g} {unit}")
        motor.stop()
        finish(bench, motor)


@clause(
    "LOW-12",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE},
    source="the hardware object: timing statistics of its servo, also in words",
)
def statistics_are_right_in_words(bench: RigProtocol) -> None:
    """Timing statistics of a hardware object have all their numbers in words, in their units."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    for lost in (0, _LOST):
        follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 0.3 * shortest_s(motor, way))
        with bench.lose_answers_of(motor, limit=lost) if lost else nullcontext():
            finish(bench, motor)
        motor.disable()
        with motor.low_level() as hardware:
            told: Any = _simple(hardware, "report")()
        text, missed = f"{told}", getattr(told, "missed", 0)
        if not hasattr(told, "period_s"):
            raise NotApplicable(f"the statistics have no period: {text}")
        wanted = [f"{told.period_s * 1e3:g} ms", f"{told.cycles} cycles"]
        wanted.append(f"{told.counts_missed} counts missed" if missed else "none missed")
        for words in wanted:
            expect(words in text, f"statistics {told!r} are shown as {text!r}; expected {words!r}")


@clause(
    "LOW-13",
    Level.L2,
    needs={Capability.LOW_LEVEL},
    source="MODBUS Application Protocol, section 7: exceptions; errors carry their facts in words",
)
def refused_register_is_named(bench: RigProtocol) -> None:
    """If a drive refuses to read a register, the error has its address, and the unit."""
    motor = bench.motor
    motor.position()
    with motor.low_level() as found:
        registers: Any = getattr(found, "registers", None)
        read = getattr(registers, "read", None)
        if read is None or next(iter(signature(read).parameters)) != "address":
            raise NotApplicable("the hardware object has no registers by address")
        refused = 0
        for address in _ADDRESSES:
            error = failure_of(partial(read, address, 1))
            if isinstance(error, PeerError):
                refused += 1
                words = f"{address:04X}h", f"{address}"
                is_told = any(one in f"{error}" for one in words)
                is_told &= f"unit {registers.unit}" in f"{error}"
                expect(is_told, f"{error}; expected the unit, and {' or '.join(words)}")
        if not refused:
            raise NotApplicable("the drive refuses no register")
    motor.position()


@clause(
    "LOW-10",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    bench={Ability.SECOND_MOTOR, Ability.TRAFFIC},
    source="requirement 2: no other part of the interface will have any effect",
)
def low_level_access_is_not_disturbed_by_neighbour(bench: RigProtocol) -> None:
    """In low-level access, nothing is sent to the drive, even if others enable another motor."""
    motor, neighbour = bench.motors[:2]
    for one in (motor, neighbour):
        move(bench, one, 0.1 * long_move(bench))
        one.disable()
    with motor.low_level():
        rest_for(bench, _LOOK_S)
        with bench.commands_to(motor) as sent:
            errors: list[MotorError | None] = []
            enable = partial(failure_of, neighbour.enable)
            party = bench.runtime.spawn("neighbour", lambda: errors.append(enable()))
            expect(party.join(_PATIENCE_S) and party.error is None, f"{party.error!r}")
            rest_for(bench, _LOOK_S)
        (error,) = errors
        what = f"another thread enabled {neighbour.name} in low-level access of {motor.name}"
        expect(error is None or isinstance(error, MotorBusyError), f"{what}: {error!r}")
        commands = ", ".join(sorted(set(sent)))
        expect(not sent, f"{what}, and its drive was sent {commands} (result: {error})")
    move(bench, neighbour, 0.1 * long_move(bench))


@clause(
    "LOW-11",
    Level.L2,
    needs={Capability.LOW_LEVEL},
    source="Motor.low_level: StateError; errors: what to do is in the message",
)
def low_level_access_is_refused_at_once(bench: RigProtocol) -> None:
    """Low-level access of a motor that is held is granted, or refused at once, until disabled."""
    motor = bench.motor
    motor.enable()
    begun_ns = bench.runtime.now_ns()
    error = failure_of(partial(_open_and_close, motor))
    took_s, most_s = elapsed_s(bench, begun_ns), 0.5 * bench.facts.time_tolerance_s
    if error is None:
        return
    expect(isinstance(error, StateError), f"low_level() of a motor that is held: {error!r}")
    expect(took_s <= most_s, f"refused after {took_s:g} s; limit {most_s:g} s: {error}")
    motor.disable()
    _open_and_close(motor)


@clause(
    "LOW-05",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="CiA 301, 1000h, 1017h, 1018h; paper 3.5, one hardware object, shared by all;"
    " MotorHooks._open_low_level: it refuses other threads",
)
def hardware_object_reads_and_writes_objects(bench: RigProtocol) -> None:
    """Objects of a CANopen node are read and written as addressed, and not during a motion."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    move(bench, motor, 0.1 * way)
    motor.disable()
    with motor.low_level() as found:
        hardware: Any = found
        if not all(hasattr(hardware, name) for name in ("upload", "download", "read", "write")):
            raise NotApplicable("the hardware object has no objects of CANopen")
        for index, subindex in ((_DEVICE_TYPE, 0), (_IDENTITY, 1)):
            data, value = hardware.upload(index, subindex), hardware.read(index, subindex)
            expect(
                int.from_bytes(data, "little") == value,
                f"{index:04X}h:{subindex}: read() is {value}, but upload() is {data.hex(' ')}",
            )
        period_ms = hardware.read(_HEARTBEAT)
        for written_ms in (period_ms + 1, period_ms):
            hardware.write(_HEARTBEAT, written_ms)
            _expect_period(hardware, written_ms, "write()")
            hardware.download(_HEARTBEAT, 0, (written_ms + 2).to_bytes(2, "little"))
            _expect_period(hardware, written_ms + 2, "download()")
        hardware.write(_HEARTBEAT, period_ms)
        _expect_aborts_in_words(hardware)
        _expect_refused_elsewhere(bench, "upload()", partial(hardware.upload, _DEVICE_TYPE, 0))
        own = partial(hardware.write, _HEARTBEAT, period_ms)
        _expect_refused_elsewhere(bench, "write()", own)
    follow(motor, TrapezoidalTrajectory(way))
    for what, operation in (
        ("write()", partial(hardware.write, _HEARTBEAT, period_ms)),
        ("download()", partial(hardware.download, _HEARTBEAT, 0, period_ms.to_bytes(2, "little"))),
        ("send_frame()", partial(hardware.send_frame, 0)),
    ):
        from_elsewhere = f"{what} of the hardware object was accepted while its motor moves"
        expect_raises(MotorBusyError, operation, from_elsewhere)
    with suppress(NotApplicable):
        enable = _simple(hardware, "enable")
        expect_raises(MotorBusyError, enable, "enable() was accepted while the motor moves")
    finish(bench, motor, shortest_s(motor, way))
    if {Ability.SECOND_MOTOR, Ability.SOLE_USER}.issubset(bench.abilities):
        _expect_further_nodes(bench, hardware)


def _expect_further_nodes(bench: RigProtocol, hardware: Any) -> None:
    """Expect the bus of a node to hear, and to ask, a node that no motor of the program has."""
    network = getattr(getattr(getattr(hardware, "node", None), "bus", None), "network", None)
    bench.motor.disable()  # it may be on the node of the second one
    second = bench.motors[1]
    _expect_pdo_as_it_was(second)
    second.disable()
    with second.low_level() as found:
        node_id = getattr(found, "node_id", None)
    if network is None or node_id in (None, getattr(hardware, "node_id", None)):
        return
    second.close()
    answer = _SDO_ANSWER + node_id
    heard: list[bytes] = []
    network.subscribe(answer, lambda _can_id, data, _time_s: heard.append(bytes(data)))
    network.send_message(_SDO_REQUEST + node_id, _UPLOAD + bytes(4))
    rest_for(bench, _LOOK_S)
    network.unsubscribe(answer)
    told = ", ".join(data.hex(" ") for data in heard) or "nothing"
    expect(
        [data[1:4] for data in heard] == [_UPLOAD[1:]],
        f"node {node_id}, asked for 1000h by the network of the bus: heard is {told}",
    )


def _expect_pdo_as_it_was(motor: Any) -> None:
    """Enable a motor; expect a TPDO whose mapping its drive keeps to be valid, or told as off."""
    sdo = getattr(getattr(getattr(motor, "hardware", None), "node", None), "sdo", None)
    read = getattr(sdo, "upload", None)
    found: list[list[bytes]] = []
    for _ in range(2):
        with suppress(Exception):  # it has no such TPDO, or takes other arguments
            found.append([read(*place) for place in _FIRST_TPDO] if read is not None else [])
        motor.enable()
    if len(found) < 2 or not found[0] or found[0][1:] != found[1][1:]:
        return
    if not all(isinstance(data, bytes) for one in found for data in one):
        return  # it is another library's
    before, after = ([data.hex(" ") for data in one] for one in found)
    told = getattr(getattr(motor.hardware, "facts", None), "limitations", ())
    is_told = any("TPDO 1 is left switched off" in one for one in told)
    if not found[0][0][-1] & 0x80 and not is_told:  # it exists
        expect(before == after, f"identifier and mapping of TPDO 1 are {after}; before: {before}")


def _expect_aborts_in_words(hardware: Any) -> None:
    """Expect the refusals of a node to be told in words of CiA 301, beside their codes."""
    for operation in (
        partial(hardware.upload, _NO_OBJECT),
        partial(hardware.upload, _DEVICE_TYPE, 1),
        partial(hardware.download, _DEVICE_TYPE, 0, bytes(4)),
        partial(_map_the_unmappable, hardware),
        partial(hardware.upload, *_WRITE_ONLY),
    ):
        error = failure_of(operation)
        expect(isinstance(error, PeerError), f"{error!r}; expected an abort of the node")
        expect(_NO_CODE not in f"{error}", f"{error}; expected the code of the abort")
        for code, word in _MEANINGS.items():
            is_told = f"{code:08X}h" not in f"{error}" or word in f"{error}".lower()
            expect(is_told, f"{error}; expected what {code:08X}h means, with the word {word!r}")


def _map_the_unmappable(hardware: Any) -> None:
    """Map the device type in a TPDO that is off, which no node allows."""
    switched_off = hardware.read(_TPDO, 1) | _INVALID
    hardware.download(_TPDO, 1, switched_off.to_bytes(4, "little"))
    hardware.download(_MAPPED, 0, bytes(1))
    hardware.download(_MAPPED, 1, _UNMAPPABLE.to_bytes(4, "little"))


def _expect_refused_elsewhere(
    bench: RigProtocol, what: str, operation: Callable[[], object]
) -> None:
    """Expect another thread to be refused this operation during low-level access."""
    errors: list[MotorError | None] = []
    party = bench.runtime.spawn("other thread", lambda: errors.append(failure_of(operation)))
    expect(party.join(_PATIENCE_S) and party.error is None, f"{what} elsewhere: {party.error!r}")
    told = f"{what} of the hardware object in another thread, during low-level access: {errors[0]}"
    expect(isinstance(errors[0], MotorBusyError), f"{told}; expected its refusal")


@clause(
    "LOW-06",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="Motor.low_level: afterwards nothing is assumed; CiA 402-2, 6060h, 6081h to 6084h",
)
def changed_objects_are_written_again(bench: RigProtocol) -> None:
    """Objects of a CiA 402 drive that low-level access has changed are as before in a motion."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    usual_s = finish(bench, motor, shortest_s(motor, way))
    for is_reserved in (False, True):
        with motor.reserve("a clause") if is_reserved else nullcontext():
            motor.disable()
            with motor.low_level() as hardware:
                _change_profile(hardware)
            before, way = position_of(bench, motor), -way
            follow(motor, TrapezoidalTrajectory(way))
            took_s = finish(bench, motor, _SLOW * shortest_s(motor, way))
        what = "other mode, speed and ramps in low-level access"
        expect_moved(bench, motor, before, way, what)
        expect(
            abs(took_s - usual_s) <= bench.facts.time_tolerance_s,
            f"{what}: the next move took {took_s:.3f} s; {usual_s:.3f} s before",
        )


@clause(
    "LOW-07",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="CiA 301, 7.3.2.2, NMT stop remote node; Motor.low_level: afterwards nothing is assumed",
)
def stopped_node_is_started_again(bench: RigProtocol) -> None:
    """A CANopen node that is stopped (NMT) in low-level access is started for the next motion."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    motor.disable()
    with motor.low_level() as found:
        hardware: Any = found
        if not hasattr(hardware, "send_frame") or not hasattr(hardware, "upload"):
            raise NotApplicable("the hardware object sends no frames to a node of CANopen")
        hardware.send_frame(_NMT, bytes((_STOP, hardware.node.node_id)))
        rest_for(bench, _LOOK_S)
        expect_raises(MotorError, partial(hardware.read, _DEVICE_TYPE), "a stopped node answers")
    before = position_of(bench, motor)
    move(bench, motor, way)
    expect_moved(bench, motor, before, way, "after its node was stopped")


@clause(
    "LOW-08",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH},
    source="CiA 402-2, cyclic synchronous position mode; requirement 2 of the paper",
)
def hardware_object_streams_positions(bench: RigProtocol) -> None:
    """In low-level access, a stream of positions is followed at once, one for each period."""
    motor = bench.motor
    move(bench, motor, 0.1 * long_move(bench))
    motor.disable()
    with motor.low_level() as found:
        hardware: Any = found
        stream_positions = getattr(hardware, "stream_positions", None)
        if stream_positions is None:
            raise NotApplicable("the hardware object streams no positions")
        _simple(hardware, "enable")()
        before, begin = position_of(bench, motor), hardware.read(_POSITION)
        stream = stream_positions(
            _STREAM_S, lambda cycle: begin + cycle if cycle <= _STREAMED else None
        )
        rest_for(bench, 2.0 * _STREAMED * _STREAM_S + _LOOK_S)
        moved = hardware.read(_POSITION) - begin
        expect(stream.ended, f"a stream of {_STREAMED} positions has not ended")
        expect(abs(moved - _STREAMED) <= 2, f"a stream over {_STREAMED} increments moved {moved}")
    expect(position_of(bench, motor) != before, "a stream of positions did not move the motor")
    move(bench, motor, 0.1 * long_move(bench))


def _change_profile(hardware: Any) -> None:
    """Write the objects of a CiA 402 drive that make a profile, and the mode.

    Raises:
        NotApplicable: it is no such drive.
    """
    try:
        for index in _PROFILE:
            slower = max(1, hardware.read(index) // 4)
            hardware.download(index, 0, slower.to_bytes(4, "little"))
    except (AttributeError, PeerError, TypeError) as error:
        raise NotApplicable(
            f"the hardware object has no {index:04X}h of CiA 402: {error}"
        ) from None
    with suppress(PeerError):
        hardware.download(_MODE, 0, bytes((_PROFILE_VELOCITY,)))


def _expect_period(hardware: Any, wanted_ms: int, what: str) -> None:
    found = hardware.read(_HEARTBEAT)
    expect(found == wanted_ms, f"{what} of {wanted_ms} to 1017h: it is {found}")
