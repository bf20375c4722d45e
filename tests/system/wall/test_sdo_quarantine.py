"""SDO quarantine after a process was killed during a transfer."""

import can
import pytest

from motorhil.motorapi.adaptations.canopen.bus import open_bus, release_bus
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.runtime.wall import close_process_runtime, runtime_of
from tests.support.line_programs import Program
from tests.support.programs.sdo_asker import channel_of
from tests.system.wall.test_hub import serving

pytestmark = pytest.mark.wall

MS = 1_000_000


class SlowServer:
    """A device that answers uploads with their number, the first one `late_ns` later."""

    def __init__(self, late_ns):
        self._late_ns = late_ns
        self.asked = 0
        self._due = []
        self._out = []

    def start(self, now_ns):
        pass

    def receive(self, data, now_ns):
        self.asked += 1
        answer = b"\x43" + data[9:12] + self.asked.to_bytes(4, "little")
        self._due.append((now_ns + self._late_ns, answer))
        self._late_ns = 0

    def sent(self, data, now_ns):
        return False

    def next_deadline_ns(self):
        return self._due[0][0] if self._due else None

    def expire(self, now_ns):
        while self._due and self._due[0][0] <= now_ns:
            data = self._due.pop(0)[1]
            self._out.append((0x581).to_bytes(4, "little") + b"\x08\0\0\0" + data)

    def take_output(self):
        out, self._out = self._out, []
        return out

    def stimulate(self, name, value, now_ns):
        raise ValueError(name)

    def snapshot(self, now_ns):
        return {}

    def identifiers(self):
        return (0x601,)

    def identifiers_revision(self):
        return 0

    def take_events(self):
        return ()

    def wants_sent(self):
        return False


def test_answer_to_a_killed_process_is_not_given_to_the_next(tmp_path, monkeypatch):
    locks = tmp_path / "locks"
    locks.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(locks))
    path = str(tmp_path / "hub")
    server = SlowServer(3000 * MS)  # long enough for a kill and another request
    with serving(path, server), can.Bus(interface="emulated", channel=path) as bus:
        runtime = runtime_of(bus)
        canopen = open_bus(bus, runtime)
        channel = channel_of(bus, quarantine_s=20.0)
        dies = Program("sdo_asker", path)
        try:
            assert dies.hear() == "ready"
            assert runtime.wait_until(lambda: server.asked == 1, 20.0)
            dies.kill()
            assert channel.upload(0x1018, 1) == (2).to_bytes(4, "little")
            assert channel.strays == 1  # it came, and was dropped; there was no longer wait
            assert channel.upload(0x1018, 1) == (3).to_bytes(4, "little")
        finally:
            dies.end()
            release_bus(canopen)
            close_process_runtime()
