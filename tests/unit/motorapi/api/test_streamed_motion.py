"""Derivatives of streamed set-points, for drives that feed them forward."""

import pytest

from motorhil.motorapi.api import CanDrive, ControlVariable, LinkError, StreamedMotion
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.unit.motorapi.api.test_can_drive import COMMAND, Hardware, Rig

POSITION, VELOCITY = ControlVariable.POSITION, ControlVariable.VELOCITY
PERIOD_S = 0.01


class Bench:
    """A streamed motion on a drive that is not there, and what was sent."""

    def __init__(self):
        self.rig = Rig()
        self.drive = CanDrive(self.rig.bus, 1, Hardware("the hardware"))
        self.motions = StreamedMotion(self.drive, PERIOD_S)
        self.sent = []  # (time [s], value, first, second)

    def send(self, value, fence):
        now_s = self.rig.runtime.now_ns() / 1e9
        self.sent.append((now_s, value, *self.motions.rates()))
        return self.drive.command(COMMAND, b"", fence=fence)

    def start(self, *, scale=1.0, **motion):
        slow = {"velocity": 1.0, "acceleration": 4.0, "deceleration": 2.0}
        mode = ControlMode.TRAJECTORY if "trajectory" in motion else ControlMode.SETPOINT
        own = {"variable": POSITION, "start": 0.0, **slow, **motion}
        self.motions.start(Motion(mode, **own), scale, (0.0, 0.0), self.send)
        self.rig.wait(3.0)


@pytest.fixture
def bench():
    made = Bench()
    yield made
    made.drive.close(at_rest=True)
    made.rig.close()


@pytest.mark.parametrize("motion", [{}, {"trajectory": TrapezoidalTrajectory(1.0)}])
def test_rates_are_the_derivatives_of_positions(bench, motion):
    bench.start(target=1.0, scale=-2.0, **motion)
    times, values, first, second = zip(*bench.sent, strict=True)
    assert (values[-1], first[-1], second[-1]) == (-2.0, 0.0, 0.0)
    for n in range(1, len(times) - 1):
        slope = (values[n + 1] - values[n - 1]) / (times[n + 1] - times[n - 1])
        # Within a period, the velocity changes by an acceleration of at most 8 per s².
        assert first[n] == pytest.approx(slope, abs=8.0 * PERIOD_S)
    assert set(second) == {-8.0, 0.0, 4.0}  # up, at the speed limit, down


def test_velocity_has_the_rate_of_its_ramp(bench):
    bench.start(target=0.5, variable=VELOCITY)
    assert [one[1] for one in bench.sent[:3]] == pytest.approx([0.0, 0.04, 0.08])
    assert {one[2] for one in bench.sent[:-1]} == {4.0}
    assert bench.sent[-1][1:] == (0.5, 0.0, 0.0)


def test_demand_to_slow_down_comes_without_a_frame(bench):
    bench.motions.slow_down(2.0, (1.0, 1.0))  # from 1 at 1 per s: 0.5 s, 0.25
    assert bench.motions.demand() == (1.0, 1.0, -2.0)
    bench.rig.wait(0.25)
    assert bench.motions.demand() == pytest.approx((1.1875, 0.5, -2.0))
    bench.rig.wait(1.0)
    assert bench.motions.demand() == pytest.approx((1.25, 0.0, 0.0))
    assert bench.sent == []
    assert bench.motions.now(POSITION, (0.0, 0.0)) == pytest.approx((1.25, 0.0))


def test_motion_that_is_refused_leaves_the_demand(bench):
    bench.start(target=1.0)
    bench.drive.close(at_rest=True)
    with pytest.raises(LinkError, match="closed"):
        bench.motions.hold((5.0, 0.0), bench.send)
    assert bench.motions.variable is POSITION
    assert bench.motions.demand() == (1.0, 0.0, 0.0)
