"""Rows: the results of worlds, as lines."""

import json
from dataclasses import replace

import pytest

from motorhil.harness.swarm.row import Result, Row, row_from
from motorhil.harness.swarm.worlds.disturbance import Disturbance

CUT = Disturbance("cut", "can0", (("node", "left"), ("at_s", 1.25), ("for_s", 0.5)))
FULL = Row(
    seed=17,
    result=Result.FAILED,
    oracle="assert",
    signature="assert | assert at app.py:3 | - | 4m | cut: begins",
    text="AssertionError: Ärger (app.py:3)",
    at_ns=1_300_000_000,
    end_ns=2_000_000_000,
    digest="0123456789abcdef",
    fired=3,
    ended_by="LinkError",
    new=("4m after the start | cut: begins",),
    met=(("a retry", 2), ("a stop", 0)),
    world=(CUT,),
)


@pytest.mark.parametrize("row", [FULL, Row(0, Result.PASSED), Row(3, Result.KILLED, text="gone")])
def test_a_row_survives_its_line(row):
    assert row_from(row.as_line()) == row
    assert "\n" not in row.as_line()


def test_a_line_has_nothing_that_is_empty():
    assert json.loads(Row(5, Result.PASSED, end_ns=7).as_line()) == {
        "seed": 5,
        "result": "pass",
        "end_ns": 7,
    }


@pytest.mark.parametrize(
    "line",
    [
        "",
        "{",
        "[]",
        "7",
        '{"seed":1}',
        '{"seed":1,"result":"odd"}',
        '{"seed":1,"result":"pass","more":2}',
    ],
)
def test_what_is_no_row_is_refused(line):
    with pytest.raises(ValueError, match="no row of a campaign"):
        row_from(line)


@pytest.mark.parametrize(
    ("result", "is_bad"),
    [
        (Result.PASSED, False),
        (Result.FAILED, True),
        (Result.TIMEOUT, True),
        (Result.KILLED, False),
        (Result.CANCELLED, False),
    ],
)
def test_failures_are_what_the_program_did(result, is_bad):
    assert Row(1, result).is_bad is is_bad


def test_rows_of_a_campaign_share_values_that_repeat():
    acts = (("drop", 1), ("delay", 2))
    one = Row(1, Result.PASSED, ended_by="LinkError", met=(("arrived", 1),), acts=acts)
    first, second = row_from(one.as_line()), row_from(replace(one, seed=2).as_line())
    assert (first, second) == (one, replace(one, seed=2))
    for name in ("ended_by", "met", "acts"):
        assert getattr(first, name) is getattr(second, name)
