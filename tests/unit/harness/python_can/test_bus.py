from contextlib import ExitStack

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.python_can.bus import close_rig, open_rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from tests.unit.emulators.simulation.test_world import Echo

MS = 1_000_000


@pytest.fixture
def rig():
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0"))
    world.add_bus(CanBus("can1"))
    world.add_controller("echo", Echo(0x180), "can0")
    runtime = VirtualRuntime(queue)
    open_rig(world, runtime)
    yield runtime
    close_rig(world)
    runtime.close()


def emulated(channel="can0", **options):
    return can.Bus(interface="emulated", channel=channel, **options)


def message(can_id, data=b"", **options):
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **options})


def test_python_can_finds_the_interface_by_entry_point():
    assert "emulated" in can.VALID_INTERFACES


def test_answer_arrives_in_the_rigs_time(rig):
    with emulated() as bus:
        bus.send(message(0x100, b"\x05"))
        answer = bus.recv(1.0)
    assert (answer.arbitration_id, bytes(answer.data), answer.channel) == (0x180, b"\x05", "can0")
    assert answer.timestamp == rig.now_ns() / 1e9
    assert 1 * MS < rig.now_ns() < 2 * MS


@pytest.mark.parametrize("interface", ["emulated", "virtual"])
@pytest.mark.parametrize("own", [True, False])
def test_messages_have_the_channel_of_the_bus_object(rig, interface, own):
    """python-can's `virtual` is the reference for both directions."""

    class Name(str):
        """A channel that is equal to, but not the same as, the name of a bus."""

        __slots__ = ()

    channel = Name("can1")
    options = {"interface": interface, "channel": channel}
    with can.Bus(**options, receive_own_messages=own) as bus, can.Bus(**options) as other:
        (bus if own else other).send(message(0x123))
        heard = bus.recv(1.0)
    assert heard.channel is channel
    assert heard.is_rx is not own


def test_recv_timeout_is_exact_in_the_rigs_time(rig):
    with emulated() as bus:
        assert bus.recv(0.1) is None
        assert rig.now_ns() == 100 * MS
        assert bus.recv(0) is None
        assert rig.now_ns() == 100 * MS


def test_filtered_frames_do_not_prolong_recv_timeout(rig):
    with emulated(can_filters=[{"can_id": 0x180, "can_mask": 0x7FF}]) as bus, emulated() as other:
        other.send_periodic(message(0x123), 0.001)
        assert bus.recv(0.0105) is None
        assert rig.now_ns() == 10_500_000


def test_two_programs_hear_each_other_but_not_themselves(rig):
    with emulated() as one, emulated() as two, emulated("can1") as elsewhere:
        one.send(message(0x321, b"\x01\x02"))
        assert two.recv(0.01).arbitration_id == 0x321
        assert one.recv(0.01) is None
        assert elsewhere.recv(0.01) is None


def test_own_frames_on_request_arrive_when_transmitted(rig):
    with emulated(receive_own_messages=True) as bus:
        bus.send(message(0x321))
        echo = bus.recv(0.01)
    assert (echo.arbitration_id, echo.is_rx) == (0x321, False)
    assert echo.timestamp > 0.0


@pytest.mark.parametrize(
    "sent",
    [
        message(0x7FF, bytes(range(8))),
        message(0x000),
        message(0x1FFFFFFF, b"\x01", is_extended_id=True),
        message(0x123, is_extended_id=True),
        message(0x123, is_remote_frame=True, dlc=5),
    ],
    ids=str,
)
def test_classical_frame_of_every_kind_arrives_unchanged(rig, sent):
    with emulated() as one, emulated() as two:
        one.send(sent)
        heard = two.recv(0.01)
    assert heard.equals(sent, timestamp_delta=None, check_channel=False)


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (message(0x123, bytes(12), is_fd=True), "CAN FD"),
        (message(0x800), "11 bits"),
        (message(0x123, bytes(9), dlc=9), "holds at most 8"),
        (message(0x123, is_remote_frame=True, dlc=9), "requests at most 8"),
        (message(1 << 29, is_extended_id=True), "29 bits"),
        (message(-1), "29 bits"),
        (message(0x20, bytes(8), is_error_frame=True), "error frame"),
    ],
)
def test_invalid_classical_frame_is_refused_with_reason(rig, sent, reason):
    with emulated() as bus, pytest.raises(can.CanOperationError, match=reason):
        bus.send(sent)


def test_periodic_messages_keep_the_rigs_time_and_stop(rig):
    with emulated() as one, emulated() as two:
        task = one.send_periodic([message(0x80, b"a"), message(0x80, b"b")], 0.01, duration=0.045)
        heard = []
        while (got := two.recv(0.1)) is not None:
            heard.append((round(got.timestamp, 3), bytes(got.data)))
        assert heard == [(0.0, b"a"), (0.01, b"b"), (0.02, b"a"), (0.03, b"b"), (0.04, b"a")]
        task.start()
        assert two.recv(0.02) is not None
        task.stop()
        assert two.recv(0.02) is None


def test_unknown_bus_is_refused_with_known_names(rig):
    with pytest.raises(can.CanInitializationError, match=r"'can7'.*open: can0, can1"):
        emulated("can7")


def test_two_rigs_with_one_bus_name_cannot_both_be_open(rig):
    world = World(EventQueue())
    world.add_bus(CanBus("can0"))
    with pytest.raises(can.CanInitializationError, match="close that rig first"):
        open_rig(world, rig)


def test_closed_bus_object_refuses_every_use(rig):
    bus = emulated()
    bus.shutdown()
    bus.shutdown()
    for use in (
        lambda: bus.send(message(0x100)),
        lambda: bus.recv(0.1),
        lambda: bus.send_periodic(message(0x100), 0.1),
        lambda: rig.listen(bus, lambda *_: None),
        lambda: rig.send(bus, bytes(16)),
    ):
        with pytest.raises(can.CanOperationError, match="can0: this bus object was shut down"):
            use()
    assert rig.now_ns() == 0


def test_listener_hears_own_frames_when_transmitted(rig):
    heard = []
    with emulated() as bus:
        registration = rig.listen(bus, lambda frame, t, own: heard.append((frame[:2], own)))
        bus.send(message(0x100))
        rig.run_for(0.01)
        registration.cancel()
        bus.send(message(0x100))
        rig.run_for(0.01)
    assert heard == [(b"\x00\x01", True), (b"\x80\x01", False)]


def test_unread_bus_drops_oldest_frames_and_counts_them(rig, monkeypatch):
    monkeypatch.setattr("motorhil.harness.python_can.bus._BACKLOG_MAX", 3)
    with emulated() as one, emulated() as two:
        for number in range(5):
            one.send(message(0x200 + number))
        rig.run_for(0.01)
        assert two.dropped == 2
        assert two.recv(0.0).arbitration_id == 0x202


@pytest.mark.pure("a constant of compiled cores cannot be replaced")
def test_bus_without_a_free_port_refuses_as_python_can_does(rig, monkeypatch):
    monkeypatch.setattr("motorhil.emulators.can.bus.bus.PORT_MASK", 3)
    with ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(emulated())
        with pytest.raises(can.CanInitializationError, match="limit is 4"):
            emulated()


def test_frames_that_wait_without_end_are_refused(rig, monkeypatch):
    """A loop that only sends let them grow until no memory was left."""
    monkeypatch.setattr("motorhil.harness.python_can.send_limit._WAITING_MAX", 3_000)
    with emulated() as bus:
        for _ in range(3_071):
            bus.send(message(0x100))
        with pytest.raises(can.CanOperationError, match=r"can0: 3072 frames wait; .* at most 3000"):
            bus.send(message(0x100))
        rig.run_for(2.0)
        for _ in range(3_071):
            rig.send(bus, bytes(16))
        with pytest.raises(can.CanOperationError, match=r"can0: 3072 frames wait"):
            rig.send(bus, bytes(16))
