"""Requests of a page: what is refused, and why."""

import pytest

from motorhil.harness.hands.hands import Hands, RefusedError, checked
from motorhil.harness.hands.requests import Inject, Speed, Step, Stimulate, Stop
from motorhil.harness.rig.rig import Rig
from motorhil.traces.digest import digest


def test_requests_are_read():
    assert checked({"act": "stop"}) == Stop()
    assert checked({"act": "step"}) == Step(for_s=0.01)
    assert checked({"act": "pace", "pace": 2}) == Speed(pace=2.0)
    assert checked({"act": "pace"}) == Speed(pace=None)
    one = {"act": "stimulus", "controller": "left", "name": "sto", "value": 1}
    assert checked(one) == Stimulate(controller="left", name="sto", value=1.0)


@pytest.mark.parametrize(
    ("act", "told"),
    [
        ({}, "act: unknown act None; "),
        ({"act": "stpo"}, "act: unknown act 'stpo'; did you mean stop?"),
        ({"act": "stop", "now": 1}, "now: unknown key"),
        ({"act": "step", "for_s": 0}, "for_s: 0 s is out of range; allowed: "),
        ({"act": "step", "for_s": "1"}, "for_s: "),
        ({"act": "step", "for_s": float("nan")}, "for_s: must be finite (nan); "),
        ({"act": "pace", "pace": -1}, "pace: -1 is out of range; "),
        ({"act": "stimulus", "controller": "left", "name": "sto"}, "value: is missing"),
        ({"act": "stimulus", "controller": 1, "name": "sto", "value": 1}, "controller: "),
        ({"act": "mend"}, "name: is missing"),
    ],
)
def test_wrong_request_is_refused_in_one_line(act, told):
    with pytest.raises(RefusedError) as caught:
        checked(act)
    assert str(caught.value).startswith(told)
    assert "\n" not in str(caught.value)


def keys_of(text):
    return Inject(bus="can0", kind="drop", keys=text).further()


def test_further_keys_are_toml():
    assert keys_of("identifier = 0x181, limit = 1") == {"identifier": 0x181, "limit": 1}
    assert keys_of(None) == {}


@pytest.mark.parametrize(
    "text",
    [
        "limit",
        "limit = 1\nlimit = 2",
        "limit = 1 }\r[rig",
        "limit = 1 }, other = { a = 1",
        "a = " + "[" * 400,
        "name = 'x'",
        "from_s = 1",
        "until_s = 1",
        "by_hand = false",
        'kind = "cut"',
        f"a = '{'x' * 1000}'",
    ],
)
def test_keys_that_do_not_belong_to_a_hand_are_refused(driven, text):
    act = {"act": "fault", "bus": "can0", "kind": "drop", "keys": text}
    _, channel = driven("two_wheels", "hands.mcap", [(0.1, act)])
    assert channel.answers[1] != ""
    assert channel.states[-1]["acts"] == 0


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (
            {"act": "stimulus", "controller": "lefd", "name": "sto", "value": 1},
            'controller: there is no controller "lefd" (known: left, right); did you mean left?',
        ),
        (
            {"act": "stimulus", "controller": "left", "name": "stop", "value": 1},
            "left: there is no stimulus 'stop'; known: load_torque_n_m, ",
        ),
        (
            {"act": "stimulus", "controller": "left", "name": "sto", "value": 0.5},
            "left: sto is 0 or 1, not 0.5",
        ),
        ({"act": "fault", "bus": "can1", "kind": "drop"}, 'bus: there is no bus "can1" '),
        ({"act": "fault", "bus": "can0", "kind": "delay"}, "delay_s: is missing; "),
        ({"act": "mend", "name": "hand 1"}, "hand 1: is not a fault by hand (known: none)"),
    ],
)
def test_rig_refuses_and_continues(driven, act, told):
    plain, _ = driven("two_wheels", "plain.mcap")
    by_hand, channel = driven("two_wheels", "hands.mcap", [(0.1, act)])
    assert channel.answers[1].startswith(told)
    assert "\n" not in channel.answers[1]
    assert channel.states[-1]["acts"] == 0
    assert digest(by_hand) == digest(plain)


def test_recorded_rig_has_its_time_only(demo, tmp_path):
    with Rig.open(demo, record=tmp_path / "again.mcap") as rig:
        hands = Hands(rig)
        assert hands.elements() == {"controllers": [], "buses": []}
        with pytest.raises(RefusedError, match="rig: is a recording"):
            hands.act(Stimulate(controller="drive_fl", name="sto", value=1.0), 1)
