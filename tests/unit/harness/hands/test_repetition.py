"""Runs with hands, repeated without hands from their recordings: the same messages."""

import pytest

from motorhil.harness.rig.fragment import read_fragment
from motorhil.traces.digest import digest


@pytest.mark.parametrize("seed", range(24))
def test_random_acts_repeat_without_hands(driven, random_acts, seed):
    by_hand, channel = driven("two_wheels", "hands.mcap", random_acts(seed, 12, 4.0))
    assert "" in channel.answers.values()
    again, _ = driven("two_wheels", "again.mcap", world=by_hand)
    assert digest(again) == digest(by_hand)


def test_acts_without_a_pace_repeat(driven):
    acts = [
        {"act": "stimulus", "controller": "left", "name": "load_torque_n_m", "value": 2.0},
        {"act": "fault", "bus": "can0", "kind": "noise", "keys": "bit_error_rate = 1e-3"},
        {"act": "mend", "name": "hand 2"},
    ]
    requests = [(0.0, act) for act in acts]
    by_hand, channel = driven("two_wheels", "hands.mcap", requests, pace=None)
    assert channel.answers == {1: "", 2: "", 3: ""}
    again, _ = driven("two_wheels", "again.mcap", world=by_hand)
    assert digest(again) == digest(by_hand)


def test_standstill_and_pace_change_nothing(driven):
    plain, _ = driven("two_wheels", "plain.mcap")
    requests = [
        (0.0, {"act": "step", "for_s": 0.4}),
        (0.5, {"act": "pace", "pace": 3.0}),
        (1.0, {"act": "continue"}),
        (1.2, {"act": "stop"}),
        (2.0, {"act": "pace"}),
        (2.5, {"act": "continue"}),
    ]
    paced, channel = driven("two_wheels", "paced.mcap", requests, is_stopped=True)
    assert set(channel.answers.values()) == {""}
    assert [state["stands"] for state in channel.states][:1] == [True]
    assert digest(paced) == digest(plain)


def test_hands_in_a_world_repeat_with_it(driven, tmp_path):
    world = tmp_path / "world.toml"
    world.write_text(
        '[[stimulus]]\ncontroller = "right"\nname = "load_torque_n_m"\nvalue = 1.0\nat_s = 0.5\n'
    )
    acts = [(1.0, {"act": "stimulus", "controller": "left", "name": "sto", "value": 1})]
    by_hand, _ = driven("two_wheels", "hands.mcap", acts, world=world)
    text = read_fragment(by_hand).text
    assert text.index("at_s = 0.5") < text.index('name = "sto"')
    again, _ = driven("two_wheels", "again.mcap", world=by_hand)
    assert digest(again) == digest(by_hand)
