"""Profile position: set-points and their handshake, target reached, halt, change on set-point."""

from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace, Sample
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode

_PP: Final = "CiA 402-2 / IEC 61800-7-201, profile position mode"
_CRUISE_S: Final = 0.2
_WINDOW_MS: Final = 200
_EARLY_S, _LATE_S = 0.02, 0.1
_GAINS: Final = {
    0x60F6: "torque control parameters",
    0x60F9: "velocity control parameters",
    0x60FB: "position control parameters",
}
_CODES: Final = {1: "B", 2: "H", 4: "I"}  # by the number of bytes
_HALTS: Final = 4
_MOST_HALTS: Final = 100
_CRUISING_S: Final = 0.3
_NO_WINDOW: Final = 0xFFFF_FFFF
_SLOW_INC_S: Final = 500.0  # speed of a slow move [increments/s]


def _start(bench: DriveBench) -> tuple[Drive, Pace, int, int]:
    """Return the drive, enabled in pp, its pace, the position, and the distance of a move."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    pace = drive.pace()
    drive.enable(Mode.PP)
    return drive, pace, drive.read(od.POSITION), pace.distance(_CRUISE_S)


def _time_s(pace: Pace) -> float:
    """Return the longest time of one move."""
    return 2.0 * (2.0 * pace.ramp_s + _CRUISE_S) + STATE_S


def _follow(drive: Drive, target: int, within_s: float) -> list[Sample]:
    """Sample the position until the drive rests at a target."""
    tolerance, still = drive.window(), 0
    last = None

    def ends(one: Sample) -> bool:
        nonlocal still, last
        is_there = abs(one.value - target) <= tolerance and one.value == last
        still, last = still + 1 if is_there else 0, one.value
        return still > 10

    return drive.watch(od.POSITION, ends, within_s)


@drive_clause("PP-01", Level.L1, source=f"{_PP}, controlword bit 6, 607Ah, 6067h")
def targets_are_reached(bench: DriveBench) -> None:
    """An absolute set-point ends at 607Ah, a relative one (bit 6) at its distance from the last."""
    drive, pace, start, way = _start(bench)
    target = start + way
    drive.offer(target)
    drive.await_target(target, _time_s(pace), f"absolute move from {start} to {target}")
    drive.offer(-way // 2, od.RELATIVE)
    target -= way - way // 2 if way % 2 else way // 2
    drive.await_target(target, _time_s(pace), f"relative move by {-way // 2}")
    drive.offer(start)
    drive.await_target(start, _time_s(pace), f"absolute move back to {start}")


@drive_clause("PP-02", Level.L1, source=f"{_PP}, controlword bit 4, statusword bit 12")
def set_point_handshake(bench: DriveBench) -> None:
    """Bit 12 follows bit 4: 0 at first, 1 with its edge and as long as it is 1, then 0 again."""
    drive, pace, start, way = _start(bench)
    seen = drive.statusword()
    what, cause = "6041h, enabled without a set-point", "bit 12 is inverted, or stays set"
    drive.expect(not seen & od.BIT_12, what, "bit 12 = 0", f"{seen:04X}h", cause)
    drive.write(od.TARGET_POSITION, start + way)
    drive.command(od.ENABLE | od.NEW_SET_POINT)
    rose = drive.until(lambda word: word & od.BIT_12 != 0, STATE_S)
    drive.expect(
        rose is not None, "bit 4 0 -> 1", "bit 12 = 1", f"{drive.statusword():04X}h", cause
    )
    reached = drive.until(lambda word: word & od.TARGET_REACHED != 0, _time_s(pace))
    drive.expect(reached is not None, "bit 4 = 1", "the move is made", "bit 10 stays 0", "")
    seen = drive.statusword()
    what = "6041h with bit 4 = 1"
    drive.expect(
        bool(seen & od.BIT_12), what, "bit 12 = 1", f"{seen:04X}h", "acknowledge too short"
    )
    drive.write(od.TARGET_POSITION, start)
    drive.command(od.ENABLE | od.NEW_SET_POINT)
    drive.quiet(0.2)
    position = drive.read(od.POSITION)
    drive.expect(
        abs(position - start - way) <= drive.window(),
        "607Ah written while bit 4 stays 1",
        f"no move: {start + way} +- {drive.window()}",
        f"6064h = {position}",
        "the level of bit 4 starts moves, not its edge",
    )
    drive.command(od.ENABLE)
    fell = drive.until(lambda word: not word & od.BIT_12, STATE_S)
    cause = "bit 12 is never cleared"
    drive.expect(
        fell is not None, "bit 4 1 -> 0", "bit 12 = 0", f"{drive.statusword():04X}h", cause
    )


@drive_clause("PP-03", Level.L1, source=f"{_PP}, set-points one after another (bit 5 = 0)")
def buffered_set_points(bench: DriveBench) -> None:
    """A set-point with bit 5 = 0 waits until the running one is reached, and is executed then."""
    drive, pace, start, way = _start(bench)
    first, second = start + way, start + way // 2
    drive.offer(first)
    drive.quiet(pace.ramp_s)
    drive.write(od.TARGET_POSITION, second)
    drive.command(od.ENABLE | od.NEW_SET_POINT)
    taken = drive.until(lambda word: word & od.BIT_12 != 0, _time_s(pace))
    if taken is None:
        raise NotApplicable("no second set-point is acknowledged: the drive has no buffer")
    drive.command(od.ENABLE)
    track = _follow(drive, second, 2.0 * _time_s(pace))
    farthest, last = max(one.value for one in track), track[-1].value
    drive.expect(
        farthest >= first - drive.window() - 0.01 * way,
        f"set-points {first}, then {second}",
        f"{first} reached before the second",
        f"turned at {farthest}",
        "a buffered set-point is executed at once",
    )
    drive.expect(
        abs(last - second) <= drive.window(),
        f"set-points {first}, then {second}",
        f"{second} +- {drive.window()} in the end",
        f"6064h = {last}",
        "the second set-point was acknowledged and lost",
    )


@drive_clause("PP-04", Level.L1, source=f"{_PP}, change set immediately (bit 5 = 1)")
def immediate_set_points(bench: DriveBench) -> None:
    """A set-point with bit 5 = 1 replaces the running one at once."""
    drive, pace, start, way = _start(bench)
    first = start + 3 * way
    drive.offer(first, od.IMMEDIATELY)
    drive.quiet(pace.ramp_s)
    drive.offer(start, od.IMMEDIATELY)
    track = _follow(drive, start, 3.0 * _time_s(pace))
    farthest, last = max(one.value for one in track), track[-1].value
    drive.expect(
        farthest < start + 2 * way,
        f"set-points {first}, then {start} after {pace.ramp_s:.2f} s",
        f"turned before {start + 2 * way}",
        f"turned at {farthest}",
        "bit 5 is ignored",
    )
    what = f"set-point {start} with bit 5"
    expected = f"{start} +- {drive.window()}"
    drive.expect(abs(last - start) <= drive.window(), what, expected, f"6064h = {last}")


@drive_clause("PP-05", Level.L1, source=f"{_PP}, statusword bit 10, 6067h, 6068h")
def target_reached(bench: DriveBench) -> None:
    """Bit 10 is 0 during a move; it is 1 once the position is in window 6067h for time 6068h."""
    drive, pace, start, way = _start(bench)
    drive.require(od.POSITION_WINDOW, od.POSITION_TIME)
    window = drive.read(od.POSITION_WINDOW)
    if not 0 < window < way // 10:
        window = max(2, way // 1000)
        drive.set(od.POSITION_WINDOW, window)
    drive.set(od.POSITION_TIME, _WINDOW_MS)
    drive.offer(start + way)  # its bit 10 must not be taken for that of the next move
    drive.until(lambda word: word & od.TARGET_REACHED != 0, _time_s(pace))
    target = start
    drive.offer(target)
    inside_ns: int | None = None
    end_ns = drive.now_ns + round(_time_s(pace) * 1e9)
    word = 0
    while not word & od.TARGET_REACHED and drive.now_ns < end_ns:
        position = drive.read(od.POSITION)
        if abs(position - target) > window:
            inside_ns = None
        elif inside_ns is None:
            inside_ns = drive.now_ns
        word = drive.statusword()
    seen_s = None if inside_ns is None else (drive.now_ns - inside_ns) / 1e9
    is_set = bool(word & od.TARGET_REACHED)
    seen = "before the window" if seen_s is None else f"{seen_s:.3f} s after entering the window"
    sampling_s = 2.0 * pace.sample_s
    low = _WINDOW_MS / 1e3 - _EARLY_S - sampling_s
    high = _WINDOW_MS / 1e3 + _LATE_S + sampling_s
    drive.expect(
        is_set and seen_s is not None and low <= seen_s <= high,
        f"bit 10 of a move to {target}, 6067h = {window}, 6068h = {_WINDOW_MS} ms",
        f"1 from {low:.2f} s to {high:.2f} s after entering the window (20 ms: sampling)",
        seen if is_set else "0",
        "6067h or 6068h is ignored, or bit 10 is that of the last move",
    )
    if not bench.is_real:  # it overshoots
        _expect_late_motor_is_awaited(drive, pace, start, way, window)


def _expect_late_motor_is_awaited(
    drive: Drive, pace: Pace, start: int, way: int, window: int
) -> None:
    """Expect no bit 10 while a motor with too little torque is still on its way to the target."""
    own, torque = drive.find(od.TORQUE_MAX), drive.find(od.TORQUE)
    if own is None or torque is None or drive.offer_value(od.FOLLOWING_WINDOW, _NO_WINDOW):
        return
    drive.offer(start + way)
    track = drive.watch(od.TORQUE, lambda _: False, pace.ramp_s)
    drive.await_target(start + way, _time_s(pace), f"a move to {start + way}")
    target = start + way // 2
    if drive.offer_value(od.TORQUE_MAX, max(abs(one.value) for one in track) // 2):
        return
    drive.offer(target)
    outside_ns = drive.now_ns
    end_ns = drive.now_ns + round(3.0 * _time_s(pace) * 1e9)
    is_told = False
    while drive.now_ns < end_ns and not is_told:  # a load may be too much for half the torque
        if abs(drive.read(od.POSITION) - target) > 2 * window:
            outside_ns = drive.now_ns
        is_told = bool(drive.statusword() & od.TARGET_REACHED)
    drive.write(od.TORQUE_MAX, own)
    seen_s = (drive.now_ns - outside_ns) / 1e9
    low = _WINDOW_MS / 1e3 - _EARLY_S - 2.0 * pace.sample_s
    drive.expect(
        not is_told or seen_s >= low,
        f"bit 10 with half the torque that 6083h needs, 6067h = {window}",
        f"1 from {low:.2f} s after entering the window",
        f"{seen_s:.3f} s",
        "bit 10 is that of the demand",
    )


@drive_clause("PP-06", Level.L2, source=f"{_PP}, controlword bit 8; 605Dh = 1: 6084h")
def halt_and_continue(bench: DriveBench) -> None:
    """Halt (bit 8) stops at 6084h and then sets bit 10; without halt the move is completed."""
    drive, pace, start, way = _start(bench)
    if drive.find(od.HALT_OPTION) is not None:
        drive.set(od.HALT_OPTION, 1)
    target = start + 4 * way
    drive.offer(target)
    drive.await_velocity(pace.velocity, 3 * pace.ramp_s + 0.5)
    drive.command(od.ENABLE | od.HALT)
    drive.braked(pace.velocity, 3 * pace.ramp_s + 0.5, "bit 8 during a move")
    halted = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
    seen = f"6041h = {drive.statusword():04X}h"
    drive.expect(halted is not None, "standstill with bit 8 = 1", "bit 10 = 1 (velocity 0)", seen)
    drive.quiet()  # a load behind a spring comes to rest after the motor
    position = drive.read(od.POSITION)
    drive.quiet(0.2)
    moved = abs(drive.read(od.POSITION) - position)
    drive.expect(moved <= drive.window(), "bit 8 = 1", "no motion", f"{moved} in 0.2 s")
    drive.command(od.ENABLE)
    drive.await_target(target, 2.0 * _time_s(pace), "bit 8 1 -> 0: the move is continued")
    _expect_still(drive)


def _expect_still(drive: Drive) -> None:
    """Expect halts at rest to leave the motor where it is, how many so ever."""
    drive.quiet()
    count = 2 * drive.window() + _HALTS
    if count > _MOST_HALTS:
        return
    position = drive.read(od.POSITION)
    for _ in range(count):
        drive.command(od.ENABLE | od.HALT)
        drive.command(od.ENABLE)
    drive.quiet()
    near = drive.window()
    drive.near(od.POSITION, position, near, f"{count} halts at rest", "each halt moves the motor")


@drive_clause("PP-07", Level.L1, source=f"{_PP}, change on set-point (bit 9 = 1, bit 5 = 0)")
def change_on_set_point(bench: DriveBench) -> None:
    """A set-point with bit 9 = 1 in the same direction passes the running target at speed."""
    drive, pace, start, way = _start(bench)
    first, second = start + way, start + 2 * way
    drive.offer(first)
    drive.quiet(pace.ramp_s / 2.0)
    drive.offer(second, od.ON_SET_POINT)
    track = drive.watch(od.POSITION, lambda one: one.value >= first, _time_s(pace))
    drive.expect(track[-1].value >= first, f"set-point {first}", "reached", f"{track[-1].value}")
    velocity = drive.read(od.VELOCITY)
    last = drive.await_target(second, _time_s(pace), f"set-point {second} with bit 9")
    if velocity < pace.velocity // 2:
        raise NotApplicable(
            f"the drive stops at {first}: it ignores bit 9, as drives to DSP 402 version 2 do"
            f" ({last} was reached)"
        )


@drive_clause("PP-11", Level.L1, source=f"{_PP}, 6081h to 6084h; position demand value 6062h")
def slow_move_has_its_ramps(bench: DriveBench) -> None:
    """A slow move on gentle ramps has them at both ends: its demand 6062h never steps."""
    drive, pace, start, _ = _start(bench)
    drive.require(od.POSITION_DEMAND)
    units = drive.units()
    velocity = max(1, round(_SLOW_INC_S / units.position_inc / units.velocity))
    speed = velocity * units.velocity
    ramp = max(1, round(2.0 * speed / units.acceleration))
    if speed * units.position_inc > 2.0 * _SLOW_INC_S or velocity > pace.velocity:
        raise NotApplicable("a velocity unit of the drive is too large for a slow move")
    drive.write(od.PROFILE_VELOCITY, velocity)
    drive.ramps(ramp)
    drive.offer(start + round(speed), od.IMMEDIATELY)
    track = drive.watch(od.POSITION_DEMAND, lambda one: one.value >= start + round(speed), 4.0)
    steps = [
        b.value - a.value - 1.5 * speed * (b.time_ns - a.time_ns) / 1e9 for a, b in pairwise(track)
    ]
    seen = f"{max(steps):.1f} more than its speed allows"
    what = f"a move at 6081h = {velocity} on ramps of 0.5 s"
    drive.expect(max(steps) <= 4.0, what, "6062h without a step", seen, "a ramp is left out")


def _gains(drive: Drive) -> dict[Entry, int]:
    """Return the gains that can be written and halved, with their values."""
    found = {}
    for index, name in _GAINS.items():
        for place in range(1, 9):
            code = _CODES.get(drive.size_of(Entry(index, place, "B", name)) or 0)
            if code is None:
                continue
            entry = Entry(index, place, code, name)
            value = drive.read(entry)
            if value > 1 and not drive.offer_value(entry, value):
                found[entry] = value
    return found


@drive_clause("GAIN-01", Level.L2, source="CiA 402-2, 60F6h, 60F9h, 60FBh: control parameter sets")
def gains_have_effect(bench: DriveBench) -> None:
    """With all its gains halved the motor lags otherwise, and with its own ones as before."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.FOLLOWING_ERROR)
    if bench.is_real:
        raise NotApplicable("half the gains of a real motor are not known to be stable")
    gains = _gains(drive)
    if not gains:
        raise NotApplicable("the drive has no gains that can be written")
    pace = drive.pace()
    drive.offer_value(od.FOLLOWING_WINDOW, _NO_WINDOW)
    way, lags = pace.distance(_CRUISE_S), []
    for share, sign in ((1, 1), (2, -1), (1, 1)):
        for entry, value in gains.items():
            drive.write(entry, value // share)
        lags.append(drive.largest_lag(pace, sign * way, 2.0 * _CRUISE_S))
    own, halved, again = lags
    if own > way // 10:
        raise NotApplicable(f"60F4h = {own} on a way of {way}: the motor cannot follow its ramps")
    names = ", ".join(f"{entry.index:04X}h:{entry.subindex}" for entry in gains)
    what = f"60F4h, {names} halved"
    slack = 2 + own // 10
    is_other = abs(halved - own) > slack
    expected = f"another lag than {own} +- {slack}"
    drive.expect(is_other, what, expected, f"{halved}", "the gains have no effect")
    is_back = abs(again - own) < abs(halved - own)
    expected = f"nearer to {own} than {halved}"
    drive.expect(is_back, f"{what}, then as before", expected, f"{again}", "gains stay halved")
    _expect_no_jump(drive, pace, gains)


def _expect_no_jump(drive: Drive, pace: Pace, gains: dict[Entry, int]) -> None:
    """Expect a turning motor to turn on steadily while its gains are halved."""
    drive.enable_at_rest(Mode.PP, 2.0 * pace.ramp_s)
    drive.offer(drive.read(od.POSITION) + pace.distance(3.0 * _CRUISING_S), od.IMMEDIATELY)
    drive.quiet(pace.ramp_s + _CRUISING_S)
    for entry, value in gains.items():
        drive.write(entry, value // 2)
    track = drive.watch(od.POSITION, lambda _: False, _CRUISING_S)
    drive.command(od.DISABLE_VOLTAGE)
    slack = drive.window() + 2.0 * pace.speed * pace.sample_s  # a sample is of any time in it
    span = drive.range_span()
    for before, after in pairwise(track):
        if 0 < span < 2 * abs(after.value - before.value):
            continue  # from one end of 607Bh to the other
        way, took_s = after.value - before.value, (after.time_ns - before.time_ns) / 1e9
        expected = f"at most {1.5 * pace.speed * took_s + slack:.0f} in {took_s:.4f} s"
        is_steady = abs(way) <= 1.5 * pace.speed * took_s + slack
        drive.expect(is_steady, "gains halved in motion: way of 6064h", expected, f"{way}")


@drive_clause("PP-12", Level.L2, source=f"{_PP}: a set-point is taken with bit 4; 6060h, 6061h")
def positioning_begins_at_rest(bench: DriveBench) -> None:
    """Selected while the motor turns, pp brings it to rest, and keeps it there until bit 4."""
    bench.drive.rests_when_selected(Mode.PP)
