"""Messages in frames by other descriptions than CANopen: a DBC file, decoders of plug-ins.

A recording names a decoder only by the kind of a controller in its rig, and gets one only if a
package registered it under this name. Code that a recording names is never loaded.
"""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Final, NamedTuple, final

from motorhil.harness.plugins import DECODERS, Plugin, installed, named
from motorhil.harness.recording.dbc import Dbc
from motorhil.traces.decoding.attached_rig import facts_of, place_of
from motorhil.traces.decoding.narrative import BusMessage, Describe
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import Source, recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.records import Attachment

_TEXT_MAX: Final = 200


@final
class GivenDecoder(NamedTuple):
    """A decoder for a node: bus ("" for every bus), node-ID, name of the plug-in or its target."""

    bus: str
    node: int
    name: str


def description_for(
    attachments: Iterable[Attachment],
    dbc: str | None,
    given: Iterable[GivenDecoder],
    tell: Callable[[str], None],
) -> Describe | None:
    """Return what describes the frames of a recording; None if nothing does.

    Args:
        attachments: files of the recording, among them its rig.
        dbc: path of a DBC file; it takes precedence.
        given: decoders that the user names; they take precedence over those of the rig.
        tell: called with one line about a decoder that fails.

    Raises:
        TraceError: the DBC cannot be used, or no decoder has a given name.
    """
    decoders = _Decoders(tell)
    for one in given:
        decoders.add(one.bus, one.node, _plugin(one))
    plugins = installed(DECODERS)
    for table in facts_of(attachments).settings.values() if plugins else ():
        bus, kind = table.get("bus"), table.get("kind")
        node = table.get("node_id", table.get("unit"))
        plugin = plugins.get(kind) if isinstance(kind, str) else None
        if plugin is not None and isinstance(bus, str) and isinstance(node, int):
            decoders.add(bus, node, plugin, table)
    by_file = None if dbc is None else Dbc(dbc)
    if by_file is None:
        return decoders if decoders.count else None

    def describe(bus: str, frame: bytes) -> BusMessage | None:
        return by_file(bus, frame) or decoders(bus, frame)

    return describe


def described_nodes(attachments: Iterable[Attachment]) -> set[tuple[str, int]]:
    """Return the buses and nodes of the controllers whose kind has a decoder."""
    kinds = installed(DECODERS)
    tables = facts_of(attachments).settings.values()
    places = (place_of(table) for table in tables if table.get("kind") in kinds)
    return {place for place in places if place is not None}


def messages_at(
    source: Source, moments: Collection[tuple[str, int]], describe: Describe
) -> dict[tuple[str, int], list[BusMessage]]:
    """Return the known messages of a recording at these moments: bus, log time [ns].

    Raises:
        TraceError: the recording cannot be read, or is damaged.
    """
    found: dict[tuple[str, int], list[BusMessage]] = {}

    def take(frames: Iterable[Frame]) -> None:
        for frame in frames:
            moment = frame.bus, frame.time_ns
            message = describe(frame.bus, frame.frame) if moment in moments else None
            if message is not None:
                found.setdefault(moment, []).append(message)

    if source.format != "mcap":
        take(source.frames(Findings()))
        return found
    with read_trace(source.path, source.memory_max) as trace:
        for time_ns in sorted({time_ns for _, time_ns in moments}):
            take(recorded_frames(trace, Findings(), time_ns, time_ns + 1))
    return found


def _plugin(given: GivenDecoder) -> Plugin:
    try:
        return named(DECODERS, given.name)
    except KeyError:
        known = ", ".join(installed(DECODERS)) or "none"
        raise TraceError(
            f"--decoder {given.name}",
            f"no installed package has a decoder of this name (known: {known})",
            remedy="install the package, or name package.module:function",
        ) from None


@final
class _Decoder:
    """The decoder of one node, which can fail at any time."""

    def __init__(
        self,
        node: int,
        plugin: Plugin,
        table: Mapping[str, object] | None,
        label: str,
        tell: Callable[[str], None],
    ) -> None:
        self._node = node
        self._label = label
        self._tell = tell
        self._has_failed = False
        self._decode: Callable[[bytes], object] | None = None
        try:
            build = plugin.load()
            wants_table = "settings" in inspect.signature(build).parameters
            self._decode = build(node, settings=table) if wants_table else build(node)
        except (Exception, SystemExit) as error:
            self._fail(error)

    def message(self, frame: bytes) -> BusMessage | None:
        """Return the message in a frame; None if the decoder does not know it, or fails."""
        if self._decode is None:
            return None
        try:
            message = self._decode(frame)
            return None if message is None else replace(_checked(message), node=self._node)
        except (Exception, SystemExit) as error:
            self._fail(error)
            return None

    def _fail(self, error: BaseException) -> None:
        if not self._has_failed:
            self._has_failed = True
            told = " ".join(f"{type(error).__name__}: {error}".split())[:_TEXT_MAX]
            self._tell(f"{self._label}: {told}; such frames stay as they are")


def _checked(message: object) -> BusMessage:
    """Return a message that can be printed.

    Raises:
        TypeError: it cannot.
    """
    if not isinstance(message, BusMessage):
        raise TypeError(f"it returns {type(message).__name__}, not BusMessage or None")
    for name, value, unit in message.signals:
        if not (isinstance(name, str) and isinstance(value, int | float | str)):
            raise TypeError(f"its signal {name!r} is {type(value).__name__}, not a number or text")
        if not isinstance(unit, str):
            raise TypeError(f"the unit of its signal {name!r} is {type(unit).__name__}, not text")
    if not (isinstance(message.name, str) and isinstance(message.problem, str)):
        raise TypeError("its message has a name or problem that is not text")
    return message


@final
class _Decoders:
    """The decoders of the nodes; the first that knows a frame describes it."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._by_bus: dict[str, dict[int, _Decoder]] = {}

    @property
    def count(self) -> int:
        """The number of nodes with a decoder."""
        return sum(map(len, self._by_bus.values()))

    def add(
        self, bus: str, node: int, plugin: Plugin, table: Mapping[str, object] | None = None
    ) -> None:
        """Add a node, unless it has a decoder; `table`: its controller's in the rig."""
        if any(node in self._by_bus.get(where, ()) for where in ("", bus)):
            return
        label = f'decoder "{plugin.name}" of node {node}' + (f" on {bus}" if bus else "")
        nodes = self._by_bus.setdefault(bus, {})
        nodes[node] = _Decoder(node, plugin, table, label, self._tell)

    def __call__(self, bus: str, frame: bytes) -> BusMessage | None:
        """Return the message in a frame; None if no decoder knows it.

        Every decoder of the bus gets the frame: an answer may be understood by its request only.
        """
        found: BusMessage | None = None
        for where in (bus, ""):
            for one in self._by_bus.get(where, {}).values():
                message = one.message(frame)
                found = message if found is None else found
        return found
