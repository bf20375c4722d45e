"""Bring-up of a drive: detection, identification, minimal configuration."""

from collections.abc import Callable
from itertools import pairwise
from math import inf, nan

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.objects import Mode, PdsState
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotionInterrupted, UsageError
from motorhil.motorapi.state import MotorState
from tests.support.motors.drive_rigs import drive
from tests.support.motors.scripted import MS, Answer, ScriptedBus, frame

OpenRig = Callable[..., Rig]


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


def host_frames(rig: Rig) -> list[tuple[int, int, bytes]]:
    """Record (time, identifier, data) of every frame of the host from now on."""
    heard: list[tuple[int, int, bytes]] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        if sender.startswith("host"):
            heard.append((time_ns, int.from_bytes(data[:4], "little"), data[8 : 8 + data[4]]))

    rig.world.tap_frames(on_frame)
    return heard


def downloads(frames: list[tuple[int, int, bytes]]) -> list[str]:
    """Return the objects written by SDO, as "6040:00"."""
    return [
        f"{int.from_bytes(data[1:3], 'little'):04X}:{data[3]:02X}"
        for _, can_id, data in frames
        if can_id == 0x601 and data[0] >> 5 == 1
    ]


def test_bring_up_of_a_booting_drive_waits(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    facts = hw.connect()
    assert facts.modes == {
        Mode.PROFILE_POSITION,
        Mode.PROFILE_VELOCITY,
        Mode.PROFILE_TORQUE,
        Mode.HOMING,
        Mode.INTERPOLATED_POSITION,
        Mode.CYCLIC_SYNC_POSITION,
        Mode.CYCLIC_SYNC_VELOCITY,
        Mode.CYCLIC_SYNC_TORQUE,
    }
    assert facts.control_id == 0x201
    assert facts.latched_ids == {0x607A: 0x301, 0x60FF: 0x401}
    assert facts.limitations == ()
    assert hw.state is PdsState.SWITCH_ON_DISABLED
    assert rig.runtime.now_ns() < 500 * MS  # boot-up takes 300
    hw.close()


def test_bring_up_sets_mutual_supervision(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    frames = host_frames(rig)
    hw.connect()
    assert hw.read("producer_heartbeat_time") == 100
    assert hw.read("consumer_heartbeat_time") == 127 << 16 | 300
    assert hw.read("abort_connection_option_code") == 3
    beats = [time_ns for time_ns, can_id, data in frames if (can_id, data) == (0x77F, b"\x05")]
    assert beats[0] < 1 * MS
    rig.runtime.run_for(1.0)
    beats = [time_ns for time_ns, can_id, _ in frames if can_id == 0x77F]
    assert all(90 * MS < after - before < 110 * MS for before, after in pairwise(beats))
    hw.close()


def test_bring_up_without_heartbeats_sets_no_supervision(rig: Rig):
    Cia402HwMotor(rig.bus("can0"), 1).connect()  # dropped at once
    hw = Cia402HwMotor(rig.bus("can0"), 1, options=HwOptions(heartbeat_ms=0))
    hw.enable()
    frames = host_frames(rig)
    rig.runtime.run_for(1.0)
    assert hw.state is PdsState.OPERATION_ENABLED
    assert hw.read("producer_heartbeat_time") == hw.read("consumer_heartbeat_time") == 0
    assert [can_id for _, can_id, _ in frames if can_id == 0x77F] == []
    hw.close()


def test_start_after_a_program_that_left_the_motor_on(rig: Rig):
    first = Cia402HwMotor(rig.bus("can0"), 1)
    first.enable()
    first.close()
    rig.runtime.run_for(1.0)
    assert rig.controllers["left"].snapshot()["state"] == 1.0  # switch on disabled: quick stop
    second = Cia402HwMotor(rig.bus("can0"), 1)
    second.enable()
    assert second.state is PdsState.OPERATION_ENABLED
    second.close()


def test_second_program_writes_nothing_and_stops_nothing(rig: Rig):
    first = Cia402HwMotor(rig.bus("can0"), 1)
    first.connect()
    first.close()
    frames = host_frames(rig)
    second = Cia402HwMotor(rig.bus("can0"), 1)
    second.connect()
    assert downloads(frames) == []
    assert [data for _, can_id, data in frames if can_id == 0] == [b"\x01\x01"]  # NMT start only
    second.close()


def test_status_in_words_names_its_state(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    hw.connect()
    assert "(switch on disabled), position 0 increments" in hw.node.describe_status()
    hw.node.statusword = 0x4E  # no state of the standard
    assert "(no state of CiA 402)" in hw.node.describe_status()
    hw.close()


def test_second_connect_sends_nothing(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    facts = hw.connect()
    now_ns = rig.runtime.now_ns()
    assert hw.connect() is facts
    assert rig.runtime.now_ns() == now_ns
    hw.close()


def test_concurrent_connects_bring_up_once(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    frames = host_frames(rig)
    parties = [rig.runtime.spawn(name, lambda: hw.connect() and None) for name in ("a", "b")]
    assert all(party.join(5.0) for party in parties)
    assert [party.error for party in parties] == [None, None]
    assert [data for _, can_id, data in frames if can_id == 0] == [b"\x80\x01", b"\x01\x01"]
    hw.close()


def test_status_tpdo_comes_every_20_ms_and_on_change(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    hw.connect()
    times: list[int] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        if data[:4] == b"\x81\x01\0\0":
            times.append(time_ns)

    rig.world.tap_frames(on_frame)
    rig.runtime.run_for(0.5)
    assert 24 <= len(times) <= 25
    times.clear()
    hw.write(0x6040, 0x0006)
    written_ns = rig.runtime.now_ns()
    assert hw.state is PdsState.READY_TO_SWITCH_ON or rig.runtime.wait_until(
        lambda: hw.state is PdsState.READY_TO_SWITCH_ON, 0.01
    )
    assert rig.runtime.now_ns() - written_ns < 3 * MS
    hw.close()


def test_velocity_tpdo_comes_cyclically_if_requested(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, motor="velocity_period_ms = 10"))
    motor = rig.motors["left"]
    motor.position()
    rig.runtime.run_for(0.05)
    latest = motor.latest()
    assert latest is not None
    assert latest.velocity == 0.0


def test_longest_velocity_period_fits_the_inhibit_time(open_rig: OpenRig):
    # CiA 301: inhibit times (sub-index 3) are UNSIGNED16 in 100 us, event timers (5) in ms.
    rig = open_rig(drive("left", 1))
    hw = Cia402HwMotor(rig.bus("can0"), 1, options=HwOptions(velocity_period_ms=65535))
    hw.connect()
    assert (hw.read(0x1801, 3), hw.read(0x1801, 5)) == (65535, 65535)
    hw.close()


def test_bring_up_disables_other_tpdos(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    hw.connect()
    for number in range(1, 4):
        cob_id = hw.read(0x1800 + number, 1)
        assert isinstance(cob_id, int)
        assert cob_id & 0x8000_0000
    hw.close()


@pytest.mark.parametrize("period_ms", [0, 10])
def test_bring_up_disables_tpdo_3_beside_velocity(open_rig: OpenRig, period_ms: int):
    rig = open_rig(drive("left", 1, "objects = { '1802h:1' = 0x381 }"))
    hw = Cia402HwMotor(rig.bus("can0"), 1, options=HwOptions(velocity_period_ms=period_ms))
    hw.connect()
    cob_id = hw.read(0x1802, 1)
    assert isinstance(cob_id, int)
    assert cob_id & 0x8000_0000
    hw.close()


def test_drive_with_fixed_pdos_is_polled_by_sdo(open_rig: OpenRig):
    rig = open_rig(drive("left", 1), drive("right", 2))
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    refuse = hw.node.sdo.download

    def refusing(index: int, subindex: int, data: bytes, *, stops: bool = False) -> None:
        if 0x1600 <= index < 0x1A04:  # a drive with fixed mapping and TPDO parameters
            raise SdoAborted(node_id=1, index=index, subindex=subindex, abort_code=0x0601_0002)
        refuse(index, subindex, data, stops=stops)

    hw.node.sdo.download = refusing  # type: ignore[method-assign]
    facts = hw.connect()
    assert facts.latched_ids == {}
    assert any("RPDO 2 cannot be mapped" in text for text in facts.limitations)
    hw.enable()
    assert hw.state is PdsState.OPERATION_ENABLED
    hw.disable()
    assert hw.state is PdsState.SWITCH_ON_DISABLED
    hw.close()


def test_objects_are_accessed_by_name_index_and_bytes(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    hw.connect()
    hw.write("target_position", -5)
    assert hw.read(0x607A) == -5
    assert hw.upload(0x607A) == b"\xfb\xff\xff\xff"
    hw.download(0x607A, 0, b"\x07\0\0\0")
    assert hw.read("target_position") == 7
    assert hw.read(0x607A, kind="bytes") == b"\x07\0\0\0"
    with pytest.raises(UsageError, match="did you mean 'target_position'"):
        hw.read("target_positon")
    with pytest.raises(UsageError, match="2000h:01h is not in the standard: say kind="):
        hw.write(0x2000, 1, 1)
    with pytest.raises(UsageError, match="does not fit the data type i8"):
        hw.write("modes_of_operation", 200)
    with pytest.raises(SdoAborted, match="2FFFh:00h aborted: object does not exist"):
        hw.upload(0x2FFF)
    with hw.sdo() as sdo:  # canopen's own client, on the same channel
        assert sdo.upload(0x6061, 0) == b"\x01"  # pp
    hw.close()


def test_written_values_are_forgotten_when_motor_changes_hands(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), 1)
    hw.connect()
    frames = host_frames(rig)
    assert hw.objects.push(0x6083, 1000)
    assert not hw.objects.push(0x6083, 1000)
    hw.physical.token += 1  # another logical motor had it meanwhile
    assert hw.objects.push(0x6083, 1000)
    assert not hw.objects.push(0x6083, 1000)
    hw.write(0x6083, 999)  # by hand
    assert hw.objects.push(0x6083, 1000)
    assert downloads(frames) == ["6083:00"] * 4
    hw.close()


def test_missing_drive_raises_deadline_with_place():
    bus = ScriptedBus()
    hw = Cia402HwMotor(bus, 9, options=HwOptions(connect_timeout_s=2.0))
    with pytest.raises(DeadlineExceeded, match="script0 node 9: any answer: did not happen") as at:
        hw.connect()
    assert at.value.last_heard == "nothing"
    assert 2.0 <= bus.runtime.now_ns() / 1e9 <= 3.5
    hw.close()


def test_bring_up_of_a_non_drive_is_refused():
    def an_io_module(data: bytes) -> list[Answer]:
        if data[:4] != b"\x09\x06\0\0" or data[8] == 0x80:
            return []
        return [(1 * MS, frame("589#4300100091010F00"))]  # 000F0191h: CiA 401

    hw = Cia402HwMotor(ScriptedBus(an_io_module), 9)
    with pytest.raises(UsageError, match="not a CiA 402 drive: its device type 1000h is 000F0191h"):
        hw.connect()
    hw.close()


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"host_node_id": 0}, "host_node_id: 0 is out of range; allowed: 1 to 127"),
        (
            {"heartbeat_ms": 70_000},
            "heartbeat_ms: 70000 ms is out of range; allowed: 0 to 65535 ms",
        ),
        (
            {"heartbeat_ms": 1.5},
            r"heartbeat_ms: must be an integer \[ms\], but is a float \(1\.5\)",
        ),
        (
            {"heartbeat_ms": 300},
            "heartbeat_timeout_ms: 300 ms is not longer than heartbeat_ms = 300 ms",
        ),
        (
            {"velocity_period_ms": -1},
            "velocity_period_ms: -1 ms is out of range; allowed: 0 to 65535 ms",
        ),
        (
            {"status_inhibit_ms": nan},
            r"status_inhibit_ms: must be finite \(nan\); allowed: 0 to 6553\.5 ms",
        ),
        (
            {"status_inhibit_ms": 6553.6},
            r"status_inhibit_ms: 6553\.6 ms is out of range; allowed: 0 to 6553\.5 ms",
        ),
        ({"connection_loss": 99}, "connection_loss: 99 is out of range; allowed: -32768 to 3"),
        ({"servo_period_ms": -1}, "servo_period_ms: -1 ms is out of range; allowed: 0 to 1000 ms"),
        (
            {"sdo_timeout_s": 0.0},
            r"sdo_timeout_s: 0\.0 s is out of range; allowed: more than 0, up to 3600 s",
        ),
        ({"connect_timeout_s": inf}, r"connect_timeout_s: must be finite \(inf\)"),
        (
            {"connect_timeout_s": "3"},
            r'connect_timeout_s: must be a number \[s\], but is a string \("3"\)',
        ),
    ],
)
def test_invalid_hw_options_are_refused(wrong: dict[str, float], text: str):
    with pytest.raises(UsageError, match=text):
        HwOptions(**wrong)  # type: ignore[arg-type]


def test_host_node_id_of_a_drive_is_refused(open_rig: OpenRig):
    bus = open_rig(drive("left", 1), drive("right", 2)).bus("can0")
    with pytest.raises(UsageError, match=r"node 127 is also the host's.*host_node_id"):
        Cia402HwMotor(bus, 127)
    left = Cia402HwMotor(bus, 1, options=HwOptions(host_node_id=2))
    right = Cia402HwMotor(bus, 2)
    with pytest.raises(UsageError, match=r"host_node_id = 2 is the node-ID of a drive here"):
        left.connect()
    right.close()
    left.connect()
    with pytest.raises(UsageError, match=r"node 2 is also the host's.*host_node_id"):
        Cia402HwMotor(bus, 2)
    left.close()
    Cia402HwMotor(bus, 2).close()


def test_closed_motor_is_offline_and_its_motion_ended(open_rig: OpenRig):
    left = open_rig(drive("left", 1)).motors["left"]
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint(10.0)
    left.start()
    left.runtime.wait_until(lambda: False, 0.1)
    left.close()
    assert left.state() is MotorState.OFFLINE
    for ask in (left.is_done, left.wait_until_done):
        with pytest.raises(MotionInterrupted, match=r"ended by close\(\) of can0 node 1 at 0\."):
            ask()
    with pytest.raises(LinkError, match="left: this motor was closed"):
        left.position()
    with pytest.raises(LinkError, match="can0 node 1: this hardware object is closed"):
        left.logical.hooks.read_position()
    assert "closed" in repr(left.hardware)  # type: ignore[attr-defined]


# --- motors from settings ------------------------------------------------------------------------


def test_motors_built_for_one_drive_share_its_hardware(open_rig: OpenRig):
    rig = open_rig(
        drive("left", 1),
        """
[motor.again]
adaptation = "cia402"
controller = "left"
[motor.again.model]
name = "wheel"
velocity_max_rad_s = 3.0
acceleration_max_rad_s2 = 10.0
""",
    )
    left, again = rig.motors["left"], rig.motors["again"]
    assert left.hardware is again.hardware  # type: ignore[attr-defined]
    left.close()
    left.close()
    assert again.position() == 0.0
    hardware = again.hardware  # type: ignore[attr-defined]
    again.close()
    assert hardware.is_closed


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        (
            "heartbeat = 100",
            r"motor\.left\.heartbeat: unknown key",
        ),
        (
            'heartbeat_ms = "fast"',
            r'motor\.left\.heartbeat_ms: must be an integer \[ms\], but is a string \("fast"\)',
        ),
        ("sdo_timeout_s = -1", r"motor\.left\.sdo_timeout_s: -1 s is out of range"),
    ],
)
def test_invalid_settings_error_names_the_remedy(open_rig: OpenRig, setting: str, text: str):
    rig = open_rig(drive("left", 1, motor=setting))
    with pytest.raises(Exception, match=text):
        rig.motors["left"]
