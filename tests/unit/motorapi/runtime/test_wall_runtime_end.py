"""End of the wall runtime: parties, their exceptions, and late frames."""

import os
import struct
import threading

import pytest

from motorhil.motorapi import DeadlineExceeded, UsageError, WallRuntime
from motorhil.motorapi.runtime.wall import process_runtime

pytestmark = pytest.mark.wall

# Linux struct can_frame (include/uapi/linux/can.h), written by hand.
FRAME = struct.pack("<IB3x8s", 0x123, 3, b"\x01\x02\x03")
EXTENDED = struct.pack("<IB3x8s", 0x8000_0000 | 0x1ABCDEF0, 0, b"")
REMOTE = struct.pack("<IB3x8s", 0x4000_0000 | 0x701, 4, b"")
LATE_S = 10.0


def test_party_exception_is_kept_for_join_or_raised_at_close():
    runtime = WallRuntime()

    def fail():
        raise ZeroDivisionError("in a party")

    joined = runtime.spawn("joined", fail)
    assert joined.join(LATE_S)
    assert isinstance(joined.error, ZeroDivisionError)
    runtime.close()
    runtime = WallRuntime()
    alone = runtime.spawn("alone", fail)
    assert runtime.wait_until(lambda: alone.finished, LATE_S)
    with pytest.raises(ZeroDivisionError):
        runtime.close()


def test_close_ends_waiting_parties_and_refuses_further_use():
    before = set(threading.enumerate())
    runtime = WallRuntime()
    ends = []

    def forever():
        try:
            runtime.wait_until(lambda: False)
        finally:
            ends.append("ended")

    party = runtime.spawn("waiter", forever)
    runtime.every(1000.0, lambda: None)
    runtime.close()
    runtime.close()
    assert ends == ["ended"]
    assert party.error is None
    assert set(threading.enumerate()) <= before
    for refused in (
        lambda: runtime.wait_until(lambda: True),
        lambda: runtime.every(1.0, lambda: None),
        lambda: runtime.spawn("late", lambda: None),
    ):
        with pytest.raises(UsageError, match="closed"):
            refused()


def test_frame_received_during_close_is_discarded():
    runtime = WallRuntime()

    class LateBus:
        channel_info = "late"
        channel = "late"

        def receive_frame(self, timeout_s):
            reading.set()
            try:
                while True:
                    runtime.every(1000.0, lambda: None).cancel()
            except UsageError:  # it is closed by now
                return FRAME, 0, False

        def transmit(self, frame):
            pass

    heard = []
    reading = threading.Event()
    runtime.listen(LateBus(), lambda *frame: heard.append(frame))
    assert runtime.wait_until(reading.is_set, LATE_S)
    runtime.close()
    assert heard == []


def test_party_that_never_ends_is_named(monkeypatch):
    monkeypatch.setattr("motorhil.motorapi.runtime.wall._CLOSE_S", 0.05)
    runtime = WallRuntime()
    go_on = threading.Event()
    runtime.spawn("stubborn", lambda: go_on.wait(LATE_S) and None)
    with pytest.raises(DeadlineExceeded, match="stubborn"):
        runtime.close()
    go_on.set()
    runtime.close()


def test_forked_child_cannot_use_the_parent_runtime():
    parents = process_runtime()
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        told = []
        for use in (lambda: parents.wait_until(lambda: True), lambda: parents.send(None, b"")):
            try:
                use()
            except UsageError as error:
                told.append(str(error))
        told.append(str(process_runtime().wait_until(lambda: True)))
        os.write(theirs, "|".join(told).encode())
        os._exit(0)
    os.waitpid(child, 0)
    *refused, own = os.read(ours, 10_000).decode().split("|")
    os.close(ours)
    os.close(theirs)
    assert len(refused) == 2
    assert all("created in the parent process" in told and "'spawn'" in told for told in refused)
    assert own == "True"
    assert parents.wait_until(lambda: True)
