"""Classes of events and states, and which oracles may judge a world."""

import pytest

from motorhil.harness.oracles.judge import IDS
from motorhil.harness.rig.config.worlds import WEIGHTS
from motorhil.harness.swarm import properties
from motorhil.harness.swarm.worlds.fairness import EXCUSES, fair, is_pushed_out
from motorhil.harness.swarm.worlds.observer import event_class, state_class
from motorhil.motorapi.errors import LimitError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("drop 2: drop 581h", "drop 580h"),
        ("drop 1: drop 582h", "drop 580h"),
        ("delay 1: delay 181h", "delay 180h"),
        ("cut 1: begins", "cut: begins"),
        ("lose 1: lose 01 10 62 00 00 08 DE 77", "lose request 10h"),
        ("truncate 1: truncate 02 03", "truncate request 03h"),
        ("stimulus load_torque_n_m = -12.5", "stimulus load_torque_n_m = #"),
        ("fault 8611h (following error)", "fault 8611h (following error)"),
    ],
)
def test_events_that_differ_in_numbers_are_one_class(text, expected):
    assert event_class(text) == expected


@pytest.mark.parametrize(
    ("truth", "expected"),
    [
        ({"state": 4.0, "velocity_rad_s": 0.0}, "4"),
        ({"state": 4.0, "velocity_rad_s": -0.5}, "4m"),
        ({"velocity_m_s": 0.5}, "-m"),
        ({}, "-"),
    ],
)
def test_a_state_is_that_of_the_drive_and_whether_it_moves(truth, expected):
    assert state_class(truth) == expected


def test_an_undisturbed_world_is_judged_by_all():
    assert fair(()) == IDS


def test_excuses_name_oracles_and_kinds_that_exist():
    assert set(EXCUSES) <= set(IDS)
    assert {kind for kinds in EXCUSES.values() for kind in kinds} <= set(WEIGHTS)


def test_a_load_excuses_a_limit_and_no_protocol():
    found = fair({"load"})
    assert "limit-velocity" not in found
    assert {"pds-legal", "one-sender", "owner-commands"} <= set(found)


def test_quirk_that_sends_on_the_identifier_of_another_drive_is_excused():
    assert "one-sender" not in fair({"quirk"})  # stray_emcy: 081h, whatever the node-ID
    assert "one-sender" in fair({"noise", "clock", "kill"})


def outside(quantity):
    return LimitError(motor="mast", quantity=quantity, value=9.0, low=-1.7, high=1.7, unit="rad")


@pytest.mark.parametrize(
    ("error", "kinds", "expected"),
    [
        (outside("initial position"), ("drop", "stall"), True),
        (outside("initial position"), ("load",), True),
        (outside("initial position"), ("drop", "fault"), False),  # nothing pushes
        (outside("target position"), ("stall",), False),  # the program's own mistake
        (ValueError("initial position"), ("stall",), False),
    ],
)
def test_motor_that_was_pushed_out_may_refuse(error, kinds, expected):
    assert is_pushed_out(error, kinds) is expected


def test_always_raises_and_names_the_promise():
    properties.always(True, "it holds")
    with pytest.raises(properties.PropertyViolated, match=r"^it holds$"):
        properties.always([], "it holds")


def test_sometimes_counts_what_was_true_and_what_never_was():
    properties.forget()
    for value in (True, False, True):
        properties.sometimes(value, "a retry")
    properties.sometimes(False, "a stop")
    assert properties.met() == {"a retry": 2, "a stop": 0}
    properties.forget()


def test_late_statusword_accuses_no_drive():
    judged_by_position_or_state = {"arrival-true", "pds-legal"}
    assert judged_by_position_or_state.isdisjoint(fair({"delay"}))
    assert judged_by_position_or_state <= set(fair({"drop"}))
