"""Takeovers of a lock, with something happening in the middle of them."""

import threading

import pytest

from motorapi import wall_runtime
from motorapi.errors import MotorBusyError
from motorapi.lock_directory import LockDirectory
from motorapi.lock_file import LockFile
from motorapi.lock_layout import LINES
from motorapi.lock_takeover import Attempt, TakeoverAttempt
from motorapi.process_lock import ProcessLock
from motorapi.wall_runtime import WallRuntime

LONG_S = 20.0


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


@pytest.fixture
def locks(tmp_path):
    """What four programs would have."""
    return [ProcessLock("pan", "the pan", LockDirectory(tmp_path)) for _ in range(4)]


def wait(runtime, time_s):
    runtime.wait_until(lambda: False, time_s)


def in_the_middle(monkeypatch, kind, name, action):
    """It is done once, just before this method's first call."""
    original = getattr(kind, name)
    todo = [action]

    def first(self, *args):
        if todo:
            todo.pop()()
        return original(self, *args)

    monkeypatch.setattr(kind, name, first)


def test_who_lets_go_in_the_middle_of_a_takeover_has_lost_nothing_and_nobody_slips_in(
    locks, runtime, monkeypatch
):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")
    told = []

    def let_go():
        hold.release()
        with pytest.raises(MotorBusyError):
            c.acquire(runtime, "c")
        told.append(hold.lost_to)

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", let_go)
    taken = b.acquire(runtime, "b", take_over=True)
    assert told == [None]
    assert hold.lost_to is None
    assert taken.token == hold.token + 1
    with pytest.raises(MotorBusyError):
        c.acquire(runtime, "c")
    taken.release()
    assert not c.acquire(runtime, "c").was_abandoned


def test_who_lets_go_before_a_takeover_begins_is_not_taken_over(locks, runtime, monkeypatch):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a")
    in_the_middle(monkeypatch, LockFile, "try_write_alone", hold.release)
    taken = b.acquire(runtime, "b", take_over=True)
    assert (taken.was_taken_over, taken.token) == (False, hold.token + 1)


def test_a_lease_that_is_renewed_before_the_takeover_begins_goes_on(locks, runtime, monkeypatch):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a", lease_s=0.5)
    wait(runtime, 0.51)
    in_the_middle(monkeypatch, LockFile, "try_write_alone", hold.renew)
    with pytest.raises(MotorBusyError, match="for a since"):
        b.acquire(runtime, "b")
    assert hold.is_held
    assert a.begin_write() == hold.token
    a.end_write()


def test_a_lease_that_would_be_renewed_in_the_middle_of_a_takeover_is_lost(
    locks, runtime, monkeypatch
):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a", lease_s=0.01)
    wait(runtime, 0.02)
    errors = []

    def renew():
        try:
            hold.renew()
        except MotorBusyError as error:
            errors.append(error)

    renewing = threading.Thread(target=renew)

    def begin():
        renewing.start()
        while not hold._counting.locked():
            pass

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", begin)
    taken = b.acquire(runtime, "b")
    renewing.join(LONG_S)
    assert [error.taken_over for error in errors] == ["its lease of 0.01 s was over"]
    assert b.begin_write() == taken.token
    b.end_write()


def test_who_is_in_the_middle_of_a_write_is_not_taken_over_until_it_is_done(locks, runtime):
    a, b, *_ = locks
    a.acquire(runtime, "a")
    a.begin_write()
    a.begin_write()
    for _ in range(2):
        with pytest.raises(MotorBusyError, match="in the middle of a write for a since"):
            b.acquire(runtime, "b", take_over=True)
        a.end_write()
    b.acquire(runtime, "b", take_over=True)
    with pytest.raises(MotorBusyError, match=r"taken over \(on demand\)"):
        a.begin_write()


def test_one_who_would_write_while_a_taker_is_paused_in_the_middle_is_told_who_that_is(
    locks, runtime, monkeypatch
):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a")
    errors = []

    def write():
        with pytest.raises(MotorBusyError) as caught:
            a.begin_write()
        errors.append(str(caught.value))

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", write)
    b.acquire(runtime, "b", take_over=True)
    assert ", in the middle of taking it over for b since 2" in errors[0]
    assert not hold.is_held


def test_a_write_of_one_thread_is_closed_against_takeovers_whatever_others_do(locks, runtime):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a")
    a.begin_write()

    def write_too():
        assert a.begin_write() == hold.token
        a.end_write()

    party = runtime.spawn("writes too", write_too)
    assert party.join(LONG_S)
    assert party.error is None
    with pytest.raises(MotorBusyError, match="in the middle of a write"):
        b.acquire(runtime, "b", take_over=True)
    a.end_write()
    taken = b.acquire(runtime, "b", take_over=True)
    again = a.acquire(runtime, "again", take_over=True)
    assert a.begin_write() == again.token == taken.token + 1
    a.end_write()


def test_of_two_takeovers_at_once_one_waits_for_the_other(locks, runtime, monkeypatch):
    a, b, c, _ = locks
    a.acquire(runtime, "a")
    seen = []

    def meddle():
        attempt = TakeoverAttempt(c._open(), None, lambda number, reason: b"")
        seen.append(attempt.make())

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", meddle)
    first = b.acquire(runtime, "b", take_over=True)
    assert seen == [Attempt.TAKING]
    second = c.acquire(runtime, "c", take_over=True)
    assert second.token == first.token + 1
    assert "for c" in first.lost_to


def test_who_finds_a_lease_over_and_is_too_late_changes_nothing(locks, runtime, monkeypatch):
    a, b, c, _ = locks
    a.acquire(runtime, "a", lease_s=0.01)
    wait(runtime, 0.02)
    taken = []

    def be_quicker():
        taken.append(c.acquire(runtime, "c", take_over=True))

    in_the_middle(monkeypatch, LockFile, "try_write_alone", be_quicker)
    with pytest.raises(MotorBusyError, match="for c since"):
        b.acquire(runtime, "b")
    assert taken[0].is_held


def test_behind_one_who_has_waited_for_it_and_lost_it_nobody_waits(locks, runtime):
    a, b, c, d = locks
    first = a.acquire(runtime, "a")
    holds = {}

    def take(lock, name):
        holds[name] = lock.acquire(runtime, name, LONG_S)

    parties = []
    for lock, name in ((b, "b"), (c, "c")):
        parties.append(runtime.spawn(name, lambda lock=lock, name=name: take(lock, name)))
        count = len(parties)
        assert runtime.wait_until(lambda n=count: len(a.look().waiters) == n, LONG_S)
    first.release()
    assert parties[0].join(LONG_S)
    assert [one.record.purpose for _, one in a.look().waiters] == ["c"]
    over = d.acquire(runtime, "d", take_over=True)
    assert not holds["b"].is_held
    assert [one.record.purpose for _, one in a.look().waiters] == ["c"]
    assert "c" not in holds
    over.release()
    assert parties[1].join(LONG_S)
    assert holds["c"].is_held
    holds["c"].release()
    assert a.acquire(runtime, "a").token == over.token + 2  # as if b, who lives, were not there


def test_one_who_has_waited_behind_the_loser_is_woken_when_the_taker_lets_go(
    locks, runtime, monkeypatch
):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")
    party = runtime.spawn("b", lambda: b.acquire(runtime, "b", LONG_S).release())
    assert runtime.wait_until(lambda: b._watcher._current is not None, LONG_S)
    over = c.acquire(runtime, "c", take_over=True)
    assert runtime.wait_until(lambda: b._watcher._epoch == c._hold._file.epoch, LONG_S)
    monkeypatch.setattr(wall_runtime, "_LOOK_AGAIN_S", LONG_S)  # it must be told
    runtime.wake()
    over.release()
    party.thread.join(LONG_S / 2)
    assert party.finished
    assert not hold.is_held


def test_who_has_not_yet_said_who_it_is_can_be_taken_over_and_its_token_is_the_smaller(
    locks, runtime, monkeypatch
):
    a, b, *_ = locks
    a.acquire(runtime, "first").release()
    taken = []
    in_the_middle(
        monkeypatch,
        LockFile,
        "tell_holder",
        lambda: taken.append(b.acquire(runtime, "b", take_over=True)),
    )
    hold = a.acquire(runtime, "a")
    assert taken[0].token == hold.token + 1
    assert not hold.is_held
    assert taken[0].is_held
    assert b.look().holder.record.purpose == "b"


def test_in_a_new_file_as_well_tokens_grow_through_such_a_takeover(locks, runtime, monkeypatch):
    a, b, *_ = locks
    taken = []
    in_the_middle(
        monkeypatch,
        LockFile,
        "tell_holder",
        lambda: taken.append(b.acquire(runtime, "b", take_over=True)),
    )
    with pytest.raises(MotorBusyError, match="for b since"):
        a.acquire(runtime, "a")  # its token might be the greater one: it has never had it
    assert taken[0].is_held


def test_as_many_who_lost_it_may_live_as_there_are_lines_and_then_it_is_told(tmp_path, runtime):
    locks = [ProcessLock("pan", "the pan", LockDirectory(tmp_path)) for _ in range(LINES + 1)]
    holds = [lock.acquire(runtime, f"p{n}", take_over=True) for n, lock in enumerate(locks[:-1])]
    with pytest.raises(MotorBusyError, match="too many processes live that have lost it"):
        locks[-1].acquire(runtime, "one more", take_over=True)
    assert [hold.is_held for hold in holds] == [False] * (LINES - 1) + [True]
    holds[3].release()
    last = locks[-1].acquire(runtime, "one more", take_over=True)
    for hold in holds:
        assert not hold.is_held
        hold.release()
    assert last.is_held
    assert locks[-1].begin_write() == last.token
    locks[-1].end_write()
    tokens = [hold.token for hold in (*holds, last)]
    assert tokens == sorted(set(tokens))


def test_who_had_it_long_ago_and_was_idle_finds_the_present_epoch(locks, runtime):
    a, b, c, d = locks
    a.acquire(runtime, "a").release()
    for _ in range(2 * LINES + 3):
        first = b.acquire(runtime, "b")
        second = c.acquire(runtime, "c", take_over=True)
        first.release()
        second.release()
    with d.acquire(runtime, "d"), pytest.raises(MotorBusyError, match="for d since"):
        a.acquire(runtime, "a")
    assert a.acquire(runtime, "a").token == second.token + 2


def test_a_takeover_is_told_to_whoever_looks(locks, runtime):
    a, b, *_ = locks
    a.acquire(runtime, "a", lease_s=30.0)
    view = a.look()
    assert (view.lease_s, view.taken_over) == (30.0, None)
    assert 0.0 < view.lease_left_s <= 30.0
    hold = b.acquire(runtime, "b", take_over=True)
    view = b.look()
    assert (view.lease_s, view.token) == (None, hold.token)
    assert (view.taken_over.reason, view.taken_over.token) == ("on demand", hold.token)
    assert view.taken_over.from_pid == view.holder.record.pid
    hold.release()
    assert b.look().holder is None
    with b.acquire(runtime, "again"):
        assert b.look().taken_over is None


def test_a_takeover_that_was_begun_and_not_done_is_told_to_nobody(locks, runtime, monkeypatch):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")

    def die():
        raise KeyboardInterrupt

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", die)
    with pytest.raises(KeyboardInterrupt):
        b.acquire(runtime, "b", take_over=True)
    assert (hold.is_held, hold.lost_to) == (True, None)
    assert a.look().taken_over is None
    hold.release()
    with c.acquire(runtime, "c") as after:
        assert after.token == hold.token + 1
        assert c.look().taken_over is None
        over = b.acquire(runtime, "b", take_over=True)
        assert b.look().taken_over.lost == after.token
        assert after.lost_to is not None
        over.release()


def test_of_a_takeover_long_ago_only_that_is_told(locks, runtime):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")
    for _ in range(20):
        first = b.acquire(runtime, "b", take_over=True)
        second = c.acquire(runtime, "c", take_over=True)
        first.release()
        second.release()
        c.acquire(runtime, "c").release()
    assert not hold.is_held
    assert hold.lost_to.startswith("somebody")
