"""Failures of central servo: missed cycles, lost nodes, hosts, amplifiers."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, LinkError, UsageError
from motorhil.motorapi.runtime.can_link import can_frame
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.software_rigs import (
    INC_PER_RAD,
    INERTIA_A_S2_RAD,
    WHEEL,
    commanded,
    enabled,
    inc,
    lag_bound_inc,
    motor,
    moving,
    node,
    one,
    two,
)

OpenRig = Callable[..., Rig]
MS = 1_000_000
COUNTS = 0x281  # TPDO 2 of node 1
OUTPUTS = 0x301  # RPDO 2 of node 1


def rule(kind: FaultKind, can_id: int, **conditions: object) -> FaultRule:
    return FaultRule(kind.value, kind, identifier=can_id, **conditions)


# --- missed cycles


@pytest.mark.parametrize("count", [1, 4])
def test_late_counts_are_misses_and_motion_continues(open_rig: OpenRig, count: int):
    rig = open_rig(one())
    left = moving(rig)
    before = left.cycles
    assert before.missed == 0
    late = rule(FaultKind.DELAY, COUNTS, delay_ns=1_300_000, limit=count, skip=10, probability=1.0)
    rig.faults.inject("can0", late)
    left.wait_until_done(3)
    after = left.cycles
    # Each is missed by its own cycle. The last delayed count comes in a cycle that has its own
    # count as well; the others replace a count that is late itself.
    assert rig.faults.fired()["delay"] == count
    assert (after.counts_missed, after.outputs_late, after.surplus) == (1, 0, 1)
    assert after.worst_in_a_row == 1
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)


def test_velocity_with_late_counts_is_true(open_rig: OpenRig):
    rig = open_rig(one())
    left = moving(rig)
    truth: list[float] = []
    rig.runtime.every(
        0.001, lambda: truth.append(rig.controllers["io"].snapshot()["velocity_rad_s"])
    )
    late = rule(FaultKind.DELAY, COUNTS, delay_ns=20_300_000, probability=0.3)
    rig.faults.inject("can0", late)
    for _ in range(40):
        rig.runtime.run_for(0.003)
        recent = truth[-50:]
        velocity = left.velocity()
        assert min(*recent, *truth[-50:]) - 0.2 <= velocity <= max(*recent, *truth[-50:]) + 0.2
    latest = left.latest()
    assert latest is not None
    assert latest.velocity is None
    rig.faults.lift("can0", "delay")
    left.wait_until_done(3)
    rig.runtime.run_for(1.0)
    latest = left.latest()
    assert latest is not None
    assert latest.velocity == pytest.approx(0.0, abs=0.01)


def test_velocity_with_late_answers_raises_a_deadline_error(open_rig: OpenRig):
    rig = open_rig(one())
    left = moving(rig)
    left.disable()
    rig.faults.inject("can0", rule(FaultKind.DELAY, 0x581, delay_ns=150_000_000))
    with pytest.raises(DeadlineExceeded, match="the last one took 151 ms"):
        left.velocity()


def test_velocity_of_a_coasting_motor_beside_a_servo(open_rig: OpenRig):
    """Its counts come with those of the servo, but it has no part in the cycle."""
    rig = open_rig(two())
    right = moving(rig, "right")
    moving(rig, "left")
    right.disable()
    velocity = right.velocity()
    assert velocity == pytest.approx(
        rig.controllers["io"].snapshot()["channel_2_velocity_rad_s"], rel=0.3
    )
    assert velocity > 0.2


@pytest.mark.parametrize("count", [1, 3])
def test_lost_counts_are_counted_singly_and_in_a_row(open_rig: OpenRig, count: int):
    rig = open_rig(one())
    left = moving(rig)
    worst: list[float] = []
    rig.runtime.every(0.001, lambda: worst.append(abs(left.following_error()) * INC_PER_RAD))
    rig.faults.inject("can0", rule(FaultKind.DROP, COUNTS, limit=count))
    left.wait_until_done(3)
    report = left.cycles
    assert (report.counts_missed, report.worst_in_a_row, report.surplus) == (count, count, 0)
    assert f"{count} counts missed, 0 outputs late, at most {count} in a row" in str(report)
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)
    # only the outputs of those cycles are older than they should be
    assert max(worst) < lag_bound_inc() + 20 * count


def test_outputs_that_still_wait_at_sync_are_late(open_rig: OpenRig):
    """More urgent frames occupy the bus from the counts on until after the next SYNC."""
    rig = open_rig(one())
    left = moving(rig)
    port = rig.world.add_host("can0", "stranger", lambda *_: None)
    frames = [(0x010).to_bytes(4, "little") + b"\x08\0\0\0" + bytes(range(8))] * 9
    bursts = [3]

    def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        if frame[:4] == COUNTS.to_bytes(4, "little") and bursts[0]:
            bursts[0] -= 1
            for one_of_nine in frames:
                port.send(one_of_nine)

    rig.world.tap_frames(on_frame)
    left.wait_until_done(3)
    report = left.cycles
    assert report.outputs_late >= 1
    assert report.missed >= 2
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)


def test_too_many_misses_in_a_row_switch_the_motor_off(open_rig: OpenRig):
    rig = open_rig(one(motor="misses_max = 5"))
    left = moving(rig)
    begun = left.cycles.counts_missed
    rig.faults.inject("can0", rule(FaultKind.DROP, COUNTS))
    since_ns = rig.runtime.now_ns()
    with pytest.raises(LinkError, match="no counts came in 5 cycles of 1 ms in a row") as caught:
        left.wait_until_done(3)
    assert rig.runtime.now_ns() - since_ns <= 7 * MS
    assert since_ns - 2 * MS <= caught.value.since_ns <= since_ns
    assert left.cycles.counts_missed - begun == 5
    rig.runtime.run_for(0.01)
    truth = rig.controllers["io"].snapshot()
    assert (truth["ready"], truth["current_a"]) == (0.0, 0.0)
    assert left.state() is MotorState.FAULT
    with pytest.raises(DeviceFault, match="8100h"):
        left.start()
    rig.faults.lift("can0", "drop")
    left.reset_fault()
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    rig.runtime.run_for(1.0)
    left.start()
    left.wait_until_done(2)


def test_late_outputs_in_a_row_raise_a_deadline_error(open_rig: OpenRig):
    """On a bus that is always full, SYNC is delayed too, which is a miss as well."""
    rig = open_rig(one(motor="misses_max = 4"))
    left = moving(rig)
    port = rig.world.add_host("can0", "stranger", lambda *_: None)
    frame = (0x010).to_bytes(4, "little") + b"\x08\0\0\0" + bytes(range(8))

    def on_frame(bus: str, time_ns: int, sender: str, heard: bytes) -> None:
        if heard[:4] == COUNTS.to_bytes(4, "little"):
            for _ in range(9):
                port.send(frame)

    rig.world.tap_frames(on_frame)
    with pytest.raises((DeadlineExceeded, LinkError)) as caught:
        left.wait_until_done(3)
    assert "in a row" in str(caught.value)
    assert left.cycles.outputs_late >= 1
    rig.runtime.run_for(0.01)
    assert rig.controllers["io"].snapshot()["ready"] == 0.0


def test_servo_on_another_node_continues(open_rig: OpenRig):
    rig = open_rig(node("io", 1), node("b", 2), motor("left", "io"), motor("right", "b"))
    right = moving(rig, "right")
    left = moving(rig, "left")
    rig.faults.inject("can0", rule(FaultKind.DROP, COUNTS))
    with pytest.raises(LinkError):
        left.wait_until_done(3)
    right.wait_until_done(3)
    assert right.cycles.missed == 0


def test_two_motors_of_one_bus_share_one_period(open_rig: OpenRig):
    rig = open_rig(
        node("io", 1), node("b", 2), motor("left", "io"), motor("right", "b", motor="cycle_ms = 2")
    )
    left = moving(rig, "left")
    with pytest.raises(UsageError, match="SYNC runs every 1 ms already, so not every 2 ms"):
        rig.motors["right"].enable()
    left.wait_until_done(3)


def test_servo_works_at_2_ms(open_rig: OpenRig):
    rig = open_rig(one(motor="cycle_ms = 2", bandwidth=30.0))
    left = moving(rig)
    left.wait_until_done(3)
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)
    assert left.cycles.period_s == 0.002


# --- the node, the host and the amplifier


def test_dead_host_leaves_outputs_at_error_values(
    open_rig: OpenRig,
):
    rig = open_rig(one())
    left = moving(rig)
    assert rig.controllers["io"].snapshot()["ready"] == 1.0
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("host",)))
    killed_ns = rig.runtime.now_ns()
    off: list[int] = []

    def look() -> None:
        truth = rig.controllers["io"].snapshot()
        if not off and truth["ready"] == 0.0 and truth["output_v"] == 0.0:
            off.append(rig.runtime.now_ns())

    rig.runtime.every(0.001, look)
    rig.runtime.run_for(0.5)
    assert off
    assert 190 * MS < off[0] - killed_ns <= 301 * MS  # 300 ms after the last heartbeat heard
    with pytest.raises(LinkError):
        left.is_done()


def test_lost_node_is_a_link_error_within_the_misses(open_rig: OpenRig):
    rig = open_rig(one())
    left = moving(rig)
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("io",)))
    lost_ns = rig.runtime.now_ns()
    with pytest.raises(LinkError, match="no counts came in 10 cycles"):
        left.wait_until_done(3)
    assert rig.runtime.now_ns() - lost_ns <= 12 * MS
    rig.runtime.run_for(0.4)
    assert left.state() is MotorState.OFFLINE
    with pytest.raises(LinkError, match="no heartbeat for 300 ms"):
        left.position()
    rig.faults.lift("can0", "cut")
    rig.runtime.run_for(0.5)
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()  # brought up again: its fault was of the connection
    left.wait_until_done(2)


def test_silent_node_is_lost_by_its_heartbeat(open_rig: OpenRig):
    rig = open_rig(one(motor="misses_max = 1000000"))
    left = moving(rig, distance=20.0)
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("io",)))
    lost_ns = rig.runtime.now_ns()
    with pytest.raises(LinkError, match="no heartbeat for 300 ms"):
        left.wait_until_done(30)
    assert rig.runtime.now_ns() - lost_ns <= 301 * MS
    rig.runtime.run_for(0.01)
    assert not left.hardware.axis.is_powered
    assert left.hardware.node.bus.sync.period_ns is None


def test_misses_that_are_not_in_a_row_stop_nothing(open_rig: OpenRig):
    rig = open_rig(one(motor="misses_max = 3"))
    left = moving(rig)
    for k in range(6):
        lost = FaultRule(f"drop {k}", FaultKind.DROP, identifier=COUNTS, skip=3 * k, limit=1)
        rig.faults.inject("can0", lost)
    left.wait_until_done(3)
    assert (left.cycles.counts_missed, left.cycles.worst_in_a_row) == (6, 1)


def test_rebooted_node_is_brought_up_again(open_rig: OpenRig):
    rig = open_rig(one())
    left = moving(rig, distance=0.3)
    left.wait_until_done(2)
    left.home()
    moving(rig)
    left.hardware.link.send(can_frame(0x000, b"\x81\x01"))  # NMT: reset node
    with pytest.raises(LinkError):
        left.wait_until_done(3)
    rig.runtime.run_for(2.0)
    assert not left.is_referenced()
    assert left.position() == inc(rig) / INC_PER_RAD  # its counter was restarted
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()
    begun = inc(rig)
    left.wait_until_done(2)
    assert inc(rig) - begun == pytest.approx(0.1 * INC_PER_RAD, abs=30)


def test_amplifier_fault_ends_the_motion_at_its_frame(open_rig: OpenRig):
    rig = open_rig(two())
    right = moving(rig, "right")
    left = moving(rig, "left")
    rig.controllers["io"].stimulate("fault", 1)
    since_ns = rig.runtime.now_ns()
    with pytest.raises(DeviceFault, match=r"left: fault 5400h \(amplifier fault\)"):
        left.wait_until_done(3)
    assert rig.runtime.now_ns() - since_ns < MS
    assert left.state() is MotorState.FAULT
    assert left.fault().code == 0x5400
    right.wait_until_done(3)  # its amplifier has no fault
    with pytest.raises(DeviceFault):
        left.reset_fault()
    rig.controllers["io"].stimulate("fault", 0)
    left.reset_fault()
    assert left.fault() is None
    left.enable()
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()
    left.wait_until_done(2)


def test_amplifier_without_supply_is_a_fault_while_driving(open_rig: OpenRig):
    rig = open_rig(one())
    left = moving(rig)
    rig.controllers["io"].stimulate("power", 0)
    with pytest.raises(DeviceFault, match="amplifier not ready"):
        left.wait_until_done(3)
    left.reset_fault()
    with pytest.raises(DeadlineExceeded, match="its amplifier to be ready"):
        left.enable()
    assert left.state() is MotorState.DISABLED
    rig.controllers["io"].stimulate("power", 1)
    left.enable()


def test_blocked_motor_is_stopped_by_following_error(open_rig: OpenRig):
    rig = open_rig(one(motor="following_error_window_rad = 0.05\nfollowing_error_s = 0.02"))
    left = moving(rig)
    rig.controllers["io"].stimulate("load_torque_n_m", 20.0)  # the motor has 13.7 N m
    with pytest.raises(DeviceFault, match=r"8611h \(following error: \d+ increments\)"):
        left.wait_until_done(3)
    rig.controllers["io"].stimulate("load_torque_n_m", 0.0)
    rig.runtime.run_for(1.0)
    left.reset_fault()
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()
    left.wait_until_done(2)


def test_set_point_whose_outputs_are_lost_fails(open_rig: OpenRig):
    for at_s in (0.0, 0.05, 0.2):  # before it moves, as it accelerates, and at its velocity
        with open_rig(one()) as rig:
            left = enabled(rig)
            rule = FaultRule("lost", FaultKind.DROP, identifier=0x301)
            if not at_s:
                rig.faults.inject("can0", rule)
            commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 1.0)
            if at_s:
                rig.runtime.run_for(at_s)
                rig.faults.inject("can0", rule)
            with pytest.raises(DeviceFault, match=r"8611h \(following error: -?\d+ increments\)"):
                left.wait_until_done(30)


@pytest.mark.parametrize("share", [0.9, 0.5, -0.5, -0.9])
def test_set_point_with_a_heavy_load_is_reached(open_rig: OpenRig, share: float):
    """The plant is far slower than the plan, but its servo is tuned for it."""
    heavy = "[controller.io.plant]\npreset = 'wheel_60w'\nload_inertia_kg_m2 = 3.0\n"
    inertia = INERTIA_A_S2_RAD * replace(WHEEL, load_inertia_kg_m2=3.0).inertia_kg_m2()
    with open_rig(one(inertia=inertia / WHEEL.inertia_kg_m2(), bandwidth=10.0), heavy) as rig:
        left = enabled(rig)
        rig.controllers["io"].stimulate("load_torque_n_m", share * 13.0)  # the motor has 13.7 N m
        rig.runtime.run_for(0.5)
        commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 3.0)
        rig.runtime.run_for(0.7)
        commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, -1.0)  # it must reverse
        left.wait_until_done(60)
        assert left.position() == pytest.approx(-1.0, abs=10 / INC_PER_RAD)


def test_set_point_is_done_within_the_position_window(open_rig: OpenRig):
    text = one(motor="position_window_rad = 0.2\nfollowing_error_window_rad = inf")
    rig = open_rig(text.replace("bandwidth_rad_s = 60.0", "kp_a_rad = 10.0\nkd_a_s_rad = 0.5"))
    left = enabled(rig)
    rig.controllers["io"].stimulate("load_torque_n_m", 2.0)  # without ki, an error stays
    commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 1.0)
    left.wait_until_done(5)
    assert 20 / INC_PER_RAD < abs(left.position() - 1.0) < 0.2


def test_blocked_motor_without_window_keeps_pushing(open_rig: OpenRig):
    rig = open_rig(one(motor="following_error_window_rad = inf"))
    left = moving(rig)
    rig.controllers["io"].stimulate("load_torque_n_m", 13.8)  # torque plus friction
    rig.runtime.run_for(0.5)
    assert left.following_error() > 0.5
    rig.controllers["io"].stimulate("load_torque_n_m", 0.0)
    left.wait_until_done(5)
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)
