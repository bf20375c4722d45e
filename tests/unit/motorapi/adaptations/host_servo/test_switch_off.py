"""Repeated switching-off of an amplifier that missed a frame."""

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.errors import DeadlineExceeded, LinkError
from tests.support.motors.software_rigs import enabled, moving, one
from tests.support.motors.wheels import frames_on

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
def test_motor_without_counts_is_switched_off_despite_losses(open_rig, lost: int):
    """The loop is open: the last current would drive the motor on."""
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
    assert off == [b"\0"]  # the first one received is the last one sent


def test_confirmed_switch_off_is_not_repeated(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, 3)
    left.disable()
    assert not ready(rig)


def test_enable_ends_the_repetition(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, 100)
    with pytest.raises(DeadlineExceeded, match="its amplifier off"):
        left.disable()  # the result is unknown to the caller, and the repetition continues
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


def test_repetition_ends_after_its_maximum(open_rig):
    rig = open_rig(one())
    left = enabled(rig)
    lose(rig, ENABLE, None)
    with pytest.raises(DeadlineExceeded, match="its amplifier off"):
        left.disable()  # the result is unknown to the caller, and the repetition continues
    rig.runtime.run_for(10.0)
    fired = rig.faults.fired()[f"{ENABLE:X}h lost"]
    assert 500 <= fired <= 502
