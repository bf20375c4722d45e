"""Group start beside a cyclic SYNC, by one burst; straddles."""

from collections.abc import Callable

import can
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.sync_start import armed_group
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LinkError, MotionInterrupted, MotorError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.synchronization.quality import SyncLevel
from tests.support.motors.drive_rigs import drive
from tests.support.motors.hosts import BusEvidence, foreign_sync, host_with
from tests.support.motors.streaming import MS, quintic, set_function

OpenRig = Callable[..., Rig]
PERIOD_S = 0.005
WINDOW_RAD = 1e-3
IDS = {0x301, 0x302, 0x303}


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(*(drive(f"wheel{one}", one) for one in (1, 2, 3, 4)))


def truth(rig: Rig, node_id: int) -> float:
    return rig.controllers[f"wheel{node_id}"].snapshot()["position_rad"]


def ready(*motors: Cia402Motor, variable: ControlVariable = ControlVariable.POSITION) -> MotorGroup:
    """Return an enabled group with all commands set, not started."""
    group = MotorGroup(*motors)
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, variable)
    group.for_each(Motor.set_setpoint, 1.0)
    return group


def streaming(motor: Cia402Motor) -> None:
    set_function(motor, quintic(2.0, 4.0)).start()


@pytest.mark.parametrize("variable", [ControlVariable.POSITION, ControlVariable.VELOCITY])
def test_group_beside_a_stream_begins_with_one_of_its_syncs(rig: Rig, variable: ControlVariable):
    with host_with(rig, 1, 2, 3, 4) as (*motors, fourth):
        group = ready(*motors, variable=variable)
        streaming(fourth)
        seen = BusEvidence(rig)
        capability = group.sync_capability()
        assert capability.level is SyncLevel.TRIGGERED
        assert "SYNC runs every 5 ms" in capability.reason
        group.start()
        group.wait_until_done(5)
        quality = group.sync_quality()
        assert (quality.command_skew_s, quality.straddles) == (0.0, 0)
        started = [times.latched_ns for _, times in quality.times if times is not None]
        assert len(started) == 3
        assert set(started) <= set(seen.syncs())
        assert min(seen.gaps_ns()) > 4.5 * MS  # only the SYNCs of the stream; they wait for frames
        group.stop()
        group.wait_until_done(5)
        fourth.wait_until_done(10)


def test_burst_is_sent_just_after_a_sync(rig: Rig):
    with host_with(rig, 1, 2, 3, 4) as (*motors, fourth):
        group = ready(*motors)
        streaming(fourth)
        seen = BusEvidence(rig)
        group.start()
        mine = [
            time_ns for time_ns, _, can_id, data in seen.frames if can_id in IDS and data[0] & 0x10
        ]
        assert len(mine) == 3
        before = max(time_ns for time_ns in seen.syncs() if time_ns < mine[0])
        assert mine[-1] - before < MS  # three set-points, and that of the stream
        assert [time_ns for time_ns in seen.syncs() if mine[0] < time_ns < mine[-1]] == []


@pytest.mark.parametrize("period_s", [0.005, 0.02, 0.1])
def test_group_beside_a_foreign_sync_begins_with_one_of_it(rig: Rig, period_s: float):
    with host_with(rig, 1, 2, 3) as motors, foreign_sync(period_s) as network:
        group = ready(*motors)
        seen = BusEvidence(rig)
        group.start()
        group.wait_until_done(5)
        quality = group.sync_quality()
        assert (quality.command_skew_s, quality.straddles) == (0.0, 0)
        assert seen.producers() == {str(network.bus._port.name)}
        assert seen.fired() == [IDS]
        assert "a foreign program" in group.sync_capability().reason


def test_group_beside_another_hosts_stream_uses_its_sync(rig: Rig):
    with host_with(rig, 4) as (fourth,), host_with(rig, 1, 2, 3) as motors:
        group = ready(*motors)
        streaming(fourth)
        seen = BusEvidence(rig)
        group.start()
        assert seen.fired()[0] >= IDS
        assert group.sync_quality().straddles == 0
        assert len(seen.producers()) == 1
        group.wait_until_done(5)


def test_regular_starts_of_another_host_are_not_cyclic_sync(rig: Rig):
    with host_with(rig, 3, 4) as others, host_with(rig, 1, 2) as motors:
        other, group = ready(*others), ready(*motors)
        group.start()
        group.wait_until_done(5)
        group.for_each(Motor.set_setpoint, 0.5)
        for turn in range(8):
            other.for_each(Motor.set_setpoint, 0.1 * (turn % 2))
            other.start()
            rig.runtime.run_for(0.05)
        before_ns = rig.runtime.now_ns()
        group.start()
        assert rig.runtime.now_ns() - before_ns < 20 * MS  # does not wait for one: they took turns
        assert motors[0].hardware.node.bus.sync.cyclic() is None
        assert group.sync_quality().command_skew_s == 0.0
        group.wait_until_done(5)


def test_burst_pushed_over_a_sync_straddles_and_reports_it(rig: Rig):
    with (
        host_with(rig, 1, 2, 3) as motors,
        foreign_sync(0.001),
        can.Bus(interface="emulated", channel="can0") as loud,
    ):
        group = ready(*motors)
        bus = motors[0].hardware.node.bus

        def shout(time_ns: int) -> None:  # wins arbitration, for most of a period
            if any(one.transmission is not None for one in armed_group(bus).set_points):
                return
            for _ in range(6):
                loud.send(can.Message(arbitration_id=0x081, data=bytes(8), is_extended_id=False))
            bus.sync.at_next(shout)

        bus.sync.at_next(shout)
        seen = BusEvidence(rig)
        group.start()
        group.wait_until_done(5)
        quality = group.sync_quality()
        assert quality.straddles == 1
        assert quality.command_skew_s == pytest.approx(0.001, abs=0.0002)  # a SYNC waits for frames
        assert sum(len(one) for one in seen.fired()) == 3
        assert len(seen.fired()) == 2
        told = [times for _, times in quality.times if times is not None and times.straddles]
        assert told
        assert "1 SYNC later than the first" in told[0].source


def test_burst_after_a_delayed_sync_straddles_and_reports_it(rig: Rig):
    with host_with(rig, 1, 2, 3) as motors, foreign_sync(0.02):
        group = ready(*motors)
        rig.runtime.run_for(0.1)
        bus = motors[0].hardware.node.bus
        late = FaultRule(
            "late",
            FaultKind.DELAY,
            identifier=0x080,
            ports=(str(bus.link.bus._port.name),),
            limit=1,
            delay_ns=20 * MS - 150_000,  # the rest is too short for three frames
        )
        injected: list[int] = []

        def look() -> None:
            if len(armed_group(bus).set_points) == 3 and not injected:
                injected.append(rig.runtime.now_ns())
                rig.faults.inject("can0", late)

        rig.runtime.every(0.001, look)
        seen = BusEvidence(rig)
        group.start()
        group.wait_until_done(5)
        quality = group.sync_quality()
        assert [len(one) for one in seen.fired()] == [1, 2]
        assert quality.straddles == 1
        assert quality.command_skew_s == pytest.approx(0.02, abs=2e-6)  # a SYNC waits for a frame


def test_stop_between_arming_and_burst_leaves_nothing_armed(rig: Rig):
    with host_with(rig, 1, 2, 3) as motors, foreign_sync(0.1):
        group = ready(*motors)
        rig.runtime.run_for(0.5)
        control = motors[1].hardware.control
        stopped: list[int] = []

        def look() -> None:  # all is ready, and waits for a SYNC
            if len(armed_group(motors[0].hardware.node.bus).set_points) == 3 and not stopped:
                stopped.append(rig.runtime.now_ns())
                group.stop()

        rig.runtime.every(0.001, look)
        seen = BusEvidence(rig)
        with pytest.raises(MotionInterrupted):
            group.start()
        rig.runtime.run_for(0.5)
        assert stopped
        assert seen.fired() == []
        assert not control.is_armed
        assert [abs(truth(rig, one)) < WINDOW_RAD for one in (1, 2, 3)] == [True] * 3


def test_own_sync_begins_a_burst_when_the_producer_ends(rig: Rig):
    with host_with(rig, 4) as (fourth,), host_with(rig, 1, 2, 3) as motors:
        group = ready(*motors)
        streaming(fourth)
        rig.runtime.run_for(0.1)
        bus = motors[0].hardware.node.bus

        def look() -> None:
            if len(armed_group(bus).set_points) == 3 and fourth.hardware.stream is not None:
                fourth.hardware.stream.cancel()

        rig.runtime.every(0.0005, look)
        seen = BusEvidence(rig)
        group.start()
        assert seen.fired()[-1] >= IDS
        assert group.sync_quality().straddles == 0
        group.wait_until_done(5)


def test_refused_set_point_leaves_nothing_armed(rig: Rig):
    with host_with(rig, 1, 2, 3) as motors, foreign_sync(PERIOD_S):
        group = ready(*motors)
        group.for_each(Motor.position)
        rig.faults.inject("can0", FaultRule("lose", FaultKind.DROP, identifier=0x603))
        seen = BusEvidence(rig)
        with pytest.raises(MotorError):
            group.start()
        rig.runtime.run_for(0.3)
        assert seen.fired() == []
        assert armed_group(motors[0].hardware.node.bus).set_points == []
        rig.faults.lift("can0", "lose")
        group.start()
        group.wait_until_done(5)
        assert seen.fired() == [IDS]


def test_stalled_sync_producer_is_named(rig: Rig):
    with host_with(rig, 4) as (fourth,), host_with(rig, 1, 2, 3) as motors:
        group = ready(*motors)
        streaming(fourth)
        rig.runtime.run_for(0.1)
        lose = FaultRule("lose", FaultKind.CUT, ports=(str(fourth.hardware.link.bus._port.name),))
        rig.faults.inject("can0", lose)
        with pytest.raises(LinkError, match="SYNC runs every 5 ms, produced by this program"):
            group.start()


def test_stream_and_set_points_begin_within_the_prediction(rig: Rig):
    with host_with(rig, 4) as (fourth,), host_with(rig, 1, 2, 3) as motors:
        group = ready(*motors)
        set_function(motors[0], quintic(0.5, 1.0))
        streaming(fourth)
        rig.runtime.run_for(0.1)
        seen = BusEvidence(rig)
        group.start()
        quality = group.sync_quality()
        assert seen.fired()[0] >= {0x302, 0x303}
        assert quality.straddles == 0
        assert quality.command_skew_s is not None
        assert quality.command_skew_s <= PERIOD_S + 1e-3
        group.wait_until_done(5)
        assert abs(truth(rig, 1) - 0.5) < WINDOW_RAD
        assert abs(truth(rig, 2) - 1.0) < WINDOW_RAD
        fourth.wait_until_done(10)


def test_single_foreign_sync_while_arming_causes_no_wait(rig: Rig):
    with (
        host_with(rig, 1, 2) as motors,
        can.Bus(interface="emulated", channel="can0") as evil,
    ):
        group = ready(*motors)
        sent: list[int] = []

        def on_frame(frame: bytes, time_ns: int, transmitted: bool) -> None:
            if int.from_bytes(frame[:4], "little") == 0x301 and not sent:
                sent.append(time_ns)
                evil.send(can.Message(arbitration_id=0x080, is_extended_id=False))

        rig.runtime.listen(evil, on_frame)
        seen = BusEvidence(rig)
        group.start()
        group.wait_until_done(5)
        assert seen.fired() == [{0x301}, {0x302}]
        quality = group.sync_quality()
        assert quality.straddles == 1
        assert quality.command_skew_s == pytest.approx(0.0, abs=0.03)  # SDOs, not 0.3 s of waiting
