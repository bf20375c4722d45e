"""Progress lines of long work: on a terminal only, by what the system knows of open files."""

import io
import os
import sys

import pytest

from motorhil.harness.cli.progress import FilesRead, StatusLine, following


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(bytes(10_000_000))
    return path


def test_line_has_part_size_rate_and_remaining_time(recording):
    files = FilesRead([str(recording)])
    assert files.look(10.0) is None  # it is not open
    with open(recording, "rb", buffering=0) as file:
        assert files.look(10.5) == "a.mcap: 0 %, 0.0 of 10.0 MB"
        file.read(2_500_000)
        assert files.look(11.5) == "a.mcap: 25 %, 2.5 of 10.0 MB, 2.5 MB/s, 3 s left"
        file.read(500_000)
        assert files.look(12.5) == "a.mcap: 30 %, 3.0 of 10.0 MB, 1.5 MB/s, 5 s left"


def test_line_of_a_read_file_tells_how_long_the_work_takes(recording):
    files = FilesRead([str(recording)])
    with open(recording, "rb", buffering=0) as file:
        file.read()
        files.look(1.0)
        assert files.look(2.9) == "a.mcap: 100 %, 10.0 of 10.0 MB"
        assert files.look(5.0) == "a.mcap: 100 %, working for 4 s"


def test_second_reading_of_a_file_is_told_as_such(recording):
    files = FilesRead([str(recording)])
    for number in (1, 2):
        with open(recording, "rb", buffering=0) as file:
            file.read(1_000_000)
            found = files.look(10.0 * number)
            file.read()
            files.look(10.0 * number + 1)
    assert found == "a.mcap: 10 % of pass 2, 1.0 of 10.0 MB"


def test_jump_to_the_end_and_back_is_no_pass(recording):
    """A reader of MCAP files looks at the end first."""
    files = FilesRead([str(recording)])
    with open(recording, "rb", buffering=0) as file:
        file.read(1_000)
        files.look(1.0)
        file.seek(0)
        file.read(500)
        assert files.look(2.0) == "a.mcap: 0 %, 0.0 of 10.0 MB"


def test_file_being_written_counts_by_the_size_to_come(tmp_path):
    target = tmp_path / "whole.mcap"
    files = FilesRead([str(target)], 4_000_000)
    with open(f"{target}.part", "wb", buffering=0) as file:
        file.write(bytes(1_000_000))
        assert files.look(1.0) == "whole.mcap: 25 %, 1.0 of 4.0 MB"


def test_following_prints_nothing_without_a_terminal(recording):
    stream = io.StringIO()
    before = sys.stderr
    with following("judge", [str(recording)], line=StatusLine(stream)):
        assert sys.stderr is before
    assert stream.getvalue() == ""


def test_other_output_replaces_the_line(capsys):
    stream = Terminal()
    line = StatusLine(stream)
    with following("judge", [os.devnull], line=line):
        line.show("motorhil judge: a.mcap: 25 %")
        print("a result")
    assert stream.getvalue() == "\rmotorhil judge: a.mcap: 25 %\x1b[K\r\r\x1b[K"
    assert capsys.readouterr().out == "a result\n"
    line.clear()
    assert stream.getvalue().count("\x1b[K") == 2  # there is nothing left to remove
