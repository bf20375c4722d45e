import gc
import os
import signal
import threading
import weakref
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.errors import UsageError

MS = 1_000_000


@pytest.fixture
def runtime():
    runtime = VirtualRuntime(EventQueue())
    yield runtime
    runtime.close()


def test_wait_takes_exactly_its_timeout_without_wall_time(runtime):
    assert runtime.wait_until(lambda: False, timeout_s=3600.0) is False
    assert runtime.now_ns() == 3600 * 10**9


def test_virtual_time_ends_before_never_of_controllers(runtime):
    """Check the end of virtual time, because a drive treats NEVER as the end of no wait.

    A replay 1e30 times slower once reached NEVER, and the drive enabled itself out of SWITCH ON
    DISABLED.
    """
    for _ in range(2):
        runtime.run_for(1e9)
    assert runtime.now_ns() < NEVER
    with pytest.raises(UsageError, match="virtual time ends at 2000000000"):
        runtime.run_for(1e-9)


def test_wait_ends_at_the_event_that_fulfils_it(runtime):
    happened = []
    runtime.queue.alarm(lambda now: happened.append(now)).set(7 * MS)
    assert runtime.wait_until(lambda: bool(happened), timeout_s=1.0) is True
    assert runtime.now_ns() == 7 * MS


@pytest.mark.parametrize(("event_ns", "result"), [(MS - 1, True), (MS, True), (MS + 1, False)])
def test_event_at_the_very_end_of_a_timeout_still_counts(runtime, event_ns, result):
    happened = []
    runtime.queue.alarm(lambda now: happened.append(now)).set(event_ns)
    assert runtime.wait_until(lambda: bool(happened), timeout_s=0.001) is result
    assert runtime.now_ns() == min(event_ns, MS)


def test_periodic_action_runs_at_start_plus_k_periods(runtime):
    times = []
    runtime.run_for(0.0005)
    registration = runtime.every(0.001, lambda: times.append(runtime.now_ns()))
    runtime.run_for(0.003)
    registration.cancel()
    runtime.run_for(0.003)
    assert times == [1_500_000, 2_500_000, 3_500_000]


def test_wait_inside_a_callback_is_refused_with_remedy(runtime):
    def callback():
        runtime.wait_until(lambda: True)

    runtime.every(0.001, callback)
    with pytest.raises(UsageError, match=r"inside a callback.*spawn"):
        runtime.run_for(0.01)


def test_wait_inside_a_condition_is_refused(runtime):
    with pytest.raises(UsageError, match="inside a callback"):
        runtime.wait_until(lambda: len([0]) == 2 or runtime.wait_until(lambda: True), 0.1)


def test_a_foreign_thread_is_refused_and_told_of_spawn(runtime):
    refusals = []

    def foreign():
        try:
            runtime.wait_until(lambda: True)
        except UsageError as error:
            refusals.append(str(error))

    thread = threading.Thread(target=foreign, name="stray")
    thread.start()
    thread.join()
    assert "stray" in refusals[0]
    assert "spawn" in refusals[0]


def test_wait_that_cannot_end_is_an_error(runtime):
    with pytest.raises(UsageError, match="nothing can end the wait"):
        runtime.wait_until(lambda: False)


def test_endless_polling_without_waiting_is_an_error(runtime):
    def poll():
        while not runtime.wait_until(lambda: False, timeout_s=0.0):
            pass

    with pytest.raises(UsageError, match="time passes only while waiting"):
        poll()


def test_failed_event_reaches_the_waiting_party(runtime):
    def fail(now_ns):
        raise ValueError("planted")

    runtime.queue.alarm(fail).set(MS)
    with pytest.raises(ValueError, match="planted"):
        runtime.run_for(1.0)
    runtime.run_for(1.0)
    assert runtime.now_ns() == 1_001 * MS


def test_failed_condition_reaches_only_its_own_party(runtime):
    ended = []

    def bystander():
        runtime.run_for(0.002)
        ended.append(runtime.now_ns())

    def broken():
        return runtime.now_ns() >= MS and 1 // 0 == 0

    party = runtime.spawn("bystander", bystander)
    runtime.queue.alarm(lambda now: None).set(MS)
    with pytest.raises(ZeroDivisionError):
        runtime.wait_until(broken, 1.0)
    assert party.join()
    assert ended == [2 * MS]


def run_parties(plans):
    """Run parties that wait their delays; return the log of (time [ns], name)."""
    runtime = VirtualRuntime(EventQueue())
    log = []

    def party(name, delays):
        for delay in delays:
            runtime.run_for(delay / 1e6)
            log.append((runtime.now_ns(), name))

    parties = [
        runtime.spawn(str(number), lambda number=number, delays=delays: party(str(number), delays))
        for number, delays in enumerate(plans)
    ]
    for one in parties:
        assert one.join()
    runtime.close()
    return log


@given(st.lists(st.lists(st.integers(0, 5), max_size=6), min_size=1, max_size=5))
def test_parties_take_turns_by_time_and_each_keeps_its_own_times(plans):
    log = run_parties(plans)
    assert log == run_parties(plans)
    assert [time for time, _ in log] == sorted(time for time, _ in log)
    for number, delays in enumerate(plans):
        own = [time for time, name in log if name == str(number)]
        assert own == [sum(delays[: i + 1]) * 1000 for i in range(len(delays))]


def test_parties_due_at_one_time_go_in_the_order_of_asking():
    assert run_parties([[3], [2, 1], [1, 2]]) == [
        (1000, "2"),
        (2000, "1"),
        (3000, "0"),  # waits since 0
        (3000, "2"),  # waits since 1000
        (3000, "1"),  # waits since 2000
    ]


def test_error_of_a_party_is_available_after_join(runtime):
    def fails():
        runtime.run_for(0.001)
        raise KeyError("planted")

    party = runtime.spawn("fails", fails)
    assert party.join(1.0)
    assert isinstance(party.error, KeyError)


def test_ended_parties_leave_nothing_in_memory(runtime):
    thread = runtime.spawn("first", lambda: None).thread
    runtime.run_for(0.001)
    thread.join()
    first = weakref.ref(thread)
    del thread
    runtime.spawn("second", lambda: None)
    gc.collect()
    assert first() is None


def test_weak_references_to_ended_threads_call_back(runtime):
    """Check what threading's own set of threads relies on.

    The compiled class of these threads kept its fields where Thread keeps weak references: freed
    ones stayed in that set, and Python crashed at a later garbage collection.
    """
    called_back = []
    party = runtime.spawn("ends", lambda: None)
    reference = weakref.ref(party.thread, called_back.append)
    assert party.join(1.0)
    party.thread.join()
    party.thread = None
    runtime.spawn("forgets the ended one", lambda: None).join()
    gc.collect()
    assert called_back == [reference]
    assert reference() is None


def test_error_of_an_unjoined_party_is_raised_by_close():
    runtime = VirtualRuntime(EventQueue())

    def fails():
        raise KeyError("planted")

    runtime.spawn("fails", fails)
    runtime.run_for(0.001)
    with pytest.raises(KeyError, match="planted"):
        runtime.close()


def test_close_ends_waiting_parties_and_leaves_no_thread():
    before = threading.active_count()
    runtime = VirtualRuntime(EventQueue())
    ended = []

    def waits():
        try:
            runtime.wait_until(lambda: False, 100.0)
        finally:
            ended.append("cleaned up")

    runtime.spawn("waits", waits)
    runtime.spawn("never started", lambda: ended.append("ran"))
    runtime.queue.alarm(lambda now: None).set(MS)
    assert runtime.wait_until(lambda: runtime.now_ns() == MS, 1.0)
    runtime.close()
    assert ended == ["ran", "cleaned up"] or ended == ["cleaned up"]
    assert threading.active_count() == before


def test_pace_is_called_before_time_moves():
    paced = []
    runtime = VirtualRuntime(EventQueue(), pace=paced.append)
    runtime.queue.alarm(lambda now: None).set(2 * MS)
    runtime.run_for(0.003)
    assert paced == [2 * MS, 3 * MS]


# --- keyboard interrupts


def test_interrupt_is_taken_between_events_and_rig_continues(runtime):
    times = []

    def act():
        times.append(runtime.interrupt())
        times.append(runtime.interrupt())  # the second one takes effect at once
        times.append(runtime.now_ns())

    registration = runtime.every(0.001, act)
    with pytest.raises(KeyboardInterrupt):
        runtime.run_for(1.0)
    assert times == [True, False, MS]
    registration.cancel()
    runtime.run_for(1.0)
    assert runtime.now_ns() == 1001 * MS
    assert runtime.interrupt() is False


def test_interrupt_during_another_partys_turn_reaches_first(runtime):
    ended = []

    def second():
        runtime.every(0.001, lambda: None)
        while not ended:
            runtime.run_for(0.0005)
            if runtime.now_ns() == 5 * MS:
                runtime.queue.alarm(lambda now: ended.append(runtime.interrupt())).set(6 * MS)

    runtime.spawn("second", second)
    with pytest.raises(KeyboardInterrupt):
        runtime.run_for(1.0)
    assert (ended, runtime.now_ns()) == ([True], 6 * MS)
    runtime.run_for(0.001)


def test_interrupt_during_spawn_leaves_no_waiting_party(runtime, monkeypatch):
    def interrupted(thread):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runtime.spawn("late", lambda: None)
    runtime.run_for(0.001)


@pytest.mark.wall
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("taken_elsewhere", [False, True])
def test_interrupt_ends_the_wait_for_a_party_that_never_waits(
    runtime, monkeypatch, taken_elsewhere
):
    """Check it also if no thread wakes: the signal came just before the wait, or elsewhere."""
    monkeypatch.setattr("motorhil.harness.virtual_time.runtime.GRACE_S", 0.05)
    told = threading.Event()
    in_time = []

    def busy():
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        os.kill(os.getpid(), signal.SIGINT)
        in_time.append(told.wait(20))

    if taken_elsewhere:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        party = runtime.spawn("busy", busy)
        with pytest.raises(KeyboardInterrupt):
            runtime.run_for(1.0)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        told.set()
    party.thread.join()
    runtime.close()
    assert in_time == [True]


@pytest.mark.wall
def test_party_that_ignores_its_end_is_reported_by_close(monkeypatch):
    monkeypatch.setattr("motorhil.harness.virtual_time.runtime.GRACE_S", 0.05)
    runtime = VirtualRuntime(EventQueue())
    over = threading.Event()

    def stubborn():
        while not over.is_set():
            with suppress(BaseException):
                runtime.run_for(0.001)

    party = runtime.spawn("stubborn", stubborn)
    runtime.run_for(0.01)
    with pytest.raises(UsageError, match=r"party 'stubborn' does not end.*BaseException"):
        runtime.close()
    over.set()
    party.thread.join()


@pytest.mark.parametrize("period_s", [float("nan"), float("inf"), 0.0, -1.0, 1e-12, 1e300])
def test_invalid_period_is_refused(runtime, period_s):
    with pytest.raises(UsageError, match=r"period_s = .*: must be 1e-9 to 1e9 s"):
        runtime.every(period_s, lambda: None)


# --- endless chains at one instant ------------------------------------------------------------


class Chain:
    """A callback that schedules itself again at the same instant, a number of times."""

    def __init__(self, runtime, count):
        self.count = count
        self.alarm = runtime.queue.alarm(self.again)
        self.alarm.set(3 * MS)

    def again(self, now_ns):
        self.count -= 1
        if self.count:
            self.alarm.set(now_ns)


@pytest.mark.parametrize("timeout_s", [None, 0.003, 1.0])
def test_endless_chain_of_timers_is_named(runtime, timeout_s):
    Chain(runtime, -1)
    with pytest.raises(UsageError) as caught:
        runtime.wait_until(lambda: False, timeout_s)
    text = str(caught.value)
    assert text.startswith(f"callback {__name__}.Chain.again: 262144 turns at t = 0.003 s")
    assert text.endswith("let a delay pass before the next call")
    assert runtime.now_ns() == 3 * MS


def test_long_chain_that_ends_is_no_error(runtime):
    chains = [Chain(runtime, 100_000), Chain(runtime, 100_000)]
    runtime.run_for(0.010)
    assert [chain.count for chain in chains] == [0, 0]
    assert runtime.now_ns() == 10 * MS


def test_many_turns_with_time_between_are_no_error(runtime):
    calls = []
    runtime.every(1e-9, lambda: calls.append(0))
    runtime.run_for(0.0003)
    assert len(calls) == 300_000


def test_endless_chain_of_parties_is_an_error(runtime):
    """Two parties that pass a turn back and forth let no time pass either."""
    turn = [0]

    def play(me):
        while True:
            runtime.wait_until(lambda: turn[0] == me)
            turn[0] = 1 - me

    for me in (0, 1):
        runtime.spawn(f"player {me}", lambda me=me: play(me))
    with pytest.raises(UsageError, match=r"^parties .*: 262144 turns at t = 0.0 s"):
        runtime.run_for(1.0)
