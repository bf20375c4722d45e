"""Power state machine: transitions, refused transitions, bits of the statusword."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import QUIET_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode, State

_FSA: Final = "CiA 402-2 / IEC 61800-7-201, PDS FSA: transitions"
_S = State
_FAULTS: Final = (_S.FAULT, _S.FAULT_REACTION_ACTIVE)

# (transition, controlword, state afterwards): one walk through all transitions that need no motion.
_WALK: Final = (
    ("2", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("7", od.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    ("2", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("7", od.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    ("2", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("3", od.SWITCH_ON, _S.SWITCHED_ON),
    ("6", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("3", od.SWITCH_ON, _S.SWITCHED_ON),
    ("10", od.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    ("2", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("3", od.SWITCH_ON, _S.SWITCHED_ON),
    ("4", od.ENABLE, _S.OPERATION_ENABLED),
    ("5", od.SWITCH_ON, _S.SWITCHED_ON),
    ("4", od.ENABLE, _S.OPERATION_ENABLED),
    ("8", od.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    ("3", od.SWITCH_ON, _S.SWITCHED_ON),
    ("4", od.ENABLE, _S.OPERATION_ENABLED),
    ("9", od.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
)
# (controlwords to get there, the state, controlwords that must do nothing there)
_REFUSED: Final = (
    ((), _S.SWITCH_ON_DISABLED, (od.SWITCH_ON, od.ENABLE, od.QUICK_STOP, od.FAULT_RESET)),
    ((od.SHUTDOWN,), _S.READY_TO_SWITCH_ON, (od.SHUTDOWN, od.FAULT_RESET)),
    ((od.SHUTDOWN, od.SWITCH_ON), _S.SWITCHED_ON, (od.SWITCH_ON, od.FAULT_RESET)),
)


@drive_clause("PDS-01", Level.L0, source=f"{_FSA} 2 to 10")
def transitions(bench: DriveBench) -> None:
    """The controlword causes transitions 2 to 10, and the statusword shows each state."""
    drive = bench.drive
    _select_any(drive)
    drive.await_state(_S.SWITCH_ON_DISABLED, "power-on", "transition 1")
    for number, word, state in _WALK:
        drive.become(state, word, f"transition {number}")


@drive_clause("PDS-02", Level.L0, source=f"{_FSA}; every other command is ignored")
def refused_transitions(bench: DriveBench) -> None:
    """A controlword that starts no transition leaves the state as it is."""
    drive = bench.drive
    _select_any(drive)
    drive.await_state(_S.SWITCH_ON_DISABLED, "power-on", "transition 1")
    for words, state, refused in _REFUSED:
        for word in words:
            drive.command(word)
        drive.await_state(state, "controlwords " + " ".join(f"{one:02X}h" for one in words), "")
        for word in refused:
            drive.command(word)
            drive.quiet()
            seen = drive.statusword()
            drive.expect(
                od.state_of(seen) is state,
                f"controlword {word:04X}h in {state}",
                f"{state} after {QUIET_S:g} s (no transition)",
                f"{od.state_of(seen)} (6041h = {seen:04X}h)",
                "a transition that the standard does not have",
            )
        drive.command(od.DISABLE_VOLTAGE)
        drive.await_state(_S.SWITCH_ON_DISABLED, "controlword 0000h", "transition 7 or 10")


@drive_clause("PDS-03", Level.L0, source="CiA 402-2, statusword 6041h, bits 4 and 9")
def statusword_bits(bench: DriveBench) -> None:
    """With power, bit 4 (voltage enabled) is 1; bit 9 (remote) is 1 while 6040h is obeyed."""
    drive = bench.drive
    _select_any(drive)
    for word in (od.SHUTDOWN, od.SWITCH_ON, od.ENABLE):
        drive.command(word)
    seen = drive.await_state(_S.OPERATION_ENABLED, "controlwords 06h 07h 0Fh", "transitions 2 to 4")
    for bit, name in ((od.VOLTAGE_ENABLED, "4, voltage enabled"), (od.REMOTE, "9, remote")):
        what = "6041h in operation enabled"
        drive.expect(seen & bit != 0, what, f"bit {name} = 1", f"{seen:04X}h")


@drive_clause("PDS-04", Level.L5, source=f"{_FSA} 13 to 15; fault reset is bit 7, 0 to 1")
def fault_reset_by_edge(bench: DriveBench) -> None:
    """A fault is reset by a rising edge of bit 7 only; the level of the bit does nothing."""
    drive = bench.drive
    mode = _select_any(drive)
    drive.enable(mode)
    fault(bench, od.FAULT_RESET)
    drive.await_state(_S.FAULT, "a fault", "transitions 13 and 14")
    drive.quiet(0.2)
    drive.command(od.FAULT_RESET)  # still 1: no edge
    drive.quiet(0.2)
    seen = drive.state()
    what = "bit 7 of 6040h = 1 since before the fault"
    drive.expect(
        seen is _S.FAULT, what, "fault (no edge)", f"{seen}", "reset by level, not by edge"
    )
    drive.command(0)
    drive.quiet()
    drive.expect(drive.state() is _S.FAULT, "bit 7 of 6040h 1 -> 0", "fault", f"{drive.state()}")
    drive.become(_S.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15, rising edge of bit 7")


def _select_any(drive: Drive) -> Mode:
    """Select the first claimed mode, for drives that need one to be enabled."""
    drive.require(od.SUPPORTED_MODES)
    for mode in Mode:
        if drive.has_mode(mode):
            drive.select(mode)
            return mode
    raise NotApplicable("6502h claims no mode")


def fault(bench: DriveBench, bits: int = 0) -> int:
    """Cause a fault while the drive is enabled; return its error code.

    Args:
        bench: its `fail` causes the fault; on a real bench a following error does.
        bits: of the controlword, 1 since before the fault.

    Raises:
        NotApplicable: there is no way to cause one.
    """
    drive = bench.drive
    drive.command(od.ENABLE | bits)
    code = bench.fail()
    if code is not None:
        return code
    drive.require(od.FOLLOWING_WINDOW, od.FOLLOWING_TIMEOUT)
    pace = drive.pace()
    drive.enable(Mode.PP)
    drive.set(od.FOLLOWING_TIMEOUT, 0)
    drive.set(od.FOLLOWING_WINDOW, 1)
    drive.write(od.TARGET_POSITION, drive.read(od.POSITION) + pace.distance(0.2))
    drive.command(od.ENABLE | od.IMMEDIATELY | od.NEW_SET_POINT | bits)
    if drive.until(lambda word: od.state_of(word) in _FAULTS, 4.0 * pace.ramp_s + 1.0) is None:
        raise NotApplicable("the following error stays within 6065h = 1: no fault to observe")
    return 0x8611
