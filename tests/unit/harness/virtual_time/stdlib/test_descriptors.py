"""Waits for descriptors: asyncio, selectors, select and sockets of one program."""

import asyncio
import os
import select
import selectors
import socket
import subprocess
import sys
import threading
import time
from random import Random

import pytest

from motorhil.motorapi.errors import UsageError


def later(delay_s, action):
    threading.Thread(target=lambda: (time.sleep(delay_s), action())).start()


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def by_select(end, timeout):
    return select.select([end], [], [], timeout)[0] == [end]


def by_selector(end, timeout):
    with selectors.DefaultSelector() as selector:
        selector.register(end, selectors.EVENT_READ)
        return bool(selector.select(timeout))


def by_poll(end, timeout):
    poll = select.poll()
    poll.register(end, select.POLLOUT)
    poll.modify(end, select.POLLIN)
    poll.register(0)
    poll.unregister(0)
    return poll.poll(None if timeout is None else 1_000 * timeout) == [(end, select.POLLIN)]


def by_epoll(end, timeout):
    with select.epoll() as epoll:
        epoll.register(end, select.EPOLLIN | select.EPOLLET)
        found = epoll.poll(-1 if timeout is None else timeout)
        assert epoll.poll(0) == []  # an edge is told once
        with select.epoll.fromfd(os.dup(epoll.fileno())) as other:
            other.modify(end, select.EPOLLIN)
            assert other.poll(0) == found
            other.unregister(end)
            assert other.poll(0) == []
    assert epoll.closed
    return found == [(end, select.EPOLLIN)]


@pytest.mark.parametrize("is_ready_within", [by_select, by_selector, by_poll, by_epoll])
def test_pipe_is_awaited_in_the_rigs_time(now_s, pipe, is_ready_within):
    later(0.5, lambda: os.write(pipe[1], b"7"))
    assert not is_ready_within(pipe[0], 0.2)
    assert now_s() == 0.2
    assert is_ready_within(pipe[0], None)
    assert now_s() == 0.5
    assert is_ready_within(pipe[0], 10.0)
    assert now_s() == 0.5


def test_pair_of_sockets_is_awaited_in_the_rigs_time(now_s):
    one, other = socket.socketpair()
    with one, other:
        later(0.5, lambda: other.send(b"7"))
        one.settimeout(0.2)
        with pytest.raises(TimeoutError, match=r"^timed out$"):
            one.recv(8)
        assert now_s() == 0.2
        one.settimeout(None)
        assert one.recv(8) == b"7"
        assert now_s() == 0.5


def network():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.accept()


def child():
    words = [sys.executable, "-c", "input()"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            select.select([process.stdout], [], [], 1.0)
        finally:
            process.stdin.close()


def named(tmp_path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "it"))
        server.listen()
        by_selector(server, 1.0)


@pytest.mark.parametrize(
    ("wait", "what"),
    [
        (network, "socket.accept in virtual time: it waits for a network socket,"),
        (child, "select.select in virtual time: it waits for a pipe to another process,"),
        (named, "selectors.EpollSelector.select in virtual time: it waits for a named socket,"),
    ],
)
def test_other_end_outside_the_program_is_refused(now_s, tmp_path, wait, what):
    with pytest.raises(UsageError) as caught:
        wait(tmp_path) if wait is named else wait()
    assert str(caught.value).startswith(what)
    assert now_s() == 0.0


def test_subprocess_of_asyncio_is_refused_with_remedy(now_s):
    with pytest.raises(UsageError, match=r"asyncio\.subprocess_exec .* asyncio\.to_thread"):
        asyncio.run(asyncio.create_subprocess_exec(sys.executable, "--version"))


@pytest.mark.parametrize("seed", range(5))
def test_coroutines_wake_in_the_order_of_their_times(now_s, seed):
    dice, woken = Random(seed), []
    naps = [[dice.randrange(1, 10**6) * 1e-3 for _ in range(5)] for _ in range(20)]

    async def sleeper(number):
        for nap_s in naps[number]:
            await asyncio.sleep(nap_s)
            woken.append((now_s(), number))

    async def together():
        await asyncio.gather(*map(sleeper, range(len(naps))))

    asyncio.run(together())
    expected = sorted(
        (sum(one[: count + 1]), number) for number, one in enumerate(naps) for count in range(5)
    )
    assert [number for _, number in woken] == [number for _, number in expected]
    for (at_s, _), (due_s, _) in zip(woken, expected, strict=True):
        assert at_s == pytest.approx(due_s, abs=0.005)  # a look at the clock takes 1 us


def test_threads_and_timeouts_of_asyncio_have_the_rigs_time(now_s):
    async def main():
        await asyncio.to_thread(time.sleep, 2.0)
        told = [now_s()]
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.Event().wait(), 0.5)
        told.append(now_s())
        loop, event = asyncio.get_running_loop(), asyncio.Event()
        later(0.25, lambda: loop.call_soon_threadsafe(event.set))
        await event.wait()
        return [*told, now_s()]

    assert asyncio.run(main()) == [2.0, 2.5, 2.75]


def test_event_loop_that_nothing_can_wake_is_told(now_s):
    with pytest.raises(UsageError, match="nothing can end the wait"):
        asyncio.run(asyncio.Event().wait())
