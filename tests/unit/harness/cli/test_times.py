"""Times of a recording on the command line: seconds, seconds from its beginning, dates."""

import argparse

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.cli.times import add_span, moment, span_of
from motorhil.traces.errors import TraceError

S = 1_000_000_000
RIG = (0, 20 * S)
# 2024-01-01T00:00:00Z, by `date -u -d 2024-01-01 +%s`
DAY_S = 1_704_067_200
DATED = (DAY_S * S, (DAY_S + 20) * S)
CANDUMP = "".join(f"({DAY_S + second}.500000) can0 181#0102\n" for second in range(4))


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "drive.log"
    path.write_text(CANDUMP)
    return str(path)


def chosen(words, span, told=None):
    parser = argparse.ArgumentParser()
    add_span(parser)
    tell = (lambda text: None) if told is None else told.append
    return span_of(parser.parse_args(words.split()), "x.mcap", span, tell)


@pytest.mark.parametrize(
    ("words", "span", "found"),
    [
        ("", RIG, (None, None)),
        ("--from 12.5 --to 13", RIG, (12_500_000_000, 13 * S)),
        ("--last 1", RIG, (19 * S, None)),
        ("--from 19.5 --last 1", RIG, (19_500_000_000, None)),
        ("--from 12.5", DATED, (DATED[0] + 12_500_000_000, None)),  # from the beginning
        (f"--from {DAY_S + 3}.5", DATED, (DATED[0] + 3_500_000_000, None)),
        ("--from 2024-01-01T00:00:07", DATED, (DATED[0] + 7 * S, None)),
        ("--from 2024-01-01T01:00:07.25+01:00", DATED, (DATED[0] + 7_250_000_000, None)),
        ("--to 2024-01-01T00:00:07Z", DATED, (None, DATED[0] + 7 * S)),
        ("--last 1", DATED, (DATED[1] - S, None)),
        ("--from 1", None, (None, None)),
    ],
)
def test_span_is_that_of_the_options(words, span, found):
    assert chosen(words, span) == found


@pytest.mark.parametrize(
    ("words", "span", "told"),
    [
        ("--from 21", RIG, "nothing at that time (--from): the recording is from 0 s to 20 s"),
        ("--from 21", DATED,
         "nothing at that time (--from): the recording is from 1704067200 s to 1704067220 s"
         " (2024-01-01T00:00:00Z to 2024-01-01T00:00:20Z)"),
        ("--to 0", RIG, "nothing at that time (--to): the recording is from 0 s to 20 s"),
        ("--from 3 --to 3", RIG, "nothing is between --from 3 s and --to 3 s"),
    ],
)  # fmt: skip
def test_time_outside_names_the_range_of_the_recording(words, span, told):
    found = []
    chosen(words, span, found)
    assert found == [f"x.mcap: {told}"]


def test_date_is_refused_for_times_of_a_rig():
    with pytest.raises(TraceError, match="do not count from 1970; give seconds; the recording is"):
        chosen("--from 2024-01-01T00:00:07", RIG)


@pytest.mark.parametrize("text", ["yesterday", "2024-13-01", "-1", "1e3", "", "1.0000000001"])
def test_text_that_is_not_a_time_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="is not a time; say"):
        moment(text)


@pytest.mark.parametrize("verb", ["show", "judge"])
def test_verb_names_the_range_of_a_foreign_recording(log, verb, capsys):
    main([verb, log, "--from", "9"])
    told = "nothing at that time (--from): the recording is from 1704067200.5 s to 1704067203.5 s"
    assert told in capsys.readouterr().err


def test_show_counts_from_the_beginning_or_by_date(log, capsys):
    printed = []
    for words in (["--from", "2"], ["--from", "2024-01-01T00:00:02.5Z"], ["--last", "1"]):
        assert main(["show", log, *words]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0].count("\n") == 2
    assert printed == [printed[0]] * 3


def test_replay_takes_the_same_times(tmp_path, log, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text('[bus.can0]\nbitrate_bit_s = 1_000_000\n[controller.left]\nkind = "cia402"\n'
                   'bus = "can0"\nnode_id = 1\n')  # fmt: skip
    words = ["replay", log, "--as", "traffic", "--rig", str(rig), "--json", "--speed", "max"]
    assert main([*words, "--last", "1"]) == 0
    assert '"sent": {"can0": 2}' in capsys.readouterr().out
