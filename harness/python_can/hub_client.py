"""Client of a hub's socket (`motorhil serve --socket PATH`), wall time."""

import os
import select
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, final

from can import CanInitializationError, CanOperationError

from motorhil.emulators.simulation.ownership_notice import (
    CLOCK,
    FD_GREETING,
    GREETING,
    HEARD,
    RECORD_MAX,
    REFUSED,
    SENT,
    STALE,
    TOLD,
    WELCOME,
    OwnershipNotice,
    pack_fenced,
    pack_owns,
    pack_submit,
    unpack_stale,
    unpack_told,
)

_GREETING_TIMEOUT_S: Final = 5.0
SEND_TIMEOUT_S: Final = 5.0  # a paused hub reads nothing
_CLOCK_TIMEOUT_S: Final = 0.2  # it follows the greeting at once


@final
class HubLink:
    """One connection to one bus of a hub; one thread may read while another one writes.

    Attributes:
        fd: True if CAN FD frames are received.
        begin_ns: the hub's time 0, since 1970 [ns]; 0 from an older hub.
        stale: tokens that the hub refused: resource -> (the greater token, its owner).
    """

    def __init__(self, channel: str, fd: bool = False) -> None:
        """Connect to `channel`, which is "PATH" (the hub's first bus) or "PATH#BUS".

        With `fd`, CAN FD frames are received and may be sent; the hub refuses it for a classical
        bus.

        Raises:
            CanInitializationError: no hub answers there, or it refuses the connection; says why.
        """
        self.fd = fd
        self.begin_ns: int = 0
        self.stale: dict[int, tuple[int, str]] = {}
        path, _, bus = channel.partition("#")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.settimeout(_GREETING_TIMEOUT_S)
            self._socket.connect(path)
            name = f"{Path(sys.argv[0] or 'python').name}[{os.getpid()}]".replace(" ", "_")
            with suppress(BrokenPipeError):  # the hub has sent its reason and closed the connection
                self._socket.send((FD_GREETING if fd else GREETING) + f"{bus} {name}".encode())
            answer = self._read()
        except OSError as error:
            self._socket.close()
            reason = error.strerror or "no answer"
            raise CanInitializationError(
                f"{path}: no hub answers here ({reason}); start one with 'motorhil serve RIG "
                f"--socket {path}'"
            ) from None
        if not answer.startswith(WELCOME):
            self._socket.close()
            reason = answer.decode("utf-8", "replace") or "the hub has closed the connection"
            raise CanInitializationError(f"{path}: {reason}")
        self.bus: str = answer[len(WELCOME) :].decode()
        self.path = path
        self._socket.setblocking(True)
        self._take_clock()

    def _take_clock(self) -> None:
        """Read the hub's clock, so that the socket is readable only for frames."""
        with suppress(OSError):  # the hub has closed the connection: the next receive says so
            if not select.select([self._socket], [], [], _CLOCK_TIMEOUT_S)[0]:
                return  # an older hub, which does not send it
            if self._socket.recv(1, socket.MSG_PEEK) == bytes((CLOCK,)):
                self.begin_ns = unpack_told(self._read())[1]

    @classmethod
    def with_all(cls, channel: str) -> "HubLink":
        """Connect, and receive CAN FD frames if the bus has them.

        Raises:
            CanInitializationError: as for a new connection.
        """
        try:
            return cls(channel, True)
        except CanInitializationError:  # a classical bus or an older hub
            return cls(channel)

    def fileno(self) -> int:
        """Return the socket's descriptor, for select and event loops."""
        return self._socket.fileno()

    def send(self, frame: bytes) -> None:
        """Send the frame to the hub, which queues it for the bus; wait while its queue is full.

        Raises:
            CanOperationError: the hub has closed the connection, or has not read for 5 s.
        """
        self._send(pack_submit(frame))

    def send_fenced(self, frame: bytes, resource: int, token: int) -> None:
        """Send a frame with its token; the hub refuses it if a greater token is known."""
        self._send(pack_fenced(frame, resource, token))

    def announce(self, notice: OwnershipNotice) -> None:
        """Announce an owner to the hub, in order with the frames. Raises as `send` does."""
        self._send(pack_owns(notice))

    def _send(self, record: bytes) -> None:
        try:
            self._socket.send(record, socket.MSG_DONTWAIT)
            return
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._closed_error() from error
        self._send_later(record, time.monotonic() + SEND_TIMEOUT_S)

    def _send_later(self, record: bytes, deadline_s: float) -> None:
        """Send as soon as the hub has read enough of what it was sent."""
        try:
            while True:
                left_s = max(0.0, deadline_s - time.monotonic())
                if not select.select([], [self._socket], [], left_s)[1]:
                    raise CanOperationError(
                        f"{self.path}: the hub has read nothing for {SEND_TIMEOUT_S:g} s, and its "
                        "queue is full; is it stopped or paused?"
                    )
                with suppress(BlockingIOError):
                    self._socket.send(record, socket.MSG_DONTWAIT)
                    return
        except (OSError, ValueError) as error:
            raise self._closed_error() from error

    def receive(self, timeout_s: float | None) -> tuple[bytes, int, bool] | None:
        """Return the next (frame, time [ns], transmitted) on the bus, or None after `timeout_s`.

        An error message of this program's own CAN controller arrives as a frame of another sender.

        Raises:
            CanOperationError: the hub has closed the connection.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            try:
                if not select.select([self._socket], [], [], left_s)[0]:
                    return None
                record = self._read()
            except (OSError, ValueError) as error:
                raise self._closed_error() from error
            if not record:
                raise self._closed_error()
            if record.startswith(REFUSED):
                reason = record[len(REFUSED) :].decode("utf-8", "replace")
                raise CanOperationError(f"{self.path}: {reason}; the hub has closed the connection")
            if record[0] in (HEARD, SENT, TOLD):
                kind, time_ns, frame = unpack_told(record)
                return frame, time_ns, kind == SENT
            if record[0] == STALE:
                resource, token, sender = unpack_stale(record)
                self.stale[resource] = token, sender

    def _read(self) -> bytes:
        """Return the next record, or b"" if the hub has closed the connection."""
        try:
            return self._socket.recv(RECORD_MAX)
        except ConnectionResetError:  # its last records are still readable
            return self._socket.recv(RECORD_MAX)

    def _closed_error(self) -> CanOperationError:
        return CanOperationError(f"{self.path}: the hub has closed the connection")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
