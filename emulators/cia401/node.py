"""A CiA 401 I/O node with amplifiers and encoders; sans-I/O.

Outputs change when their RPDO is processed: at once (types 254, 255) or at SYNC (0 to 240), before
the counters are sampled for the TPDOs of the same SYNC. If the host is lost (heartbeat, NMT stop,
reset of communication), the outputs take their error values and keep them until they are written
again.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from emulators.canopen.lss import UNCONFIGURED
from emulators.canopen.nmt import NmtState
from emulators.canopen.node import CanopenNode, NodeTiming
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NEVER
from emulators.cia401.channel import FAULT, READY, STIMULI, Channel
from emulators.cia401.io_objects import INPUTS, IoObjects
from emulators.cia401.settings import NodeSettings
from emulators.controller import NonvolatileMemory

_PREFIX: Final = ("", "channel_2_", "channel_3_", "channel_4_")


@final
class IoNode:
    """An I/O node; implements `Controller` and `NodeHost`."""

    def __init__(
        self,
        od: ObjectDictionary,
        settings: NodeSettings,
        events: Sequence[tuple[str, str]] = (),
        memory: NonvolatileMemory | None = None,
    ) -> None:
        self.od = od
        self.settings = settings
        rate = settings.oscillator.rate()
        self.channels: list[Channel] = [Channel(channel, rate) for channel in settings.channels]
        self._objects = IoObjects(od, self.channels)
        self._node = CanopenNode(
            od,
            UNCONFIGURED if settings.node_id_by_lss else settings.node_id,
            NodeTiming(boot_up_ns=settings.boot_up_ns, sdo_reply_ns=settings.sdo_reply_ns),
            self,
            memory,
        )
        self._events: list[tuple[str, str]] = list(events)
        self._inputs: int = 0  # as last reported to the node's TPDOs
        self._touched: bool = False  # inputs may have changed
        self._has_started: bool = False

    # --- Controller

    def start(self, now_ns: int) -> None:
        """Power on."""
        self._node.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame on the bus."""
        self._node.receive(data, now_ns)
        if self._touched:
            self._publish(now_ns)

    def sent(self, data: bytes, now_ns: int) -> None:
        """Confirm that an own frame has left the bus."""
        self._node.sent(data, now_ns)

    def wants_sent(self) -> bool:
        """Return True: the node waits for its TPDOs to leave."""
        return self._node.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""
        deadline_ns = self._node.deadline_ns()
        for channel in self.channels:
            if channel.due_ns < deadline_ns:
                deadline_ns = channel.due_ns
        return None if deadline_ns == NEVER else deadline_ns

    def expire(self, now_ns: int) -> None:
        """Process what is due: first the amplifiers, then the node."""
        for channel in self.channels:
            if channel.due_ns <= now_ns:
                channel.axis.at(now_ns)
                channel.settle(now_ns)
                self._touched = True
        if self._touched:
            self._publish(now_ns)
        self._node.expire(now_ns)
        if self._touched:
            self._publish(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to send now."""
        return self._node.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of each event since the last call."""
        events = self._node.take_events()
        if not self._events:
            return events
        own = self._events
        self._events = []
        return [*events, *own]

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a stimulus of channel 1; prefix it by "channel_2_" and so on for other channels.

        Raises:
            ValueError: the stimulus is unknown, or the value is invalid.
        """
        place = 0
        for number in range(1, len(self.channels)):
            if name.startswith(_PREFIX[number]):
                place = number
        stimulus = name[len(_PREFIX[place]) :]
        if stimulus not in STIMULI:
            known = [before + one for before in self._prefixes() for one in STIMULI]
            raise ValueError(f"there is no stimulus {name!r}; known: {', '.join(known)}")
        channel = self.channels[place]
        channel.axis.at(now_ns)
        channel.stimulate(stimulus, value)
        channel.settle(now_ns)
        self._publish(now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true state at `now_ns`; channels after the first have a prefix.

        The prefixes are "channel_2_" and so on.
        """
        found: dict[str, float] = {}
        for place, channel in enumerate(self.channels):
            channel.axis.at(now_ns)
            channel.truth(_PREFIX[place], found)
        return found

    def identifiers(self) -> Sequence[int] | None:
        """Return the CAN identifiers that the node listens to."""
        return self._node.identifiers()

    def identifiers_revision(self) -> int:
        """Return a number that increases with every change of `identifiers`."""
        return self._node.identifiers_revision()

    # --- NodeHost

    def on_nmt(self, state: int, now_ns: int) -> None:
        """Set the outputs to their error values in STOPPED."""
        if state == NmtState.STOPPED:
            self._fall_back("stopped", now_ns)

    def on_reset(self, whole: bool, now_ns: int) -> None:
        """Reset outputs and counters on reset node; on reset communication use error values."""
        if whole:
            self._objects.presets.clear()
            self._take_over(now_ns)
            if self._has_started:  # at power-on it counts from the motor's position
                for channel in self.channels:
                    channel.axis.set_position(0)
            self._has_started = True
        else:
            self._fall_back("communication reset", now_ns)

    def on_write(self, now_ns: int) -> None:
        """Apply written objects."""
        objects = self._objects
        if objects.is_written:
            objects.is_written = False
            self._take_over(now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Do nothing: outputs of synchronous RPDOs have come by `on_write`."""

    def before_read(self, now_ns: int) -> None:
        """Update the counters to `now_ns`."""
        for channel in self.channels:
            channel.axis.at(now_ns)

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        """Set the outputs to their error values because the host is lost."""
        self._fall_back(f"node {node_id} is lost" if node_id else "it is guarded no more", now_ns)

    def on_bus_off(self, now_ns: int) -> None:
        """Set the outputs to their error values because the node cannot hear its host."""
        self._fall_back("bus-off", now_ns)

    # --- inside

    def _take_over(self, now_ns: int) -> None:
        """Apply outputs and counter presets to the channels."""
        objects = self._objects
        objects.apply()
        for channel in self.channels:
            channel.axis.at(now_ns)
            channel.settle(now_ns)
        if objects.presets:
            for place, value in objects.presets.items():
                self.channels[place].axis.set_position(value)
            objects.presets.clear()
        self._touched = True

    def _fall_back(self, why: str, now_ns: int) -> None:
        self._objects.fall_back()
        self._take_over(now_ns)
        self._events.append(("warning", f"{why}: the outputs have their error values"))

    def _publish(self, now_ns: int) -> None:
        """Report changed inputs to the TPDOs that map them."""
        self._touched = False
        inputs = self._objects.inputs()
        if inputs == self._inputs:
            return
        for place in range(len(self.channels)):
            before, after = self._inputs >> 2 * place & 3, inputs >> 2 * place & 3
            if after & ~before & FAULT:
                self._events.append(("error", f"amplifier {place + 1}: fault"))
            elif (before ^ after) & READY:
                state = "ready" if after & READY else "not ready"
                self._events.append(("info", f"amplifier {place + 1}: {state}"))
        self._inputs = inputs
        self._node.object_changed(INPUTS, 1, now_ns)

    def _prefixes(self) -> tuple[str, ...]:
        return _PREFIX[: len(self.channels)]
