"""Colours of verdicts: on a terminal, or if asked for; never from a recording."""

import io

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.cli.printable import has_colours

LOG = "".join(f"({1000 + n}.500000) can0 181#0102\n" for n in range(4))


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")


@pytest.mark.parametrize(
    ("choice", "variables", "stream", "wanted"),
    [
        ("auto", {}, Terminal(), True),
        ("auto", {}, io.StringIO(), False),
        ("auto", {"TERM": "dumb"}, Terminal(), False),
        ("auto", {"NO_COLOR": "1", "FORCE_COLOR": "1"}, Terminal(), False),
        ("auto", {"NO_COLOR": ""}, Terminal(), True),
        ("auto", {"FORCE_COLOR": "1"}, io.StringIO(), True),
        ("always", {"NO_COLOR": "1"}, io.StringIO(), True),
        ("never", {"FORCE_COLOR": "1"}, Terminal(), False),
    ],
)
def test_colours_follow_option_then_variables(monkeypatch, choice, variables, stream, wanted):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert has_colours(choice, stream) is wanted


def test_verdicts_have_colours_and_the_same_words(tmp_path, capsys):
    log = tmp_path / "a.log"
    log.write_text(LOG)
    plain = main(["judge", str(log)])
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert main(["judge", str(log), "--color", "always"]) == plain
    tinted = capsys.readouterr().out
    assert "\x1b[33mcould not judge" in tinted
    for code in ("\x1b[32m", "\x1b[31m", "\x1b[33m", "\x1b[0m"):
        tinted = tinted.replace(code, "")
    assert tinted == text


def test_clause_results_have_colours(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["conform", "--adaptation", "ideal", "--clause", "ID-02", "--color", "always"]
    assert main(words) == 0
    assert "ID-02     \x1b[32mpassed         \x1b[0m" in capsys.readouterr().out
