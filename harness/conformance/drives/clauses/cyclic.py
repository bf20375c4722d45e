"""Cyclic modes: csp, csv, cst and ip with SYNC; offsets, limits, halt, loss of SYNC."""

import struct
from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    SYNC_S,
    configure,
    operational,
    sync,
)
from motorhil.harness.conformance.drives.drive import STATE_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

_CSP: Final = "CiA 402-2, cyclic synchronous position mode"
_CSV: Final = "CiA 402-2, cyclic synchronous velocity mode"
_CST: Final = "CiA 402-2, cyclic synchronous torque mode"
_IP: Final = "CiA 402-2, interpolated position mode"
_PERIOD_MS: Final = round(SYNC_S * 1e3)
_ENABLE_IP: Final = 0x10
_PUSH: Final = 200  # of 60B2h [1/1000 of 6076h]
_COARSE_INC: Final = 4.0  # of a position unit
_OF_VENDOR: Final = 0xFF  # upper half of the error codes of a maker
_VENDOR_BITS: Final = 0x81  # of 1001h
_TORQUE_NOISE: Final = 15  # of 6077h [1/1000 of 6076h]


@drive_clause("CSP-01", Level.L4, source="CiA 402-2, cyclic synchronous position mode, 607Ah")
def cyclic_position(bench: DriveBench) -> None:
    """In csp, 607Ah by a synchronous RPDO moves the motor at SYNC; bits 12 and 13 tell so."""
    drive = bench.drive
    drive.require_mode(Mode.CSP)
    pace = drive.pace()
    identifier = configure(drive, 0x1400, (od.TARGET_POSITION,), 1)
    start = drive.read(od.POSITION)
    drive.write(od.TARGET_POSITION, start)
    operational(drive)
    drive.enable(Mode.CSP)
    target = float(start)
    for _ in range(50):
        sync(drive)
    word = drive.statusword()
    what, expected = "6041h in csp, at rest", "bits 12, 13 = 1, 0 (follows, no following error)"
    drive.expect(word & (od.BIT_12 | od.BIT_13) == od.BIT_12, what, expected, f"{word:04X}h")
    for _ in range(50):
        target += 0.25 * pace.speed * SYNC_S
        drive.client.send(identifier, struct.pack("<i", round(target)))
        sync(drive)
    drive.quiet(0.3)
    position, tolerance = (
        drive.read(od.POSITION),
        max(drive.window(), round(0.02 * (target - start))),
    )
    what, expected = "targets by RPDO and SYNC", f"{round(target)} +- {tolerance}"
    drive.expect(abs(position - target) <= tolerance, what, expected, f"{position}", "not followed")
    target += 0.25 * pace.speed * SYNC_S
    drive.client.send(identifier, struct.pack("<i", round(target)))
    drive.quiet(0.2)
    moved = abs(drive.read(od.POSITION) - position)
    step = round(0.25 * pace.speed * SYNC_S)
    drive.expect(
        moved <= step // 2 + 1,
        f"RPDO {identifier:03X}h with the next target, without SYNC",
        "no motion in 0.2 s",
        f"{moved} of {step}",
        "the target takes effect before SYNC",
    )


@drive_clause("CSP-08", Level.L4, source=f"{_CSP}: moves to 607Ah; 6060h, 6061h")
def cyclic_position_begins_at_rest(bench: DriveBench) -> None:
    """Selected while the motor turns, csp brings it to rest, if 607Ah stays as it is."""
    if bench.is_real:
        raise NotApplicable("a real motor might jump to 607Ah")
    bench.drive.rests_when_selected(Mode.CSP)


@drive_clause("CSV-01", Level.L4, source="CiA 402-2, cyclic synchronous velocity mode, 60FFh")
def cyclic_velocity(bench: DriveBench) -> None:
    """In csv, 60FFh by a synchronous RPDO takes effect at SYNC, in both directions."""
    drive = bench.drive
    drive.require_mode(Mode.CSV)
    pace = drive.pace()
    identifier = configure(drive, 0x1400, (od.TARGET_VELOCITY,), 1)
    drive.write(od.TARGET_VELOCITY, 0)
    operational(drive)
    drive.enable(Mode.CSV)
    for sign in (1, -1):
        velocity = 0
        for step in range(1, 21):
            velocity = sign * pace.velocity * step // 40
            drive.client.send(identifier, struct.pack("<i", velocity))
            sync(drive)
        drive.await_velocity(velocity, pace.ramp_s + 0.5)
        drive.client.send(identifier, struct.pack("<i", 0))
        drive.quiet(0.1)
        seen = drive.read(od.VELOCITY)
        drive.expect(
            abs(seen) > abs(velocity) // 2,
            f"RPDO {identifier:03X}h with 0, without SYNC",
            f"606Ch = {velocity} for 0.1 s",
            f"{seen}",
            "the target takes effect before SYNC",
        )
        sync(drive)
        drive.await_velocity(0, 2.0 * pace.ramp_s + 0.5)


class _Stream:
    """Targets of a cyclic mode, sent by a synchronous RPDO before each SYNC."""

    def __init__(self, bench: DriveBench, mode: Mode, entry: Entry, first: int) -> None:
        self.drive: Final = bench.drive
        self.pace: Final = self.drive.pace()
        self._code: Final = entry.code
        self._identifier: Final = configure(self.drive, 0x1400, (entry,), 1)
        self.drive.write(entry, first)
        operational(self.drive)
        self.drive.enable(mode)

    def send(self, target: float, cycles: int = 1) -> None:
        """Send a target in each of these cycles."""
        for _ in range(cycles):
            data = struct.pack(f"<{self._code}", round(target))
            self.drive.client.send(self._identifier, data)
            sync(self.drive)

    def line(self, begin: float, end: float, step: float) -> None:
        """Send targets from begin to end, a step apart."""
        count = max(1, round(abs(end - begin) / step))
        for place in range(1, count + 1):
            self.send(begin + (end - begin) * place / count)


def _position_stream(bench: DriveBench) -> tuple[_Stream, int, float]:
    """Return a stream in csp at rest, its position, and the step of a quarter of the speed."""
    drive = bench.drive
    drive.require_mode(Mode.CSP)
    start = drive.read(od.POSITION)
    drive.offer_value(od.PERIOD, _PERIOD_MS)
    stream = _Stream(bench, Mode.CSP, od.TARGET_POSITION, start)
    stream.send(start, 5)
    return stream, start, 0.25 * stream.pace.speed * SYNC_S


@drive_clause("CSP-02", Level.L4, source=f"{_CSP}, 60B0h, 60B1h, 60B2h; statusword bit 12")
def position_offset(bench: DriveBench) -> None:
    """In csp the position is 607Ah + 60B0h; 60B1h and 60B2h push it, and leave it as it is."""
    drive = bench.drive
    drive.require(od.POSITION_OFFSET, od.VELOCITY_OFFSET, od.POSITION_DEMAND, od.FOLLOWING_ERROR)
    stream, start, step = _position_stream(bench)
    hides_push = bench.is_real or drive.units().position_inc > _COARSE_INC
    offset = round(4 * step)
    for value in (offset // 2, offset, 0, -offset, 0):
        drive.write(od.POSITION_OFFSET, value)
        stream.send(start, 40)
        drive.near(od.POSITION, start + value, drive.window(), f"csp, 60B0h = {value}", "ignored")
    speed = round(step / SYNC_S / drive.units().velocity)
    for value in (speed, -speed, 0):
        drive.write(od.VELOCITY_OFFSET, value)
        stream.send(start, 40)
        moved = drive.read(od.POSITION) - start
        least = 0 if hides_push or not value else drive.window()
        most = max(drive.window(), 10.0 * step)
        is_pushed = least <= moved * (1 if value >= 0 else -1) <= most
        what, cause = f"csp at rest, 60B1h = {value}", "60B1h is ignored, or has the other sign"
        error = drive.read(od.POSITION_DEMAND) - drive.read(od.POSITION)
        drive.near(od.FOLLOWING_ERROR, error, 4, f"{what}: 6062h - 6064h", "another sign or unit")
        if value:
            expected = f"{least} to {most:.0f} in its direction"
            drive.expect(is_pushed, what, expected, f"{moved}", cause)
        else:
            drive.near(od.POSITION, start, drive.window(), what)
    if drive.find(od.TORQUE_OFFSET) is None or hides_push:
        return
    for before, torque in pairwise((0, _PUSH, 0, -_PUSH, 0)):
        drive.write(od.TORQUE_OFFSET, torque)
        track = drive.watch(od.POSITION, lambda one: abs(one.value - start) > 1, 5.0 * SYNC_S)
        pushed = track[-1].value - start
        what = f"csp at rest, 60B2h = {torque} after {before}"
        is_pushed, cause = pushed * (torque - before) > 0, "60B2h is ignored, or has the other sign"
        drive.expect(is_pushed, what, "a push in the direction of the change", f"{pushed}", cause)
        stream.send(start, 40)
        drive.near(od.POSITION, start, drive.window(), f"{what}, later")


@drive_clause("CSP-03", Level.L4, source=f"{_CSP}, 607Dh; statusword bits 11 and 12")
def position_limits_in_csp(bench: DriveBench) -> None:
    """A target of csp beyond 607Dh stops at it, with bits 11, 12 = 1, 0 until it is back."""
    drive = bench.drive
    drive.require(od.LIMIT_MIN, od.LIMIT_MAX)
    stream, start, step = _position_stream(bench)
    way, home = round(20 * step), drive.find(od.HOME_OFFSET) or 0
    drive.set(od.LIMIT_MIN, start - way + home)
    drive.set(od.LIMIT_MAX, start + way + home)
    place = float(start)
    for sign in (1, -1):
        stream.line(place, start + sign * 30 * step, step)
        place = start + sign * 30 * step
        stream.send(place, 10)
        word = drive.statusword()
        what = f"607Ah = {place:.0f} beyond 607Dh = {start + sign * way}"
        if od.state_of(word) is not State.OPERATION_ENABLED:
            return
        drive.near(od.POSITION, start + sign * way, drive.window(), what, "607Dh is ignored")
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        drive.expect(bits == od.INTERNAL_LIMIT, what, "bits 11, 12 = 1, 0", f"{word:04X}h")
    stream.line(place, start, step)
    stream.send(start, 10)
    word = drive.statusword()
    bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
    drive.expect(bits == od.BIT_12, "back within 607Dh", "bits 11, 12 = 0, 1", f"{word:04X}h")


@drive_clause("CSP-04", Level.L4, source=f"{_CSP}, controlword bit 8; statusword bit 12")
def halt_in_csp(bench: DriveBench) -> None:
    """In csp, halt stops the motor with bit 12 = 0; without halt it follows the next target."""
    drive = bench.drive
    stream, start, step = _position_stream(bench)
    stream.line(start, start + 40 * step, step)
    drive.command(od.ENABLE | od.HALT)
    stream.send(start + 41 * step, 20 + round(stream.pace.ramp_s / SYNC_S))
    place = drive.read(od.POSITION)
    most = 40 * step + 0.6 * stream.pace.ramp_s * stream.pace.speed
    what = f"halt at {start + 40 * step:.0f} in csp"
    drive.expect(place <= start + most, what, f"rest before {start + most:.0f}", f"{place}")
    word = drive.statusword()
    drive.expect(not word & od.BIT_12, what, "bit 12 = 0", f"{word:04X}h")
    stream.send(place + 10 * step, 10)
    drive.near(od.POSITION, place, drive.window(), f"{what}, next targets", "halt is ignored")
    drive.command(od.ENABLE)
    stream.send(place, 20)
    stream.line(place, place + 20 * step, step)
    stream.send(place + 20 * step, 10)
    drive.near(od.POSITION, place + 20 * step, drive.window(), "halt ended in csp", "halt stays")
    word = drive.statusword()
    drive.expect(bool(word & od.BIT_12), "halt ended in csp", "bit 12 = 1", f"{word:04X}h")


@drive_clause("CSP-05", Level.L4, source=f"{_CSP}, 607Fh, 60C2h; statusword bits 11 and 12")
def speed_limit_in_csp(bench: DriveBench) -> None:
    """A target of csp that is too far for 607Fh is followed no faster, or is a fault."""
    drive = bench.drive
    drive.require(od.VELOCITY_MAX)
    stream, start, _ = _position_stream(bench)
    pace = stream.pace
    limit = max(1, pace.velocity // 4)
    drive.set(od.VELOCITY_MAX, limit)
    most = limit * drive.units().velocity
    end = float(start)
    for sign in (1, -1):
        begin_ns, begin = drive.now_ns, drive.read(od.POSITION)
        stream.line(end, end + sign * 40 * most * SYNC_S, 2.0 * most * SYNC_S)
        rate = abs(drive.read(od.POSITION) - begin) / (drive.now_ns - begin_ns) * 1e9
        end += sign * 40 * most * SYNC_S
        word = drive.statusword()
        if od.state_of(word) is not State.OPERATION_ENABLED:
            return
        what = f"607Ah at twice 607Fh = {limit}"
        least = 0.2 * most if bench.is_real else 0.7 * most  # SYNC is late in wall time
        expected = f"{least:.0f} to {1.1 * most:.0f} position units/s"
        is_limited = least <= rate <= 1.1 * most
        drive.expect(is_limited, what, expected, f"{rate:.0f}", "607Fh is ignored in csp")
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        drive.expect(bits == od.INTERNAL_LIMIT, what, "bits 11, 12 = 1, 0", f"{word:04X}h")
        stream.send(end, 60)
        drive.near(od.POSITION, end, drive.window(), what, "the target is lost")
        word = drive.statusword()
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        drive.expect(bits == od.BIT_12, f"{what}, reached", "bits 11, 12 = 0, 1", f"{word:04X}h")


@drive_clause("CSP-06", Level.L4, source=f"{_CSP}, 60C2h")
def interpolation_period(bench: DriveBench) -> None:
    """In csp a target is reached after 60C2h, linearly; without 60C2h after the SYNC period."""
    drive = bench.drive
    drive.require(od.PERIOD, od.PERIOD_INDEX, od.POSITION_DEMAND)
    stream, start, step = _position_stream(bench)
    place = float(start)
    for writes, time_s in (
        (((od.PERIOD_INDEX, -2), (od.PERIOD, 5)), 0.05),
        (((od.PERIOD, 50), (od.PERIOD_INDEX, -3)), 0.05),
        (((od.PERIOD, 0),), SYNC_S),
    ):
        if any(drive.offer_value(entry, value) for entry, value in writes):
            continue
        stream.send(place, 10)
        place += 4.0 * step
        begin_ns = drive.now_ns
        stream.send(place)
        last = round(place) - 1  # rounded twice
        track = drive.watch_to(od.POSITION_DEMAND, last, 0.2)
        took_s = (track[-1].time_ns - begin_ns) / 1e9
        what = f"607Ah = {place:.0f}, 60C2h = {drive.read(od.PERIOD)}"
        expected = f"6062h there after {time_s:.3f} s +- 5 ms"
        is_there = track[-1].value >= last and abs(took_s - time_s) <= 0.005 + stream.pace.sample_s
        seen = f"{track[-1].value}, {took_s:.4f} s"
        drive.expect(is_there or took_s < SYNC_S + 0.005 >= time_s, what, expected, seen, "ignored")


@drive_clause("CSP-07", Level.L4, source=f"{_CSP}, position range limit 607Bh")
def range_in_csp(bench: DriveBench) -> None:
    """In csp, targets that pass an end of the range 607Bh go on at its other end, both ways."""
    drive = bench.drive
    drive.require_mode(Mode.CSP)
    drive.require(od.RANGE_MIN, od.RANGE_MAX)
    step = 0.25 * drive.pace().speed * SYNC_S
    size, start = 2 * round(20 * step), drive.read(od.POSITION)
    low = start - size // 2
    drive.set(od.RANGE_MIN, low)
    drive.set(od.RANGE_MAX, low + size - 1)
    stream, start, _ = _position_stream(bench)
    place = 0
    for sign in (1, -1):
        for _ in range(30):
            place += sign
            stream.send(low + (start - low + round(place * step)) % size)
        velocity = drive.read(od.VELOCITY)
        target = low + (start - low + round(place * step)) % size
        what = f"csp, 607Bh = {low}..{low + size - 1}, past its end in direction {sign}"
        expected, cause = f"606Ch in direction {sign}, no faster", "the long way round"
        most = drive.pace().velocity // 2
        drive.expect(0 < sign * velocity <= most, what, expected, f"{velocity}", cause)
        stream.send(target, 20)
        away = (drive.read(od.POSITION) - target + size // 2) % size - size // 2
        drive.expect(abs(away) <= drive.window(), what, f"6064h = {target}", f"{away} beside it")


@drive_clause("CSV-02", Level.L4, source=f"{_CSV}, 60B1h, 607Fh, controlword bit 8")
def velocity_offset(bench: DriveBench) -> None:
    """In csv the velocity is 60FFh + 60B1h, up to 607Fh with bits 11, 12 = 1, 0; halt stops it."""
    drive = bench.drive
    drive.require_mode(Mode.CSV)
    drive.require(od.VELOCITY_OFFSET, od.VELOCITY_MAX)
    stream = _Stream(bench, Mode.CSV, od.TARGET_VELOCITY, 0)
    pace = stream.pace
    half, slack = pace.velocity // 2, 1 + pace.velocity // 20
    for target, offset in ((half, half // 2), (-half, -half // 2), (-half, half // 2), (0, 0)):
        drive.write(od.VELOCITY_OFFSET, offset)
        stream.line(drive.read(od.VELOCITY), target, pace.velocity / 40)
        stream.send(target, 20)
        what = f"csv, 60FFh = {target}, 60B1h = {offset}"
        drive.near(od.VELOCITY, target + offset, slack, what, "60B1h is ignored")
        word = drive.statusword()
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        drive.expect(bits == od.BIT_12, what, "bits 11, 12 = 0, 1", f"{word:04X}h")
    drive.set(od.VELOCITY_MAX, half)
    for sign in (1, -1):
        stream.line(drive.read(od.VELOCITY), sign * pace.velocity, pace.velocity / 40)
        stream.send(sign * pace.velocity, 20)
        what = f"csv, 60FFh = {sign * pace.velocity}, 607Fh = {half}"
        drive.near(od.VELOCITY, sign * half, slack, what, "607Fh is ignored")
        word = drive.statusword()
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        drive.expect(bits == od.INTERNAL_LIMIT, what, "bits 11, 12 = 1, 0", f"{word:04X}h")
    drive.command(od.ENABLE | od.HALT)
    drive.braked(half, 3.0 * pace.ramp_s + 0.5, "halt in csv")
    stream.send(half // 2, 10)
    drive.near(od.VELOCITY, 0, slack, "halt in csv", "halt is ignored")
    drive.command(od.ENABLE)
    stream.send(half // 2, 20)
    drive.near(od.VELOCITY, half // 2, slack, "halt ended in csv", "halt stays")


@drive_clause("CST-01", Level.L4, source=f"{_CST}, 6071h, 60B2h, 6072h, controlword bit 8")
def cyclic_torque(bench: DriveBench) -> None:
    """In cst, 6071h by a synchronous RPDO plus 60B2h is the torque 6077h, within 6072h."""
    drive = bench.drive
    drive.require_mode(Mode.CST)
    drive.require(od.TARGET_TORQUE, od.TORQUE, od.TORQUE_OFFSET, od.TORQUE_MAX)
    if bench.is_real:
        raise NotApplicable("a free motor would race: torque modes are tried on emulated benches")
    stream = _Stream(bench, Mode.CST, od.TARGET_TORQUE, 0)
    pace, torque = stream.pace, min(4 * _TORQUE_NOISE, drive.read(od.TORQUE_MAX) // 3)
    if torque < 2 * _TORQUE_NOISE:
        raise NotApplicable(f"6072h = {3 * torque}: too little torque to be judged")
    for target, offset, most in (
        (torque, 0, None),
        (-torque, 0, None),
        (torque, torque, None),
        (-torque, -torque, None),
        (0, torque // 2, None),
        (-torque, 0, torque // 2),
    ):
        if most is not None and most > 4:  # less is a value that no host has set
            drive.set(od.TORQUE_MAX, most)
        drive.write(od.TORQUE_OFFSET, offset)
        stream.send(target, 4)
        speed = drive.read(od.VELOCITY)
        what = f"cst, 6071h = {target}, 60B2h = {offset}, 6072h = {most}"
        wanted = target + offset if most is None else -most
        drive.near(od.TORQUE, wanted, _TORQUE_NOISE, what, "an object is ignored")
        word = drive.statusword()
        bits = word & (od.INTERNAL_LIMIT | od.BIT_12)
        expected = od.BIT_12 if most is None else od.INTERNAL_LIMIT
        drive.expect(bits == expected, what, f"bits 11, 12: {expected:04X}h", f"{word:04X}h")
        stream.send(target, 2)
        gained = drive.read(od.VELOCITY) - speed
        is_gained = gained * wanted > 0 or abs(wanted) < torque
        drive.expect(is_gained, what, "speed gained with its sign", f"{gained}")
    drive.write(od.TORQUE_OFFSET, 0)
    drive.command(od.ENABLE | od.HALT)
    stream.send(torque // 2, 30 + round(4.0 * pace.ramp_s / SYNC_S))
    drive.near(od.VELOCITY, 0, 1 + pace.velocity // 20, "halt in cst", "halt is ignored")
    word = drive.statusword()
    drive.expect(not word & od.BIT_12, "halt in cst", "bit 12 = 0", f"{word:04X}h")
    drive.command(od.ENABLE)
    stream.send(torque // 2, 4)
    drive.near(od.TORQUE, torque // 2, _TORQUE_NOISE, "halt ended in cst", "halt stays")
    drive.command(od.DISABLE_VOLTAGE)
    _expect_no_kick(drive)


def _expect_no_kick(drive: Drive) -> None:
    """Expect no torque from the begin of cst on, if 6071h is 0; 60C2h is the time of its ramp."""
    drive.offer_value(od.PERIOD, 3 * _PERIOD_MS)
    drive.write(od.TARGET_TORQUE, 0)
    drive.enable(Mode.CST)
    track = drive.watch(od.TORQUE, lambda _: False, 2.0 * SYNC_S)
    most = max((one.value for one in track), key=abs)
    what = "6077h after cst is enabled with 6071h = 0"
    expected, cause = f"0 +- {_TORQUE_NOISE}", "its first ramp begins at another torque"
    drive.expect(abs(most) <= _TORQUE_NOISE, what, expected, f"{most}", cause)


@drive_clause("CYC-01", Level.L5, source="The rig: cyclic.sync_lost_periods; CiA 402-2, 60C2h")
def sync_is_lost(bench: DriveBench) -> None:
    """SYNC that is absent for the stated number of periods is the stated fault, no sooner."""
    drive = bench.drive
    bench.require_stated("cyclic", "sync_lost_periods")
    periods = bench.stated["cyclic"]["sync_lost_periods"]
    code = bench.stated["cyclic"].get("sync_lost_code", 0xFF64)
    drive.require(od.PERIOD, od.PERIOD_INDEX)
    drive.set(od.PERIOD_INDEX, -3)
    drive.set(od.PERIOD, 4 * _PERIOD_MS)
    period_s = 4.0 * SYNC_S
    for mode in (Mode.CSP, Mode.CSV, Mode.CST, Mode.IP):
        if not drive.has_mode(mode):
            continue
        drive.write(od.TARGET_POSITION, drive.read(od.POSITION))
        drive.write(od.TARGET_VELOCITY, 0)
        operational(drive)
        drive.enable(mode)
        what = f"{mode}, before the first SYNC"
        drive.quiet(2.0 * periods * period_s)
        _expect_enabled(drive, what)
        for _ in range(4):
            sync(drive)
            drive.quiet((periods - 0.5) * period_s)
            _expect_enabled(drive, f"{mode}, SYNC absent for {periods - 0.5:g} periods")
        begin_ns = drive.now_ns
        sync(drive)
        what = f"{mode}, SYNC absent for {periods} periods"
        frame = drive.await_emergency(code, begin_ns, what, (periods + 0.5) * period_s)
        if code >> 8 == _OF_VENDOR:
            expected = f"{_VENDOR_BITS:02X}h: a generic error, and one of its maker"
            register = frame.data[2]
            is_told = register & _VENDOR_BITS == _VENDOR_BITS
            drive.expect(is_told, f"1001h of {code:04X}h", expected, f"{register:02X}h")
        drive.await_state(State.FAULT, what, "the stated fault")
        drive.enable(mode)
        sync(drive)
        drive.enable(Mode.PP)
        drive.quiet(2.0 * periods * period_s)
        _expect_enabled(drive, f"pp after {mode}, without SYNC")


def _expect_enabled(drive: Drive, what: str) -> None:
    state = drive.state()
    drive.expect(state is State.OPERATION_ENABLED, what, "operation enabled", f"{state}")


@drive_clause("CYC-02", Level.L5, source="CiA 402-2, cyclic synchronous modes; 60C2h")
def sync_may_be_absent(bench: DriveBench) -> None:
    """A drive whose rig states no monitoring of SYNC stays enabled without SYNC, at rest."""
    drive = bench.drive
    if bench.stated.get("cyclic", {}).get("sync_lost_periods"):
        raise NotApplicable("the rig states that lost SYNC is a fault: see CYC-01")
    stream, start, step = _position_stream(bench)
    stream.line(start, start + 4 * step, step)
    drive.quiet(1.0)
    place = drive.read(od.POSITION)
    state = drive.state()
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        raise NotApplicable("lost SYNC is a fault of this drive: state cyclic.sync_lost_periods")
    drive.expect(state is State.OPERATION_ENABLED, "1 s without SYNC", "enabled", f"{state}")
    drive.quiet(0.2)
    drive.near(od.POSITION, place, drive.window(), "1 s without SYNC", "the motor runs on")


def _let_pass(drive: Drive, has_sync: bool) -> None:
    """Let 20 periods pass, with SYNC or without."""
    for _ in range(20):
        if has_sync:
            sync(drive)
        else:
            drive.quiet(SYNC_S)


def _empty_buffer(drive: Drive) -> None:
    """Make 60C4h a FIFO of 16 records, which some files do not."""
    for entry, value in ((od.IP_ORGANISATION, 0), (od.IP_SIZE, 16), (od.IP_CLEAR, 1)):
        drive.offer_value(entry, value)


@drive_clause("IP-01", Level.L4, source=f"{_IP}, 60C1h:1, 60C2h, controlword bit 4")
def interpolated_position(bench: DriveBench) -> None:
    """In ip with bit 4 = 1, one record is reached in each 60C2h, in order, and bit 12 is 1."""
    drive = bench.drive
    drive.require_mode(Mode.IP)
    drive.require(od.IP_RECORD, od.PERIOD, od.PERIOD_INDEX)
    _empty_buffer(drive)
    pace = drive.pace()
    drive.set(od.PERIOD_INDEX, -3)
    drive.set(od.PERIOD, _PERIOD_MS)
    start = drive.read(od.POSITION)
    step = 0.25 * pace.speed * SYNC_S
    operational(drive)
    drive.enable_at_rest(Mode.IP, 2.0 * pace.ramp_s)
    for has_sync in (False, True):
        start = drive.read(od.POSITION)
        word = drive.statusword()
        drive.expect(not word & od.BIT_12, "ip, bit 4 = 0", "bit 12 = 0", f"{word:04X}h")
        for place in range(1, 9):
            drive.write(od.IP_RECORD, round(start + place * step))
        drive.quiet(0.05)
        what = f"ip, records written, {'with' if has_sync else 'without'} SYNC"
        drive.near(od.POSITION, start, drive.window(), f"{what}, bit 4 = 0", "records are taken")
        drive.command(od.ENABLE | _ENABLE_IP)
        begin_ns = drive.now_ns
        word = drive.statusword()
        drive.expect(bool(word & od.BIT_12), what, "bit 12 = 1", f"{word:04X}h")
        drive.expect(not word & od.TARGET_REACHED, what, "bit 10 = 0", f"{word:04X}h")
        for _ in range(12 if has_sync else 0):
            sync(drive)
        last = round(start + 8 * step)
        if not has_sync:
            track = drive.watch_to(od.POSITION_DEMAND, last - 1, 1.0)
            took_s = (track[-1].time_ns - begin_ns) / 1e9
            expected, seen = f"{last} after {8 * SYNC_S:.3f} s +- 8 ms", f"{took_s:.4f} s"
            slack_s = 0.008 + 2.0 * pace.sample_s + (0.02 if bench.is_real else 0.0)
            is_paced = abs(track[-1].value - last) <= 1 and abs(took_s - 8 * SYNC_S) <= slack_s
            drive.expect(is_paced, what, expected, seen, "60C2h is not the pace")
        reached = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        drive.expect(reached is not None, what, "bit 10 = 1 in the end", "0")
        word = drive.statusword()
        drive.expect(not word & od.INTERNAL_LIMIT, what, "bit 11 = 0", f"{word:04X}h")
        _let_pass(drive, has_sync)
        drive.near(od.POSITION, last, drive.window(), what, "a record is lost")
        for place in range(1, 3):  # a running interpolation goes on with the next records
            drive.write(od.IP_RECORD, round(last + place * step))
            if has_sync:
                sync(drive)
        _let_pass(drive, has_sync)
        drive.near(od.POSITION, last + 2 * step, drive.window(), f"{what}, two more", "ip ended")
        drive.command(od.ENABLE)


@drive_clause("IP-02", Level.L4, source=f"{_IP}, controlword bits 4 and 8")
def interpolation_is_halted(bench: DriveBench) -> None:
    """In ip, bit 4 = 0 or halt stops the motor on its ramp; the records wait until it goes on."""
    drive = bench.drive
    drive.require_mode(Mode.IP)
    drive.require(od.IP_RECORD, od.PERIOD, od.PERIOD_INDEX)
    _empty_buffer(drive)
    pace = drive.pace()
    drive.set(od.PERIOD_INDEX, -3)
    drive.set(od.PERIOD, 5 * _PERIOD_MS)
    drive.enable(Mode.IP)
    step = 1.25 * pace.speed * SYNC_S
    for word in (od.ENABLE, od.ENABLE | _ENABLE_IP | od.HALT):
        start = drive.read(od.POSITION)
        for place in range(1, 9):
            drive.write(od.IP_RECORD, round(start + place * step))
        drive.command(od.ENABLE | _ENABLE_IP)
        drive.quiet(0.12)
        drive.command(word)
        drive.quiet(0.1 + pace.ramp_s)
        seen = drive.statusword()
        what = f"ip, controlword {word:04X}h"
        drive.expect(not seen & od.BIT_12, what, "bit 12 = 0", f"{seen:04X}h")
        if word & od.HALT:
            halted = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
            drive.expect(halted is not None, what, "bit 10 = 1 (velocity is 0)", "0")
        place = drive.read(od.POSITION)
        moved = start < place < start + 6 * step
        drive.expect(moved, what, f"rest within {start}..{start + 6 * step:.0f}", f"{place}")
        drive.quiet(0.2)
        drive.near(od.POSITION, place, drive.window(), what, "it goes on")
        drive.command(od.ENABLE | _ENABLE_IP)
        drive.quiet(0.5)
        drive.near(od.POSITION, start + 8 * step, drive.window(), "ip goes on", "records are lost")
        drive.command(od.ENABLE)


@drive_clause("IP-03", Level.L4, source=f"{_IP}, 60C4h: buffer size, organisation, clear")
def interpolation_buffer(bench: DriveBench) -> None:
    """The buffer takes 60C4h:2 records; a full FIFO refuses more, a ring drops the oldest."""
    drive = bench.drive
    drive.require_mode(Mode.IP)
    drive.require(od.IP_RECORD, od.IP_SIZE, od.IP_ORGANISATION)
    _empty_buffer(drive)
    pace = drive.pace()
    for entry in (od.PERIOD, od.PERIOD_INDEX):
        drive.set(entry, _PERIOD_MS if entry is od.PERIOD else -3)
    drive.enable(Mode.IP)
    drive.set(od.IP_SIZE, 4)
    step = 0.1 * pace.speed * SYNC_S
    for is_ring in (0, 1):
        drive.set(od.IP_ORGANISATION, is_ring)
        start = drive.read(od.POSITION)
        codes = [drive.offer_value(od.IP_RECORD, round(start + n * step)) for n in range(1, 6)]
        seen = [bool(code) for code in codes]
        wanted = [False] * 4 + [not is_ring]
        what = f"5 records in a buffer of 4, 60C4h:3 = {is_ring}"
        cause = "60C4h:2 or 60C4h:3 is ignored, or the records are used before bit 4 is set"
        drive.expect(seen == wanted, what, f"refused: {wanted}", f"{seen}", cause)
        count = drive.find(od.IP_POSITION)
        drive.expect(count in (4, None), what, f"{od.IP_POSITION} = 4", f"{count}")
        drive.command(od.ENABLE | _ENABLE_IP)
        drive.quiet(0.3)
        drive.near(od.POSITION, start + (4 + is_ring) * step, drive.window(), what, "wrong records")
        drive.command(od.ENABLE)
    start = drive.read(od.POSITION)
    drive.write(od.IP_RECORD, round(start + step))
    drive.write(od.IP_CLEAR, 0)
    refused = drive.offer_value(od.IP_RECORD, round(start + step))
    drive.expect(refused != 0, "60C4h:6 = 0", "records are refused", "accepted")
    drive.write(od.IP_CLEAR, 1)
    drive.command(od.ENABLE | _ENABLE_IP)
    drive.quiet(0.1)
    drive.near(od.POSITION, start, drive.window(), "60C4h:6 = 0, then 1", "records are kept")
    drive.command(od.ENABLE)
    most = drive.find(Entry(0x60C4, 1, "I", "maximum buffer size"))
    if most is not None and most > 4:  # less is a value that no host has set
        for wrong in (0, most + 1):
            code = drive.offer_value(od.IP_SIZE, wrong)
            drive.expect(code != 0, f"60C4h:2 = {wrong}", "an abort code", "accepted")
        drive.write(od.IP_SIZE, most)


@drive_clause("IP-05", Level.L4, source=f"{_IP}, interpolation sub mode select 60C0h")
def sub_mode_is_known(bench: DriveBench) -> None:
    """60C0h is 0 (linear) or negative (of the maker) at power-on; the others are reserved."""
    drive = bench.drive
    drive.require_mode(Mode.IP)
    drive.require(od.IP_SUB_MODE)
    mode = drive.read(od.IP_SUB_MODE)
    drive.expect(mode <= 0, f"{od.IP_SUB_MODE}", "0 or negative", f"{mode}", "a reserved one")


@drive_clause("IP-04", Level.L4, source=f"{_IP}, 607Dh; statusword bit 11")
def position_limits_in_ip(bench: DriveBench) -> None:
    """A record of ip beyond 607Dh stops at it with bit 11 = 1, is refused, or is a fault."""
    drive = bench.drive
    drive.require_mode(Mode.IP)
    drive.require(od.IP_RECORD, od.PERIOD, od.PERIOD_INDEX, od.LIMIT_MIN, od.LIMIT_MAX)
    _empty_buffer(drive)
    pace = drive.pace()
    drive.set(od.PERIOD_INDEX, -3)
    drive.set(od.PERIOD, 5 * _PERIOD_MS)
    start, home = drive.read(od.POSITION), drive.find(od.HOME_OFFSET) or 0
    step = round(1.25 * pace.speed * SYNC_S)
    drive.set(od.LIMIT_MIN, start - 2 * step + home)
    drive.set(od.LIMIT_MAX, start + 2 * step + home)
    drive.enable(Mode.IP)
    for sign in (1, -1):
        begin = drive.read(od.POSITION)
        end = start + sign * 3 * step
        count = max(1, round(abs(end - begin) / step))
        drive.command(od.ENABLE | _ENABLE_IP)
        for place in range(1, count + 1):
            record = round(begin + (end - begin) * place / count)
            if drive.offer_value(od.IP_RECORD, record):
                return
        drive.quiet(5.0 * SYNC_S * (count + 2) + 0.3)
        word = drive.statusword()
        if od.state_of(word) is not State.OPERATION_ENABLED:
            return
        what = f"60C1h:1 = {end} beyond 607Dh = {start + sign * 2 * step}"
        drive.near(od.POSITION, start + sign * 2 * step, drive.window(), what, "607Dh is ignored")
        drive.expect(bool(word & od.INTERNAL_LIMIT), what, "bit 11 = 1", f"{word:04X}h")
        drive.command(od.ENABLE)
