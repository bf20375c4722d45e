"""`--json` of every verb: one document on stdout, and the exit status that the verb has anyway."""

import json

import pytest

from motorhil.harness.cli.main import main, parsers
from tests.support.swarm.campaigns import failure, written

# They print what programs print, an address, or a script.
NO_RESULTS = {"demo", "run", "serve", "view", "completion"}
LINES = {"show"}  # one document a line, as a recording may have no end
LOG = "".join(f"({1000 + n}.500000) can0 181#0102\n" for n in range(4))
RIG = """\
[motor.wheel]
adaptation = "ideal"
[motor.wheel.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
"""
BUS = """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
"""
WORDS = {
    "new": ["new", "wheels"],
    "check": ["check", "rig.toml"],
    "record": None,  # it needs a live bus: tests/system/wall/test_record.py
    "replay": ["replay", "a.log", "--as", "traffic", "--rig", "bus.toml", "--speed", "max"],
    "recover": ["recover", "a.mcap", "-o", "whole.mcap", "--force"],
    "show": ["show", "a.log"],
    "diff": ["diff", "a.log", "b.log"],
    "conform": ["conform", "--rig", "rig.toml", "--clause", "ID-02"],
    "judge": ["judge", "a.log"],
    "analyse": ["analyse", "bus.toml"],
    "report": ["report", "a.log", "-o", "page.html"],
    "convert": ["convert", "a.log", "-o", "a.mcap", "--force"],
    "identify": None,  # it needs a recorded motion: test_identify.py
    "list": ["list", "controllers"],
    "swarm": ["swarm", "--show", "campaign"],
}
VERBS = [name for name in parsers() if name not in NO_RESULTS]


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "bus.toml").write_text(BUS)
    (tmp_path / "a.log").write_text(LOG)
    (tmp_path / "b.log").write_text(LOG.replace("0102", "0103"))
    assert main(["convert", "a.log", "-o", "a.mcap"]) == 0
    written(tmp_path / "campaign", [failure()])
    return tmp_path


def test_every_verb_with_results_has_json():
    assert set(VERBS) == set(WORDS)
    for name, parser in parsers().items():
        has_json = any("--json" in action.option_strings for action in parser._actions)
        assert has_json is (name not in NO_RESULTS), name


@pytest.mark.parametrize("verb", [name for name in VERBS if WORDS.get(name)])
def test_json_is_one_document_with_the_same_status(bench, capsys, verb):
    plain = main(WORDS[verb])
    text = capsys.readouterr().out
    if verb == "new":
        for path in (bench / "wheels").iterdir():
            path.unlink()
    assert main([*WORDS[verb], "--json"]) == plain
    out = capsys.readouterr().out
    assert out.endswith("\n")
    assert out != text
    documents = out.splitlines() if verb in LINES else [out]
    assert all(isinstance(json.loads(one), dict | list) for one in documents)


@pytest.mark.parametrize("words", [["judge", "--list"], ["conform", "--list"]])
def test_list_of_rules_is_one_document(words, capsys):
    assert main([*words, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) > 10
