"""Worlds for takeovers of motors from living owners, by lease or on demand.

- "parties": logical motors of one process, in virtual time, without a lock.
- "threads": logical motors of one process, on the wall clock, with a lock between processes.
- "strangers": each has its own hardware object and lock, as in separate processes.
"""

from types import SimpleNamespace

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    WallRuntime,
)
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor


@pytest.fixture(params=["parties", "threads", "strangers"])
def world(request, tmp_path):
    """Return a world with logical motors a to d of one physical motor."""
    virtual = request.param == "parties"
    runtime = VirtualRuntime(EventQueue()) if virtual else WallRuntime()
    directory = LockDirectory(tmp_path)

    def hardware(bus, node):
        lock = None if virtual else ProcessLock(f"m{node}", f"motor {node}", directory)
        return PlainHwMotor(runtime, node, bus, lock=lock)

    def motors(names, node=1):
        if request.param == "strangers":
            return [PlainMotor(hardware(PlainBus(f"of {n}"), node), name=n) for n in names]
        shared = hardware(PlainBus("bus"), node)
        return [PlainMotor(shared, name=name) for name in names]

    def pass_s(time_s):
        runtime.wait_until(lambda: False, time_s)

    yield SimpleNamespace(
        runtime=runtime,
        motors=motors,
        pass_s=pass_s,
        kind=request.param,
        virtual=virtual,
        lease_s=0.1 if virtual else 0.4,  # far longer than any delay on a busy machine
    )
    runtime.close()


@pytest.fixture
def logical(world):
    return world.motors("abcd")
