import _thread
import gc
import queue
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest

from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.harness.virtual_time.stdlib.threads import join_executors, program_here
from motorhil.motorapi.errors import UsageError

THE_WALLS = (_thread.start_new_thread, _thread.allocate_lock)  # bound here, so not replaced


def test_thread_that_has_ended_leaves_no_object(now_s):
    def start():
        thread = threading.Thread(target=time.sleep, args=(0.1,))
        thread.start()
        thread.join()
        return weakref.ref(thread)

    first, _ = start(), start()  # a start forgets threads that have ended
    gc.collect()
    assert first() is None


def test_sleep_lets_rig_time_pass_and_others_run(now_s):
    said, begun = [], []

    def worker(name, period_s):
        begun.append(name)
        for _ in range(2):
            time.sleep(period_s)
            said.append((name, now_s()))

    threads = [threading.Thread(target=worker, args=(f"every {p}", p)) for p in (3.0, 2.0)]
    for thread in threads:
        thread.start()
    assert not begun  # a thread that starts another one keeps its turn
    for thread in threads:
        thread.join()
    assert begun == ["every 3.0", "every 2.0"]
    assert said == [("every 2.0", 2.0), ("every 3.0", 3.0), ("every 2.0", 4.0), ("every 3.0", 6.0)]
    assert not any(thread.is_alive() for thread in threads)


def test_lock_waiters_are_served_in_order_in_virtual_time(now_s):
    lock, got = threading.Lock(), []

    def taker(name):
        with lock:
            got.append((name, now_s()))
            time.sleep(1.0)

    threads = [threading.Thread(target=taker, args=(name,)) for name in "abc"]
    with lock:
        for thread in threads:
            thread.start()
        time.sleep(1.0)
    for thread in threads:
        thread.join()
    assert got == [("a", 1.0), ("b", 2.0), ("c", 3.0)]


def test_lock_acquire_times_out_in_virtual_time(now_s):
    lock = threading.Lock()
    lock.acquire()
    threading.Timer(2.0, lock.release).start()
    assert not lock.acquire(timeout=1.5)
    assert now_s() == 1.5
    assert lock.acquire(timeout=1.5)
    assert now_s() == 2.0
    with pytest.raises(ValueError, match="non-blocking"):
        lock.acquire(False, 1.0)
    with pytest.raises(ValueError, match=r"positive|non-negative"):
        lock.acquire(True, -3.0)


def test_rlock_belongs_to_one_thread(now_s):
    lock = threading.RLock()
    seen = []

    def other():
        seen.append((lock.acquire(False), lock.acquire(timeout=5.0), now_s()))
        lock.release()

    thread = threading.Thread(target=other)
    with lock, lock:
        thread.start()
        time.sleep(1.0)
    thread.join()
    assert seen == [(False, True, 1.0)]
    with pytest.raises(RuntimeError, match="un-acquired"):
        lock.release()


def test_queues_events_and_barriers_wait_in_virtual_time(now_s):
    orders, done, gate = queue.Queue(maxsize=1), threading.Event(), threading.Barrier(2)
    worked = []

    def worker():
        gate.wait()
        while (order := orders.get(timeout=10.0)) is not None:
            time.sleep(0.5)
            worked.append((order, now_s()))
        done.set()

    threading.Thread(target=worker).start()
    time.sleep(1.0)
    gate.wait()
    for order in (1, 2, None):
        orders.put(order)  # waits for room
    assert not done.wait(0.25)
    assert done.wait(10.0)
    assert worked == [(1, 1.5), (2, 2.0)]
    with pytest.raises(queue.Empty):
        orders.get(timeout=1.0)
    assert now_s() == pytest.approx(3.0, abs=1e-4)  # each look at a clock takes a microsecond
    mail = queue.SimpleQueue()
    threading.Timer(1.0, mail.put, ["post"]).start()
    assert mail.get() == "post"


def test_thread_pool_runs_concurrently_and_can_be_joined(now_s):
    before = threading.active_count()  # other tests of this process may have running threads

    def work(number):
        time.sleep(1.0)
        return number * 2, now_s()

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, range(3))) == [(0, 1.0), (2, 1.0), (4, 2.0)]
    left = ThreadPoolExecutor(1)
    future = left.submit(work, 5)
    join_executors()  # without an own shutdown
    assert future.result() == (10, 3.0)
    assert threading.active_count() == before
    ThreadPoolExecutor(1).submit(int).result()  # new pools are possible


def test_thread_exception_is_reported_before_next_turn(now_s, monkeypatch):
    told = []
    monkeypatch.setattr(
        "threading.excepthook", lambda what: told.append((what.exc_type, what.thread.name, now_s()))
    )

    def fails():
        time.sleep(1.0)
        raise ZeroDivisionError

    def leaves():
        raise SystemExit

    threads = [threading.Thread(target=work, name=work.__name__) for work in (fails, leaves)]
    for thread in threads:
        thread.start()
    time.sleep(1.5)
    assert told == [(ZeroDivisionError, "fails", 1.0)]


def test_remaining_threads_are_ended_with_time_for_cleanup(rig):
    ended = []

    def listens(name, cleaning_s):
        try:
            while True:
                time.sleep(0.4)
        finally:
            time.sleep(cleaning_s)
            ended.append((name, rig.runtime.now_ns() / 1e9))

    with in_virtual_time(rig):
        for name, cleaning_s in (("slow", 2.0), ("quick", 1.0)):
            threading.Thread(target=listens, args=(name, cleaning_s), daemon=True).start()
        time.sleep(1.0)
        threading.Thread(target=ended.append, args=("never begun",)).start()
    assert ended == [("quick", 2.0), ("slow", 3.0)]
    rig.runtime.close()


def test_thread_that_ignores_its_end_gets_no_more_turns(rig):
    turns = []

    def stubborn():
        while True:
            try:
                time.sleep(1.0)
            except BaseException:
                turns.append(rig.runtime.now_ns())

    with in_virtual_time(rig):
        threading.Thread(target=stubborn, daemon=True).start()
        time.sleep(0.5)
    count = len(turns)
    assert count == 3
    rig.runtime.run_for(100.0)
    rig.runtime.close()
    assert len(turns) == count


def test_foreign_thread_uses_wall_clock_and_wakes_no_party(now_s):
    start_new_thread, allocate_lock = THE_WALLS
    event, over = threading.Event(), allocate_lock()
    over.acquire()
    refused, clocks = [], []

    def foreign():
        clocks.append(time.monotonic())
        try:
            event.set()
        except UsageError as error:
            refused.append(str(error))
        over.release()

    threading.Thread(target=event.wait, daemon=True).start()
    time.sleep(1.0)
    before_s = time.monotonic()
    start_new_thread(foreign, ())
    over.acquire()
    assert before_s == pytest.approx(100_001.0, abs=1e-4)
    assert abs(clocks[0] - 100_001.0) > 1.0
    assert "cannot wake a party" in refused[0]
    assert "threading.Thread" in refused[0]


def test_deadlock_is_reported_with_names_and_places(rig):
    told = []

    def take(one, other):
        with one:
            time.sleep(1.0)
            try:
                other.acquire()
            except UsageError as error:
                told.append(str(error))

    with in_virtual_time(rig):
        first, second = threading.Lock(), threading.Lock()
        beat = rig.runtime.every(60.0, lambda: None)
        threads = [
            threading.Thread(target=take, args=locks, name=name)
            for name, locks in (("left", (first, second)), ("right", (second, first)))
        ]
        for thread in threads:
            thread.start()
        with pytest.raises(UsageError) as caught:
            threads[0].join()
        for thread in threads:
            thread.join()
    beat.cancel()
    assert rig.runtime.now_ns() == 3600 * 10**9  # an hour, as an event might have helped until then
    assert [text.split(" waits")[0] for text in told] == ["party 'left'", "party 'right'"]
    for text in (*told, str(caught.value)):
        assert (
            "nothing can end the wait: all parties have waited for one another for an hour" in text
        )
        assert "left (" in text
        assert "), held up by right" in text
        assert "), held up by left" in text
        assert f"{__file__}:" in text
        assert "main (" in text


def test_join_of_long_running_thread_is_not_a_deadlock(now_s):
    thread = threading.Thread(target=time.sleep, args=(10_000.0,))
    thread.start()
    thread.join()
    assert now_s() == 10_000.0


def test_ctrl_c_ends_wait_for_lock_without_acquiring_it(rig):
    with in_virtual_time(rig):
        lock = threading.Lock()

        def holder():
            with lock:
                time.sleep(2.0)

        thread = threading.Thread(target=holder)
        thread.start()
        rig.runtime.queue.alarm(lambda now_ns: rig.runtime.interrupt()).set(10**9)
        time.sleep(0.5)
        with pytest.raises(KeyboardInterrupt):
            lock.acquire()
        assert rig.runtime.now_ns() == 10**9
        assert not lock.acquire(False)
        assert lock.acquire()
        assert rig.runtime.now_ns() == 2 * 10**9
        lock.release()


def test_interrupt_while_lock_is_acquired_leaves_it_free(now_s, rig, monkeypatch):
    lock = threading.Lock()
    lock.acquire()

    class Interrupting:
        def wait_for_parties(self, done, timeout_s):
            lock.release()
            assert done()
            raise KeyboardInterrupt

        def __getattr__(self, name):
            return getattr(rig.runtime, name)

    monkeypatch.setattr(program_here(), "runtime", Interrupting())
    with pytest.raises(KeyboardInterrupt):
        lock.acquire()
    assert not lock.locked()


def test_thread_started_in_callback_runs(now_s, rig):
    ran = []
    rig.runtime.queue.alarm(
        lambda now_ns: threading.Thread(target=lambda: ran.append(now_s())).start()
    ).set(10**9)
    time.sleep(2.0)
    assert ran == [1.0]


def test_objects_of_program_work_on_wall_clock_afterwards(rig):
    with in_virtual_time(rig):
        mail, lock = queue.Queue(), threading.RLock()
        flag, pool = threading.Event(), ThreadPoolExecutor(1)

    def outside():
        with lock:
            flag.set()
        mail.put(5)

    with lock:
        thread = threading.Thread(target=outside)
        thread.start()
        assert not flag.wait(0.001)
    assert flag.wait(20)
    assert mail.get(timeout=20) == 5
    thread.join()
    assert pool.submit(int).result() == 0
    pool.shutdown()


def test_two_parties_can_import_one_module(now_s, tmp_path, monkeypatch):
    (tmp_path / "slow_to_import.py").write_text("import time\ntime.sleep(1.0)\nready = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    seen = []

    def use():
        import slow_to_import

        seen.append((slow_to_import.ready, now_s()))

    threads = [threading.Thread(target=use) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [(True, 1.0), (True, 1.0)]


def test_start_new_thread_starts_a_party(now_s):
    ended = threading.Event()

    def work(pause_s, last=None):
        time.sleep(pause_s)
        last.set()

    assert _thread.start_new_thread(work, (1.0,), {"last": ended})
    assert ended.wait(5.0)
    assert 1.0 <= now_s() < 1.0 + 1e-5  # each look takes a microsecond


def test_sleep_on_wall_clock_fails_test():
    with pytest.raises(pytest.fail.Exception, match=r"sleeps 0\.5 s on the wall clock"):
        time.sleep(0.5)
