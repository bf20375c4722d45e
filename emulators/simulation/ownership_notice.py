"""Protocol of a hub's socket: one SEQPACKET record per message.

The hub is a bus that several processes share without root or kernel module. The first byte of a
record is its kind. The hub is lossless, and keeps the order of the frames on the bus. The
connection opens with a text exchange, so that a client of another version gets a readable refusal:

    client: b"motorhil-hub 1 BUS NAME"     BUS may be empty: the first one
    hub:    b"welcome BUS"  or  b"refused REASON"

A client that opens with b"motorhil-hub 2 BUS NAME" may send and receive CAN FD frames, on an FD
bus. Other clients do not receive them.

Binary records follow:

    client -> hub   SUBMIT  | can_frame (16) or canfd_frame (72)
                    FENCED  | resource (u16) | token (u64) | can_frame      a commanding frame
                    OWNS    | resource | token | action (u8) | pid (u32) | waited_ns (i64)
                            | held_ns (i64) | owner NUL holder NUL purpose NUL program (UTF-8)
    hub -> client   HEARD   | time_ns (i64, little-endian) | frame          another node's frame
                    SENT    | time_ns | frame                               an own one, transmitted
                    STALE   | resource | token | who (UTF-8)
                    TOLD    | time_ns | can_frame       an error message of the client's own port
                    CLOCK   | time_ns               once, first: the hub's time 0, since 1970 (UTC)

A client that sends a frame that no bus can carry receives `refused REASON`, and is disconnected.
Kinds 16 and up belong to programs that share a rig's virtual clock, on a socket of their own; a
receiver ignores unknown kinds.

*Fencing.* An owner of a motor has a token that is greater than those of all owners before. For each
resource of a bus, the hub keeps the greatest token in frames and ownership notices. A FENCED frame
with a smaller token comes from a process that has lost the motor without knowing it (because it was
paused). The hub does not send it, and informs the sender once by STALE. A resource is a node-ID;
motors that share a node have node-ID + 256 times their channel each.
"""

import struct
from typing import Final, final

from motorhil.frozen import frozen

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
CLOCK: Final = 8
RECORD_MAX: Final = 512
FENCED_SIZE: Final = 27

_HEAD: Final = struct.Struct("<Bq")
_HEAD_SIZE: Final = _HEAD.size
_FENCED: Final = struct.Struct("<BHQ")
_FENCED_HEAD: Final = _FENCED.size
_OWNS: Final = struct.Struct("<BHQBIqq")
_WORDS: Final = 4
_WORD_MAX: Final = 110  # four of them and the rest fit RECORD_MAX


@final
@frozen
class OwnershipNotice:
    """A client's notice about the ownership of a motor.

    Attributes:
        resource: the node-ID, + 256 times the channel where motors share a node.
        action: as in the record's LockAction (1 taken, 2 released, 3 waiting, 4 refused, 5 taken
            from a dead one, 6 taken over from a living one, 7 lost).
        token: of the ownership.
        owner, holder, purpose, program, pid: the sender, the present holder if another, and their
            purpose, in words.
        waited_ns, held_ns: durations.
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
    """Pack a client's frame for the bus."""
    return b"\x01" + frame


def pack_told(kind: int, time_ns: int, frame: bytes) -> bytes:
    """Pack a frame on the bus at `time_ns` (HEARD or SENT), an error message (TOLD), or CLOCK."""
    return _HEAD.pack(kind, time_ns) + frame


def unpack_told(record: bytes) -> tuple[int, int, bytes]:
    """Unpack (kind, time_ns, frame) of a hub's record."""
    kind, time_ns = _HEAD.unpack_from(record)
    return kind, time_ns, record[_HEAD_SIZE:]


def pack_fenced(frame: bytes, resource: int, token: int) -> bytes:
    """Pack a client's frame that is refused if the resource has a greater token."""
    return _FENCED.pack(FENCED, resource, token) + frame


def unpack_fenced(record: bytes) -> tuple[int, int, bytes]:
    """Unpack (resource, token, frame) of a fenced frame."""
    _, resource, token = _FENCED.unpack_from(record)
    return resource, token, record[_FENCED_HEAD:]


def pack_owns(notice: OwnershipNotice) -> bytes:
    """Pack an ownership notice; words are cut to the available size."""
    head = _OWNS.pack(
        *(OWNS, notice.resource, notice.token, notice.action),
        *(notice.pid, notice.waited_ns, notice.held_ns),
    )
    words = (notice.owner, notice.holder, notice.purpose, notice.program)
    return head + b"\0".join(_cut(word.replace("\0", " "), _WORD_MAX) for word in words)


def unpack_owns(record: bytes) -> OwnershipNotice | None:
    """Unpack an ownership notice; return None if the record is malformed."""
    words = record[_OWNS.size :].decode("utf-8", "replace").split("\0")
    if len(record) < _OWNS.size or len(words) != _WORDS:
        return None
    _, resource, token, action, pid, waited_ns, held_ns = _OWNS.unpack_from(record)
    owner, holder, purpose, program = words
    return OwnershipNotice(
        *(resource, action, token, owner, holder, purpose, program, pid, waited_ns, held_ns)
    )


def pack_stale(resource: int, token: int, who: str) -> bytes:
    """Pack the refusal of a frame: the motor is owned under this greater token."""
    return _FENCED.pack(STALE, resource, token) + _cut(who, RECORD_MAX - _FENCED_HEAD)


def unpack_stale(record: bytes) -> tuple[int, int, str]:
    """Unpack (resource, greater token, who) of a refusal."""
    _, resource, token = _FENCED.unpack_from(record)
    return resource, token, record[_FENCED_HEAD:].decode("utf-8", "replace")


def _cut(text: str, size: int) -> bytes:
    """Return the text in UTF-8, cut to this size at a character boundary."""
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()
