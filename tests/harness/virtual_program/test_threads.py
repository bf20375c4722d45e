import _thread
import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from harness.virtual_program import in_virtual_time, join_executors
from harness.virtual_program.turn import program_here
from motorapi.errors import UsageError

THE_WALLS = (_thread.start_new_thread, _thread.allocate_lock)  # in here nothing replaces them


def test_who_sleeps_lets_the_rigs_time_pass_and_others_run(now_s):
    said, begun = [], []

    def worker(name, period_s):
        begun.append(name)
        for _ in range(2):
            time.sleep(period_s)
            said.append((name, now_s()))

    threads = [threading.Thread(target=worker, args=(f"every {p}", p)) for p in (3.0, 2.0)]
    for thread in threads:
        thread.start()
    assert not begun  # who starts a thread keeps the turn
    for thread in threads:
        thread.join()
    assert begun == ["every 3.0", "every 2.0"]
    assert said == [("every 2.0", 2.0), ("every 3.0", 3.0), ("every 2.0", 4.0), ("every 3.0", 6.0)]
    assert not any(thread.is_alive() for thread in threads)


def test_a_lock_held_across_a_wait_is_waited_for_in_virtual_time_first_come_first_served(now_s):
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


def test_a_lock_that_is_not_let_go_in_time_is_not_taken(now_s):
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


def test_a_reentrant_lock_is_one_threads(now_s):
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
        orders.put(order)  # waits until there is room
    assert not done.wait(0.25)
    assert done.wait(10.0)
    assert worked == [(1, 1.5), (2, 2.0)]
    with pytest.raises(queue.Empty):
        orders.get(timeout=1.0)
    assert now_s() == pytest.approx(3.0, abs=1e-4)  # looking at clocks takes a microsecond each
    mail = queue.SimpleQueue()
    threading.Timer(1.0, mail.put, ["post"]).start()
    assert mail.get() == "post"


def test_a_pool_works_side_by_side_and_ends_as_with_python(now_s):
    before = threading.active_count()  # other tests of this process may have threads of their own

    def work(number):
        time.sleep(1.0)
        return number * 2, now_s()

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, range(3))) == [(0, 1.0), (2, 1.0), (4, 2.0)]
    left = ThreadPoolExecutor(1)
    future = left.submit(work, 5)
    join_executors()  # nobody has shut it down
    assert future.result() == (10, 3.0)
    assert threading.active_count() == before
    ThreadPoolExecutor(1).submit(int).result()  # there may be new ones


def test_what_a_thread_raises_is_told_as_python_does_before_another_has_its_turn(
    now_s, monkeypatch
):
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


def test_threads_that_are_left_end_with_the_program_and_their_cleaning_up_has_its_time(rig):
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


def test_a_thread_that_does_not_let_itself_be_ended_has_no_turn_any_more(rig):
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


def test_a_thread_of_somebody_else_has_the_wall_and_wakes_nobody(now_s):
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
    assert "would wake a party" in refused[0]
    assert "threading.Thread" in refused[0]


def test_parties_that_hold_each_other_up_are_told_who_and_where_also_while_events_go_on(rig):
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
    assert rig.runtime.now_ns() == 3600 * 10**9  # so long it might have been an event that helps
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


def test_who_waits_for_a_thread_that_is_busy_for_hours_is_left_alone(now_s):
    thread = threading.Thread(target=time.sleep, args=(10_000.0,))
    thread.start()
    thread.join()
    assert now_s() == 10_000.0


def test_ctrl_c_ends_the_wait_for_a_lock_and_takes_it_from_nobody(rig):
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


def test_an_interrupt_at_the_moment_a_lock_is_given_leaves_it_free(now_s, rig, monkeypatch):
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


def test_a_thread_has_a_turn_when_one_is_started_in_a_callback(now_s, rig):
    ran = []
    rig.runtime.queue.alarm(
        lambda now_ns: threading.Thread(target=lambda: ran.append(now_s())).start()
    ).set(10**9)
    time.sleep(2.0)
    assert ran == [1.0]


def test_objects_made_in_a_program_work_on_the_wall_afterwards(rig):
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


def test_modules_are_imported_by_two_parties_at_once(now_s, tmp_path, monkeypatch):
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


def test_old_programs_start_threads_by_another_name(now_s):
    ended = threading.Event()

    def work(pause_s, last=None):
        time.sleep(pause_s)
        last.set()

    assert _thread.start_new_thread(work, (1.0,), {"last": ended})
    assert ended.wait(5.0)
    assert 1.0 <= now_s() < 1.0 + 1e-5  # looks take their microseconds


def test_sleeping_on_the_wall_fails_a_test_of_this_folder():
    with pytest.raises(pytest.fail.Exception, match=r"sleeps 0\.5 s on the wall"):
        time.sleep(0.5)
