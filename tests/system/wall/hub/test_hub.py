import contextlib
import os
import socket
import threading
import time
from pathlib import Path

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.gateways.hub import HubError, HubServer
from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.python_can.hub_client import HubLink
from tests.unit.emulators.simulation.test_world import Echo

pytestmark = pytest.mark.wall


@contextlib.contextmanager
def serving(path, *controllers):
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 1_000_000))
    world.add_bus(CanBus("can1", 500_000))
    for number, controller in enumerate(controllers):
        world.add_controller(f"c{number}", controller, "can0")
    loop = WallLoop(queue)
    hub = HubServer(path, world)
    loop.add(hub)
    stop = threading.Event()
    thread = threading.Thread(target=loop.run, args=(stop.is_set,))
    thread.start()
    try:
        yield world
    finally:
        stop.set()
        thread.join()
        loop.close()


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / "hub")


def message(can_id, data=b""):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def test_program_talks_to_a_controller_in_another_loop(path):
    with serving(path, Echo(0x180)), can.Bus(interface="emulated", channel=path) as bus:
        bus.send(message(0x100, b"\x2a"))
        answer = bus.recv(30.0)
    assert (answer.arbitration_id, bytes(answer.data), answer.is_rx) == (0x180, b"\x2a", True)


@pytest.mark.parametrize("spelling", [str, Path, "{}#can0".format])
def test_messages_have_the_channel_of_the_bus_object(path, spelling):
    channel = spelling(path)
    with (
        serving(path, Echo(0x180)),
        can.Bus(interface="emulated", channel=channel, receive_own_messages=True) as bus,
    ):
        bus.send(message(0x100))
        own, answer = bus.recv(30.0), bus.recv(30.0)
    assert (own.is_rx, answer.is_rx) == (False, True)
    assert own.channel is answer.channel is channel


def test_all_clients_receive_all_frames_in_one_order(path):
    count = 3000
    with (
        serving(path),
        can.Bus(interface="emulated", channel=path) as one,
        can.Bus(interface="emulated", channel=path) as two,
        can.Bus(interface="emulated", channel=path + "#can0") as witness,
    ):
        for number in range(count):
            one.send(message(0x101, number.to_bytes(2, "big")))
            two.send(message(0x102, number.to_bytes(2, "big")))
        heard = [witness.recv(30.0) for _ in range(2 * count)]
        two_heard = [two.recv(30.0) for _ in range(count)]
    for sender in (0x101, 0x102):
        numbers = [int.from_bytes(m.data, "big") for m in heard if m.arbitration_id == sender]
        assert numbers == list(range(count))
    assert [bytes(m.data) for m in two_heard] == [
        bytes(m.data) for m in heard if m.arbitration_id == 0x101
    ]


def test_own_frames_return_when_transmitted_if_requested(path):
    with (
        serving(path),
        can.Bus(interface="emulated", channel=path, receive_own_messages=True) as own,
        can.Bus(interface="emulated", channel=path) as other,
    ):
        own.send(message(0x123))
        echo, heard = own.recv(30.0), other.recv(30.0)
    assert (echo.is_rx, heard.is_rx) == (False, True)
    assert echo.timestamp == heard.timestamp
    assert heard.timestamp == pytest.approx(time.time(), abs=60.0)  # absolute, as of SocketCAN


def test_two_buses_of_a_hub_are_separate(path):
    with (
        serving(path),
        can.Bus(interface="emulated", channel=path) as first,
        can.Bus(interface="emulated", channel=path + "#can1") as second,
    ):
        first.send(message(0x123))
        assert second.recv(0.2) is None


def test_unknown_bus_is_refused_naming_the_known_ones(path):
    with (
        serving(path),
        pytest.raises(can.CanInitializationError, match=r"bus 'can9': not found.*can1"),
    ):
        can.Bus(interface="emulated", channel=path + "#can9")


def test_client_of_another_protocol_is_refused_in_words(path):
    with serving(path), socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(path)
        stranger.send(b"\x01hello")
        assert stranger.recv(500).startswith(b"refused this is motorhil's hub")


def test_missing_hub_error_says_how_to_start_one(path):
    with pytest.raises(can.CanInitializationError, match="motorhil serve"):
        can.Bus(interface="emulated", channel=path)


def test_lost_hub_raises_an_error(path):
    with serving(path):
        bus = can.Bus(interface="emulated", channel=path)
    with bus, pytest.raises(can.CanOperationError, match="closed the connection"):
        bus.recv(30.0)


def test_bus_is_marked_shut_down_before_its_connection_ends(path, monkeypatch):
    known = []
    with serving(path):
        bus = can.Bus(interface="emulated", channel=path)
        close = HubLink.close
        monkeypatch.setattr(
            HubLink, "close", lambda link: (known.append(bus._is_shutdown), close(link))
        )
        bus.shutdown()
    assert known == [True]


def test_used_path_is_refused_and_a_dead_hubs_path_reused(path):
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0"))
    with serving(path), pytest.raises(HubError, match="in use by a running hub"):
        HubServer(path, world)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as killed:
        killed.bind(path)
    HubServer(path, world).close()


def test_regular_file_at_the_path_is_kept(tmp_path):
    world = World(EventQueue())
    world.add_bus(CanBus("can0"))
    file = tmp_path / "precious"
    file.write_text("keep")
    with pytest.raises(HubError, match="not a socket"):
        HubServer(file, world)
    assert file.read_text() == "keep"


def test_path_too_long_is_refused_with_the_limit(tmp_path):
    world = World(EventQueue())
    world.add_bus(CanBus("can0"))
    with pytest.raises(HubError, match="107 bytes"):
        HubServer(tmp_path / ("x" * 120), world)


NO_FRAMES = {
    "an error message": b"\x00\x00\x00\x20\x08".ljust(16, b"\x00"),
    "more bytes than eight": b"\x01\x00\x00\x00\x40".ljust(16, b"\x00"),
    "more than 11 bits": b"\x00\x08\x00\x00\x00".ljust(16, b"\x00"),
}


@pytest.mark.parametrize("frame", NO_FRAMES.values(), ids=NO_FRAMES)
def test_invalid_frame_is_refused_and_other_clients_stay(path, frame):
    with serving(path, Echo(0x180)), can.Bus(interface="emulated", channel=path) as bus:
        with can.Bus(interface="emulated", channel=path) as broken:
            broken.transmit(frame)
            with pytest.raises(can.CanOperationError, match=f"{path}: frame {frame.hex()}: "):
                broken.recv(30.0)
        bus.send(message(0x100, b"\x2a"))
        assert bytes(bus.recv(30.0).data) == b"\x2a"


def test_client_beyond_the_maximum_is_refused(path, monkeypatch):
    monkeypatch.setattr("motorhil.emulators.gateways.hub.CLIENTS_MAX", 2)
    with (
        serving(path, Echo(0x180)),
        can.Bus(interface="emulated", channel=path) as bus,
        can.Bus(interface="emulated", channel=path),
    ):
        with pytest.raises(can.CanInitializationError, match="too many programs; the limit is 2"):
            can.Bus(interface="emulated", channel=path)
        bus.send(message(0x100, b"\x2a"))
        assert bytes(bus.recv(30.0).data) == b"\x2a"


def test_client_that_only_sends_waits_for_the_bus(path):
    with (
        serving(path) as world,
        can.Bus(interface="emulated", channel=path) as greedy,
        can.Bus(interface="emulated", channel=path) as witness,
    ):
        port = 0
        most = 0
        for number in range(4000):
            greedy.send(message(0x100, number.to_bytes(2, "little")))
            most = max(most, world.bus("can0").pending(port))
        heard = [witness.recv(30.0) for _ in range(4000)]
    assert [int.from_bytes(one.data, "little") for one in heard] == list(range(4000))
    assert 0 < most <= 1024


def test_paused_hub_ends_the_wait_of_a_sender(path, monkeypatch):
    monkeypatch.setattr("motorhil.harness.python_can.hub_client.SEND_TIMEOUT_S", 0.05)
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 1_000_000))
    loop = WallLoop(queue)
    loop.add(HubServer(path, world))
    stop = threading.Event()
    thread = threading.Thread(target=loop.run, args=(stop.is_set,))
    thread.start()
    with contextlib.closing(loop), can.Bus(interface="emulated", channel=path) as bus:
        stop.set()
        thread.join()
        with pytest.raises(can.CanOperationError, match=r"read nothing for 0\.05 s"):
            flood(bus)


def flood(bus):
    for _ in range(100_000):
        bus.send(message(0x100))


def test_path_that_looks_like_path_and_bus_is_refused(tmp_path):
    world = World(EventQueue())
    world.add_bus(CanBus("can0"))
    with pytest.raises(HubError, match=r"a#b.*'#'"):
        HubServer(tmp_path / "a#b", world)
    assert not list(tmp_path.iterdir())


def test_hub_removes_only_its_own_socket(path):
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0"))
    first = HubServer(path, world)
    os.unlink(path)  # removed from outside
    second = HubServer(path, world)
    first.close()
    assert os.path.exists(path)
    second.close()
    assert not os.path.exists(path)
