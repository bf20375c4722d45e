"""Lines on the wall whose other end takes nothing: who sends is told, and nobody waits for ever."""

import os
import pty
import socket
import time

import pytest

from motorapi.byte_lines import SerialLine, TcpLine
from motorapi.errors import LinkError
from motorapi.wall_runtime import WallRuntime

pytestmark = pytest.mark.wall

MUCH = bytes(60_000)  # bytes; sent again and again, it fills whatever buffers there are
TIMES = 400


def fill(line):
    for _ in range(TIMES):
        line.send(MUCH)


def test_a_connection_whose_other_end_reads_nothing_is_a_broken_link():
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = TcpLine("127.0.0.1", server.getsockname()[1], runtime=WallRuntime())
        began_s = time.monotonic()
        with pytest.raises(LinkError, match="cannot send"):
            fill(line)
        assert time.monotonic() - began_s < 5.0
        line.close()


def test_a_serial_line_that_takes_nothing_is_a_broken_link():
    master, slave = pty.openpty()
    try:
        line = SerialLine(os.ttyname(slave), runtime=WallRuntime())
        began_s = time.monotonic()
        with pytest.raises(LinkError, match="cannot send"):
            fill(line)
        assert time.monotonic() - began_s < 5.0
        line.close()
    finally:
        os.close(slave)
        os.close(master)
