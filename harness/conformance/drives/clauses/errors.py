"""Error reports: EMCY, error register, error history."""

from typing import Final

from motorhil.harness.conformance.clause import Level
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.network import RESET_COMMUNICATION
from motorhil.harness.conformance.drives.clauses.power import fault
from motorhil.harness.conformance.drives.drive import STATE_S
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

_GENERIC: Final = 0x01
_COMMUNICATION: Final = 0x10
_CODES: Final = "CiA 402-1, error codes of 603Fh; CiA 301, 7.2.7"
# (stimulus, its value with the fault and without it, error code, bit of 1001h)
_CAUSES: Final = (
    ("short_circuit", 1, 0, 0x2320, 0x02),
    ("mains_over_voltage", 1, 0, 0x3110, 0x04),
    ("mains_under_voltage", 1, 0, 0x3120, 0x04),
    ("device_temperature_c", 95.0, 25.0, 0x4210, 0x08),
    ("encoder", 0, 1, 0x7305, 0x00),
)
_TO_BUS_OFF: Final = 32  # failed transmissions in a row: ISO 11898-1, fault confinement


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
    ended = drive.await_emergency(0x0000, begin_ns, "fault reset")
    if not bench.is_real and "emcy_vendor_bytes" in bench.stated.get("quirks", ()):
        what = "quirk emcy_vendor_bytes: bytes 3 to 7 of the EMCY of a fault"
        drive.expect(any(frame.data[3:]), what, "not all 0", frame.data.hex(" "))
        what = "quirk emcy_vendor_bytes: bytes 3 to 7 of EMCY 0000h"
        drive.expect(not any(ended.data[3:]), what, "0: it is no error", ended.data.hex(" "))
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


@drive_clause("ERR-03", Level.L5, source=f"{_CODES}; 1001h, bits 1 to 5; transition 15")
def faults_of_the_hardware(bench: DriveBench) -> None:
    """A fault of the hardware has its code and its bit of 1001h; it cannot be reset meanwhile."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    for is_on in (True, False):
        for name, fails, works, code, bit in _CAUSES:
            if is_on:
                drive.enable(mode)
            begin_ns = drive.now_ns
            bench.stimulate(name, fails)
            what = f"{name} = {fails}"
            frame = drive.await_emergency(code, begin_ns, what)
            drive.await_state(State.FAULT, what, "transitions 13 and 14")
            register = drive.read(od.ERROR_REGISTER)
            expected = f"1001h with bits 0 and {bit:02X}h, without {_COMMUNICATION:02X}h"
            is_told = register & (bit | 1 | _COMMUNICATION) == bit | 1
            is_told = is_told and frame.data[2] == register
            drive.expect(is_told, what, expected, f"{register:02X}h", "wrong class of error")
            shown = drive.find(od.ERROR_CODE)
            drive.expect(shown in (code, None), what, f"603Fh = {code:04X}h", f"{shown}")
            for word in (0, od.FAULT_RESET, 0):
                drive.command(word)
                drive.quiet()
            state = drive.state()
            expected = "fault: its cause is present"
            drive.expect(state is State.FAULT, f"fault reset, {what}", expected, f"{state}")
            if is_on and name == _CAUSES[0][0]:
                drive.client.node.nmt.send_command(RESET_COMMUNICATION)
                drive.boot()
                now = drive.read(od.ERROR_REGISTER)
                expected = f"1001h with bits 0 and {bit:02X}h: its cause is present"
                is_told = now & (bit | _GENERIC) == bit | _GENERIC
                drive.expect(is_told, f"reset communication, {what}", expected, f"{now:02X}h")
            bench.stimulate(name, works)
            drive.quiet()
            begin_ns = drive.now_ns
            drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")
            drive.await_emergency(0x0000, begin_ns, f"fault reset, {name} = {works}")
            drive.near(od.ERROR_REGISTER, 0, 0, f"{name} = {works}")
            drive.command(0)


@drive_clause("ERR-04", Level.L5, source="CiA 402-2, statusword 6041h, bit 7 (warning)")
def warnings(bench: DriveBench) -> None:
    """A device that is warm, but not too hot, sets bit 7 (warning) and stays enabled."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    drive.enable(mode)
    for celsius, wanted in ((25.0, False), (80.0, True), (25.0, False)):
        bench.stimulate("device_temperature_c", celsius)
        drive.quiet()
        word = drive.statusword()
        is_right = od.state_of(word) is State.OPERATION_ENABLED
        is_right = is_right and bool(word & od.WARNING) is wanted
        expected = f"operation enabled, bit 7 = {int(wanted)}"
        drive.expect(is_right, f"device at {celsius:g} C", expected, f"{word:04X}h")


@drive_clause("ERR-05", Level.L5, source="CiA 402-2, 6064h; 603Fh = 7305h, incremental sensor 1")
def encoder_is_lost(bench: DriveBench) -> None:
    """Without its encoder the drive has a fault, 6064h and 606Ch stand; home is lost with it."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.require_mode(Mode.PV)
    pace = drive.pace()
    drive.enable(Mode.HM)
    drive.set(od.HOMING_METHOD, 37)
    drive.command(od.ENABLE | od.START_HOMING)
    home = drive.until(lambda word: bool(word & od.BIT_12), STATE_S)
    drive.expect(home is not None, "homing, method 37", "bit 12 = 1", "0")
    drive.cruise(pace)
    bench.stimulate("encoder", 0)
    place = drive.read(od.POSITION)
    drive.await_state(State.FAULT, "encoder lost", "transition 14")
    drive.near(od.POSITION, place, 0, "encoder lost", "6064h is no measurement")
    drive.near(od.VELOCITY, 0, 0, "encoder lost")
    drive.quiet(1.0)
    bench.stimulate("encoder", 1)
    drive.near(od.POSITION, place, pace.distance(0.0), "encoder back", "counted without it")
    drive.quiet(1.0)
    drive.enable(Mode.HM)
    word = drive.statusword()
    drive.expect(not word & od.BIT_12, "encoder back, hm", "bit 12 = 0 (no home)", f"{word:04X}h")
    drive.enable(Mode.PV)
    drive.await_velocity(pace.velocity, 3.0 * pace.ramp_s + 0.5)


@drive_clause("ERR-06", Level.L5, source=f"{_CODES}: 3220h; statusword bit 4 (voltage enabled)")
def supply_is_lost(bench: DriveBench) -> None:
    """Without its supply an enabled drive has fault 3220h, bit 4 = 0, and cannot be reset."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    for is_on in (True, False):
        if is_on:
            drive.enable(mode)
        else:
            drive.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
        begin_ns = drive.now_ns
        bench.stimulate("power", 0)
        drive.quiet()
        word = drive.statusword()
        what = f"power = 0, {'enabled' if is_on else 'ready to switch on'}"
        drive.expect(not word & od.VOLTAGE_ENABLED, what, "bit 4 = 0", f"{word:04X}h")
        if not is_on:
            seen = od.state_of(word)
            drive.expect(seen is State.READY_TO_SWITCH_ON, what, "no fault", f"{seen}")
            drive.command(od.SWITCH_ON)
            drive.command(od.ENABLE)
        drive.await_emergency(0x3220, begin_ns, what)
        drive.await_state(State.FAULT, what, "transitions 13 and 14")
        for word in (0, od.FAULT_RESET, 0):
            drive.command(word)
            drive.quiet()
        state = drive.state()
        drive.expect(state is State.FAULT, f"fault reset, {what}", "fault", f"{state}")
        bench.stimulate("power", 1)
        drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")
        word = drive.statusword()
        drive.expect(bool(word & od.VOLTAGE_ENABLED), "power = 1", "bit 4 = 1", f"{word:04X}h")
        drive.command(0)


@drive_clause("ERR-07", Level.L5, source="IEC 61800-5-2, STO; CiA 402-2, PDS FSA: transition 9")
def safe_torque_off(bench: DriveBench) -> None:
    """Safe torque off ends operation enabled at once, and holds transition 2 while it is on."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    stated = bench.stated.get("protection", {})
    for _ in range(2):
        drive.enable(mode)
        begin_ns = drive.now_ns
        bench.stimulate("sto", 1)
        drive.quiet()
        if stated.get("sto") == "fault":
            drive.await_emergency(stated.get("sto_error_code", 0x8A88), begin_ns, "sto = 1")
            drive.await_state(State.FAULT, "sto = 1", "transition 13, as the rig states")
            bench.stimulate("sto", 0)
            continue
        drive.await_state(State.SWITCH_ON_DISABLED, "sto = 1", "transition 9")
        drive.expect(not drive.emergencies(begin_ns), "sto = 1", "no EMCY", "an EMCY")
        drive.command(od.SHUTDOWN)
        drive.quiet()
        state = drive.state()
        expected = "switch on disabled"
        drive.expect(
            state is State.SWITCH_ON_DISABLED, "shutdown with sto = 1", expected, f"{state}"
        )
        bench.stimulate("sto", 0)
        drive.command(0)


@drive_clause("ERR-08", Level.L5, source="CiA 301, 7.2.7.1: 8120h, 8140h; CiA 402-2, 6007h")
def bus_errors(bench: DriveBench) -> None:
    """A passive node sends EMCY 8120h, and 0000h afterwards; after bus-off it sends 8140h."""
    drive = bench.drive
    mode = next((one for one in Mode if drive.has_mode(one)), Mode.PP)
    drive.enable(mode)
    for _ in range(2):
        for value, code in ((1, 0x8120), (0, 0x0000)):
            begin_ns = drive.now_ns
            bench.stimulate("error_passive", value)
            frame = drive.await_emergency(code, begin_ns, f"error_passive = {value}")
            wanted = _COMMUNICATION | _GENERIC if value else 0
            seen = f"{frame.data[2]:02X}h"
            expected = f"1001h = {wanted:02X}h"
            drive.expect(frame.data[2] == wanted, f"EMCY {code:04X}h", expected, seen)
            bench.stimulate("error_passive", value)
            drive.quiet()
            count = len(drive.emergencies(begin_ns))
            drive.expect(count == 1, f"error_passive = {value} twice", "one EMCY", f"{count}")
    state = drive.state()
    drive.expect(
        state is State.OPERATION_ENABLED, "a passive node", "operation enabled", f"{state}"
    )
    for option, reaction in (
        (1, State.FAULT),
        (2, State.SWITCH_ON_DISABLED),
        (0, State.OPERATION_ENABLED),
    ):
        drive.set(od.ABORT_CONNECTION, option)
        drive.enable(mode)
        begin_ns = drive.now_ns
        bench.stimulate("bus_off", 1)
        drive.quiet()
        bench.stimulate("bus_off", 0)
        drive.await_emergency(0x8140, begin_ns, "recovered from bus-off")
        drive.await_state(reaction, f"bus-off, 6007h = {option}", "reaction of 6007h")
    drive.set(od.ABORT_CONNECTION, 1)
    begin_ns, destroyed = drive.now_ns, bench.strike(_TO_BUS_OFF)
    drive.client.send_message(0x600 + drive.node_id, b"\x40\0\x10\0".ljust(8, b"\0"))
    drive.quiet()
    what = f"{destroyed()} destroyed frames of the drive"
    drive.await_emergency(0x8140, begin_ns, what)
    drive.await_state(State.FAULT, what, "bus-off, 6007h = 1")


@drive_clause("ERR-09", Level.L5, source="CiA 301, 7.5.2.4; CiA 402-2, 605Eh, transition 14")
def second_fault(bench: DriveBench) -> None:
    """A short circuit ends a fault reaction at once; 1003h has both errors, the last one first."""
    drive = bench.drive
    drive.require(od.ERRORS_KEPT, od.ABORT_CONNECTION, od.FAULT_OPTION, od.HEARTBEAT_CONSUMER)
    pace = drive.pace()
    drive.write(od.ERRORS_KEPT, 0)
    drive.cruise(pace)
    drive.ramps(max(1, pace.acceleration // 4))
    drive.set(od.FAULT_OPTION, 2)
    begin_ns = drive.now_ns
    bench.stimulate("device_temperature_c", 95.0)
    drive.await_emergency(0x4210, begin_ns, "device at 95 C")
    state = drive.state()
    expected = "fault reaction active: it brakes"
    drive.expect(state is State.FAULT_REACTION_ACTIVE, "device at 95 C", expected, f"{state}")
    bench.stimulate("short_circuit", 1)
    drive.await_state(State.FAULT, "short circuit while braking", "at once", pace.ramp_s)
    shown = drive.find(od.ERROR_CODE)
    what = "short circuit while braking"
    drive.expect(shown in (0x2320, None), what, "603Fh = 2320h", f"{shown}")
    drive.near(od.ERRORS_KEPT, 2, 0, "two errors")
    codes = [drive.read(Entry(0x1003, place, "I", "error")) & 0xFFFF for place in (1, 2)]
    seen = ", ".join(f"{code:04X}h" for code in codes)
    drive.expect(codes == [0x2320, 0x4210], "1003h:1, 1003h:2", "2320h, 4210h", seen)
    register = drive.read(od.ERROR_REGISTER)
    drive.expect(register == 0x0B, "1001h after two errors", "0Bh", f"{register:02X}h")
    bench.stimulate("device_temperature_c", 25.0)
    for word in (0, od.FAULT_RESET, 0):
        drive.command(word)
        drive.quiet()
    drive.expect(drive.state() is State.FAULT, "short circuit present", "fault", "reset")
    bench.stimulate("short_circuit", 0)
    drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")
