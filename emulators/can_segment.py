"""A CAN bus of a world: who hears which identifier, at the cost of one look-up a frame."""

from collections.abc import Callable, Mapping
from typing import Final, final

from emulators.event_queue import Alarm
from emulators.media.can_bus import CanBus
from emulators.media.can_node import PLAIN, CanNode, FrameSupport
from emulators.media.delivery import DELIVERED, HEARD, KIND_MASK, LOST, TOLD, hears
from emulators.media.faults import FaultRule
from emulators.segment import ControllerSlot, Endpoint, Overseer, Segment, port_of

HOST: Final = "host"  # what the host's interface is called on every bus

FrameTap = Callable[[str, int, str, bytes], None]


@final
class BusSegment(Segment):
    """One bus with everybody on it, and who listens to which identifier."""

    def __init__(self, bus: CanBus, world: Overseer, chips: Mapping[str, CanNode]) -> None:
        super().__init__(bus.name, world.queue)
        self.bus = bus
        self._chips = chips
        self._interface: Endpoint | None = None  # the host's, while no application uses it
        self._world = world
        self._alarm: Alarm = world.queue.alarm(self._expire)
        self._by_port: list[Endpoint] = []
        self._slots: list[ControllerSlot] = []
        self._listeners: list[Endpoint] = []  # hosts, and controllers that hear everything
        self._routes: dict[bytes, list[Endpoint]] = {}  # by the bytes of the identifier
        self._everything: list[Endpoint] = []  # who hears an identifier that is not in there
        self._routes_valid = False
        self.taps: list[FrameTap] = []
        self._settle(world.queue.now_ns)

    def attach(self, name: str) -> int:
        """A controller's CAN controller is on the bus; its port."""
        return self.bus.attach(name, self._chips.get(name, PLAIN), self.queue.now_ns)

    def attach_host(self, name: str) -> int:
        """A host's interface is on the bus; its port."""
        usual = FrameSupport.CLASSICAL if self.bus.data_bitrate_bit_s is None else FrameSupport.FD
        chip = self._chips.get(HOST, CanNode(frames=usual, shared=True))
        return self.bus.attach(name, chip, self.queue.now_ns)

    def reserve_host(self) -> None:
        """The host's interface is on the bus, and acknowledges, before an application uses it."""
        self._interface = Endpoint(HOST, self.attach_host(HOST))
        self._by_port.append(self._interface)
        self._settle(self.queue.now_ns)

    def add_silent(self, name: str) -> None:
        """A node with nothing behind its CAN controller is on the bus."""
        self._by_port.append(Endpoint(name, self.attach(name)))
        self._settle(self.queue.now_ns)

    def claim_host(self, name: str) -> int:
        """The port for an application of this name: the host's interface, or another one."""
        interface = self._interface
        if interface is None or name != HOST:
            return self.attach_host(self.free_name(name))
        self._interface = None
        return interface.port

    def join(self, endpoint: Endpoint) -> None:
        """The endpoint takes part; its port was attached last, or was reserved."""
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
        """A node that is bus-off begins to recover now."""
        self.bus.restart(port, self.queue.now_ns)
        self._settle(self.queue.now_ns)

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
        self._settle(self.queue.now_ns)

    def lift(self, name: str) -> None:
        """The rule holds no longer."""
        self.bus.lift(name, self.queue.now_ns)
        self._settle(self.queue.now_ns)

    def _settle(self, now_ns: int) -> None:
        """The bus is called when it wants to be, and what its faults did is told."""
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
        if bus.eventful:
            self._settle(now_ns)
        else:
            due_ns = bus.deadline_ns()
            if due_ns != self._alarm.time_ns:
                self._alarm.move(due_ns)
