"""Fixtures: an emulated drive stepped by hand, rigs in virtual time."""

import os
from pathlib import Path

import pytest
from motorhil.emulators.controller import ControllerContext
from motorhil.harness.rig.rig import Rig

from motorhil_odrive.emulated.build import build

RIG = Path(__file__).parents[1] / "src" / "motorhil_odrive" / "rig.toml"
MS = 1_000_000
REMOTE = 0x4000_0000


@pytest.fixture(scope="session", autouse=True)
def own_locks(tmp_path_factory):
    os.environ["MOTORHIL_LOCK_DIR"] = str(tmp_path_factory.mktemp("locks"))


class Bench:
    """One emulated drive alone: frames in and out, time by hand."""

    def __init__(self, **table):
        table = {"node_id": 5, "plant": {"preset": "wheel_60w"}, **table}
        context = ControllerContext(name="drive", folder=Path(), seed=1)
        self.drive = build(table, context)
        self.now = 0
        self.heard = []  # (time [ms], command, data)
        self.drive.start(0)

    def run(self, ms):
        end = self.now + round(ms * MS)
        while (due := self.drive.next_deadline_ns()) is not None and due <= end:
            self.now = max(self.now, due)
            self.drive.expire(self.now)
            self._collect()
        self.now = end
        return self

    def tell(self, command, data=b"", *, node=5, flags=0, length=None):
        frame = (node << 5 | command | flags).to_bytes(4, "little")
        frame += bytes((len(data) if length is None else length, 0, 0, 0)) + data.ljust(8, b"\0")
        self.drive.receive(frame, self.now)
        self._collect()
        return self

    def ask(self, command):
        self.heard.clear()
        self.tell(command, flags=REMOTE, length=8)
        (answer,) = [data for _, what, data in self.heard if what == command]
        return answer

    def _collect(self):
        for frame in self.drive.take_output():
            can_id = int.from_bytes(frame[:4], "little")
            self.heard.append((self.now / MS, can_id & 0x1F, frame[8 : 8 + frame[4]]))

    def heartbeat(self):
        """Return (error, state, result, done)."""
        data = self.ask(1)
        return int.from_bytes(data[:4], "little"), data[4], data[5], data[6]

    def truth(self, name):
        return self.drive.snapshot(self.now)[name]


@pytest.fixture
def rig():
    with Rig.open(RIG) as rig:
        yield rig
