import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor


@pytest.fixture
def runtime():
    runtime = VirtualRuntime(EventQueue())
    yield runtime
    runtime.close()


@pytest.fixture
def hw(runtime):
    return PlainHwMotor(runtime)


@pytest.fixture
def motor(hw):
    return PlainMotor(hw)


@pytest.fixture
def pair(runtime):
    """Return two motors that share a trigger."""
    bus = PlainBus()
    return [PlainMotor(PlainHwMotor(runtime, node, bus)) for node in (1, 2)]
