"""Ends of a motion, reported by `wait` and `on_done` equally.

Times are those of the bus record (ends of frames), in virtual time: they agree to the nanosecond.
"""

from collections.abc import Callable

import can
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor, HomingFailed
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorError,
    PluginError,
)
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.outcome import Ending, Outcome
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive

OpenRig = Callable[..., Rig]
MS = 1_000_000
TPDO_1, HEARTBEAT = 0x181, 0x701
FAULT, OPERATION_ENABLED, TARGET_REACHED, HOMING_ERROR = 0x0008, 0x0027, 0x0400, 0x2000
STATE = 0x006F


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


class Heard:
    """(time, identifier, data) of all frames of the drive from now on."""

    def __init__(self, rig: Rig) -> None:
        self.frames: list[tuple[int, int, bytes]] = []
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if sender != "host":
            self.frames.append((time_ns, can_id, frame[8 : 8 + frame[4]]))

    def first_status(self, wanted: Callable[[int], bool], after_ns: int = 0) -> int:
        """Return the time when the first TPDO with such a statusword was complete."""
        return next(
            time_ns
            for time_ns, can_id, data in self.frames
            if can_id == TPDO_1
            and time_ns >= after_ns
            and wanted(int.from_bytes(data[:2], "little"))
        )


def send_foreign(rig: Rig, can_id: int, data: bytes) -> None:
    """Send a frame as another program does that knows nothing of the motors here."""
    rig.bus("can0").send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


class Endings:
    """The end of a motion of `motor`, by both ways of notification."""

    def __init__(self, rig: Rig, motor: Motor) -> None:
        self.told: list[Outcome] = []
        self.waited: list[tuple[int, MotorError | None]] = []
        self._rig = rig
        motor.on_done(self.told.append)
        self._party = rig.runtime.spawn("waiter", lambda: self._wait(motor))

    def _wait(self, motor: Motor) -> None:
        error: MotorError | None = None
        try:
            motor.wait_until_done()
        except MotorError as caught:
            error = caught
        self.waited.append((self._rig.runtime.now_ns(), error))

    def within(self, timeout_s: float, late_ns: int = 0) -> tuple[int, MotorError | None]:
        """Return time and error of the end; both ways agree, within `late_ns` of the waiter."""
        assert self._party.join(timeout_s)
        assert self._party.error is None
        ((waited_ns, error),) = self.waited
        (outcome,) = self.told
        assert outcome.time_ns <= waited_ns <= outcome.time_ns + late_ns
        assert type(outcome.error) is type(error)
        assert str(outcome.error) == str(error)
        return outcome.time_ns, error


def moving(rig: Rig, way: float = 1.0) -> tuple[Cia402Motor, Heard, Endings]:
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))
    motor.start()
    heard = Heard(rig)
    endings = Endings(rig, motor)
    rig.runtime.run_for(0.15)
    return motor, heard, endings


def test_target_reached_ends_a_motion(rig: Rig):
    _, heard, endings = moving(rig)
    ended_ns, error = endings.within(5.0)
    assert error is None
    assert endings.told[0].ending is Ending.DONE
    assert ended_ns == heard.first_status(lambda word: bool(word & TARGET_REACHED))


def test_fault_ends_a_motion(rig: Rig):
    _, heard, endings = moving(rig)
    rig.controllers["left"].stimulate("fault", 0x3210)
    ended_ns, error = endings.within(1.0)
    assert ended_ns == heard.first_status(lambda word: bool(word & FAULT))
    assert isinstance(error, DeviceFault)
    assert (error.code, error.since_ns) == (0x3210, ended_ns)
    assert endings.told[0].ending is Ending.FAILED


@pytest.mark.parametrize("how", [Motor.stop, Motor.halt, Motor.quick_stop])
def test_stop_by_another_motor_ends_a_motion_at_once(rig: Rig, how: Callable[[Motor], None]):
    motor, _, endings = moving(rig)
    other = Cia402Motor(motor.hardware, motor.model, name="other")
    stopped_ns = rig.runtime.now_ns()
    how(other)
    ended_ns, error = endings.within(1.0)
    assert ended_ns == stopped_ns
    assert isinstance(error, MotionInterrupted)
    assert error.by == f"{how.__name__}() of other"
    assert endings.told[0].ending is Ending.INTERRUPTED


def test_foreign_switch_off_ends_a_motion(rig: Rig):
    """The frames come from another host: only the drive's reaction is visible to this process."""
    _motor, heard, endings = moving(rig)
    send_foreign(rig, 0x201, b"\0\0")  # disable voltage, not by the interface
    ended_ns, error = endings.within(1.0)
    assert ended_ns == heard.first_status(lambda word: word & STATE != OPERATION_ENABLED)
    assert isinstance(error, MotionInterrupted)
    assert error.at_ns == ended_ns
    assert error.by.startswith("the drive, now in state")


def test_disable_by_another_logical_motor_waits_for_the_end(rig: Rig):
    motor, _, endings = moving(rig)
    other = Cia402Motor(motor.hardware, motor.model, name="other")
    with pytest.raises(MotorError, match=r"held by start\(\) of left"):
        other.disable()
    assert endings.within(5.0)[1] is None


def test_lost_drive_ends_a_motion_within_heartbeat_time(rig: Rig):
    _, heard, endings = moving(rig)
    lost_ns = rig.runtime.now_ns()
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("left",), from_ns=lost_ns))
    ended_ns, error = endings.within(1.0)
    last_ns = max(time_ns for time_ns, can_id, _ in heard.frames if can_id == HEARTBEAT)
    assert ended_ns == last_ns + 300 * MS  # heartbeat_timeout_ms
    assert ended_ns <= lost_ns + 300 * MS
    assert isinstance(error, LinkError)
    assert error.since_ns == ended_ns


def test_drive_reboot_ends_a_motion_at_its_boot_up(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, controller="timing.boot_up_s = 0.1"))  # before a loss
    _motor, heard, endings = moving(rig)
    send_foreign(rig, 0x000, bytes((0x81, 1)))  # CiA 301, NMT: reset node
    ended_ns, error = endings.within(1.0)
    booted_ns = next(
        time_ns for time_ns, can_id, data in heard.frames if (can_id, data) == (HEARTBEAT, b"\0")
    )
    assert ended_ns == booted_ns
    assert isinstance(error, LinkError)
    assert "it has booted" in error.reason


def test_drive_leaving_operational_ends_a_motion_at_heartbeat(rig: Rig):
    _motor, heard, endings = moving(rig)
    send_foreign(rig, 0x000, bytes((0x02, 1)))  # CiA 301, NMT: stop
    ended_ns, error = endings.within(1.0)
    told_ns = next(
        time_ns for time_ns, can_id, data in heard.frames if (can_id, data) == (HEARTBEAT, b"\4")
    )
    assert ended_ns == told_ns
    assert isinstance(error, LinkError)
    assert "not OPERATIONAL" in error.reason


def test_closing_the_hardware_ends_a_motion_at_once(rig: Rig):
    motor, _, endings = moving(rig)
    now_ns = rig.runtime.now_ns()
    motor.hardware.close()
    ended_ns, error = endings.within(1.0)
    assert ended_ns == now_ns
    assert isinstance(error, MotionInterrupted)
    assert error.by == "close() of can0 node 1"


def test_failed_homing_ends_a_motion(rig: Rig):
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    motor.enable()
    motor.home(37, wait=False)
    endings = Endings(rig, motor)
    # The emulated drive fails no homing, so its statuswords are injected. CiA 402-2, homing mode:
    # bit 13, homing error, rises after it was seen low.
    begun_ns = rig.runtime.now_ns()
    words = iter((0x0237, 0x2637))
    timer = rig.runtime.every(
        10e-6, lambda: motor.hardware.node.take_status(next(words), 0, rig.runtime.now_ns())
    )
    rig.runtime.run_for(20e-6)
    timer.cancel()
    ended_ns, error = endings.within(5.0)
    assert isinstance(error, HomingFailed)
    assert (error.method, error.statusword) == (37, 0x2637)
    assert ended_ns == begun_ns + 20_000


def test_stop_ends_when_the_drive_is_at_rest(rig: Rig):
    motor, _, _ = moving(rig)
    motor.stop()
    endings = Endings(rig, motor)
    ended_ns, error = endings.within(1.0)
    assert error is None
    watch = motor.hardware.node.watch
    assert watch is not None
    assert ended_ns == watch.ended_ns
    assert endings.told[0].operation == "stop() of left"


def test_later_low_level_access_keeps_the_recorded_end(rig: Rig):
    motor, _, endings = moving(rig)
    rig.controllers["left"].stimulate("fault", 0x3210)
    _, error = endings.within(1.0)
    with motor.low_level() as hardware:
        hardware.reset_fault()
    late: list[Outcome] = []
    motor.on_done(late.append)
    assert str(late[0].error) == str(error)


# --- a drive without cyclic status -------------------------------------------------------------


def test_polled_drive_reports_its_end_while_awaited(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, motor="status_period_ms = 0"))
    motor, _, endings = moving(rig)
    assert not motor.hardware.node.status_is_cyclic
    ended_ns, error = endings.within(5.0, late_ns=5 * MS)  # the waiter may be polling just then
    assert error is None
    times = motor._motion_times()
    assert times is not None
    assert times.ended_ns == ended_ns


# --- errors of callbacks, and of others --------------------------------------------------------


def test_failing_callback_harms_neither_bus_nor_others(rig: Rig):
    motor, _, endings = moving(rig)
    registrations = [motor.on_done(lambda outcome: 1 / 0)]
    also: list[Outcome] = []
    motor.on_done(also.append)
    rig.runtime.run_for(3.0)  # all callbacks run
    assert len(also) == 1
    assert motor.hardware.node.malformed == 0
    position = motor.position()
    assert position == pytest.approx(1.0, abs=2e-3)  # the drive's position window
    assert registrations[0] is not None
    ((_, error),) = endings.waited
    assert isinstance(error, PluginError)  # the waiter got the error
    motor.start()
    motor.wait_until_done(timeout_s=5)
