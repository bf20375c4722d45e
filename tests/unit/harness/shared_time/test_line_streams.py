"""Serial ports of a rig that binaries open by other functions than open()."""

import pytest

from tests.support.modbus.rigs import text
from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = [pytest.mark.wall, needs_compiler]

ANSWER = "a: 01 03 02 00 30 B8 50 "  # register 1003h of a drive at rest: see test_line_programs.py
RIG = text(line="rtu", names=("mast", "head"))


@pytest.mark.parametrize(
    ("way", "told"),
    [
        ("fopen", ["a: line buffered: 1", ANSWER, "a: closed: 1"]),
        ("fdopen", ["a: line buffered: 1", ANSWER, "a: closed: 1"]),
        ("openat", [ANSWER]),
        ("dprintf", [ANSWER]),
        (
            "rate",
            [
                "a: motorhil: program 'a': /dev/line: opened with 250000 bit/s, 8N1; line line has"
                " 115200 bit/s, 8N1, which is used",
                "a: 250000 bit/s, low latency 1",
                ANSWER,
            ],
        ),
    ],
)
def test_serial_port_opened_in_other_ways_answers(twice, tmp_path, way, told):
    lines = twice(RIG, a=[compiled("line_streams", tmp_path), way, "/dev/line"])
    assert lines == told


def test_stream_of_cpp_on_serial_port_answers(twice, tmp_path):
    lines = twice(RIG, a=[compiled("line_fstream", tmp_path), "/dev/line"])
    assert lines == [ANSWER]


@pytest.mark.parametrize("way", ["fopen", "openat"])
def test_hardware_opened_in_other_ways_is_refused_by_name(run, tmp_path, way):
    lines, wrong, _ = run(RIG, a=[compiled("line_streams", tmp_path), way, "/dev/ttyUSB7"])
    assert wrong == {"a": "exit status 4"}
    assert "hardware cannot be reached, and no line of the rig is there" in lines[0]
    assert lines[1] == f"a: {way}: No such device or address"
