"""A CAN bus of a world: delivery of frames by identifier."""

from collections.abc import Callable, Mapping
from typing import final

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.port import DELIVERED, HEARD, KIND_MASK, LOST, TOLD, hears
from motorhil.emulators.can.controller_config import HOST, PLAIN, CanNode, FrameSupport
from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.emulators.simulation.endpoints import (
    ControllerSlot,
    Endpoint,
    Overseer,
    Segment,
    port_of,
)
from motorhil.emulators.simulation.event_queue import Alarm

FrameTap = Callable[[str, int, str, bytes], None]


@final
class BusSegment(Segment):
    """One bus with its endpoints and their identifiers."""

    def __init__(self, bus: CanBus, world: Overseer, chips: Mapping[str, CanNode]) -> None:
        super().__init__(bus.name, world.queue)
        self.bus = bus
        self._chips = chips
        self._interface: Endpoint | None = None  # of the host, until an application uses it
        self._world = world
        self._alarm: Alarm = world.queue.alarm(self._expire)
        self._by_port: list[Endpoint] = []
        self._slots: list[ControllerSlot] = []
        self._listeners: list[Endpoint] = []  # hosts, and controllers that hear everything
        self._routes: dict[bytes, list[Endpoint]] = {}  # by the bytes of the identifier
        self._everything: list[Endpoint] = []  # receivers of identifiers without a route
        self._routes_valid = False
        self._vacant: list[int] = []  # ports of programs that have left
        self.taps: list[FrameTap] = []
        self._settle(world.queue.now_ns)

    def attach(self, name: str) -> int:
        """Attach a controller's CAN controller to the bus and return its port."""
        return self.bus.attach(name, self._chips.get(name, PLAIN), self.queue.now_ns)

    def attach_host(self, name: str) -> int:
        """Attach a host's interface to the bus and return its port."""
        usual = FrameSupport.CLASSICAL if self.bus.data_bitrate_bit_s is None else FrameSupport.FD
        chip = self._chips.get(HOST, CanNode(frames=usual, shared=True))
        return self.bus.attach(name, chip, self.queue.now_ns)

    def reserve_host(self) -> None:
        """Attach the host's interface, which acknowledges before an application uses it."""
        self._interface = Endpoint(HOST, self.attach_host(HOST))
        self._by_port.append(self._interface)
        self._settle(self.queue.now_ns)

    def add_silent(self, name: str) -> None:
        """Attach a node that only acknowledges."""
        self._by_port.append(Endpoint(name, self.attach(name)))
        self._settle(self.queue.now_ns)

    def claim_host(self, name: str) -> int:
        """Return the port for an application of this name: the host's interface, or a new one."""
        interface = self._interface
        if interface is not None and name == HOST:
            self._interface = None
            return interface.port
        names = self.bus.port_names()
        for number in sorted(self._vacant, key=lambda one: names[one] != name):
            new_name = name if names[number] == name else self.free_name(name)
            if self.bus.hand_over(number, new_name, self.queue.now_ns):
                self._vacant.remove(number)
                return number
        return self.attach_host(self.free_name(name))

    def join(self, endpoint: Endpoint) -> None:
        """Add the endpoint; its port was attached last, or was reserved."""
        if endpoint.port < len(self._by_port):
            self._by_port[endpoint.port] = endpoint
        else:
            self._by_port.append(endpoint)
        if isinstance(endpoint, ControllerSlot):
            self._slots.append(endpoint)
        else:
            self._listeners.append(endpoint)
        self._routes_valid = False
        self._settle(self.queue.now_ns)

    def restart(self, port: int) -> None:
        """Let a bus-off node begin to recover now."""
        self.bus.restart(port, self.queue.now_ns)
        self._settle(self.queue.now_ns)

    def free_name(self, wish: str) -> str:
        """Return the wanted name, with a number appended if it is taken."""
        taken = set(self.bus.port_names())
        name = wish
        number = 1
        while name in taken:
            number += 1
            name = f"{wish}-{number}"
        return name

    def remove_listener(self, endpoint: Endpoint) -> None:
        """Stop deliveries to the endpoint."""
        if endpoint in self._listeners:
            self._listeners.remove(endpoint)
            self._vacant.append(endpoint.port)
        self._routes_valid = False

    def pending(self, port: int) -> int:
        """Return the number of frames of this port that are not yet sent."""
        return self.bus.pending(port)

    def hosts_pending(self) -> int:
        """Return the number of frames of hosts that are not yet sent, also of closed ones."""
        hosts = (one for one in self._by_port if not isinstance(one, ControllerSlot))
        return sum(self.bus.pending(one.port) for one in hosts)

    def forget_routes(self) -> None:
        """Rebuild the routes because a controller listens to other identifiers."""
        self._routes_valid = False

    def submit(self, port: int, frame: bytes, now_ns: int) -> None:
        """Queue the frame and set the alarm to the bus's next deadline."""
        self.bus.submit(port, frame, now_ns)
        due_ns = self.bus.deadline_ns()
        if due_ns != self._alarm.time_ns:
            self._alarm.move(due_ns)

    def inject(self, rule: FaultRule) -> None:
        """Add a fault rule."""
        self.bus.inject(rule, self.queue.now_ns)
        self._settle(self.queue.now_ns)

    def lift(self, name: str) -> None:
        """Remove a fault rule."""
        self.bus.lift(name, self.queue.now_ns)
        self._settle(self.queue.now_ns)

    def _settle(self, now_ns: int) -> None:
        """Set the alarm to the bus's deadline and report fault events."""
        if self.bus.eventful:
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
        everything.sort(key=port_of)
        routes: dict[bytes, list[Endpoint]] = {}
        for can_id, slot in chosen:
            key = can_id.to_bytes(4, "little")
            known = routes.get(key)
            if known is None:
                known = routes[key] = everything.copy()
            if slot not in known:
                known.append(slot)
        for receivers in routes.values():
            receivers.sort(key=port_of)
        self._everything = everything
        self._routes = routes
        self._routes_valid = True

    def _expire(self, now_ns: int) -> None:
        by_port = self._by_port
        bus = self.bus
        for frame, sender_port, kind in bus.expire(now_ns):
            sender = by_port[sender_port]
            if kind & KIND_MASK == TOLD:
                for tap in self.taps:
                    tap(self.name, now_ns, sender.name, frame)
                if kind == TOLD:
                    sender.told(frame, now_ns)
                continue
            if kind & KIND_MASK != LOST:  # lost frames are events, not records
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
        if bus.eventful:
            self._settle(now_ns)
        else:
            due_ns = bus.deadline_ns()
            if due_ns != self._alarm.time_ns:
                self._alarm.move(due_ns)
