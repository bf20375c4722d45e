"""Torque: profile torque mode, torque and speed limits, slippage, torque and current values."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable, Violated
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace, slope
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode

_TQ: Final = "CiA 402-2 / IEC 61800-7-201, profile torque mode"
_LIMITS: Final = "CiA 402-2, 6072h, 6073h, 60E0h, 60E1h, 6077h"
_RAMP_S: Final = 0.2
_HARDER: Final = 4
_RPM_MAX: Final = 100_000
_NOISE: Final = 15  # of 6077h [1/1000 of 6076h]


def _start(bench: DriveBench, mode: Mode) -> tuple[Drive, Pace, int]:
    """Return the drive at rest in a torque mode, its pace, and a torque that it can bear."""
    drive = bench.drive
    drive.require_mode(mode)
    drive.require(od.TARGET_TORQUE, od.TORQUE)
    if bench.is_real:
        raise NotApplicable("a free motor would race: torque modes are tried on emulated benches")
    pace = drive.pace()
    torque = _peaks(drive, pace)[0]
    drive.command(od.DISABLE_VOLTAGE)
    drive.write(od.TARGET_TORQUE, 0)
    drive.enable(mode)
    return drive, pace, torque


def _longest_s(pace: Pace) -> float:
    return 40.0 * pace.ramp_s + 5.0


def _peaks(drive: Drive, pace: Pace, *, is_limited: bool = False) -> tuple[int, int]:
    """Return the torques of speeding up and of slowing down in pv [1/1000 of 6076h].

    Raises:
        NotApplicable: they are limited, and the motor does not reach its speed against its load.
    """
    drive.require_mode(Mode.PV)
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    found = []
    for velocity in (pace.velocity, 0):
        drive.write(od.TARGET_VELOCITY, velocity)
        track = drive.watch(od.TORQUE, lambda _: False, 2.0 * pace.ramp_s)
        try:
            drive.await_velocity(velocity, 8.0 * pace.ramp_s + STATE_S)
        except Violated:
            if not is_limited:
                raise
            raise NotApplicable("with half of its torque its load holds the motor back") from None
        torques = [one.value for one in track]
        found.append(max(torques) if velocity else -min(torques))
    return found[0], found[1]


@drive_clause("TQ-01", Level.L1, source=f"{_TQ}, 6071h, 6074h, 6077h, 6087h, statusword bit 10")
def torque_is_reached(bench: DriveBench) -> None:
    """6074h goes to 6071h on the ramp 6087h, 6077h follows, and bit 10 is set; in both ways."""
    drive, pace, torque = _start(bench, Mode.TQ)
    drive.require(od.TORQUE_DEMAND, od.TORQUE_SLOPE)
    ramp = max(1, round(torque / _RAMP_S))
    drive.write(od.TORQUE_SLOPE, ramp)
    for target in (torque, -torque, 0):
        before = drive.read(od.TORQUE_DEMAND)
        speed = drive.read(od.VELOCITY)
        drive.write(od.TARGET_TORQUE, target)
        word = drive.statusword()
        what = f"6071h = {target}"
        drive.expect(not word & od.TARGET_REACHED, what, "bit 10 = 0 at first", f"{word:04X}h")
        way = 1 if target > before else -1
        track = drive.watch_to(od.TORQUE_DEMAND, target, 4.0 * _RAMP_S, sign=way)
        low, high = sorted((before, target))
        part = [one for one in track if low + 3 < one.value < high - 3]
        found = slope(part) if len(part) > 3 else 0.0
        drive.expect(
            0.9 * ramp <= found <= 1.1 * ramp and track[-1].value == target,
            what,
            f"6074h = {target} at 6087h = {ramp} per second +- 10 %",
            f"{track[-1].value}, {found:.0f} per second",
            "6087h is ignored",
        )
        drive.near(od.TORQUE, target, _NOISE, what, "6077h does not follow 6074h")
        reached = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        drive.expect(reached is not None, what, "bit 10 = 1", f"{drive.statusword():04X}h")
        gained = drive.read(od.VELOCITY) - speed
        if target == torque:
            expected = "606Ch grows with a positive torque"
            drive.expect(gained > pace.velocity // 100, what, expected, f"{gained}", "wrong sign")


@drive_clause("TQ-02", Level.L2, source=f"{_TQ}, 6080h, 6072h, statusword bit 11")
def torque_mode_has_limits(bench: DriveBench) -> None:
    """In tq, 6080h limits the speed in both directions; 6072h limits the torque, with bit 11."""
    drive, pace, torque = _start(bench, Mode.TQ)
    drive.require(od.MOTOR_SPEED_MAX, od.TORQUE_MAX)
    turn = drive.turn()
    limit_rpm = max(1, round(pace.speed / 2.0 / turn * 60.0))
    if limit_rpm > _RPM_MAX:
        raise NotApplicable(f"608Fh: 6081h would be {2 * limit_rpm} rpm of the motor")
    limit = limit_rpm * turn / 60.0 / drive.units().velocity
    own_rpm = drive.read(od.MOTOR_SPEED_MAX)
    for sign in (1, -1):
        drive.set(od.MOTOR_SPEED_MAX, own_rpm)  # a lower limit can cut the torque before it
        drive.write(od.TARGET_TORQUE, sign * torque)
        drive.quiet(0.01)
        word = drive.statusword()
        what = f"6071h = {sign * torque} below 6072h"
        drive.expect(not word & od.INTERNAL_LIMIT, what, "bit 11 = 0", f"{word:04X}h")
        drive.set(od.MOTOR_SPEED_MAX, limit_rpm)
        drive.watch_to(od.VELOCITY, round(sign * 0.95 * limit), _longest_s(pace), sign=sign)
        drive.quiet(pace.ramp_s)
        what = f"6071h = {sign * torque}, 6080h = {limit_rpm} rpm"
        velocity = sign * drive.read(od.VELOCITY)
        if velocity < 0.9 * limit and not drive.statusword() & od.INTERNAL_LIMIT:
            raise NotApplicable(f"{what}: friction keeps the motor at 606Ch = {velocity}")
        drive.near(od.VELOCITY, sign * limit, 0.1 * limit, what, "6080h is ignored in tq")
        word = drive.statusword()
        drive.expect(bool(word & od.INTERNAL_LIMIT), what, "bit 11 = 1", f"{word:04X}h")
    if torque < 4 * _NOISE:
        return  # half of it could not be told from noise
    drive.write(od.TARGET_TORQUE, 0)
    drive.set(od.MOTOR_SPEED_MAX, 8 * limit_rpm)
    drive.set(od.TORQUE_MAX, torque // 2)
    drive.write(od.TARGET_TORQUE, torque)
    drive.quiet(0.1)
    what = f"6071h = {torque}, 6072h = {torque // 2}"
    drive.near(od.TORQUE, torque // 2, _NOISE, what, "6072h is ignored in tq")
    word = drive.statusword()
    drive.expect(bool(word & od.INTERNAL_LIMIT), what, "bit 11 = 1", f"{word:04X}h")


@drive_clause("TQ-03", Level.L2, source=f"{_TQ}, controlword bit 8; 605Dh")
def torque_mode_halts(bench: DriveBench) -> None:
    """In tq, halt brings the motor to rest and sets bit 10; without halt it has torque again."""
    drive, pace, torque = _start(bench, Mode.TQ)
    drive.write(od.TARGET_TORQUE, torque)
    for _ in range(2):
        drive.watch_to(od.VELOCITY, pace.velocity // 2 + 1, _longest_s(pace))
        velocity = drive.read(od.VELOCITY)
        if velocity <= pace.velocity // 4:
            raise NotApplicable(f"6071h = {torque}: the motor turns at {velocity} only")
        drive.command(od.ENABLE | od.HALT)
        begin_ns = drive.now_ns
        drive.braked(velocity, 6.0 * pace.ramp_s + 0.5, "halt in tq")
        took_s, ramp_s = (drive.now_ns - begin_ns) / 1e9, velocity / pace.velocity * pace.ramp_s
        expected = f"rest after {ramp_s:.3f} s (6084h = 6085h), -40 % to +30 %"
        is_ramp = 0.6 * ramp_s <= took_s <= 1.3 * ramp_s + 0.02
        drive.expect(is_ramp, "halt in tq", expected, f"{took_s:.3f} s", "another ramp is used")
        halted = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        drive.expect(halted is not None, "halted", "bit 10 = 1", f"{drive.statusword():04X}h")
        drive.command(od.ENABLE)
    drive.command(od.ENABLE | od.HALT)
    drive.write(od.TARGET_TORQUE, 2 * torque)
    drive.quiet(0.3)
    drive.near(od.VELOCITY, 0, 1 + pace.velocity // 50, "6071h written during halt", "halt ends")


@drive_clause("TQ-07", Level.L2, source=f"{_TQ}; digital inputs 60FDh, bits 0 and 1")
def torque_mode_has_limit_switches(bench: DriveBench) -> None:
    """A limit switch that stops the motor in tq does so against its torque too, and lets it back.

    A load can drive the motor into the switch, while its torque points away from it.
    """
    drive, pace, torque = _start(bench, Mode.TQ)
    for sign, name in ((1, "positive_limit"), (-1, "negative_limit")):
        for share in (torque, -1):
            bench.stimulate(name, -1)
            drive.write(od.TARGET_TORQUE, sign * torque)
            full = round(sign * pace.velocity / 2)
            drive.watch_to(od.VELOCITY, full, _longest_s(pace), sign=sign)
            drive.write(od.TARGET_TORQUE, sign * share)
            velocity = sign * drive.read(od.VELOCITY)
            if velocity <= pace.velocity // 4:
                raise NotApplicable(f"6071h = {torque}: the motor turns at {velocity} only")
            bench.stimulate(name, 1)
            what = f"{name} on, in tq with 6071h = {sign * share}"
            drive.quiet(velocity / pace.velocity * pace.ramp_s + 0.02)
            left = drive.read(od.VELOCITY)
            is_stopped = abs(left) <= 1 + pace.velocity // 20
            if share == torque and not is_stopped:
                raise NotApplicable("a limit switch does not stop the motor in tq")
            expected = "rest after the ramp 6085h"
            drive.expect(is_stopped, what, expected, f"606Ch = {left}", "its torque decides")
        drive.write(od.TARGET_TORQUE, -sign * torque)
        drive.quiet(pace.ramp_s)
        away = -sign * drive.read(od.VELOCITY)
        drive.expect(away > 0, what, "motion away from it", f"606Ch = {-sign * away}")
        bench.stimulate(name, -1)


@drive_clause("TQ-04", Level.L2, source=_LIMITS)
def torque_limits(bench: DriveBench) -> None:
    """6072h and 6073h limit the torque 6077h, 60E0h only a positive one, 60E1h a negative one."""
    drive = bench.drive
    drive.require(od.TORQUE)
    pace = drive.pace()
    if not bench.is_real:
        drive.ramps(_HARDER * pace.acceleration)
    peaks = _peaks(drive, pace)
    if min(peaks) < 8 * _NOISE:
        raise NotApplicable(f"6083h needs {peaks} 1/1000 of 6076h: too little torque to be judged")
    again = _peaks(drive, pace)  # the torque of a load may depend on the position
    repeats = [abs(one - other) <= _NOISE for one, other in zip(peaks, again, strict=True)]
    for entry, sides in (
        (od.TORQUE_MAX, (0, 1)),
        (od.CURRENT_MAX, (0, 1)),
        (od.TORQUE_POSITIVE, (0,)),
        (od.TORQUE_NEGATIVE, (1,)),
    ):
        own = drive.find(entry)
        limit = min(peaks) // 2
        if own is None or drive.offer_value(entry, limit):
            continue
        seen = _peaks(drive, pace, is_limited=True)
        for side in (0, 1):
            what = f"{('speeding up', 'slowing down')[side]}, {entry} = {limit}"
            wanted = limit if side in sides else peaks[side]
            expected = f"|6077h| up to {wanted} +- {2 * _NOISE}"
            is_kept = abs(seen[side] - wanted) <= 2 * _NOISE
            if side not in sides and not repeats[side]:
                expected = f"|6077h| beyond {limit + 2 * _NOISE}"
                is_kept = seen[side] > limit + 2 * _NOISE
            drive.expect(is_kept, what, expected, f"{seen[side]}", "the limit is ignored")
        drive.write(entry, own)


@drive_clause("TQ-06", Level.L2, source="CiA 402-2, 60E0h, 60E1h = 0, 6077h")
def no_torque_in_a_direction(bench: DriveBench) -> None:
    """With 60E0h = 0 no positive torque is made, and with 60E1h = 0 no negative one."""
    drive, _, torque = _start(bench, Mode.TQ)
    drive.require(od.TORQUE_POSITIVE, od.TORQUE_NEGATIVE)
    for entry, sign in ((od.TORQUE_POSITIVE, 1), (od.TORQUE_NEGATIVE, -1)):
        own = drive.read(entry)
        drive.set(entry, 0)
        for target in (sign * torque, -sign * torque):
            drive.write(od.TARGET_TORQUE, target)
            drive.quiet()
            wanted = 0 if target == sign * torque else target
            drive.near(od.TORQUE, wanted, _NOISE, f"6071h = {target}, {entry} = 0")
        drive.write(entry, own)


@drive_clause("TQ-05", Level.L1, source="CiA 402-2, 6077h, 6078h")
def torque_is_current(bench: DriveBench) -> None:
    """The current 6078h has the sign of the torque 6077h, and is proportional to it."""
    drive, _, torque = _start(bench, Mode.TQ)
    drive.require(od.CURRENT)
    ratios = []
    for target in (torque, -torque):
        drive.write(od.TARGET_TORQUE, target)
        drive.quiet(0.05)
        sums = [0, 0]
        for _ in range(10):
            for place, entry in enumerate((od.TORQUE, od.CURRENT)):
                sums[place] += drive.read(entry)
        expected = f"the sign of 6071h = {target}"
        drive.expect(sums[0] * target > 0, "6077h", expected, f"{sums[0] / 10}")
        ratios.append(sums[1] / sums[0])
    is_one = ratios[0] > 0.0 and abs(ratios[1] - ratios[0]) < 0.2 * ratios[0]
    seen = ", ".join(f"{one:.2f}" for one in ratios)
    drive.expect(is_one, f"6078h / 6077h at 6071h = {torque}, -{torque}", "one ratio > 0", seen)


@drive_clause("PV-08", Level.L2, source="CiA 402-2, profile velocity mode, 60F8h, bit 13")
def slippage(bench: DriveBench) -> None:
    """Bit 13 is 1 in pv while |606Bh - 606Ch| exceeds 60F8h, and 0 otherwise, or with 60F8h = 0."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.SLIPPAGE, od.TORQUE_MAX, od.VELOCITY_DEMAND)
    pace = drive.pace()
    limit = _peaks(drive, pace)[0] // 2
    own = drive.read(od.TORQUE_MAX)
    for most in (pace.velocity // 4, 0):
        drive.set(od.SLIPPAGE, most)
        for sign in (1, -1):
            drive.write(od.TARGET_VELOCITY, 0)
            drive.await_velocity(0, 10.0 * pace.ramp_s + 0.5)
            drive.write(od.TORQUE_MAX, limit)
            drive.write(od.TARGET_VELOCITY, sign * pace.velocity)
            words = [drive.statusword()]
            what = f"half the torque that 6083h needs, 60F8h = {most}"
            drive.expect(not words[0] & od.BIT_13, what, "bit 13 = 0 at first", f"{words[0]:04X}h")
            drive.quiet(pace.ramp_s)
            slips = abs(drive.read(od.VELOCITY_DEMAND) - drive.read(od.VELOCITY))
            word = drive.statusword()
            wanted = 0 < most < slips
            expected = f"bit 13 = {int(wanted)} at a slippage of {slips}"
            drive.expect(bool(word & od.BIT_13) == wanted, what, expected, f"{word:04X}h")
            drive.write(od.TORQUE_MAX, own)
            drive.await_velocity(sign * pace.velocity, 6.0 * pace.ramp_s + 0.5)
            drive.quiet(0.1)
            word = drive.statusword()
            drive.expect(not word & od.BIT_13, "no slippage", "bit 13 = 0", f"{word:04X}h")


@drive_clause("PV-09", Level.L2, source="CiA 402-2, 60C5h, 60C6h")
def ramps_are_limited(bench: DriveBench) -> None:
    """60C5h limits the acceleration 6083h, and 60C6h the deceleration 6084h."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.ACCELERATION_MAX, od.DECELERATION_MAX, od.DECELERATION)
    pace = drive.pace()
    half, third = max(1, pace.acceleration // 2), max(1, pace.acceleration // 3)
    drive.set(od.ACCELERATION_MAX, half)
    drive.set(od.DECELERATION_MAX, third)
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    drive.write(od.TARGET_VELOCITY, pace.velocity)
    found = drive.sped_up(pace)
    drive.expect_ramp(found, half, "speeding up", "60C5h, half of 6083h")
    drive.await_velocity(pace.velocity, 3.0 * pace.ramp_s)
    drive.write(od.TARGET_VELOCITY, 0)
    found = drive.braked(pace.velocity, 8.0 * pace.ramp_s, "60FFh = 0")
    drive.expect_ramp(found, third, "slowing down", "60C6h, a third of 6084h")
