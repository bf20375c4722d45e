"""Rig keys of CAN controllers and bus faults, valid and invalid."""

import contextlib
import io
from dataclasses import dataclass

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from motorhil.harness.cli.main import main

RIG = """\
[bus.can0]
bitrate_bit_s = 500_000
data_bitrate_bit_s = 2_000_000
[bus.can0.node.left]
queue = "priority"
frames = "fd_tolerant"
one_shot = true
recovery_s = 0.5
error_reporting = true
oscillator_ppm = 50.0
time_quanta = 20
sample_point = 16
jump_width = 4
[bus.can0.node.host]
recovery_s = "command"
[bus.can0.node.ear]
silent = true
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
[[fault]]
bus = "can0"
kind = "error"
bit = 20
nodes = ["left", "ear"]
[[fault]]
bus = "can0"
kind = "error"
error = "stuff"
sender = "left"
[[fault]]
bus = "can0"
kind = "noise"
bit_error_rate = 1e-6
from_s = 1.0
[[fault]]
bus = "can0"
kind = "babble"
sender = "ear"
identifier = 0x080
data = "00 FF"
from_s = 1.0
[[fault]]
bus = "can0"
kind = "short"
level = "dominant"
from_s = 1.0
until_s = 2.0
[[fault]]
bus = "can0"
kind = "split"
nodes = ["left"]
from_s = 1.0
"""


@dataclass
class Answer:
    status: int
    out: str
    err: str


def check(path, text):
    path.write_text(text)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(["check", str(path)])
    return Answer(status, out.getvalue(), err.getvalue())


def test_every_key_is_accepted(tmp_path):
    answer = check(tmp_path / "rig.toml", RIG)
    warning = "can0: warning: classical CAN controllers destroy its CAN FD frames: ear; give them "
    assert (answer.status, answer.err.splitlines()) == (
        0,
        [f'{warning}frames = "fd_tolerant" or "fd" in [bus.can0.node.ear]'],
    )


# (old text, new text, message), with line, key, value, limit and remedy.
REFUSALS = [
    ("2_000_000", "400_000", "3: bus.can0.data_bitrate_bit_s: 400000 bit/s is out of range; "
     "allowed: 500000 to 20000000 bit/s"),
    ("[bus.can0.node.left]", "[bus.can0.node.lft]", '4: bus.can0.node.lft: there is no controller '
     '"lft" (known: host, left); did you mean left?'),
    ('queue = "priority"', 'queue = "lifo"', '5: bus.can0.node.left.queue: unknown queue "lifo" '
     "(known: fifo, priority); did you mean fifo?"),
    ('"fd_tolerant"', '"xl"', '6: bus.can0.node.left.frames: unknown kind of CAN controller "xl" '
     "(known: classical, fd_tolerant, fd); take it out, or use one of these"),
    ("one_shot = true", "one_shot = 1", "7: bus.can0.node.left.one_shot: must be true or false, "
     "but is an integer (1); write one_shot = true"),
    ("recovery_s = 0.5", "recovery_s = -1", "8: bus.can0.node.left.recovery_s: -1 s is out of "
     "range; allowed: 0 to 1e+06 s"),
    ("recovery_s = 0.5", 'recovery_s = "never"', "8: bus.can0.node.left.recovery_s: must be a "
     'number [s], but is a string ("never"); write recovery_s = 0.1, or "command"'),
    ("recovery_s = 0.5", 'recovery = "command"', "8: bus.can0.node.left.recovery: unknown key "
     "(known: queue, frames, one_shot, recovery_s, error_reporting, oscillator_ppm, time_quanta, "
     "sample_point, jump_width, silent); did you mean recovery_s?"),
    ("oscillator_ppm = 50.0", "oscillator_ppm = 1e6", "10: bus.can0.node.left.oscillator_ppm: "
     "1000000.0 ppm is out of range; allowed: -100000 to 100000 ppm"),
    ("time_quanta = 20\nsample_point = 16\n", "time_quanta = 10\n", "11: bus.can0.node.left."
     "time_quanta: 10 quanta leave no room for the usual sample point, 14; write sample_point = 8"),
    ("sample_point = 16", "sample_point = 0", "12: bus.can0.node.left.sample_point: 0 quanta is "
     "out of range; allowed: 2 to 399 quanta"),
    ("sample_point = 16", "sample_point = 20", "12: bus.can0.node.left.sample_point: 20 quanta is "
     "out of range; allowed: 2 to 19 quanta"),
    ("sample_point = 16", "sample_point = 0.8", "12: bus.can0.node.left.sample_point: must be an "
     "integer [quanta], but is a float (0.8); allowed: 2 to 399 quanta"),
    ("jump_width = 4", "jump_width = 5", "13: bus.can0.node.left.jump_width: 5 quanta behind the "
     "sample point is out of range; allowed: 1 to 4 quanta behind the sample point"),
    ("[bus.can0.node.ear]", '[bus.can0.node."an ear"]', "16: bus.can0.node.'an ear': is not a "
     "name; use a letter, then letters, digits, - and _ only"),
    ("[bus.can0.node.ear]", "[bus.can0.node.host-2]", "16: bus.can0.node.host-2: is reserved "
     "for ports of applications; rename it"),
    ("bit = 20\n", "", "23: fault[0].bit: is missing; write bit = 20, or error = \"crc\""),
    ("bit = 20\n", 'bit = 20\nerror = "crc"\n', "27: fault[0].error: an error has a bit or an "
     "error, not both; take one out"),
    ('["left", "ear"]', '["left", "eir"]', '27: fault[0].nodes[1]: there is no controller "eir" '
     "(known: host, left, ear); did you mean ear?"),
    ('["left", "ear"]', '["left", "left"]', '27: fault[0].nodes[1]: "left" is there twice; take '
     "one out"),
    ("1e-6", "0", "36: fault[2].bit_error_rate: 0 is out of range; allowed: 1e-12 to 0.1"),
    ("identifier = 0x080\n", "identifier = 0x080\nidentifier_mask = 1\n", "43: fault[3]."
     "identifier_mask: a babble sends one identifier; take it out"),
    ('"dominant"', '"low"', '48: fault[4].level: unknown level "low" (known: dominant, recessive); '
     "take it out, or use one of these"),
    ('nodes = ["left"]\n', "", "51: fault[5].nodes: is missing; write nodes = "
     '["left"]: those that lose the bus'),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "told"), REFUSALS)
def test_mistake_is_one_line_with_line_value_limit_and_remedy(tmp_path, old, new, told):
    path = tmp_path / "rig.toml"
    assert old in RIG
    answer = check(path, RIG.replace(old, new, 1))
    assert (answer.status, answer.out) == (2, "")
    assert answer.err == f"{path}:{told}\n"


NUMBERS = st.one_of(
    st.integers(-2, 25),
    st.integers(-(2**70), 2**70),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0.0, -0.0, 1e-320, 0.1, 1.2, 1e9]),
).map(str)
TEXTS = st.sampled_from(
    [
        *('""', '"left"', '"host"', '"ear"', '"command"', '"fd"', '"fifo"', '"crc"', '"0x80"'),
        *("'0 0'", '"00 zz"', '"recessive"', '"noise"', '"babble"', '"short"', '"\\u0000"'),
        *("true", "nan", "-inf", "07:32:00", "1979-05-27"),
    ]
)
VALUES = st.recursive(
    NUMBERS | TEXTS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda items: f"[{', '.join(items)}]"),
        inner.map(lambda item: f"{{ silent = {item} }}"),
    ),
    max_leaves=3,
)
LINES = RIG.splitlines()
OWN = [
    number
    for number, line in enumerate(LINES)
    if " = " in line and not line.startswith(("bus =", "node_id", "plant", 'kind = "cia402"'))
]


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture]
)  # the folder is rewritten each time
@given(st.lists(st.tuples(st.sampled_from(OWN), VALUES), min_size=1, max_size=2))
def test_any_value_gives_a_rig_or_one_line_of_error(tmp_path, edits):
    lines = LINES.copy()
    for number, value in edits:
        lines[number] = f"{lines[number].split(' = ')[0]} = {value}"
    path = tmp_path / "rig.toml"
    answer = check(path, "\n".join(lines))
    event(f"exit status {answer.status}")
    assert answer.status in (0, 2)
    if answer.status == 2:
        assert answer.out == ""
        assert answer.err.startswith(f"{path}:")
        assert answer.err.count("\n") == 1
