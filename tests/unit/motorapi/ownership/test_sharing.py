import gc

import can
import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    TrapezoidalTrajectory,
    UsageError,
)
from motorhil.motorapi.bus_context import context_of, physical_key
from motorhil.motorapi.ownership.physical_motor import (
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.ownership.queue import TRANSACTION_TIMEOUT_S
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor, fault_now


def follow(motor, way):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


@pytest.fixture
def logical(hw):
    """Return two logical motors of one physical motor."""
    return [PlainMotor(hw, name=name) for name in ("drive", "other")]


def test_second_hardware_object_raises_and_names_the_first(runtime, hw):
    with pytest.raises(UsageError, match=r"bus0 node 1 .*PlainHwMotor\('bus0', node=1\).*close"):
        PlainHwMotor(runtime, node=1)
    PlainHwMotor(runtime, node=2)
    PlainHwMotor(runtime, node=1, bus=PlainBus("bus1"))
    PlainHwMotor(VirtualRuntime(EventQueue()), node=1)  # in another runtime


def test_closed_or_dropped_hardware_object_is_replaceable(runtime, hw):
    hw.close()
    hw.close()
    second = PlainHwMotor(runtime, node=1)
    hw.close()  # no longer its motor
    with pytest.raises(UsageError):
        PlainHwMotor(runtime, node=1)
    second.bus.hardware.clear()
    del second
    gc.collect()
    PlainHwMotor(runtime, node=1)


OPERATIONS = (
    *(Motor.start, Motor.enable, Motor.disable, Motor.reset_fault, Motor.home, Motor.stop),
    *(Motor.quick_stop, Motor.halt, Motor.position, Motor.velocity, Motor.fault),
    *(Motor.is_referenced, lambda motor: motor.reserve().__enter__()),
    lambda motor: motor.low_level().__enter__(),
)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_closed_motor_is_refused_while_another_stays_open(runtime, logical, operation):
    closed, other = logical
    for motor in logical:
        follow(motor, 1.0)
    closed.close()
    closed.close()
    with pytest.raises(LinkError, match="drive: this motor was closed; make a new one"):
        operation(closed)
    other.start()
    other.wait_until_done()
    assert other.position() == 1.0


def test_one_bus_has_one_key_however_often_opened():
    buses = [
        can.Bus(interface="virtual", channel=channel)
        for channel in ("sharing-a", "sharing-a", "sharing-b")
    ]
    try:
        keys = [physical_key(bus) for bus in buses]
    finally:
        for bus in buses:
            bus.shutdown()
    assert keys[0] == keys[1] != keys[2]

    class Nameless:
        channel_info = "unknown"

    first, second = Nameless(), Nameless()
    assert physical_key(first) is physical_key(second) is None
    assert context_of(first).medium is not context_of(second).medium


def test_release_of_an_unregistered_motor_does_nothing():
    bus = PlainBus()
    release_physical_motor(bus, 1, object())
    mine = register_physical_motor(bus, 1, "a label", bus)
    release_physical_motor(bus, 1, bus)
    assert mine.label == "a label"


def test_settings_of_a_logical_motor_do_not_reach_another(logical):
    drive, other = logical
    follow(drive, 1.0)
    assert other.control_mode is None
    follow(other, -2.0)
    drive.start()
    drive.wait_until_done()
    assert drive.position() == other.position() == 1.0


def test_moving_motor_cannot_be_commanded_by_another(runtime, logical, hw):
    drive, other = logical
    follow(drive, 3.0)
    follow(other, 1.0)
    drive.start()
    log = list(hw.log)
    for refused in (other.start, other.enable, other.disable, other.home, other.reset_fault):
        with pytest.raises(MotorBusyError) as caught:
            refused()
        assert caught.value.holder == "start() of drive"
        assert caught.value.since_ns == 0
    assert hw.log == log
    assert other.position() == 0.0  # reading is free
    drive.wait_until_done()
    other.start()
    with pytest.raises(MotorBusyError, match="other"):
        drive.start()


def test_motion_that_ended_unseen_frees_the_motor(runtime, logical):
    drive, other = logical
    follow(drive, 1.0)
    drive.start()
    runtime.run_for(5.0)
    follow(other, 1.0)
    other.start()
    drive.wait_until_done()  # it ended at its target
    assert not other.is_done()
    assert drive.is_done()


def test_velocity_set_point_holds_the_motor_until_stop(logical):
    drive, other = logical
    drive.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    drive.set_setpoint(1.0)
    drive.start()
    drive.wait_until_done()
    follow(other, 1.0)
    with pytest.raises(MotorBusyError):
        other.start()
    other.stop()  # no ownership needed
    other.start()
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of other"):
        drive.wait_until_done()


def test_fault_frees_the_motor(logical, hw):
    drive, other = logical
    follow(drive, 3.0)
    drive.start()
    fault_now(hw)
    follow(other, 1.0)
    with pytest.raises(DeviceFault):
        other.start()
    other.reset_fault()
    other.start()


def test_token_grows_when_the_motor_changes_hands(logical, hw):
    drive, other = logical
    tokens = []
    for motor in (drive, drive, other, drive):
        follow(motor, 0.1)
        motor.start()
        motor.wait_until_done()
        tokens.append(hw.physical.token)
    assert tokens == [1, 1, 2, 3]


def test_operations_of_parties_take_turns_in_order(runtime):
    hw = PlainHwMotor(runtime, acts_s=0.1)
    order = []

    def enable_and_disable(name):
        motor = PlainMotor(hw, name=name)
        motor.enable()
        order.append((name, "enabled", runtime.now_ns()))
        motor.disable()
        order.append((name, "disabled", runtime.now_ns()))

    parties = [runtime.spawn(name, lambda name=name: enable_and_disable(name)) for name in "abc"]
    for party in parties:
        assert party.join(timeout_s=10)
        assert party.error is None
    # a enables; b and c find it enabled in their turns; then each disables in turn.
    assert [entry[:2] for entry in order] == [
        *[("a", "enabled"), ("b", "enabled"), ("c", "enabled")],
        *[("a", "disabled"), ("b", "disabled"), ("c", "disabled")],
    ]
    assert [entry[2] for entry in order] == [k * 100_000_000 for k in (1, 1, 1, 2, 3, 4)]


def test_two_simultaneous_starts_run_in_turn(runtime):
    hw = PlainHwMotor(runtime, acts_s=0.01)
    outcomes = []

    def move(name, way):
        motor = PlainMotor(hw, name=name)
        follow(motor, way)
        try:
            motor.start()
        except MotorBusyError as error:
            outcomes.append((name, error.holder))
            return
        motor.wait_until_done()
        outcomes.append((name, hw.position()))

    parties = [
        runtime.spawn("a", lambda: move("a", 1.0)),
        runtime.spawn("b", lambda: move("b", 2.0)),
    ]
    for party in parties:
        party.join()
        assert party.error is None
    assert outcomes == [("b", "start() of a"), ("a", 1.0)]


def test_turn_timeout_names_the_holder(runtime, hw):
    motor, late = PlainMotor(hw, name="slow"), PlainMotor(hw, name="late")
    hw.acts_s = TRANSACTION_TIMEOUT_S + 1.0
    runtime.spawn("slow", motor.enable)
    runtime.run_for(0.5)
    with pytest.raises(MotorBusyError, match=r"enable\(\) of slow since 0\.000000 s"):
        late.enable()
    runtime.run_for(1.0)
    hw.acts_s = 0.0
    late.enable()  # no trace of the abandoned turn


def test_callback_cannot_begin_an_operation_within_another(runtime):
    hw = PlainHwMotor(runtime, acts_s=0.1)
    motor = PlainMotor(hw)
    refused = []

    def meddle():
        try:
            motor.disable()
        except UsageError as error:
            refused.append(str(error))

    timer = runtime.every(0.05, meddle)
    motor.enable()
    timer.cancel()
    assert len(refused) >= 1
    assert "enable() of m1 is still active in this thread" in refused[0]


def test_groups_in_opposite_orders_do_not_deadlock(runtime):
    bus = PlainBus()
    hardware = [PlainHwMotor(runtime, node, bus, acts_s=0.001) for node in (1, 2, 3)]
    for one in hardware:
        one.connecting_s = 0.001
    rounds = []

    def drive(name, order):
        from motorhil.motorapi import MotorGroup

        group = MotorGroup(*(PlainMotor(hardware[k], name=f"{name}{k}") for k in order))
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(*[TrapezoidalTrajectory(0.01)] * 3)
        done = 0
        while done < 20:
            try:
                group.start()
            except MotorBusyError:
                runtime.run_for(0.003)
                continue
            group.wait_until_done(timeout_s=5)
            done += 1
        rounds.append(name)

    parties = [
        runtime.spawn("up", lambda: drive("up", (0, 1, 2))),
        runtime.spawn("down", lambda: drive("down", (2, 1, 0))),
    ]
    for party in parties:
        assert party.join(timeout_s=60)
        assert party.error is None
    assert sorted(rounds) == ["down", "up"]
    assert [hw.position() for hw in hardware] == pytest.approx([0.4] * 3)  # sums of 0.01
