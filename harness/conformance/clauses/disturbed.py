"""L5: frames are destroyed on a CAN bus, until a node of it works no more as it did.

What one bit error destroys CAN repeats by itself (ISO 11898-1). Nodes count: 16 failures to send in
a row make one error passive, 32 put it off the bus, for 128 times 11 recessive bits at least.
"""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, clause, expect
from harness.conformance.modes import (
    ending,
    expect_usable,
    modes_of,
    move_through,
    until_rest_s,
)
from harness.conformance.motions import aim, finish, long_move, move, place, reached, rest_for
from motorapi import LinkError, Motor, MotorState

_TO_PASSIVE = 24  # failures: and passive it stays for a while
_TO_BUS_OFF = 32
_AT_ONCE_S = 0.05
_BACK_S = 0.2
_BIT_ERROR_RATE = 1e-4
_MOVES = 6
_FRAMES = 14  # of a start, and a few after it
_ERRORS = {Ability.BUS_ERRORS, Ability.AFRESH}


@clause(
    "BUS-01",
    Level.L5,
    bench=_ERRORS,
    source="errors, LinkError: the bus is off; motorapi.bus_status; ISO 11898-1, fault confinement",
)
def a_host_off_the_bus_is_told_at_once_and_goes_on_afterwards(bench: RigProtocol) -> None:
    """In every mode, who waits is told when the host goes off the bus, and can go on afterwards."""
    for mode in modes_of(bench):
        motor = bench.motor
        with bench.strike(None, _TO_BUS_OFF) as struck:
            if mode.moves and mode.ends:
                error = ending(bench, motor, mode, _AT_ONCE_S)
                expect(
                    isinstance(error, LinkError),
                    f"{mode.words}: the host's CAN controller went off the bus, and who waited was"
                    f" told {error!r} within {_AT_ONCE_S:g} s",
                )
            rest_for(bench, until_rest_s(bench, motor))  # one whose servo is on the host coasts
            reached(struck() == _TO_BUS_OFF, "a host off the bus")
        expect_usable(bench, motor, f"{mode.words}, and the host was off the bus")


@clause(
    "BUS-02",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={*_ERRORS, Ability.TRUTH},
    source="README, 'at most once'; ISO 11898-1: what is destroyed is repeated",
)
def a_noisy_bus_loses_no_move_and_doubles_none(bench: RigProtocol) -> None:
    """On a bus where one bit in ten thousand is wrong each move is made, once, and told so."""
    motor = bench.motor
    motor.enable()
    with bench.noise(_BIT_ERROR_RATE) as struck:
        for number in range(_MOVES):
            before, way = place(bench, motor), 0.25 * long_move(bench) * (-1) ** (number // 2)
            aim(motor, way, relative=True)
            finish(bench, motor)
            _expect_moved(bench, motor, before, way, f"move {number + 1} on a noisy bus")
        reached(struck() > 0, "a bit error")


@clause(
    "BUS-03",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={*_ERRORS, Ability.TRUTH},
    source="ISO 11898-1: an error passive node takes part; CiA 301, EMCY 8120h",
)
def an_error_passive_node_is_none_that_has_failed(bench: RigProtocol) -> None:
    """Whether its drive is error passive or the host, it is enabled, without fault, and moves."""
    for whose in ("drive", "host"):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        with bench.strike(motor if whose == "drive" else None, _TO_PASSIVE) as struck:
            rest_for(bench, _BACK_S)
            reached(struck() == _TO_PASSIVE, f"an error passive {whose}")
            state, fault = motor.state(), motor.fault()
            what = f"its {whose} is error passive"
            expect(state is MotorState.ENABLED, f"{what}, and it is told as {state.value}")
            expect(fault is None, f"{what}, and that is told as its fault: {fault}")
            before, way = place(bench, motor), 0.25 * long_move(bench)
            move(bench, motor, way)
            _expect_moved(bench, motor, before, way, what)


@clause(
    "BUS-04",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={*_ERRORS, Ability.TRUTH},
    source="README, 'at most once'; Linux: what waits for a bus that goes off is given up",
)
def whichever_frame_puts_the_host_off_the_bus_nothing_is_untrue(bench: RigProtocol) -> None:
    """Whichever frame of a move the host goes off the bus with: made once, or said to fail."""
    hit = 0
    for skip in range(1, _FRAMES):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        strike = bench.strike(None, _TO_BUS_OFF, skip=skip)
        hit += move_through(bench, motor, strike, f"off the bus with frame {skip + 1} of a move")
    reached(hit > 0, "a host off the bus")


def _expect_moved(bench: RigProtocol, motor: Motor, before: float, way: float, what: str) -> None:
    moved, unit = place(bench, motor) - before, motor.model.unit
    expect(
        abs(moved - way) <= 2.0 * bench.facts.window,
        f"{what}: told to move {way:g} {unit} once, it moved {moved:g} {unit}",
    )
