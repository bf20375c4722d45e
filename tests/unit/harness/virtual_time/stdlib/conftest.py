import time
from types import SimpleNamespace

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time


@pytest.fixture(autouse=True)
def refuse_wall_sleep(monkeypatch):
    wall = time.sleep

    def refuse(seconds):
        if not seconds > 0:
            wall(seconds)  # raises for invalid durations
        pytest.fail(f"a thread sleeps {seconds} s on the wall clock")

    monkeypatch.setattr("time.sleep", refuse)
    monkeypatch.setattr("motorhil.harness.virtual_time.stdlib.clocks._sleep", refuse)


@pytest.fixture
def rig():
    """An empty rig."""
    return SimpleNamespace(runtime=VirtualRuntime(EventQueue()), seed=7)


@pytest.fixture
def now_s(rig):
    """A function that returns the rig's own time [s] while a program is active.

    The time is rounded to 0.1 ms: a thread that has polled n times before it waits wakes n
    microseconds later.
    """
    with in_virtual_time(rig):
        yield lambda: round(rig.runtime.now_ns() / 1e9, 4)
    rig.runtime.close()
