"""Supervision of motion: following error, software position limits."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode, State

_FOLLOWING: Final = 0x8611
_TIMEOUT_MS: Final = 30
_LONG_MS: Final = 300
_TOO_MUCH: Final = 1.3  # of the motor's torque
_FASTEST_S: Final = 0.01
_HARDER, _FASTER = 100, 4
_FAULTS: Final = (State.FAULT, State.FAULT_REACTION_ACTIVE)


@drive_clause("FOL-01", Level.L2, source="CiA 402-2, 6065h, 6066h, statusword bit 13; EMCY 8611h")
def following_error(bench: DriveBench) -> None:
    """A following error beyond 6065h for longer than 6066h sets bit 13, or is fault 8611h."""
    drive = bench.drive
    drive.require(od.FOLLOWING_WINDOW, od.FOLLOWING_TIMEOUT, od.FOLLOWING_ERROR)
    pace = drive.pace()
    if pace.sample_s > _FASTEST_S:
        took = f"an upload takes {pace.sample_s:.3f} s"
        raise NotApplicable(f"{took}: too long to time {_TIMEOUT_MS} ms")
    begin_ns = drive.now_ns
    window = _lag_by_profile(drive, pace) or _lag_by_force(bench, pace)
    beyond_ns: int | None = None
    end_ns = drive.now_ns + round((2.0 * pace.ramp_s + 1.0) * 1e9)
    word = 0
    while drive.now_ns < end_ns:
        word = drive.statusword()
        if word & od.BIT_13 or od.state_of(word) in _FAULTS:
            break
        if beyond_ns is None and abs(drive.read(od.FOLLOWING_ERROR)) > window:
            beyond_ns = drive.now_ns
    seen_s = None if beyond_ns is None else (drive.now_ns - beyond_ns) / 1e9
    is_fault = od.state_of(word) in _FAULTS
    if beyond_ns is None and not is_fault and not word & od.BIT_13:
        raise NotApplicable(f"60F4h stays within {window} at the drive's limits")
    low, high = _TIMEOUT_MS / 1e3 - 0.015, _TIMEOUT_MS / 1e3 + 0.1
    seen = "at once" if seen_s is None else f"after {seen_s:.3f} s"
    drive.expect(
        (is_fault or bool(word & od.BIT_13)) and seen_s is not None and low <= seen_s <= high,
        f"|60F4h| > 6065h = {window}, 6066h = {_TIMEOUT_MS} ms",
        f"bit 13 or a fault after {low:.2f} s to {high:.2f} s",
        f"6041h = {word:04X}h {seen}",
        "6065h or 6066h is ignored",
    )
    if is_fault:
        drive.await_emergency(_FOLLOWING, begin_ns, "fault by following error")
        drive.await_state(State.FAULT, "following error", "transition 14", STATE_S + pace.ramp_s)
        code = drive.find(od.ERROR_CODE)
        expected, seen = f"{_FOLLOWING:04X}h", "absent" if code is None else f"{code:04X}h"
        drive.expect(code in (_FOLLOWING, None), f"{od.ERROR_CODE}", expected, seen)


def _lag_by_profile(drive: Drive, pace: Pace) -> int:
    """Start a move whose following error is twice 6065h, and return that; 0 if there is no lag."""
    if not drive.has_mode(Mode.PP):
        return 0
    drive.enable(Mode.PP)
    start = drive.read(od.POSITION)
    drive.offer(start + pace.distance(0.5), od.IMMEDIATELY)
    drive.await_velocity(pace.velocity, 3.0 * pace.ramp_s + 0.5)
    errors = [abs(drive.read(od.FOLLOWING_ERROR)) for _ in range(20)]
    word = drive.statusword()
    what = f"a move within 6065h = {drive.read(od.FOLLOWING_WINDOW)}"
    drive.expect(not word & od.BIT_13, what, "bit 13 = 0", f"6041h = {word:04X}h", "window ignored")
    drive.until(lambda word: word & od.TARGET_REACHED != 0, 4.0 * pace.ramp_s + 3.0)
    window = min(errors) // 2
    if window:
        _set_window(drive, window)
        drive.offer(start, od.IMMEDIATELY)
    return window


def _lag_by_force(bench: DriveBench, pace: Pace) -> int:
    """Start a move that the motor cannot follow; return 6065h."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    if bench.is_real:
        raise NotApplicable("60F4h stays 0 at full speed: too small to judge 6065h")
    window = max(2, pace.distance(0.2) // 50)
    _set_window(drive, window)
    drive.ramps(_HARDER * pace.acceleration)
    drive.write(od.PROFILE_VELOCITY, _FASTER * pace.velocity)
    drive.offer(drive.read(od.POSITION) + 20 * pace.distance(0.5), od.IMMEDIATELY)
    return window


@drive_clause("FOL-02", Level.L2, source="CiA 402-2, 6065h, 6066h, statusword bit 13; EMCY 8611h")
def following_error_counts_on(bench: DriveBench) -> None:
    """New set-points do not put off bit 13, or the fault, of a motor beyond 6065h for 6066h."""
    drive = bench.drive
    drive.require(od.FOLLOWING_WINDOW, od.FOLLOWING_TIMEOUT, od.FOLLOWING_ERROR)
    drive.require_mode(Mode.PP)
    bench.require_stated("plant")
    plant, pace = bench.plant(), drive.pace()
    torque_n_m = plant["current_max_a"] * plant["torque_constant_n_m_a"] * plant["gear_ratio"]
    window = max(2, pace.distance(0.2) // 50)
    _set_window(drive, window, _LONG_MS)
    drive.enable(Mode.PP)
    target = drive.read(od.POSITION)
    bench.stimulate("load_torque_n_m", _TOO_MUCH * torque_n_m)
    lag = drive.watch(od.FOLLOWING_ERROR, lambda one: abs(one.value) > window, 1.0)
    beyond_ns = lag[-1].time_ns
    if abs(lag[-1].value) <= window:
        raise NotApplicable(f"60F4h stays within {window} under {_TOO_MUCH:g} times its torque")
    within_s, word = _LONG_MS / 1e3 + 0.1, 0
    while not word & od.BIT_13 and od.state_of(word) not in _FAULTS:
        seen_s = (drive.now_ns - beyond_ns) / 1e9
        what = f"|60F4h| > 6065h = {window}, 6066h = {_LONG_MS} ms, with a set-point each 50 ms"
        expected = f"bit 13 or a fault within {within_s:.2f} s"
        seen = f"6041h = {word:04X}h after {seen_s:.3f} s"
        drive.expect(seen_s <= within_s, what, expected, seen, "each set-point begins 6066h anew")
        drive.write(od.TARGET_POSITION, target)
        for bit in (od.NEW_SET_POINT, 0):  # without its handshake: the fault may come meanwhile
            drive.command(od.ENABLE | od.IMMEDIATELY | bit)
        word = drive.until(lambda one: bool(one & od.BIT_13), 0.05) or drive.statusword()
    bench.stimulate("load_torque_n_m", 0.0)


def _set_window(drive: Drive, window: int, timeout_ms: int = _TIMEOUT_MS) -> None:
    drive.set(od.FOLLOWING_TIMEOUT, timeout_ms)
    drive.set(od.FOLLOWING_WINDOW, window)


@drive_clause("LIM-01", Level.L2, source="CiA 402-2, 607Dh, statusword bit 11; EMCY 8612h")
def software_limits(bench: DriveBench) -> None:
    """No set-point moves the motor beyond 607Dh: it is clamped with bit 11, or refused."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.LIMIT_MIN, od.LIMIT_MAX)
    pace = drive.pace()
    start = drive.read(od.POSITION)
    way = pace.distance(0.2)
    offset = drive.find(od.HOME_OFFSET) or 0
    drive.set(od.LIMIT_MIN, start - way + offset)
    drive.set(od.LIMIT_MAX, start + way + offset)
    drive.enable(Mode.PP)
    for sign in (1, -1):
        target = start + sign * 3 * way
        limit = start + sign * way
        if drive.refusal(od.TARGET_POSITION.index, 0, target.to_bytes(4, "little", signed=True)):
            continue
        drive.command(od.ENABLE | od.IMMEDIATELY | od.NEW_SET_POINT)
        drive.quiet(0.01)
        words = [drive.statusword()]
        track = drive.watch(od.POSITION, lambda _: False, 6.0 * pace.ramp_s + 1.0)
        words.append(drive.statusword())
        drive.command(od.ENABLE)
        farthest = max(sign * (one.value - start) for one in track)
        drive.expect(
            farthest <= way + drive.window() + 0.01 * way,
            f"set-point {target} beyond 607Dh = {limit}",
            f"stopped at {limit} + 1 % (overshoot of the servo)",
            f"{start + sign * farthest}",
            "607Dh is not enforced",
        )
        is_told = any(word & od.INTERNAL_LIMIT for word in words)
        is_refused = farthest <= drive.window() or od.state_of(words[-1]) in _FAULTS
        drive.expect(
            is_told or is_refused,
            f"set-point {target} beyond 607Dh = {limit}",
            "bit 11 (internal limit active) = 1",
            f"6041h = {words[-1]:04X}h",
            "clamped without telling",
        )
        if od.state_of(words[-1]) in _FAULTS:
            drive.enable(Mode.PP)
