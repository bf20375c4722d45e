"""Unmodified binaries as programs of a rig, in its virtual time."""

import shutil

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest
from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = [pytest.mark.wall, needs_compiler]

SILENT = """
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }
"""
DRIVE = """
[bus.can0]
bitrate_bit_s = 1_000_000

[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
"""
# CiA 301, SDO upload of 1000h: expedited answer of four bytes (43h), device type 20192h: device
# profile 402 (192h), servo drive (2).
QUESTION = "40 00 10 00 00 00 00 00"
REQUEST = "601#" + QUESTION.replace(" ", "")
ANSWER = "43 00 10 00 92 01 02 00"
needs_can_utils = pytest.mark.skipif(
    shutil.which("candump") is None or shutil.which("cansend") is None, reason="needs can-utils"
)


@pytest.fixture
def run(tmp_path):
    """Return a function that runs programs, by name, and returns (output, failures, digest)."""

    def run(base=SILENT, seed=None, **commands):
        text = base
        for name, command in commands.items():
            words = ", ".join(f"'{word}'" for word in command)
            text += f"\n[program.{name}]\ncommand = [{words}]\nstall_s = 5\n"
        (tmp_path / "rig.toml").write_text(text)
        lines = []
        with Rig.open(tmp_path / "rig.toml", record=tmp_path / "run.mcap") as rig:
            wrong = run_programs(rig, lines.append)
        return lines, wrong, digest(tmp_path / "run.mcap")

    return run


@pytest.mark.timeout(60)  # of the wall
def test_c_program_sleeps_an_hour_at_once(run, tmp_path):
    program = compiled("sleeper", tmp_path)
    lines, wrong, _ = run(a=[program])
    assert wrong == {}
    assert lines == [  # each look at a clock takes 1 us
        "a: 100000.000001000 0.000002 0",
        "a: 103600.000005000 3600.000006 3600",
    ]


def test_c_program_has_answer_of_drive_by_sdo_twice_the_same(run, tmp_path):
    program = compiled("sdo_client", tmp_path)
    runs = [run(DRIVE, a=[program]) for _ in range(2)]
    lines, wrong, _ = runs[0]
    assert wrong == {}
    assert lines == [f"a: 581: {ANSWER} within 5 ms", "a: -1, 2 s"]
    assert runs[1] == runs[0]


@needs_can_utils
def test_candump_shows_frames_of_cansend_and_drive_twice_the_same(run):
    commands = {
        "dump": ["candump", "-ta", "-T", "1000", "can0,581:7FF,601:7FF"],
        "send": ["sh", "-c", f"exec cansend can0 {REQUEST}"],
        "ask": ["sh", "-c", f"exec cangen -g 500 -n 3 -I 601 -L 8 -D {REQUEST[4:]} can0"],
    }
    runs = [run(DRIVE, **commands) for _ in range(2)]
    lines, wrong, _ = runs[0]
    assert wrong == {}
    frames = [line.split("can0")[1].split() for line in lines]
    request, answer = ["601", "[8]", *QUESTION.split()], ["581", "[8]", *ANSWER.split()]
    assert frames == [request, request, request, answer, request, answer]  # it boots for 0.3 s
    assert runs[1] == runs[0]
