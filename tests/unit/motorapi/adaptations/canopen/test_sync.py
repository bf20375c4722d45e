"""One SYNC producer per bus: following, take-over and refusal."""

from collections.abc import Callable

import canopen
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.errors import LinkError, MotorError, UsageError
from tests.support.motors.drive_rigs import drive
from tests.support.motors.hosts import BusEvidence, foreign_sync, host_with
from tests.support.motors.software_rigs import INC_PER_RAD, moving, one
from tests.support.motors.streaming import MS, quintic, set_function

OpenRig = Callable[..., Rig]
PERIOD_NS = 5 * MS
FRAME_NS = MS // 10  # longer than a SYNC takes
INCREMENT_RAD = 1e-4  # a few: the drive's following error while it comes to rest


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(*(drive(f"wheel{one}", one) for one in (1, 2, 3, 4)))


def position(rig: Rig, node_id: int) -> float:
    return rig.controllers[f"wheel{node_id}"].snapshot()["position_rad"]


def stream_of(motor: Cia402Motor) -> CspStream:
    stream = motor.hardware.stream
    assert stream is not None
    return stream


def name_of(who: "Cia402Motor | canopen.Network") -> str:
    """Return the name of this host on the bus."""
    bus = who.hardware.link.bus if isinstance(who, Cia402Motor) else who.bus
    return str(bus._port.name)


def test_stream_of_equal_period_follows_other_hosts_sync(rig: Rig):
    with host_with(rig, 1) as (first,), host_with(rig, 2) as (second,):
        first.position(), second.position()
        seen = BusEvidence(rig)
        set_function(first, quintic(1.0, 1.0)).start()
        set_function(second, quintic(0.4, 0.5)).start()
        second.wait_until_done(5)
        first.wait_until_done(5)
        assert seen.producers() == {name_of(first)}
        assert set(seen.gaps_ns()) == {PERIOD_NS}
        for motor, count in ((first, 200), (second, 100)):
            stream = stream_of(motor)
            assert (stream.sent, stream.late, stream.missed) == (count, 0, 0)
        assert abs(position(rig, 2) - 0.4) < INCREMENT_RAD
        assert first.hardware.node.bus.sync.cyclic() is None


def test_other_period_is_refused_and_names_the_producer(rig: Rig):
    with host_with(rig, 1) as (first,), host_with(rig, 2, period_ms=4) as (second,):
        set_function(first, quintic(1.0, 1.0)).start()
        set_function(second, quintic(0.4, 0.5))
        with pytest.raises(
            UsageError, match="every 5 ms already, produced by this program, so not every 4 ms"
        ):
            second.start()
        assert position(rig, 2) == 0.0
        first.wait_until_done(5)
        second.start()  # now it is free
        second.wait_until_done(5)


def test_follower_takes_over_when_the_producer_ends(rig: Rig):
    with host_with(rig, 1) as (first,), host_with(rig, 2) as (second,):
        first.position(), second.position()
        seen = BusEvidence(rig)
        set_function(first, quintic(0.4, 0.5)).start()
        set_function(second, quintic(1.0, 1.0)).start()
        first.wait_until_done(5)
        second.wait_until_done(5)
        assert seen.producers() == {name_of(first), name_of(second)}
        (late,) = [gap for gap in seen.gaps_ns() if gap != PERIOD_NS]  # one, during the take-over
        assert 0 <= late - PERIOD_NS * 5 // 4 < FRAME_NS
        assert abs(position(rig, 2) - 1.0) < INCREMENT_RAD
        assert stream_of(second).late == 0


def test_stream_of_equal_period_follows_a_foreign_sync(rig: Rig):
    with host_with(rig, 1) as (motor,):
        seen = BusEvidence(rig)
        with foreign_sync(0.005) as network:
            set_function(motor, quintic(1.0, 1.0)).start()
            motor.wait_until_done(5)
            assert seen.producers() == {name_of(network)}
        stream = stream_of(motor)
        assert (stream.sent, stream.late, stream.missed) == (200, 0, 0)
        assert abs(position(rig, 1) - 1.0) < INCREMENT_RAD


def test_foreign_sync_of_other_period_is_refused(rig: Rig):
    with host_with(rig, 1) as (motor,), foreign_sync(0.01):
        motor.position()
        set_function(motor, quintic(1.0, 1.0))
        for _ in range(2):  # it must be heard at first, and is known then
            with pytest.raises(
                UsageError,
                match="every 10 ms already, produced by a foreign program, so not",
            ):
                motor.start()
        assert abs(position(rig, 1)) < INCREMENT_RAD


def test_drives_brake_when_a_foreign_sync_ends(rig: Rig):
    with host_with(rig, 1) as (motor,), foreign_sync(0.005) as network:
        set_function(motor, quintic(2.0, 2.0)).start()
        rig.runtime.run_for(1.0)
        network.sync.stop()
        with pytest.raises(LinkError, match=r"no SYNC came for .* ms; it was produced by"):
            motor.wait_until_done(5)
        before = position(rig, 1)
        rig.runtime.run_for(0.5)
        assert position(rig, 1) == before
        assert 0.5 < before < 1.5


def test_second_producer_is_detected_and_drives_brake(rig: Rig):
    with host_with(rig, 1) as (motor,):
        set_function(motor, quintic(2.0, 2.0)).start()
        rig.runtime.run_for(1.0)
        with foreign_sync(0.0071):
            with pytest.raises(LinkError, match="a foreign program produces SYNC as"):
                motor.wait_until_done(5)
            before = position(rig, 1)
            rig.runtime.run_for(0.5)
            assert abs(position(rig, 1) - before) < INCREMENT_RAD
        assert motor.hardware.node.bus.sync.period_ns is None


def test_single_foreign_sync_is_tolerated(rig: Rig):
    with host_with(rig, 1) as (motor,), host_with(rig, 2) as (other,):
        set_function(motor, quintic(1.0, 1.0)).start()
        rig.runtime.run_for(0.5)
        other.hardware.node.bus.sync.send()
        motor.wait_until_done(5)


def test_follower_cut_off_for_a_while_resumes(rig: Rig):
    with host_with(rig, 1) as (first,), host_with(rig, 2) as (second,):
        set_function(first, quintic(1.0, 1.0)).start()
        second.position()
        ports = (name_of(second),)
        lost = FaultRule("lost", FaultKind.DROP, identifier=0x080, ports=ports, skip=40, limit=3)
        rig.faults.inject("can0", lost)
        seen = BusEvidence(rig)
        set_function(second, quintic(0.4, 0.5)).start()
        second.wait_until_done(5)
        assert seen.producers() == {name_of(first)}  # no take-over from a living producer
        assert stream_of(second).missed == 3
        first.wait_until_done(5)


# --- servos on the host ------------------------------------------------------------------------


def test_servos_of_equal_period_follow_a_foreign_sync(open_rig: OpenRig):
    rig = open_rig(one())
    left = rig.motors["left"]
    seen = BusEvidence(rig)
    with foreign_sync(0.001) as network:
        rig.runtime.run_for(0.1)
        assert moving(rig) is left
        left.wait_until_done(5)
        assert seen.producers() == {name_of(network)}
    assert left.position() == pytest.approx(2.0, abs=10 / INC_PER_RAD)
    assert left.cycles.missed == 0


def test_servos_switch_off_when_their_sync_ends(open_rig: OpenRig):
    rig = open_rig(one())
    with foreign_sync(0.001) as network:
        rig.runtime.run_for(0.1)
        left = moving(rig)
        rig.runtime.run_for(0.3)
        network.sync.stop()
        with pytest.raises(MotorError, match="no SYNC came for"):
            left.wait_until_done(5)
        rig.runtime.run_for(1.0)
        assert rig.controllers["io"].snapshot()["velocity_rad_s"] == 0.0


def test_servos_of_other_period_are_refused(open_rig: OpenRig):
    rig = open_rig(one())
    with foreign_sync(0.004):
        rig.runtime.run_for(0.1)
        with pytest.raises(UsageError, match="SYNC runs every 4 ms already, produced by a foreign"):
            rig.motors["left"].enable()
