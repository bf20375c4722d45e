"""What goes over a hub's socket: one SEQPACKET record is one message, first byte its kind.

The hub is a bus that several processes share without root or kernel module: lossless, and in the
one order in which the frames were on the bus. The connection opens with a text exchange, so that a
client of another version is told so in words:
    client: b"motorhil-hub 1 BUS NAME"     BUS may be empty: the first one
    hub:    b"welcome BUS"  or  b"refused REASON"
then, for as long as it lasts, binary records:
    client -> hub   SUBMIT  | can_frame (16)
    hub -> client   HEARD   | time_ns (i64, little-endian) | can_frame      somebody else's frame
                    SENT    | time_ns | can_frame                           an own one, transmitted
A client that sends what no bus can carry is told `refused REASON` once more, and disconnected.
Kinds 16 and up are free for sharing one virtual clock later; a receiver ignores kinds it does not
know.
"""

import struct
from typing import Final

GREETING: Final = b"motorhil-hub 1 "
WELCOME: Final = b"welcome "
REFUSED: Final = b"refused "
SUBMIT: Final = 1
HEARD: Final = 2
SENT: Final = 3
RECORD_MAX: Final = 512

_HEAD: Final = struct.Struct("<Bq")
_HEAD_SIZE: Final = _HEAD.size


def pack_submit(frame: bytes) -> bytes:
    """A client's frame for the bus."""
    return b"\x01" + frame


def pack_told(kind: int, time_ns: int, frame: bytes) -> bytes:
    """A frame that was on the bus at `time_ns`; `kind` is HEARD or SENT."""
    return _HEAD.pack(kind, time_ns) + frame


def unpack_told(record: bytes) -> tuple[int, int, bytes]:
    """(kind, time_ns, frame) of what a hub told."""
    kind, time_ns = _HEAD.unpack_from(record)
    return kind, time_ns, record[_HEAD_SIZE:]
