"""Sentences about disturbances and failures."""

import pytest

from motorhil.harness.rig.config.worlds import WEIGHTS
from motorhil.harness.swarm.report.sentences import duration, sentence, story, told
from motorhil.harness.swarm.row import CANARY
from motorhil.harness.swarm.worlds.disturbance import Disturbance
from tests.support.swarm.campaigns import CUT, DROP, failure

HIT = {"sender": "left", "identifier": 0x581, "skip": 1, "limit": 1}
SINCE = {"sender": "host", "identifier": 0x301, "from_s": 1.0823, "limit": 1}
SENT = {"sender": "host", "skip": 11, "limit": 3}
SPAN = {"at_s": 0.5, "for_s": 0.0025}
SENTENCES = [
    ("drop", "can0", HIT, "the second frame 581h of left is lost"),
    ("drop", "can0", {**HIT, "limit": 3}, "the second to fourth frames 581h of left are lost"),
    ("drop", "can0", {**HIT, "skip": 10}, "the 11th frame 581h of left is lost"),
    ("drop", "can0", {**HIT, "skip": 21}, "the 22nd frame 581h of left is lost"),
    ("drop", "can0", SINCE, "the first frame 301h of host from 1.0823 s on is lost"),
    ("drop", "can0", {**SINCE, "limit": 3}, "3 frames 301h of host from 1.0823 s on are lost"),
    (
        "delay",
        "can0",
        {**HIT, "delay_s": 0.00893},
        "the second frame 581h of left comes 8.93 ms late",
    ),
    ("duplicate", "can0", HIT, "the second frame 581h of left comes twice"),
    ("corrupt", "can0", HIT, "the second frame 581h of left has a wrong bit"),
    ("error", "can0", {**HIT, "error": "bit"}, "the second frame 581h of left meets a bit error"),
    (
        *("error", "can0", {**HIT, "error": "last"}),
        "the second frame 581h of left meets an error in its last bit",
    ),
    (
        *("error", "can0", {**HIT, "error": "ack"}),
        "the second frame 581h of left meets no acknowledgement",
    ),
    ("lose", "rs485", SENT, "the 12th to 14th transmissions of host on rs485 are lost"),
    (
        *("truncate", "rs485", {**SENT, "limit": 1, "after": 1}),
        "the 12th transmission of host on rs485 is cut after 1 byte",
    ),
    ("cut", "can0", {"node": "left", **SPAN}, "left is cut off can0 from 0.5 s for 2.5 ms"),
    (
        *("noise", "can0", {**SPAN, "rate": 0.001}),
        "noise inverts bits on can0 from 0.5 s for 2.5 ms (bit error rate 0.001)",
    ),
    ("load", "left", {"value": -3.5, **SPAN}, "-3.5 N m load left from 0.5 s for 2.5 ms"),
    ("stall", "left", {"value": 30.0, **SPAN}, "30 N m stall left from 0.5 s for 2.5 ms"),
    ("heat", "left", {"value": 90.0, **SPAN}, "left has 90 °C from 0.5 s for 2.5 ms"),
    (
        *("supply", "left", {"value": 12.0, **SPAN, "after": 24.0}),
        "the supply of left is 12 V from 0.5 s for 2.5 ms",
    ),
    ("power", "left", {"value": 0.0, **SPAN}, "left has no power from 0.5 s for 2.5 ms"),
    ("power", "left", {"value": 0.0, "at_s": 0.5}, "left has no power from 0.5 s on"),
    ("fault", "left", {"code": 0x4310, "at_s": 1.25}, "left has fault 4310h at 1.25 s"),
    ("quirk", "left", {"name": "slow_sdo"}, "left has the quirk slow_sdo"),
    ("clock", "left", {"ppm": -3.34}, "the clock of left is 3.34 ppm slow"),
    ("clock", "left", {"ppm": 3.34}, "the clock of left is 3.34 ppm fast"),
    (
        "plant",
        "left",
        {"key": "load_inertia_kg_m2", "value": 0.05},
        "load_inertia_kg_m2 of left is 0.05",
    ),
    ("interleaving", "", {"seed": 3}, "the parties take turns by seed 3"),
    ("kill", "driver", {"at_s": 1.5}, "program driver is killed at 1.5 s"),
]


@pytest.mark.parametrize(("kind", "on", "values", "expected"), SENTENCES)
def test_sentence_of_each_kind(kind, on, values, expected):
    assert sentence(Disturbance(kind, on, tuple(values.items()))) == expected


def test_each_kind_that_is_drawn_has_a_sentence():
    assert {kind for kind, *_ in SENTENCES} == set(WEIGHTS)


def test_unknown_kind_or_missing_value_is_listed():
    assert sentence(Disturbance("melt", "left", (("at_s", 1.0),))) == "melt on left (at_s 1.0)"
    assert sentence(Disturbance("clock", "left")) == "clock on left"


def test_story_tells_world_disturbances_time_and_failure():
    row = failure(text="1.052100000 s can0 node 1 (left): target 66000 reported as reached")
    assert story(row) == (
        "World 17: the second frame 581h of left is lost; at 1.052100 s can0 node 1 (left): "
        "target 66000 reported as reached"
    )


def test_story_of_several_disturbances_joins_them_by_and():
    assert told((DROP, CUT, CUT)) == (
        "the second frame 581h of left is lost, left is cut off can0 from 0.5 s for 20 ms, and "
        "left is cut off can0 from 0.5 s for 20 ms"
    )
    assert story(failure(CANARY, world=())).startswith("The canary: nothing disturbs it; at ")


def test_story_is_one_line_without_control_characters():
    row = failure(text="a\nb\x1b[31m\u202ec")
    assert story(row).endswith("a b\\x1b[31m\\u202ec")


@pytest.mark.parametrize(
    ("time_s", "expected"),
    [
        (1.0, "1 s"),
        (0.9996, "1 s"),
        (0.9994, "999 ms"),
        (0.0009996, "1 ms"),
        (0.00025, "250 µs"),
        (0.0, "0 µs"),
        (12.5, "12.5 s"),
    ],
)
def test_duration_has_a_fitting_unit(time_s, expected):
    assert duration(time_s) == expected
