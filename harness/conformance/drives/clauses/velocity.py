"""Profile velocity: sign, units, ramps, windows, halt, limits, polarity."""

from typing import Final

from motorhil.harness.conformance.clause import Level
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import QUIET_S, STATE_S, Drive, Pace, slope
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode

_PV: Final = "CiA 402-2 / IEC 61800-7-201, profile velocity mode"
_FACTORS: Final = "CiA 402-2, factor group: 608Fh, 6091h, 6092h, 6096h"
_TIME_MS: Final = 200
_EARLY_S, _LATE_S = 0.03, 0.1
_SOON_S: Final = 0.005  # for an emulated drive, in virtual time


def _start(bench: DriveBench) -> tuple[Drive, Pace]:
    """Return the drive, enabled in pv with 60FFh = 0, and its pace."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    pace = drive.pace()
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    return drive, pace


def _longest_s(pace: Pace) -> float:
    return 3.0 * pace.ramp_s + 0.5


@drive_clause("PV-01", Level.L1, source=f"{_PV}, 60FFh, 606Ch")
def velocity_is_reached(bench: DriveBench) -> None:
    """606Ch reaches 60FFh in both directions, and target reached (bit 10) is set."""
    drive, pace = _start(bench)
    window = max(1, min(0xFFFF, pace.velocity // 20))
    if (drive.find(od.VELOCITY_WINDOW) or window) < window:
        drive.offer_value(od.VELOCITY_WINDOW, window)  # below the noise of the motor
    for velocity in (pace.velocity, -pace.velocity, 0):
        drive.write(od.TARGET_VELOCITY, velocity)
        drive.await_velocity(velocity, 2.0 * _longest_s(pace))
        reached = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        seen = f"6041h = {drive.statusword():04X}h, 606Ch = {drive.read(od.VELOCITY)}"
        drive.expect(reached is not None, f"60FFh = {velocity} reached", "bit 10 = 1", seen)


@drive_clause("PV-02", Level.L0, source=_FACTORS)
def units_agree(bench: DriveBench) -> None:
    """6064h changes at the rate that 606Ch tells, in the units that the dictionary declares."""
    drive, pace = _start(bench)
    for velocity in (pace.velocity, -pace.velocity):
        drive.write(od.TARGET_VELOCITY, velocity)
        drive.await_velocity(velocity, 2.0 * _longest_s(pace))
        begin_ns, begin = drive.now_ns, drive.read(od.POSITION)
        drive.quiet(0.2)
        middle = drive.read(od.VELOCITY)
        drive.quiet(0.2)
        end_ns, end = drive.now_ns, drive.read(od.POSITION)
        rate = (end - begin) / (end_ns - begin_ns) * 1e9
        expected = middle * drive.units().velocity
        drive.expect(
            abs(rate - expected) <= 0.05 * abs(expected) + 5,
            f"rate of 6064h at 606Ch = {middle}",
            f"{expected:.0f} position units/s +- 5 %",
            f"{rate:.0f}",
            "wrong sign, or units that the dictionary does not declare",
        )


@drive_clause("PV-03", Level.L1, source=f"{_PV}, 6083h and 6084h")
def ramps(bench: DriveBench) -> None:
    """The motor speeds up at 6083h and slows down at 6084h."""
    drive, pace = _start(bench)
    slow = max(1, pace.acceleration // 2)
    drive.require(od.DECELERATION)
    for up, down in ((pace.acceleration, slow), (slow, pace.acceleration)):
        drive.write(od.ACCELERATION, up)
        drive.write(od.DECELERATION, down)
        drive.write(od.TARGET_VELOCITY, pace.velocity)
        track = drive.watch(
            od.VELOCITY, lambda one: one.value >= pace.velocity * 0.95, 2.0 * _longest_s(pace)
        )
        drive.await_velocity(pace.velocity, _longest_s(pace))
        part = [one for one in track if 0.2 * pace.velocity < one.value < 0.8 * pace.velocity]
        found = slope(part) / drive.units().acceleration if len(part) > 3 else None
        drive.expect_ramp(found, up, "speeding up", "6083h")
        drive.write(od.TARGET_VELOCITY, 0)
        found = drive.braked(pace.velocity, 2.0 * _longest_s(pace), "60FFh = 0")
        drive.expect_ramp(found, down, "slowing down", "6084h")


def _expect_delay(
    drive: Drive, pace: Pace, bit: int, is_set: bool, limit: int, entries: tuple[Entry, Entry]
) -> None:
    """Expect a bit to change 200 ms after 606Ch has passed a limit on its way to the speed."""
    window, time = entries
    drive.write(od.TARGET_VELOCITY, pace.velocity)
    passed_ns: int | None = None
    end_ns = drive.now_ns + round((2.0 * _longest_s(pace) + 1.0) * 1e9)
    done = False
    while not done and drive.now_ns < end_ns:
        if passed_ns is None and drive.read(od.VELOCITY) >= limit:
            passed_ns = drive.now_ns
        done = bool(drive.statusword() & bit) is is_set
    seen_s = None if passed_ns is None else (drive.now_ns - passed_ns) / 1e9
    name = "bit 10" if bit == od.TARGET_REACHED else "bit 12"
    sampling_s = 2.0 * pace.sample_s
    low, high = _TIME_MS / 1e3 - _EARLY_S - sampling_s, _TIME_MS / 1e3 + _LATE_S + sampling_s
    change = "never" if not done else "before that" if seen_s is None else f"after {seen_s:.3f} s"
    drive.expect(
        done and seen_s is not None and low <= seen_s <= high,
        f"{name} after 606Ch has passed {limit} ({window})",
        f"{int(is_set)} after {low:.2f} s to {high:.2f} s ({time} = {_TIME_MS} ms; sampling)",
        change,
        f"{window.index:04X}h or {time.index:04X}h is ignored",
    )


@drive_clause("PV-04", Level.L1, source=f"{_PV}, 606Dh and 606Eh, statusword bit 10")
def velocity_window(bench: DriveBench) -> None:
    """Bit 10 is set once 606Ch has been in window 606Dh of 60FFh for time 606Eh."""
    drive, pace = _start(bench)
    drive.require(od.VELOCITY_WINDOW, od.VELOCITY_TIME)
    window = max(1, min(0xFFFF, pace.velocity // 10))
    drive.set(od.VELOCITY_WINDOW, window)
    drive.set(od.VELOCITY_TIME, _TIME_MS)
    drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
    drive.write(od.TARGET_VELOCITY, pace.velocity)
    drive.until(lambda word: not word & od.TARGET_REACHED, STATE_S)
    limit = pace.velocity - window
    entries = (od.VELOCITY_WINDOW, od.VELOCITY_TIME)
    _expect_delay(drive, pace, od.TARGET_REACHED, True, limit, entries)


@drive_clause("PV-05", Level.L1, source=f"{_PV}, 606Fh and 6070h, statusword bit 12")
def velocity_threshold(bench: DriveBench) -> None:
    """Bit 12 (speed is 0) is 1 at rest, and 0 once 606Ch has exceeded 606Fh for time 6070h."""
    drive, pace = _start(bench)
    drive.require(od.THRESHOLD, od.THRESHOLD_TIME)
    threshold = max(1, min(0xFFFF, pace.velocity // 10))
    drive.set(od.THRESHOLD, threshold)
    drive.set(od.THRESHOLD_TIME, _TIME_MS)
    at_rest = drive.until(lambda word: word & od.BIT_12 != 0, STATE_S)
    seen = f"6041h = {drive.statusword():04X}h"
    drive.expect(at_rest is not None, "pv at rest", "bit 12 = 1 (speed is 0)", seen, "inverted")
    entries = (od.THRESHOLD, od.THRESHOLD_TIME)
    _expect_delay(drive, pace, od.BIT_12, False, threshold, entries)


@drive_clause("PV-10", Level.L1, source=f"{_PV}, 606Fh, statusword bit 12")
def threshold_written_in_motion(bench: DriveBench) -> None:
    """606Fh has its effect at once: bit 12 is 1 at speed below it, and 0 at speed above it."""
    drive, pace = _start(bench)
    drive.require(od.THRESHOLD, od.THRESHOLD_TIME)
    drive.set(od.THRESHOLD_TIME, 0)
    velocity = min(pace.velocity, 0xFFFF // 2)
    drive.write(od.TARGET_VELOCITY, velocity)
    drive.await_velocity(velocity, 2.0 * _longest_s(pace))
    for threshold, wanted in ((velocity // 2, False), (2 * velocity, True), (velocity // 2, False)):
        drive.quiet()
        drive.set(od.THRESHOLD, threshold)
        drive.quiet(QUIET_S if bench.is_real else _SOON_S)
        word = drive.statusword()
        what = f"606Ch = {velocity}, 606Fh = {threshold}"
        expected, cause = f"bit 12 = {int(wanted)}", "606Fh has its effect later"
        drive.expect(bool(word & od.BIT_12) is wanted, what, expected, f"{word:04X}h", cause)


@drive_clause("PV-06", Level.L2, source=f"{_PV}, controlword bit 8; 605Dh")
def halt_ramps(bench: DriveBench) -> None:
    """Halt slows down at 6084h with 605Dh = 1, at 6085h with 2; without halt it runs again."""
    drive, pace = _start(bench)
    drive.require(od.HALT_OPTION, od.DECELERATION, od.QUICK_DECELERATION)
    slow = max(1, pace.acceleration // 2)
    for option, normal, quick in ((1, slow, pace.acceleration), (2, slow, pace.acceleration)):
        drive.set(od.HALT_OPTION, option)
        drive.ramps(normal, quick)
        drive.write(od.TARGET_VELOCITY, pace.velocity)
        drive.command(od.ENABLE)
        drive.await_velocity(pace.velocity, 2.0 * _longest_s(pace))
        drive.command(od.ENABLE | od.HALT)
        found = drive.braked(pace.velocity, 2.0 * _longest_s(pace), f"halt, 605Dh = {option}")
        ramp, name = (normal, "6084h") if option == 1 else (quick, "6085h")
        drive.expect_ramp(found, ramp, f"halt with 605Dh = {option}", name)
        halted = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        seen = f"6041h = {drive.statusword():04X}h"
        drive.expect(halted is not None, "halted", "bit 10 = 1 (velocity is 0)", seen)
    drive.command(od.ENABLE)
    drive.await_velocity(pace.velocity, 2.0 * _longest_s(pace))


@drive_clause("PV-07", Level.L2, source="CiA 402-2, 607Fh, statusword bit 11")
def velocity_limit(bench: DriveBench) -> None:
    """No profile runs faster than 607Fh; bit 11 (internal limit) is set, or 60FFh refused."""
    drive, pace = _start(bench)
    drive.require(od.VELOCITY_MAX)
    limit = max(1, pace.velocity // 2)
    drive.set(od.VELOCITY_MAX, limit)
    data = pace.velocity.to_bytes(4, "little", signed=True)
    if drive.refusal(od.TARGET_VELOCITY.index, 0, data):
        return
    track = drive.watch(od.VELOCITY, lambda _: False, _longest_s(pace))
    fastest = max(one.value for one in track)
    drive.expect(
        fastest <= 1.1 * limit + 1,
        f"60FFh = {pace.velocity}, 607Fh = {limit}",
        f"606Ch up to {limit}, +10 % for the servo",
        f"{fastest}",
        "607Fh is not enforced",
    )
    seen = drive.statusword()
    what = f"60FFh = {pace.velocity} beyond 607Fh = {limit}"
    drive.expect(bool(seen & od.INTERNAL_LIMIT), what, "bit 11 = 1", f"{seen:04X}h")


@drive_clause("POL-01", Level.L0, source="CiA 402-2, polarity 607Eh")
def polarity(bench: DriveBench) -> None:
    """607Eh bit 7 inverts positions, bit 6 velocities; each bit leaves the other sign alone."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.POLARITY)
    pace = drive.pace()
    directions = []
    for value in (0x00, 0x40, 0x80):
        drive.command(od.DISABLE_VOLTAGE)
        drive.set(od.POLARITY, value)
        drive.write(od.TARGET_VELOCITY, 0)
        drive.enable(Mode.PV)
        drive.write(od.TARGET_VELOCITY, pace.velocity)
        drive.await_velocity(pace.velocity, 2.0 * _longest_s(pace))
        begin = drive.read(od.POSITION)
        drive.quiet(0.1)
        directions.append(1 if drive.read(od.POSITION) > begin else -1)
        drive.write(od.TARGET_VELOCITY, 0)
        drive.braked(pace.velocity, 2.0 * _longest_s(pace), "60FFh = 0")
    usual = directions[0]
    drive.expect(
        directions == [usual, -usual, -usual],
        "direction of 6064h at 606Ch > 0 with 607Eh = 00h, 40h, 80h",
        f"{[usual, -usual, -usual]}",
        f"{directions}",
        "a bit of 607Eh is ignored, or inverts both",
    )
