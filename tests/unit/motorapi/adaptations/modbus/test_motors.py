"""Motors on Modbus drives: the interface's guarantees on faulty lines."""

from dataclasses import replace
from math import pi

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    FaultReaction,
    MotorGroup,
    MotorPosition,
    MotorState,
    SyncLevel,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.modbus.client import (
    ModbusExceptionResponse,
    ModbusProtocolViolation,
)
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LimitError,
    MotorBusyError,
    MotorError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.functions import Polynomial
from tests.support.modbus.rigs import (
    ADAPTATIONS,
    LINES,
    opened,
    rules,
    run_s,
    text,
    truth,
)
from tests.support.repetition import examples

RESOLUTION = 0.002  # rad: one step of the coarser drive, and the error of its servo


@pytest.fixture(params=list(ADAPTATIONS))
def adaptation(request):
    return request.param


@pytest.fixture(params=list(LINES))
def rig(request, adaptation):
    with opened(text(adaptation, request.param)) as rig:
        yield rig


def go_to(motor, position, **words):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(position, **words)
    motor.start()


def test_asking_alone_finds_the_end_of_a_motion(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.5)
    begun_ns = rig.runtime.now_ns()
    while not mast.is_done():
        run_s(rig, 0.1)
        assert rig.runtime.now_ns() - begun_ns < 5_000_000_000
    assert truth(rig)["position_rad"] == pytest.approx(0.5, abs=RESOLUTION)
    mast.stop()
    assert MotorGroup(mast).is_done()


def test_asking_inside_a_condition_does_not_wait(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.5)
    assert not rig.runtime.wait_until(mast.is_done, 3.0)  # the last status received: it moves
    assert mast.is_done()


def test_registers_of_a_moving_or_reserved_motor_are_not_written(rig):
    mast = rig.motors["mast"]
    registers = mast.hardware.registers
    go_to(mast, 1.0)
    with pytest.raises(MotorBusyError, match=r"held by start\(\) of mast .*low_level\(\)"):
        registers.write(0x6002, 0x0040)
    mast.wait_until_done(20)
    with mast.reserve("survey"), pytest.raises(MotorBusyError, match="for survey"):
        registers.write(0x6002, 0x0040)
    assert abs(mast.position() - 1.0) < RESOLUTION


def test_position_set_point_is_reached(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.5)
    mast.wait_until_done(5)
    assert mast.position() == pytest.approx(0.5, abs=RESOLUTION)
    assert truth(rig)["position_rad"] == pytest.approx(0.5, abs=RESOLUTION)
    go_to(mast, -0.2, relative=True)
    mast.wait_until_done(5)
    assert truth(rig)["position_rad"] == pytest.approx(0.3, abs=RESOLUTION)
    assert mast.state() is MotorState.ENABLED


def test_trajectory_takes_its_given_duration(rig):
    mast = rig.motors["mast"]
    mast.enable()
    mast.set_control_mode(ControlMode.TRAJECTORY)
    mast.set_trajectory(TrapezoidalTrajectory(0.8, duration_s=1.2))
    mast.start()
    begun_ns = rig.runtime.now_ns()
    mast.wait_until_done(5)
    took_s = (rig.runtime.now_ns() - begun_ns) / 1e9
    assert took_s == pytest.approx(1.2, abs=0.06)  # integer rpm and ms, and a poll every 10 ms
    assert truth(rig)["position_rad"] == pytest.approx(0.8, abs=RESOLUTION)


def test_model_limits_are_kept(rig):
    mast = rig.motors["mast"]
    fastest = 0.0
    go_to(mast, 2.0)
    while not mast.is_done():
        run_s(rig, 0.01)
        fastest = max(fastest, truth(rig)["velocity_rad_s"])
    assert 1.9 < fastest < 2.05
    with pytest.raises(LimitError):
        mast.set_setpoint(7.0)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_velocity_set_point_continues_until_stopped(rig, way):
    mast = rig.motors["mast"]
    mast.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    mast.set_setpoint(way)
    mast.start()
    mast.wait_until_done(5)
    assert truth(rig)["velocity_rad_s"] == pytest.approx(way, abs=0.03)
    assert mast.velocity() == pytest.approx(way, abs=0.05)
    mast.stop()
    mast.wait_until_done(5)
    assert abs(truth(rig)["velocity_rad_s"]) < 0.01
    run_s(rig, 0.1)
    assert truth(rig)["velocity_rad_s"] == 0.0


@pytest.mark.parametrize("velocity", [1.0, 0.02])
def test_velocity_trajectory_ends_after_its_duration(rig, velocity):
    mast = rig.motors["mast"]
    mast.enable()
    mast.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    mast.set_trajectory(TrapezoidalTrajectory(velocity, duration_s=4.0))
    mast.start()
    begun_ns = rig.runtime.now_ns()
    mast.wait_until_done(6)
    assert (rig.runtime.now_ns() - begun_ns) / 1e9 == pytest.approx(4.0, abs=0.06)
    assert truth(rig)["velocity_rad_s"] == pytest.approx(velocity, abs=0.003)


def test_reversal_of_velocity_is_done_when_reached(rig):
    mast = rig.motors["mast"]
    mast.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    for velocity in (0.05, -0.05, -0.01):
        mast.set_setpoint(velocity, limits=DerivativeLimits(first=0.05))
        mast.start()
        mast.wait_until_done(5)
        assert truth(rig)["velocity_rad_s"] == pytest.approx(velocity, abs=0.006)


def test_asking_for_the_end_looks_at_the_drive(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.2)
    assert not mast.is_done()
    run_s(rig, 3.0)
    in_callback = []
    timer = rig.runtime.every(0.01, lambda: in_callback.append(mast.is_done()))
    run_s(rig, 0.015)
    timer.cancel()
    assert in_callback == [False]  # it cannot wait there
    assert mast.is_done()


@pytest.mark.parametrize("way", [1, -1])
def test_wrap_of_the_drives_counter_does_not_show(way):
    wide = text().replace("position_min_rad = -6.0\nposition_max_rad = 6.0\n", "")
    near = f"registers = {{ zero_position = {way * 2_147_300_000} }}\n[motor.mast]"
    with opened(wide.replace("[motor.mast]", near)) as rig:
        mast = rig.motors["mast"]
        mast.home(19, timeout_s=20)
        offset = mast.position() - truth(rig)["position_rad"]
        assert mast.position() == pytest.approx(way * 2_147_300_000 / 1e6 * 2 * pi, abs=0.1)
        mast.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        mast.set_setpoint(way * 1.0)
        mast.start()
        before = mast.position()
        for _ in range(15):  # the counter wraps after 1.2 rad
            run_s(rig, 0.2)
            now = mast.position()
            assert -0.01 < way * (now - before) < 0.3
            before = now
        mast.stop()
        mast.wait_until_done(5)
        begin = truth(rig)["position_rad"]
        for distance in (0.5, -0.2):
            go_to(mast, way * distance, relative=True)
            mast.wait_until_done(5)
        assert truth(rig)["position_rad"] - begin == pytest.approx(way * 0.3, abs=0.02)
        assert mast.position() - offset == pytest.approx(truth(rig)["position_rad"], abs=RESOLUTION)
        mast.home(37)
        assert mast.position() == pytest.approx(0.0, abs=RESOLUTION)


FOLLOWER = """\
[motor.follower]
adaptation = "ideal"
axis = "follower"
[motor.follower.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 1000.0
"""


def test_follower_of_a_polled_leader_continues_at_its_start(adaptation):
    with opened(text(adaptation) + FOLLOWER) as rig:
        mast, follower = rig.motors["mast"], rig.motors["follower"]
        mast.enable()
        follower.enable()
        assert mast.position() == 0.0
        follower.set_control_mode(ControlMode.TRAJECTORY)
        gear = ComplexTrajectory(Polynomial((0.0, 0.5)), 0.0, 1.0)
        follower.set_trajectory(gear, MotorPosition(mast))
        follower.start()
        for target in (0.4, 0.8):
            go_to(mast, target)
            mast.wait_until_done(5)
            assert follower.position() == pytest.approx(target / 2, abs=RESOLUTION)


def test_stop_of_a_coasting_motor_ends_at_rest(rig):
    mast = rig.motors["mast"]
    mast.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    mast.set_setpoint(2.0)
    mast.start()
    mast.wait_until_done(5)
    mast.disable()
    assert truth(rig)["velocity_rad_s"] > 1.5
    mast.stop()
    mast.wait_until_done(5)
    assert truth(rig)["velocity_rad_s"] == pytest.approx(0.0, abs=0.01)


def test_stop_in_motion_rests_short_of_the_target(rig):
    mast = rig.motors["mast"]
    go_to(mast, 2.0)
    run_s(rig, 0.5)
    mast.stop()
    mast.wait_until_done(5)
    stopped = truth(rig)["position_rad"]
    assert 0.1 < stopped < 1.5
    assert abs(truth(rig)["velocity_rad_s"]) < 0.01  # by the drive's status; it still settles
    run_s(rig, 1.0)
    assert truth(rig)["position_rad"] == pytest.approx(stopped, abs=RESOLUTION)


def test_stop_from_a_callback_is_executed(rig):
    mast = rig.motors["mast"]
    go_to(mast, 2.0)
    timer = rig.runtime.every(0.3, lambda: (mast.stop(), timer.cancel()))
    run_s(rig, 0.5)
    mast.wait_until_done(5)  # the last command here is the stop
    assert 0.05 < truth(rig)["position_rad"] < 1.5
    assert abs(truth(rig)["velocity_rad_s"]) < 0.01


def test_quick_stop_requires_enable_afterwards(rig):
    mast = rig.motors["mast"]
    go_to(mast, 2.0)
    run_s(rig, 0.4)
    mast.quick_stop()
    mast.wait_until_done(5)
    assert mast.state() is MotorState.STOPPED
    with pytest.raises(UsageError, match="quick stop"):
        mast.start()
    mast.enable()
    go_to(mast, 0.0)
    mast.wait_until_done(5)
    assert truth(rig)["position_rad"] == pytest.approx(0.0, abs=RESOLUTION)


def test_homing_here_defines_position_0(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.5)
    mast.wait_until_done(5)
    mast.home(37)
    assert mast.position() == pytest.approx(0.0, abs=RESOLUTION)
    assert mast.is_referenced()
    with pytest.raises(UnsupportedError, match="homing by method 99"):
        mast.home(99)


def test_pr_drive_finds_its_home_switch():
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.home(19, timeout_s=20)
        assert mast.is_referenced()
        at_switch = truth(rig)["position_rad"] - mast.position()
        assert at_switch == pytest.approx(0.3, abs=0.005)


def test_alarm_is_a_fault_until_reset(rig):
    mast = rig.motors["mast"]
    go_to(mast, 2.0)
    run_s(rig, 0.3)
    rig.controllers["mast"].stimulate("alarm", 0x20)
    with pytest.raises(DeviceFault) as caught:
        mast.wait_until_done(5)
    assert caught.value.code == 0x20
    with pytest.raises(DeviceFault):
        mast.start()
    mast.reset_fault()
    go_to(mast, 0.1)
    mast.wait_until_done(5)
    assert truth(rig)["position_rad"] == pytest.approx(0.1, abs=RESOLUTION)


def test_power_stage_is_switched(rig):
    mast = rig.motors["mast"]
    mast.enable()
    assert mast.state() is MotorState.ENABLED
    mast.disable()
    assert mast.state() is MotorState.DISABLED
    run_s(rig, 0.1)
    assert truth(rig)["current_a"] == 0.0


def test_silent_drive_is_offline_until_it_answers(rig):
    mast = rig.motors["mast"]
    mast.enable()
    rig.controllers["mast"].stimulate("power", 0)
    assert mast.state() is MotorState.OFFLINE
    rig.controllers["mast"].stimulate("power", 1)
    run_s(rig, 2.0)  # a gateway needs a second to abandon the request before
    assert mast.state() is not MotorState.OFFLINE


def test_stop_ramp_is_written_again_after_another_owner():
    with opened() as rig:
        mast = rig.motors["mast"]
        go_to(mast, 0.1)
        mast.wait_until_done(5)
        with mast.low_level() as hardware:
            told = hardware.registers.read(0x6017)
            hardware.registers.write(0x6017, told[0] + 100)
        go_to(mast, 0.2)
        mast.wait_until_done(5)
        with mast.low_level() as hardware:
            assert hardware.registers.read(0x6017) == told


def test_drives_on_one_line_start_in_sequence_and_report_it(adaptation):
    with opened(text(adaptation, names=("pan", "tilt"))) as rig:
        pair = MotorGroup(rig.motors["pan"], rig.motors["tilt"])
        pair.for_each(lambda motor: motor.set_control_mode(ControlMode.TRAJECTORY))
        pair.set_trajectory(TrapezoidalTrajectory(0.4), TrapezoidalTrajectory(-0.8))
        capability = pair.sync_capability()
        assert capability.level is SyncLevel.SEQUENTIAL
        assert capability.start_skew_s is None
        assert "one request at a time" in capability.reason
        with pytest.raises(UsageError):
            pair.start(require=SyncLevel.TRIGGERED)
        pair.start()
        pair.wait_until_done(5)
        assert truth(rig, "pan")["position_rad"] == pytest.approx(0.4, abs=RESOLUTION)
        assert truth(rig, "tilt")["position_rad"] == pytest.approx(-0.8, abs=RESOLUTION)
        quality = pair.sync_quality()
        assert quality.start_skew_s is not None
        assert 0.001 < quality.start_skew_s < 0.1


def test_group_reacts_while_a_party_waits_for_it(adaptation):
    with opened(text(adaptation, names=("pan", "tilt"))) as rig:
        pair = MotorGroup(rig.motors["pan"], rig.motors["tilt"])
        pair.for_each(lambda motor: motor.set_control_mode(ControlMode.TRAJECTORY))
        pair.set_trajectory(TrapezoidalTrajectory(4.0), TrapezoidalTrajectory(-4.0))
        pair.fault_reaction = FaultReaction.EACH
        pair.start()
        party = rig.runtime.spawn("watch", pair.wait_until_done)
        run_s(rig, 0.8)
        rig.controllers["pan"].stimulate("alarm", 0x10)
        run_s(rig, 3.0)  # this caller neither waits for the group nor reads it
        assert not truth(rig, "tilt")["velocity_rad_s"]
        assert -2.0 < truth(rig, "tilt")["position_rad"] < -0.5
        assert party.join(1.0)
        assert isinstance(party.error, DeviceFault)


def test_missing_gear_ratio_in_the_model_is_reported():
    lacking = text().replace("gear_ratio = 100.0\n", "")
    with opened(lacking) as rig, pytest.raises(UsageError, match="gear_ratio is not given"):
        rig.motors["mast"].enable()


# --- line faults ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rule", "error"),
    [
        (SerialFaultRule("lost", SerialFaultKind.LOSE, sender="mast"), DeadlineExceeded),
        (SerialFaultRule("lost", SerialFaultKind.LOSE, sender="host"), DeadlineExceeded),
        (
            SerialFaultRule("bits", SerialFaultKind.CORRUPT, sender="mast", flip=b"\0\0\x01"),
            ModbusProtocolViolation,
        ),
        (
            SerialFaultRule("unit", SerialFaultKind.CORRUPT, sender="mast", flip=b"\x02"),
            ModbusProtocolViolation,
        ),
        (
            SerialFaultRule("short", SerialFaultKind.TRUNCATE, sender="mast", after=4),
            ModbusProtocolViolation,
        ),
    ],
)
def test_each_failure_has_its_error_and_next_request_works(rule, error):
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.enable()
        rig.faults.inject("line", rule)
        with pytest.raises(error) as caught:
            mast.position()
        assert "line unit 1" in str(caught.value)
        rig.faults.lift("line", rule.name)
        assert mast.position() == pytest.approx(0.0, abs=RESOLUTION)


@pytest.mark.parametrize("line", list(LINES))
@pytest.mark.parametrize("kind", ["lose", "corrupt"])
def test_spoiled_readings_do_not_fail_moves(adaptation, line, kind):
    with opened(text(adaptation, line)) as rig:
        mast = rig.motors["mast"]
        mast.enable()
        spoiled = SerialFaultRule(
            "spoiled", SerialFaultKind(kind), sender="mast", function=3, probability=0.01
        )
        rig.faults.inject("line", spoiled)
        for target in (0.5, -0.5, 0.2):
            go_to(mast, target)
            mast.wait_until_done(15)
            assert truth(rig)["position_rad"] == pytest.approx(target, abs=RESOLUTION)
        assert rig.faults.fired()["spoiled"] > 2


def test_unreachable_drive_is_asked_once_per_reading():
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.enable()
        rig.controllers["mast"].stimulate("power", 0)
        registers = mast.hardware.registers
        took_s = []
        for _ in range(3):
            begun_ns = rig.runtime.now_ns()
            with pytest.raises(DeadlineExceeded):
                registers.read(0x1003)
            took_s.append((rig.runtime.now_ns() - begun_ns) / 1e9)
        # 0.2 s for an answer; before each further request, 0.5 s for a late one
        assert took_s == pytest.approx([0.9, 0.7, 0.7], abs=0.02)


def test_late_answer_never_answers_the_next_request():
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.enable()
        unit = mast.hardware.registers
        late = SerialFaultRule(
            "late", SerialFaultKind.DELAY, sender="mast", delay_ns=250_000_000, limit=1
        )
        rig.faults.inject("line", late)
        assert unit.read(0x0001) == [10_000]  # asked twice
        assert unit.read(0x600F) == [200]
        assert unit.line.strays == 1


def test_position_is_young_after_two_losses_in_one_poll(rig):
    mast = rig.motors["mast"]
    mast.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    mast.set_setpoint(0.5)
    mast.start()
    run_s(rig, 0.5)
    for answer in (1, 2):  # the answer to the repeated request is between them
        name = f"lost {answer}"
        rule = SerialFaultRule(
            name, SerialFaultKind.LOSE, sender="mast", function=3, skip=answer, limit=1
        )
        rig.faults.inject("line", rule)
    position = mast.position()
    assert mast.hardware.registers.repeats >= 2
    age_s = 0.8  # one time-out, with the wait for a late answer, and the other exchanges
    assert 0.0 <= truth(rig)["position_rad"] - position <= 0.5 * age_s


def test_position_that_cannot_be_young_is_refused(adaptation):
    with opened(text(adaptation, "rtu")) as rig:  # on TCP no late answer is waited for
        refuse_an_old_position(rig)


def refuse_an_old_position(rig):
    mast = rig.motors["mast"]
    mast.enable()
    for turn in range(2):
        for answer in (1, 2):
            rule = SerialFaultRule(
                *(f"lost {turn} {answer}", SerialFaultKind.LOSE, "mast", None, 3),
                **{"skip": answer + 6 * turn, "limit": 1},
            )
            rig.faults.inject("line", rule)
    with pytest.raises(DeadlineExceeded, match=r"few lost requests: .* within 0\.8 s"):
        mast.position()
    assert mast.position() == pytest.approx(0.0, abs=RESOLUTION)


def test_refusal_by_the_drive_names_its_address():
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.enable()
        with pytest.raises(ModbusExceptionResponse) as caught:
            mast.hardware.registers.read(0x0000)
        assert str(caught.value) == (
            "line unit 1: function 03h at 0000h refused: illegal data address (02h)"
        )


MOVES = st.lists(st.sampled_from((0.3, -0.4, 0.7)), min_size=1, max_size=3)


@settings(max_examples=examples(20), deadline=None)
@given(st.data(), MOVES, st.sampled_from(list(ADAPTATIONS)))
def test_relative_move_is_made_at_most_once(data, moves, adaptation):
    with opened(text(adaptation)) as rig:
        mast = rig.motors["mast"]
        mast.enable()
        for number, distance in enumerate(moves):
            before = truth(rig)["position_rad"]
            names = [f"{number}-{k}" for k in range(data.draw(st.integers(0, 3)))]
            for name in names:
                rig.faults.inject("line", data.draw(rules(name)))
            mast.set_control_mode(ControlMode.SETPOINT)
            mast.set_setpoint(distance, relative=True)
            done = False
            try:
                mast.start()
                mast.wait_until_done(5)
                done = True
            except MotorError as error:
                event(type(error).__name__)
            for name in names:
                rig.faults.lift("line", name)
            run_s(rig, 3.0)  # late answers have come, moving drives are at rest
            moved = (truth(rig)["position_rad"] - before) / distance
            assert -0.02 < moved < 1.02
            if done:
                event("done")
                assert moved > 0.98
            else:
                event("moved all the same" if moved > 0.98 else "not, or not all of it")
            assert mast.position() == pytest.approx(truth(rig)["position_rad"], abs=RESOLUTION)


def test_positions_are_those_of_the_output(rig):
    mast = rig.motors["mast"]
    go_to(mast, 2 * pi / 8)
    mast.wait_until_done(5)
    assert truth(rig)["position_inc"] == pytest.approx(2000 * 100 / 8, abs=60)


def test_repeated_relative_command_would_move_twice(monkeypatch):
    """The mistake that the property above must find: both halves of it, injected."""
    prepare, trigger = LeadshineHwMotor.prepare, LeadshineHwMotor.trigger

    def prepare_relative(self, motion, model):
        distance = replace(motion, target=motion.target - motion.start)
        prepare(self, distance, model)
        self._prepared = (0x0051, *self._prepared[1:])

    def try_again(self):
        try:
            trigger(self)
        except DeadlineExceeded:
            trigger(self)

    monkeypatch.setattr(LeadshineHwMotor, "prepare", prepare_relative)
    monkeypatch.setattr(LeadshineHwMotor, "trigger", try_again)
    with opened() as rig:
        mast = rig.motors["mast"]
        mast.enable()
        lost = SerialFaultRule("lost", SerialFaultKind.LOSE, sender="mast", function=16, limit=1)
        rig.faults.inject("line", lost)
        go_to(mast, 0.3, relative=True)
        run_s(rig, 3.0)
        assert truth(rig)["position_rad"] == pytest.approx(0.6, abs=RESOLUTION)
