import os
import pty
import socket

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.gateways.hub import HubServer
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import (
    bus_name,
    hub_name,
    serial_name,
    socketcan_name,
    tcp_name,
)


def test_serial_line_has_one_name_for_all_links(tmp_path):
    ours, theirs = pty.openpty()
    try:
        line = os.ttyname(theirs)
        (tmp_path / "by-id").mkdir()
        (tmp_path / "by-id" / "usb-drive").symlink_to(line)
        (tmp_path / "drive").symlink_to(tmp_path / "by-id" / "usb-drive")
        names = {
            serial_name(str(path))
            for path in (line, tmp_path / "drive", tmp_path / "by-id" / "usb-drive")
        }
    finally:
        os.close(ours)
        os.close(theirs)
    number = line.rpartition("/")[2]
    assert names == {f"serial-136-{number}"}  # devices.txt of Linux: 136 is UNIX98 PTY slaves


def test_path_that_is_not_a_serial_line_raises(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="not a serial line, but a file"):
        serial_name(str(tmp_path / "file"))
    with pytest.raises(UsageError, match="No such file"):
        serial_name(str(tmp_path / "none"))


def test_hub_bus_has_one_name_for_all_paths(tmp_path):
    (tmp_path / "here").mkdir()
    with socket.socket(socket.AF_UNIX) as one, socket.socket(socket.AF_UNIX) as two:
        one.bind(str(tmp_path / "here" / "hub"))
        two.bind(str(tmp_path / "other"))
        (tmp_path / "link").symlink_to(tmp_path / "here")
        straight = hub_name(str(tmp_path / "here" / "hub"), "can0")
        assert hub_name(str(tmp_path / "link" / ".." / "here" / "hub"), "can0") == straight
        assert hub_name(str(tmp_path / "link" / "hub"), "can0") == straight
        assert hub_name(str(tmp_path / "here" / "hub"), "can1") != straight
        assert hub_name(str(tmp_path / "other"), "can0") != straight


def test_network_interface_name_is_index_and_namespace():
    name, index = "lo", socket.if_nametoindex("lo")
    namespace = os.stat("/proc/self/ns/net").st_ino
    assert socketcan_name(name) == f"can-if{index}-net{namespace}"
    with pytest.raises(UsageError, match="no-such-if0: no such network interface"):
        socketcan_name("no-such-if0")


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("localhost", "tcp-127.0.0.1-502"),
        ("127.0.0.1", "tcp-127.0.0.1-502"),
        ("::1", "tcp-127.0.0.1-502"),
        ("::ffff:10.0.0.7", "tcp-10.0.0.7-502"),
        ("10.0.0.7", "tcp-10.0.0.7-502"),
        ("Drive.Local.", "tcp-drive.local-502"),
        ("fe80::1", "tcp-fe80::1-502"),
    ],
)
def test_tcp_server_name_is_its_address(host, name):
    assert tcp_name(host, 502) == name


def test_bus_of_a_rig_in_this_process_has_no_name():
    class RigBus:
        runtime = VirtualRuntime(EventQueue())

    assert bus_name(RigBus()) is None
    with can.Bus(interface="virtual", channel="lock-names") as bus:
        assert bus_name(bus) is None


def test_two_spellings_of_a_hub_bus_have_one_name(tmp_path):
    world = World(EventQueue())
    world.add_bus(CanBus("can0"))
    hub = HubServer(tmp_path / "hub", world)

    class HubBus:  # as motorhil.harness.python_can.bus.EmulatedBus; system tests open it
        channel_info = "emulated bus"

        def __init__(self, path, name):
            self.hub_bus = (str(path), name)
            self.channel = f"{path}#{name}"

    try:
        (tmp_path / "link").symlink_to(tmp_path / "hub")
        assert bus_name(HubBus(tmp_path / "hub", "can0")) == bus_name(
            HubBus(tmp_path / "link", "can0")
        )
    finally:
        hub.close()


def test_other_bus_name_is_interface_and_channel():
    class PcanBus:
        channel = "PCAN_USBBUS1"
        channel_info = "PCAN"

    class SlcanBus:
        channel = "/dev/null"
        channel_info = "slcan"

    assert bus_name(PcanBus()) == "pcan-PCAN_USBBUS1"
    assert bus_name(SlcanBus()) == "slcan-serial-1-3"  # devices.txt of Linux: 1:3 is /dev/null
    for name in ("a/b", "../x"):
        PcanBus.channel = name
        assert "/" not in bus_name(PcanBus())
