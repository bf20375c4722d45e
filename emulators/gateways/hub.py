"""The hub: a world's buses on a UNIX socket, for other processes."""

import contextlib
import errno
import os
import socket
import stat
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final, final

from motorhil.emulators.can.frame import FD_FRAME_BYTES, FRAME_BYTES, as_driven
from motorhil.emulators.gateways.loop import Source
from motorhil.emulators.simulation.endpoints import HostPort
from motorhil.emulators.simulation.ownership_notice import (
    CLOCK,
    FD_GREETING,
    FENCED,
    FENCED_SIZE,
    GREETING,
    HEARD,
    OWNS,
    RECORD_MAX,
    REFUSED,
    SENT,
    SUBMIT,
    TOLD,
    WELCOME,
    OwnershipNotice,
    pack_stale,
    pack_told,
    unpack_fenced,
    unpack_owns,
)
from motorhil.emulators.simulation.world import World

_BACKLOG_MAX: Final = 131_072  # frames of about 100 bytes; 15 s at a full bus of 1 Mbit/s
_QUEUE_MAX: Final = 1024  # frames of a client that wait for the bus; its further ones wait in it
_SUBMIT_SIZE: Final = 1 + FRAME_BYTES
_FD_SUBMIT_SIZE: Final = 1 + FD_FRAME_BYTES
_TAKING: Final = (1, 5, 6)  # actions of a notice that begin an ownership
_ENDING: Final = (2, 7)  # and those that end it
CLIENTS_MAX: Final = 256  # select() does not accept descriptors above 1023


class HubError(Exception):
    """The hub's socket cannot be used; the message has path, reason and remedy."""


@final
class _Fences:
    """The greatest token seen of every resource, and its owner."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, int], tuple[int, str]] = {}

    def newer(self, bus: str, resource: int, token: int, who: str) -> tuple[int, str] | None:
        """Return (token, owner) of a greater token of the resource, or None."""
        known = self._seen.get((bus, resource))
        if known is None or known[0] < token:
            self._seen[bus, resource] = token, who
        elif known[0] > token:
            return known
        return None


def _words(resource: int) -> str:
    channel = f" channel {resource >> 8}" if resource >> 8 else ""
    return f"node {resource & 0xFF}{channel}"


@final
class _Client:
    """One connected process: its port on a bus, and its unread records."""

    def __init__(
        self, connection: socket.socket, world: World, fences: _Fences, begin_ns: int
    ) -> None:
        self.connection = connection
        self._begin_ns = begin_ns  # the world's time 0, since 1970
        self.lost = ""  # reason for disconnecting, or ""
        self._world = world
        self._fences = fences
        self._port: HostPort | None = None
        self._bus = ""
        self._fd = False
        self._told_stale: set[tuple[int, int]] = set()
        self._owned: dict[int, OwnershipNotice] = {}  # ownerships it has announced, by resource
        self._waiting: deque[bytes] = deque()

    def readable(self) -> bool:
        """Process its input; return False once it has disconnected."""
        while not self.is_full():
            try:
                record = self.connection.recv(RECORD_MAX)
            except BlockingIOError:
                return True
            except OSError:
                return False
            if not record:
                return False
            if self._port is None:
                if not self._greet(record):
                    return False
            elif not self._take(self._port, record):
                return False
        return True

    def is_full(self) -> bool:
        """Return whether its frames must wait before the hub, because the bus is behind."""
        return self._port is not None and self._port.pending() >= _QUEUE_MAX

    def _take(self, port: HostPort, record: bytes) -> bool:
        """Process a record; return False if the client must be disconnected."""
        kind = record[0]
        frame = b""
        if kind == FENCED and len(record) == FENCED_SIZE:
            resource, token, frame = unpack_fenced(record)
            newer = self._fences.newer(self._bus, resource, token, port.name)
            if newer is not None:
                self._refuse_stale(port.name, resource, token, newer)
                return True
        elif kind == SUBMIT and (
            len(record) == _SUBMIT_SIZE or (self._fd and len(record) == _FD_SUBMIT_SIZE)
        ):
            frame = record[1:]
        elif kind == OWNS:
            notice = unpack_owns(record)
            if notice is not None:
                self._note(port.name, notice)
        if frame:
            try:
                port.send(as_driven(frame))
            except ValueError as error:  # a frame that no bus can carry
                self.refuse(f"frame {frame.hex()}: {error}")
                return False
        return True

    def _note(self, name: str, notice: OwnershipNotice) -> None:
        if notice.action in _ENDING:
            self._owned.pop(notice.resource, None)
        if notice.action in _TAKING:
            self._owned[notice.resource] = notice
            purpose = f" for {notice.purpose}" if notice.purpose else ""
            self._fences.newer(self._bus, notice.resource, notice.token, name + purpose)
        self._world.tell_ownership(self._bus, name, notice)

    def _refuse_stale(self, name: str, resource: int, token: int, newer: tuple[int, str]) -> None:
        if (resource, token) in self._told_stale:
            return
        self._told_stale.add((resource, token))
        greater, who = newer
        self._report(
            f"frames of {name} are refused: token {token}, and {_words(resource)} is owned under"
            f" token {greater} by {who}"
        )
        self._send(pack_stale(resource, greater, who))

    def _report(self, text: str) -> None:
        self._world.report(self._world.queue.now_ns, "warning", self._bus, text)

    def leave(self) -> None:
        """Handle its departure; report motors that it still owned, as after a kill."""
        if self._port is not None and self._owned:
            owned = ", ".join(
                f"{_words(notice.resource)} (token {notice.token})"
                for notice in self._owned.values()
            )
            self._report(f"{self._port.name} has left, and has not given back {owned}")
        self.close()

    def refuse(self, reason: str) -> None:
        """Send the reason for disconnecting."""
        self._send(REFUSED + reason.encode())

    def _greet(self, record: bytes) -> bool:
        words = record.decode("utf-8", "replace").split(" ", 3)
        names = self._world.bus_names()
        refusal = ""
        fd = record.startswith(FD_GREETING)
        if not (fd or record.startswith(GREETING)) or len(words) != 4:
            refusal = "this is motorhil's hub, protocol 1 and 2; the client speaks another"
        elif words[2] and words[2] not in names:
            refusal = f"bus {words[2]!r}: not found; expected {', '.join(names)}"
        bus = "" if refusal else words[2] or names[0]
        if fd and bus and self._world.bus(bus).data_bitrate_bit_s is None:
            refusal = f"fd=True: bus {bus} is classical CAN; the rig gives it no data_bitrate_bit_s"
        if refusal:
            self.refuse(refusal)
            return False
        try:
            self._port = self._world.add_host(bus, words[3], self._tell, self._tell_error)
        except ValueError as error:
            self.refuse(str(error))
            return False
        self._fd = fd
        self._send(WELCOME + bus.encode())
        self._send(pack_told(CLOCK, self._begin_ns, b""))
        self._bus = bus
        return True

    def _tell(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        if self._fd or len(frame) == FRAME_BYTES:
            self._send(pack_told(SENT if transmitted else HEARD, time_ns, frame))

    def _tell_error(self, message: bytes, time_ns: int, _: bool) -> None:
        self._send(pack_told(TOLD, time_ns, message))

    def _send(self, record: bytes) -> None:
        self._waiting.append(record)
        if len(self._waiting) > _BACKLOG_MAX:
            self.lost = f"it left {_BACKLOG_MAX} frames unread"
        self.flush()

    def flush(self) -> None:
        """Send as much as the client accepts."""
        waiting = self._waiting
        try:
            while waiting:
                self.connection.send(waiting[0])
                waiting.popleft()
        except BlockingIOError:
            pass
        except OSError as error:
            self.lost = os.strerror(error.errno or errno.EPIPE)

    def waits(self) -> bool:
        """Return whether records wait for the client."""
        return bool(self._waiting)

    def close(self) -> None:
        """Close its port and its connection."""
        if self._port is not None:
            self._port.close()
        self.connection.close()


@final
class HubServer:
    """A Gateway: processes connect to `path` and get a port on a bus of the world.

    Delivery is lossless: unread frames wait for a client, up to 131,072. A client that lags
    further is disconnected; it never sees gaps. A client that sends faster than the bus waits in
    its `send` as soon as 1,024 of its frames are queued. Frames of a client that has lost its motor
    are refused (fencing, see `hub_protocol`).
    """

    def __init__(self, path: str | Path, world: World) -> None:
        """Create the socket, for this user only.

        Raises:
            HubError: the path is taken by a running hub, is not a socket, or cannot be created.
        """
        self.path: Path = Path(path)
        self._world = world
        self._fences = _Fences()
        self._clients: dict[socket.socket, _Client] = {}
        self._begin_ns = 0  # the world's time 0, since 1970; the same for all clients
        if "#" in str(self.path):
            raise HubError(
                f"{self.path}: '#' is not allowed, because clients write PATH#BUS; choose "
                "another path"
            )
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._clear_stale()
            mask = os.umask(0o177)
            try:
                self._listener.bind(str(self.path))
            finally:
                os.umask(mask)
            self._inode = self.path.lstat().st_ino
            self._listener.listen(CLIENTS_MAX)
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            raise HubError(
                f"{self.path}: cannot create the hub's socket: {error.strerror or error}; "
                "choose another path with --socket (at most 107 bytes, in a writable folder)"
            ) from None
        except HubError:
            self._listener.close()
            raise

    def _clear_stale(self) -> None:
        try:
            mode = self.path.lstat().st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISSOCK(mode):
            raise HubError(f"{self.path}: exists and is not a socket; choose another path")
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
            try:
                probe.connect(str(self.path))
            except ConnectionRefusedError:
                self.path.unlink()  # left behind by a hub that was killed
                return
        raise HubError(
            f"{self.path}: in use by a running hub; stop that one or choose another path"
        )

    def sources(self) -> Sequence[Source]:
        """Return the listening socket and those of all clients."""
        for connection, client in list(self._clients.items()):
            client.flush()
            if client.lost:
                self._drop(connection)
        reading = [one for one, client in self._clients.items() if not client.is_full()]
        return [self._listener, *reading]

    def readable(self, source: Source) -> None:
        """Handle a new, active or departing client."""
        if source is self._listener:
            self._accept()
            return
        client = self._clients.get(source) if isinstance(source, socket.socket) else None
        if client is not None and not client.readable():
            self._drop(client.connection)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it has left again, or the descriptors are used up: it waits
            return
        connection.setblocking(False)
        if not self._begin_ns:
            self._begin_ns = time.time_ns() - self._world.queue.now_ns
        client = _Client(connection, self._world, self._fences, self._begin_ns)
        if len(self._clients) < CLIENTS_MAX:
            self._clients[connection] = client
        else:
            client.refuse(f"too many programs; the limit is {len(self._clients)}, all connected")
            client.close()

    def backlogged(self) -> bool:
        """Return whether a client has unread records."""
        return any(client.waits() for client in self._clients.values())

    def _drop(self, connection: socket.socket) -> None:
        self._clients.pop(connection).leave()

    def close(self) -> None:
        """Disconnect all clients and free the path."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._listener.close()
        with contextlib.suppress(FileNotFoundError):
            if self.path.lstat().st_ino == self._inode:  # not if another hub has replaced it
                self.path.unlink()
