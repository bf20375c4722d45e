"""Unique names of buses and lines, independent of their spelling.

Locks between processes are files with these names. One bus or line has one name in all processes of
a host; two have two.

- SocketCAN: the network namespace and the index of the interface; its name can change.
- A hub socket: device and inode of the socket, whatever path leads there, and the bus.
- A serial line: the device numbers of the character device, whatever link leads there
  (/dev/serial/by-id/...).
- A TCP server: host and port; the host as an address if it is one, with one name for all local
  ones.
- Any other python-can bus: its interface and channel, compared as text, because nothing more is
  known.
"""

import os
import socket
import stat
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from motorapi.errors import UsageError

if TYPE_CHECKING:
    import can

_LOCAL: Final = ("localhost", "ip6-localhost", "")


def bus_name(bus: "can.BusABC") -> str | None:
    """Return the name of the CAN bus of this bus object; None: it exists in this process only.

    Raises:
        UsageError: the interface no longer exists.
    """
    if getattr(bus, "runtime", None) is not None:
        return None  # a rig of this process, in virtual time
    raw = getattr(bus, "socket", None)
    channel = str(getattr(bus, "channel", ""))
    if isinstance(raw, socket.socket) and raw.family == socket.AF_CAN and channel:
        return socketcan_name(channel)
    hub = getattr(bus, "hub_bus", None)
    if hub is not None:
        path, name = hub
        return hub_name(path, name)
    kind = type(bus).__name__.removesuffix("Bus").lower()
    if kind == "virtual":
        return None  # python-can's virtual bus, within one process
    if channel.startswith("/dev/"):
        return f"{kind}-{serial_name(channel)}"
    return _quoted(f"{kind}-{channel or bus.channel_info}")


def socketcan_name(interface: str) -> str:
    """Return the name of the bus of a SocketCAN interface. Raise UsageError if it is missing."""
    try:
        index = socket.if_nametoindex(interface)
    except OSError as error:
        raise UsageError(f"{interface}: no such network interface ({error.strerror})") from error
    return f"can-if{index}-net{_stat('/proc/self/ns/net').st_ino}"


def hub_name(path: str, bus: str) -> str:
    """Return the name of a bus of the hub that serves on the socket at `path`."""
    found = _stat(path)
    return _quoted(f"hub-{found.st_dev}-{found.st_ino}-{bus}")


def line_name(line: object) -> str | None:
    """Return the name of the line of a byte line object; None: it exists in this process only."""
    path, address = getattr(line, "path", None), getattr(line, "address", None)
    if isinstance(path, str):
        return serial_name(path)
    if isinstance(address, tuple):
        return tcp_name(*address)
    return None


def serial_name(path: str) -> str:
    """Return the name of the serial line of the character device at `path`.

    Raises:
        UsageError: `path` does not exist, or is not a character device.
    """
    found = _stat(path)
    if not stat.S_ISCHR(found.st_mode):
        raise UsageError(f"{path}: not a serial line, but {_kind(found.st_mode)}")
    return f"serial-{os.major(found.st_rdev)}-{os.minor(found.st_rdev)}"


def tcp_name(host: str, port: int) -> str:
    """Return the name of the server at a TCP address, without a name service."""
    if host.lower() in _LOCAL:
        where = "127.0.0.1"
    else:
        try:
            address = ip_address(host)
            mapped = getattr(address, "ipv4_mapped", None)
            address = mapped or address
            where = "127.0.0.1" if address.is_loopback else str(address)
        except ValueError:
            where = host.lower().rstrip(".")
    return _quoted(f"tcp-{where}-{port}")


def _stat(path: str) -> os.stat_result:
    try:
        return os.stat(path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _kind(mode: int) -> str:
    kinds = {stat.S_IFREG: "a file", stat.S_IFDIR: "a directory", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "something else")


def _quoted(text: str) -> str:
    return quote(text, safe=" :").replace(" ", "_")[:180]
