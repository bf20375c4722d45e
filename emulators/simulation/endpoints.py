"""Segments and endpoints of a world, and their overseer."""

from collections.abc import Callable, Mapping
from typing import final

from motorhil.emulators.can.frame import ERR_FLAG
from motorhil.emulators.controller import STUCK, Controller, StuckControllerError
from motorhil.emulators.simulation.event_queue import UNSET, EventQueue

HostListener = Callable[[bytes, int, bool], None]


class Overseer:
    """A receiver of reports from the segments of a world. `World` derives from it."""

    def __init__(self, queue: EventQueue) -> None:
        self.queue = queue

    def report(self, now_ns: int, level: str, name: str, text: str) -> None:
        """Report an event for the record."""

    def touch(self, slot: "ControllerSlot") -> None:
        """Mark the controller as changed: the next sample includes it."""


class Segment:
    """One medium with its endpoints."""

    def __init__(self, name: str, queue: EventQueue) -> None:
        self.name = name
        self.queue = queue

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Send the frame from this port."""

    def forget_routes(self) -> None:
        """Rebuild the routes because a controller listens to other identifiers."""

    def remove_listener(self, endpoint: "Endpoint") -> None:
        """Stop deliveries to the endpoint; its port may be used again."""

    def pending(self, port: int) -> int:
        """Return the number of frames of this port that are not yet sent."""
        return 0


class Endpoint:
    """An object with a port on a bus."""

    def __init__(self, name: str, port: int) -> None:
        self.name = name
        self.port = port

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """Handle a complete frame of another endpoint."""

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """Handle a complete own frame."""

    def told(self, message: bytes, now_ns: int) -> None:
        """Handle an error message of its CAN controller (`error_message`)."""


@final
class ControllerSlot(Endpoint):
    """A controller's place in the world: its port, its alarm, its sample state."""

    def __init__(
        self, name: str, port: int, controller: Controller, segment: Segment, world: Overseer
    ) -> None:
        super().__init__(name, port)
        self.controller = controller
        self._segment = segment
        self._world = world
        self._alarm = world.queue.alarm(self._expire)
        self._wants_sent = controller.wants_sent()
        self._revision = controller.identifiers_revision()
        self._expired_ns = UNSET
        self._again = 0  # how often it was called at that time without moving on
        self.touched: bool = False
        self.sample: Mapping[str, float] = {}

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """Pass a frame to the controller."""
        self.controller.receive(frame, now_ns)
        self.settle(now_ns)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """Confirm an own frame to the controller, if it wants that."""
        if self._wants_sent and self.controller.sent(frame, now_ns) is not False:
            self.settle(now_ns)

    def told(self, message: bytes, now_ns: int) -> None:
        """Pass an error message to the controller, if `identifiers` includes those."""
        identifiers = self.controller.identifiers()
        if identifiers is not None and ERR_FLAG in identifiers:
            self.controller.receive(message, now_ns)
            self.settle(now_ns)

    def _expire(self, now_ns: int) -> None:
        if now_ns == self._expired_ns:
            self._again += 1
            if self._again == STUCK:
                raise StuckControllerError(self.name, now_ns)
        else:
            self._expired_ns = now_ns
            self._again = 0
        self.controller.expire(now_ns)
        self.settle(now_ns)

    def settle(self, now_ns: int) -> None:
        """Apply the results of a call: send frames, report events, set the alarm."""
        controller = self.controller
        output = controller.take_output()
        if output:
            for frame in output:
                self._segment.submit(self.port, frame, now_ns)
        events = controller.take_events()
        if events:
            for level, text in events:
                self._world.report(now_ns, level, self.name, text)
        revision = controller.identifiers_revision()
        if revision != self._revision:
            self._revision = revision
            self._segment.forget_routes()
        deadline_ns = controller.next_deadline_ns()
        due_ns = UNSET if deadline_ns is None else deadline_ns
        if due_ns != self._alarm.time_ns:
            self._alarm.move(due_ns)
        if not self.touched:
            self.touched = True
            self._world.touch(self)


@final
class HostPort(Endpoint):
    """An application's port on a bus; `listener` hears every frame, own ones when transmitted.

    `on_error` hears the error messages of its CAN controller, as frames of others.
    """

    def __init__(
        self,
        name: str,
        port: int,
        segment: Segment,
        listener: HostListener,
        on_error: HostListener,
    ) -> None:
        super().__init__(name, port)
        self._segment = segment
        self._listener = listener
        self._on_error = on_error

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """Pass a frame to the application."""
        self._listener(frame, now_ns, False)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """Confirm to the application that its frame was transmitted."""
        self._listener(frame, now_ns, True)

    def told(self, message: bytes, now_ns: int) -> None:
        """Pass an error message to the application."""
        self._on_error(message, now_ns, False)

    def send(self, frame: bytes) -> None:
        """Queue the frame for the bus."""
        self._segment.submit(self.port, frame, self._segment.queue.now_ns)

    def pending(self) -> int:
        """Return the number of its frames that are not yet sent."""
        return self._segment.pending(self.port)

    def close(self) -> None:
        """Stop deliveries to the application; queued frames are still sent."""
        self._segment.remove_listener(self)


def port_of(endpoint: Endpoint) -> int:
    """Return the port, the sort key of endpoints on a medium."""
    return endpoint.port
