"""A Gateway between a Modbus/TCP line of a world and network clients.

By default only loopback addresses are allowed. Each network connection has one connection to the
emulated gateway. Its data arrive there after the latency of the line, and responses are sent out at
once. A new client beyond the greatest number replaces the one that has been silent the longest.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, TCP connection management.
"""

import ipaddress
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, final

from motorhil.emulators.gateways.loop import Source
from motorhil.emulators.simulation.world import World

CLIENTS_MAX: Final = 256  # select() does not accept descriptors above 1023
_PIECE: Final = 4096
_UNREAD_MAX: Final = 65_536  # limit of unread bytes; above it the client's requests wait


class ModbusSocketError(Exception):
    """The address cannot be used; the message has address, reason and remedy."""


@final
class _Connection:
    """One client."""

    def __init__(
        self,
        connection: socket.socket,
        world: World,
        line: str,
        name: str,
        changed: Callable[[], None],
    ) -> None:
        self.connection = connection
        self._changed = changed
        self.is_over = False
        self._waiting = bytearray()
        self._ends = False  # close after sending what waits
        self._host = world.add_line_host(line, name, self._tell)

    def _tell(self, data: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted or self.is_over:
            return
        if not data:
            self._ends = True
        elif not self._waiting:
            taken = self._send(data)
            if taken == len(data) and not self.is_over:
                return
            data = data[taken:]
        self._waiting += data
        if self._waiting or self._ends or self.is_over:
            self.flush()
            self._changed()

    def _send(self, data: bytes | bytearray) -> int:
        """Send data and return how much the client has accepted."""
        try:
            return self.connection.send(data)
        except BlockingIOError:
            return 0
        except OSError:  # it has disconnected
            self.is_over = True
            return len(data)

    def flush(self) -> None:
        """Send as much as the client accepts."""
        while self._waiting:
            taken = self._send(self._waiting)
            del self._waiting[:taken]
            if not taken:
                return
        self.is_over = self.is_over or self._ends

    def readable(self) -> None:
        """Pass its data to the line."""
        try:
            data = self.connection.recv(_PIECE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._host.send(data)
        else:
            self.is_over = True
            self._changed()

    def waits(self) -> bool:
        """Return whether bytes wait for the client."""
        return bool(self._waiting)

    def may_send(self) -> bool:
        """Return whether its input is read."""
        return len(self._waiting) < _UNREAD_MAX

    def close(self) -> None:
        """Disconnect the client."""
        self._host.close()
        self.connection.close()


@final
class ModbusSocket:
    """A Gateway: clients connect to `host`, `port`, and are connected to a line of the world.

    Args:
        host: a name or an address.
        port: 0: any that is free.
        world: the world of the line.
        line: the name of a Modbus/TCP line.
        any_address: allow addresses that other machines can reach.
        clients_max: the greatest number of clients.

    Attributes:
        address: (host, port) in use.

    Raises:
        ModbusSocketError: the address is open to others, unknown, or taken.
    """

    def __init__(
        self,
        host: str,
        port: int,
        world: World,
        line: str,
        *,
        any_address: bool = False,
        clients_max: int = CLIENTS_MAX,
    ) -> None:
        self._clients_max: Final = clients_max
        self._world = world
        self._line = line
        self._connections: dict[socket.socket, _Connection] = {}  # the silent ones first
        self._watched: list[Source] = []
        self._is_settled = False  # no client came, left, or has unread bytes
        family, address = _resolved(host, port, any_address)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        problem = ""
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind(address)
            self._listener.listen(CLIENTS_MAX)
            self._listener.setblocking(False)
        except OSError as error:
            problem = f"{error.strerror or error}"
        if problem:
            self._listener.close()
            raise ModbusSocketError(
                f"{_written(host, port)}: {problem}; choose another port, or 0 for any free one"
            )
        bound: tuple[str, int] = self._listener.getsockname()[:2]
        self.address: Final = bound

    def __str__(self) -> str:
        """Return the address as host:port."""
        return _written(*self.address)

    def sources(self) -> Sequence[Source]:
        """Return the listening socket, and those of clients whose input is read."""
        if not self._is_settled:
            self._settle()
        return self._watched

    def _change(self) -> None:
        self._is_settled = False

    def _settle(self) -> None:
        watched: list[Source] = [self._listener]
        for connection, client in list(self._connections.items()):
            if client.waits():
                client.flush()
            if client.is_over:
                client.close()
                del self._connections[connection]
            elif client.may_send():
                watched.append(connection)
        self._watched = watched
        self._is_settled = not any(client.waits() for client in self._connections.values())

    def readable(self, source: Source) -> None:
        """Handle a new, active or departing client."""
        if source is self._listener:
            self._accept()
        elif isinstance(source, socket.socket) and source in self._connections:
            client = self._connections[source] = self._connections.pop(source)
            client.readable()

    def _accept(self) -> None:
        try:
            connection, peer = self._listener.accept()
        except OSError:  # it has left again, or the descriptors are used up: it waits
            return
        if len(self._connections) >= self._clients_max:
            self._connections.pop(next(iter(self._connections))).close()
        connection.setblocking(False)
        with suppress(OSError):  # it may have left already
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        name = _written(*peer[:2])
        self._connections[connection] = _Connection(
            connection, self._world, self._line, name, self._change
        )
        self._change()

    def backlogged(self) -> bool:
        """Return whether bytes wait for a client."""
        return not self._is_settled

    def close(self) -> None:
        """Disconnect all clients and free the address."""
        for client in self._connections.values():
            client.close()
        self._connections.clear()
        self._listener.close()


def _written(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _resolved(
    host: str, port: int, any_address: bool
) -> tuple[socket.AddressFamily, tuple[str, int] | tuple[str, int, int, int]]:
    problem = ""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        problem = f"{error.strerror or error}"
    if problem:
        raise ModbusSocketError(f"{_written(host, port)}: {problem}; usual: 127.0.0.1")
    for _, _, _, _, address in found:
        if not any_address and not ipaddress.ip_address(str(address[0])).is_loopback:
            raise ModbusSocketError(
                f"{_written(host, port)}: other machines can reach it, and Modbus has no "
                "authentication; serve on 127.0.0.1, or say --any-address"
            )
    family, _, _, _, first = found[0]
    if isinstance(first[0], int):
        raise ModbusSocketError(
            f"{_written(host, port)}: this Python does not support such addresses"
        )
    return family, (first[0], *first[1:])
