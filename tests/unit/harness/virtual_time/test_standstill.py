"""Messages about a run that makes no progress."""

import threading

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.harness.virtual_time.standstill import Standstill, line_in


@pytest.fixture
def told():
    return []


def looks(watch, count):
    for _ in range(count):
        watch.look()


def test_party_that_does_not_wait_is_named_once_with_its_line(told):
    runtime = VirtualRuntime(EventQueue())
    watch = Standstill(runtime, line_in(__file__), told.append)
    looks(watch, 10)
    assert told == []
    looks(watch, 30)
    (text,) = told
    assert text.startswith("virtual time has stood still at 0.000000 s for 10 s: 'main' has not")
    assert f"waited since, at {__file__}:" in text
    assert "(watch.look())" in text
    assert "time.sleep(0.001)" in text


def test_running_party_is_the_one_that_is_named(told):
    runtime = VirtualRuntime(EventQueue())
    watch = Standstill(runtime, lambda ident: f" in {ident == threading.get_ident()}", told.append)
    runtime.spawn("counter", lambda: looks(watch, 20)).join()
    (text,) = told
    assert "'counter' has not waited since in True" in text


def test_time_that_passes_is_not_told(told):
    runtime = VirtualRuntime(EventQueue())
    watch = Standstill(runtime, lambda ident: "", told.append)
    for _ in range(50):
        runtime.run_for(0.1)
        looks(watch, 9)
    assert told == []


def test_endless_program_is_told_of_until_once(told):
    runtime = VirtualRuntime(EventQueue())
    watch = Standstill(runtime, lambda ident: "", told.append)
    for _ in range(5):
        runtime.run_for(1000.0)
        watch.look()
    (text,) = told
    assert text.startswith(
        "virtual time has reached 4,000 s, and the program still runs; --until S"
    )
