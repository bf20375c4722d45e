"""Relative moves of all adaptations are made at most once; planted violations are detected."""

import re
from dataclasses import replace
from functools import cache

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.sharing_tests.relative_moves import (
    KINDS,
    Ending,
    MadeMoreThanOnce,
    Plan,
    Reach,
    Step,
    at_most_once,
    judge,
    single_faults,
    traffic_of,
)
from motorhil.motorapi import DeadlineExceeded
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
from motorhil.motorapi.errors import LinkError, MotorError
from tests.support.sharing import movers

SDO_REQUEST, SDO_ANSWER, TPDO, RPDO = 0x601, 0x581, 0x181, 0x201
EXAMPLES = {"servo": 8}  # the cycle of 1 ms is expensive
EVERY = {"servo": 49, "csp": 21, "pp by SYNC": 21}  # step through the plans; else EVERY_NINTH
EVERY_NINTH = 9
MOVERS = {
    "pp-rpdo": lambda folder: movers.by_rpdo(),
    "pp-sdo": movers.by_sdo,
    "pp-sync": lambda folder: movers.in_a_group(),
    "csp": lambda folder: movers.streamed(),
    "servo": lambda folder: movers.by_servo(),
}


@pytest.fixture(params=MOVERS)
def mover(request, tmp_path):
    return MOVERS[request.param](tmp_path)


def lost(identifier, *, place=0, count=1):
    """Return a rule that drops `count` frames of the identifier, from frame `place` on."""
    return FaultRule("lost", FaultKind.DROP, identifier=identifier, skip=place, limit=count)


def plan_of(*rules, distance=0.5):
    return Plan(1, (Step(distance, rules), Step(-distance)))


def reached(mover, plans):
    reach = Reach()
    for plan in plans:
        reach.add(judge(mover, plan))
    return reach


@pytest.fixture(scope="module")
def random_moves(tmp_path_factory):
    """Return a function that makes a kind's moves under random faults, once, and their reach."""

    @cache
    def moved(kind):
        mover, reach = MOVERS[kind](tmp_path_factory.mktemp(kind)), Reach()
        at_most_once(mover, examples=EXAMPLES.get(mover.name, 25), reach=reach, shrink=False)()
        return reach

    return moved


# --- the property ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", MOVERS)
def test_move_under_random_faults_is_made_at_most_once(random_moves, kind):
    assert sum(random_moves(kind).endings.values()) >= EXAMPLES.get(kind, 25)


def test_move_with_one_fault_in_its_start_is_made_at_most_once(mover):
    """All plans take minutes, so the test takes every n-th plan, with all kinds of faults."""
    chosen = single_faults(mover)[:: EVERY.get(mover.name, EVERY_NINTH)]
    reach = reached(mover, chosen)
    assert sum(reach.fired.values()) == sum(reach.hit.values()) == len(chosen) >= 10
    assert reach.hit[Ending.DONE] > 5
    assert all(reach.fired[kind] > 2 for kind in KINDS)


# --- reached cases ------------------------------------------------------------------------------


def test_undisturbed_moves_are_done_without_hits(mover):
    reach = judge(mover, plan_of())
    assert reach.endings == {Ending.DONE: 2}
    assert not reach.hit
    assert not reach.fired
    assert not reach.errors


def test_lost_answers_fail_moves_that_were_made(tmp_path):
    mover = movers.by_sdo(tmp_path)
    answers = [plan_of(lost(SDO_ANSWER, place=place)) for place in range(0, 60, 2)]
    reach = reached(mover, answers)
    assert reach.fired == {FaultKind.DROP: len(answers)}
    assert reach.endings[Ending.FAILED_MADE] > 0
    assert reach.endings[Ending.FAILED_NOT_MADE] > 0
    assert reach.errors["DeadlineExceeded"] > 10


def test_late_answers_in_the_next_move_are_harmless(tmp_path):
    """They are delayed beyond every timeout; then another object is requested."""
    mover = movers.by_sdo(tmp_path)
    late = FaultRule("late", FaultKind.DELAY, identifier=SDO_ANSWER, limit=1, delay_ns=400_000_000)
    for place in range(0, 60, 4):
        reach = judge(mover, plan_of(replace(late, skip=place)))
        assert reach.fired == {FaultKind.DELAY: 1}
        assert reach.errors.keys() <= {"DeadlineExceeded"}
        assert reach.endings[Ending.DONE] >= 1  # the second one


def test_lost_command_is_repeated_and_made_once():
    reach = judge(movers.by_rpdo(), plan_of(lost(RPDO, count=2)))
    assert reach.fired == {FaultKind.DROP: 2}
    assert reach.endings == {Ending.DONE: 2}
    assert reach.hit == {Ending.DONE: 1}


def test_lost_acknowledge_repeats_command_and_move_is_single():
    reach = judge(movers.by_rpdo(), plan_of(lost(TPDO, count=14)))
    assert reach.repeated >= 1
    assert reach.endings == {Ending.DONE: 2}
    assert reach.hit == {Ending.DONE: 1}


def test_random_plans_reach_faults_hits_and_errors(random_moves):
    reach = Reach()
    for kind in ("pp-rpdo", "pp-sdo", "csp"):
        reach.add(random_moves(kind))
    assert all(reach.fired[kind] > 3 for kind in KINDS), str(reach)
    assert reach.hit[Ending.DONE] > 5, str(reach)
    assert sum(reach.errors.values()) > 3, str(reach)


# --- violations ----------------------------------------------------------------------------------


def test_blind_restart_after_timeout_is_detected(mover):
    """The reply is lost after the motor has moved, so a blind repetition is a second move."""

    def blindly(rig, distance):
        try:
            mover.move(rig, distance)
        except (DeadlineExceeded, LinkError):
            rig.runtime.run_for(0.5)
            mover.move(rig, distance)

    twice = replace(mover, move=blindly)
    if mover.name == "servo":
        pytest.skip("its moves are made on the host: no answer that is lost fails them")
    with pytest.raises(MadeMoreThanOnce, match="beyond"):
        reached(twice, [*hard_plans(mover)])


def test_relative_set_point_on_the_wire_is_detected(monkeypatch):
    """A relative bit (6) and a rising edge per repetition turn one lost answer into a move.

    CiA 402-2, profile position mode: each edge of bit 4 is a new set-point.
    """

    def push(self, index, value, subindex=0, *, whole=ObjectAccess.push):
        if index == 0x607A:
            value -= self.read_int(0x6062)
        return whole(self, index, value, subindex)

    def send_set_point(self):
        self.send_holding_word()
        return self.send_controlword(0x0F | 0x10 | 0x20 | 0x40)

    monkeypatch.setattr(ObjectAccess, "push", push)
    monkeypatch.setattr(DriveControl, "send_set_point", send_set_point)
    mover = movers.by_rpdo()
    assert judge(mover, plan_of()).endings == {Ending.DONE: 2}
    with pytest.raises(MadeMoreThanOnce, match="beyond"):
        judge(mover, plan_of(lost(TPDO, count=14)))


def hard_plans(mover):
    """Yield plans with lost answers: each SDO answer in turn, or all TPDOs and an SDO answer."""
    identifiers = traffic_of(mover).identifiers
    if TPDO in identifiers:
        yield from (plan_of(lost(TPDO, place=place, count=100)) for place in range(6))
        mute = FaultRule("mute", FaultKind.DROP, identifier=TPDO, until_ns=10_900_000_000)
        yield from (plan_of(mute, lost(SDO_ANSWER, place=place)) for place in range(0, 60, 2))
    yield from (plan_of(lost(SDO_ANSWER, place=place)) for place in range(60))


def test_done_report_without_motion_is_detected(mover):
    def boldly(rig, distance):
        try:
            mover.move(rig, distance)
        except MotorError:
            return

    bold = replace(mover, move=boldly)
    nothing = FaultRule("deaf", FaultKind.DROP, sender="host")
    with pytest.raises(MadeMoreThanOnce, match="was reported done; it is at"):
        judge(bold, plan_of(nothing))


def test_later_unrequested_move_is_detected():
    mover = movers.by_rpdo()

    def late(rig, distance):
        mover.move(rig, distance)
        rig.world.queue.alarm(lambda now_ns: mover.move(rig, 0.2)).set(
            rig.runtime.now_ns() + 800_000_000
        )

    with pytest.raises((MadeMoreThanOnce, MotorError)):
        judge(replace(mover, move=late), plan_of())


def test_adaptations_own_exception_is_passed_on():
    def broken(rig, distance):
        raise ZeroDivisionError("in the adaptation")

    with pytest.raises(ZeroDivisionError):
        judge(replace(movers.by_rpdo(), move=broken), plan_of())


def test_verdict_names_its_plan():
    mover = movers.by_rpdo()
    far = replace(mover, move=lambda rig, distance: mover.move(rig, 2 * distance))
    plan = plan_of(lost(TPDO))
    with pytest.raises(MadeMoreThanOnce, match=re.escape(str(plan))) as caught:
        judge(far, plan)
    assert "pp by RPDO: a move by 0.5 from 0 was reported done; it was at 0.99" in str(caught.value)


def test_equal_plans_give_equal_reach():
    plan = plan_of(
        FaultRule("half", FaultKind.DROP, probability=0.05),
        FaultRule("late", FaultKind.DELAY, probability=0.1, delay_ns=5_000_000),
    )
    assert judge(movers.by_rpdo(), plan) == judge(movers.by_rpdo(), plan)


def test_reach_as_text_lists_all_counts():
    told = str(judge(movers.by_rpdo(), plan_of(lost(RPDO, count=2))))
    assert told == (
        "moves: 2 done (1 of them hit). Faults: 2 drop. Errors: none."
        " Frames repeated by the host: 0"
    )
