"""Two programs at one lock, paused before any system call on its file while the other one runs."""

import fcntl
from itertools import count

import pytest

from motorhil.motorapi.locking import witness
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import LockFile, find, held_at
from motorhil.motorapi.locking.process_lock import ProcessLock
from tests.support.sharing.stepwise import Program, Turns, stopped_at_calls

TOKEN_OF_A_NEW_FILE_MIN = 10**15  # microseconds of the calendar: greater than in any removed file


@pytest.fixture(autouse=True)
def stepwise():
    with stopped_at_calls():
        yield


def judge(path, *programs):
    holds = [program.hold for program in programs if program.hold is not None]
    tokens = [hold.token for hold in holds]
    assert len(set(tokens)) == len(tokens), tokens
    assert min(tokens, default=TOKEN_OF_A_NEW_FILE_MIN) >= TOKEN_OF_A_NEW_FILE_MIN
    assert sum(hold.is_held for hold in holds) <= 1
    owner = [hold.token for hold in holds if hold.is_held]
    assert owner in ([], [max(tokens, default=0)])
    for hold in holds:
        hold.release()
    last = ProcessLock("pan", "the pan", LockDirectory(path)).acquire(Turns(), "last")
    assert last.token > max(tokens, default=0)
    last.release()
    return tokens


def all_pauses(schedule, tmp_path):
    """Carry out the schedule with all pauses (first, second); return the number of schedules."""
    done = 0
    for first in count():
        for second in count():
            path = tmp_path / f"{first}-{second}"
            path.mkdir(mode=0o700)
            was_first, was_second = schedule(path, first, second)
            done += 1
            if not was_second:
                break
        if not was_first:
            return done


def is_attempted(path):
    """Return True if a stopped program has locked HELD, and is not the holder yet."""
    file = LockFile(LockDirectory(path), "pan")
    held = held_at(file.epoch)
    found = find(file.fd, fcntl.F_RDLCK, held, 1)
    file.close()
    return found is not None and found[0] == held


def released(path):
    hold = ProcessLock("pan", "the pan", LockDirectory(path)).acquire(Turns(), "before")
    hold.release()


@pytest.mark.parametrize("is_killed", [False, True], ids=["paused", "killed"])
def test_release_in_a_takeover_gives_nobody_its_token(tmp_path, is_killed):
    def schedule(path, first, second):
        holder = ProcessLock("pan", "the pan", LockDirectory(path)).acquire(Turns(), "holder")
        taker, waiter = Program(path, take_over=True), Program(path)
        was_first = taker.advance(first)
        holder.release()
        was_second = waiter.advance(second)
        is_attempt = is_attempted(path)
        if is_killed:
            taker.kill()
        taker.advance()
        waiter.advance()
        tokens = judge(path, taker, waiter)
        assert holder.token not in tokens
        assert tokens or is_killed or is_attempt  # each gave up while the other one was stopped
        return was_first, was_second

    assert all_pauses(schedule, tmp_path) > 100


@pytest.mark.parametrize("is_new", [False, True], ids=["used", "new"])
@pytest.mark.parametrize("is_killed", [False, True], ids=["paused", "killed"])
def test_takeover_of_a_paused_acquisition_has_own_token(tmp_path, is_killed, is_new):
    def schedule(path, first, second):
        if not is_new:
            released(path)
        asker, taker = Program(path), Program(path, take_over=True)
        was_first = asker.advance(first)
        was_second = taker.advance(second)
        if is_killed:
            asker.kill()
        asker.advance()
        taker.advance()
        assert judge(path, asker, taker) or is_killed
        return was_first, was_second

    assert all_pauses(schedule, tmp_path) > 100


def test_release_in_a_takeover_keeps_the_order_of_the_queue(tmp_path):
    """The holder came from the queue: a takeover moves the queue on past its place, if any."""

    def schedule(path, first, second):
        directory = LockDirectory(path)
        before = ProcessLock("pan", "the pan", directory).acquire(Turns(), "before")
        holder, one, two = (LockFile(directory, "pan") for _ in range(3))
        places = [file.queue_up() for file in (holder, one, two)]
        before.release()
        assert holder.take(places[0])
        taker = Program(path, take_over=True)
        was_first = taker.advance(first)
        holder.let_go()
        taker.advance()
        taker.hold.release()
        for file in (one, two):
            file.look_up()
        assert not two.take(places[2]), f"overtaken after {first} steps"
        assert one.take(places[1])
        for file in (holder, one, two):
            file.close()
        return was_first, False

    assert all_pauses(schedule, tmp_path) > 10


def test_attempt_during_a_takeover_keeps_its_place(tmp_path):
    """The holder dies in a takeover, and the first in the queue tries at once to follow."""
    kept = []

    def schedule(path, first, second):
        directory = LockDirectory(path)
        before = ProcessLock("pan", "the pan", directory).acquire(Turns(), "before")
        holder, one, new = (LockFile(directory, "pan") for _ in range(3))
        places = [file.queue_up() for file in (holder, one)]
        before.release()
        assert holder.take(places[0])
        taker = Program(path, take_over=True)
        was_first = taker.advance(first)
        holder.close()
        taken = []
        trier = Program(path, lambda: taken.append(one.take(places[1])))
        was_second = trier.advance(second)
        taker.advance()
        trier.advance()
        if taker.hold is not None:
            taker.hold.release()
        if taken == [False]:
            new.look_up()
            assert not new.take_at_once(), f"overtaken after {first} and {second} steps"
            kept.append((first, second))
        for file in (one, new):
            file.close()
        return was_first, was_second

    assert all_pauses(schedule, tmp_path) > 100
    assert len(kept) > 30


@pytest.mark.parametrize("is_killed", [False, True], ids=["paused", "killed"])
def test_takeover_of_a_paused_takeover_leaves_one_owner(tmp_path, is_killed):
    """The holder lives: the first taker is a holder to take from once it has written the epoch."""

    def schedule(path, first, second):
        holder = Program(path)
        one, two = Program(path, take_over=True), Program(path, take_over=True)
        holder.advance()
        was_first = one.advance(first)
        was_second = two.advance(second)
        if is_killed:
            one.kill()
        one.advance()
        two.advance()
        judge(path, holder, one, two)
        return was_first, was_second

    assert all_pauses(schedule, tmp_path) > 100


def test_takeover_in_a_new_file_leaves_the_holder_of_the_removed_one(tmp_path, monkeypatch):
    """A program has begun to acquire the new file: the taker finds something to take there."""
    numbers = {}
    monkeypatch.setattr(witness, "_hash_of", lambda inode: numbers.setdefault(inode, len(numbers)))
    refused = []
    for first in count():
        path = tmp_path / f"{first}"
        path.mkdir(mode=0o700)
        lock = ProcessLock("pan", "the pan", LockDirectory(path))
        hold = lock.acquire(Turns(), "holder")
        (path / "pan").unlink()
        asker, taker = Program(path), Program(path, take_over=True)
        is_stopped = asker.advance(first)
        taker.advance()
        asker.advance()
        assert (asker.hold, taker.hold, hold.lost_to) == (None, None, None)
        assert lock.begin_write() == hold.token  # looks at the new file
        lock.end_write()
        refused.append(first)
        hold.release()
        if not is_stopped:
            break
    assert len(refused) > 10
