"""Media and controllers wired together on one event queue: a world that is told the time.

The world reads no clock. Whoever owns the queue runs its events, as fast as it likes (virtual time)
or no earlier than they are due (wall time); what happens is the same. A frame costs its bus one
event and each node that listens to its identifier one call, however many nodes there are.
"""

from collections.abc import Callable, Mapping
from typing import final

from emulators.controller import Controller
from emulators.event_queue import UNSET, Alarm, EventQueue
from emulators.hub_protocol import OwnershipNotice
from emulators.media.can_bus import DELIVERED, HEARD, KIND_MASK, LOST, CanBus, hears
from emulators.media.faults import FaultRule

HostListener = Callable[[bytes, int, bool], None]
FrameTap = Callable[[str, int, str, bytes], None]
EventTap = Callable[[int, str, str, str], None]
SampleTap = Callable[[int, str, Mapping[str, float]], None]
OwnershipTap = Callable[[str, int, str, OwnershipNotice], None]


class Endpoint:
    """Something with a port on a bus."""

    def __init__(self, name: str, port: int) -> None:
        self.name = name
        self.port = port

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """A frame of somebody else's is complete."""

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """An own frame is complete."""


@final
class ControllerSlot(Endpoint):
    """A controller's place in the world: its port, its alarm, whether a sample is due."""

    def __init__(
        self, name: str, port: int, controller: Controller, segment: "BusSegment", world: "World"
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
    """An application's port on a bus; `on_frame` hears every frame, own ones when transmitted."""

    def __init__(self, name: str, port: int, segment: "BusSegment", listener: HostListener) -> None:
        super().__init__(name, port)
        self._segment = segment
        self._listener = listener

    def deliver(self, frame: bytes, now_ns: int) -> None:
        """The application has heard the frame."""
        self._listener(frame, now_ns, False)

    def confirm(self, frame: bytes, now_ns: int) -> None:
        """The application knows that its frame was transmitted."""
        self._listener(frame, now_ns, True)

    def send(self, frame: bytes) -> None:
        """The frame waits its turn for the bus."""
        self._segment.submit(self.port, frame, self._segment.queue.now_ns)

    def close(self) -> None:
        """Nothing is heard any more; frames still queued go out."""
        self._segment.remove_listener(self)


@final
class BusSegment:
    """One bus with everybody on it, and who listens to which identifier."""

    def __init__(self, bus: CanBus, world: "World") -> None:
        self.bus = bus
        self.queue = world.queue
        self.name = bus.name
        self._world = world
        self._alarm: Alarm = world.queue.alarm(self._expire)
        self._has_rules = bool(bus.faults_fired())  # faults are asked for only where there are any
        self._by_port: list[Endpoint] = []
        self._slots: list[ControllerSlot] = []
        self._listeners: list[Endpoint] = []  # hosts, and controllers that hear everything
        self._routes: dict[bytes, list[Endpoint]] = {}  # by the bytes of the identifier
        self._everything: list[Endpoint] = []  # who hears an identifier that is not in there
        self._routes_valid = False
        self.taps: list[FrameTap] = []
        self._settle(world.queue.now_ns)

    def join(self, endpoint: Endpoint) -> None:
        """The endpoint, whose port was attached last, takes part."""
        self._by_port.append(endpoint)
        if isinstance(endpoint, ControllerSlot):
            self._slots.append(endpoint)
        else:
            self._listeners.append(endpoint)
        self._routes_valid = False

    def free_name(self, wish: str) -> str:
        """The name wished for, with a number behind it if it is taken."""
        taken = [endpoint.name for endpoint in self._by_port]
        name = wish
        number = 1
        while name in taken:
            number += 1
            name = f"{wish}-{number}"
        return name

    def remove_listener(self, endpoint: Endpoint) -> None:
        """The endpoint hears nothing any more."""
        if endpoint in self._listeners:
            self._listeners.remove(endpoint)
        self._routes_valid = False

    def forget_routes(self) -> None:
        """Somebody listens to other identifiers than before."""
        self._routes_valid = False

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """The frame is queued, and the bus knows when it is next wanted."""
        self.bus.submit(port, frame, now_ns)
        due_ns = self.bus.deadline_ns()
        if due_ns != self._alarm.time_ns:
            self._alarm.move(due_ns)

    def inject(self, rule: FaultRule) -> None:
        """The rule holds from now on."""
        self.bus.inject(rule, self.queue.now_ns)
        self._has_rules = True
        self._settle(self.queue.now_ns)

    def lift(self, name: str) -> None:
        """The rule holds no longer."""
        self.bus.lift(name, self.queue.now_ns)
        self._settle(self.queue.now_ns)

    def _settle(self, now_ns: int) -> None:
        """The bus is called when it wants to be, and what its faults did is told."""
        if self._has_rules:
            for time_ns, rule, what, frame in self.bus.take_fault_events():
                can_id = f" {int.from_bytes(frame[:4], 'little') & 0x1FFF_FFFF:X}h" if frame else ""
                self._world.report(time_ns, "warning", self.name, f"{rule}: {what}{can_id}")
        self._alarm.move(self.bus.deadline_ns())

    def _build_routes(self) -> None:
        everything: list[Endpoint] = []
        chosen: list[tuple[int, ControllerSlot]] = []
        for slot in self._slots:
            identifiers = slot.controller.identifiers()
            if identifiers is None:
                everything.append(slot)
            else:
                for can_id in identifiers:
                    chosen.append((can_id, slot))
        everything.extend(self._listeners)
        everything.sort(key=_port_of)
        routes: dict[bytes, list[Endpoint]] = {}
        for can_id, slot in chosen:
            key = can_id.to_bytes(4, "little")
            known = routes.get(key)
            if known is None:
                known = routes[key] = everything.copy()
            if slot not in known:
                known.append(slot)
        for receivers in routes.values():
            receivers.sort(key=_port_of)
        self._everything = everything
        self._routes = routes
        self._routes_valid = True

    def _expire(self, now_ns: int) -> None:
        by_port = self._by_port
        bus = self.bus
        for frame, sender_port, kind in bus.expire(now_ns):
            sender = by_port[sender_port]
            if kind & KIND_MASK != LOST:  # what nobody hears is an event, not a frame of the record
                for tap in self.taps:
                    tap(self.name, now_ns, sender.name, frame)
                if not self._routes_valid:
                    self._build_routes()
                receivers = self._routes.get(frame[:4])
                if receivers is None:
                    receivers = self._everything
                for endpoint in receivers:
                    if endpoint is not sender and (kind == DELIVERED or hears(kind, endpoint.port)):
                        endpoint.deliver(frame, now_ns)
            if kind & KIND_MASK != HEARD:
                sender.confirm(frame, now_ns)
        if self._has_rules:
            self._settle(now_ns)
        else:
            due_ns = bus.deadline_ns()
            if due_ns != self._alarm.time_ns:
                self._alarm.move(due_ns)


def _port_of(endpoint: Endpoint) -> int:
    return endpoint.port


@final
class World:
    """Buses and controllers by name, on one event queue."""

    def __init__(self, queue: EventQueue) -> None:
        self.queue = queue
        self._segments: dict[str, BusSegment] = {}
        self._slots: dict[str, ControllerSlot] = {}
        self._touched: list[ControllerSlot] = []
        self._event_taps: list[EventTap] = []
        self._sample_taps: list[SampleTap] = []
        self._ownership_taps: list[OwnershipTap] = []
        self._sample_period_ns = 0
        self._sampler = queue.alarm(self._sample)

    def add_bus(self, bus: CanBus) -> None:
        """The bus exists, with nobody on it."""
        self._segments[bus.name] = BusSegment(bus, self)

    def bus(self, name: str) -> CanBus:
        """The bus's core, for its statistics and its faults."""
        return self._segments[name].bus

    def bus_names(self) -> list[str]:
        """In the order of adding."""
        return list(self._segments)

    def add_controller(self, name: str, controller: Controller, bus: str) -> None:
        """The controller hangs on the bus and is powered on now."""
        segment = self._segments[bus]
        slot = ControllerSlot(name, segment.bus.attach(name), controller, segment, self)
        segment.join(slot)
        self._slots[name] = slot
        controller.start(self.queue.now_ns)
        slot.settle(self.queue.now_ns)

    def add_host(self, bus: str, name: str, on_frame: HostListener) -> HostPort:
        """An application's port on the bus; it hears every frame. A second "host" is "host-2"."""
        segment = self._segments[bus]
        name = segment.free_name(name)
        port = HostPort(name, segment.bus.attach(name), segment, on_frame)
        segment.join(port)
        return port

    def controller(self, name: str) -> Controller:
        """The controller itself."""
        return self._slots[name].controller

    def stimulate(self, name: str, stimulus: str, value: float) -> None:
        """A physical input of the controller has this value from now on."""
        slot = self._slots[name]
        slot.controller.stimulate(stimulus, value, self.queue.now_ns)
        slot.settle(self.queue.now_ns)

    def inject(self, bus: str, rule: FaultRule) -> None:
        """The fault rule holds on the bus from now on.

        Raises:
            ValueError: the bus was made without a fault plan, or has had a rule of that name.
        """
        self._segments[bus].inject(rule)

    def lift(self, bus: str, name: str) -> None:
        """The fault rule of this name holds no longer.

        Raises:
            ValueError: the bus has no such rule.
        """
        self._segments[bus].lift(name)

    def snapshot(self, name: str) -> Mapping[str, float]:
        """The truth inside the controller now."""
        return self._slots[name].controller.snapshot(self.queue.now_ns)

    def tap_frames(self, on_frame: FrameTap) -> None:
        """`on_frame(bus, time_ns, sender, frame)` hears every frame that somebody on a bus heard.

        A frame that a fault drops is told by `tap_events` alone; one that it delays, when it comes.
        """
        for segment in self._segments.values():
            segment.taps.append(on_frame)

    def tap_events(self, on_event: EventTap) -> None:
        """`on_event(time_ns, level, controller, text)` hears what controllers report."""
        self._event_taps.append(on_event)

    def tap_ownership(self, on_notice: OwnershipTap) -> None:
        """`on_notice(bus, time_ns, sender, notice)` hears what hosts say of who owns what."""
        self._ownership_taps.append(on_notice)

    def tell_ownership(self, bus: str, sender: str, notice: OwnershipNotice) -> None:
        """A host on the bus says who owns a motor."""
        for tap in self._ownership_taps:
            tap(bus, self.queue.now_ns, sender, notice)

    def tap_samples(self, period_ns: int, on_sample: SampleTap) -> None:
        """`on_sample(time_ns, controller, truth)` every `period_ns`, while the truth changes.

        A controller that nothing happens in, and whose truth stays the same, is not asked.

        Raises:
            ValueError: somebody samples at another period already.
        """
        if self._sample_taps and period_ns != self._sample_period_ns:
            raise ValueError(
                f"a sample every {period_ns} ns: the world is sampled every "
                f"{self._sample_period_ns} ns already, for all"
            )
        self._sample_taps.append(on_sample)
        self._sample_period_ns = period_ns
        for slot in self._slots.values():
            slot.touched = True
        self._touched = list(self._slots.values())
        self._sampler.set(self.queue.now_ns)

    def report(self, now_ns: int, level: str, name: str, text: str) -> None:
        """Something worth a line in the record happened."""
        for tap in self._event_taps:
            tap(now_ns, level, name, text)

    def touch(self, slot: ControllerSlot) -> None:
        """Something happened in the controller: the next sample includes it."""
        if not self._sample_taps:
            return
        self._touched.append(slot)
        if len(self._touched) == 1:
            period_ns = self._sample_period_ns
            self._sampler.set((self.queue.now_ns // period_ns + 1) * period_ns)

    def _sample(self, now_ns: int) -> None:
        again: list[ControllerSlot] = []
        due = self._touched
        due.sort(key=_port_and_name)
        for slot in due:
            truth = slot.controller.snapshot(now_ns)
            slot.touched = False
            if truth is not slot.sample and truth != slot.sample:
                slot.sample = truth
                for tap in self._sample_taps:
                    tap(now_ns, slot.name, truth)
                slot.touched = True
                again.append(slot)
        self._touched = again
        if again:
            self._sampler.set(now_ns + self._sample_period_ns)


def _port_and_name(slot: ControllerSlot) -> tuple[int, str]:
    return (slot.port, slot.name)
