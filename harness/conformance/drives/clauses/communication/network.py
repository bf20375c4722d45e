"""CANopen services: boot-up, NMT, heartbeat in both directions."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import BOOT_S, STATE_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

START: Final = 0x01
STOP: Final = 0x02
PRE_OPERATIONAL: Final = 0x80
RESET_NODE: Final = 0x81
RESET_COMMUNICATION: Final = 0x82
_NAMES: Final = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
_PERIOD_MS: Final = 200
_HOST: Final = 0x7C  # a node-ID that no other node of a bench uses
_CONSUMER_MS: Final = 200


@drive_clause("NMT-01", Level.L0, source="CiA 301, 7.2.8.3.3, boot-up; 7.2.8.3.2.2, node states")
def boot_up(bench: DriveBench) -> None:
    """After reset node and reset communication the drive sends one boot-up, and answers."""
    drive = bench.drive
    for command in (RESET_NODE, RESET_COMMUNICATION):
        begin_ns = drive.now_ns
        drive.client.node.nmt.send_command(command)

        def booted(since_ns: int = begin_ns) -> bool:
            heard = drive.client.heard(drive.error_control_id, since_ns)
            return any(one.data == b"\0" for one in heard)

        drive.client.wait_for(booted, BOOT_S)
        heard = drive.client.heard(drive.error_control_id, begin_ns)
        drive.expect(
            booted() and heard[0].data == b"\0",
            f"NMT {command:02X}h",
            f"{drive.error_control_id:03X}h [00] within {BOOT_S:g} s",
            ", ".join(one.data.hex() for one in heard) or "nothing",
            "no boot-up message",
        )
        drive.boot()
        word = drive.state()
        expected = "switch on disabled after a reset, with or without a fault before"
        if command == RESET_NODE:
            drive.await_state(State.SWITCH_ON_DISABLED, "reset node", expected)
        again = [
            one for one in drive.client.heard(drive.error_control_id, begin_ns) if one.data == b"\0"
        ]
        drive.expect(
            len(again) == 1, f"NMT {command:02X}h", "one boot-up message", f"{len(again)} ({word})"
        )


@drive_clause("NMT-02", Level.L0, source="CiA 301, 7.2.8.3.2, NMT state machine; 7.2.8.3.1")
def nmt_states(bench: DriveBench) -> None:
    """NMT commands change the state in the heartbeat; a stopped node answers no SDO, nor later."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_PRODUCER)
    drive.write(od.HEARTBEAT_PRODUCER, _PERIOD_MS)
    for command, state in ((START, 0x05), (STOP, 0x04), (PRE_OPERATIONAL, 0x7F), (START, 0x05)):
        if command == STOP:
            _ask(drive, od.DEVICE_TYPE)  # it may answer before the command, but not after
        drive.client.node.nmt.send_command(command)
        drive.quiet(_PERIOD_MS / 1e3)  # a heartbeat may be on its way
        since_ns = drive.now_ns
        drive.quiet(2.0 * _PERIOD_MS / 1e3)
        heard = drive.client.heard(drive.error_control_id, since_ns)
        seen = ", ".join(one.data.hex() for one in heard) or "no heartbeat"
        drive.expect(
            bool(heard)
            and all(len(one.data) == 1 and one.data[0] & 0x7F == state for one in heard),
            f"NMT {command:02X}h",
            f"heartbeats {state:02X}h ({_NAMES[state]})",
            seen,
            "the NMT command is ignored, or the heartbeat shows another state",
        )
        if state == 0x04:
            _ask(drive, od.DEVICE_TYPE)
            drive.quiet(0.1)
            answers = drive.client.heard(0x580 + drive.node_id, since_ns)
            seen = ", ".join(one.data.hex(" ") for one in answers)
            drive.expect(not answers, "SDO request in stopped", "no answer", seen)
        if state == 0x7F:
            _ask(drive, od.HEARTBEAT_PRODUCER)
            drive.quiet(0.1)
            answers = drive.client.heard(0x580 + drive.node_id, since_ns)
            drive.expect(
                all(one.data[1:4] == _place(od.HEARTBEAT_PRODUCER) for one in answers),
                f"upload of {od.HEARTBEAT_PRODUCER} in pre-operational, after stopped",
                "its answer",
                ", ".join(one.data.hex(" ") for one in answers),
                "an answer from before the stop comes late",
            )


def _ask(drive: Drive, entry: Entry) -> None:
    """Queue a request for an upload, whose answer is not awaited."""
    drive.client.send_message(0x600 + drive.node_id, bytes((0x40, *_place(entry), 0, 0, 0, 0)))


def _place(entry: Entry) -> bytes:
    return bytes((*entry.index.to_bytes(2, "little"), entry.subindex))


@drive_clause("NMT-03", Level.L0, source="CiA 301, 7.5.2.16, producer heartbeat time 1017h")
def heartbeat_period(bench: DriveBench) -> None:
    """The heartbeat has the period of 1017h, and 0 switches it off."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_PRODUCER)
    drive.write(od.HEARTBEAT_PRODUCER, _PERIOD_MS)
    drive.quiet(_PERIOD_MS / 1e3)
    begin_ns = drive.now_ns
    drive.quiet(10.0 * _PERIOD_MS / 1e3)
    times = [one.time_ns / 1e6 for one in drive.client.heard(drive.error_control_id, begin_ns)]
    mean_ms = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
    drive.expect(
        0.75 * _PERIOD_MS <= mean_ms <= 1.25 * _PERIOD_MS,
        f"1017h = {_PERIOD_MS}",
        f"a mean period of {_PERIOD_MS} ms +- 25 % (consumers allow for delays)",
        f"{len(times)} heartbeats, {mean_ms:.1f} ms",
        "the unit is not 1 ms, or the object has no effect",
    )
    drive.write(od.HEARTBEAT_PRODUCER, 0)
    drive.quiet(_PERIOD_MS / 1e3)
    begin_ns = drive.now_ns
    drive.quiet(3.0 * _PERIOD_MS / 1e3)
    left = len(drive.client.heard(drive.error_control_id, begin_ns))
    drive.expect(left == 0, "1017h = 0", "no heartbeat", f"{left} in {0.6:g} s")


@drive_clause("NMT-04", Level.L5, source="CiA 301, 7.5.2.15, 1016h, 1029h; CiA 402-2, 6007h")
def host_lost(bench: DriveBench) -> None:
    """A lost heartbeat of the host (1016h) sends EMCY 8130h; 6007h and 1029h:1 choose the rest."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_CONSUMER, od.ABORT_CONNECTION)
    mode = next((one for one in (Mode.PP, Mode.PV, Mode.CSP) if drive.has_mode(one)), None)
    if mode is None:
        raise NotApplicable("6502h claims none of pp, pv, csp")
    for option, state in (
        (1, State.FAULT),
        (2, State.SWITCH_ON_DISABLED),
        (3, State.SWITCH_ON_DISABLED),
        (0, State.OPERATION_ENABLED),
    ):
        if drive.offer_value(od.ABORT_CONNECTION, option):
            continue
        drive.enable(mode)
        drive.set(od.HEARTBEAT_CONSUMER, _HOST << 16 | _CONSUMER_MS)
        drive.client.send(0x700 + _HOST, b"\x05")
        begin_ns = drive.now_ns
        drive.quiet(_CONSUMER_MS / 2e3)
        early = drive.state()
        what = f"6007h = {option}, heartbeat of node {_HOST:02X}h"
        expected = f"operation enabled {_CONSUMER_MS // 2} ms after a heartbeat, within 1016h"
        drive.expect(
            early is State.OPERATION_ENABLED, what, expected, f"{early}", "1016h is not in ms"
        )
        drive.quiet(_CONSUMER_MS / 1e3)
        drive.await_emergency(0x8130, begin_ns, f"{what} lost after {_CONSUMER_MS} ms")
        drive.await_state(state, f"{what} lost", "reaction of 6007h")
        drive.write(od.HEARTBEAT_CONSUMER, 0)
    _expect_fault_when_switched_on(drive)
    _expect_error_behaviour(drive)


def _expect_fault_when_switched_on(drive: Drive) -> None:
    """Expect that 6007h = 1 makes a lost host a fault also before operation is enabled."""
    if drive.offer_value(od.ABORT_CONNECTION, 1):
        return
    drive.command(0)
    drive.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
    drive.become(State.SWITCHED_ON, od.SWITCH_ON, "transition 3")
    drive.set(od.HEARTBEAT_CONSUMER, _HOST << 16 | _CONSUMER_MS)
    drive.client.send(0x700 + _HOST, b"\x05")
    what = f"heartbeat of node {_HOST:02X}h lost when switched on, 6007h = 1"
    drive.await_state(State.FAULT, what, "reaction of 6007h", _CONSUMER_MS / 1e3 + STATE_S)
    drive.write(od.HEARTBEAT_CONSUMER, 0)
    drive.command(0)
    drive.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")


def _expect_error_behaviour(drive: Drive) -> None:
    """Check the NMT state that 1029h:1 chooses after a lost host; without it that of its 0."""
    own = drive.find(od.COMMUNICATION_ERROR)
    if drive.offer_value(od.HEARTBEAT_PRODUCER, _CONSUMER_MS // 4):
        return
    for behaviour, state in ((1, 0x05), (2, 0x04), (0, 0x7F)):
        if own is None and behaviour:
            continue
        if own is not None and drive.offer_value(od.COMMUNICATION_ERROR, behaviour):
            continue
        drive.client.node.nmt.send_command(START)
        drive.set(od.HEARTBEAT_CONSUMER, _HOST << 16 | _CONSUMER_MS)
        drive.client.send(0x700 + _HOST, b"\x05")
        drive.quiet(2.0 * _CONSUMER_MS / 1e3)
        since_ns = drive.now_ns
        drive.quiet(_CONSUMER_MS / 2e3)
        heard = drive.client.heard(drive.error_control_id, since_ns)
        drive.expect(
            bool(heard) and all(one.data[0] & 0x7F == state for one in heard),
            f"1029h:1 = {behaviour}, heartbeat of node {_HOST:02X}h lost in operational",
            f"heartbeats {state:02X}h ({_NAMES[state]})",
            ", ".join(one.data.hex() for one in heard) or "no heartbeat",
            "1029h is ignored",
        )
        drive.client.node.nmt.send_command(PRE_OPERATIONAL)
        drive.write(od.HEARTBEAT_CONSUMER, 0)
    if own is not None:
        drive.write(od.COMMUNICATION_ERROR, own)
    drive.write(od.HEARTBEAT_PRODUCER, 0)


@drive_clause("NMT-05", Level.L5, source="CiA 402-2, 6007h: NMT stopped is a lost connection")
def stopped_node(bench: DriveBench) -> None:
    """NMT stop and reset communication while moving cause the reaction of 6007h, as a lost host."""
    drive = bench.drive
    drive.require(od.ABORT_CONNECTION)
    pace = drive.pace()
    for command in (STOP, RESET_COMMUNICATION):
        for option, state in ((1, State.FAULT), (2, State.SWITCH_ON_DISABLED), (0, None)):
            if drive.offer_value(od.ABORT_CONNECTION, option):
                continue
            drive.client.node.nmt.send_command(START)
            drive.cruise(pace)
            drive.client.node.nmt.send_command(command)
            drive.quiet(3.0 * pace.ramp_s)
            drive.client.node.nmt.send_command(START)
            drive.boot()
            what = f"NMT {command:02X}h, 6007h = {option}"
            wanted = state or State.OPERATION_ENABLED
            drive.await_state(wanted, what, "reaction of 6007h", 2.0 * STATE_S)
            register = drive.find(od.ERROR_REGISTER)
            if state is State.FAULT and register is not None:
                seen = f"{register:02X}h"
                drive.expect(bool(register & 1), f"{what}: fault", "1001h bit 0 = 1", seen)
            drive.ramps(pace.acceleration)
            if state is None and drive.has_mode(Mode.PV):
                drive.near(od.VELOCITY, pace.velocity, pace.velocity // 10, what, "it stops")
                drive.write(od.TARGET_VELOCITY, 0)
