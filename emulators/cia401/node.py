"""A CiA 401 I/O node with amplifiers and encoders; sans-I/O.

Outputs change when their RPDO is processed: at once (types 254, 255) or at SYNC (0 to 240), before
the counters are sampled for the TPDOs of the same SYNC. If the host is lost (heartbeat, NMT stop,
reset of communication), the outputs take their error values and keep them until they are written
again.

| object       | content                                                                     |
| ------------ | --------------------------------------------------------------------------- |
| 6411h:c      | analogue output of channel c, INTEGER16, +-10 V left-adjusted               |
| 6443h, 6444h | its reaction when the host is lost: 0 nothing, 1 takes this value           |
| 6200h:1      | digital outputs; bit c - 1 enables the amplifier of channel c               |
| 6206h, 6207h | their reaction when the host is lost: bits that take a value, and which     |
| 6000h:1      | digital inputs; bits 2c - 2 and 2c - 1 are *ready* and *fault* of channel c |
| 6820h:c      | encoder counter of channel c, INTEGER32, wraps around; 6810h:c sets it      |

CiA 401 has no position counter. Encoders are CiA 406, and a device of two profiles has the objects
of the second one 800h further on (CiA 301, multiple device modules: 1000h is FFFFh, 67FFh and 6FFFh
have the two device types). A counter is therefore 6020h + 800h, "position value for multi-sensor
devices", and its preset 6010h + 800h. Field bus couplers with counter modules use the same objects
(Turck BL20 among them), so other programs know them. The speed value of CiA 406 is left out: its 16
bits contain less than two counts of 32.

Our own EDS is reduced to the channels of the rig. A vendor's EDS is served as it is: objects above
that the file lacks are invisible, and outputs without a channel are plain values.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.canopen.files.device_description import DeviceDescription
from motorhil.emulators.canopen.files.eds import EdsError, read_eds
from motorhil.emulators.canopen.lss import UNCONFIGURED
from motorhil.emulators.canopen.nmt import NmtState
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Variable,
    is_integer,
    length_bits,
)
from motorhil.emulators.canopen.outbox import NEVER, NodeTiming
from motorhil.emulators.cia401.channel import FAULT, READY, STIMULI, Channel
from motorhil.emulators.cia401.settings import (
    CHANNELS_MAX,
    OWN_EDS,
    NodeSettings,
    read_settings,
)
from motorhil.emulators.controller import (
    Controller,
    ControllerContext,
    NonvolatileMemory,
    SettingError,
)
from motorhil.emulators.firmware.clock import on_own_time
from motorhil.emulators.settings.tables import ObjectValue

INPUTS: Final = 0x6000
OUTPUTS: Final = 0x6200
ANALOGUE_OUTPUT: Final = 0x6411
PRESET: Final = 0x6810
POSITION: Final = 0x6820

_ERROR_MODE_8: Final = 0x6206
_ERROR_VALUE_8: Final = 0x6207
_ERROR_MODE: Final = 0x6443
_ERROR_VALUE: Final = 0x6444
_BY_CHANNEL: Final = (ANALOGUE_OUTPUT, _ERROR_MODE, _ERROR_VALUE, PRESET, POSITION)
_LINKED: Final = (ANALOGUE_OUTPUT, POSITION)
_OF_AN_IO_NODE: Final = ((INPUTS, 1), (OUTPUTS, 1), (ANALOGUE_OUTPUT, 1), (POSITION, 1))
_INVALID: Final = 1 << 31
_PREFIX: Final = ("", "channel_2_", "channel_3_", "channel_4_")  # of stimuli and truth, by channel
_D = DataType


@final
class IoObjects:
    """The values that hosts wrote, and the values that they may read.

    Attributes:
        is_written: a write has happened since the node last looked; the node clears this.
        presets: counters to be set, by channel from 0; the node clears them.
    """

    def __init__(self, od: ObjectDictionary, channels: list[Channel]) -> None:
        self.is_written: bool = False
        self.presets: dict[int, int] = {}
        self._channels = channels
        ensure = od.ensure
        self._outputs = ensure(OUTPUTS, 1, _D.UNSIGNED8, 0)
        self._outputs.writer = self._write
        self._error_mode_8 = ensure(_ERROR_MODE_8, 1, _D.UNSIGNED8, 0xFF)
        self._error_value_8 = ensure(_ERROR_VALUE_8, 1, _D.UNSIGNED8, 0)
        self._analogue: list[Variable] = []
        self._error_mode: list[Variable] = []
        self._error_value: list[Variable] = []
        ensure(INPUTS, 1, _D.UNSIGNED8, 0).reader = self.inputs
        for place, channel in enumerate(channels):
            number = place + 1
            output = ensure(ANALOGUE_OUTPUT, number, _D.INTEGER16, 0)
            output.writer = self._write
            self._analogue.append(output)
            self._error_mode.append(ensure(_ERROR_MODE, number, _D.UNSIGNED8, 1))
            self._error_value.append(ensure(_ERROR_VALUE, number, _D.INTEGER32, 0))
            ensure(POSITION, number, _D.INTEGER32, 0).reader = channel.axis.position_inc
            ensure(PRESET, number, _D.INTEGER32, 0).writer = _Preset(self, place).write

    def inputs(self) -> int:
        """Return the digital inputs, 6000h:1."""
        value = 0
        shift = 0
        for channel in self._channels:
            value |= channel.inputs << shift
            shift += 2
        return value

    def apply(self) -> None:
        """Set the outputs from the objects."""
        enables = self._outputs.integer()
        for place, channel in enumerate(self._channels):
            channel.set_output(self._analogue[place].integer())
            channel.set_enabled(enables >> place & 1 != 0)

    def fall_back(self) -> None:
        """Set the outputs to their error values (6206h, 6207h, 6443h, 6444h) without a host."""
        mode = self._error_mode_8.integer()
        self._outputs.value = self._outputs.integer() & ~mode | self._error_value_8.integer() & mode
        for place, output in enumerate(self._analogue):
            if self._error_mode[place].integer() == 1:
                value = self._error_value[place].integer()
                output.value = max(-32768, min(32767, value))

    def _write(self, value: int) -> int:
        self.is_written = True
        return OK


@final
class _Preset:
    """The writer of one channel's preset."""

    def __init__(self, objects: IoObjects, place: int) -> None:
        self._objects = objects
        self._place = place

    def write(self, value: int) -> int:
        self._objects.presets[self._place] = value
        self._objects.is_written = True
        return OK


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

    def tell(self, events: Sequence[tuple[str, str]]) -> None:
        """Add events of the node's making to those of `take_events`."""
        self._events += events

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


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the I/O node that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: its name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong, or the EDS cannot be read; names the keys.
    """
    read = read_settings(settings, context.folder, context.stream())
    built = build_node(read, context.memory(read.nonvolatile_memory))
    return on_own_time(built, read.oscillator)


def build_node(settings: NodeSettings, memory: NonvolatileMemory | None = None) -> IoNode:
    """Build the node with these settings; all calls must use its own clock.

    Raises:
        SettingError: the EDS cannot be read or lacks an indispensable object, or an object of
            `settings.objects` cannot be set.
    """
    try:
        description = read_eds(settings.eds, settings.node_id)
    except EdsError as error:
        place = f"{error.path}:{error.line}" if error.line else str(error.path)
        raise SettingError(("eds",), f"{place}: {error.text}", error.remedy) from error
    is_own = settings.eds == OWN_EDS
    channels = len(settings.channels)
    od = _dictionary(description, channels) if is_own else description.dictionary()
    if not any(od.get(index, subindex) for index, subindex in _OF_AN_IO_NODE):
        missing = ", ".join(f"{index:04X}h:{subindex}" for index, subindex in _OF_AN_IO_NODE)
        raise SettingError(
            ("eds",),
            f"{settings.eds} has none of {missing}: it is not the EDS of an I/O node",
            "leave eds out to use the built-in one",
        )
    for wanted in settings.objects:
        _set(od, wanted, settings.eds.name)
    events = [("warning", f"{path}:{line}: {text}") for path, line, text in description.warnings]
    if not settings.oscillator.is_ideal():
        events.append(("info", settings.oscillator.told()))
    node = IoNode(od, settings, events, memory)
    if not is_own:
        stated = [(wanted.index, wanted.subindex) for wanted in settings.objects]
        lines = _unconnected(od, settings.eds.name, channels) + description.supplied(od, stated)
        node.tell([("info", line) for line in lines])
    return node


def _unconnected(od: ObjectDictionary, file: str, channels: int) -> list[str]:
    """Return which channels a vendor's file does not reach, and which outputs drive nothing."""
    notes = []
    for number in range(1, channels + 1):
        lacking = [f"{index:04X}h:{number}" for index in _LINKED if od.get(index, number) is None]
        if lacking:
            text = f"{file} has no {', '.join(lacking)}: no host reaches this part"
            notes.append(f"channel {number}: {text}; expected only of digital I/O")
    spare = [sub for sub in od.subindices(ANALOGUE_OUTPUT) if sub > channels]
    if spare:
        names = ", ".join(f"{ANALOGUE_OUTPUT:04X}h:{sub}" for sub in spare)
        notes.append(f"{names} of {file} drive no motor: the node has {channels} channels")
    return notes


def _dictionary(description: DeviceDescription, channels: int) -> ObjectDictionary:
    """Return our own file's dictionary, reduced to this number of channels."""
    whole = description.dictionary()
    od = ObjectDictionary()
    od.dummies = whole.dummies
    od.node_id = whole.node_id
    od.supports_lss = whole.supports_lss
    for variable in whole:
        if variable.index not in _BY_CHANNEL or variable.subindex <= channels:
            od.add(variable)
    for index in _BY_CHANNEL:
        count = od.get(index, 0)
        if count is not None and count.integer() > channels:
            count.set_default(channels)
    if channels < CHANNELS_MAX:
        for index in od.indices():
            if 0x1600 <= index <= 0x17FF or 0x1A00 <= index <= 0x1BFF:
                _shorten(od, index, channels)
    return od


def _shorten(od: ObjectDictionary, mapping: int, channels: int) -> None:
    """Remove absent objects from a PDO mapping; a PDO that maps nothing becomes invalid."""
    count = od.get(mapping, 0)
    if count is None or not count.integer():
        return
    entries = [od.integer(mapping, place, 0) for place in range(1, count.integer() + 1)]
    there = [
        entry
        for entry in entries
        if entry >> 16 not in _BY_CHANNEL or (entry >> 8 & 0xFF) <= channels
    ]
    count.set_default(len(there))
    for place in range(1, len(entries) + 1):
        variable = od.get(mapping, place)
        if variable is not None:
            variable.set_default(there[place - 1] if place <= len(there) else 0)
    cob_id = od.get(mapping - 0x200, 1)
    if not there and cob_id is not None:
        cob_id.set_default(cob_id.integer() | _INVALID)


def _set(od: ObjectDictionary, wanted: ObjectValue, file: str) -> None:
    path = ("objects", wanted.key)
    variable = od.get(wanted.index, wanted.subindex)
    if variable is None:
        raise SettingError(path, f"{file} has no such object", "leave it out")
    value = wanted.value
    try:
        if isinstance(value, str):
            if length_bits(variable.data_type):
                raise TypeError(f"{value!r} is not a number")
            variable.set_default(value.encode("utf-8"))
            return
        if is_integer(variable.data_type):
            if isinstance(value, float):
                raise TypeError(f"{value} is not a whole number")
            low, high = variable.low, variable.high
            if (low is not None and value < low) or (high is not None and value > high):
                raise ValueError(f"{value} is outside {low}..{high}")
        variable.set_default(value)
    except (TypeError, ValueError) as error:
        raise SettingError(path, str(error)) from error
