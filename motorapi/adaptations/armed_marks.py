"""What was armed by a process that died before SYNC: nothing of it may begin, whoever sends SYNC.

A drive keeps what waits in it for a SYNC when its commander dies, and the next SYNC on the bus,
sent for quite other drives, would start it. So each set-point that waits is marked, by a lock
between processes that says which drive, and which RPDO; a mark whose process has died stays. Who
has the bus's turn next, and is told that somebody died in it, overwrites what is marked by a halt,
and takes that out by a SYNC of its own, before anything else is armed.

Where somebody else has taken the drive since, he has seen to that himself, when he found it left.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.cia402_objects import ENABLE_OPERATION, HALT
from motorapi.lock_directory import LockDirectory
from motorapi.lock_view import list_locks, look
from motorapi.process_lock import Hold, ProcessLock

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import CanopenLink

_OVERWRITTEN: Final = 2  # times: a frame may be lost
_HALTED: Final = (ENABLE_OPERATION | HALT).to_bytes(2, "little") + bytes(4)


@final
class ArmedMarks:
    """The set-points on one bus that wait for a SYNC, as other processes see them.

    Args:
        where: the bus, as processes call it; None: no other process is on it.
        name: the same for people.
    """

    def __init__(self, where: str | None, name: str) -> None:
        self._where: Final = where
        self._name: Final = name
        self._locks: dict[tuple[int, int], ProcessLock] = {}

    def mark(self, link: "CanopenLink", node_id: int, can_id: int, owner: object) -> Hold | None:
        """This RPDO of the drive waits for SYNC, until the mark is released."""
        if self._where is None:
            return None
        lock = self._lock(node_id, can_id)
        return lock.acquire(link.runtime, "a set-point that waits for SYNC", 0.0, owner)

    def _lock(self, node_id: int, can_id: int) -> ProcessLock:
        lock = self._locks.get((node_id, can_id))
        if lock is None:
            name = f"{self._prefix}{node_id}-{can_id:03X}"
            lock = ProcessLock(name, f"what waits for SYNC in {self._name} node {node_id}")
            self._locks[node_id, can_id] = lock
        return lock

    @property
    def _prefix(self) -> str:
        return f"{self._where}-armed-"

    def clear(self, link: "CanopenLink", own: int | None = None) -> None:
        """Nothing that a dead process has armed begins any more. Whoever calls this has the turn.

        Args:
            link: where to send.
            own: the node-ID of a drive that is the caller's now.

        Raises:
            LinkError: the bus does not take what overwrites it.
        """
        left = [] if self._where is None else list(self._left(own))
        if not left:
            return
        if link.bus_sync.known() is None:  # one that runs has started it long ago
            from motorapi.adaptations.canopen_link import can_frame

            frames = [can_frame(can_id, _HALTED) for _, can_id in left] * _OVERWRITTEN
            link.confirmed([link.send_tracked(frame) for frame in frames])
            link.confirmed([link.sync()])
        for node_id, can_id in left:
            self._lock(node_id, can_id).acquire(link.runtime, "seen to", 0.0, self).release()

    def _left(self, own: int | None) -> Iterator[tuple[int, int]]:
        """(node-ID, identifier) of what waits for a process that died."""
        directory = LockDirectory()
        for view in list_locks(directory):
            if not view.name.startswith(self._prefix) or not view.abandoned:
                continue
            node_id, can_id = view.name.removeprefix(self._prefix).split("-")
            drive = look(directory, f"{self._where}-node{node_id}")
            if int(node_id) == own or (drive.abandoned and drive.holder is None):
                yield int(node_id), int(can_id, 16)
