"""CiA 401 I/O node with amplifiers and encoder counters, for the host.

There is one object per node and process, shared by the motors on its channels. Two channels share
frames:

| PDO        | content                                                    | transmission    |
| ---------- | ---------------------------------------------------------- | --------------- |
| RPDO 1     | 6200h:1, a bit for each amplifier's enable input           | on change       |
| TPDO 1     | 6000h:1, two bits for each amplifier: ready, fault         | on change       |
| RPDO 2, 3  | 6411h, the outputs of channels 1 and 2, of 3 and 4         | latched by SYNC |
| TPDO 2, 3  | 6820h, the counters of channels 1 and 2, of 3 and 4        | at SYNC         |

An amplifier is switched off repeatedly until its node confirms it, as a frame may be lost.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID, open_bus, release_bus
from motorhil.motorapi.adaptations.canopen.node import (
    CanopenNode,
    node_locks,
)
from motorhil.motorapi.adaptations.canopen.objects import COMMUNICATION_OBJECTS, ObjectTable
from motorhil.motorapi.adaptations.canopen.pdo_setup import (
    EVENT_DRIVEN,
    SYNCHRONOUS,
    PdoSetUp,
    PdoWish,
)
from motorhil.motorapi.adaptations.canopen.sync import SYNC_ID
from motorhil.motorapi.adaptations.host_servo.cycle import Axis, ChannelPair, Cycle, cycle_of
from motorhil.motorapi.adaptations.host_servo.occupation import NodeOccupation
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    LinkError,
    MotorBusyError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.runtime.can_link import can_frame
from motorhil.motorapi.runtime.turn_lock import TurnLock
from motorhil.motorapi.synchronization.bus_load import NodeTraffic, PeriodicMessage, note_node

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.adaptations.canopen.pdo_setup import PdoFound
    from motorhil.motorapi.locking.process_lock import LockHandle
    from motorhil.motorapi.runtime.api import Runtime


@final
@frozen
class IoFacts:
    """The results of the bring-up of a node.

    Attributes:
        channels: the number of channels that have both an analogue output and a counter.
        enable_id: the identifier of the RPDO with the digital outputs.
        pairs: the identifiers of (RPDO, TPDO) of channels 1 and 2, and of 3 and 4.
        boot: the number of the boot-up.
        limitations: the functions that this node lacks or refuses, in words.
    """

    channels: int
    enable_id: int
    pairs: tuple[tuple[int, int], ...]
    boot: int
    limitations: tuple[str, ...]


_SHORTER: Final = 0.999  # a fast oscillator shortens the node's times
_OUTPUT_BYTES: Final = 4
_COUNT_BYTES: Final = 8


def node_traffic(
    node_id: int, facts: "IoFacts", inputs: "tuple[int, PdoFound]", options: "IoOptions"
) -> NodeTraffic:
    """Return the traffic of a node; `inputs`: (identifier, TPDO) of its digital inputs."""
    sent: list[PeriodicMessage] = []
    ours: tuple[PeriodicMessage, ...] = ()
    unknown = ""
    can_id, tpdo = inputs
    if tpdo.inhibit_100us:
        sent.append(PeriodicMessage(can_id, 1, tpdo.inhibit_100us * 1e-4 * _SHORTER))
    else:
        unknown = f"TPDO {can_id:03X}h of node {node_id} has no inhibit time"
    if options.heartbeat_ms:
        period_s = options.heartbeat_ms / 1e3
        sent.append(PeriodicMessage(HEARTBEAT_ID + node_id, 1, period_s * _SHORTER))
        ours = (PeriodicMessage(HEARTBEAT_ID + options.host_node_id, 1, period_s),)
    return NodeTraffic(
        sent=tuple(sent),
        ours=ours,
        sent_at_sync=tuple(
            PeriodicMessage(back, _COUNT_BYTES, 1.0, 1.0) for _, back in facts.pairs
        ),
        ours_at_sync=tuple(PeriodicMessage(out, _OUTPUT_BYTES, 1.0, 1.0) for out, _ in facts.pairs),
        unknown=unknown,
    )


_OBJECTS: Final = ObjectTable(COMMUNICATION_OBJECTS)
INPUTS: Final = 0x6000
OUTPUTS: Final = 0x6200
ANALOGUE_OUTPUT: Final = 0x6411
CHANNELS_MAX: Final = 4

_FIRST_INPUTS_S: Final = 0.5
_INHIBIT_100US: Final = 10  # of the digital inputs: without it their bus load has no bound
_TPDOS: Final = 4


@final
class AmplifierNode:
    """One I/O node, by node-ID; `open_node` returns a shared one.

    Attributes:
        node: the received state of the node.
        inputs: 6000h:1 as received last; `inputs_ns`: its time (-1: never).
        on_inputs: callbacks for received inputs.
        on_facts: callbacks during the bring-up, before the node is OPERATIONAL.
        cycle: the clock of all servos on its bus.
        users: the number of motors that share it.
        occupation: the occupation of the node by the servos of one process.
    """

    def __init__(
        self, bus: "can.BusABC", node_id: int, runtime: "Runtime", options: IoOptions
    ) -> None:
        self.options: Final = options
        canopen_bus = open_bus(bus, runtime)
        self.link: Final = canopen_bus.link
        if options.heartbeat_ms and (
            node_id == options.host_node_id or canopen_bus.is_host(node_id)
        ):
            release_bus(canopen_bus)
            raise UsageError(
                f"{self.link.name} node {node_id}: node {node_id} is also the host's node-ID; give"
                " the host another host_node_id"
            )
        self.node: Final = CanopenNode(canopen_bus, node_id, options, _OBJECTS)
        locks = node_locks(bus, runtime, node_id, self.node.label)
        self.occupation: Final = NodeOccupation(locks[0], self.node)
        self.node.sdo.process_lock = self._sdo_lock = locks[1]
        if self.occupation.fence is not None:
            self.node.sdo.fence = canopen_bus.fences[node_id] = self.occupation.fence
        self.inputs: int = 0
        self.inputs_ns: int = -1
        self.users: int = 0
        self.is_closed: bool = False
        self.on_inputs: list[Callable[[int], None]] = []
        self.on_facts: list[Callable[[IoFacts], None]] = []
        self.facts: IoFacts | None = None
        self.cycle: Final[Cycle] = cycle_of(canopen_bus, options.cycle_ms / 1e3)
        self._pairs: tuple[ChannelPair, ...] = ()
        self._outputs = 0
        self._inputs_id: int | None = None
        self._setting_up = TurnLock(runtime)

    def close(self) -> None:
        """Close the node; its supervision of the host then switches its outputs off."""
        if self.is_closed:
            return
        self.is_closed = True
        self.facts = None
        nodes = _nodes(self.link.bus)
        if nodes.get(self.node.node_id) is self:
            del nodes[self.node.node_id]
        for pair in self._pairs:
            pair.close()
        self.node.close()
        if self._inputs_id is not None:
            self.link.ignore(self._inputs_id)
        release_bus(self.node.bus)

    def place(self, channel: int, axis: Axis) -> ChannelPair:
        """Assign the channel to `axis`, and return its frames."""
        pair = self._pairs[(channel - 1) // 2]
        pair.place((channel - 1) % 2, axis)
        return pair

    # --- digital outputs and inputs --------------------------------------------------------

    def switch(self, channel: int, on: bool) -> None:
        """Switch the enable input of the channel's amplifier, as soon as the bus allows.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another process's servo runs on the node.
        """
        facts = self.facts
        bit = 1 << channel - 1
        self._outputs = self._outputs | bit if on else self._outputs & ~bit
        if facts is not None:
            frame = can_frame(facts.enable_id, bytes((self._outputs,)))
            self.link.send(frame, self.occupation.outputs)

    def is_switched(self, channel: int) -> bool:
        """Return whether the amplifier's enable input is on, as far as the host knows."""
        return self._outputs >> channel - 1 & 1 != 0

    def status(self, channel: int) -> int:
        """Return READY and FAULT of the channel's amplifier, as received last."""
        return self.inputs >> 2 * (channel - 1) & 3

    def _on_inputs(self, frame: bytes, time_ns: int) -> None:
        if frame[4] != 1:
            self.node.malformed += 1
            return
        self.inputs_ns = time_ns
        if frame[8] != self.inputs:
            self.inputs = frame[8]
            self.node.news.count += 1
        for action in self.on_inputs:
            action(time_ns)

    # --- bring-up --------------------------------------------------------------------------

    @property
    def is_up(self) -> bool:
        """True if the node is still configured and OPERATIONAL."""
        return self.facts is not None and self.node.is_up

    def doubt(self) -> None:
        """Discard all knowledge of the node; `connect` brings it up as if it were new."""
        self.facts = None

    def release(self) -> None:
        """Count one user less; the last one closes the node."""
        self.users -= 1
        if self.users == 0:
            self.close()

    def connect(self) -> IoFacts:
        """Bring the node up and configure it, unless that was done already.

        Raises:
            LinkError: this object was closed.
            DeadlineExceeded: the node does not answer.
            UsageError: the device is not such an I/O node.
            UnsupportedError: the node refuses the PDOs that a servo needs.
        """
        facts = self.facts
        if facts is not None:
            self.node.look_for_restart()
            if self.node.is_up:
                return facts
        if self.is_closed:
            raise LinkError(link=self.node.label, reason="this hardware object is closed")
        options = self.options
        what = f"{self.node.label}: its set-up"
        with self._setting_up.turn(4 * options.connect_timeout_s, what):
            if self.facts is not None and self.node.is_up:
                return self.facts
            self.facts = None  # after a failure, the next call tries again
            with self._setting_up_alone():
                self.facts = self._bring_up()
            return self.facts

    @contextmanager
    def _setting_up_alone(self) -> Iterator[None]:
        """Exclude other processes from the set-up, and protect their servos from writes."""
        if self._sdo_lock is None:
            yield
            return
        runtime, sdo = self.link.runtime, self.node.sdo
        timeout_s = 4 * self.options.connect_timeout_s
        with ExitStack() as held:
            what = f"set-up of {self.node.label}"
            held.enter_context(self._sdo_lock.acquire(runtime, what, timeout_s, sdo))

            def own() -> None:
                if not self.occupation.is_here:
                    held.enter_context(self.occupation.occupied())

            sdo.before_writing = own
            try:
                yield
            finally:
                sdo.before_writing = None

    def _bring_up(self) -> IoFacts:
        node, options = self.node, self.options
        node.may_change_state()
        node.first_answer()
        boot = node.boots
        channels = self._count_channels()
        sync_id = node.read_optional(0x1005)
        if sync_id is not None and sync_id & 0x7FF != SYNC_ID:
            raise UsageError(
                f"{node.label}: its SYNC is {sync_id & 0x7FF:03X}h, ours {SYNC_ID:03X}h"
            )
        limitations: list[str] = []
        self._set_up_dead_man(channels, limitations)
        self._outputs = node.read_optional(OUTPUTS, 1) or 0
        pdos = PdoSetUp(node)
        enable = pdos.configure(PdoWish(False, 1, (OUTPUTS << 16 | 0x108,), EVENT_DRIVEN))
        inputs = pdos.configure(
            PdoWish(
                *(True, 1, (INPUTS << 16 | 0x108,), EVENT_DRIVEN),
                inhibit_100us=_INHIBIT_100US,
                event_ms=options.status_period_ms,
            )
        )
        pairs: list[tuple[int, int]] = []
        for first in range(1, channels + 1, 2):
            places = range(first, min(first + 1, channels) + 1)
            outputs = tuple(ANALOGUE_OUTPUT << 16 | place << 8 | 16 for place in places)
            counts = tuple(options.counter << 16 | place << 8 | 32 for place in places)
            number = 2 + first // 2
            out = pdos.configure(PdoWish(False, number, outputs, SYNCHRONOUS))
            back = pdos.configure(PdoWish(True, number, counts, SYNCHRONOUS))
            if out is not None and back is not None:
                pairs.append((out[0], back[0]))
        if enable is None or inputs is None or len(pairs) < (channels + 1) // 2:
            raise UnsupportedError(
                motor=node.label,
                feature="a servo on the host",
                supported="; ".join(pdos.refusals),
            )
        for number in range(2 + len(pairs), _TPDOS + 1):
            pdos.switch_off(number, keep=None)
        self._inputs_id = inputs[0]
        self.link.handle(inputs[0], self._on_inputs)
        self._pair_up(pairs)
        facts = IoFacts(channels, enable[0], tuple(pairs), boot, tuple(limitations))
        for action in tuple(self.on_facts):
            action(facts)
        sent = node_traffic(node.node_id, facts, inputs, options)
        note_node(self.link.bus, node.node_id, sent)
        pdos.finish()
        self._await_inputs()
        node.stays_operational()
        return facts

    def _pair_up(self, identifiers: list[tuple[int, int]]) -> None:
        if [pair.identifiers for pair in self._pairs] == identifiers:
            return
        for pair in self._pairs:
            pair.close()
        self._pairs = tuple(
            ChannelPair(self.cycle, self.node, both, self.options.misses_max, self.occupation)
            for both in identifiers
        )

    def _count_channels(self) -> int:
        node, counter = self.node, self.options.counter
        outputs, counters = node.read_optional(ANALOGUE_OUTPUT), node.read_optional(counter)
        if not outputs or not counters or node.read_optional(OUTPUTS) is None:
            lacking = [
                f"{index:04X}h"
                for index, number in ((ANALOGUE_OUTPUT, outputs), (counter, counters))
                if not number
            ]
            raise UsageError(
                f"{node.label} is not an I/O node with analogue outputs and encoder counters: "
                f"{', '.join(lacking) or '6200h'} missing"
            )
        return min(outputs, counters, CHANNELS_MAX)

    def _set_up_dead_man(self, channels: int, limitations: list[str]) -> None:
        """Set up mutual supervision; without us all outputs go to 0, and all amplifiers off."""
        node, options = self.node, self.options
        bits = (1 << channels) - 1
        for index, wanted in ((0x6206, bits), (0x6207, 0)):
            found = node.read_optional(index, 1)
            value = (0 if found is None else found & ~bits) | wanted
            node.write_if_different(
                (index, 1), value, 1, limitations, "the fault state of its outputs"
            )
        for channel in range(1, channels + 1):
            meaning = f"the fault state of output {channel}"
            node.write_if_different((0x6443, channel), 1, 1, limitations, meaning)
            node.write_if_different((0x6444, channel), 0, 4, limitations, meaning)
        what = "its heartbeat, so its loss is not detected"
        node.write_if_different((0x1017, 0), options.heartbeat_ms, 2, limitations, what)
        if options.heartbeat_ms and options.heartbeat_timeout_ms:
            consumer = options.host_node_id << 16 | options.heartbeat_timeout_ms
            what = "its supervision of us, so it does not detect our loss"
            node.write_if_different((0x1016, 1), consumer, 4, limitations, what)
            if node.read_optional(0x1017) == options.heartbeat_ms:
                node.expect_heartbeat()

    def _await_inputs(self) -> None:
        """Await the digital inputs, which the node sends when it becomes OPERATIONAL."""
        before_ns = self.inputs_ns
        timeout_s = max(_FIRST_INPUTS_S, 3 * self.options.status_period_ms / 1e3)
        if not self.link.wait_until(lambda: self.inputs_ns != before_ns, timeout_s):
            raise DeadlineExceeded(
                awaited=f"{self.node.label}: its digital inputs",
                timeout_s=timeout_s,
                last_heard="nothing in OPERATIONAL",
            )


@final
class _Nodes:
    """The I/O nodes on one bus, by node-ID."""

    def __init__(self) -> None:
        self.nodes: Final[dict[int, AmplifierNode]] = {}


def _nodes(bus: "can.BusABC") -> dict[int, AmplifierNode]:
    return context_of(bus).medium.part(_Nodes).nodes


def open_node(
    bus: "can.BusABC", node_id: int, runtime: "Runtime", options: IoOptions
) -> AmplifierNode:
    """Return the node of this ID on this bus, made on first use.

    Raises:
        UsageError: it is used with other options already.
    """
    nodes = _nodes(bus)
    io = nodes.get(node_id)
    if io is None:
        io = nodes[node_id] = AmplifierNode(bus, node_id, runtime, options)
    elif io.options != options:
        raise UsageError(
            f"{io.node.label} is used with other settings already; motors on one node share its"
            " settings"
        )
    io.users += 1
    return io


READY: Final = 1
_REPEAT_S: Final = 0.01
_REPEATS: Final = 500


@final
class SwitchOff:
    """A command that clears the enable input of one amplifier, every 10 ms until it is confirmed.

    Without it, an amplifier that missed the one frame would keep its last current while its node
    hears the host. The loop is open, and no supervision helps. Meanwhile this process occupies the
    node; otherwise another process could enable an amplifier that is then switched off again.

    Args:
        io: the node.
        channel: the channel of the amplifier.
        hold: the occupation of the node, released at the end; None: no other process can have it.
    """

    def __init__(self, io: "AmplifierNode", channel: int, hold: "LockHandle | None") -> None:
        self._io = io
        self._channel = channel
        self._hold = hold
        self._left = _REPEATS
        self._since_ns = io.link.runtime.now_ns()
        self._registration = io.link.runtime.every(_REPEAT_S, self._again)

    def see(self, time_ns: int) -> None:
        """Evaluate digital inputs received from the node."""
        if time_ns > self._since_ns and not self._io.status(self._channel) & READY:
            self.end()

    def _again(self) -> None:
        if not self._left:
            self.end()
            return
        self._left -= 1
        try:
            self._io.switch(self._channel, False)
        except LinkError:
            pass  # the bus may accept the next one
        except MotorBusyError:
            self.end()  # another process owns the node now, and the amplifier

    def end(self) -> None:
        """End the repetition and release the node; further calls do nothing."""
        self._registration.cancel()
        hold, self._hold = self._hold, None
        if hold is not None:
            hold.release()
