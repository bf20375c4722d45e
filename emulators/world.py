"""Media and controllers wired together on one event queue: a world that is told the time.

The world reads no clock. Whoever owns the queue runs its events, as fast as it likes (virtual time)
or no earlier than they are due (wall time); what happens is the same. A frame costs its bus one
event and each node that listens to its identifier one call, however many nodes there are.
"""

from collections.abc import Callable, Mapping
from typing import final

from emulators.can_segment import BusSegment, FrameTap
from emulators.controller import Controller
from emulators.event_queue import EventQueue
from emulators.hub_protocol import OwnershipNotice
from emulators.line_segment import LineHost, LineSegment, LineTap, SerialSegment, TcpSegment
from emulators.media.byte_pipe import BytePipe
from emulators.media.can_bus import CanBus
from emulators.media.can_node import CanNode
from emulators.media.faults import FaultRule
from emulators.media.serial_faults import SerialFaultPlan
from emulators.media.serial_line import SerialLine
from emulators.modbus.tcp import GATEWAY_TIMEOUT_NS
from emulators.segment import ControllerSlot, HostListener, HostPort, Overseer

EventTap = Callable[[int, str, str, str], None]
SampleTap = Callable[[int, str, Mapping[str, float]], None]
OwnershipTap = Callable[[str, int, str, OwnershipNotice], None]


@final
class World(Overseer):
    """Buses and controllers by name, on one event queue."""

    def __init__(self, queue: EventQueue) -> None:
        super().__init__(queue)
        self._segments: dict[str, BusSegment] = {}
        self._lines: dict[str, LineSegment] = {}
        self._slots: dict[str, ControllerSlot] = {}
        self._touched: list[ControllerSlot] = []
        self._event_taps: list[EventTap] = []
        self._sample_taps: list[SampleTap] = []
        self._ownership_taps: list[OwnershipTap] = []
        self._sample_period_ns = 0
        self._sampler = queue.alarm(self._sample)

    def add_bus(self, bus: CanBus, chips: Mapping[str, CanNode] | None = None) -> None:
        """The bus exists, with nobody on it; `chips` of those to come that are not plain.

        The chip named "host" is that of every application.
        """
        self._segments[bus.name] = BusSegment(bus, self, chips or {})

    def reserve_host(self, bus: str) -> None:
        """The host's interface is on the bus, and acknowledges; the first "host" will have it."""
        self._segments[bus].reserve_host()

    def add_silent(self, bus: str, name: str) -> None:
        """A node that acknowledges, and says nothing, hangs on the bus."""
        self._segments[bus].add_silent(name)

    def bus(self, name: str) -> CanBus:
        """The bus's core, for its statistics and its faults."""
        return self._segments[name].bus

    def bus_names(self) -> list[str]:
        """In the order of adding."""
        return list(self._segments)

    def add_serial_line(self, line: SerialLine, plan: SerialFaultPlan | None) -> None:
        """The line exists, with nobody on it. `plan` is the one that the line has."""
        self._lines[line.name] = SerialSegment(line, self, plan)

    def add_tcp(
        self, pipe: BytePipe, plan: SerialFaultPlan | None, timeout_ns: int = GATEWAY_TIMEOUT_NS
    ) -> None:
        """The gateway exists, with nobody behind it. `plan` is the one that the pipe has."""
        self._lines[pipe.name] = TcpSegment(pipe, self, plan, timeout_ns)

    def line(self, name: str) -> LineSegment:
        """A line, for its faults."""
        return self._lines[name]

    def line_names(self) -> list[str]:
        """In the order of adding."""
        return list(self._lines)

    def add_controller(self, name: str, controller: Controller, bus: str) -> None:
        """The controller hangs on the bus, or line, and is powered on now.

        Raises:
            ValueError: on a line: it has no `unit`, or another one has the same.
        """
        line = self._lines.get(bus)
        if line is not None:
            slot = ControllerSlot(name, line.attach(name), controller, line, self)
            line.join(slot, _unit_of(controller))
        else:
            segment = self._segments[bus]
            slot = ControllerSlot(name, segment.attach(name), controller, segment, self)
            segment.join(slot)
        self._slots[name] = slot
        controller.start(self.queue.now_ns)
        slot.settle(self.queue.now_ns)

    def add_host(
        self, bus: str, name: str, on_frame: HostListener, on_error: HostListener | None = None
    ) -> HostPort:
        """An application's port on the bus; it hears every frame. A second "host" is "host-2".

        On a CAN FD bus its CAN controller is an FD one. What it tells of errors comes to
        `on_error`, or without one among the frames.
        """
        segment = self._segments[bus]
        number = segment.claim_host(name)
        name = segment.bus.port_names()[number]
        port = HostPort(name, number, segment, on_frame, on_error or on_frame)
        segment.join(port)
        return port

    def add_line_host(self, line: str, name: str, on_data: HostListener) -> LineHost:
        """An application's port on the line; on TCP a connection.

        It is told (characters, now, False), and (b"", now, True) when its own last character is
        out. On TCP the characters b"" are the end of the connection.
        """
        return self._lines[line].add_host(name, on_data)

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

    def restart(self, bus: str, node: str) -> None:
        """A node that is bus-off begins now to wait for the 128 x 11 recessive bits.

        Raises:
            ValueError: there is no such node on the bus, or it is not bus-off.
        """
        segment = self._segments[bus]
        names = segment.bus.port_names()
        if node not in names:
            raise ValueError(f"bus {bus}: no node {node} (known: {', '.join(names) or 'none'})")
        segment.restart(names.index(node))

    def snapshot(self, name: str) -> Mapping[str, float]:
        """The truth inside the controller now."""
        return self._slots[name].controller.snapshot(self.queue.now_ns)

    def tap_frames(self, on_frame: FrameTap) -> None:
        """`on_frame(bus, time_ns, sender, frame)` hears every frame that somebody on a bus heard.

        A frame that a fault drops is told by `tap_events` alone; one that it delays, when it comes.
        """
        for segment in self._segments.values():
            segment.taps.append(on_frame)

    def tap_lines(self, on_adu: LineTap) -> None:
        """`on_adu` hears every ADU on a line when it is complete; see `LineTap`."""
        for line in self._lines.values():
            line.taps.append(on_adu)

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


def _unit_of(controller: Controller) -> int:
    unit: object = getattr(getattr(controller, "inner", controller), "unit", None)
    if not isinstance(unit, int):
        raise ValueError("it has no unit: it is no Modbus controller")
    return unit
