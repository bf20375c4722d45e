"""The host's end of a bus: confirmation, SYNC, heartbeats, dispatch."""

import gc
import weakref

import pytest

from motorhil.motorapi.adaptations.canopen.bus import CanopenBus, open_bus, release_bus
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import LinkError, UsageError
from motorhil.motorapi.runtime.can_link import CanLink, can_frame
from motorhil.motorapi.synchronization.bus_load import CanTraffic, declare_traffic
from tests.support.motors.scripted import FRAME_NS, MS, ScriptedBus, frame, text_of


def link_on(bus: ScriptedBus) -> CanLink:
    return CanLink(bus, bus.runtime)


def test_can_frame_equals_linux_struct():
    # linux/can.h: can_id u32, len u8, 3 bytes of padding and reserve, data[8]
    assert can_frame(0x201, b"\x0f\x00").hex() == "01020000020000000f00000000000000"


def test_tracked_frame_has_its_time_on_the_wire():
    bus = ScriptedBus()
    link = link_on(bus)
    sent = link.send_tracked(frame("301#0F0001000000"))
    assert sent.time_ns is None
    link.confirmed([sent])
    assert sent.time_ns == bus.runtime.now_ns() == FRAME_NS


def test_equal_frames_are_confirmed_in_order():
    bus = ScriptedBus()
    link = link_on(bus)
    first, second = (link.send_tracked(frame("301#0F00")) for _ in range(2))
    link.confirmed([first])
    link.confirmed([second])
    assert first.time_ns is not None


def test_frames_before_a_confirmed_one_count_as_unsent():
    bus = ScriptedBus(confirms=False)
    link = link_on(bus)
    first, second = (link.send_tracked(frame(f"301#0F0{place}")) for place in (1, 2))
    bus.confirm("301#0F02")
    link.confirmed([second])
    assert first.time_ns is None
    bus.confirm("301#0F01")  # it is no longer awaited
    bus.runtime.run_for(0.01)
    assert first.time_ns is None


def test_untransmitted_frame_raises_an_error_naming_it():
    bus = ScriptedBus(confirms=False)
    link = link_on(bus)
    with pytest.raises(
        LinkError, match=r"301h\) were not transmitted within 0.5 s; this bus never"
    ):
        link.confirmed([link.send_tracked(frame("301#0F00"))])


def test_frames_are_dispatched_by_identifier():
    bus = ScriptedBus()
    link = link_on(bus)
    heard: list[tuple[str, int]] = []
    link.handle(0x181, lambda data, time_ns: heard.append((text_of(data), time_ns)))
    bus.deliver("181#3706", 5 * MS)
    bus.deliver("182#3706", 6 * MS)
    bus.runtime.run_for(0.01)
    assert heard == [("181#3706", 5 * MS)]
    link.ignore(0x181)
    bus.deliver("181#3706")
    bus.runtime.run_for(0.01)
    assert len(heard) == 1


def test_other_identifiers_reach_the_canopen_network():
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    heard: list[bytes] = []
    canopen.network.subscribe(0x193, lambda can_id, data, time_s: heard.append(bytes(data)))
    bus.deliver("193#0102")
    bus.runtime.run_for(0.01)
    assert heard == [b"\x01\x02"]
    canopen.network.send_message(0x613, b"\x40")
    assert bus.texts == ["613#40"]


def test_host_heartbeat_is_sent_at_once_and_cyclically():
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    canopen.produce_heartbeat(127, 100)
    canopen.produce_heartbeat(127, 100)  # a second drive needs it too
    bus.runtime.run_for(0.25)
    assert bus.sent == [(0, "77F#05"), (100 * MS, "77F#05"), (200 * MS, "77F#05")]
    canopen.release_heartbeat(127)
    bus.runtime.run_for(0.1)
    assert len(bus.sent) == 4
    canopen.release_heartbeat(127)
    bus.runtime.run_for(1.0)
    assert len(bus.sent) == 4


def test_failed_heartbeat_is_reported_once_until_recovery(monkeypatch):
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    canopen.produce_heartbeat(127, 100)
    tried = []

    def refuse(frame):
        tried.append(frame)
        raise LinkError(link="can0", reason="cannot send")

    for _ in range(2):
        monkeypatch.setattr(bus, "transmit", refuse)
        with pytest.raises(LinkError, match="cannot send"):
            bus.runtime.run_for(0.15)
        tried.clear()
        bus.runtime.run_for(1.0)  # it retries without further reports
        assert len(tried) == 10
        monkeypatch.undo()
        bus.runtime.run_for(0.2)


def test_second_host_heartbeat_period_is_refused():
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    canopen.produce_heartbeat(127, 100)
    with pytest.raises(UsageError, match="heartbeat of 100 ms already, so not of 50 ms"):
        canopen.produce_heartbeat(127, 50)


def test_cyclic_sync_is_shared_and_ends_with_its_last_user():
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    turns: list[str] = []
    one = canopen.sync.join(0.01, lambda: turns.append("one"))
    two = canopen.sync.join(0.01, lambda: turns.append("two"))
    with pytest.raises(UsageError, match="SYNC runs every 10 ms already, so not every 20 ms"):
        canopen.sync.join(0.02, lambda: None)
    bus.runtime.run_for(0.0251)
    assert bus.sent == [(10 * MS, "080#"), (20 * MS, "080#")]
    assert turns == ["one", "two", "one", "two"]
    one.cancel()
    two.cancel()
    bus.runtime.run_for(0.1)
    assert len(bus.sent) == 2


@pytest.mark.parametrize("own", [True, False])
def test_at_next_sync_reports_its_time_for_any_sender(own: bool):
    bus = ScriptedBus()
    canopen = CanopenBus(bus, bus.runtime)
    told: list[int] = []
    canopen.sync.at_next(told.append)
    if own:
        canopen.sync.send()
    else:
        bus.deliver("080#", FRAME_NS)
    bus.runtime.run_for(0.01)
    assert told == [FRAME_NS]
    canopen.sync.send()
    bus.runtime.run_for(0.01)
    assert told == [FRAME_NS]  # the next one only


def test_link_of_a_bus_is_shared_until_its_last_release():
    bus = ScriptedBus()
    canopen = open_bus(bus, bus.runtime)
    assert open_bus(bus, bus.runtime) is canopen
    canopen.produce_heartbeat(127, 100)
    release_bus(canopen)
    assert open_bus(bus, bus.runtime) is canopen
    release_bus(canopen)
    release_bus(canopen)
    sent = len(bus.sent)
    bus.runtime.run_for(1.0)
    assert len(bus.sent) == sent  # nothing is active
    other = open_bus(bus, bus.runtime)
    assert other is not canopen
    release_bus(other)


def test_bus_that_is_gone_leaves_nothing():
    bus = ScriptedBus()
    release_bus(open_bus(bus, bus.runtime))
    declare_traffic(bus, CanTraffic(1_000_000))
    kept = [weakref.ref(bus), weakref.ref(context_of(bus))]
    del bus
    gc.collect()
    assert [one() for one in kept] == [None, None]
