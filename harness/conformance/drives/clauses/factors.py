"""Units and values: demand and actual values, factors, position range, kinds of set-points."""

from collections.abc import Sequence
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace, slope
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode

_VALUES: Final = "CiA 402-2, 6062h, 6063h, 6064h, 606Bh, 606Ch, 60F4h, 60FCh"
_FACTORS: Final = "CiA 402-2, factor group: 6091h, 6092h, 6096h, 6097h"
_OTHER_UNITS: Final = (
    *(Entry(0x608C, 0, "B", "dimension index"), Entry(0x608E, 0, "B", "dimension index")),
    *(Entry(0x60A8, 0, "I", "SI unit"), Entry(0x60A9, 0, "I", "SI unit")),
)
_HARDER: Final = 100  # an acceleration that the motor cannot follow
_SWING_S: Final = 0.3
_NEGATIVE, _POSITIVE, _SHORTEST = 0x40, 0x80, 0xC0  # 60F2h bits 6 and 7: rotary axis


@drive_clause("VAL-01", Level.L1, source=_VALUES)
def demand_and_actual_values_agree(bench: DriveBench) -> None:
    """60F4h is 6062h - 6064h, and 606Bh is the speed of 6062h, at rest and in both directions."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.POSITION_DEMAND, od.FOLLOWING_ERROR, od.VELOCITY_DEMAND)
    pace, units = drive.pace(), drive.units()
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    drive.quiet(0.1)
    for velocity in (0, pace.velocity, -pace.velocity, 0):
        drive.write(od.TARGET_VELOCITY, velocity)
        drive.quiet(2.5 * pace.ramp_s + 0.2)
        what = f"60FFh = {velocity}"
        drive.near(od.VELOCITY_DEMAND, velocity, 1, what, "606Bh has another unit")
        speed = abs(velocity) * units.velocity
        slack = 2.0 + drive.window() + 4.0 * pace.sample_s * speed
        error = drive.read(od.FOLLOWING_ERROR)
        place = drive.read(od.POSITION)
        what = f"60F4h = {error}, {what}"
        drive.near(od.POSITION_DEMAND, place + error, slack, what, "60F4h has another sign or unit")
        track = drive.watch(od.POSITION_DEMAND, lambda _: False, 0.15)
        rate = slope(track) * (1 if track[-1].value >= track[0].value else -1)
        wanted = velocity * units.velocity
        seen, expected = f"{rate:.0f}", f"{wanted:.0f} position units/s +- 3 %"
        is_right = abs(rate - wanted) <= 0.03 * abs(wanted) + 1
        drive.expect(is_right, "rate of 6062h", expected, seen)


@drive_clause("FAC-01", Level.L1, source=_FACTORS)
def factors_have_effect(bench: DriveBench) -> None:
    """6096h:1 and 6097h:1 scale velocities and accelerations; 6092h:1, the feed, positions."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    if bench.stated.get("units"):
        raise NotApplicable("the rig states the units: factors have no effect")
    if any(drive.find(entry) for entry in _OTHER_UNITS):
        raise NotApplicable("an SI unit or a dimension index replaces the factors")
    drive.require(od.VELOCITY_FACTOR, od.ACCELERATION_FACTOR, od.FEED, od.ENCODER_INCREMENTS)
    pace = drive.pace()
    plain = drive.units()
    drive.set(od.VELOCITY_FACTOR, 2 * drive.read(od.VELOCITY_FACTOR))
    drive.set(od.ACCELERATION_FACTOR, 4 * drive.read(od.ACCELERATION_FACTOR))
    velocity = max(1, pace.velocity // 2)
    drive.ramps(max(1, pace.acceleration // 8))
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    begin_ns = drive.now_ns
    drive.write(od.TARGET_VELOCITY, velocity)
    drive.await_velocity(velocity, 6.0 * pace.ramp_s + 0.5)
    took_s, wanted_s = (drive.now_ns - begin_ns) / 1e9, 2.0 * pace.ramp_s
    what = "6096h:1 twice, 6097h:1 four times as large"
    expected, seen = f"a ramp of {wanted_s:.2f} s -15 % to +30 %", f"{took_s:.2f} s"
    is_ramp = 0.85 * wanted_s <= took_s <= 1.3 * wanted_s + 0.02
    drive.expect(is_ramp, what, expected, seen, "6097h is ignored")
    rate = slope(drive.watch(od.POSITION, lambda _: False, 0.3))
    wanted = 2.0 * velocity * plain.velocity
    seen, expected = f"{rate:.0f}", f"{wanted:.0f} position units/s +- 5 %"
    drive.expect(abs(rate - wanted) <= 0.05 * wanted, what, expected, seen, "6096h is ignored")
    drive.write(od.TARGET_VELOCITY, 0)
    drive.await_velocity(0, 6.0 * pace.ramp_s + 0.5)
    drive.quiet(0.2)
    drive.command(od.DISABLE_VOLTAGE)
    drive.quiet(0.5)
    if drive.read(od.ENCODER_INCREMENTS) <= 1:
        return  # the file does not state the encoder: 6092h cannot be judged
    place, feed = drive.read(od.POSITION), drive.read(od.FEED)
    swing = [one.value for one in drive.watch(od.POSITION, lambda _: False, _SWING_S)]
    drive.set(od.FEED, 2 * feed)
    if max(swing) - min(swing) > 1:
        return  # a load swings it
    drive.near(od.POSITION, 2 * place, 4, "6092h:1 twice as large", "6092h is ignored")


@drive_clause(
    "FAC-02", Level.L1, source="CiA 402-2, factor group: 608Fh, 6091h, 6092h, 6096h, 6097h"
)
def ratios_are_stated(bench: DriveBench) -> None:
    """No numerator or divisor of 608Fh, 6091h, 6092h, 6096h and 6097h is 0."""
    drive = bench.drive
    found = {
        entry: value
        for index in (0x608F, 0x6091, 0x6092, 0x6096, 0x6097)
        for entry in (Entry(index, 1, "I", "numerator"), Entry(index, 2, "I", "divisor"))
        if (value := drive.find(entry)) is not None
    }
    if not found:
        raise NotApplicable("the drive has no factors")
    for entry, value in found.items():
        drive.expect(value != 0, f"{entry}", "at least 1", "0", "its ratio is undefined")


def _travel(drive: Drive, pace: Pace, target: int, bits: int, size: int) -> int:
    """Make a move; return the way of 6064h, counted beyond its range."""
    before, way = drive.read(od.POSITION), 0
    drive.offer(target, od.IMMEDIATELY | bits)
    end_ns = drive.now_ns + round((2.0 * size / pace.speed + 4.0 * pace.ramp_s + STATE_S) * 1e9)
    still = 0
    while still < 5 and drive.now_ns < end_ns:
        place = drive.read(od.POSITION)
        step = (place - before + size // 2) % size - size // 2
        way, before = way + step, place
        still = still + 1 if drive.statusword() & od.TARGET_REACHED else 0
    return way


@drive_clause("RNG-01", Level.L1, source="CiA 402-2, position range limit 607Bh; 60F2h, bits 6, 7")
def position_range(bench: DriveBench) -> None:
    """6064h wraps within 607Bh; a set-point moves in the direction of 60F2h, bits 6 and 7."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.RANGE_MIN, od.RANGE_MAX, od.POSITIONING)
    pace = drive.pace()
    size = 4 * pace.distance(0.05)
    low = -size // 4
    drive.set(od.RANGE_MIN, low)
    drive.set(od.RANGE_MAX, low + size - 1)
    slack = drive.window() + 4
    for option, cases in (
        (_POSITIVE, ((0.25, 0.25), (0.75, 0.75))),
        (_NEGATIVE, ((0.25, -0.75), (0.75, -0.25))),
        (_SHORTEST, ((0.25, 0.25), (0.75, -0.25))),
    ):
        for share, wanted_share in cases:
            drive.set(od.POSITIONING, option)
            drive.enable_at_rest(Mode.PP, 2.0 * pace.ramp_s)
            start = drive.read(od.POSITION)
            target = low + (start + round(share * size) - low) % size
            way = _travel(drive, pace, target, 0, size)
            wanted = round(wanted_share * size)
            what = f"set-point {target} from {start}, 607Bh = {low}..{low + size - 1}"
            what = f"{what}, 60F2h = {option:02X}h"
            expected = f"a way of {wanted} +- {slack}"
            cause = "60F2h is ignored, or 607Bh has no effect"
            drive.expect(abs(way - wanted) <= slack, what, expected, f"{way}", cause)
            place = drive.read(od.POSITION)
            is_inside = low <= place < low + size
            drive.expect(is_inside, what, "6064h within 607Bh", f"{place}", "6064h does not wrap")
    drive.set(od.POSITIONING, 0)
    for target in (low + size // 8, low + 7 * size // 8, low + size // 8):
        start = drive.read(od.POSITION)
        way = _travel(drive, pace, target, 0, size)
        what = f"set-point {target} from {start}, 60F2h = 0 (linear axis)"
        wanted = target - start
        drive.expect(abs(way - wanted) <= slack, what, f"{wanted} +- {slack}", f"{way}")


@drive_clause("PP-08", Level.L1, source="CiA 402-2, profile position mode, 60F2h, bits 0 and 1")
def origin_of_relative_moves(bench: DriveBench) -> None:
    """A relative set-point counts from the last target, the demand or 6064h, as 60F2h says."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.POSITIONING)
    pace = drive.pace()
    drive.enable(Mode.PP)
    for option in (0, 1, 2):
        drive.set(od.POSITIONING, option)
        start, way = drive.read(od.POSITION), pace.distance(0.5)
        drive.offer(start + way, od.IMMEDIATELY)
        drive.await_velocity(pace.velocity, 3.0 * pace.ramp_s + 0.5)
        drive.write(od.TARGET_POSITION, way)
        places = [drive.read(od.POSITION)]
        drive.command(od.ENABLE | od.IMMEDIATELY | od.RELATIVE | od.NEW_SET_POINT)
        places.append(drive.read(od.POSITION))
        drive.command(od.ENABLE)
        drive.until(lambda word: word & od.TARGET_REACHED != 0, 4.0 * pace.ramp_s + 3.0)
        seen = drive.read(od.POSITION)
        lag = round(0.02 * pace.speed)
        low, high = (places[0] + way - lag, places[1] + way + lag) if option else (0, 0)
        if not option:
            low = high = start + 2 * way
        low, high = low - drive.window(), high + drive.window()
        what = f"relative set-point {way} at {places[0]} on the way to {start + way}"
        expected, cause = f"{low} to {high}", "60F2h bits 0 and 1 are ignored"
        drive.expect(low <= seen <= high, f"{what}, 60F2h = {option}", expected, f"{seen}", cause)
    if not bench.is_real:
        _expect_origin_of_a_lagging_motor(drive, pace)
    for wrong in (3, 0x100):
        drive.offer_value(od.POSITIONING, wrong)


def _expect_origin_of_a_lagging_motor(drive: Drive, pace: Pace) -> None:
    """Expect that 60F2h = 2 means 6064h, not the demand, which an overloaded motor cannot reach."""
    if drive.find(od.FOLLOWING_WINDOW) is None or drive.find(od.FOLLOWING_ERROR) is None:
        return
    drive.set(od.FOLLOWING_WINDOW, 0xFFFF_FFFF)
    drive.set(od.POSITIONING, 2)
    start, way = drive.read(od.POSITION), -pace.distance(0.5)  # back
    drive.ramps(_HARDER * pace.acceleration)
    drive.offer(start + way, od.IMMEDIATELY)
    drive.write(od.TARGET_POSITION, way)
    places = [drive.read(od.POSITION)]
    drive.command(od.ENABLE | od.IMMEDIATELY | od.RELATIVE | od.NEW_SET_POINT)
    places.append(drive.read(od.POSITION))
    lag = drive.read(od.FOLLOWING_ERROR)
    drive.command(od.ENABLE)
    drive.until(lambda word: word & od.TARGET_REACHED != 0, 4.0 * pace.ramp_s + 3.0)
    drive.ramps(pace.acceleration)
    slack = drive.window() + abs(places[1] - places[0])
    if abs(lag) <= 2 * slack:
        return  # it keeps up with any ramp
    seen = drive.read(od.POSITION)
    what = f"relative set-point {way} at {places[0]}, {lag} behind the demand, 60F2h = 2"
    low, high = places[0] + way - slack, places[1] + way + slack
    cause = "the distance counts from the demand"
    drive.expect(low <= seen <= high, what, f"{low} to {high}", f"{seen}", cause)


@drive_clause("PP-09", Level.L1, source="CiA 402-2, profile position mode, end velocity 6082h")
def end_velocity(bench: DriveBench) -> None:
    """With 6082h > 0 the motor passes its target at that speed, with bit 10 = 1, and goes on."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.END_VELOCITY)
    if bench.is_real:
        raise NotApplicable("the motor would not stop: tried on emulated benches alone")
    limits = [drive.find(entry) or 0 for entry in (od.LIMIT_MIN, od.LIMIT_MAX)]
    if limits[0] < limits[1]:
        raise NotApplicable(f"607Dh = {limits}: the motor may not go on beyond a target")
    pace = drive.pace()
    drive.enable(Mode.PP)
    for sign in (1, -1):
        end = pace.velocity // 2
        drive.set(od.END_VELOCITY, end)
        target = drive.read(od.POSITION) + sign * pace.distance(0.2)
        drive.offer(target, od.IMMEDIATELY)
        word = drive.statusword()
        what = f"set-point {target}, 6082h = {end}"
        drive.expect(not word & od.TARGET_REACHED, what, "bit 10 = 0 at first", f"{word:04X}h")
        drive.expect_ramp(drive.sped_up(pace), pace.acceleration, what, "6083h")
        track = drive.watch_to(od.POSITION, target, 4.0 * pace.ramp_s + 1.0, sign=sign)
        passed = sign * (track[-1].value - target) >= 0
        drive.expect(passed, what, "the target is passed", f"{track[-1].value}")
        drive.quiet(0.1)
        drive.near(od.VELOCITY, sign * end, 0.1 * end, f"{what}, beyond it", "6082h is ignored")
        word = drive.statusword()
        drive.expect(bool(word & od.TARGET_REACHED), what, "bit 10 = 1", f"{word:04X}h")
        drive.set(od.END_VELOCITY, 0)
        target = drive.read(od.POSITION)
        drive.offer(target, od.IMMEDIATELY)
        drive.await_target(target, 4.0 * pace.ramp_s + 1.0, "6082h = 0")


@drive_clause("PP-10", Level.L1, source="CiA 402-2, profile position mode, bits 4, 5 and 12")
def buffer_of_set_points(bench: DriveBench) -> None:
    """With one set-point running and one waiting, bit 12 stays 1, and a third one is not taken."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    pace = drive.pace()
    drive.enable(Mode.PP)
    start, way = drive.read(od.POSITION), pace.distance(0.3)
    for bits, last in ((0, start + way), (od.IMMEDIATELY, start - way)):
        drive.offer(start + 2 * way)
        drive.quiet(pace.ramp_s / 2.0)
        drive.write(od.TARGET_POSITION, start + way)
        drive.command(od.ENABLE | od.NEW_SET_POINT)
        drive.command(od.ENABLE)
        word = drive.statusword()
        if not word & od.BIT_12:
            raise NotApplicable("bit 12 is 0 while a set-point waits: the drive has more buffers")
        drive.write(od.TARGET_POSITION, start - way)
        drive.command(od.ENABLE | bits | od.NEW_SET_POINT)
        drive.command(od.ENABLE)
        track = drive.watch(
            od.POSITION, lambda _: False, 3.0 * way / pace.speed + 6.0 * pace.ramp_s + 0.5
        )
        highest, lowest = max(one.value for one in track), min(one.value for one in track)
        seen = f"highest {highest}, lowest {lowest}, end {track[-1].value}"
        what = f"set-points {start + 2 * way}, {start + way}, {start - way} ({bits:02X}h)"
        is_done = highest >= start + 2 * way - drive.window() or bool(bits)
        is_done = is_done and lowest >= min(start, last) - way // 10
        is_done = is_done and abs(track[-1].value - last) <= drive.window()
        drive.expect(is_done, what, f"end at {last}", seen, "a third set-point is taken, or lost")
        word = drive.statusword()
        drive.expect(not word & od.BIT_12, what, "bit 12 = 0 in the end", f"{word:04X}h")
        drive.offer(start)
        drive.await_target(start, 2.0 * way / pace.speed + 4.0 * pace.ramp_s + 1.0, "back")


def _expect_same(drive: Drive, pairs: Sequence[tuple[Entry, Entry]]) -> None:
    """Expect the first of each pair to be the second in increments, at rest and at speed."""
    drive.require_mode(Mode.PV)
    pairs = [pair for pair in pairs if drive.find(pair[0]) is not None]
    if not pairs or drive.find(od.POLARITY):
        raise NotApplicable("the drive has no such object, or inverts values by 607Eh")
    pace, units = drive.pace(), drive.units()
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    for velocity in (0, pace.velocity, -pace.velocity):
        drive.write(od.TARGET_VELOCITY, velocity)
        drive.quiet(2.5 * pace.ramp_s + 0.2)
        for entry, other in pairs:
            is_speed = entry is od.VELOCITY_SENSOR
            per_unit = units.position_inc * (units.velocity if is_speed else 1.0)
            begin_ns = drive.now_ns
            wanted = drive.read(other) * per_unit
            value = drive.read(entry)
            moved = abs(velocity) * units.velocity * (drive.now_ns - begin_ns) / 1e9
            most = 0.05 * abs(wanted) + 500 if is_speed else (drive.window() + moved) * per_unit
            what, expected = f"60FFh = {velocity}", f"{entry} = {wanted:.0f} +- {most:.0f}"
            is_right = abs(value - wanted) <= most
            drive.expect(is_right, what, expected, f"{value}", f"not {other} in increments")


@drive_clause("VAL-03", Level.L1, source="CiA 402-2, 6063h and 60FCh: internal units")
def internal_positions(bench: DriveBench) -> None:
    """6063h is 6064h in increments of the encoder, and 60FCh is 6062h in increments."""
    pairs = (
        (od.POSITION_INTERNAL, od.POSITION),
        (od.POSITION_DEMAND_INTERNAL, od.POSITION_DEMAND),
    )
    _expect_same(bench.drive, pairs)


@drive_clause("VAL-04", Level.L1, source="CiA 402-2, velocity sensor actual value 6069h")
def velocity_of_the_sensor(bench: DriveBench) -> None:
    """6069h is the velocity 606Ch in increments of the encoder per second."""
    bench.drive.require(od.VELOCITY_SENSOR)
    _expect_same(bench.drive, ((od.VELOCITY_SENSOR, od.VELOCITY),))


@drive_clause("VAL-02", Level.L1, source="CiA 402-2, DC link circuit voltage 6079h [mV]")
def dc_link_voltage(bench: DriveBench) -> None:
    """6079h is the voltage of the DC link in mV: the supply's when at rest, and 0 without it."""
    drive = bench.drive
    drive.require(od.DC_LINK)
    volts = drive.read(od.DC_LINK)
    drive.expect(5_000 <= volts <= 1_000_000, "6079h", "5 V to 1000 V, in mV", f"{volts}")
    for power, wanted in ((0, 0), (1, volts)):
        bench.stimulate("power", power)
        drive.quiet(0.1)
        drive.near(od.DC_LINK, wanted, volts / 50.0, f"power = {power}")
