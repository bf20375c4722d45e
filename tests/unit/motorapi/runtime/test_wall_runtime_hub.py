"""The wall runtime on an emulated bus over a socket: own frames after transmission."""

import struct

import can
import pytest

from motorhil.motorapi import LinkError, WallRuntime
from motorhil.motorapi.runtime.can_sources import source_of
from tests.system.wall.hub.test_hub import serving
from tests.unit.emulators.simulation.test_world import Echo

pytestmark = pytest.mark.wall

ASK = struct.pack("<IB3x8s", 0x100, 1, b"\x07")
ANSWER = struct.pack("<IB3x8s", 0x200, 1, b"\x07")
LATE_S = 10.0


@pytest.fixture
def runtime():
    runtime = WallRuntime()
    yield runtime
    runtime.close()


def test_own_frames_are_reported_after_transmission(tmp_path, runtime):
    path = str(tmp_path / "hub.sock")
    with serving(path, Echo(0x200)), can.Bus(interface="emulated", channel=path) as bus:
        heard = []
        listening = runtime.listen(bus, lambda frame, t, own: heard.append((frame, own)))
        assert source_of(bus).reports_own  # so the hub reports it, not the return of `send`
        runtime.send(bus, ASK)
        assert runtime.wait_until(lambda: len(heard) == 2, LATE_S)
        assert heard == [(ASK, True), (ANSWER, False)]
        listening.cancel()
        runtime.close()  # before the bus: a closed bus must not be read


def test_lost_hub_is_reported(tmp_path, runtime):
    path = str(tmp_path / "hub.sock")
    with serving(path):
        bus = can.Bus(interface="emulated", channel=path)
        runtime.listen(bus, lambda *_: None)
    try:
        with pytest.raises(LinkError, match="hub has closed"):
            runtime.wait_until(lambda: False, LATE_S)
        with pytest.raises(LinkError, match="cannot send"):
            runtime.send(bus, ASK)
    finally:
        bus.shutdown()
