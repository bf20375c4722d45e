"""Fencing on SocketCAN, where no hub checks tokens.

Every frame given to the kernel is on the bus.
"""

import contextlib
import threading
from collections import Counter
from pathlib import Path

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.cia402.drive import build
from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.gateways.socketcan import SocketCanGateway
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.motorapi import WallRuntime
from motorhil.motorapi.locking.directory import VARIABLE
from tests.system.wall.sharing.test_fencing import SET_POINTS, Stage, lose


@contextlib.contextmanager
def serving_on(interface):
    """Return one drive on the interface."""
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 1_000_000))
    drive = build({"node_id": 1}, ControllerContext(name="drive", folder=Path(), seed=1))
    world.add_controller("drive", drive, "can0")
    loop = WallLoop(queue)
    loop.add(SocketCanGateway(interface, world, "can0"))
    stop = threading.Event()
    loop.start()
    thread = threading.Thread(target=loop.run, args=(stop.is_set,))
    thread.start()
    try:
        yield world
    finally:
        stop.set()
        thread.join()
        loop.close()


@pytest.fixture
def stage(tmp_path, monkeypatch):
    locks = tmp_path / "locks"
    locks.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(locks))
    runtime = WallRuntime()
    with serving_on("vcan0") as world:
        stage = Stage("vcan0", runtime, world)
        try:
            yield stage
        finally:
            stage.close()
            runtime.close()


@pytest.mark.parametrize("how", ["fenced", "unfenced"])
def test_resumed_stream_sends_no_frame_on_the_bus(stage, how):
    since = lose(stage, how, take_over=True)
    if how == "fenced":
        assert stage.owner.ask("wait").startswith("interrupted ")
        assert stage.others(since) == Counter()
        assert stage.owner.ask("write").startswith("busy ")
        assert stage.others(since) == Counter()
    else:  # without a wait for the motor, which could end the stream before its first frame
        stage.wait_for(lambda: any(SET_POINTS in frame for frame in stage.heard(since)))
