"""Homing: home by position, switch and index pulse, home offset, bits 10, 12 and 13."""

import struct
from collections.abc import Sequence
from math import pi
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    configure,
    operational,
    quiet_other_pdos,
)
from motorhil.harness.conformance.drives.drive import STATE_S, Drive, Pace
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode

_HM: Final = "CiA 402-2 / IEC 61800-7-201, homing mode"
_CURRENT_POSITION: Final = (37, 35)
_RESERVED: Final = (15, 16, 31, 32)
_SETTLED_S: Final = 0.3
_OFFSET: Final = 1000
_SEARCH_S: Final = 60.0
_TRIES: Final = 5
_APART_S: Final = 0.0003
# CiA 402-2, homing methods: the edge by method, and the direction in which it is passed; methods
# 1 to 14 go on from there to the next index pulse. A cam is active between its two edges.
_NEGATIVE, _POSITIVE, _LEFT, _RIGHT = "negative_limit", "positive_limit", "home_from", "home_to"
_EDGES: Final = {
    17: (_NEGATIVE, 1),
    18: (_POSITIVE, -1),
    19: (_LEFT, -1),
    20: (_LEFT, 1),
    21: (_RIGHT, 1),
    22: (_RIGHT, -1),
    23: (_LEFT, -1),
    24: (_LEFT, 1),
    25: (_RIGHT, -1),
    26: (_RIGHT, 1),
    27: (_RIGHT, 1),
    28: (_RIGHT, -1),
    29: (_LEFT, 1),
    30: (_LEFT, -1),
}
_WITH_INDEX: Final = 16  # methods 1 to 14 are 17 to 30 with the index pulse
_WITHOUT_LIMIT: Final = range(19, 23)  # these do not turn at a limit switch
_SIDES: Final = {_LEFT: (-1, 0), _RIGHT: (0, 1)}  # from where they find their edge of a cam
_BITS: Final = od.TARGET_REACHED | od.BIT_12 | od.BIT_13


def _home(drive: Drive) -> int | None:
    """Start homing; return the statusword when it has ended, or None if it does not end."""
    drive.command(od.ENABLE)
    drive.command(od.ENABLE | od.START_HOMING)
    word = drive.until(lambda word: bool(word & (od.BIT_12 | od.BIT_13)), 2.0 * STATE_S)
    drive.command(od.ENABLE)
    return word


@drive_clause("HOME-01", Level.L1, source=f"{_HM}, methods 35 and 37, 607Ch, statusword bits")
def home_is_here(bench: DriveBench) -> None:
    """Method 37 or 35 makes the current position home: zero is 607Ch beyond it; bits 10, 12 = 1.

    CiA 402-2: zero = home + 607Ch, so that 6064h of home is -607Ch; Elmo's and Parker's manuals
    have the same text. KEB's F6 has +607Ch. A rig declares that.
    """
    drive = bench.drive
    drive.require_mode(Mode.HM)
    method = next((one for one in _CURRENT_POSITION if _takes(drive, one)), None)
    if method is None:
        raise NotApplicable("6098h takes neither 37 nor 35")
    drive.require(od.HOME_OFFSET)
    drive.enable_at_rest(Mode.HM, _SETTLED_S)
    before = drive.statusword()
    what = f"6041h, before homing with method {method}"
    drive.expect(not before & (od.BIT_12 | od.BIT_13), what, "bits 12, 13 = 0", f"{before:04X}h")
    for offset in (0, _OFFSET):
        drive.set(od.HOME_OFFSET, offset)
        word = _home(drive)
        what = f"homing, method {method}, 607Ch = {offset}"
        seen = "no end" if word is None else f"6041h = {word:04X}h"
        expected = "bits 10 and 12 = 1, 13 = 0 (completed)"
        is_done = word is not None and word & _BITS == od.TARGET_REACHED | od.BIT_12
        drive.expect(is_done, what, expected, seen, "homing is not made, or bits are wrong")
        _expect_offset(bench, offset, what)


def home_beside_zero(bench: DriveBench, offset: int) -> None:
    """Make the current position home, this far from zero; do nothing if the drive cannot."""
    drive = bench.drive
    has = all(drive.find(one) is not None for one in (od.HOME_OFFSET, od.SUPPORTED_MODES))
    if not has or not drive.has_mode(Mode.HM) or bench.facts.home_offset_is_opposite:
        return
    if not any(_takes(drive, one) for one in _CURRENT_POSITION):
        return
    if drive.offer_value(od.HOME_OFFSET, offset) == 0:
        drive.enable(Mode.HM)
        _home(drive)


def _expect_offset(bench: DriveBench, offset: int, what: str) -> None:
    """Expect 6064h of home to be -607Ch, or +607Ch if the rig declares that."""
    drive = bench.drive
    position = drive.read(od.POSITION)
    is_opposite = bench.facts.home_offset_is_opposite
    wanted = offset if is_opposite else -offset
    other = "that of CiA 402-2" if is_opposite else "the opposite sign of 607Ch, as KEB's F6 has"
    remedy = (
        f"home_offset_is_opposite = {str(not is_opposite).lower()} in [conformance] declares it"
    )
    drive.expect(
        abs(position - wanted) <= drive.window(),
        f"6064h after {what}",
        f"{wanted} +- {drive.window()} (home; zero is {-wanted} beyond it)",
        f"{position}",
        f"{other}; {remedy}" if abs(position + wanted) <= drive.window() else "607Ch is ignored",
    )
    if drive.find(od.POSITION_DEMAND) is not None:
        cause = "6062h has another zero than 6064h"
        drive.near(od.POSITION_DEMAND, wanted, drive.window(), f"after {what}", cause)


def scale(bench: DriveBench, pace: Pace) -> float:
    """Make a move; return position units per radian of the output."""
    drive = bench.drive
    drive.enable(Mode.PP)
    ends = []
    for target in (drive.read(od.POSITION) + pace.distance(0.5), drive.read(od.POSITION)):
        drive.offer(target, od.IMMEDIATELY)
        drive.await_target(target, 6.0 * pace.ramp_s + STATE_S, "a move")
        ends.append((drive.read(od.POSITION), bench.true_position_rad()))
    return (ends[1][0] - ends[0][0]) / (ends[1][1] - ends[0][1])


def _set_speeds(drive: Drive, pace: Pace) -> None:
    """Set 6099h and 609Ah, which many files leave at 0, to what the drive can do."""
    for entry, value in (
        (od.SEARCH_SPEED, max(1, pace.velocity // 2)),
        (od.ZERO_SPEED, max(1, pace.velocity // 20)),
        (od.HOMING_ACCELERATION, pace.acceleration),
    ):
        if drive.find(entry) is not None:
            drive.write(entry, value)


def _move_to(bench: DriveBench, pace: Pace, place_rad: float, per_rad: float) -> None:
    """Move to a place of the output in pp, and enable hm there."""
    drive = bench.drive
    drive.enable(Mode.PP)
    way = round((place_rad - bench.true_position_rad()) * per_rad)
    target = drive.read(od.POSITION) + way
    drive.offer(target, od.IMMEDIATELY)
    within_s = abs(way) / pace.speed + 4.0 * pace.ramp_s + STATE_S
    drive.await_target(target, within_s, f"move to {place_rad:g} rad")
    drive.enable(Mode.HM)


def _search(drive: Drive, method: int) -> int:
    """Home with a method; return the statusword at rest."""
    drive.set(od.HOMING_METHOD, method)
    drive.command(od.ENABLE)
    drive.command(od.ENABLE | od.START_HOMING)
    end_ns = drive.now_ns + round(_SEARCH_S * 1e9)
    word = drive.statusword()
    while not (word & (od.BIT_12 | od.BIT_13) and word & od.TARGET_REACHED):
        drive.expect(drive.now_ns < end_ns, f"method {method}", "an end", f"{word:04X}h after 60 s")
        drive.quiet(0.02)
        word = drive.statusword()
    drive.command(od.ENABLE)
    return word


def _home_rad(bench: DriveBench, method: int, offset: int, per_rad: float) -> float:
    """Home with a method; return where home is on the output."""
    drive = bench.drive
    word = _search(drive, method)
    expected = "bits 10 and 12 = 1, 13 = 0 (completed)"
    is_done = word & _BITS == od.TARGET_REACHED | od.BIT_12
    what = f"homing, method {method}, from {bench.true_position_rad():.3f} rad"
    drive.expect(is_done, what, expected, f"6041h = {word:04X}h", "the switch is not found")
    return bench.true_position_rad() - (drive.read(od.POSITION) + offset) / per_rad


def _expect_home(bench: DriveBench, method: int, start_rad: float, per_rad: float) -> None:
    """Expect home at the edge of the method's switch, or at the index pulse beyond it."""
    drive = bench.drive
    switches = bench.stated["switches"]
    edge, way = _EDGES[method if method in _EDGES else method + _WITH_INDEX]
    edge_rad, unit_rad = switches[f"{edge}_rad"], 1.0 / abs(per_rad)
    _move_to(bench, bench.drive.pace(), start_rad, per_rad)
    sign = -1 if bench.facts.home_offset_is_opposite else 1
    home = _home_rad(bench, method, sign * _OFFSET, per_rad)
    is_there = abs(home - edge_rad) <= 2.0 * unit_rad
    wanted = f"{edge} = {edge_rad:g} rad +- 2 position units"
    if method not in _EDGES:
        turn_rad = drive.turn() * unit_rad
        turns = home / turn_rad - switches.get("index_rad", 0.0) / (2.0 * pi)
        is_index = abs(turns - round(turns)) * turn_rad < 3.0 * unit_rad
        is_there = is_index and -2.0 * unit_rad <= way * (home - edge_rad) <= turn_rad
        wanted = f"the first index pulse beyond {edge} = {edge_rad:g} rad"
    what = f"home by method {method} from {start_rad:g} rad"
    drive.expect(is_there, what, wanted, f"{home:.5f} rad", "another edge, or too late")


def _begin(bench: DriveBench, *keys: str) -> float:
    """Require the switches of the rig; return position units per radian of the output."""
    drive = bench.drive
    bench.require_stated("switches", *keys)
    drive.require_mode(Mode.HM)
    drive.require_mode(Mode.PP)
    drive.set(od.HOME_OFFSET, _OFFSET)
    _set_speeds(drive, drive.pace())
    return scale(bench, drive.pace())


def _has_index(bench: DriveBench) -> bool:
    return bench.stated.get("switches", {}).get("index_pulse", True) is not False


def require_index(bench: DriveBench) -> None:
    """Raise NotApplicable if the rig states that the encoder has no index pulse."""
    if not _has_index(bench):
        raise NotApplicable("switches.index_pulse = false: the encoder has none")


@drive_clause("HOME-03", Level.L1, source=f"{_HM}, methods 17, 18, 1 and 2")
def home_at_limit_switches(bench: DriveBench) -> None:
    """Methods 17 and 18 find the edge of a limit switch, 1 and 2 the index pulse beyond it."""
    keys = ("negative_limit_rad", "positive_limit_rad")
    per_rad = _begin(bench, *keys)
    low, high = (bench.stated["switches"][one] for one in keys)
    for method in (17, 18, 1, 2) if _has_index(bench) else (17, 18):
        _expect_home(bench, method, (low + high) / 2.0, per_rad)


def _expect_homes(bench: DriveBench, methods: Sequence[int], sides: Sequence[int]) -> None:
    """Expect home with all methods, from below (-1), on (0) and above (1) the cam of the switch."""
    keys = ("negative_limit_rad", "home_from_rad", "home_to_rad", "positive_limit_rad")
    per_rad = _begin(bench, *keys)
    low, left, right, high = (bench.stated["switches"][one] for one in keys)
    starts_rad = {-1: left - (left - low) / 4.0, 0: (left + right) / 2.0}
    starts_rad[1] = right + (high - right) / 8.0
    for method in methods:
        edge, _ = _EDGES[method if method in _EDGES else method + _WITH_INDEX]
        needs_side = method in _WITHOUT_LIMIT or method + _WITH_INDEX in _WITHOUT_LIMIT
        for side in sides:
            if not needs_side or side in _SIDES[edge]:
                _expect_home(bench, method, starts_rad[side], per_rad)


@drive_clause("HOME-04", Level.L1, source=f"{_HM}, methods 19 to 30")
def home_at_the_switch(bench: DriveBench) -> None:
    """Methods 19 to 30 find their edge of the home switch from below, from it, and from above."""
    _expect_homes(bench, range(19, 31), (-1, 0, 1))


@drive_clause("HOME-05", Level.L1, source=f"{_HM}, methods 3 to 14")
def home_at_index_pulse(bench: DriveBench) -> None:
    """Methods 3 to 14 find the first index pulse beyond their edge of the home switch."""
    require_index(bench)
    _expect_homes(bench, range(3, 15), (-1, 1))


@drive_clause("HOME-06", Level.L1, source=f"{_HM}, methods 33 and 34")
def home_at_next_index_pulse(bench: DriveBench) -> None:
    """Method 33 finds the next index pulse in negative direction, 34 in positive direction."""
    require_index(bench)
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.require_mode(Mode.PP)
    pace = drive.pace()
    _set_speeds(drive, pace)
    per_rad = scale(bench, pace)
    turn = drive.turn()
    start_rad = bench.true_position_rad() + 0.3 * turn / per_rad
    homes = []
    for method, sign in ((33, -1), (34, 1), (33, -1)):
        if not _takes(drive, method):
            raise NotApplicable(f"6098h does not take {method}")
        _move_to(bench, pace, start_rad, per_rad)
        home = _home_rad(bench, method, 0, per_rad)
        way = (home - start_rad) * per_rad * sign
        what = f"home by method {method}"
        drive.expect(-2 <= way <= turn + 2, what, f"0 to {turn:.0f} from the start", f"{way:.0f}")
        homes.append(home * per_rad)
    apart, again = homes[1] - homes[0], homes[2] - homes[0]
    is_one_turn = abs(apart - turn) <= drive.window() and abs(again) <= drive.window()
    expected = f"index pulses {turn:.0f} apart"
    drive.expect(is_one_turn, "methods 33 and 34", expected, f"{apart:.0f}, {again:.0f}")
    _expect_a_whole_turn(bench, pace, per_rad, homes[1])


def _expect_a_whole_turn(bench: DriveBench, pace: Pace, per_rad: float, index: float) -> None:
    """Expect an index pulse that is a whole turn away, sought as fast as the turn allows."""
    drive = bench.drive
    turn = drive.turn()
    fast = max(1, round(pace.velocity * min(1.0, (turn / pace.distance(0.0)) ** 0.5 / 2.0)))
    if drive.find(od.ZERO_SPEED) is None:
        return
    drive.write(od.ZERO_SPEED, fast)
    for method, sign in ((33, -1), (34, 1)):
        beside = sign * (drive.window() + round(turn / 20.0))
        _move_to(bench, pace, (index + beside) / per_rad, per_rad)
        home = _home_rad(bench, method, 0, per_rad) * per_rad
        what = f"home by method {method}, {abs(beside)} beyond an index pulse, 6099h:2 = {fast}"
        is_next = abs(home - index - sign * turn) <= 2 * drive.window()
        expected = f"home {turn:.0f} beyond that"
        drive.expect(is_next, what, expected, f"{sign * (home - index):.0f}", "given up too soon")


@drive_clause("HOME-07", Level.L2, source=f"{_HM}, 6099h, 609Ah; controlword bits 4 and 8")
def homing_is_interrupted(bench: DriveBench) -> None:
    """The search runs at 6099h:1 on ramp 609Ah; halt or bit 4 = 0 ends it, with bit 10 at rest."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.require(od.SEARCH_SPEED, od.HOMING_ACCELERATION)
    pace = drive.pace()
    bench.stimulate("home", 0)
    drive.set(od.HOMING_METHOD, 24)
    _set_speeds(drive, pace)
    drive.ramps(2 * pace.acceleration)
    for velocity, word in ((pace.velocity, od.ENABLE), (pace.velocity // 2, None)):
        drive.write(od.SEARCH_SPEED, velocity)
        drive.enable(Mode.HM)
        drive.command(od.ENABLE | od.START_HOMING)
        begin_ns = drive.now_ns
        drive.await_velocity(velocity, 3.0 * pace.ramp_s + 0.5)
        took_s, ramp_s = (drive.now_ns - begin_ns) / 1e9, velocity / pace.velocity * pace.ramp_s
        expected = f"609Ah: {ramp_s:.3f} s -20 % to +40 %"
        seen = f"{took_s:.3f} s"
        drive.expect(0.8 * ramp_s <= took_s <= 1.4 * ramp_s + 0.02, "homing", expected, seen)
        drive.quiet(pace.ramp_s)
        drive.await_velocity(velocity, 0.01)
        drive.near(od.VELOCITY_DEMAND, velocity, 1 + velocity // 100, "search for the switch")
        seen = f"{drive.statusword():04X}h"
        is_going = not drive.statusword() & _BITS
        drive.expect(is_going, "homing in progress", "bits 10, 12, 13 = 0", seen)
        drive.command(od.ENABLE | od.START_HOMING | od.HALT if word is None else word)
        drive.braked(velocity, 3.0 * pace.ramp_s + 0.5, "homing interrupted")
        ended = drive.until(lambda word: word & _BITS == od.TARGET_REACHED, STATE_S)
        seen = f"{drive.statusword():04X}h"
        drive.expect(ended is not None, "homing interrupted", "bits 10, 12, 13 = 1, 0, 0", seen)
    drive.command(od.ENABLE | od.START_HOMING)
    drive.quiet(0.2)
    expected, moved = "no motion: bit 4 was 1 before", abs(drive.read(od.VELOCITY_DEMAND))
    drive.expect(moved == 0, "halt ended", expected, f"606Bh = {moved}")
    drive.command(od.ENABLE)
    for name in ("home", "negative_limit"):
        bench.stimulate(name, 1)
        drive.quiet(0.1)
        word, moved = drive.statusword(), abs(drive.read(od.VELOCITY_DEMAND))
        seen = f"6041h = {word:04X}h, 606Bh = {moved}"
        is_over = moved == 0 and not word & (od.BIT_12 | od.BIT_13)
        drive.expect(is_over, f"{name} on, homing over", "no effect", seen, "homing is not over")
        bench.stimulate(name, -1)


@drive_clause("HOME-08", Level.L2, source=f"{_HM}, statusword bits 12 and 13: homing error")
def homing_fails(bench: DriveBench) -> None:
    """A limit switch that the method does not expect, or a second one, is homing error (bit 13)."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.require(od.SEARCH_SPEED, od.ZERO_SPEED)
    _set_speeds(drive, drive.pace())
    bench.stimulate("home", 0)
    for method, names in (
        (20, ("positive_limit",)),
        (21, ("negative_limit",)),
        (24, ("positive_limit", "negative_limit")),
        (29, ("negative_limit", "positive_limit")),
    ):
        drive.enable(Mode.HM)
        drive.set(od.HOMING_METHOD, method)
        drive.command(od.ENABLE | od.START_HOMING)
        for place, name in enumerate(names, 1):
            drive.quiet(0.3)
            before = drive.statusword()
            drive.expect(not before & _BITS, f"method {method}", "in progress", f"{before:04X}h")
            bench.stimulate(name, 1)
            drive.quiet(0.3)
            bench.stimulate(name, -1 if place < len(names) else 1)
        word = drive.until(lambda word: word & _BITS == od.TARGET_REACHED | od.BIT_13, STATE_S)
        seen = f"{drive.statusword():04X}h"
        what = f"homing, method {method}, limit switch in the way"
        drive.expect(word is not None, what, "bits 10, 12, 13 = 1, 0, 1", seen)
        drive.command(od.ENABLE)
        for name in names:
            bench.stimulate(name, -1)
    for entry in (od.SEARCH_SPEED, od.ZERO_SPEED):
        speed = drive.read(entry)
        if not drive.offer_value(entry, 0):
            word = _search(drive, 24)
            drive.expect(bool(word & od.BIT_13), f"{entry} = 0", "bit 13 = 1", f"{word:04X}h")
            drive.write(entry, speed)


@drive_clause("HOME-09", Level.L1, source=f"{_HM}, statusword bit 12; NMT reset node")
def home_is_forgotten(bench: DriveBench) -> None:
    """Bit 12 stays 1 in hm after the drive is disabled, and is 0 after a reset of the node."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    if not _takes(drive, 37) and not _takes(drive, 35):
        raise NotApplicable("6098h takes neither 37 nor 35")
    drive.enable(Mode.HM)
    word = _home(drive) or 0
    for _ in range(2):
        seen = f"{word:04X}h"
        drive.expect(bool(word & od.BIT_12), "home attained", "bit 12 = 1", seen)
        drive.command(od.DISABLE_VOLTAGE)
        drive.enable(Mode.HM)
        word = drive.statusword()
    drive.reset()
    drive.enable(Mode.HM)
    word = drive.statusword()
    drive.expect(not word & od.BIT_12, "reset node", "bit 12 = 0", f"{word:04X}h", "home is kept")


@drive_clause("HOME-02", Level.L2, source=f"{_HM}, 6098h: 15, 16, 31 and 32 are reserved")
def reserved_methods(bench: DriveBench) -> None:
    """A reserved homing method is refused, or ends with homing error (bit 13)."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.enable(Mode.HM)
    for method in _RESERVED:
        if _takes(drive, method):
            word = _home(drive) or drive.statusword()
            expected = "an SDO abort code, or bit 13 = 1"
            seen = f"accepted, 6041h = {word:04X}h"
            drive.expect(bool(word & od.BIT_13), f"6098h = {method}", expected, seen)


def _takes(drive: Drive, method: int) -> bool:
    return drive.refusal(od.HOMING_METHOD.index, 0, bytes((method,))) == 0


@drive_clause("HOME-10", Level.L2, source=f"{_HM}: homing starts with bit 4; 6060h, 6061h")
def homing_begins_at_rest(bench: DriveBench) -> None:
    """Selected while the motor turns, hm brings it to rest, and keeps it there until bit 4."""
    bench.drive.rests_when_selected(Mode.HM)


@drive_clause("HOME-11", Level.L2, source=f"{_HM}: homing starts with bit 4; 6060h, 6061h")
def homing_starts_at_once(bench: DriveBench) -> None:
    """Homing can be started as soon as a TPDO tells that 6061h is 6; it succeeds all the same."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.require_mode(Mode.PP)
    if not any(_takes(drive, one) for one in _CURRENT_POSITION):
        raise NotApplicable("6098h takes neither 37 nor 35")
    commands = configure(drive, 0x1400, (od.CONTROLWORD, od.MODE), 255)
    told = configure(drive, 0x1800, (od.MODE_DISPLAY,), 255)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    shown = struct.pack("<b", Mode.HM)

    def attained(word: int) -> bool:
        return word & (od.BIT_12 | od.BIT_13) == od.BIT_12

    for place in range(_TRIES):
        drive.enable(Mode.PP)
        drive.quiet(place * _APART_S)
        begin_ns = drive.now_ns
        drive.client.send(commands, struct.pack("<Hb", od.ENABLE, Mode.HM))
        is_told = drive.client.wait_for(
            lambda begin_ns=begin_ns: any(  # type: ignore[misc]  # mypy#15459
                one.data == shown for one in drive.client.heard(told, begin_ns)
            ),
            STATE_S,
        )
        if not is_told:
            raise NotApplicable("the drive tells no change of 6061h, or selects no mode enabled")
        start = struct.pack("<Hb", od.ENABLE | od.START_HOMING, Mode.HM)
        drive.client.send(commands, start)
        is_done = drive.until(attained, 2.0 * STATE_S) is not None
        word = drive.statusword()
        drive.client.send(commands, struct.pack("<Hb", od.ENABLE, Mode.HM))
        drive.quiet(2.0 * _APART_S)
        if bench.is_real and not word & od.BIT_13:
            is_done = True  # a start that comes with the mode may be passed over
        seen = f"6041h = {word:04X}h"
        cause = "hm is shown before it can start"
        drive.expect(is_done, "homing, as soon as 6061h = 6", "bits 12, 13 = 1, 0", seen, cause)
