"""Nothing that a file says controls the terminal that prints it."""

import re

import pytest

from motorhil.harness.cli.printable import printable
from motorhil.traces.can_frame import classic
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema

ESCAPE = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202e\r"
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


@pytest.fixture
def evil(bench):
    with TraceWriter("evil.mcap", {}) as writer:
        channel = writer.channel(f"/can/can0{ESCAPE}", Schema.of(CAN_FRAME))
        source = writer.source(channel, f"left{ESCAPE}\nforged line", Direction.RECEIVED)
        writer.extend([(source, 1_000, classic(0x701, b"\0"))])
    (bench / f"evil{ESCAPE}.toml").write_text("[rig\n")
    (bench / "evil.log").write_text(f"(0.0) can0{ESCAPE} 123#00\nnonsense {ESCAPE}\n")
    (bench / "evil.csv").write_text(f"time_s,bus{ESCAPE}\n1,{ESCAPE}\n")
    (bench / "evil.asc").write_text(f"date {ESCAPE}\nbase hex timestamps absolute\n{ESCAPE}\n")
    return bench


@pytest.mark.parametrize(
    "words",
    [
        ("show", "evil.mcap"),
        ("diff", "evil.mcap", "evil.mcap"),
        ("judge", "evil.mcap"),
        ("analyse", "evil.mcap"),
        ("recover", "evil.mcap", "-o", f"out{ESCAPE}.mcap"),
        ("convert", "evil.log", "out.mcap"),
        ("convert", "evil.csv", "out.mcap"),
        ("convert", "evil.asc", "out.mcap"),
        ("check", f"evil{ESCAPE}.toml"),
        ("show", f"no{ESCAPE}.mcap"),
        ("run", f"no{ESCAPE}.toml"),
    ],
    ids=lambda words: printable(" ".join(words)),
)
def test_output_has_no_control_characters(evil, say, words):
    _, out, err = say(*words)
    assert out + err
    assert CONTROL.search(out + err) is None
    assert not any(line.startswith("forged") for line in out.splitlines())


def test_tab_line_feed_and_words_of_any_language_stay():
    assert printable("a\tb\nGröße 位置") == "a\tb\nGröße 位置"
    assert printable("\x1b[31m\x7f\u202e") == r"\x1b[31m\x7f\u202e"
