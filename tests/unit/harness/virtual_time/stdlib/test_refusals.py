import multiprocessing
import os
import select
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from multiprocessing.pool import ThreadPool
from types import ModuleType

import can
import pytest

from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.motorapi.errors import UsageError


def receive():
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.recv(1)


def wait_for_network(wait):
    with socket.create_server(("127.0.0.1", 0)) as server:
        wait(server)


def by_selector(server):
    with selectors.DefaultSelector() as selector:
        selector.register(server, selectors.EVENT_READ)
        selector.select(0.01)


def by_poll(server):
    poll = select.poll()
    poll.register(server)
    poll.poll(10)


def by_epoll(server):
    with select.epoll() as epoll:
        epoll.register(server.fileno(), select.EPOLLIN)
        epoll.poll(0.01)


REFUSED = {
    "os.fork": lambda: os.fork(),
    "os.forkpty": lambda: os.forkpty(),
    "multiprocessing": lambda: multiprocessing.Process(target=print).start(),
    "multiprocessing.Queue": lambda: multiprocessing.Queue(),
    "multiprocessing.SimpleQueue": lambda: multiprocessing.SimpleQueue(),
    "select.select": lambda: wait_for_network(lambda one: select.select([one], [], [], 0.01)),
    "select.poll": lambda: wait_for_network(by_poll),
    "select.epoll": lambda: wait_for_network(by_epoll),
    "selectors.EpollSelector.select": lambda: wait_for_network(by_selector),
    "signal.alarm": lambda: signal.alarm(100),
    "signal.setitimer": lambda: signal.setitimer(signal.ITIMER_REAL, 100.0),
    "signal.sigtimedwait": lambda: signal.sigtimedwait([signal.SIGUSR1], 0.01),
    "socket.recv": receive,
    "socket.socket(AF_CAN)": lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW),
}


@pytest.mark.parametrize("name", REFUSED)
def test_blocking_operation_is_refused_with_remedy(now_s, name):
    with pytest.raises(UsageError) as caught:
        REFUSED[name]()
    told = str(caught.value)
    assert told.startswith(f"{name} in virtual time: ")
    assert told.endswith("motorhil serve RIG -- python SCRIPT")


def test_non_blocking_operations_are_not_refused(now_s):
    assert select.select([], [], [], 0) == ([], [], [])
    with selectors.DefaultSelector() as selector:
        assert selector.select(0) == []
    one, other = socket.socketpair()
    with one, other:
        one.setblocking(False)
        other.send(b"7")
        assert one.recv(8) == b"7"
        with pytest.raises(BlockingIOError):
            one.recv(8)
    done = subprocess.run(
        [sys.executable, "-c", "print(5)"], capture_output=True, text=True, check=True
    )
    assert done.stdout == "5\n"
    assert now_s() == 0.0  # time stood still


def test_thread_pool_of_multiprocessing_works(now_s):
    with ThreadPool(2) as pool:
        assert pool.map(lambda nap_s: (time.sleep(nap_s), now_s())[1], [1.0, 1.5, 1.0]) == [
            *(1.0, 1.5, 2.0)
        ]
    assert now_s() == 2.0


def test_threads_that_are_not_parties_may_block(rig):
    heard = []

    def outside():
        started.wait(20)
        heard.append(select.select([], [], [], 0.001))

    started = threading.Event()
    thread = threading.Thread(target=outside)
    thread.start()
    with in_virtual_time(rig):
        started.set()
        thread.join()
    assert heard == [([], [], [])]


def test_thread_started_by_own_package_uses_wall_time(now_s):
    own = ModuleType("motorhil.motorapi.somewhere")
    exec("def start(thread):\n    thread.start()\n", vars(own))
    ran = []
    thread = threading.Thread(target=lambda: ran.append(select.select([], [], [], 0.001)))
    own.start(thread)
    thread.join()
    assert ran == [([], [], [])]
    assert now_s() == 0.0


def test_bus_of_hub_socket_is_refused(now_s):
    with pytest.raises(can.CanInitializationError, match=r"'/tmp/x.sock' is a socket.*by its name"):
        can.Bus(interface="emulated", channel="/tmp/x.sock")


def test_second_program_or_foreign_thread_is_refused(rig):
    refused = []

    def elsewhere():
        try:
            with in_virtual_time(rig):
                pass
        except UsageError as error:
            refused.append(str(error))

    thread = threading.Thread(target=elsewhere, name="stranger")
    thread.start()
    thread.join()
    assert "thread 'stranger' is not a party of this rig" in refused[0]
    with in_virtual_time(rig), pytest.raises(UsageError, match="already"), in_virtual_time(rig):
        pass
