"""L5: loss of communication between a drive and its host.

Each loss happens in the middle of each kind of motion. The rig declares the time limits: `lost_s`,
`dead_man_s` and `brake_s`.
"""

import re
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from itertools import product
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    Mode,
    aim,
    begin_move,
    braking_distance,
    elapsed_s,
    error_ending,
    expect_moved,
    expect_rest,
    expect_same_end,
    expect_unmoved,
    expect_usable,
    failure_of,
    finish,
    follow,
    is_over_soon,
    long_move,
    midway_s,
    modes_of,
    move,
    move_through,
    position_of,
    prepare,
    reached,
    rest_for,
    shortest_s,
    smooth_move,
    speed,
    torque_of,
    until_rest_s,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    DeadlineExceeded,
    LinkError,
    Motor,
    MotorError,
    MotorState,
    TrapezoidalTrajectory,
    UnsupportedError,
)

_BACK_S = 1.0
_HEARD = ("last heard", "since")
_EXAMPLES = 10
_FRAMES = 14  # a start, and a few frames after it
_BOTH = (True, False)
_LATER = [(skip, False, True) for skip in range(6)]  # of the host, in a start that needs few
_FRAMES_OF_STOP = 3  # the stop, and frames that go before it
_SLOW = 4.0  # times the shortest move: a stop can be repeated before its end
_FIRST_OF_STOP = (2, 3)
_SPEED_S = 0.02
_LATE = 0.7  # of the time within which a loss is noticed
_HOLDS = 0.2  # of the largest torque
_GONE = (MotorState.OFFLINE, MotorState.FAULT)
_CABLE = {Ability.TRUTH, Ability.CUT, Ability.AFRESH}


@clause(
    "LOST-01",
    Level.L5,
    bench={Ability.CUT, Ability.AFRESH},
    source="Motor.wait_until_done, LinkError; MotorHooks._read_state, OFFLINE; CiA 301, 7.2.8.3",
)
def cut_cable_fails_wait_in_time(bench: RigProtocol) -> None:
    """In every mode, a wait for a drive whose cable is cut fails in time, and is not done."""
    for mode in modes_of(bench):
        motor = bench.motor
        with bench.cut(motor):
            _expect_wait_fails(bench, motor, mode, "after the cable was cut")
            rest_for(bench, bench.facts.lost_s)
            state = motor.state()
            expect(state in _GONE, f"{mode.name}: cable cut, but the state is {state.value}")


def _expect_wait_fails(bench: RigProtocol, motor: Motor, mode: Mode, when: str) -> None:
    """Check that a wait for the motor ends with an error in time."""
    if not mode.moves:
        return
    within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
    begun_ns = bench.runtime.now_ns()
    error = error_ending(bench, motor, mode, within_s)
    took_s = elapsed_s(bench, begun_ns)
    expect(error is not None, f"{mode.name}: done was reported {took_s:.3f} s {when}")
    expect(
        took_s < within_s - 1e-6,
        f"{mode.name}: no error within {within_s:g} s {when}",
    )


@clause(
    "LOST-02",
    Level.L5,
    needs={Capability.DEAD_MAN},
    bench=_CABLE,
    source="CiA 301, heartbeat consumer (1016h), 1029h; CiA 402-2, 6007h; dead-man",
)
def drive_with_cut_cable_comes_to_rest(bench: RigProtocol) -> None:
    """In every mode, a drive whose cable is cut is at rest within dead-man and braking time."""
    moved = False
    for mode in modes_of(bench):
        motor = bench.motor
        moved |= abs(speed(bench, motor, 0.02)) > 0.1 * motor.model.velocity_max
        with bench.cut(motor):
            rest_for(bench, until_rest_s(bench, motor))
            expect_rest(bench, motor, f"{mode.name}, with its cable cut")
    reached(moved, "a cut during a motion")


@clause(
    "LOST-03",
    Level.L5,
    needs={Capability.DEAD_MAN},
    bench={Ability.TRUTH, Ability.SILENCE_HOST, Ability.AFRESH},
    source="CiA 301, heartbeat consumer (1016h), 1029h; CiA 402-2, 6007h",
)
def drive_without_host_comes_to_rest(bench: RigProtocol) -> None:
    """In every mode, a drive without its host is at rest in time, and the host is notified."""
    silenced = 0
    for mode in modes_of(bench):
        motor = bench.motor
        with bench.silence_host() as lost:
            begun_ns = bench.runtime.now_ns()
            _expect_wait_fails(bench, motor, mode, "after the host was silenced")
            spent_s = elapsed_s(bench, begun_ns)
            rest_for(bench, max(0.0, until_rest_s(bench, motor) - spent_s))
            expect_rest(bench, motor, f"{mode.name}, with its host silenced")
            silenced += lost()
    reached(silenced > 0, "the loss of a frame of the host")


@clause(
    "LOST-04",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench=_CABLE,
    source="MotorHooks._connect; Sharing and locking, at most once",
)
def restored_cable_starts_no_motion(bench: RigProtocol) -> None:
    """Once the cable is back, no motion begins by itself, and the motor is usable as before."""
    for mode in modes_of(bench):
        motor = bench.motor
        with bench.cut(motor):
            rest_for(bench, until_rest_s(bench, motor))
            still_moves = abs(speed(bench, motor, 0.05)) > bench.facts.window
        before = position_of(bench, motor)
        rest_for(bench, _BACK_S)
        if (
            not still_moves
        ):  # without a dead-man the motion continues, and no new command has ended it
            expect_unmoved(bench, motor, before, f"{mode.name}: with its cable back")
        expect_usable(bench, motor, f"{mode.name}, after a loss")


@clause(
    "LOST-05",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={*_CABLE, Ability.LOAD},
    source="MotorHooks._read_state; MotorHooks._enable, it holds its position",
)
def state_after_loss_is_true(bench: RigProtocol) -> None:
    """After a loss, a motor reports that it is enabled if and only if it holds its position."""
    for has_moved in (True, False):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        if has_moved:  # the host and the drive know one another
            move(bench, motor, 0.25 * long_move(bench))
        _expect_true_state(bench, "after a motion" if has_moved else "enabled, but never moved")


def _expect_true_state(bench: RigProtocol, when: str) -> None:
    motor = bench.motor
    with bench.cut(motor):
        rest_for(bench, until_rest_s(bench, motor))
        motor.state()  # a host that only asks when asked to notices the loss now
    rest_for(bench, _BACK_S)
    state = motor.state()
    if state not in (MotorState.ENABLED, MotorState.DISABLED):
        return
    before = position_of(bench, motor)
    bench.load(motor, torque_of(motor, _HOLDS))
    rest_for(bench, 0.5)
    if state is MotorState.ENABLED:
        expect_unmoved(bench, motor, before, f"{when}: reported as enabled, with a load")
        return
    moved = abs(position_of(bench, motor) - before)
    expect(
        moved > 10.0 * bench.facts.window,
        f"{when}: reported as disabled after a loss, the motor holds {_HOLDS:.0%} of its torque",
    )


@clause(
    "LOST-06",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench=_CABLE,
    source="requirement 4 of the paper; Sharing and locking, at most once",
)
def command_to_lost_drive_is_never_executed_later(bench: RigProtocol) -> None:
    """While the cable is cut, commands fail, and are not carried out when it is back."""
    motor = bench.motor
    move(bench, motor, 0.25 * long_move(bench))  # the motor is now fully set up
    before = position_of(bench, motor)
    with bench.cut(motor):
        for pause_s in (0.0, 2.0 * bench.facts.lost_s):  # before the loss can be noticed, and after
            rest_for(bench, pause_s)
            error = failure_of(
                lambda: aim(motor, 0.5 * long_move(bench), relative=True),
                lambda: finish(bench, motor),
            )
            expect(error is not None, "cable cut, but a move was reported done")
    rest_for(bench, _BACK_S)
    expect_unmoved(bench, motor, before, "after a failed move, with the cable back")


@clause(
    "LOST-14",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.CUT},
    source="errors: DeadlineExceeded, what was heard last; LinkError, since when",
)
def error_of_lost_drive_tells_what_was_heard(bench: RigProtocol) -> None:
    """The error of a position that a lost drive does not tell says since when, or what it heard."""
    motor = bench.motor
    move(bench, motor, 0.1 * long_move(bench))
    with bench.cut(motor):
        rest_for(bench, 2.0 * bench.facts.lost_s)
        error, other = failure_of(motor.position), failure_of(motor.enable)
    told = f"{error}"
    expect(any(one in told for one in _HEARD), f"the cable is cut: {told}; expected what was heard")
    is_known = isinstance(other, LinkError)  # the motor knows by itself that it is lost
    expect(
        not is_known or isinstance(error, LinkError), f"{told}; but a command fails with {other}"
    )


@clause(
    "LOST-07",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.RESTART, Ability.AFRESH},
    source="CiA 301, 7.2.8.3.3 boot-up; MotorHooks._connect",
)
def drive_restart_fails_motion_and_sets_up_again(bench: RigProtocol) -> None:
    """If a drive restarts during a motion, the motion fails, and the drive is set up again."""
    for mode in modes_of(bench):
        motor = bench.motor
        bench.restart(motor)
        within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
        if mode.moves:
            error = error_ending(bench, motor, mode, within_s)
            expect(error is not None, f"{mode.name}: done was reported after a restart")
        rest_for(bench, until_rest_s(bench, motor) + _BACK_S)
        expect_rest(bench, motor, f"{mode.name}: after a restart")
        state = motor.state()
        expect(
            state is not MotorState.ENABLED,
            f"{mode.name}: power is off after a restart, but the state is {state.value}",
        )
        expect_usable(bench, motor, f"{mode.name}, after a restart")


@clause(
    "LOST-08",
    Level.L5,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH, Ability.STOP_SYNC, Ability.AFRESH},
    source="CiA 301, SYNC; Sharing and locking, dead-man",
)
def stream_without_sync_fails_and_stops(bench: RigProtocol) -> None:
    """If a streamed motion loses its clock signal, it fails in time, and the motor stops."""
    for mode in modes_of(bench):
        if mode.capability is not Capability.COMPLEX_POSITION:
            continue
        motor = bench.motor
        with bench.stop_sync() as lost:
            rest_for(bench, 0.02)
            if not lost():
                raise NotApplicable("no clock signal was seen on the bus")
            _expect_wait_fails(bench, motor, mode, "after the clock signal was lost")
            rest_for(bench, until_rest_s(bench, motor))
            expect_rest(bench, motor, f"{mode.name}, without its clock signal")
        expect_usable(bench, motor, f"{mode.name}, after the loss of its clock signal")
        return
    if is_over_soon(bench):
        raise NotApplicable("no room for a long motion: long_move is too short")
    raise Violated("complex trajectories are refused")


@clause(
    "LOST-09",
    Level.L5,
    needs={Capability.POSITION_SET_POINT},
    bench={Ability.TRUTH, Ability.LOSE, Ability.SILENCE_HOST, Ability.AFRESH},
    source="Sharing and locking, at most once; requirement 1; errors: DeadlineExceeded, PeerError;"
    " Motor.start: the motion is started and acknowledged, otherwise an error is raised",
)
def lost_frame_keeps_report_truthful(bench: RigProtocol) -> None:
    """Whichever frame of a move is lost, it is done or fails truthfully; a stop may be repeated."""
    hit = 0
    firsts = [(skip, lose_answers, False) for skip in range(_FRAMES) for lose_answers in _BOTH]
    for skip, lose_answers, has_moved in (*firsts, *_LATER):
        bench.afresh()
        motor = bench.motor
        motor.enable()
        if has_moved:
            move(bench, motor, 0.1 * long_move(bench))
        which = f"frame {skip + 1} of {'the drive' if lose_answers else 'the host'} lost"
        lose = bench.silence_host(skip=skip, limit=1)
        if lose_answers:
            lose = bench.lose_answers_of(motor, skip=skip, limit=1)
        hit += move_through(bench, motor, lose, which, is_brief=True)
    reached(hit > 0, "the loss of a frame")
    for skip in range(_FRAMES_OF_STOP if bench.facts.repeats_stops else 0):
        _expect_stop_without_frame(bench, skip)
    for limit in _FIRST_OF_STOP if bench.facts.repeats_stops else ():
        _expect_ramp_of_streamed_stop(bench, limit)


def _expect_ramp_of_streamed_stop(bench: RigProtocol, limit: int) -> None:
    """Expect a stop of a streamed motion to be a ramp, although its first frames are lost."""
    bench.afresh()
    motor, way = bench.motor, long_move(bench)
    motor.enable()
    try:
        follow(motor, smooth_move(motor, way))
    except UnsupportedError:
        return
    rest_for(bench, midway_s(motor, way, 0.5))
    velocity, before = speed(bench, motor, _SPEED_S), position_of(bench, motor)
    with bench.silence_host(limit=limit):
        error = failure_of(motor.stop, partial(finish, bench, motor))
    made, least = position_of(bench, motor) - before, 0.5 * braking_distance(motor, velocity)
    expect(
        error is not None or made >= least,
        f"the first {limit} frames of the host lost in a stop of a streamed motion: moved by"
        f" {made:g} {motor.model.unit} to rest; expected a ramp, at least {least:g}",
    )


def _expect_stop_without_frame(bench: RigProtocol, skip: int) -> None:
    """Expect that a stop brings the motor to rest although a frame of the host is lost."""
    bench.afresh()
    motor, way = bench.motor, long_move(bench)
    motor.enable()
    before, slowly_s = position_of(bench, motor), _SLOW * shortest_s(motor, way)
    follow(motor, TrapezoidalTrajectory(way, duration_s=slowly_s))
    rest_for(bench, 0.2 * slowly_s)
    with bench.silence_host(skip=skip, limit=1):
        failure_of(motor.stop, partial(motor.wait_until_done, 0.6 * slowly_s))
    what = f"frame {skip + 1} of the host lost in a stop"
    expect_rest(bench, motor, what)
    made, unit = abs(position_of(bench, motor) - before), motor.model.unit
    expect(made < 0.9 * abs(way), f"{what}: moved {made:g} {unit} of {way:g} {unit}; not stopped")


@clause(
    "LOST-11",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.ONE_KIND, Ability.AFRESH},
    source="CiA 301, COB-ID: each message has its own; requirement 1; errors: LinkError",
)
def loss_of_one_kind_of_frame_is_told(bench: RigProtocol) -> None:
    """If all frames with one identifier are lost, a motion is done, or fails by itself."""
    with bench.identifiers() as seen:
        bench.motor.enable()
        move(bench, bench.motor, 0.1 * long_move(bench))
    lost = 0
    for identifier in sorted(seen):
        bench.afresh()
        motor, way = bench.motor, 0.25 * long_move(bench)
        expected_s, what = shortest_s(motor, way), f"all frames {identifier:03X}h lost"
        told = motor.position()
        before = begin_move(bench, motor, way, 0.3 * expected_s)
        is_told = _is_told(bench, motor, expected_s)
        with bench.lose_identifier(identifier) as count:
            rest_for(bench, bench.facts.lost_s + bench.facts.time_tolerance_s)
            if is_told:
                _expect_latest_or_gone(bench, motor, told - before, what)
            error = failure_of(partial(finish, bench, motor, expected_s))
            rest_for(bench, until_rest_s(bench, motor))
            with suppress(MotorError):  # else it is fresh
                made, moved = motor.position() - told, bench.true_position(motor) - before
                expect(
                    abs(made - moved) <= 2.0 * bench.facts.window,
                    f"{what}: moved by {moved:g}, position() by {made:g}; expected an error",
                )
            lost += count()
        _expect_state_in_words(error, what)
        is_open = isinstance(error, DeadlineExceeded) and error.awaited.startswith("end of motion")
        expect(
            not is_open,
            f"{what}: a motion of {expected_s:.3f} s is neither done nor failed: {error}",
        )
        if error is None:
            expect_moved(bench, motor, before, way, f"{what}: done was reported")
            continue
        rest_for(bench, until_rest_s(bench, motor) + _BACK_S)
        expect_usable(bench, motor, what)
    reached(lost > 0, "the loss of a frame")
    for identifier in sorted(seen):
        bench.afresh()
        bench.motor.enable()
        _expect_start_is_told(bench, bench.motor, identifier)
        bench.afresh()
        _expect_end_in_time(bench, bench.motor, identifier)


def _expect_end_in_time(bench: RigProtocol, motor: Motor, identifier: int) -> None:
    """Expect the end of a motion to be told once the loss of frames before the wait is noticed."""
    way, lost_s = 0.25 * long_move(bench), bench.facts.lost_s
    expected_s = shortest_s(motor, way)
    begin_move(bench, motor, way, 0.3 * expected_s)
    begun_ns = bench.runtime.now_ns()
    with bench.lose_identifier(identifier):
        rest_for(bench, _LATE * lost_s)
        error = failure_of(partial(finish, bench, motor, expected_s))
    took_s = elapsed_s(bench, begun_ns)
    within_s = max(0.7 * expected_s, lost_s) + bench.facts.time_tolerance_s
    expect(
        error is not None or took_s <= within_s,
        f"all frames {identifier:03X}h lost: done was reported {took_s:.3f} s later; expected"
        f" within {within_s:.3f} s",
    )


def _expect_start_is_told(bench: RigProtocol, motor: Motor, identifier: int) -> None:
    """Start a motor without its frames of one identifier; check the error's words, and the state.

    A CiA 402 drive can be asked for its statusword. So its state is true, or unknown, after a fault
    that none of these frames could tell.
    """
    way, what = 0.1 * long_move(bench), f"all frames {identifier:03X}h lost"
    with bench.lose_identifier(identifier):
        rest_for(bench, bench.facts.lost_s)
        prepare(motor, way)
        _expect_state_in_words(failure_of(motor.start), what)
        rest_for(bench, until_rest_s(bench, motor))
        can_be_asked = hasattr(getattr(motor, "hardware", None), "statusword")
        if can_be_asked and Ability.FAULT in bench.abilities:
            bench.fail(motor)
            rest_for(bench, _BACK_S)
            with suppress(MotorError):
                state = motor.state()
                is_true = state in (MotorState.FAULT, MotorState.OFFLINE)
                expect(is_true, f"{what}, and the drive failed: state() is {state.value}")


def _expect_state_in_words(error: MotorError | None, what: str) -> None:
    """Expect an error that tells a statusword of CiA 402 to tell its state in the same words."""
    for word, name in _STATUSWORD.findall(f"{error}"):
        states = [one for mask, value, one in _STATES if int(word, 16) & mask == value]
        expect(
            name in states or not states,
            f"{what}: {error}; expected statusword {word}h as {' or '.join(states)}",
        )


_STATUSWORD: Final = re.compile(r"statusword ([0-9A-F]{4})h \(([^)]*)\)")
_STATES: Final = (  # CiA 402-2, 6041h: mask, value, state
    (0x4F, 0x00, "not ready to switch on"),
    (0x4F, 0x40, "switch on disabled"),
    (0x6F, 0x21, "ready to switch on"),
    (0x6F, 0x23, "switched on"),
    (0x6F, 0x27, "operation enabled"),
    (0x6F, 0x07, "quick stop active"),
    (0x4F, 0x0F, "fault reaction active"),
    (0x4F, 0x08, "fault"),
)


def _is_told(bench: RigProtocol, motor: Motor, expected_s: float) -> bool:
    """Return whether this motor reports its motion without being asked."""
    latest = motor.latest()
    return latest is not None and elapsed_s(bench, latest.time_ns) < 0.2 * expected_s


def _expect_latest_or_gone(bench: RigProtocol, motor: Motor, offset: float, what: str) -> None:
    """Expect that a motor, which nobody asks, is where it was last heard, or offline."""
    latest = motor.latest()
    if latest is None or latest.position is None or latest.state in _GONE:
        return
    off = abs(latest.position - offset - bench.true_position(motor))
    expect(
        off <= 2.0 * bench.facts.window + 0.1 * long_move(bench),
        f"{what}: latest() says {latest.state.value}, {off:g} {motor.model.unit} from its place",
    )


@clause(
    "LOST-12",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench=_CABLE,
    source="Motor.wait_until_done: of the last motion, whatever was commanded since; LinkError;"
    " Motor.progress, Motor.on_done: at once if it has ended already",
)
def unnoticed_failure_is_not_forgotten(bench: RigProtocol) -> None:
    """If a motion fails while no caller waits, a wait after the next commands still says so."""
    troubles = ["cut off"] + ["restarted"] * (Ability.RESTART in bench.abilities)
    for trouble, is_disabled in product(troubles, (False, True)):
        bench.afresh()
        motor, way = bench.motor, 2.0 * long_move(bench)
        before = begin_move(bench, motor, way, midway_s(motor, way, 0.3))
        if trouble == "restarted":
            bench.restart(motor)
        with bench.cut(motor) if trouble == "cut off" else nullcontext():
            rest_for(bench, until_rest_s(bench, motor))
        rest_for(bench, _BACK_S)
        expect_same_end(motor, f"its drive was {trouble} in a motion")
        is_over, what = motor.progress() is None, f"its drive was {trouble} in a motion, and nobody"
        if is_disabled:
            motor.disable()
        if motor.fault() is not None:
            motor.reset_fault()
        motor.enable()
        error = failure_of(partial(finish, bench, motor, shortest_s(motor, way)))
        if error is None:
            expect_moved(bench, motor, before, way, f"{what} awaited it; later, done")
        expect(
            not (is_over and isinstance(error, DeadlineExceeded)),
            f"{what} awaited it: it was over, and goes on since the drive is back: {error}",
        )


@clause(
    "LOST-13",
    Level.L5,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.AFRESH},
    source="The rig: borne_s; timeouts of the adaptation, which are longer than that",
)
def short_silence_is_borne(bench: RigProtocol) -> None:
    """A motion goes on through a silence of its drive that is as short as the rig states."""
    borne_s = bench.facts.borne_s
    if borne_s is None:
        raise NotApplicable("the rig does not state borne_s")
    begins: tuple[tuple[str, Callable[[Motor, float], None]], ...] = (
        ("a trajectory", lambda motor, way: follow(motor, TrapezoidalTrajectory(way))),
        ("a set-point", lambda motor, way: aim(motor, way, relative=True)),
    )
    for what, begin in begins:
        for delay_s in (0.0, 0.003, 0.011):
            bench.afresh()
            motor, way = bench.motor, long_move(bench)
            motor.enable()
            before = position_of(bench, motor)
            begin(motor, way)
            rest_for(bench, 0.3 * shortest_s(motor, way) + delay_s)
            with bench.lose_answers_of(motor) as lost:
                error = failure_of(partial(motor.wait_until_done, borne_s))
                is_struck = lost() > 0
            if isinstance(error, DeadlineExceeded):  # of this wait
                error = failure_of(partial(finish, bench, motor, shortest_s(motor, way)))
            text = f"{what}, whose drive was silent for {borne_s:g} s"
            reached(is_struck, f"{text}: a lost frame")
            expect(error is None, f"{text}, failed: {error!r}")
            expect_moved(bench, motor, before, way, text)


@clause(
    "LOST-10",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench=_CABLE,
    source="Motor.wait_until_done: done, or the right error; never done short of its target",
)
def done_despite_cut_cable_means_at_target(bench: RigProtocol) -> None:
    """Whenever and however long the cable is cut, done is reported only at the target."""
    from hypothesis import HealthCheck, Phase, given, seed, settings
    from hypothesis import strategies as st

    found: list[bool] = []

    @seed(bench.seed)
    @settings(
        max_examples=_EXAMPLES,
        deadline=None,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.floats(0.0, 1.1), st.floats(0.0, 1.5))
    def property_holds(share: float, length: float) -> None:
        bench.afresh()
        found.append(_is_done_after_a_cut(bench, share, length * bench.facts.lost_s))

    property_holds()
    if True not in found:
        raise NotApplicable("no motion was done in spite of a cut, with these seeds and delays")
    reached(len(found) > _EXAMPLES // 2, "a cut during a motion")


def _is_done_after_a_cut(bench: RigProtocol, share: float, length_s: float) -> bool:
    """Cut the cable during a motion; return whether the motion was reported done."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    before = begin_move(bench, motor, way, share * shortest_s(motor, way))

    def wait_through_cut() -> None:
        with bench.cut(motor), suppress(DeadlineExceeded):
            motor.wait_until_done(length_s)
        finish(bench, motor, shortest_s(motor, way))

    if failure_of(wait_through_cut) is not None:
        return False
    when = f"cut off for {length_s:.3f} s after {share:.0%} of its time"
    expect_moved(bench, motor, before, way, f"{when}, done was reported")
    return True
