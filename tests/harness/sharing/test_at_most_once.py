"""No relative move is made twice, by any adaptation; and whoever does make one twice is told so."""

import re
from dataclasses import replace

import pytest

from emulators.media.faults import FaultKind, FaultRule
from harness.sharing.at_most_once import KINDS, at_most_once, judge, single_faults, traffic_of
from harness.sharing.relative_moves import Ending, MadeMoreThanOnce, Plan, Reach, Step
from motorapi import DeadlineExceeded
from motorapi.adaptations.drive_control import DriveControl
from motorapi.adaptations.drive_objects import DriveObjects
from motorapi.errors import MotorError
from tests.harness.sharing import movers

SDO_REQUEST, SDO_ANSWER, TPDO, RPDO = 0x601, 0x581, 0x181, 0x201
EXAMPLES = {"servo": 8}  # a cycle of 1 ms costs
EVERY = {"servo": 49, "csp": 21, "pp by SYNC": 21}  # of the plans with one fault; else
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
    """From this frame of the identifier on so many are lost."""
    return FaultRule("lost", FaultKind.DROP, identifier=identifier, skip=place, limit=count)


def plan_of(*rules, distance=0.5):
    return Plan(1, (Step(distance, rules), Step(-distance)))


def reached(mover, plans):
    reach = Reach()
    for plan in plans:
        reach.add(judge(mover, plan))
    return reach


# --- the property ------------------------------------------------------------------------------


def test_a_relative_move_is_made_at_most_once_whatever_becomes_of_frames(mover):
    at_most_once(mover, examples=EXAMPLES.get(mover.name, 25), shrink=False)()


def test_it_is_made_at_most_once_with_one_fault_anywhere_in_its_start(mover):
    """The whole of it takes minutes; a test sees every so many, which are of all kinds."""
    chosen = single_faults(mover)[:: EVERY.get(mover.name, EVERY_NINTH)]
    reach = reached(mover, chosen)
    assert sum(reach.fired.values()) == sum(reach.hit.values()) == len(chosen) >= 10
    assert reach.hit[Ending.DONE] > 5
    assert all(reach.fired[kind] > 2 for kind in KINDS)


# --- which is about something: what it must have met ----------------------------------------------


def test_undisturbed_moves_are_made_and_nothing_is_hit(mover):
    reach = judge(mover, plan_of())
    assert reach.endings == {Ending.DONE: 2}
    assert not reach.hit
    assert not reach.fired
    assert not reach.errors


def test_moves_fail_that_were_made_when_the_answer_is_lost(tmp_path):
    mover = movers.by_sdo(tmp_path)
    answers = [plan_of(lost(SDO_ANSWER, place=place)) for place in range(0, 60, 2)]
    reach = reached(mover, answers)
    assert reach.fired == {FaultKind.DROP: len(answers)}
    assert reach.endings[Ending.FAILED_MADE] > 0
    assert reach.endings[Ending.FAILED_NOT_MADE] > 0
    assert reach.errors["DeadlineExceeded"] > 10


def test_late_answers_come_in_the_next_move_and_do_no_harm(tmp_path):
    """They are held back longer than anybody waits for them; then another object is asked for."""
    mover = movers.by_sdo(tmp_path)
    late = FaultRule("late", FaultKind.DELAY, identifier=SDO_ANSWER, limit=1, delay_ns=400_000_000)
    for place in range(0, 60, 4):
        reach = judge(mover, plan_of(replace(late, skip=place)))
        assert reach.fired == {FaultKind.DELAY: 1}
        assert reach.errors.keys() <= {"DeadlineExceeded"}
        assert reach.endings[Ending.DONE] >= 1  # the second one


def test_a_command_that_is_lost_is_sent_again_and_made_once():
    reach = judge(movers.by_rpdo(), plan_of(lost(RPDO, count=2)))
    assert reach.fired == {FaultKind.DROP: 2}
    assert reach.endings == {Ending.DONE: 2}
    assert reach.hit == {Ending.DONE: 1}


def test_an_acknowledge_that_is_lost_has_the_command_sent_again_and_made_once():
    reach = judge(movers.by_rpdo(), plan_of(lost(TPDO, count=14)))
    assert reach.repeated >= 1
    assert reach.endings == {Ending.DONE: 2}
    assert reach.hit == {Ending.DONE: 1}


def test_random_plans_reach_what_they_are_about(tmp_path):
    reach = Reach()
    for make in (movers.by_rpdo, lambda: movers.by_sdo(tmp_path), movers.streamed):
        at_most_once(make(), examples=25, reach=reach)()
    assert all(reach.fired[kind] > 3 for kind in KINDS), str(reach)
    assert reach.hit[Ending.DONE] > 5, str(reach)
    assert sum(reach.errors.values()) > 3, str(reach)


# --- and who breaks it is told -------------------------------------------------------------------


def test_whoever_starts_again_after_a_timeout_is_caught(mover):
    """The reply is lost, the motor has moved: a blind repetition is a second move."""

    def blindly(rig, distance):
        try:
            mover.move(rig, distance)
        except DeadlineExceeded:
            rig.runtime.run_for(0.5)
            mover.move(rig, distance)

    twice = replace(mover, move=blindly)
    if mover.name == "servo":
        pytest.skip("its moves are made on the host: no answer that is lost fails them")
    with pytest.raises(MadeMoreThanOnce, match="beyond"):
        reached(twice, [*hard_plans(mover)])


def test_an_adaptation_that_has_the_drive_count_from_where_it_is_is_caught(monkeypatch):
    """Relative on the wire (bit 6), a rising edge for every repetition: one lost answer is a move.

    CiA 402-2, profile position mode: each edge of bit 4 is a set-point of its own.
    """

    def push(self, index, value, subindex=0, *, whole=DriveObjects.push):
        if index == 0x607A:
            value -= self.read_int(0x6062)
        return whole(self, index, value, subindex)

    def send_set_point(self):
        self.send_holding_word()
        return self.send_controlword(0x0F | 0x10 | 0x20 | 0x40)

    monkeypatch.setattr(DriveObjects, "push", push)
    monkeypatch.setattr(DriveControl, "send_set_point", send_set_point)
    mover = movers.by_rpdo()
    assert judge(mover, plan_of()).endings == {Ending.DONE: 2}
    with pytest.raises(MadeMoreThanOnce, match="beyond"):
        judge(mover, plan_of(lost(TPDO, count=14)))


def hard_plans(mover):
    """Answers are lost: of SDO one, from every one on; or all that the drive tells by itself."""
    identifiers = traffic_of(mover).identifiers
    if TPDO in identifiers:
        yield plan_of(FaultRule("mute", FaultKind.DROP, identifier=TPDO, until_ns=10_300_000_000))
        yield from (plan_of(lost(TPDO, place=place, count=100)) for place in range(6))
    yield from (plan_of(lost(SDO_ANSWER, place=place)) for place in range(60))


def test_whoever_says_done_of_what_was_not_heard_is_caught(mover):
    def boldly(rig, distance):
        try:
            mover.move(rig, distance)
        except MotorError:
            return

    bold = replace(mover, move=boldly)
    nothing = FaultRule("deaf", FaultKind.DROP, sender="host")
    with pytest.raises(MadeMoreThanOnce, match="was reported done; it is at"):
        judge(bold, plan_of(nothing))


def test_whoever_moves_later_by_himself_is_caught():
    mover = movers.by_rpdo()

    def late(rig, distance):
        mover.move(rig, distance)
        rig.world.queue.alarm(lambda now_ns: mover.move(rig, 0.2)).set(
            rig.runtime.now_ns() + 800_000_000
        )

    with pytest.raises((MadeMoreThanOnce, MotorError)):
        judge(replace(mover, move=late), plan_of())


def test_an_error_of_the_adaptations_own_code_is_no_verdict_but_itself():
    def broken(rig, distance):
        raise ZeroDivisionError("in the adaptation")

    with pytest.raises(ZeroDivisionError):
        judge(replace(movers.by_rpdo(), move=broken), plan_of())


def test_a_verdict_names_the_plan_that_led_to_it():
    mover = movers.by_rpdo()
    far = replace(mover, move=lambda rig, distance: mover.move(rig, 2 * distance))
    plan = plan_of(lost(TPDO))
    with pytest.raises(MadeMoreThanOnce, match=re.escape(str(plan))) as caught:
        judge(far, plan)
    assert "pp by RPDO: a move by 0.5 from 0 was reported done; it was at 0.99" in str(caught.value)


def test_the_same_plan_reaches_the_same():
    plan = plan_of(
        FaultRule("half", FaultKind.DROP, probability=0.05),
        FaultRule("late", FaultKind.DELAY, probability=0.1, delay_ns=5_000_000),
    )
    assert judge(movers.by_rpdo(), plan) == judge(movers.by_rpdo(), plan)


def test_what_was_reached_is_told_in_words():
    told = str(judge(movers.by_rpdo(), plan_of(lost(RPDO, count=2))))
    assert told == (
        "moves: 2 done (1 of them hit). Faults: 2 drop. Errors: none."
        " Frames repeated by the host: 0"
    )
