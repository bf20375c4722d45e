"""Node guarding and life guarding (CiA 301, 7.2.8.2.1): toggle bit and losses."""

import pytest

from motorhil.emulators.canopen.nmt import NmtState
from tests.support.canopen.node_bench import (
    MS,
    NODE_ID,
    UNSIGNED8,
    UNSIGNED16,
    Bench,
    dictionary,
    put,
)

GUARD = 0x4000_0700 + NODE_ID  # the remote frame, as Linux has it


def guarded(guard_ms=0, factor=0, heartbeat_ms=0, reaction=0):
    od = dictionary()
    put(od, 0x100C, 0, UNSIGNED16, guard_ms)
    put(od, 0x100D, 0, UNSIGNED8, factor)
    od.get(0x1017).set_default(heartbeat_ms)
    od.get(0x1029, 1).set_default(reaction)
    return Bench(od).operate()


def ask(bench):
    bench.tell(GUARD)
    return [text for text in bench.frames() if text.startswith("702")]


def test_guard_response_has_state_and_alternating_toggle_bit():
    bench = guarded()
    assert [ask(bench) for _ in range(3)] == [["702 05"], ["702 85"], ["702 05"]]
    bench.tell(0x000, b"\x02\x00")  # stopped
    assert ask(bench) == ["702 84"]
    bench.tell(0x000, b"\x80\x00")  # pre-operational
    assert ask(bench) == ["702 7F"]


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_first_response_after_reset_has_toggle_bit_0(command):
    bench = guarded()
    assert ask(bench) == ["702 05"]
    bench.tell(0x000, bytes((command, 0)))
    assert ask(bench) == []  # initialising
    bench.wait(300 * MS)
    assert "702 00" in bench.frames()
    assert ask(bench) == ["702 7F"]


def test_node_with_heartbeat_is_not_guarded():
    """A node may not use both at the same time."""
    bench = guarded(heartbeat_ms=1000)
    assert ask(bench) == []
    assert bench.download(0x1017, 0, 0, 2) == ""
    assert ask(bench) == ["702 05"]


def test_master_is_not_missed_before_first_request():
    bench = guarded(guard_ms=100, factor=3)
    assert bench.node.next_deadline_ns() is None
    ask(bench)
    assert bench.node.next_deadline_ns() == bench.now_ns + 300 * MS


@pytest.mark.parametrize(("guard_ms", "factor"), [(0, 3), (100, 0)])
def test_life_guarding_needs_time_and_factor(guard_ms, factor):
    bench = guarded(guard_ms, factor)
    ask(bench)
    assert bench.node.next_deadline_ns() is None


def test_life_guarding_expires_one_nanosecond_late():
    """EMCY 8130h "life guard error or heartbeat error", once; 1029h:1 = 0: pre-operational."""
    bench = guarded(guard_ms=100, factor=3)
    begun_ns = bench.now_ns
    ask(bench)
    bench.run(begun_ns + 300 * MS - 1)
    assert ask(bench) == ["702 85"]
    bench.run(begun_ns + 600 * MS - 2)
    assert bench.node.state == NmtState.OPERATIONAL
    assert bench.frames() == []
    bench.run(begun_ns + 600 * MS - 1)
    assert bench.frames() == ["082 30 81 11 00 00 00 00 00"]
    assert bench.node.state == NmtState.PRE_OPERATIONAL
    assert ("lost", 0) in [call[:2] for call in bench.host.calls]
    bench.wait(5_000 * MS)
    assert bench.frames() == []
    bench.tell(GUARD)
    assert bench.frames() == ["702 7F", "082 00 00 00 00 00 00 00 00"]  # the master is back
    assert bench.node.next_deadline_ns() == bench.now_ns + 300 * MS


@pytest.mark.parametrize(
    ("reaction", "state"),
    [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)],
)
def test_guarding_loss_follows_1029h(reaction, state):
    bench = guarded(guard_ms=10, factor=1, reaction=reaction)
    ask(bench)
    bench.wait(10 * MS)
    assert bench.node.state == state


def test_guarding_times_may_be_written_while_active():
    bench = guarded(guard_ms=100, factor=3)
    ask(bench)
    assert bench.download(0x100D, 0, 1, 1) == ""
    assert bench.node.next_deadline_ns() <= bench.now_ns + 100 * MS
    assert bench.download(0x100C, 0, 0, 2) == ""
    assert bench.node.next_deadline_ns() is None
