"""Option codes: quick stop, shutdown, disable operation and fault reaction, ramps included."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable, Violated
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import QUIET_S, STATE_S, Drive, Pace
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

_QUICK_STOP: Final = "CiA 402-2 / IEC 61800-7-201, quick stop option code 605Ah"
_HOST: Final = 0x7C
_CONSUMER_MS: Final = 100
_SLOW: Final = 4
_HELD_S: Final = 0.3
_TORQUE: Final = 60  # [1/1000 of 6076h]
_NOISE: Final = 15  # of 6077h [1/1000 of 6076h]
_RAMPS: Final = (od.DECELERATION, od.QUICK_DECELERATION)


def _moving(bench: DriveBench, *needed: Entry) -> tuple[Drive, Pace, int]:
    """Return the drive at full speed, its pace, and half of its ramp, which 6084h then has."""
    drive = bench.drive
    drive.require(*needed)
    if not (drive.has_mode(Mode.PV) or drive.has_mode(Mode.PP)):
        raise NotApplicable("6502h claims neither pv nor pp")
    pace = drive.pace()
    slow = max(1, pace.acceleration // 2)
    drive.cruise(pace)
    drive.ramps(slow, pace.acceleration)
    return drive, pace, slow


def _longest_s(pace: Pace) -> float:
    return 4.0 * pace.ramp_s + 0.5


def _at_rest(drive: Drive, pace: Pace, state: State, what: str) -> None:
    """Expect the state once the motor has stopped; skip the clause while a load moves it on."""
    try:
        drive.await_state(state, what, "after the motor has come to rest", STATE_S + pace.ramp_s)
    except Violated:
        if abs(drive.find(od.VELOCITY) or 0) <= 1 + pace.velocity // 50:
            raise
        raise NotApplicable(f"{what}: its load moves the motor on") from None


@drive_clause("STOP-01", Level.L2, source=f"{_QUICK_STOP} = 2, 6085h; transitions 11 and 12")
def quick_stop_ramp(bench: DriveBench) -> None:
    """With 605Ah = 2 a quick stop brakes at 6085h, and ends in switch on disabled."""
    drive, pace, _ = _moving(bench, od.QUICK_STOP_OPTION, od.QUICK_DECELERATION)
    drive.set(od.QUICK_STOP_OPTION, 2)
    what = "quick stop with 605Ah = 2"
    drive.become(State.QUICK_STOP_ACTIVE, od.QUICK_STOP, "transition 11", pace.ramp_s / 2.0)
    found = drive.braked(pace.velocity, _longest_s(pace), what)
    drive.expect_ramp(found, pace.acceleration, what, "6085h")
    _at_rest(drive, pace, State.SWITCH_ON_DISABLED, f"{what}: transition 12")


@drive_clause("STOP-02", Level.L2, source=f"{_QUICK_STOP} = 1, 6084h; transitions 11 and 12")
def quick_stop_slow_down(bench: DriveBench) -> None:
    """With 605Ah = 1 a quick stop brakes at 6084h, and ends in switch on disabled."""
    drive, pace, slow = _moving(bench, od.QUICK_STOP_OPTION, od.DECELERATION)
    drive.set(od.QUICK_STOP_OPTION, 1)
    what = "quick stop with 605Ah = 1"
    drive.become(State.QUICK_STOP_ACTIVE, od.QUICK_STOP, "transition 11", pace.ramp_s / 2.0)
    found = drive.braked(pace.velocity, _longest_s(pace), what)
    drive.expect_ramp(found, slow, what, "6084h")
    _at_rest(drive, pace, State.SWITCH_ON_DISABLED, f"{what}: transition 12")


@drive_clause("STOP-03", Level.L2, source=f"{_QUICK_STOP} = 5 and 6; transition 16; bit 10")
def quick_stop_stays(bench: DriveBench) -> None:
    """With 605Ah = 5 (6084h) or 6 (6085h) the drive stays in quick stop active until enabled.

    Once it is at rest, bit 10 of 6041h is 1.
    """
    for option in (5, 6):
        drive, pace, slow = _moving(bench, od.QUICK_STOP_OPTION, *_RAMPS)
        drive.set(od.QUICK_STOP_OPTION, option)
        what = f"quick stop with 605Ah = {option}"
        drive.become(State.QUICK_STOP_ACTIVE, od.QUICK_STOP, "transition 11", pace.ramp_s / 2.0)
        found = drive.braked(pace.velocity, _longest_s(pace), what)
        ramp, name = (slow, "6084h") if option == 5 else (pace.acceleration, "6085h")
        drive.expect_ramp(found, ramp, what, name)
        drive.quiet(0.3)
        state = drive.state()
        expected = "quick stop active, at rest too"
        drive.expect(state is State.QUICK_STOP_ACTIVE, what, expected, f"{state}")
        ended = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        seen = f"{drive.statusword():04X}h"
        drive.expect(ended is not None, f"{what}, at rest", "bit 10 = 1", seen, "bit 10 is stale")
        drive.write(od.TARGET_VELOCITY, 0)
        drive.become(State.OPERATION_ENABLED, od.ENABLE, "transition 16")
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 9")


@drive_clause("STOP-04", Level.L2, source=f"{_QUICK_STOP} = 0")
def quick_stop_coasts(bench: DriveBench) -> None:
    """With 605Ah = 0 a quick stop disables the drive at once, without a ramp."""
    drive, pace, _ = _moving(bench, od.QUICK_STOP_OPTION)
    drive.set(od.QUICK_STOP_OPTION, 0)
    drive.ramps(max(1, pace.acceleration // _SLOW))
    drive.become(
        State.SWITCH_ON_DISABLED, od.QUICK_STOP, "605Ah = 0: no ramp before it", pace.ramp_s
    )


@drive_clause("STOP-05", Level.L2, source=f"{_QUICK_STOP} = 3, 4, 7 and 8")
def quick_stop_limits(bench: DriveBench) -> None:
    """With 605Ah = 3 or 4 a quick stop is harder than 6085h; with 7 or 8 the drive stays in it.

    After each of them, a motion is followed as closely as before.
    """
    drive = bench.drive
    refused = 0
    before = _largest_error(drive)
    for option in (3, 4, 7, 8):
        if drive.find(od.QUICK_STOP_OPTION) is None or drive.refusal(
            od.QUICK_STOP_OPTION.index, 0, option.to_bytes(2, "little")
        ):
            refused += 1
            continue
        drive, pace, _ = _moving(bench)
        drive.ramps(max(1, pace.acceleration // _SLOW))
        what = f"quick stop with 605Ah = {option}, ramps {_SLOW} times slower"
        drive.command(od.QUICK_STOP)
        _expect_hard(drive, pace, what)
        stays = State.QUICK_STOP_ACTIVE if option > 4 else State.SWITCH_ON_DISABLED
        _at_rest(drive, pace, stays, what)
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 12")
        if before is not None:
            what, most = f"60F4h in a move after {what}", 2 * before + drive.window()
            error = _largest_error(drive) or 0
            drive.expect(error <= most, what, f"up to {most}", f"{error}", "the servo is weaker")
    if refused == 4:
        raise NotApplicable("the drive takes none of 3, 4, 7, 8 in 605Ah")


def _largest_error(drive: Drive) -> int | None:
    """Return the largest 60F4h of a short move; None if the drive makes none, or does not tell."""
    if not drive.has_mode(Mode.PP) or drive.find(od.FOLLOWING_ERROR) is None:
        return None
    pace = drive.pace()
    return drive.largest_lag(pace, pace.distance(0.0), QUIET_S)


def _expect_option(bench: DriveBench, entry: Entry, word: int, state: State) -> None:
    """Expect option 0 to disable at once, and 1 to brake at 6084h before."""
    for option in (0, 1):
        drive, pace, slow = _moving(bench, entry, od.DECELERATION)
        if drive.refusal(entry.index, 0, option.to_bytes(2, "little")):
            drive.command(od.DISABLE_VOLTAGE)
            continue
        what = f"controlword {word:02X}h with {entry.index:04X}h = {option}"
        drive.command(word)
        if option == 0:
            drive.await_state(state, what, "power off at once", pace.ramp_s / 2.0)
        else:
            found = drive.braked(pace.velocity, _longest_s(pace), what)
            drive.expect_ramp(found, slow, what, "6084h")
            _at_rest(drive, pace, state, what)
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 7 or 10")
        drive.quiet(2.0 * pace.ramp_s)


@drive_clause("STOP-06", Level.L2, source="CiA 402-2, shutdown option code 605Bh; transition 8")
def shutdown_option(bench: DriveBench) -> None:
    """Shutdown while moving: 605Bh = 0 disables at once, 1 slows down at 6084h before."""
    _expect_option(bench, od.SHUTDOWN_OPTION, od.SHUTDOWN, State.READY_TO_SWITCH_ON)


@drive_clause("STOP-07", Level.L2, source="CiA 402-2, 605Ch; transition 5")
def disable_operation_option(bench: DriveBench) -> None:
    """Disable operation while moving: 605Ch = 0 disables at once, 1 slows down at 6084h before."""
    _expect_option(bench, od.DISABLE_OPTION, od.SWITCH_ON, State.SWITCHED_ON)


@drive_clause("STOP-08", Level.L5, source="CiA 402-2, fault reaction option code 605Eh; 6007h = 1")
def fault_reaction_option(bench: DriveBench) -> None:
    """A lost host while moving: 605Eh = 0 disables at once, 1 brakes at 6084h, 2 at 6085h."""
    for option in (1, 2, 0):
        needed = (od.HEARTBEAT_CONSUMER, od.ABORT_CONNECTION, od.FAULT_OPTION)
        drive, pace, slow = _moving(bench, *needed, *_RAMPS)
        drive.set(od.FAULT_OPTION, option)
        drive.set(od.ABORT_CONNECTION, 1)
        drive.set(od.HEARTBEAT_CONSUMER, _HOST << 16 | _CONSUMER_MS)
        begin_ns = drive.now_ns
        drive.client.send(0x700 + _HOST, b"\x05")
        what = f"lost heartbeat with 605Eh = {option}"
        drive.await_emergency(0x8130, begin_ns, what)
        if option == 0:
            drive.await_state(State.FAULT, what, "no reaction before it", pace.ramp_s / 2.0)
        else:
            found = drive.braked(pace.velocity, _longest_s(pace), what)
            ramp, name = (slow, "6084h") if option == 1 else (pace.acceleration, "6085h")
            drive.expect_ramp(found, ramp, what, name)
            _at_rest(drive, pace, State.FAULT, what)
        drive.write(od.HEARTBEAT_CONSUMER, 0)


@drive_clause("STOP-09", Level.L2, source="CiA 402-2, halt option code 605Dh = 3 and 4")
def halt_limits(bench: DriveBench) -> None:
    """With 605Dh = 3 or 4 a halt is harder than 6084h and 6085h, and sets bit 10 at rest."""
    drive = bench.drive
    drive.require(od.HALT_OPTION)
    for option in (3, 4):
        if drive.offer_value(od.HALT_OPTION, option):
            continue
        drive, pace, _ = _moving(bench)
        drive.ramps(max(1, pace.acceleration // _SLOW))
        drive.command(od.ENABLE | od.HALT)
        _expect_hard(drive, pace, f"halt with 605Dh = {option}")
        halted = drive.until(lambda word: word & od.TARGET_REACHED != 0, STATE_S)
        drive.expect(halted is not None, f"halt with 605Dh = {option}", "bit 10 = 1", "0")


@drive_clause("STOP-10", Level.L5, source="CiA 402-2, fault reaction option code 605Eh = 3 and 4")
def fault_reaction_limits(bench: DriveBench) -> None:
    """With 605Eh = 3 or 4 the reaction to a lost host is harder than 6084h and 6085h."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_CONSUMER, od.ABORT_CONNECTION, od.FAULT_OPTION)
    for option in (3, 4):
        if drive.offer_value(od.FAULT_OPTION, option):
            continue
        drive.set(od.ABORT_CONNECTION, 1)
        drive, pace, _ = _moving(bench)
        drive.ramps(max(1, pace.acceleration // _SLOW))
        begin_ns = drive.now_ns
        drive.set(od.HEARTBEAT_CONSUMER, _HOST << 16 | _CONSUMER_MS)
        drive.client.send(0x700 + _HOST, b"\x05")
        what = f"lost heartbeat with 605Eh = {option}"
        drive.await_emergency(0x8130, begin_ns, what)
        _expect_hard(drive, pace, what)
        _at_rest(drive, pace, State.FAULT, what)
        drive.write(od.HEARTBEAT_CONSUMER, 0)


@drive_clause("STOP-12", Level.L2, source="CiA 402-2, controlword bit 8, 605Dh; modes pv to cst")
def mode_begins_under_halt(bench: DriveBench) -> None:
    """A mode that is selected while halt is 1 keeps the motor at rest; it moves after halt."""
    drive = bench.drive
    drive.require_mode(Mode.PV)
    pace = drive.pace()
    modes = [(Mode.PV, od.TARGET_VELOCITY, pace.velocity // 2)]
    if not bench.is_real:  # a free motor would race, and SYNC is late
        modes += [
            (Mode.CSV, od.TARGET_VELOCITY, pace.velocity // 2),
            (Mode.TQ, od.TARGET_TORQUE, _TORQUE),
            (Mode.CST, od.TARGET_TORQUE, _TORQUE),
        ]
    drive.write(od.TARGET_VELOCITY, 0)
    drive.enable(Mode.PV)
    drive.command(od.ENABLE | od.HALT)
    for mode, entry, value in modes:
        if not drive.has_mode(mode):
            continue
        drive.write(entry, value)
        drive.select(mode)
        drive.quiet(2.0 * pace.ramp_s)
        what = f"{mode} selected while halt is 1, {entry} = {value}"
        drive.near(od.VELOCITY, 0, 1 + pace.velocity // 50, what, "halt is ignored")
        drive.command(od.ENABLE)
        drive.write(entry, value)  # a cyclic mode obeys the next target
        seen = drive.watch_to(od.VELOCITY, pace.velocity // 4, 40.0 * pace.ramp_s)[-1].value
        expected = f"606Ch = {pace.velocity // 4} at least, without halt"
        torque = drive.find(od.TORQUE) if entry is od.TARGET_TORQUE else None
        is_free = torque is not None and abs(torque - value) <= _NOISE  # friction limits its speed
        is_going = seen >= pace.velocity // 4 or is_free
        drive.expect(is_going, what, expected, f"{seen}", "halt stays")
        drive.command(od.ENABLE | od.HALT)
        drive.braked(pace.velocity // 4, _longest_s(pace), f"halt in {mode}")
    if not bench.is_real and drive.has_mode(Mode.CSP):
        _expect_held(drive)


def _expect_held(drive: Drive) -> None:
    """Expect a target that is written while halt is 1 to have no effect in csp."""
    drive.select(Mode.CSP)
    drive.quiet(_HELD_S)
    here = drive.read(od.POSITION)
    beside = here + 3 * drive.window() + 3
    drive.write(od.TARGET_POSITION, beside)
    drive.quiet(_HELD_S)
    what = f"{Mode.CSP} selected while halt is 1, 607Ah = {beside}"
    drive.near(od.POSITION, here, drive.window() + 1, what, "halt is ignored")
    drive.command(od.ENABLE)
    drive.write(od.TARGET_POSITION, beside)
    drive.quiet(_HELD_S)
    drive.near(od.POSITION, beside, drive.window() + 1, f"607Ah = {beside} without halt")


def _expect_hard(drive: Drive, pace: Pace, what: str) -> None:
    """Expect rest sooner than by ramps that are `_SLOW` times longer than usual."""
    begin_ns = drive.now_ns
    drive.braked(pace.velocity, 2.0 * _SLOW * pace.ramp_s + 0.5, what)
    took_s, ramp_s = (drive.now_ns - begin_ns) / 1e9, _SLOW * pace.ramp_s
    expected = f"rest in less than {0.9 * ramp_s:.2f} s, as a ramp takes {ramp_s:.2f} s"
    drive.expect(took_s < 0.9 * ramp_s, what, expected, f"{took_s:.2f} s", "a ramp is used")


@drive_clause("STOP-11", Level.L2, source="CiA 402-2, 605Bh and 605Ch; transitions 5 and 8")
def disabling_is_taken_back(bench: DriveBench) -> None:
    """Enabled again while it slows down by 605Bh or 605Ch, the drive never leaves that state."""
    for entry, word in ((od.SHUTDOWN_OPTION, od.SHUTDOWN), (od.DISABLE_OPTION, od.SWITCH_ON)):
        drive, pace, _ = _moving(bench, entry)
        if drive.offer_value(entry, 1):
            continue
        drive.ramps(max(1, pace.acceleration // _SLOW))
        drive.command(word)
        drive.quiet(pace.ramp_s)
        seen = drive.state()
        what = f"controlword {word:02X}h with {entry.index:04X}h = 1"
        expected = "operation enabled while it slows down"
        drive.expect(seen is State.OPERATION_ENABLED, what, expected, f"{seen}")
        drive.ramps(pace.acceleration)
        drive.command(od.ENABLE)
        drive.quiet(1.5 * pace.ramp_s)
        if drive.has_mode(Mode.PV):
            what = f"{what}, then 0Fh"
            cause = "it slows down to rest first"
            drive.near(od.VELOCITY, pace.velocity, pace.velocity // 10, what, cause)
        drive.quiet(2.0 * _SLOW * pace.ramp_s)
        seen = drive.state()
        expected = "operation enabled, as before"
        drive.expect(seen is State.OPERATION_ENABLED, what, expected, f"{seen}")
