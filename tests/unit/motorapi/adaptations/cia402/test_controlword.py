"""Effects of the controlword, and effects that it must not have."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.objects import Mode, PdsState
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, UnsupportedError
from tests.support.motors.drive_rigs import drive

OpenRig = Callable[..., Rig]


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1), drive("right", 2))


def ready(rig: Rig, node_id: int = 1) -> Cia402HwMotor:
    """Return controls, enabled in pp, with a slow profile and target position 20,000 (0.95 rad)."""
    hw = Cia402HwMotor(rig.bus("can0"), node_id)
    hw.connect()
    hw.set_mode(Mode.PROFILE_POSITION)
    for name in ("profile_acceleration", "profile_deceleration", "profile_velocity"):
        hw.write(name, 40_000)
    hw.write("target_position", 20_000)
    hw.enable()
    return hw


def position(rig: Rig) -> float:
    return rig.controllers["left"].snapshot()["position_inc"]


def written_to_left(rig: Rig) -> list[tuple[str, int]]:
    """Record (object, value) of every SDO write to node 1 from now on."""
    found: list[tuple[str, int]] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        if data[:2] == b"\x01\x06" and data[8] >> 5 == 1:
            index = int.from_bytes(data[9:11], "little")
            size = 4 - (data[8] >> 2 & 3)
            value = int.from_bytes(data[12 : 12 + size], "little", signed=True)
            found.append((f"{index:04X}", value))

    rig.world.tap_frames(on_frame)
    return found


def test_arm_waits_until_its_frame_was_on_the_wire(rig: Rig):
    hw = ready(rig)
    heard: list[int] = []
    rig.world.tap_frames(
        lambda bus, time_ns, sender, data: heard.append(int.from_bytes(data[:4], "little"))
    )
    hw.control.arm(0x607A, 20_000)
    assert 0x301 in heard
    rig.runtime.run_for(0.3)
    assert position(rig) == 0
    hw.node.bus.sync.send()
    rig.runtime.run_for(0.3)
    assert position(rig) > 100
    hw.close()


def test_armed_target_does_not_start_after_a_halt(rig: Rig):
    hw = ready(rig)
    hw.control.take_set_points()
    hw.control.arm(0x607A, 20_000)
    hw.halt()
    rig.runtime.run_for(0.01)
    hw.node.bus.sync.send()
    rig.runtime.run_for(0.3)
    assert abs(position(rig)) <= 1
    hw.close()


def test_armed_target_does_not_start_after_disarm(rig: Rig):
    hw = ready(rig)
    hw.control.take_set_points()
    hw.control.arm(0x607A, 20_000)
    hw.control.disarm()
    hw.node.bus.sync.send()
    rig.runtime.run_for(0.3)
    assert abs(position(rig)) <= 1
    hw.close()


def test_set_point_after_a_stop_starts_nothing(rig: Rig):
    hw = ready(rig)
    hw.control.take_set_points()
    hw.halt()
    hw.control.send_set_point()
    rig.runtime.run_for(0.3)
    assert abs(position(rig)) <= 1
    hw.control.release()  # no set-point waits for the end of the halt
    rig.runtime.run_for(0.3)
    assert abs(position(rig)) <= 1
    hw.close()


def test_halt_lasts_until_the_next_set_point(rig: Rig):
    hw = ready(rig)
    hw.control.take_set_points()
    hw.control.send_set_point()
    rig.runtime.run_for(0.4)
    hw.halt()
    rig.runtime.run_for(0.5)
    at = position(rig)
    assert 500 < at < 19_000
    hw.control.take_set_points()
    rig.runtime.run_for(0.5)
    assert abs(position(rig) - at) <= 1
    hw.control.send_set_point()
    rig.runtime.run_for(1.5)
    assert abs(position(rig) - 20_000) <= 1
    hw.close()


def test_homing_starts_by_a_rising_edge_every_time(rig: Rig):
    motor = rig.motors["left"]
    motor.enable()
    words = written_to_left(rig)
    motor.home(37)
    motor.home(37)
    bits = [value >> 4 & 1 for name, value in words if name == "6040"]
    rises = sum(after > before for before, after in pairwise(bits))
    assert rises == 2


def test_entering_pv_clears_the_old_target_velocity(rig: Rig):
    motor = rig.motors["left"]
    for velocity in (2.0, 0.5):
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(velocity)
        words = written_to_left(rig)
        motor.start()
        entered = words.index(("6060", 3))
        assert [value for name, value in words[:entered] if name == "60FF"] == [0]
        motor.wait_until_done(timeout_s=5)
        motor.stop()
        motor.wait_until_done(timeout_s=5)
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(0.0)
        motor.start()
        motor.wait_until_done(timeout_s=5)


def test_mode_not_confirmed_by_6061h_raises_an_error(rig: Rig, monkeypatch: pytest.MonkeyPatch):
    hw = ready(rig)
    read = hw.objects.read_int
    monkeypatch.setattr(
        type(hw.objects),
        "read_int",
        lambda self, what, subindex=0: 1 if what == 0x6061 else read(what, subindex),
    )
    with pytest.raises(DeadlineExceeded, match="mode HOMING in 6061h") as caught:
        hw.set_mode(Mode.HOMING)
    assert caught.value.last_heard == "mode 1"
    hw.close()


def test_mode_missing_in_6502h_is_refused_before_sending(rig: Rig):
    hw = ready(rig)
    words = written_to_left(rig)
    with pytest.raises(UnsupportedError, match="mode VELOCITY; it supports PROFILE_POSITION"):
        hw.set_mode(Mode.VELOCITY)
    assert words == []
    hw.close()


@pytest.mark.parametrize("lost", [1, 2])
def test_lost_controlword_is_sent_again(rig: Rig, lost: int):
    motor = rig.motors["left"]
    motor.enable()
    rule = FaultRule("lose", FaultKind.DROP, identifier=0x201, limit=lost)
    rig.faults.inject("can0", rule)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.5)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert rig.faults.fired()["lose"] == lost
    assert abs(rig.controllers["left"].snapshot()["position_rad"] - 0.5) < 1e-3


def test_controlword_that_never_arrives_raises_an_error(rig: Rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.faults.inject("can0", FaultRule("lose", FaultKind.DROP, identifier=0x201))
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.5)
    with pytest.raises(DeadlineExceeded, match="left: set-point acknowledge"):
        motor.start()
    assert position(rig) == 0


def test_enable_works_from_any_state(rig: Rig):
    hw = ready(rig)
    for word in (0x06, 0x07, 0x02, 0x00):  # RTSO, SO, QSA or SOD, SOD
        hw.write("controlword", word)
        rig.runtime.run_for(0.2)
        assert hw.state is not PdsState.OPERATION_ENABLED
        hw.enable()
        assert hw.state is PdsState.OPERATION_ENABLED
    hw.close()


def test_drive_in_fault_is_not_enabled_before_reset(rig: Rig):
    hw = ready(rig)
    rig.controllers["left"].stimulate("fault", 0x4310)
    rig.runtime.run_for(0.5)
    with pytest.raises(DeviceFault, match="4310h"):
        hw.enable()
    hw.reset_fault()
    assert hw.state is PdsState.SWITCH_ON_DISABLED
    hw.reset_fault()  # nothing to do
    hw.enable()
    hw.close()


def test_fault_with_persistent_cause_is_reported(rig: Rig):
    hw = ready(rig)
    rig.controllers["left"].stimulate("power", 0)
    rig.runtime.run_for(0.5)
    with pytest.raises(DeviceFault, match="3220h"):
        hw.reset_fault()
    rig.controllers["left"].stimulate("power", 1)
    rig.runtime.run_for(0.1)
    hw.reset_fault()
    assert hw.state is PdsState.SWITCH_ON_DISABLED
    hw.close()


def test_a_quick_stop_at_any_moment_of_enable_does_not_end_it(open_rig: OpenRig):
    """A quick stop leads back to a state that no poll may have seen the drive leave."""
    rig = open_rig(drive("left", 1, motor="status_period_ms = 0"))
    motor, runtime = rig.motors["left"], rig.runtime
    motor.enable()
    motor.disable()
    begun_ns = runtime.now_ns()
    motor.enable()
    usual_ns = runtime.now_ns() - begun_ns
    hit = 0
    for part in range(50):
        motor.disable()

        def stop(after_s: float = part / 50 * usual_ns / 1e9) -> None:
            runtime.wait_until(lambda: False, after_s)
            motor.quick_stop()

        party = runtime.spawn("stop", stop)
        begun_ns = runtime.now_ns()
        motor.enable()
        hit += runtime.now_ns() - begun_ns > usual_ns
        assert party.join(1.0)
        assert party.error is None
    assert hit > 10, "most stops came while nothing was to be enabled"
