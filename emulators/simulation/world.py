"""A world: media and controllers on one event queue.

The world does not read a clock. The owner of the queue runs its events as fast as possible (virtual
time) or no earlier than they are due (wall time), with equal results. A frame costs its bus one
event and each node that listens to its identifier one call, independent of the number of nodes.
"""

from collections.abc import Callable, Mapping
from typing import final

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.controller_config import CanNode
from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.emulators.controller import Controller
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.media.serial_faults import SerialFaultPlan
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.tcp import GATEWAY_TIMEOUT_NS
from motorhil.emulators.simulation.can_network import BusSegment, FrameTap
from motorhil.emulators.simulation.endpoints import ControllerSlot, HostListener, HostPort, Overseer
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
from motorhil.emulators.simulation.serial_network import (
    LineHost,
    LineSegment,
    LineTap,
    SerialSegment,
    TcpSegment,
)

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
        """Add an empty bus; `chips` has the setup of CAN controllers by node name.

        The chip named "host" is that of every application.
        """
        self._segments[bus.name] = BusSegment(bus, self, chips or {})

    def reserve_host(self, bus: str) -> None:
        """Attach the host's interface, which acknowledges; the first "host" will use it."""
        self._segments[bus].reserve_host()

    def add_silent(self, bus: str, name: str) -> None:
        """Attach a node that only acknowledges."""
        self._segments[bus].add_silent(name)

    def bus(self, name: str) -> CanBus:
        """Return the bus's core, for its statistics and its faults."""
        return self._segments[name].bus

    def hosts_pending(self) -> int:
        """Return the number of frames of hosts on all buses that are not yet sent."""
        return sum(segment.hosts_pending() for segment in self._segments.values())

    def bus_names(self) -> list[str]:
        """Return the names of the buses in the order of adding."""
        return list(self._segments)

    def add_serial_line(self, line: SerialLine, plan: SerialFaultPlan | None) -> None:
        """Add an empty serial line. `plan` is the line's own fault plan."""
        self._lines[line.name] = SerialSegment(line, self, plan)

    def add_tcp(
        self, pipe: BytePipe, plan: SerialFaultPlan | None, timeout_ns: int = GATEWAY_TIMEOUT_NS
    ) -> None:
        """Add a gateway without controllers. `plan` is the pipe's own fault plan."""
        self._lines[pipe.name] = TcpSegment(pipe, self, plan, timeout_ns)

    def line(self, name: str) -> LineSegment:
        """Return a line, for its faults."""
        return self._lines[name]

    def serial_line(self, name: str) -> "SerialLine | None":
        """Return the wires of a line; None on TCP."""
        line = self._lines[name]
        return line.line if isinstance(line, SerialSegment) else None

    def line_names(self) -> list[str]:
        """Return the names of the lines in the order of adding."""
        return list(self._lines)

    def add_controller(self, name: str, controller: Controller, bus: str) -> None:
        """Attach the controller to the bus, or line, and power it on now.

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
        """Return an application's port on the bus; it hears every frame.

        A second "host" is "host-2". On a CAN FD bus its CAN controller is an FD one. Error messages
        are passed to `on_error`, or without one among the frames.
        """
        segment = self._segments[bus]
        number = segment.claim_host(name)
        name = segment.bus.port_names()[number]
        port = HostPort(name, number, segment, on_frame, on_error or on_frame)
        segment.join(port)
        return port

    def add_line_host(self, line: str, name: str, on_data: HostListener) -> LineHost:
        """Return an application's port on the line; on TCP a connection.

        Its listener gets (characters, now, False), and (b"", now, True) when its own last character
        is sent. On TCP the characters b"" are the end of the connection.
        """
        return self._lines[line].add_host(name, on_data)

    def controller(self, name: str) -> Controller:
        """Return the controller itself."""
        return self._slots[name].controller

    def stimulate(self, name: str, stimulus: str, value: float) -> None:
        """Set a physical input of the controller, and report it.

        Raises:
            ValueError: the input does not exist, or cannot have this value.
        """
        slot = self._slots[name]
        slot.controller.stimulate(stimulus, value, self.queue.now_ns)
        self.report(self.queue.now_ns, "info", name, f"stimulus {stimulus} = {value:g}")
        slot.settle(self.queue.now_ns)

    def inject(self, bus: str, rule: FaultRule) -> None:
        """Add the fault rule to the bus.

        Raises:
            ValueError: the bus was made without a fault plan, or has had a rule of that name.
        """
        self._segments[bus].inject(rule)

    def lift(self, bus: str, name: str) -> None:
        """Remove the fault rule of this name.

        Raises:
            ValueError: the bus does not have such a rule.
        """
        self._segments[bus].lift(name)

    def restart(self, bus: str, node: str) -> None:
        """Let a bus-off node begin to wait for the 128 x 11 recessive bits.

        Raises:
            ValueError: the node is not on the bus, or not bus-off.
        """
        segment = self._segments[bus]
        names = segment.bus.port_names()
        if node not in names:
            raise ValueError(
                f"bus {bus}: node {node} not found (known: {', '.join(names) or 'none'})"
            )
        segment.restart(names.index(node))

    def snapshot(self, name: str) -> Mapping[str, float]:
        """Return the true state of the controller now."""
        return self._slots[name].controller.snapshot(self.queue.now_ns)

    def tap_frames(self, on_frame: FrameTap) -> None:
        """Call `on_frame(bus, time_ns, sender, frame)` for every frame that any node received.

        A frame that a fault drops is reported to `tap_events` only; a delayed frame on its arrival.
        """
        for segment in self._segments.values():
            segment.taps.append(on_frame)

    def untap_frames(self, on_frame: FrameTap) -> None:
        """End the calls of a function given to `tap_frames`."""
        for segment in self._segments.values():
            segment.taps.remove(on_frame)

    def tap_lines(self, on_adu: LineTap) -> None:
        """Call `on_adu` for every complete ADU on a line; see `LineTap`."""
        for line in self._lines.values():
            line.taps.append(on_adu)

    def tap_events(self, on_event: EventTap) -> None:
        """Call `on_event(time_ns, level, controller, text)` for every report of a controller."""
        self._event_taps.append(on_event)

    def tap_ownership(self, on_notice: OwnershipTap) -> None:
        """Call `on_notice(bus, time_ns, sender, notice)` for every ownership notice of a host."""
        self._ownership_taps.append(on_notice)

    def tell_ownership(self, bus: str, sender: str, notice: OwnershipNotice) -> None:
        """Pass on a host's ownership notice."""
        for tap in self._ownership_taps:
            tap(bus, self.queue.now_ns, sender, notice)

    def tap_samples(self, period_ns: int, on_sample: SampleTap) -> None:
        """Call `on_sample(time_ns, controller, truth)` every `period_ns`, while the truth changes.

        A controller without events and with an unchanged true state is not sampled.

        Raises:
            ValueError: samples are already taken with another period.
        """
        if self._sample_taps and period_ns != self._sample_period_ns:
            raise ValueError(
                f"sample period {period_ns} ns: the world is already sampled every "
                f"{self._sample_period_ns} ns, for all"
            )
        self._sample_taps.append(on_sample)
        self._sample_period_ns = period_ns
        for slot in self._slots.values():
            slot.touched = True
        self._touched = list(self._slots.values())
        self._sampler.set(self.queue.now_ns)

    def report(self, now_ns: int, level: str, name: str, text: str) -> None:
        """Report an event for the record."""
        for tap in self._event_taps:
            tap(now_ns, level, name, text)

    def touch(self, slot: ControllerSlot) -> None:
        """Mark the controller as changed: the next sample includes it."""
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
        raise ValueError("controller has no unit; expected a controller for lines")
    return unit
