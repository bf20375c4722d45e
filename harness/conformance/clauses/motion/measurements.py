"""L0: measured position, velocity, torque and following error are those of the motor."""

from contextlib import suppress
from functools import partial
from math import copysign

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s, ramp_s
from motorhil.harness.conformance.clauses.helpers import (
    coast,
    elapsed_s,
    expect_at,
    expect_moved,
    expect_outside,
    expect_unmoved,
    failure_of,
    finish,
    follow,
    long_move,
    move_exactly,
    position_of,
    rest_for,
    shortest_s,
    torque_of,
    turn,
)
from motorhil.harness.conformance.clauses.motion.setpoints import expect_counts_from_present
from motorhil.harness.conformance.clauses.tracks import PositionWatch
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotionKind
from motorhil.settings import Number

_VELOCITY_SHARE = 0.05
_TORQUE_SHARE = 0.1
_SAMPLE_S = 0.01
_SAMPLES = 10
_SETTLED_S = 0.2
_PUSH = 0.2  # of the largest torque
_TOLD_S = 0.02
_TOLD_SHARE = 0.4  # of the velocity of a motor that is being pushed
_PROMPT_S = 0.02  # a reading that meets the peak after a load
_READINGS = 40
_SWITCHES = "switches"
_BEGIN = "initial_position_rad"
_OUT_OF_REACH = 1e12  # rad: no counter of 32 bits has it
_HERE = (37, 35)  # CiA 402-2, 6098h: homing on the spot
_CROSSED_S = 60.0
_FAR = 100.0  # long moves: a range of a few turns is that of a message, which does not wrap


@clause(
    "MEAS-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.velocity: measured velocity [U/s]; paper 3.2",
)
def measured_velocity_is_true_velocity(bench: RigProtocol) -> None:
    """Measured velocity is the velocity of the output, in sign and size, also at rest."""
    for share in (0.5, -0.25):
        asked = share * bench.motor.model.velocity_max
        expect_true_velocity(bench, asked)
        at_rest = bench.motor.velocity()
        unit = bench.motor.model.unit
        expect(
            abs(at_rest) <= _VELOCITY_SHARE * abs(asked),
            f"velocity: measured {at_rest:g} {unit}/s at rest, {_SETTLED_S:g} s after a motion at"
            f" {asked:g} {unit}/s; expected 0",
        )


def expect_true_velocity(bench: RigProtocol, asked: float) -> None:
    """Move at this velocity [U/s]; check the measured one against the true one; settle."""
    motor, model = bench.motor, bench.motor.model
    ramps = model.acceleration_max, model.deceleration
    up_s, down_s = (ramp_s(abs(asked), one, jerk_of(motor)) for one in ramps)
    way = 1.5 * asked * _SAMPLES * 0.1 + 0.5 * asked * (up_s + down_s)
    limits = DerivativeLimits(first=abs(asked))
    duration_s = least_s(way, abs(asked), *ramps, jerk_of(motor))
    follow(motor, TrapezoidalTrajectory(way, limits=limits))
    rest_for(bench, up_s + 0.1)
    begun_ns, before = bench.runtime.now_ns(), bench.true_position(motor)
    measured = []
    for _ in range(_SAMPLES):
        measured.append(motor.velocity())
        rest_for(bench, _SAMPLE_S)
    since_s = elapsed_s(bench, begun_ns)
    true = (bench.true_position(motor) - before) / since_s
    mean = sum(measured) / len(measured)
    expect(
        abs(mean - true) <= _VELOCITY_SHARE * abs(asked),
        f"velocity: measured {mean:g} {model.unit}/s at {true:g} {model.unit}/s",
    )
    finish(bench, motor, duration_s)
    rest_for(bench, _SETTLED_S)


@clause(
    "MEAS-02",
    Level.L0,
    needs={Capability.MEASURED_TORQUE},
    bench={Ability.LOAD},
    source="Motor.torque: measured torque [N·m], or force [N]; paper 3.2",
)
def measured_torque_holds_load(bench: RigProtocol) -> None:
    """Measured torque is the torque that holds the load, in sign and size."""
    bench.motor.enable()
    expect_true_torque(bench, 1.0)


def expect_true_torque(bench: RigProtocol, settle_s: float) -> None:
    """Load the enabled motor, which then settles; check the measured torque against the load."""
    motor = bench.motor
    most = torque_of(motor, 1.0)
    measured = []
    for share in (0.4, -0.3):
        from_both_sides = []  # friction holds a part of the load, once with and once against it
        for aside in (0.3, -0.3):
            bench.load(motor, (share + aside) * most)
            rest_for(bench, settle_s)
            bench.load(motor, share * most)
            rest_for(bench, settle_s)
            from_both_sides.append(motor.torque())
        measured.append(sum(from_both_sides) / 2.0)
    unit = motor.model.unit_of(ControlVariable.TORQUE)
    found, wanted = measured[0] - measured[1], 0.7 * most
    expect(
        abs(found - wanted) <= _TORQUE_SHARE * most,
        f"torque: loads differ by {wanted:g} {unit}, measured values by {found:g} {unit},"
        f" {measured[0]:g} and {measured[1]:g} {unit}",
    )


@clause(
    "MEAS-03",
    Level.L0,
    needs={Capability.MEASURED_FOLLOWING_ERROR},
    bench={Ability.LOAD, Ability.TRUTH},
    source="Motor.following_error: demand minus actual position [U]",
)
def following_error_is_demand_minus_actual(bench: RigProtocol) -> None:
    """Following error is the distance from demand to actual position, in sign and size."""
    motor, unit = bench.motor, bench.motor.model.unit
    motor.enable()
    found, true, slowest_s = 0.0, 0.0, 0.0
    for torque in (torque_of(motor, 0.5), torque_of(motor, -0.5)):
        rest_for(bench, _SETTLED_S)
        held, held_truly = motor.position(), bench.true_position(motor)
        bench.load(motor, torque)
        off, off_truly, reported = 0.0, 0.0, 0.0
        for _ in range(60):
            begun_ns = bench.runtime.now_ns()
            reported = max(reported, motor.following_error(), key=abs)
            slowest_s = max(slowest_s, elapsed_s(bench, begun_ns))
            off = max(off, held - motor.position(), key=abs)  # at the encoder: the gear may yield
            off_truly = max(off_truly, held_truly - bench.true_position(motor), key=abs)
            rest_for(bench, 0.002)
        bench.load(motor, 0.0)
        if abs(off) < 10.0 * (motor.model.resolution or 0.0) or off == 0.0:
            raise NotApplicable(
                f"the load moves the motor by {off:.3g} {unit}, too little to measure"
            )
        found, true = found + abs(reported), true + abs(off)
        expect(
            reported * off > 0.0 and off * off_truly > 0.0,
            f"following error: {reported:.4g} {unit} reported at a distance of {off:.4g} {unit};"
            f" the true distance is {off_truly:.4g} {unit}, with a load of {torque:g}",
        )
    expect(  # slow readings meet the peak by chance
        slowest_s > _PROMPT_S or 0.5 <= found / true <= 2.0,
        f"following error: {found / 2.0:.4g} {unit} reported at distances of {true / 2.0:.4g}"
        f" {unit}, mean of both directions",
    )


@clause(
    "MEAS-04",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.position: measured position [U], fresh whenever it is read",
)
def position_in_motion_is_true(bench: RigProtocol) -> None:
    """In motion, the reported position is that of the output a moment ago, in both directions."""
    motor = bench.motor
    motor.enable()
    for way in (long_move(bench), -long_move(bench)):
        expected_s = shortest_s(motor, way)
        watch = PositionWatch(bench, motor)
        follow(motor, TrapezoidalTrajectory(way))
        for _ in range(_READINGS):
            watch.read(f"in a move by {way:g} {motor.model.unit}")
            rest_for(bench, expected_s / _READINGS)
        finish(bench, motor, expected_s)
        watch.end(0.5 * abs(way))


@clause(
    "MEAS-05",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.LOAD},
    source="Motor.position: measured position; Motor.enable: the motor holds its position",
)
def pushed_motor_reports_its_place(bench: RigProtocol) -> None:
    """A motor that was pushed while off reports its place, holds it, and moves on from there."""
    motor = bench.motor
    move_exactly(bench, motor, 0.1 * long_move(bench), "before it was pushed")
    for torque in (torque_of(motor, _PUSH), torque_of(motor, -_PUSH)):
        motor.disable()
        watch = PositionWatch(bench, motor)
        bench.load(motor, torque)
        for _ in range(10):
            rest_for(bench, 0.02)
            watch.read(f"disabled, pushed by {torque:g}")
        _expect_velocity_told(bench, f"disabled, pushed by {torque:g}")
        bench.load(motor, 0.0)
        coast(bench, motor)
        watch.read("pushed, at rest again")
        watch.end(10.0 * bench.facts.window)
        held = bench.true_position(motor)
        motor.enable()
        rest_for(bench, _SETTLED_S)
        expect_unmoved(bench, motor, held, "enabled after it was pushed")
        way = 0.1 * long_move(bench)
        move_exactly(bench, motor, way, "moved after it was pushed")
        expect_moved(bench, motor, held, way, "moved after it was pushed", 2.0)


def _expect_velocity_told(bench: RigProtocol, what: str) -> None:
    """Check the last known velocity, if it is known, and new."""
    motor, unit = bench.motor, bench.motor.model.unit
    before, begun_ns = bench.true_position(motor), bench.runtime.now_ns()
    rest_for(bench, _TOLD_S)
    motor.position()
    took_s, latest = elapsed_s(bench, begun_ns), motor.latest()
    true = (bench.true_position(motor) - before) / took_s
    if latest is None or latest.velocity is None or latest.time_ns < begun_ns:
        return
    allowed = _TOLD_SHARE * abs(true) + _VELOCITY_SHARE * motor.model.velocity_max
    expect(
        abs(latest.velocity - true) <= allowed,
        f"{what}: latest() has velocity {latest.velocity:g} {unit}/s; it is {true:g} {unit}/s",
    )


@clause(
    "MEAS-06",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY, Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH, Ability.SETTINGS},
    source="Motor.position: measured position; CiA 402-2, 6064h: a counter of 32 bits wraps around",
)
def position_goes_on_beyond_the_counter(bench: RigProtocol) -> None:
    """Where the counter of a drive ends, positions go on; moves there are refused, or right."""
    stated = bench.stated(of_drive=True)
    if stated is None or _BEGIN not in stated.declaration.keys:
        raise NotApplicable(f"the drive cannot begin elsewhere ({_BEGIN})")
    if _SWITCHES in stated.values:
        raise NotApplicable("the drive has limit switches, which are nearer")
    if bench.motor.model.kind is not MotionKind.ROTARY:
        raise NotApplicable("the position of a linear motor is not that of its drive in rad")
    kind, found = stated.declaration.keys[_BEGIN].kind, False
    for sign in (1.0, -1.0):
        end, way = _end_of_counter(bench, sign), sign * long_move(bench)
        begin = 0.0 if end is None else end - 0.3 * way
        if end is None or (isinstance(kind, Number) and not kind.low <= begin <= kind.high):
            continue
        with suppress(RigError), bench.altered({}, {_BEGIN: begin}):  # not in the drive's reach
            if abs(bench.motor.position() - begin) > 0.01 * abs(way):
                continue  # it counts from elsewhere, as some do from the place at power-on
            inwards = TrapezoidalTrajectory(-0.01 * way)
            bench.motor.enable()
            error = failure_of(partial(follow, bench.motor, inwards))
            if isinstance(error, LimitError):
                expect_outside(error)
                continue  # its own limits of position are nearer
            finish(bench, bench.motor)
            found = True
            _expect_across(bench, end, way)
    if not found:
        raise NotApplicable("no end of its counter can be reached")


def _end_of_counter(bench: RigProtocol, sign: float) -> float | None:
    """Return the largest position in this direction that the motor takes, by its refusal."""
    motor = bench.motor
    motor.enable()
    error = failure_of(partial(follow, motor, TrapezoidalTrajectory(sign * _OUT_OF_REACH)))
    if error is None:
        motor.stop()
        finish(bench, motor)
    if not isinstance(error, LimitError):
        return None
    end = error.high if sign > 0.0 else error.low
    is_counter = end is not None and _FAR * long_move(bench) < abs(end) < _OUT_OF_REACH
    return end if is_counter else None


def _expect_across(bench: RigProtocol, end: float, way: float) -> None:
    """Check positions across the end of the counter, both ways, and moves beside it."""
    motor = bench.motor
    speed = 0.3 * motor.model.velocity_max
    motor.enable()
    for direction in (1.0, -1.0):
        what = f"across the end of its counter at {end:g}, {'on' if direction > 0.0 else 'back'}"
        watch = PositionWatch(bench, motor)
        turn(motor, copysign(speed, direction * way))
        for _ in range(_READINGS):
            watch.read(what)
            rest_for(bench, 0.7 * abs(way) / speed / _READINGS)
        motor.stop()
        finish(bench, motor)
        watch.read(what)
        watch.end(0.5 * abs(way))
        before = position_of(bench, motor)
        try:
            move_exactly(bench, motor, direction * 0.1 * way, what)
        except UsageError as error:  # refused
            if isinstance(error, LimitError):
                expect_outside(error)
            expect_unmoved(bench, motor, before, f"a move was refused {what}")
            continue
        expect_moved(bench, motor, before, direction * 0.1 * way, what, 2.0)
        if motor.logical.hooks.supports(ControlMode.SETPOINT, ControlVariable.POSITION):
            expect_counts_from_present(bench, motor, direction * 0.3 * way)
    _expect_homed_across(bench, way)


def _expect_homed_across(bench: RigProtocol, way: float) -> None:
    """Check that homing on the spot makes the position 0, beyond the end of the counter, too."""
    motor, begin = bench.motor, bench.motor.position()
    turn(motor, copysign(0.3 * motor.model.velocity_max, way))
    bench.runtime.wait_until(lambda: abs(position_of(bench, motor) - begin) > abs(way), _CROSSED_S)
    motor.stop()
    finish(bench, motor)
    for method in _HERE:
        try:
            motor.home(method)
        except UnsupportedError:
            continue
        expect_at(bench, motor, 0.0, "homed on the spot, beyond the end of its counter")
        return
