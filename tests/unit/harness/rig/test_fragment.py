"""Fragments of recordings: the world, the acts by hand in their order, ends of faults."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.rig.config.toml import RigError, Source, written
from motorhil.harness.rig.fragment import end_of, fragment_in, read_fragment, table_of

LOAD = table_of(written("stimulus", [("controller", "left"), ("value", 1.5)]))
CUT = table_of(written("fault", [("kind", "cut"), ("nodes", ["left"])]))


def test_acts_are_in_the_order_of_their_numbers():
    metadata = {"hand 10": LOAD, "run": {"seed": "1"}, "hand 2": CUT, "hand 1": LOAD}
    assert [line for line in fragment_in(metadata).splitlines() if line.startswith("[[")] == [
        "[[stimulus]]",
        "[[fault]]",
        "[[stimulus]]",
    ]


def test_end_of_a_fault_is_in_its_table():
    found = tomllib.loads(fragment_in({"hand 1": CUT, "hand 2": end_of("hand 1", 0.25)}))
    assert found == {"fault": [{"kind": "cut", "nodes": ["left"], "until_s": 0.25}]}


def test_world_comes_first():
    text = fragment_in({"hand 1": LOAD, "world": table_of("[world]\ninterleaving = 3\n")})
    assert text.startswith("[world]\ninterleaving = 3\n\n[[stimulus]]\n")


def test_metadata_of_others_are_left_out():
    assert fragment_in({"run": {"seed": "1"}, "hand 0": LOAD, "hand 1 ": LOAD}) == ""
    assert fragment_in({"hand 1": {}, "hand 2": end_of("hand 9", 1.0)}) == ""


def test_recording_without_acts_is_refused(demo):
    with pytest.raises(RigError, match="has no acts by hand, and no fragment"):
        read_fragment(demo)


@given(st.integers(0, 10**15))
def test_instant_is_the_same_after_the_text(time_ns):
    (one,) = tomllib.loads(written("stimulus", [("at_s", time_ns / 1e9)]))["stimulus"]
    assert round(one["at_s"] * 1e9) == time_ns


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x7f"), max_size=20))
def test_text_is_the_same_in_toml(text):
    assert tomllib.loads(written("a", [("b", text)])) == {"a": [{"b": text}]}


def test_appended_fragment_is_known(tmp_path):
    rig = Source(tmp_path / "rig.toml", "[rig]\nseed = 1")
    assert rig.fragment == ""
    assert rig.with_fragment(Source(tmp_path / "w.toml", "[world]\n")).fragment == "[world]\n"
