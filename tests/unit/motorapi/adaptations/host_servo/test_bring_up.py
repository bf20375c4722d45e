"""Central servo: bring-up of its node, and low-level access."""

from collections.abc import Callable

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotorBusyError, StateError, UsageError
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.software_rigs import (
    INC_PER_RAD,
    enabled,
    motor,
    moving,
    node,
    one,
    two,
)

OpenRig = Callable[..., Rig]


# --- low-level access, bring-up


def test_low_level_access_needs_a_servo_that_is_off(open_rig: OpenRig):
    rig = open_rig(two())
    left, right = enabled(rig, "left"), enabled(rig, "right")
    with pytest.raises(StateError, match=r"its servo holds it.*disable\(\)"), left.low_level():
        pass
    left.disable()
    with pytest.raises(StateError, match="neighbour channel"), left.low_level():
        pass
    right.disable()
    with left.low_level() as hardware:
        hardware.write(0x6411, 1234, 1, kind="i16")
        assert hardware.read(0x6411, 1, kind="i16") == 1234
        wire: list[int] = []
        rig.world.tap_frames(lambda bus, when, who, frame: wire.append(frame[0] | frame[1] << 8))
        busy: list[Exception] = []

        def other() -> None:
            try:
                right.enable()
            except MotorBusyError as error:
                busy.append(error)

        rig.runtime.spawn("other", other).join(1)
        assert busy
        rig.runtime.run_for(0.05)
        assert 0x080 not in wire
    left.enable()
    left.set_control_mode(ControlMode.SETPOINT, ControlVariable.POSITION)
    left.set_setpoint(0.05)
    left.start()
    left.wait_until_done(1)


def test_second_connection_writes_only_differences(open_rig: OpenRig):
    rig = open_rig(one())
    left = rig.motors["left"]
    left.position()
    hardware = left.hardware
    hardware.io.doubt()
    downloads: list[bytes] = []

    def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        if frame[:2] == b"\x01\x06" and frame[8] >> 5 == 1:
            downloads.append(frame)

    rig.world.tap_frames(on_frame)
    hardware.connect()
    assert downloads == []


def test_outputs_fall_to_0_despite_the_nodes_defaults(open_rig: OpenRig):
    objects = '[controller.io.objects]\n"6444h:1" = 20000\n"6443h:1" = 0\n"6206h:1" = 0\n'
    rig = open_rig(node("io", 1, more=objects), motor("left", "io"))
    moving(rig)
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("host",)))
    rig.runtime.run_for(0.5)
    truth = rig.controllers["io"].snapshot()
    assert (truth["output_v"], truth["ready"]) == (0.0, 0.0)


def test_drive_is_not_an_io_node_and_channel_must_exist(open_rig: OpenRig):
    rig = open_rig(drive("d", 3), one(), motor("far", "io", 4), motor("no", "d"))
    with pytest.raises(UsageError, match=r"node 3 is not an I/O node.*: 6411h, 6820h missing"):
        rig.motors["no"].position()
    with pytest.raises(UsageError, match="channel 4: the node has 1 channels"):
        rig.motors["far"].position()


def test_drive_and_servo_share_a_bus_undisturbed(open_rig: OpenRig):
    rig = open_rig(one(), drive("d", 3))
    left, d = moving(rig), rig.motors["d"]
    d.set_control_mode(ControlMode.TRAJECTORY)
    d.set_trajectory(TrapezoidalTrajectory(0.5))
    d.start()
    d.wait_until_done(3)
    left.wait_until_done(3)
    assert left.cycles.missed == 0
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)
