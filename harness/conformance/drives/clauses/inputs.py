"""Digital inputs: 60FDh, limit switches, touch probes. The bench sets the inputs of the drive."""

from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    configure,
    operational,
    quiet_other_pdos,
)
from motorhil.harness.conformance.drives.clauses.homing import (
    home_beside_zero,
    require_index,
    scale,
)
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode

_INPUTS: Final = "CiA 402-2, digital inputs 60FDh"
_PROBE: Final = "CiA 402-2, touch probe 60B8h to 60BDh, 60D0h, 60D5h to 60D8h"
_NAMES: Final = (
    ("negative_limit", 0x1),
    ("positive_limit", 0x2),
    ("home", 0x4),
    ("interlock", 0x8),
)
_RELEASED: Final = -1
_HOME: Final = 0x4  # of 60FDh
_ASIDE: Final = 3.0  # [position units]
_PUSH: Final = 0.02  # of the torque that the motor has
_SETTLED_S: Final = 0.2
_ON, _EVERY, _INDEX, _BY_SOURCE, _RISING, _FALLING = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
# (input of the bench, its source in 60D0h, shift of its byte, results of both edges)
_PROBES: Final = (("touch_probe_1", 1, 0, 0x60BA, 0x60D5), ("touch_probe_2", 2, 8, 0x60BC, 0x60D7))


def _level(bench: DriveBench, name: str, value: float) -> None:
    bench.stimulate(name, value)
    bench.drive.quiet(0.01)


@drive_clause("DIN-01", Level.L1, source=f"{_INPUTS}, bits 0 to 3")
def inputs_are_shown(bench: DriveBench) -> None:
    """60FDh shows limit switches, home switch and interlock in bits 0 to 3, at once."""
    drive = bench.drive
    drive.require(od.INPUTS)
    identifier = configure(drive, 0x1800, (od.INPUTS,), 255)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    own = drive.read(od.INPUTS)
    for name, bit in _NAMES:
        for value in (1, 0, 1):
            begin_ns, before = drive.now_ns, drive.read(od.INPUTS)
            _level(bench, name, value)
            seen, told = drive.read(od.INPUTS), drive.client.heard(identifier, begin_ns)
            what, wanted = (
                f"input {name} = {value}",
                f"bit {bit.bit_length() - 1} of 60FDh = {value}",
            )
            drive.expect(bool(seen & bit) == bool(value), what, wanted, f"{seen:08X}h")
            wanted = f"no other bit than in {before:08X}h"
            drive.expect(not (seen ^ before) & ~bit, what, wanted, f"{seen:08X}h")
            if seen != before:
                data = [int.from_bytes(one.data[:4], "little") for one in told]
                cause = "the change is no event of the TPDO"
                drive.expect(data == [seen], what, f"one TPDO with {seen:X}h", f"{data}", cause)
        _level(bench, name, _RELEASED)
    drive.near(od.INPUTS, own, 0, "all inputs as before")


@drive_clause("DIN-02", Level.L1, source=f"{_INPUTS}, bit 2; the rig: switches, backlash_rad")
def input_of_the_output(bench: DriveBench) -> None:
    """60FDh shows the home switch where the output is, wherever backlash lets the motor be."""
    drive = bench.drive
    drive.require(od.INPUTS)
    drive.require_mode(Mode.PP)
    bench.require_stated("switches", "home_from_rad", "home_to_rad")
    low, high = (bench.stated["switches"][f"home_{one}_rad"] for one in ("from", "to"))
    pace, plant = drive.pace(), bench.plant()
    start, start_rad = drive.read(od.POSITION), bench.true_position_rad()
    per_rad = scale(bench, pace)
    edge = start + (low - start_rad) * per_rad
    aside = max(_ASIDE, 0.25 * plant["backlash_rad"] * abs(per_rad))
    push = _PUSH * plant["current_max_a"] * plant["torque_constant_n_m_a"] * plant["gear_ratio"]
    push = abs(push) + plant["output_coulomb_friction_n_m"]
    for target in (round(edge - aside), round(edge + aside)):
        within_s = abs(target - drive.read(od.POSITION)) / pace.speed + 4.0 * pace.ramp_s + STATE_S
        drive.offer(target, od.IMMEDIATELY)
        drive.await_target(target, within_s, "a move")
        for load in (push, -push):
            bench.stimulate("load_torque_n_m", load)
            drive.quiet(_SETTLED_S)
            true_rad, seen = bench.true_position_rad(), bool(drive.read(od.INPUTS) & _HOME)
            span = sorted((true_rad, bench.true_position_rad()))  # an undamped load may swing
            near = 1.0 / abs(per_rad)
            if any(span[0] - near <= one <= span[1] + near for one in (low, high)):
                continue
            what = f"bit 2 of 60FDh, the output at {true_rad:.5f} rad, the motor at {target}"
            wanted = low <= true_rad < high
            expected = f"{int(wanted)}: the switch is on from {low:g} to {high:g} rad"
            drive.expect(seen is wanted, what, expected, f"{int(seen)}")
        bench.stimulate("load_torque_n_m", 0.0)


def _run_into(bench: DriveBench, pace: Pace, sign: int, mode: Mode) -> None:
    """Move in a direction in pv or pp, until 606Ch has its speed."""
    drive = bench.drive
    if mode is Mode.PV:
        drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(mode)
    if mode is Mode.PV:
        drive.write(od.TARGET_VELOCITY, sign * pace.velocity)
    else:
        target = drive.read(od.POSITION) + sign * pace.distance(5.0)
        drive.offer(target, od.IMMEDIATELY)
    drive.await_velocity(sign * pace.velocity, 3.0 * pace.ramp_s + 0.5)


@drive_clause("LSW-01", Level.L2, source=f"{_INPUTS}, bits 0 and 1; statusword 6041h, bit 11")
def limit_switches(bench: DriveBench) -> None:
    """An active limit switch stops motion into it, with bit 11 = 1; motion away is possible."""
    drive = bench.drive
    modes = [one for one in (Mode.PV, Mode.PP) if drive.has_mode(one)]
    pace = drive.pace()
    for mode in modes:
        for sign, name in ((1, "positive_limit"), (-1, "negative_limit")):
            _run_into(bench, pace, sign, mode)
            word = drive.statusword()
            what = f"{name} off"
            drive.expect(not word & od.INTERNAL_LIMIT, what, "bit 11 = 0", f"{word:04X}h")
            bench.stimulate(name, 1)
            what = f"{name} on, in {mode}"
            found = drive.braked(pace.velocity, 3.0 * pace.ramp_s + 0.5, what)
            drive.expect_ramp(found, pace.acceleration, what, "6084h = 6085h")
            seen = drive.until(lambda word: word & od.INTERNAL_LIMIT != 0, STATE_S)
            drive.expect(seen is not None, what, "bit 11 = 1", f"{drive.statusword():04X}h")
            _expect_barred(drive, pace, sign, mode, what)
            bench.stimulate(name, _RELEASED)
            drive.quiet(0.02)
            word = drive.statusword()
            drive.expect(not word & od.INTERNAL_LIMIT, f"{name} off", "bit 11 = 0", f"{word:04X}h")


def _expect_barred(drive: Drive, pace: Pace, sign: int, mode: Mode, what: str) -> None:
    """Expect no motion into the limit switch, and motion away from it."""
    drive.quiet(0.2)
    place = drive.read(od.POSITION)
    for way in (sign, -sign):
        if mode is Mode.PV:
            drive.write(od.TARGET_VELOCITY, way * pace.velocity)
        else:
            drive.offer(place + way * pace.distance(0.2), od.IMMEDIATELY)
        drive.quiet(2.0 * pace.ramp_s)
        moved = way * (drive.read(od.POSITION) - place)
        if way == sign:
            drive.expect(moved <= drive.window(), what, "no motion into it", f"{moved}")
        else:
            drive.expect(moved > 0.3 * pace.distance(0.0), what, "motion away from it", f"{moved}")


@drive_clause("LSW-02", Level.L2, source="CiA 402-2, 607Dh: limits of the position actual value")
def software_limits_in_velocity_modes(bench: DriveBench) -> None:
    """In pv the motor does not run beyond 607Dh: it is stopped with bit 11 = 1, or has a fault.

    That holds also for a limit that is written in motion, if the drive takes it.
    """
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.LIMIT_MIN, od.LIMIT_MAX)
    pace = drive.pace()
    way = pace.distance(0.2)
    home_beside_zero(bench, 4 * way)  # 607Dh counts from home
    start = drive.read(od.POSITION)
    offset = drive.find(od.HOME_OFFSET) or 0
    drive.set(od.LIMIT_MIN, start - way + offset)
    drive.set(od.LIMIT_MAX, start + way + offset)
    for sign in (1, -1):
        drive.write(od.TARGET_VELOCITY, 0)
        drive.enable(Mode.PV)
        drive.write(od.TARGET_VELOCITY, sign * pace.velocity)
        what = f"60FFh = {sign * pace.velocity}, 607Dh = {start + sign * way}"
        drive.await_velocity(sign * pace.velocity, 3.0 * pace.ramp_s)
        drive.braked(pace.velocity, 6.0 * pace.ramp_s + 2.0, what)
        beyond = sign * (drive.read(od.POSITION) - start) - way
        most = round(0.6 * pace.distance(0.0)) + drive.window()
        drive.expect(
            -drive.window() <= beyond <= most,
            what,
            f"rest 0 to {most} (a ramp) beyond it",
            f"{beyond}",
            "607Dh is ignored in pv",
        )
        word = drive.statusword()
        is_told = bool(word & od.INTERNAL_LIMIT) or not word & 0x04
        drive.expect(is_told, what, "bit 11 = 1, or a fault", f"{word:04X}h")
    drive.enable(Mode.PV)
    drive.write(od.TARGET_VELOCITY, pace.velocity)  # back within the limits
    drive.await_velocity(pace.velocity, 3.0 * pace.ramp_s)
    inside = drive.until(lambda word: not word & od.INTERNAL_LIMIT, pace.ramp_s)
    drive.expect(inside is not None, "back within 607Dh", "bit 11 = 0", "1")
    if drive.offer_value(od.LIMIT_MAX, start + offset) == 0:
        what = f"607Dh:2 = {start + offset}, written in motion"
        drive.braked(pace.velocity, 6.0 * pace.ramp_s + 2.0, what)
        place, expected = drive.read(od.POSITION), f"rest at {start} to {start + most}"
        is_kept = start - drive.window() <= place <= start + most
        drive.expect(is_kept, what, expected, f"{place}", "607Dh has its effect later")


def _latched(drive: Drive, value: int, events: int, place: int) -> tuple[int, int]:
    """Return a latched position and its count of events; `place` is 0 for rising edges."""
    position = drive.read(Entry(value + place, 0, "i", "touch probe position value"))
    return position, drive.read(Entry(events + place, 0, "H", "touch probe edge counter"))


@drive_clause("LIM-02", Level.L2, source="CiA 402-2, statusword bit 11: internal limit active")
def no_limit_is_active(bench: DriveBench) -> None:
    """Away from all limits, bit 11 is 0 at rest in each mode, also when it is selected again."""
    drive = bench.drive
    modes = [one for one in (Mode.PP, Mode.PV, Mode.TQ, Mode.HM) if drive.has_mode(one)]
    if not modes:
        raise NotApplicable("6502h claims none of pp, pv, tq and hm")
    if Mode.PV in modes:
        drive.write(od.TARGET_VELOCITY, 0)
    for mode in modes + modes:
        drive.enable(mode)
        word = drive.statusword()
        drive.expect(not word & od.INTERNAL_LIMIT, f"{mode} at rest", "bit 11 = 0", f"{word:04X}h")
        drive.command(od.DISABLE_VOLTAGE)


@drive_clause("TP-01", Level.L1, source=_PROBE)
def touch_probes(bench: DriveBench) -> None:
    """Both touch probes latch 6064h at the edges that 60B8h enables, once or at every event."""
    drive = bench.drive
    drive.require_mode(Mode.PP)
    drive.require(od.PROBE_FUNCTION, od.PROBE_STATUS, Entry(0x60D5, 0, "H", "edge counter"))
    pace = drive.pace()
    drive.enable(Mode.PP)
    for name, _, shift, value, events in _PROBES:
        for every in (0, _EVERY):
            for edge, bit, place in ((_RISING, 0x02, 0), (_FALLING, 0x04, 1)):
                function = _ON | every | edge
                _level(bench, name, int(edge == _FALLING))
                drive.write(od.PROBE_FUNCTION, function << shift)
                what = f"60B8h = {function << shift:04X}h"
                drive.near(od.PROBE_STATUS, _ON << shift, 0, f"{what}, no edge yet")
                seen = []
                for _ in range(2):
                    target = drive.read(od.POSITION) + pace.distance(0.0) // 3
                    drive.offer(target, od.IMMEDIATELY)
                    drive.await_target(target, 4.0 * pace.ramp_s + STATE_S, "a move")
                    _, count = _latched(drive, value, events, place)
                    for level in (0, 1, 0):
                        _level(bench, name, level)
                    at, after = _latched(drive, value, events, place)
                    seen.append(
                        (abs(at - drive.read(od.POSITION)) <= drive.window(), after - count)
                    )
                wanted = [(True, 1), (bool(every), int(bool(every)))]
                if edge == _FALLING:
                    wanted = [(True, 1 + bool(every)), (bool(every), int(bool(every)))]
                cause = "a bit of 60B8h is ignored"
                drive.expect(
                    seen == wanted, what, f"(latched, events) = {wanted}", f"{seen}", cause
                )
                drive.near(od.PROBE_STATUS, (_ON | bit) << shift, 0, f"{what}, after edges")
                drive.write(od.PROBE_FUNCTION, 0)
                drive.near(od.PROBE_STATUS, 0, 0, "60B8h = 0")
        bench.stimulate(name, _RELEASED)
    drive.write(od.PROBE_FUNCTION, _ON | _EVERY | _RISING)
    drive.reset()
    drive.near(od.PROBE_STATUS, 0, 0, "60B8h = 0 after a reset of the node")


@drive_clause("TP-02", Level.L1, source=f"{_PROBE}: index pulse")
def index_pulse(bench: DriveBench) -> None:
    """A touch probe on the index pulse latches positions one turn of the motor apart."""
    require_index(bench)
    drive = bench.drive
    drive.require_mode(Mode.PV)
    drive.require(od.PROBE_FUNCTION)
    pace = drive.pace()
    turn = drive.turn()
    velocity = max(1, round(pace.velocity * min(1.0, 4.0 * turn / pace.speed)))
    for sources, function in (((1, 2), _INDEX), ((5, 6), _BY_SOURCE)):
        for place, source in enumerate(sources, 1):
            chosen = Entry(0x60D0, place, "h", "touch probe source")
            if "index_rad" in bench.stated.get("switches", {}) and not bench.is_real:
                code = drive.offer_value(chosen, source)
                expected = "accepted: the rig states an index pulse for both probes"
                drive.expect(not code, f"{chosen} = {source}", expected, f"{code:08X}h")
            drive.set(chosen, source)
        for _, _, shift, value, events in _PROBES:
            what = f"60B8h = {(function | _ON | _EVERY | _RISING) << shift:04X}h"
            drive.write(od.PROBE_FUNCTION, (function | _ON | _EVERY | _RISING) << shift)
            seen: list[int] = []
            for sign in (1, -1):
                drive.write(od.TARGET_VELOCITY, 0)
                drive.enable(Mode.PV)
                drive.write(od.TARGET_VELOCITY, sign * velocity)
                for _ in range(3):
                    _, count = _latched(drive, value, events, 0)
                    end_ns = drive.now_ns + 2_000_000_000
                    while _latched(drive, value, events, 0)[1] == count and drive.now_ns < end_ns:
                        pass
                    at, after = _latched(drive, value, events, 0)
                    drive.expect(after != count, what, "an event in each turn", "none in 2 s")
                    seen.append(at)
                drive.write(od.TARGET_VELOCITY, 0)
                drive.braked(velocity, 3.0 * pace.ramp_s + 0.5, "60FFh = 0")
            apart = [abs(b - a) % turn for a, b in pairwise(seen)]
            exact = all(min(one, turn - one) <= 2.0 for one in apart)
            up = seen[1] > seen[0] and seen[2] > seen[1]
            expected = f"positions whole turns ({turn:.0f}) apart"
            drive.expect(exact and up, what, expected, f"{seen}", "not the index pulse's position")
            drive.write(od.PROBE_FUNCTION, 0)


@drive_clause("TP-03", Level.L1, source=f"{_PROBE}: sources by 60D0h")
def probe_sources(bench: DriveBench) -> None:
    """With bits 2 and 3 of 60B8h = 2, 60D0h chooses the input of each probe."""
    drive = bench.drive
    drive.require(od.PROBE_FUNCTION)
    for place, (_, _, shift, value, events) in enumerate(_PROBES, 1):
        for name, source, *_ in _PROBES:
            drive.set(Entry(0x60D0, place, "h", "touch probe source"), source)
            drive.write(od.PROBE_FUNCTION, (_ON | _EVERY | _BY_SOURCE | _RISING) << shift)
            for one, *_ in _PROBES:
                _level(bench, one, 0)
                _, count = _latched(drive, value, events, 0)
                _level(bench, one, 1)
                _, after = _latched(drive, value, events, 0)
                wanted = int(one == name)
                what = f"edge of {one}, 60D0h:{place} = {source}"
                drive.expect(after - count == wanted, what, f"{wanted} events", f"{after - count}")
                bench.stimulate(one, _RELEASED)
            drive.write(od.PROBE_FUNCTION, 0)
    for wrong in (0, 3, 7):
        code = drive.refusal(0x60D0, 1, wrong.to_bytes(2, "little"))
        drive.expect(code != 0, f"60D0h:1 = {wrong} (reserved)", "an abort code", "accepted")


@drive_clause("TP-04", Level.L1, source=f"{_PROBE}: position of the edge")
def probe_in_motion(bench: DriveBench) -> None:
    """An input along the way latches the same positions at every speed, in both directions."""
    drive = bench.drive
    switches = bench.stated.get("switches", {})
    drive.require(od.PROBE_FUNCTION)
    drive.require_mode(Mode.PP)
    bench.require_stated("switches", "touch_probe_1_from_rad", "touch_probe_1_to_rad")
    pace = drive.pace()
    start, slack = drive.read(od.POSITION), drive.window() // 2  # for backlash
    inc_rad = scale(bench, pace)
    edges = [switches[f"touch_probe_1_{end}_rad"] * inc_rad for end in ("from", "to")]
    drive.write(od.PROBE_FUNCTION, _ON | _EVERY | _RISING | _FALLING)
    for velocity in (pace.velocity, pace.velocity // 5):
        drive.write(od.PROFILE_VELOCITY, velocity)
        for sign in (1, -1):
            target = round(edges[1] + pace.distance(0.1)) if sign > 0 else start
            drive.offer(target, od.IMMEDIATELY)
            drive.await_target(target, 30.0 * pace.ramp_s + STATE_S, "a move past the input")
            rising, falling = (_latched(drive, 0x60BA, 0x60D5, place)[0] for place in (0, 1))
            seen = [rising, falling] if sign > 0 else [falling, rising]
            near = all(abs(a - b) <= slack for a, b in zip(seen, edges, strict=True))
            what = f"touch probe 1, passed at 6081h = {velocity} in direction {sign}"
            wanted = f"{edges[0]:.0f}, {edges[1]:.0f} +- {slack}"
            drive.expect(near, what, wanted, f"{seen}", "the position is latched too late")
