"""Type of a CAN network interface, from the Linux kernel.

Source: linux/rtnetlink.h, linux/if_link.h (RTM_GETLINK, IFLA_MTU, IFLA_LINKINFO, IFLA_INFO_KIND).
"""

import socket
import struct
import sys
from typing import Final

VIRTUAL: Final = ("vcan", "vxcan")
_RTM_GETLINK: Final = 18
_REQUEST: Final = 1
_MTU: Final = 4
_LINKINFO: Final = 18
_KIND: Final = 1
_MESSAGE: Final = struct.Struct("=IHHII BxHiII")  # nlmsghdr and ifinfomsg
_ATTRIBUTE: Final = struct.Struct("=HH")
_ANSWER_MAX: Final = 1 << 16


def link_kind(interface: str) -> str:
    """Return the kind as in `ip -details link` ("vcan", "can" for hardware), or "".

    Raises:
        OSError: the interface does not exist.
    """
    return _part(_part(_attributes_of(interface), _LINKINFO), _KIND).rstrip(b"\0").decode()


def link_mtu(interface: str) -> int:
    """Return the largest frame [bytes]: 16, or 72 and more with CAN FD.

    Raises:
        OSError: the interface does not exist.
    """
    return int.from_bytes(_part(_attributes_of(interface), _MTU), sys.byteorder)


def _attributes_of(interface: str) -> bytes:
    index = socket.if_nametoindex(interface)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        asked = (_MESSAGE.size, _RTM_GETLINK, _REQUEST, 1, 0)
        kernel.send(_MESSAGE.pack(*asked, socket.AF_UNSPEC, 0, index, 0, 0))
        answer = kernel.recv(_ANSWER_MAX)
    return answer[_MESSAGE.size :]


def _part(attributes: bytes, wanted: int) -> bytes:
    """Return the content of an attribute, or b"" if it is absent."""
    at = 0
    while at + _ATTRIBUTE.size <= len(attributes):
        size, kind = _ATTRIBUTE.unpack_from(attributes, at)
        if kind == wanted:
            return attributes[at + _ATTRIBUTE.size : at + size]
        at += max(size + 3 & ~3, _ATTRIBUTE.size)
    return b""
