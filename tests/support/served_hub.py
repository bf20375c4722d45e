"""A hub served by another process, and the frames on it, for tests on the wall clock."""

import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import can
import pytest

from motorhil.motorapi.runtime.wall import WallRuntime
from tests.support.line_programs import LONG_S

SERVE = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)


def await_boot(path):
    """Wait until node 1 answers: requests before its boot-up (300 ms) are lost."""
    ask = can.Message(
        arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False
    )
    with can.Bus(interface="emulated", channel=str(path)) as bus:
        for _ in range(round(LONG_S / 0.1)):
            bus.send(ask)
            answer = bus.recv(timeout=0.1)
            while answer is not None:
                if answer.arbitration_id == 0x581:
                    return
                answer = bus.recv(timeout=0.1)
    pytest.fail("node 1 never answered")


@contextmanager
def served(rig, path, *options):
    """Serve the rig on a hub at `path`, in another process, until the end of the context."""
    command = [*SERVE, "serve", str(rig), "--socket", str(path), *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout.readline().startswith(b"can0: ")
        await_boot(path)
        try:
            yield path
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(LONG_S)


def wait_for(done):
    """Wait on the wall clock until `done`."""
    runtime = WallRuntime()
    try:
        assert runtime.wait_until(done, LONG_S)
    finally:
        runtime.close()


class Listener:
    """The selected frames on a bus, in order, as another program receives them."""

    def __init__(self, bus, is_wanted):
        self.frames = []
        self._is_wanted = is_wanted
        self._bus = bus
        self._ends = False
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self):
        while not self._ends:
            message = self._bus.recv(timeout=0.05)
            if message is not None and self._is_wanted(message.arbitration_id, message.data):
                self.frames.append((message.arbitration_id, bytes(message.data)))

    def close(self):
        self._ends = True
        self._thread.join()
        self._bus.shutdown()
