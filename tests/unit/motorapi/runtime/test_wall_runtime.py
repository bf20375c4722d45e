"""The wall runtime, without waits for time except by `wait_until`.

Upper bounds on delays are generous (seconds), lower bounds are exact.
"""

import struct
import threading

import can
import pytest

from motorhil.motorapi import LinkError, UsageError, WallRuntime, runtime_of
from motorhil.motorapi.runtime.wall import close_process_runtime, process_runtime

pytestmark = pytest.mark.wall

# Linux struct can_frame (include/uapi/linux/can.h), written by hand.
FRAME = struct.pack("<IB3x8s", 0x123, 3, b"\x01\x02\x03")
EXTENDED = struct.pack("<IB3x8s", 0x8000_0000 | 0x1ABCDEF0, 0, b"")
REMOTE = struct.pack("<IB3x8s", 0x4000_0000 | 0x701, 4, b"")
LATE_S = 10.0


@pytest.fixture
def runtime():
    before = set(threading.enumerate())
    runtime = WallRuntime()
    yield runtime
    runtime.close()
    assert set(threading.enumerate()) <= before


@pytest.fixture
def bus():
    with can.Bus(interface="virtual", channel="wall-test") as bus:
        yield bus


@pytest.fixture
def peer(bus):
    with can.Bus(interface="virtual", channel="wall-test") as peer:
        yield peer


def work(runtime, duration_s):
    """Run a callback that takes some time."""
    end_ns = runtime.now_ns() + round(duration_s * 1e9)
    while runtime.now_ns() < end_ns:
        pass


def test_time_begins_at_zero_and_only_grows(runtime):
    first_ns = runtime.now_ns()
    assert 0 <= first_ns < LATE_S * 1e9
    assert runtime.now_ns() >= first_ns


def test_wait_ends_at_once_or_at_its_deadline_never_before(runtime):
    assert runtime.wait_until(lambda: True)
    assert runtime.wait_until(lambda: True, 0.0)
    assert not runtime.wait_until(lambda: False, 0.0)
    began_ns = runtime.now_ns()
    assert not runtime.wait_until(lambda: False, 0.05)
    assert runtime.now_ns() - began_ns >= 50_000_000
    with pytest.raises(UsageError, match="timeout_s"):
        runtime.wait_until(lambda: True, -1.0)


def test_change_by_another_thread_is_noticed(runtime):
    flag = threading.Event()
    party = runtime.spawn("setter", flag.set)
    assert runtime.wait_until(flag.is_set, LATE_S)
    assert party.join(LATE_S)
    assert party.error is None
    foreign = threading.Thread(target=lambda: results.append(runtime.wait_until(flag.is_set, 1.0)))
    results = []
    foreign.start()
    foreign.join()
    assert results == [True]  # on the wall clock, any thread may wait


def test_timers_keep_their_grid_and_end(runtime):
    times_ns = []
    began_ns = runtime.now_ns()
    timer = runtime.every(0.02, lambda: times_ns.append(runtime.now_ns()))
    assert runtime.wait_until(lambda: len(times_ns) >= 3, LATE_S)
    timer.cancel()
    timer.cancel()
    count = len(times_ns)
    for time_ns in times_ns:
        assert time_ns - began_ns >= 20_000_000
    assert times_ns == sorted(times_ns)
    assert not runtime.wait_until(lambda: len(times_ns) > count, 0.06)
    for period_s in (0.0, -1.0, 1e-12, 1e300, float("inf"), float("nan")):
        with pytest.raises(UsageError, match=r"period_s = .*: must be 1e-9 to 1e9 s"):
            runtime.every(period_s, lambda: None)


def test_late_timer_skips_missed_runs(runtime):
    runs_ns = []

    def slow_once():
        runs_ns.append(runtime.now_ns())
        if len(runs_ns) == 1:
            work(runtime, 0.05)

    runtime.every(0.01, slow_once)
    assert runtime.wait_until(lambda: len(runs_ns) >= 5, LATE_S)
    # The second is late; the third to fifth are on the grid: two whole periods between them.
    assert runs_ns[4] - runs_ns[1] >= 20_000_000


def test_timer_cancelled_in_a_callback_does_not_run_again(runtime):
    runs = []

    def cancel_when_it_is_due():  # created without other callbacks: it cannot be earlier
        timer = runtime.every(0.01, lambda: runs.append(1))
        work(runtime, 0.03)
        timer.cancel()
        return True

    assert runtime.wait_until(cancel_when_it_is_due)
    assert not runtime.wait_until(lambda: False, 0.03)
    assert runs == []


def test_frames_are_received_as_can_frames(runtime, bus, peer):
    heard = []
    runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
    peer.send(can.Message(arbitration_id=0x123, data=[1, 2, 3], is_extended_id=False))
    peer.send(can.Message(arbitration_id=0x1ABCDEF0, is_extended_id=True))
    peer.send(can.Message(arbitration_id=0x701, dlc=4, is_remote_frame=True, is_extended_id=False))
    assert runtime.wait_until(lambda: len(heard) == 3, LATE_S)
    assert heard == [(FRAME, False), (EXTENDED, False), (REMOTE, False)]


def test_frames_are_sent_and_reported_in_order(runtime, bus, peer):
    heard = []
    runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
    for frame in (FRAME, EXTENDED, REMOTE):
        runtime.send(bus, frame)
    assert heard == [(FRAME, True), (EXTENDED, True), (REMOTE, True)]
    got = [peer.recv(LATE_S) for _ in range(3)]
    assert [message.arbitration_id for message in got] == [0x123, 0x1ABCDEF0, 0x701]
    assert [bytes(message.data) for message in got] == [b"\x01\x02\x03", b"", b""]
    assert [message.is_remote_frame for message in got] == [False, False, True]
    assert got[2].dlc == 4


def test_own_frames_are_reported_once_even_if_echoed(runtime):
    with can.Bus(interface="virtual", channel="wall-own", receive_own_messages=True) as bus:
        heard = []
        runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
        runtime.send(bus, FRAME)
        with can.Bus(interface="virtual", channel="wall-own") as peer:
            peer.send(can.Message(arbitration_id=0x1ABCDEF0))
            assert runtime.wait_until(lambda: len(heard) >= 2, LATE_S)
        assert heard == [(FRAME, True), (EXTENDED, False)]


def test_frames_of_other_protocols_are_ignored(runtime):
    options = {"interface": "virtual", "channel": "wall-fd", "protocol": can.CanProtocol.CAN_FD}
    with can.Bus(**options) as bus, can.Bus(**options) as peer:
        heard = []
        runtime.listen(bus, lambda frame, time_ns, own: heard.append(frame))
        peer.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(8)))
        peer.send(can.Message(arbitration_id=0x1ABCDEF0))
        assert runtime.wait_until(lambda: bool(heard), LATE_S)
        assert heard == [EXTENDED]


def test_error_frames_become_controller_messages(runtime, bus, peer):
    heard = []
    runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
    for arbitration_id, data, extended in (
        (0x204, "0020000000008000", False),  # linux/can/error.h: error passive, TEC 128
        (0x004, "0020", False),  # PCAN: a stuff error, 4 bytes of its own
        (0x204, "0020000000008000", True),
        (0x701, "0020000000008000", False),
    ):
        peer.send(
            can.Message(
                arbitration_id=arbitration_id,
                is_error_frame=True,
                is_extended_id=extended,
                data=bytes.fromhex(data),
            )
        )
    assert runtime.wait_until(lambda: len(heard) == 4, LATE_S)
    assert heard[0] == (
        struct.pack("<IB3x8s", 0x2000_0204, 8, bytes([0, 32, 0, 0, 0, 0, 128, 0])),
        False,
    )
    assert heard[1:] == [(struct.pack("<IB3x8s", 0x2000_0000, 8, b""), False)] * 3


def test_send_without_listeners_works(runtime, bus, peer):
    runtime.send(bus, FRAME)
    assert peer.recv(LATE_S).arbitration_id == 0x123


def test_listeners_are_called_in_order_until_cancelled(runtime, bus, peer):
    heard = []
    first = runtime.listen(bus, lambda frame, time_ns, own: heard.append("first"))
    runtime.listen(bus, lambda frame, time_ns, own: heard.append("second"))
    peer.send(can.Message(arbitration_id=1))
    assert runtime.wait_until(lambda: len(heard) == 2, LATE_S)
    first.cancel()
    first.cancel()
    peer.send(can.Message(arbitration_id=1))
    assert runtime.wait_until(lambda: len(heard) == 3, LATE_S)
    assert heard == ["first", "second", "second"]


def test_frame_sent_from_a_callback_is_reported_after_it(runtime, bus, peer):
    order = []

    def answer(frame, time_ns, own):
        order.append(("begin", own))
        if not own:
            runtime.send(bus, FRAME)
        order.append(("end", own))

    runtime.listen(bus, answer)
    peer.send(can.Message(arbitration_id=1))
    assert runtime.wait_until(lambda: len(order) == 4, LATE_S)
    assert order == [("begin", False), ("end", False), ("begin", True), ("end", True)]


def test_callbacks_and_conditions_run_one_at_a_time(runtime, bus, peer):
    inside = []
    overlaps = []
    heard = []

    def alone(*_):
        inside.append(1)
        if len(inside) > 1:
            overlaps.append(1)
        work(runtime, 0.0005)
        heard.append(1)
        inside.pop()

    runtime.listen(bus, alone)
    runtime.every(0.001, alone)
    sender = runtime.spawn(
        "sender", lambda: [peer.send(can.Message(arbitration_id=k)) for k in range(50)] and None
    )

    def enough():
        alone()
        return len(heard) > 120

    assert runtime.wait_until(enough, LATE_S)
    assert sender.join(LATE_S)
    assert overlaps == []


@pytest.mark.parametrize("kind", ["timer", "listener", "done"])
def test_wait_inside_a_callback_raises_with_advice(runtime, bus, peer, kind):
    errors = []

    def wait_here(*_):
        try:
            runtime.wait_until(lambda: True, 1.0)
        except UsageError as error:
            errors.append(str(error))
        return True

    if kind == "timer":
        runtime.every(0.001, wait_here)
    elif kind == "listener":
        runtime.listen(bus, wait_here)
        peer.send(can.Message(arbitration_id=1))
    else:
        runtime.wait_until(wait_here)
    assert runtime.wait_until(lambda: bool(errors), LATE_S)
    assert "inside a callback" in errors[0]
    assert "runtime.spawn" in errors[0]


def test_callback_exception_reaches_a_waiter(runtime, bus, peer):
    def broken(*_):
        raise ZeroDivisionError("in a callback")

    listener = runtime.listen(bus, broken)
    peer.send(can.Message(arbitration_id=1))
    with pytest.raises(ZeroDivisionError, match="in a callback"):
        runtime.wait_until(lambda: False, LATE_S)
    listener.cancel()
    assert not runtime.wait_until(lambda: False, 0.0)  # reported once


def test_unseen_exception_is_raised_at_close(bus, peer):
    runtime = WallRuntime()
    seen = threading.Event()

    def broken(*_):
        seen.set()
        raise ZeroDivisionError("in a callback")

    runtime.listen(bus, broken)
    peer.send(can.Message(arbitration_id=1))
    assert seen.wait(LATE_S)
    with pytest.raises(ZeroDivisionError):
        runtime.close()
    runtime.close()


def test_broken_bus_is_reported_to_waiters_and_senders(runtime):
    bus = can.Bus(interface="virtual", channel="wall-broken")
    runtime.listen(bus, lambda *_: None)
    closer = iter([False, False, True])

    def close_the_second_time():
        if next(closer, False):
            bus.shutdown()
        return False

    with pytest.raises(LinkError, match="cannot receive"):
        runtime.wait_until(close_the_second_time, LATE_S)
    with pytest.raises(LinkError, match="cannot send"):
        runtime.send(bus, FRAME)


def test_bus_closed_by_its_user_reports_nothing_later(runtime):
    bus = can.Bus(interface="virtual", channel="wall-closed")
    runtime.listen(bus, lambda *_: None)
    bus.shutdown()
    threads = [thread for thread in threading.enumerate() if "wall-closed" in thread.name]
    for thread in threads:
        thread.join(LATE_S)
    assert not runtime.wait_until(lambda: False, 0.0)


def test_bus_object_has_one_reader(runtime, bus):
    with can.Notifier(bus, []), pytest.raises(UsageError, match="Notifier"):
        runtime.listen(bus, lambda *_: None)
    runtime.listen(bus, lambda *_: None)


def test_bus_with_its_own_runtime_raises(runtime, bus):
    bus.runtime = runtime
    with pytest.raises(UsageError, match="runtime_of"):
        WallRuntime().listen(bus, lambda *_: None)


def test_all_real_buses_of_a_process_share_one_runtime(bus, peer):
    shared = runtime_of(bus)
    assert shared is runtime_of(peer) is process_runtime()
    bus.runtime = mine = WallRuntime()
    assert runtime_of(bus) is mine
    mine.close()
    close_process_runtime()
    again = process_runtime()
    assert again is not shared
    close_process_runtime()
