"""Error reports: EMCY, error register, error history."""

from motorhil.harness.conformance.clause import Level
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.power import fault
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode, State

_GENERIC = 0x01


@drive_clause("ERR-01", Level.L5, source="CiA 301, 7.2.7, EMCY; 7.5.2.2, 1001h; CiA 402-2, 603Fh")
def emergency(bench: DriveBench) -> None:
    """A fault sends one EMCY with the code of 603Fh and the register 1001h; its reset 0000h."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    drive.enable(mode)
    begin_ns = drive.now_ns
    code = fault(bench)
    frame = drive.await_emergency(code, begin_ns, f"fault {code:04X}h")
    drive.await_state(State.FAULT, "a fault", "transitions 13 and 14")
    shown = drive.find(od.ERROR_CODE)
    if shown is not None:
        expected = f"{code:04X}h, as in the EMCY"
        drive.expect(shown == code, f"{od.ERROR_CODE}", expected, f"{shown:04X}h")
    register = drive.read(od.ERROR_REGISTER)
    drive.expect(
        frame.data[2] == register and bool(register & _GENERIC),
        f"EMCY {frame.data.hex(' ')}",
        f"its third byte = 1001h = {register:02X}h, with bit 0 (generic error)",
        f"{frame.data[2]:02X}h",
        "the error register is elsewhere in the EMCY",
    )
    count = len(drive.emergencies(begin_ns))
    drive.expect(count == 1, f"fault {code:04X}h", "one EMCY", f"{count}")
    begin_ns = drive.now_ns
    drive.command(0)
    drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")
    drive.await_emergency(0x0000, begin_ns, "fault reset")
    register = drive.read(od.ERROR_REGISTER)
    drive.expect(register == 0, "1001h after the fault reset", "00h", f"{register:02X}h")


@drive_clause("ERR-02", Level.L5, source="CiA 301, 7.5.2.4, pre-defined error field 1003h")
def error_history(bench: DriveBench) -> None:
    """1003h:1 has the last error, 1003h:0 their number; writing 0 to it clears, others abort."""
    drive = bench.drive
    drive.require(od.ERRORS_KEPT)
    drive.write(od.ERRORS_KEPT, 0)
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    drive.enable(mode)
    code = fault(bench)
    drive.await_state(State.FAULT, "a fault", "transitions 13 and 14")
    count = drive.read(od.ERRORS_KEPT)
    drive.expect(count >= 1, f"{od.ERRORS_KEPT} after a fault", "at least 1", f"{count}")
    last = drive.read(od.LAST_ERROR) & 0xFFFF
    drive.expect(last == code, f"{od.LAST_ERROR}", f"{code:04X}h in its lower half", f"{last:04X}h")
    refused = drive.refusal(0x1003, 0, b"\x01")
    drive.expect(refused != 0, "1 to 1003h:0", "an abort code", "accepted")
    drive.write(od.ERRORS_KEPT, 0)
    count = drive.read(od.ERRORS_KEPT)
    drive.expect(count == 0, "1003h:0 after writing 0", "0", f"{count}", "the history is kept")
