"""L5: destroyed frames on a CAN bus, up to bus-off.

A CAN controller repeats a frame that a bit error has destroyed (ISO 11898-1). Error counters grow:
16 failed transmissions in a row make a node error passive, and 32 put it in bus-off, for at least
128 times 11 recessive bits.
"""

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    elapsed_s,
    error_ending,
    expect_moved,
    expect_state,
    expect_usable,
    failure_of,
    finish,
    long_move,
    modes_of,
    move,
    move_through,
    position_of,
    reached,
    rest_for,
    until_rest_s,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import LinkError, MotorState

_TO_PASSIVE = 24  # failures; the node then stays error passive for a while
_TO_BUS_OFF = 32
_AT_ONCE_S = 0.05
_BACK_S = 0.2
_BIT_ERROR_RATE = 1e-4
_MOVES = 6
_COMMAND_FRAMES = 4  # of a command that is confirmed
_FRAMES = 14  # a start, and a few frames after it
_DRIVE_FRAMES = 6
_ERRORS = {Ability.BUS_ERRORS, Ability.AFRESH}


@clause(
    "BUS-01",
    Level.L5,
    bench=_ERRORS,
    source="errors, LinkError: the bus is off; motorapi.runtime; ISO 11898-1, fault confinement",
)
def host_bus_off_ends_wait_at_once(bench: RigProtocol) -> None:
    """In every mode, bus-off of the host ends the wait at once; the motor is usable afterwards."""
    for mode in modes_of(bench):
        motor = bench.motor
        with bench.strike(None, _TO_BUS_OFF) as struck:
            if mode.moves and mode.ends:
                error = error_ending(bench, motor, mode, _AT_ONCE_S)
                expect(
                    isinstance(error, LinkError),
                    f"{mode.name}: host in bus-off; expected LinkError from"
                    f" the wait within {_AT_ONCE_S:g} s, got {error!r}",
                )
            rest_for(bench, until_rest_s(bench, motor))  # a servo on the host coasts
            reached(struck() == _TO_BUS_OFF, "bus-off of the host")
        expect_usable(bench, motor, f"{mode.name}, after bus-off of the host")


@clause(
    "BUS-02",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={*_ERRORS, Ability.TRUTH},
    source="Sharing and locking, at most once; ISO 11898-1: destroyed frames are repeated",
)
def noisy_bus_makes_each_move_once(bench: RigProtocol) -> None:
    """On a bus with one wrong bit in ten thousand, every move is made once and reported done."""
    motor = bench.motor
    motor.enable()
    with bench.noise(_BIT_ERROR_RATE) as struck:
        for number in range(_MOVES):
            before, way = position_of(bench, motor), 0.25 * long_move(bench) * (-1) ** (number // 2)
            aim(motor, way, relative=True)
            finish(bench, motor)
            expect_moved(bench, motor, before, way, f"move {number + 1} on a noisy bus", 2.0)
        reached(struck() > 0, "a bit error on the bus")


@clause(
    "BUS-03",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={*_ERRORS, Ability.TRUTH},
    source="ISO 11898-1: an error passive node takes part; CiA 301, EMCY 8120h",
)
def error_passive_node_is_not_faulty(bench: RigProtocol) -> None:
    """With an error passive drive or host, the motor stays enabled, without fault, and moves."""
    for whose in ("drive", "host"):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        with bench.strike(motor if whose == "drive" else None, _TO_PASSIVE) as struck:
            motor.position()  # makes a drive send that only answers
            rest_for(bench, _BACK_S)
            reached(struck() == _TO_PASSIVE, f"an error passive {whose}")
            what, fault = f"{whose} error passive", motor.fault()
            expect_state(motor, MotorState.ENABLED, what)
            expect(fault is None, f"{what}: reported as fault: {fault}")
            before, way = position_of(bench, motor), 0.25 * long_move(bench)
            move(bench, motor, way)
            expect_moved(bench, motor, before, way, what, 2.0)


@clause(
    "BUS-04",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={*_ERRORS, Ability.TRUTH},
    source="Sharing and locking, at most once; Linux: bus-off discards queued frames",
)
def bus_off_at_any_frame_moves_once_or_fails(bench: RigProtocol) -> None:
    """Whichever frame of a move puts the host in bus-off, the move is made once or fails."""
    hit = 0
    for skip in range(_FRAMES):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        strike = bench.strike(None, _TO_BUS_OFF, skip=skip)
        hit += move_through(bench, motor, strike, f"bus-off with frame {skip + 1} of a move")
    reached(hit > 0, "bus-off of the host")


@clause(
    "BUS-05",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench=_ERRORS,
    source="errors, LinkError: the bus is off; Linux: bus-off discards queued frames",
)
def command_in_bus_off_fails_at_once(bench: RigProtocol) -> None:
    """A command that bus-off of the host meets fails at once, with LinkError; later ones work."""
    hit = 0
    for skip in range(_COMMAND_FRAMES):
        bench.afresh()
        motor = bench.motor
        move(bench, motor, 0.1 * long_move(bench))
        begun_ns = bench.runtime.now_ns()
        with bench.strike(None, _TO_BUS_OFF, skip=skip) as struck:
            error = failure_of(motor.disable)
            took_s = elapsed_s(bench, begun_ns)
            rest_for(bench, until_rest_s(bench, motor))
            hit += struck() == _TO_BUS_OFF
        if error is None:
            break
        expect(
            isinstance(error, LinkError) and took_s <= _AT_ONCE_S,
            f"bus-off at frame {skip + 1} of disable(): {error!r} after {took_s:.3f} s; expected"
            f" LinkError within {_AT_ONCE_S:g} s",
        )
        expect_usable(bench, motor, "after bus-off in disable()")
    reached(hit > 0, "bus-off of the host")


@clause(
    "BUS-06",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={*_ERRORS, Ability.TRUTH},
    source="ISO 11898-1, fault confinement: any node may be in bus-off; Sharing and locking",
)
def bus_off_of_drive_moves_once_or_fails(bench: RigProtocol) -> None:
    """Whichever frame of a move puts the drive in bus-off, the move is made once or fails."""
    hit = 0
    for skip in range(_DRIVE_FRAMES):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        strike = bench.strike(motor, _TO_BUS_OFF, skip=skip)
        what = f"bus-off of the drive with its frame {skip + 1} of a move"
        hit += move_through(bench, motor, strike, what)
    reached(hit > 0, "bus-off of the drive")
