"""Lines of a world: serial lines, and Modbus/TCP through a gateway.

Modbus controllers are the same on both: they receive and send RTU frames. On a serial line these
are the frames on the wires. On TCP a gateway is in between, as in a real plant.

On a serial line without silences, controllers receive the characters, as hosts do.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final, final

from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.media.serial_faults import SerialFaultPlan
from motorhil.emulators.media.serial_line import CHARACTERS, SENT, SPOILED, SerialLine
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.modbus.tcp import GATEWAY_TIMEOUT_NS, GONE, MbapStream, TcpGateway
from motorhil.emulators.modbus.tcp import adu as adu_of
from motorhil.emulators.simulation.endpoints import (
    ControllerSlot,
    Endpoint,
    HostListener,
    Overseer,
    Segment,
)
from motorhil.emulators.simulation.event_queue import UNSET

LineTap = Callable[[str, int, int, int, str, bytes, bool], None]
"""A listener: (line, now, first bit's begin and last bit's end [ns], sender, ADU, spoiled)."""


class LineSegment(Segment, ABC):
    """The common part of serial lines and gateways: endpoints, faults, taps."""

    def __init__(self, name: str, overseer: Overseer, plan: SerialFaultPlan | None) -> None:
        super().__init__(name, overseer.queue)
        self.taps: list[LineTap] = []
        self.plan = plan
        self.endpoints: list[Endpoint] = []
        self._overseer = overseer
        self._alarm = overseer.queue.alarm(self._expire)

    @abstractmethod
    def attach(self, name: str) -> int:
        """Attach a controller and return the number of its new port."""

    def join(self, slot: ControllerSlot, unit: int) -> None:
        """Add the controller whose port was attached last."""
        self.endpoints.append(slot)

    @abstractmethod
    def add_host(self, name: str, listener: HostListener) -> "LineHost":
        """Return a new port for an application on the line."""

    def free_name(self, wish: str) -> str:
        """Return the wanted name, with a number appended if it is taken."""
        taken = [endpoint.name for endpoint in self.endpoints]
        name, number = wish, 1
        while name in taken:
            number += 1
            name = f"{wish}-{number}"
        return name

    def remove_listener(self, endpoint: Endpoint) -> None:
        """Stop deliveries to the endpoint."""
        if isinstance(endpoint, LineHost):
            endpoint.is_closed = True

    @abstractmethod
    def _expire(self, now_ns: int) -> None:
        """Process what is due."""

    def _settle(self, deadline_ns: int | None) -> None:
        if self.plan is not None:
            for time_ns, rule, what, data in self.plan.take_events():
                text = f"{rule}: {what} {data.hex(' ').upper()}"
                self._overseer.report(time_ns, "warning", self.name, text)
        due_ns = UNSET if deadline_ns is None else deadline_ns
        if due_ns != self._alarm.time_ns:
            self._alarm.move(due_ns)


@final
class LineHost(Endpoint):
    """The port of an application: bytes in, bytes out."""

    def __init__(self, name: str, port: int, segment: LineSegment, listener: HostListener) -> None:
        super().__init__(name, port)
        self.is_closed = False
        self._segment = segment
        self._listener = listener

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """Pass received characters to the application."""
        if not self.is_closed:
            self._listener(frame, now_ns, False)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """Inform the application that its last character is sent."""
        if not self.is_closed:
            self._listener(frame, now_ns, True)

    def send(self, data: bytes) -> None:
        """Send these characters, unless it is closed."""
        if self.is_closed:
            return  # its port may be another's
        self._segment.submit(self.port, data, self._segment.queue.now_ns)

    def pending(self) -> int:
        """Return the number of its characters that are not yet sent."""
        return self._segment.pending(self.port)

    def close(self) -> None:
        """Stop deliveries to the application."""
        self._segment.remove_listener(self)


@final
class SerialSegment(LineSegment):
    """A serial line with its endpoints."""

    def __init__(self, line: SerialLine, overseer: Overseer, plan: SerialFaultPlan | None) -> None:
        super().__init__(line.name, overseer, plan)
        self.line: Final = line

    def attach(self, name: str) -> int:
        """Attach a port and return its number."""
        return self.line.attach(name)

    def add_host(self, name: str, listener: HostListener) -> LineHost:
        """Return a new port for an application on the line, or that of one that has left."""
        for number, left in enumerate(self.endpoints):
            if isinstance(left, LineHost) and left.is_closed:
                own = name if left.name == name else self.free_name(name)
                if self.line.hand_over(number, own):
                    host = self.endpoints[number] = LineHost(own, number, self, listener)
                    return host
        name = self.free_name(name)
        host = LineHost(name, self.line.attach(name), self, listener)
        self.endpoints.append(host)
        return host

    def pending(self, port: int) -> int:
        """Return the number of characters of this port that are not yet sent."""
        return self.line.pending(port)

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Let the port begin to send."""
        self.line.submit(port, frame, now_ns)
        self._settle(self.line.next_deadline_ns())

    def _expire(self, now_ns: int) -> None:
        for kind, data, port, start_ns in self.line.expire(now_ns):
            if kind == SENT:
                self.endpoints[port].confirm(data, now_ns)
            elif kind == CHARACTERS:
                is_raw = not self.line.has_silences
                if is_raw:  # port -1: a collision, recorded as of the line itself
                    sender = self.name if port < 0 else self.endpoints[port].name
                    for tap in self.taps:
                        tap(self.name, now_ns, start_ns, now_ns, sender, data, port < 0)
                for endpoint in self.endpoints:
                    if (is_raw or isinstance(endpoint, LineHost)) and endpoint.port != port:
                        endpoint.deliver(data, now_ns)
            else:
                spoiled = kind == SPOILED
                end_ns, sender = self.line.silent_since_ns(), self.endpoints[port].name
                for tap in self.taps:
                    tap(self.name, now_ns, start_ns, end_ns, sender, data, spoiled)
                for endpoint in self.endpoints:
                    if isinstance(endpoint, ControllerSlot) and endpoint.port != port:
                        endpoint.deliver(b"" if spoiled else data, now_ns)
        self._settle(self.line.next_deadline_ns())


@final
class TcpSegment(LineSegment):
    """Controllers behind a gateway, and the connections to it. Ports count both."""

    def __init__(
        self,
        pipe: BytePipe,
        overseer: Overseer,
        plan: SerialFaultPlan | None,
        timeout_ns: int = GATEWAY_TIMEOUT_NS,
    ) -> None:
        super().__init__(pipe.name, overseer, plan)
        self.gateway: Final = TcpGateway(timeout_ns)
        self._pipe = pipe
        self._slots: dict[int, ControllerSlot] = {}  # by unit
        self._units: dict[int, int] = {}  # by port
        self._connections: dict[int, int] = {}  # open ones, by port
        self._timeout = overseer.queue.alarm(self._give_up)
        self._clients: dict[int, tuple[LineHost, MbapStream]] = {}  # by open connection
        self._ports = 0

    def attach(self, name: str) -> int:
        """Return the number of the next port."""
        self._ports += 1
        return self._ports - 1

    def join(self, slot: ControllerSlot, unit: int) -> None:
        """Add the controller under this unit identifier.

        Raises:
            ValueError: the identifier is taken.
        """
        self.gateway.add_unit(unit)
        super().join(slot, unit)
        self._slots[unit] = slot
        self._units[slot.port] = unit

    def add_host(self, name: str, listener: HostListener) -> LineHost:
        """Open a connection."""
        name = self.free_name(name)
        host = LineHost(name, self.attach(name), self, listener)
        self.endpoints.append(host)
        connection = self._connections[host.port] = self._pipe.connect(name, self.name)
        self._clients[connection] = host, MbapStream()
        return host

    def remove_listener(self, endpoint: Endpoint) -> None:
        """Close the connection, and forget it; closing it again has no effect."""
        super().remove_listener(endpoint)
        connection = self._connections.pop(endpoint.port, None)
        if connection is not None:
            self.endpoints.remove(endpoint)
            self._close(connection)

    def _close(self, connection: int) -> None:
        """Forget a closed connection, unless requests of it have not yet arrived."""
        if self._pipe.close(connection):
            del self._clients[connection]
            self.gateway.forget(connection)

    def pending(self, port: int) -> int:
        """Return the number of bytes of this connection that have not yet arrived."""
        return self._pipe.pending(self._connections.get(port, GONE))

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Process the bytes of a client, or the response of a controller."""
        connection = self._connections.get(port)
        if connection is not None:
            self._pipe.submit(connection, True, frame, now_ns)
        elif port in self._units:
            self._respond(self._units[port], frame[1:-2], now_ns)
        self._settle(self._pipe.next_deadline_ns())

    def _respond(self, unit: int, pdu: bytes, now_ns: int) -> None:
        answer = self.gateway.answered(unit, pdu)
        if answer is not None:
            self._send_back(*answer, now_ns, self._slots[unit].name)
        self._ask_next(unit, now_ns)

    def _send_back(self, connection: int, adu: bytes, now_ns: int, sender: str) -> None:
        if connection != GONE:
            sent = self._pipe.submit(connection, False, adu, now_ns, sender)
            if sent:
                self._tap(now_ns, sender, sent, spoiled=len(sent) < len(adu))

    def _ask_next(self, unit: int, now_ns: int) -> None:
        pdu = self.gateway.next_for(unit, now_ns)
        if pdu is not None:
            self._slots[unit].deliver(with_crc(bytes((unit,)) + pdu), now_ns)

    def _expire(self, now_ns: int) -> None:
        closing: list[int] = []
        for data, connection, to_server in self._pipe.expire(now_ns):
            client = self._clients.get(connection)
            if client is None:  # closed since, at this time
                continue
            if to_server:
                self._hear(connection, *client, data, now_ns)
                if client[0].is_closed:
                    closing.append(connection)
            else:
                client[0].deliver(data, now_ns)
        for connection in closing:
            if connection in self._clients:
                self._close(connection)
        self._settle(self._pipe.next_deadline_ns())

    def _give_up(self, now_ns: int) -> None:
        """Handle timed-out units and set the next timeout."""
        for unit, connection, adu in self.gateway.expired(now_ns):
            self._send_back(connection, adu, now_ns, self.name)
            self._ask_next(unit, now_ns)
        self._timeout.set(self.gateway.next_deadline_ns())
        self._settle(self._pipe.next_deadline_ns())

    def _hear(
        self, connection: int, host: LineHost, stream: MbapStream, data: bytes, now_ns: int
    ) -> None:
        for request in stream.feed(data):
            if self.taps:
                self._tap(now_ns, host.name, adu_of(*request))
            if not self.gateway.knows(request[1]) or self.gateway.is_full(request[1]):
                self._send_back(connection, self.gateway.refusal(request), now_ns, self.name)
                continue
            handed_on = self.gateway.ask(connection, request, now_ns)
            if self._timeout.time_ns == UNSET:  # else it rings earlier, and is set again then
                self._timeout.set(self.gateway.next_deadline_ns())
            if handed_on is not None:
                unit, pdu = handed_on
                self._slots[unit].deliver(with_crc(bytes((unit,)) + pdu), now_ns)
        if stream.closed_because is not None and not host.is_closed:
            text = f"{host.name} is disconnected: {stream.closed_because}"
            self._overseer.report(now_ns, "warning", self.name, text)
            host.deliver(b"", now_ns)  # the end of the stream
            host.close()

    def _tap(self, now_ns: int, sender: str, adu: bytes, spoiled: bool = False) -> None:
        for tap in self.taps:
            tap(self.name, now_ns, now_ns, now_ns, sender, adu, spoiled)
