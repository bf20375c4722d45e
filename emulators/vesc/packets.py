"""Packets of a VESC over CAN frames: up to 512 bytes, in fragments with a CRC.

A packet of up to 6 bytes is one frame (8). A longer one is filled in, 7 bytes a frame (5) up to
offset 252, 6 bytes a frame (6) from 259 on, and ends with its length and CRC (7).

Source: vedderb/bldc, comm/comm_can.c (firmware 7.01).
"""

from binascii import crc_hqx  # CRC-16/XMODEM, if it starts with 0
from collections.abc import Iterator
from typing import Final, final

FILL, FILL_LONG, PROCESS, PROCESS_SHORT = 5, 6, 7, 8
PACKET_MAX: Final = 512
_SHORT_MAX: Final = 6
_FAR: Final = 255  # last offset that fits the byte of FILL


def frames_of(packet: bytes, sender: int, mode: int) -> Iterator[tuple[int, bytes]]:
    """Yield (command, data) of the frames that carry a packet from `sender`."""
    head = bytes((sender, mode))
    if len(packet) <= _SHORT_MAX:
        yield PROCESS_SHORT, head + packet
        return
    at = 0
    while at < len(packet):
        if at <= _FAR:
            yield FILL, bytes((at,)) + packet[at : at + 7]
            at += 7
        else:
            yield FILL_LONG, at.to_bytes(2, "big") + packet[at : at + 6]
            at += 6
    yield PROCESS, head + len(packet).to_bytes(2, "big") + crc_hqx(packet, 0).to_bytes(2, "big")


@final
class Reassembly:
    """The three receive buffers of a controller, shared by all senders."""

    def __init__(self) -> None:
        self._buffers: list[bytes] = [b"", b"", b""]

    def fill(self, offset: int, part: bytes) -> bool:
        """Add a fragment to the buffer that ends at its offset; return False if none does."""
        for i, buffer in enumerate(self._buffers):
            if len(buffer) == offset and offset + len(part) <= PACKET_MAX:
                self._buffers[i] = buffer + part
                return True
        if offset == 0:
            self._buffers[0] = part
        return offset == 0

    def take(self, length: int, crc: int) -> bytes | None:
        """Return the packet of this length; None if there is none, or its CRC is another one."""
        for i, buffer in enumerate(self._buffers):
            if len(buffer) == length:
                self._buffers[i] = b""
                return buffer if crc_hqx(buffer, 0) == crc else None
        self._buffers = [b"", b"", b""]
        return None
