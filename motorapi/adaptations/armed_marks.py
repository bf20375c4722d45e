"""Marks of armed set-points, which outlive the process that armed them.

A drive keeps a set-point that waits for SYNC after the program that sent it has died. The next SYNC
on the bus, sent for other drives, would start that set-point. So each waiting set-point is marked
by a lock between processes, which names the drive and the RPDO. The mark of a process that died
stays. The next process that gets the bus's turn learns that the previous one died in it. Before it
arms anything else, it overwrites the marked set-points by a halt, and latches the halt by a SYNC of
its own.

If another process has taken the drive since, that process cleared the drive itself when it found
the ownership abandoned.
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
        where: the name of the bus between processes, or None if no other process uses it.
        name: the name of the bus in messages.
    """

    def __init__(self, where: str | None, name: str) -> None:
        self._where: Final = where
        self._name: Final = name
        self._locks: dict[tuple[int, int], ProcessLock] = {}

    def mark(self, link: "CanopenLink", node_id: int, can_id: int, owner: object) -> Hold | None:
        """Mark an RPDO of the drive as waiting for SYNC, until the mark is released."""
        if self._where is None:
            return None
        lock = self._lock(node_id, can_id)
        return lock.acquire(link.runtime, "a set-point that waits for SYNC", 0.0, owner)

    def _lock(self, node_id: int, can_id: int) -> ProcessLock:
        lock = self._locks.get((node_id, can_id))
        if lock is None:
            name = f"{self._prefix}{node_id}-{can_id:03X}"
            lock = ProcessLock(name, f"set-points waiting for SYNC in {self._name} node {node_id}")
            self._locks[node_id, can_id] = lock
        return lock

    @property
    def _prefix(self) -> str:
        return f"{self._where}-armed-"

    def clear(self, link: "CanopenLink", own: int | None = None) -> None:
        """Disarm set-points that dead processes have armed; the caller must have the turn.

        Args:
            link: the link to send on.
            own: the node-ID of a drive that now belongs to the caller.

        Raises:
            LinkError: the bus does not accept the overwriting frames.
        """
        left = [] if self._where is None else list(self._left(own))
        if not left:
            return
        if link.bus_sync.known() is None:  # A running cyclic SYNC has started them long ago.
            from motorapi.adaptations.canopen_link import can_frame

            frames = [can_frame(can_id, _HALTED) for _, can_id in left] * _OVERWRITTEN
            link.confirmed([link.send_tracked(frame) for frame in frames])
            link.confirmed([link.sync()])
        for node_id, can_id in left:
            self._lock(node_id, can_id).acquire(
                link.runtime, "clearing the mark", 0.0, self
            ).release()

    def _left(self, own: int | None) -> Iterator[tuple[int, int]]:
        """Yield (node-ID, identifier) of each set-point that a dead process has left armed."""
        directory = LockDirectory()
        for view in list_locks(directory):
            if not view.name.startswith(self._prefix) or not view.abandoned:
                continue
            node_id, can_id = view.name.removeprefix(self._prefix).split("-")
            drive = look(directory, f"{self._where}-node{node_id}")
            if int(node_id) == own or (drive.abandoned and drive.holder is None):
                yield int(node_id), int(can_id, 16)
