"""What a world is made of, whatever the medium: who is on it, and whoever looks after them all."""

from collections.abc import Callable, Mapping
from typing import final

from emulators.controller import Controller
from emulators.event_queue import UNSET, EventQueue
from emulators.media.can_frame import ERR_FLAG

HostListener = Callable[[bytes, int, bool], None]


class Overseer:
    """Hears of what happens in the places of a world. `emulators.world.World` is one."""

    def __init__(self, queue: EventQueue) -> None:
        self.queue = queue

    def report(self, now_ns: int, level: str, name: str, text: str) -> None:
        """Something worth a line in the record happened."""

    def touch(self, slot: "ControllerSlot") -> None:
        """Something happened in the controller: the next sample includes it."""


class Segment:
    """One medium with everybody on it."""

    def __init__(self, name: str, queue: EventQueue) -> None:
        self.name = name
        self.queue = queue

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """The port wants to send this."""

    def forget_routes(self) -> None:
        """Somebody listens to other identifiers than before."""

    def remove_listener(self, endpoint: "Endpoint") -> None:
        """The endpoint hears nothing any more."""


class Endpoint:
    """Something with a port on a bus."""

    def __init__(self, name: str, port: int) -> None:
        self.name = name
        self.port = port

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """A frame of somebody else's is complete."""

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """An own frame is complete."""

    def told(self, message: bytes, now_ns: int) -> None:
        """Its CAN controller tells it of an error (`emulators.media.error_message`)."""


@final
class ControllerSlot(Endpoint):
    """A controller's place in the world: its port, its alarm, whether a sample is due."""

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
        self.touched = False
        self.sample: Mapping[str, float] = {}

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """The controller has received the frame."""
        self.controller.receive(frame, now_ns)
        self.settle(now_ns)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """The controller knows that its frame went out, if it wants to."""
        if self._wants_sent and self.controller.sent(frame, now_ns) is not False:
            self.settle(now_ns)

    def told(self, message: bytes, now_ns: int) -> None:
        """The controller has received the error message, if it asks for those (`identifiers`)."""
        identifiers = self.controller.identifiers()
        if identifiers is not None and ERR_FLAG in identifiers:
            self.controller.receive(message, now_ns)
            self.settle(now_ns)

    def _expire(self, now_ns: int) -> None:
        self.controller.expire(now_ns)
        self.settle(now_ns)

    def settle(self, now_ns: int) -> None:
        """What the controller wants after a call is done: frames out, alarm set, events told."""
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
        """The application has heard the frame."""
        self._listener(frame, now_ns, False)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """The application knows that its frame was transmitted."""
        self._listener(frame, now_ns, True)

    def told(self, message: bytes, now_ns: int) -> None:
        """The application has heard of the error."""
        self._on_error(message, now_ns, False)

    def send(self, frame: bytes) -> None:
        """The frame waits its turn for the bus."""
        self._segment.submit(self.port, frame, self._segment.queue.now_ns)

    def close(self) -> None:
        """Nothing is heard any more; frames still queued go out."""
        self._segment.remove_listener(self)


def port_of(endpoint: Endpoint) -> int:
    """The order in which those on a medium are called."""
    return endpoint.port
