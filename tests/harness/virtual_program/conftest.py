import time
from types import SimpleNamespace

import pytest

from emulators.event_queue import EventQueue
from harness.virtual_program import in_virtual_time
from harness.virtual_time import VirtualRuntime


@pytest.fixture(autouse=True)
def nobody_sleeps_on_the_wall(monkeypatch):
    wall = time.sleep

    def refuse(seconds):
        if not seconds > 0:
            wall(seconds)  # refuses what is no time
        pytest.fail(f"somebody sleeps {seconds} s on the wall")

    monkeypatch.setattr("time.sleep", refuse)
    monkeypatch.setattr("harness.virtual_program.clocks._sleep", refuse)


@pytest.fixture
def rig():
    """A rig in which nothing is."""
    return SimpleNamespace(runtime=VirtualRuntime(EventQueue()), seed=7)


@pytest.fixture
def now_s(rig):
    """A program is on; what the rig's own clock says, at which nobody looks.

    To 0.1 ms: who has looked n times before it waits wakes n microseconds later.
    """
    with in_virtual_time(rig):
        yield lambda: round(rig.runtime.now_ns() / 1e9, 4)
    rig.runtime.close()
