import pytest

from emulators.event_queue import EventQueue
from harness.virtual_time import VirtualRuntime
from tests.motorapi.ideal import IdealBus, IdealHwMotor, IdealMotor


@pytest.fixture
def runtime():
    runtime = VirtualRuntime(EventQueue())
    yield runtime
    runtime.close()


@pytest.fixture
def hw(runtime):
    return IdealHwMotor(runtime)


@pytest.fixture
def motor(hw):
    return IdealMotor(hw)


@pytest.fixture
def pair(runtime):
    """Two motors that share a trigger."""
    bus = IdealBus()
    return [IdealMotor(IdealHwMotor(runtime, node, bus)) for node in (1, 2)]
