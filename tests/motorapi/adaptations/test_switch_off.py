"""An amplifier that missed the frame that switches it off is switched off by the next one."""

import pytest

from emulators.media.faults import FaultKind, FaultRule
from harness.rig import Rig
from motorapi.errors import DeadlineExceeded, LinkError
from tests.motorapi.adaptations.software_rigs import enabled, moving, one
from tests.motorapi.adaptations.wheels import frames_on

COUNTS, ENABLE = 0x281, 0x201
COAST_RAD = 1.0  # from some 3 rad/s


def lose(rig: Rig, identifier: int, limit: int | None) -> None:
    now_ns = rig.runtime.now_ns()
    name = f"{identifier:X}h lost"
    rule = FaultRule(name, FaultKind.DROP, identifier=identifier, from_ns=now_ns, limit=limit)
    rig.faults.inject("can0", rule)


def ready(rig: Rig) -> bool:
    return rig.controllers["io"].snapshot()["ready"] == 1.0


@pytest.mark.parametrize("lost", [0, 1, 5])
def test_a_motor_whose_counts_end_is_switched_off_though_frames_are_lost(open_rig, lost: int):
    """No loop is closed any more: what it was given last would drive it on and on."""
    rig = open_rig(one())
    left = moving(rig)
    lose(rig, COUNTS, None)
    if lost:
        lose(rig, ENABLE, lost)
    heard = frames_on(rig)
    with pytest.raises(LinkError, match="no counts came"):
        left.wait_until_done(5)
    at = rig.controllers["io"].snapshot()["position_rad"]
    rig.runtime.run_for(0.001)
    assert ready(rig) is bool(lost)
    rig.runtime.run_for(0.01 * lost + 0.005)
    assert not ready(rig)
    rig.runtime.run_for(1.0)
    assert abs(rig.controllers["io"].snapshot()["position_rad"] - at) < COAST_RAD
    off = [data for _, sender, can_id, data in heard if can_id == ENABLE and sender == "host"]
    assert off == [b"\0"]  # the first that is heard is the last that is sent


def test_a_motor_that_says_that_it_is_off_is_off(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, 3)
    left.disable()
    assert not ready(rig)


def test_enabling_again_ends_it(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, 100)
    with pytest.raises(DeadlineExceeded, match="its amplifier off"):
        left.disable()  # it is told that nobody knows, and goes on being switched off
    rig.faults.lift("can0", f"{ENABLE:X}h lost")
    left.enable()
    rig.runtime.run_for(0.5)
    assert ready(rig)


def test_nothing_is_sent_after_a_close(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, None)
    left.close()
    heard = frames_on(rig)
    rig.runtime.run_for(0.1)
    assert [can_id for _, sender, can_id, _ in heard if sender == "host"] == []


def test_it_is_given_up_after_a_while(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, None)
    with pytest.raises(DeadlineExceeded, match="its amplifier off"):
        left.disable()  # it is told that nobody knows, and goes on being switched off
    rig.runtime.run_for(10.0)
    fired = rig.faults.fired()[f"{ENABLE:X}h lost"]
    assert 500 <= fired <= 502
