import signal
import threading
import time
from functools import wraps

import pytest

from motorhil.harness.virtual_time.stdlib import signals


@pytest.fixture(autouse=True)
def _restored():
    before = signal.getsignal(signal.SIGUSR1)
    yield
    signal.signal(signal.SIGUSR1, before)


def send_at(rig, time_s):
    """Send SIGUSR1 in an event at this time."""

    def send():
        period.cancel()
        signal.raise_signal(signal.SIGUSR1)

    period = rig.runtime.every(time_s, send)


def test_handler_waits_in_its_turn_and_the_wait_goes_on(rig, now_s):
    seen = []

    def handle(number, frame):
        time.sleep(0.3)
        seen.append((number, now_s()))

    signal.signal(signal.SIGUSR1, handle)
    send_at(rig, 0.5)
    time.sleep(2.0)
    assert seen == [(signal.SIGUSR1, 0.8)]
    assert now_s() == 2.0


def test_handler_longer_than_the_wait_ends_it_late(rig, now_s):
    signal.signal(signal.SIGUSR1, lambda *_: time.sleep(3.0))
    send_at(rig, 0.5)
    time.sleep(1.0)
    assert now_s() == 3.5


def test_condition_of_interrupted_wait_still_counts(rig, now_s):
    done = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: done.set())
    send_at(rig, 0.5)
    assert done.wait(2.0)
    assert now_s() == 0.5


def test_exception_of_handler_ends_the_wait_in_its_turn(rig, now_s):
    def handle(*_):
        raise LookupError("of the handler")

    signal.signal(signal.SIGUSR1, handle)
    send_at(rig, 0.5)
    with pytest.raises(LookupError, match="of the handler"):
        time.sleep(2.0)
    assert now_s() == 0.5
    time.sleep(1.0)
    assert now_s() == 1.5


def test_handler_runs_in_no_turn_of_another_thread(rig, now_s):
    """The main thread waits for its turn while another thread has it."""
    log = []

    def handle(*_):
        log.append("handler")
        time.sleep(0.1)

    def work():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGUSR1)
        for _ in range(20):
            log.append("thread")
            sum(range(10_000))  # long enough for the main thread to wake
        log.append("thread ends")

    signal.signal(signal.SIGUSR1, handle)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    time.sleep(1.0)
    assert log == [*["thread"] * 20, "thread ends", "handler"]


def test_handler_without_a_wait_runs_at_once(now_s):
    seen = []
    signal.signal(signal.SIGUSR1, lambda *facts: seen.append(facts[0]))
    signal.raise_signal(signal.SIGUSR1)
    assert seen == [signal.SIGUSR1]


def test_handler_is_returned_as_it_was_set(now_s):
    def handle(*_):
        pass

    signal.signal(signal.SIGUSR1, handle)
    assert signal.getsignal(signal.SIGUSR1) is handle
    assert signal.signal(signal.SIGUSR1, signal.SIG_IGN) is handle
    assert signal.getsignal(signal.SIGUSR1) is signal.SIG_IGN


def test_decorated_handler_of_others_is_told_as_it_is():
    """Check functools.wraps, which leaves the decorated function as an attribute."""

    @wraps(print)
    def handle(*_):
        pass

    before = signal.signal(signal.SIGUSR1, handle)
    try:
        assert signals.handler_of(signal.SIGUSR1) is handle
        assert signals.set_handler(signal.SIGUSR1, handle) is handle
    finally:
        signal.signal(signal.SIGUSR1, before)
