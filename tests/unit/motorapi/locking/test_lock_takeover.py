"""Takeovers of a lock, with other events in the middle of them."""

import os
import threading

import pytest

from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import EPOCH_AT, LINES, LockFile
from motorhil.motorapi.locking.lock_status import list_locks
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.locking.takeover import Attempt, TakeoverAttempt
from motorhil.motorapi.runtime import wall as wall_runtime
from motorhil.motorapi.runtime.wall import WallRuntime

LONG_S = 20.0


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


@pytest.fixture
def locks(tmp_path):
    """Return the lock objects of four programs."""
    return [ProcessLock("pan", "the pan", LockDirectory(tmp_path)) for _ in range(4)]


def wait(runtime, time_s):
    runtime.wait_until(lambda: False, time_s)


def in_the_middle(monkeypatch, kind, name, action):
    """Run an action once, just before the first call of a method."""
    original = getattr(kind, name)
    todo = [action]

    def first(self, *args):
        if todo:
            todo.pop()()
        return original(self, *args)

    monkeypatch.setattr(kind, name, first)


def test_release_during_a_takeover_loses_nothing(locks, runtime, monkeypatch):
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


def test_release_before_a_takeover_prevents_it(locks, runtime, monkeypatch):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a")
    in_the_middle(monkeypatch, LockFile, "try_write_alone", hold.release)
    taken = b.acquire(runtime, "b", take_over=True)
    assert (taken.was_taken_over, taken.token) == (False, hold.token + 1)


def test_lease_renewed_before_a_takeover_continues(locks, runtime, monkeypatch):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a", lease_s=0.5)
    wait(runtime, 0.51)
    in_the_middle(monkeypatch, LockFile, "try_write_alone", hold.renew)
    with pytest.raises(MotorBusyError, match="for a since"):
        b.acquire(runtime, "b")
    assert hold.is_held
    assert a.begin_write() == hold.token
    a.end_write()


def test_lease_renewal_during_a_takeover_is_lost(locks, runtime, monkeypatch):
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


def test_takeover_waits_for_the_end_of_a_write(locks, runtime):
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


def test_write_during_a_paused_takeover_names_the_new_holder(locks, runtime, monkeypatch):
    a, b, *_ = locks
    hold = a.acquire(runtime, "a")
    errors = []

    def write():
        with pytest.raises(MotorBusyError) as caught:
            a.begin_write()
        errors.append(str(caught.value))

    in_the_middle(monkeypatch, TakeoverAttempt, "_move_on", write)
    b.acquire(runtime, "b", take_over=True)
    assert ", during its takeover for b since 2" in errors[0]
    assert not hold.is_held


def test_write_of_one_thread_blocks_takeovers(locks, runtime):
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


def test_second_of_two_takeovers_waits_for_the_first(locks, runtime, monkeypatch):
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


def test_late_takeover_of_a_lease_changes_nothing(locks, runtime, monkeypatch):
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


def test_place_of_a_former_holder_blocks_no_waiter(locks, runtime):
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
    assert a.acquire(runtime, "a").token == over.token + 2  # as if b, which is alive, did not exist


def test_waiter_behind_the_loser_wakes_at_the_next_release(locks, runtime, monkeypatch):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")
    party = runtime.spawn("b", lambda: b.acquire(runtime, "b", LONG_S).release())
    assert runtime.wait_until(lambda: b._watcher._current is not None, LONG_S)
    over = c.acquire(runtime, "c", take_over=True)
    assert runtime.wait_until(lambda: b._watcher._epoch == c._hold._file.epoch, LONG_S)
    monkeypatch.setattr(wall_runtime, "_LOOK_AGAIN_S", LONG_S)  # it must be notified
    runtime.wake()
    over.release()
    party.thread.join(LONG_S / 2)
    assert party.finished
    assert not hold.is_held


def test_takeover_of_an_unpublished_holder_has_larger_token(locks, runtime, monkeypatch):
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


def test_takeover_of_an_unpublished_holder_of_a_new_file(locks, runtime, monkeypatch):
    a, b, *_ = locks
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


def test_number_of_live_former_holders_is_limited(tmp_path, runtime):
    locks = [ProcessLock("pan", "the pan", LockDirectory(tmp_path)) for _ in range(LINES + 1)]
    holds = [lock.acquire(runtime, f"p{n}", take_over=True) for n, lock in enumerate(locks[:-1])]
    with pytest.raises(MotorBusyError, match="too many live processes have lost the lock"):
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


def test_idle_former_holder_finds_the_present_epoch(locks, runtime):
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


def test_takeover_is_visible_to_readers(locks, runtime):
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


def test_unfinished_takeover_is_not_visible(locks, runtime, monkeypatch):
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


def test_loss_of_an_old_token_has_no_details(locks, runtime):
    a, b, c, _ = locks
    hold = a.acquire(runtime, "a")
    for _ in range(20):
        first = b.acquire(runtime, "b", take_over=True)
        second = c.acquire(runtime, "c", take_over=True)
        first.release()
        second.release()
        c.acquire(runtime, "c").release()
    assert not hold.is_held
    assert hold.lost_to.startswith("an unknown process")


def damage(path, data, at):
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


@pytest.mark.parametrize("was_taken_over", [False, True])
@pytest.mark.parametrize(
    ("data", "at"),
    [
        (b"\xff" * 8, EPOCH_AT),
        (b"\x09" + b"\0" * 7, EPOCH_AT),
        (b"\xff" * 8, EPOCH_AT + 8),  # the first valid place
        (b"\xff" * 8, EPOCH_AT - 8),  # the check value
    ],
)
def test_damaged_epoch_raises_with_the_remedy(locks, runtime, tmp_path, was_taken_over, data, at):
    a, b, c, d = locks
    hold = a.acquire(runtime, "a")
    if was_taken_over:
        first, hold = hold, b.acquire(runtime, "b", take_over=True)
        assert not first.is_held
    damage(tmp_path / "pan", data, at)
    words = f"{tmp_path}/pan: damaged lock file; epoch .* remove the file"
    for action in (
        c.look,
        lambda: c.acquire(runtime, "c"),
        lambda: list_locks(LockDirectory(tmp_path)),
    ):
        with pytest.raises(UsageError, match=words):
            action()
    (tmp_path / "pan").unlink()
    hold.release()
    d.acquire(runtime, "d").release()


@pytest.mark.parametrize("size", [0, 8, 490])
def test_file_cut_off_while_in_use_raises(locks, runtime, tmp_path, size):
    a, b, c, _ = locks
    a.acquire(runtime, "a")
    hold = b.acquire(runtime, "b", take_over=True)
    os.truncate(tmp_path / "pan", size)
    with pytest.raises(UsageError, match=f"{tmp_path}/pan: damaged lock file; the file ends"):
        c.acquire(runtime, "c")
    hold.release()
