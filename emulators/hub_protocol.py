"""What goes over a hub's socket: one SEQPACKET record is one message, first byte its kind.

The hub is a bus that several processes share without root or kernel module: lossless, and in the
one order in which the frames were on the bus. The connection opens with a text exchange, so that a
client of another version is told so in words:
    client: b"motorhil-hub 1 BUS NAME"     BUS may be empty: the first one
    hub:    b"welcome BUS"  or  b"refused REASON"
A client that opens with b"motorhil-hub 2 BUS NAME" may send CAN FD frames and hears them, on a bus
that has them; to all others there are none.
then, for as long as it lasts, binary records:
    client -> hub   SUBMIT  | can_frame (16) or canfd_frame (72)
                    FENCED  | resource (u16) | token (u64) | can_frame      a commanding frame
                    OWNS    | resource | token | action (u8) | pid (u32) | waited_ns (i64)
                            | held_ns (i64) | owner NUL holder NUL purpose NUL program (UTF-8)
    hub -> client   HEARD   | time_ns (i64, little-endian) | frame          somebody else's frame
                    SENT    | time_ns | frame                               an own one, transmitted
                    STALE   | resource | token | who (UTF-8)
                    TOLD    | time_ns | can_frame       an error message of the client's own port
A client that sends what no bus can carry is told `refused REASON` once more, and disconnected.
Kinds 16 and up are free for sharing one virtual clock later; a receiver ignores kinds it does not
know.

*Fencing.* Who owns a motor does so under a token, greater than that of anybody before. The hub
keeps the greatest it has seen of each resource of a bus, in frames and in what owners say. A FENCED
frame with a smaller one comes from somebody who has lost the motor without knowing it yet (a
process that was paused): it does not get on the bus, and its sender is told STALE, once. A resource
is a node-ID; motors that share a node have node-ID + 256 times their channel each.
"""

import struct
from dataclasses import dataclass
from typing import Final, final

GREETING: Final = b"motorhil-hub 1 "
FD_GREETING: Final = b"motorhil-hub 2 "
WELCOME: Final = b"welcome "
REFUSED: Final = b"refused "
SUBMIT: Final = 1
HEARD: Final = 2
SENT: Final = 3
FENCED: Final = 4
OWNS: Final = 5
STALE: Final = 6
TOLD: Final = 7
RECORD_MAX: Final = 512
FENCED_SIZE: Final = 27

_HEAD: Final = struct.Struct("<Bq")
_HEAD_SIZE: Final = _HEAD.size
_FENCED: Final = struct.Struct("<BHQ")
_FENCED_HEAD: Final = _FENCED.size
_OWNS: Final = struct.Struct("<BHQBIqq")
_WORDS: Final = 4
_WORD_MAX: Final = 110  # four of them, and the rest, are less than RECORD_MAX


@final
@dataclass(frozen=True, slots=True)
class OwnershipNotice:
    """What a client says of the ownership of a motor; who sent it, when, and on which bus.

    Attributes:
        resource: the node-ID, + 256 times the channel where motors share a node.
        action: as in the record's LockAction (1 taken, 2 released, 3 waiting, 4 refused, 5 taken
            from a dead one, 6 taken over from a living one, 7 lost).
        token: of the ownership.
        owner, holder, purpose, program, pid: who, who has it if not the owner, what for; in words.
        waited_ns, held_ns: how long.
    """

    resource: int
    action: int
    token: int
    owner: str = ""
    holder: str = ""
    purpose: str = ""
    program: str = ""
    pid: int = 0
    waited_ns: int = 0
    held_ns: int = 0


def pack_submit(frame: bytes) -> bytes:
    """A client's frame for the bus."""
    return b"\x01" + frame


def pack_told(kind: int, time_ns: int, frame: bytes) -> bytes:
    """A frame that was on the bus at `time_ns`, HEARD or SENT; or TOLD of what went wrong."""
    return _HEAD.pack(kind, time_ns) + frame


def unpack_told(record: bytes) -> tuple[int, int, bytes]:
    """(kind, time_ns, frame) of what a hub told."""
    kind, time_ns = _HEAD.unpack_from(record)
    return kind, time_ns, record[_HEAD_SIZE:]


def pack_fenced(frame: bytes, resource: int, token: int) -> bytes:
    """A client's frame for the bus, if nobody has a greater token of the resource."""
    return _FENCED.pack(FENCED, resource, token) + frame


def unpack_fenced(record: bytes) -> tuple[int, int, bytes]:
    """(resource, token, frame) of a fenced frame."""
    _, resource, token = _FENCED.unpack_from(record)
    return resource, token, record[_FENCED_HEAD:]


def pack_owns(notice: OwnershipNotice) -> bytes:
    """What a client says of who owns a motor; words are cut to the room there is."""
    head = _OWNS.pack(
        *(OWNS, notice.resource, notice.token, notice.action),
        *(notice.pid, notice.waited_ns, notice.held_ns),
    )
    words = (notice.owner, notice.holder, notice.purpose, notice.program)
    return head + b"\0".join(_cut(word.replace("\0", " "), _WORD_MAX) for word in words)


def unpack_owns(record: bytes) -> OwnershipNotice | None:
    """What a client said of who owns a motor; None: it is no such record."""
    words = record[_OWNS.size :].decode("utf-8", "replace").split("\0")
    if len(record) < _OWNS.size or len(words) != _WORDS:
        return None
    _, resource, token, action, pid, waited_ns, held_ns = _OWNS.unpack_from(record)
    owner, holder, purpose, program = words
    return OwnershipNotice(
        *(resource, action, token, owner, holder, purpose, program, pid, waited_ns, held_ns)
    )


def pack_stale(resource: int, token: int, who: str) -> bytes:
    """A frame was refused: somebody owns the motor under this greater token."""
    return _FENCED.pack(STALE, resource, token) + _cut(who, RECORD_MAX - _FENCED_HEAD)


def unpack_stale(record: bytes) -> tuple[int, int, str]:
    """(resource, greater token, who) of a refusal."""
    _, resource, token = _FENCED.unpack_from(record)
    return resource, token, record[_FENCED_HEAD:].decode("utf-8", "replace")


def _cut(text: str, size: int) -> bytes:
    """The text in UTF-8, no longer than this, and whole."""
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()
