"""Progress of a long conversion on a pseudo-terminal, and its end by Ctrl-C."""

import os
import pty
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.wall
ROWS = 1_200_000


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "long.log"
    rows = (f"({n // 1000}.{n % 1000:03}000) can0 {n % 1024:03X}#{n:016X}\n" for n in range(ROWS))
    path.write_text("".join(rows))
    return path


def test_interrupted_conversion_leaves_one_line_and_no_file(log):
    target = log.with_suffix(".mcap")
    master, slave = pty.openpty()
    words = [sys.executable, "-m", "motorhil", "convert", str(log), "-o", str(target)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=slave) as process:
        os.close(slave)
        shown = b""
        while b" s left" not in shown:
            shown += os.read(master, 1024)
        process.send_signal(signal.SIGINT)
        try:
            while more := os.read(master, 1024):
                shown += more
        except OSError:  # the process has closed the terminal
            pass
        out = process.stdout.read()
        assert process.wait() == 130
    os.close(master)
    assert out == b""
    assert b"motorhil convert: long.log: " in shown
    last = shown.rpartition(b"\x1b[K")[2]  # after the progress line was removed
    assert last == b"motorhil: interrupted\r\n"
    assert os.listdir(log.parent) == [log.name]
