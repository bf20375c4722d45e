"""Replay of a recorded host against devices, and comparison of their answers.

The player is sans-I/O, and sends a step once everything that the recorded host had waited for has
arrived again. Then the recorded pause is kept after the last of these observations, or after the
host's last frame. An observation that does not arrive within the patience after its time is missed.
The player notes it and continues, as a human operator would. The host's own heartbeat waits for
nothing, and continues while there are steps to send.

Virtual time costs per frame on the bus, so a wait in vain costs what the periodic frames of its
seconds cost. A subject that has let three waits in a row pass without any report gets no patience,
only its recorded time, until it reports again. Their cost is thus bounded by the number of silent
subjects, not by the number of frames.

A recording may begin when its devices had booted already. The player then waits until the live
devices have booted, and both sides are compared from the host's first frame on. Both are decoded
with the same names and objects: those of the recording, completed by those of the rig.
"""

import sys
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.emulators.can.frame import FRAME_BYTES
from motorhil.frozen import frozen
from motorhil.harness.plugins import CONTROLLERS, named, own_eds
from motorhil.harness.recording.decoders import described_nodes, description_for
from motorhil.harness.replay.frames import PAUSE_MAX_S, STRAY_NS, Pauses, duration_ns, never
from motorhil.harness.replay.verdict import meaning_in
from motorhil.harness.rig.config.buses import CAN
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi.runtime.api import Runtime
from motorhil.traces.can_frame import classic
from motorhil.traces.decoding.attached_rig import RecordedNames, names_of, rig_in
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.dynamixel import unit_of
from motorhil.traces.decoding.events import Kind
from motorhil.traces.decoding.narrative import Describe, Line
from motorhil.traces.decoding.objects import ObjectNames
from motorhil.traces.exchange.host import (
    ANSWER,
    HostSide,
    HostStep,
    HostSurvey,
    Listener,
    Subject,
    Told,
    answer_size,
    host_of,
    survey_of,
)
from motorhil.traces.formats.frames import NS
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.mcap.records import Attachment
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import Direction
from motorhil.traces.semantics.diff import (
    Difference,
    ObjectFidelity,
    Tolerance,
    differences,
    fidelity,
    retimed,
    told_by_nodes,
)

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import RigDescription
    from motorhil.harness.rig.rig import Rig

PITCH_NS: Final = 1_000_000
"""The distance of recorded frames without time stamps [ns]."""
PATIENCE_NS: Final = 2_000_000_000
IN_VAIN_MAX: Final = 3
"""The number of waits in vain in a row after which a silent subject gets no more patience."""
_NEVER_NS: Final = 1 << 62
_RESET_ALL: Final = classic(0, b"\x81\x00")
"""The frame of NMT service "reset node" to all nodes (CiA 301)."""
_NMT_START: Final = 1
_RESETS: Final = (0x81, 0x82)
_STARTED_S: Final = 0.05
"""How long devices may need to become operational [s]."""
_TAIL_S: Final = 0.1
"""How long to listen after the end of the recording [s], since devices may be slower now."""
_SDO_REQUEST: Final = 12  # function code of the pre-defined connection set


@final
@frozen
class Missed:
    """An observation that did not arrive: when it was given up, and the last one heard instead."""

    time_ns: int
    awaited: Told
    step: HostStep
    instead: str


@final
class _Heartbeat:
    """Frames of one identifier that are sent by time alone."""

    def __init__(self, steps: list[HostStep], speed: float) -> None:
        self.steps = steps
        self.sent = 0
        self.due_ns = 0
        self._speed = speed
        last = steps[-1].start_ns - steps[-2].start_ns if len(steps) > 1 else None
        self._period_ns = last

    def start(self, begin_ns: int, now_ns: int) -> None:
        self.due_ns = now_ns + round((self.steps[0].start_ns - begin_ns) / self._speed)

    def take(self) -> HostStep:
        """Return the next frame and schedule its successor, at the end with the last period."""
        place = min(self.sent, len(self.steps) - 1)
        step = self.steps[place]
        self.sent += 1
        if self.sent < len(self.steps):
            pause_ns = self.steps[self.sent].start_ns - step.start_ns
            self.due_ns += round(pause_ns / self._speed)
        elif self._period_ns:
            self.due_ns += round(self._period_ns / self._speed)
        else:
            self.due_ns = _NEVER_NS
        return step


@final
class _Reports:
    """The reports about one subject that no wait has passed over, by value.

    Attributes:
        last: the last report; None: none so far.
        in_vain: the number of waits in vain since then.
        is_given_up: True if an answer that was given up may still arrive.
    """

    def __init__(self) -> None:
        self.last: Told | None = None
        self.in_vain: int = 0
        self.is_given_up = False
        self._count = 0
        self._passed = 0
        self._by_value: dict[object, deque[tuple[int, int]]] = {}  # numbers and times [ns]

    def add(self, told: Told) -> None:
        """Add a report."""
        self.last, self.in_vain = told, 0
        self._by_value.setdefault(told.value, deque()).append((self._count, told.time_ns))
        self._count += 1

    def pass_over(self, value: object) -> int | None:
        """Pass over all reports up to the next one of this value, and return its time [ns].

        Return None, and pass over none, if it has not come.
        """
        waiting = self._by_value.get(value, deque())
        while waiting:
            number, time_ns = waiting.popleft()
            if number >= self._passed:
                self._passed = number + 1
                return time_ns
        return None

    def forget(self) -> bool:
        """Pass over all reports; return False if there are none."""
        had_some = self._passed < self._count
        self._passed = self._count
        return had_some


@final
class HostPlayer:
    """Player of one host on all its buses.

    Args:
        steps: the steps of the recording.
        listener: the listener to the live buses.
        begin_ns: the start time of the recording [ns].
        lines: those of the buses that are Modbus lines.
        speed: factor by which pauses are shorter than recorded.
        patience_ns: extra time for each awaited observation, beyond its recorded time [ns].

    Attributes:
        sent: number of frames sent, without heartbeats.
        unsent: number of recorded host frames that cannot be sent (CAN FD, malformed).
        missed: the observations that did not arrive.
        silent: the subjects that got no patience at least once, because they reported nothing.
        pairs: (recorded time, live time) of frames that were on their bus [ns].
        booted: buses and node-IDs of the devices that have booted.
        has_news: True if `next_deadline_ns` may return another time than before.
    """

    def __init__(
        self,
        steps: Sequence[HostStep],
        listener: Listener,
        begin_ns: int = 0,
        lines: Collection[str] = (),
        speed: float = 1.0,
        patience_ns: int = PATIENCE_NS,
    ) -> None:
        self.sent: int = 0
        self.unsent = 0
        self.missed: list[Missed] = []
        self.silent: set[Subject] = set()
        self.pairs: list[tuple[int, int]] = []
        self.booted: set[tuple[str, int]] = set()
        self.has_news: bool = True
        self._steps = [step for step in steps if not step.is_free]
        free: dict[tuple[str, bytes], list[HostStep]] = {}
        for step in steps:
            if step.is_free:
                free.setdefault((step.bus, step.frame[:4]), []).append(step)
        self._heartbeats = [_Heartbeat(one, speed) for one in free.values()]
        self._listener = listener
        self._speed = speed
        self._patience_ns = patience_ns
        self._reports: dict[Subject, _Reports] = {}
        self._anchor = (begin_ns, 0)  # the last known pair of recorded and live time
        self._lines = frozenset(lines)
        self._waiting_since_ns = 0
        self._in_flight: list[HostStep] = []
        self._waits: deque[Told] = deque()
        self._is_started = False
        self._begin()

    def start(self, now_ns: int) -> None:
        """Start the playback at `now_ns`; what was heard before does not count as a report."""
        self._is_started = True
        begin_ns = self._anchor[0]
        self._anchor = (begin_ns, now_ns)
        self._waiting_since_ns = now_ns
        for one in self._heartbeats:
            one.start(begin_ns, now_ns)

    def is_over(self) -> bool:
        """Return True once all steps are sent."""
        return self.sent == len(self._steps)

    def heard(self, bus: str, frame: bytes, now_ns: int, transmitted: bool) -> None:
        """Handle a complete frame on a live bus; `transmitted` marks one of the host's own."""
        if transmitted:
            for place, step in enumerate(self._in_flight):
                if step.bus == bus and step.frame == frame:
                    del self._in_flight[place]
                    self._is_out(step, now_ns)
                    break
            self._listener.decode(bus, frame)
            return
        said = self._listener.decode(bus, frame)
        if said.kind is Kind.BOOT and said.node is not None:
            self.booted.add((bus, said.node))
        if not self._is_started:
            return
        for told in self._listener.told(now_ns, bus, said):
            self._has_reported(told)

    def answered(self, line: str, unit: int, now_ns: int) -> None:
        """Handle a complete answer of a unit on a live line."""
        subject = (line, unit, ANSWER)
        self._has_reported(Told(now_ns, subject, True, "its answer"))

    def next_deadline_ns(self) -> int | None:
        """Return when `take` is due if nothing is heard before [ns]."""
        self.has_news = False
        if self.is_over():
            return None
        due_ns = self._due_ns() if self._is_ready() else self._patient_until_ns()
        return min([due_ns, *(one.due_ns for one in self._heartbeats)])

    def take(self, now_ns: int) -> list[tuple[str, bytes]]:
        """Return (bus, frame) of each frame to send by now."""
        out: list[tuple[str, bytes]] = []
        for one in self._heartbeats:
            while one.due_ns <= now_ns and not self.is_over():
                step = one.take()
                out.append((step.bus, step.frame))
        while not self.is_over():
            if not self._is_ready():
                if now_ns < self._patient_until_ns():
                    break
                self._give_up(now_ns)
                continue
            if self._due_ns() > now_ns:
                break
            step = self._steps[self.sent]
            self._forget_late(step)
            self._forget_before_reset(step)
            out.append((step.bus, step.frame))
            if step.bus in self._lines:  # a line does not report the end of transmission
                self._is_out(step, now_ns + step.end_ns - step.start_ns)
            else:
                self._in_flight.append(step)
            self.sent += 1
            self._waiting_since_ns = now_ns
            self._begin()
        return out

    # ------------------------------------------------------------------------------ inside

    def _has_reported(self, told: Told) -> None:
        self.has_news = True
        self._about(told.subject).add(told)

    def _about(self, subject: Subject) -> _Reports:
        found = self._reports.get(subject)
        if found is None:
            found = self._reports[subject] = _Reports()
        return found

    def _begin(self) -> None:
        """Set up the observations that the next step waits for."""
        if not self.is_over():
            self._waits = deque(self._steps[self.sent].waits)

    def _is_out(self, step: HostStep, now_ns: int) -> None:
        """Note that a frame of the host has been on its bus."""
        self.has_news = True
        self.pairs.append((step.end_ns, now_ns))
        self._know(step.end_ns, now_ns)

    def _is_ready(self) -> bool:
        """Return True if everything that this step waits for has arrived."""
        while self._waits and self._has_come(self._waits[0]):
            self._waits.popleft()
        return not self._waits

    def _has_come(self, awaited: Told) -> bool:
        """Return True if the observation came after those awaited before, and pass over it."""
        time_ns = self._about(awaited.subject).pass_over(awaited.value)
        if time_ns is None:
            return False
        self._know(awaited.time_ns, time_ns)
        return True

    def _patient_until_ns(self) -> int:
        """Return when this step stops waiting [ns]; its recorded wait may be minutes (homing)."""
        recorded_ns, live_ns = self._anchor
        awaited = self._waits[0]
        until_ns = live_ns + round((awaited.time_ns - recorded_ns) / self._speed)
        if self._about(awaited.subject).in_vain >= IN_VAIN_MAX:
            return until_ns
        return max(self._waiting_since_ns, until_ns) + self._patience_ns

    def _give_up(self, now_ns: int) -> None:
        """Give up the observation that this step waits for."""
        awaited = self._waits.popleft()
        heard = self._about(awaited.subject)
        if heard.in_vain >= IN_VAIN_MAX:
            self.silent.add(awaited.subject)
        heard.in_vain += 1
        if awaited.subject[2] == ANSWER:
            instead = "no answer"
            heard.is_given_up = True
        elif heard.last is not None:
            instead = f"last told: {heard.last.text}"
        else:
            instead = "no report received"
        self.missed.append(Missed(now_ns, awaited, self._steps[self.sent], instead))
        self._waiting_since_ns = now_ns
        self._know(awaited.time_ns, now_ns)

    def _forget_late(self, step: HostStep) -> None:
        """Discard an answer that arrived after it was given up, before the next request."""
        can_id = int.from_bytes(step.frame[:4], "little")
        if step.bus in self._lines or can_id >> 7 != _SDO_REQUEST:
            return  # lines may have several requests to one unit in progress
        answers = self._about((step.bus, can_id & 0x7F, ANSWER))
        if answers.is_given_up and answers.forget():
            answers.is_given_up = False

    def _forget_before_reset(self, step: HostStep) -> None:
        """Discard all reports of nodes that the host resets now."""
        if step.bus in self._lines or int.from_bytes(step.frame[:4], "little") or step.frame[4] < 2:
            return
        command, node = step.frame[8:10]
        if command in _RESETS:
            for subject, heard in self._reports.items():
                if subject[0] == step.bus and node in (0, subject[1]):
                    heard.forget()

    def _know(self, recorded_ns: int, live_ns: int) -> None:
        """Set the pair of recorded and live time from which pauses are counted."""
        if recorded_ns >= self._anchor[0]:
            self._anchor = (recorded_ns, live_ns)

    def _due_ns(self) -> int:
        """Return when this step is due, in live time [ns]."""
        recorded_ns, live_ns = self._anchor
        return live_ns + round((self._steps[self.sent].start_ns - recorded_ns) / self._speed)


@final
class ReceiveQueue:
    """A bus listener that ignores all frames before a given frame of its own.

    Args:
        hear: called with each frame, its time [ns], and True if the frame is an own one.
        opening: the frame to wait for; None: listen at once.
    """

    def __init__(self, hear: Callable[[bytes, int, bool], None], opening: bytes | None) -> None:
        self._hear = hear
        self._opening = opening

    def heard(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """Handle a frame that was on the bus."""
        if self._opening is not None:
            if not transmitted or frame != self._opening:
                return
            self._opening = None
        self._hear(frame, time_ns, transmitted)


class Driven(Protocol):
    """The buses and lines that a recorded host drives.

    Attributes:
        runtime: the runtime that provides the time.
        buses, lines: their names.
        what: the name of all of them together, for messages.
    """

    runtime: Runtime
    buses: Sequence[str]
    lines: Sequence[str]
    what: str

    def bit_times_ns(self, bus: str) -> tuple[int, int]:
        """Return the bit times [ns] of a bus: nominal, and in the CAN FD data phase."""

    def send(self, bus: str, frame: bytes) -> None:
        """Queue a can_frame on a bus, or send an ADU on a line."""

    def listen(self, bus: str, player: HostPlayer, opening: bytes | None = None) -> None:
        """Connect the player to a bus or line, from its own frame `opening` on; None: at once."""


@final
@frozen
class Pace:
    """The pace of a replayed host.

    Attributes:
        speed: factor by which the host's pauses are shorter than recorded.
        patience_ns: how much longer than recorded the player waits for an answer [ns].
        reset: reset all nodes by NMT first, so that nodes that run already boot again.
    """

    speed: float = 1.0
    patience_ns: int = PATIENCE_NS
    reset: bool = False


@final
@frozen
class Bench:
    """The known facts about the devices of a rig.

    Attributes:
        names: names and objects of its controllers.
        nodes: buses and node-IDs of its CAN controllers.
    """

    names: RecordedNames
    nodes: frozenset[tuple[str, int]]


def bench_of(description: "RigDescription") -> Bench:
    """Return the facts of a rig; a controller without an EDS has the file of its plugin."""
    names, nodes = RecordedNames(), set()
    for one in description.controllers.values():
        if one.node_id is None:
            continue
        place = one.bus, one.node_id
        names.nodes[place] = one.name
        if description.buses[one.bus].kind != CAN:
            continue
        nodes.add(place)
        given = one.settings.get("eds")
        path = own_eds(named(CONTROLLERS, one.kind).target)
        if isinstance(given, str):
            path = description.folder / given
        if path is not None and path.is_file():
            text = path.read_bytes().decode("cp1252", errors="replace")
            names.objects[place] = ObjectNames(text)
    return Bench(names, frozenset(nodes))


@contextmanager
def prepared(
    recording: Path, buses: Sequence[str], notes: list[str], longest_s: float = PAUSE_MAX_S
) -> Iterator[Path]:
    """Provide a recording whose frames have times, and whose bus is one of these, if possible.

    Frames without time stamps get a pitch in their order. If a recording without a rig has one CAN
    bus, and there is only one here, it has that one's name.

    Args:
        recording: a recording (MCAP).
        buses: the CAN buses of the devices.
        notes: list of remarks to which changes are added.
        longest_s: the longest pause that is replayed [s].

    Raises:
        TraceError: the recording cannot be read, or has a longer pause or a stray stamp.
    """
    with read_trace(recording) as trace:
        topics = {channel.topic for channel in trace.channels.values()}
        recorded = sorted(one for one in topics if one.startswith("/can/"))
        span_ns = trace.span_ns()
        if span_ns is not None and span_ns[1] - span_ns[0] > min(STRAY_NS, longest_s * NS):
            _require_short_pauses(trace, recording, longest_s)
        has_lines = any(one.startswith(("/modbus/", "/serial/")) for one in topics)
        has_rig = any(rig_in(one.data) for one in trace.attachments)
        renamed = {}
        if len(recorded) == len(buses) == 1 and not has_rig:
            name = recorded[0].removeprefix("/can/")
            if name != buses[0]:
                renamed = {recorded[0]: f"/can/{buses[0]}"}
                notes.append(f"bus {name} is replayed on {buses[0]}")
        pitch_ns = 0
        if recorded and not has_lines and span_ns is not None and span_ns[0] == span_ns[1]:
            pitch_ns = PITCH_NS
            notes.append(
                f"the frames have no time stamps; they are taken as {pitch_ns / 1e6:g} ms apart, "
                "so pauses of the host are unknown"
            )
        if not renamed and not pitch_ns:
            yield recording
            return
        with TemporaryDirectory(prefix="motorhil-") as folder:
            target = Path(folder, recording.name)
            with TraceWriter(target, trace.metadata) as writer:
                _copy(trace, writer, renamed, pitch_ns)
            yield target


def _require_short_pauses(trace: Trace, recording: Path, longest_s: float) -> None:
    """Raise TraceError for a stamp that is wrong, or a pause that would be waited for in vain."""
    pauses = Pauses()
    for channel, time_ns, _ in trace.messages():
        pauses.take(channel.topic.rpartition("/")[2], time_ns)
    pauses.refuse(str(recording), longest_s)


def _copy(trace: Trace, writer: TraceWriter, renamed: Mapping[str, str], pitch_ns: int) -> None:
    for one in trace.attachments:
        writer.attach(one.name, one.data, one.media_type, one.log_time_ns)
    channels: dict[int, int] = {}
    for place, (channel, time_ns, payload) in enumerate(trace.messages()):
        if channel.schema is None:
            continue
        if channel.number not in channels:
            topic = renamed.get(channel.topic, channel.topic)
            channels[channel.number] = writer.channel(topic, channel.schema, channel.metadata)
        writer.write(channels[channel.number], time_ns + place * pitch_ns, payload)


@final
@frozen
class Reading:
    """How to read a recording and its replay alike.

    Attributes:
        names: names and objects of the nodes; None: each file's own.
        side: the criterion for frames of the recorded host; None: the purpose of each frame, in
            both files.
        strangers: buses and node-IDs that the recording does not know, and that are not compared.
        from_ns: the times from which the recording and its replay are compared [ns].
    """

    names: RecordedNames | None = None
    side: HostSide | None = None
    strangers: frozenset[tuple[str, int]] = frozenset()
    from_ns: tuple[int, int] = (0, 0)


@final
@frozen
class HostReplay:
    """A finished replay of a host.

    Attributes:
        player: the player of the host.
        reading: how to compare the recording with the replay.
        notes: remarks for the user: the host's own node-ID, a lead-in, missing devices.
    """

    player: HostPlayer
    reading: Reading
    notes: Sequence[str]


def drive(
    driven: Driven,
    recording: Path,
    pace: Pace | None = None,
    host_nodes: Collection[int] = (),
    bench: Bench | None = None,
) -> HostReplay:
    """Send everything the recorded host sent to the devices.

    Args:
        driven: the buses and lines of the devices.
        recording: a recording with a host in it.
        pace: speed, patience and reset; None: as recorded.
        host_nodes: the host's own node-IDs, besides those that the recording shows.
        bench: the facts about the devices; None: unknown.

    Raises:
        TraceError: the recording cannot be read.
        RigError: the recording has no host, or it uses a bus or line that is missing.
    """
    pace = pace or Pace()
    present = None if bench is None else bench.nodes
    notes: list[str] = []
    with read_trace(recording) as trace:
        found = survey_of(trace)
        names = names_of(trace.attachments)
        described = described_nodes(trace.attachments)
        if bench is not None:
            names = names.completed_by(bench.names)
        side = _side_of(found, host_nodes, present, notes)
        steps, unsent = host_of(trace, _listener(names, driven.buses), _lengths(driven), side)
        first_ns, end_ns = trace.span_ns() or (0, 0)
        is_run = "run" in trace.metadata  # from power-on
        begin_ns = 0 if is_run else first_ns
    used = _used_by(steps, driven, recording)
    awaited = set() if is_run else _to_boot(found, pace.reset, side, present)
    _wait_once_for_missing(steps, present, driven.buses)
    if awaited:
        begin_ns = _without_beginning(steps)
    player = HostPlayer(
        *(steps, _listener(names, driven.buses), begin_ns, driven.lines),
        *(pace.speed, pace.patience_ns),
    )
    player.unsent = unsent
    runtime = driven.runtime
    resets = [one for one in used if pace.reset and one in driven.buses]
    for name in driven.buses if awaited else used:
        # Messages from before the reset do not count as answers.
        driven.listen(name, player, _RESET_ALL if name in resets else None)
    for bus in resets:
        driven.send(bus, _RESET_ALL)
    if awaited:
        _lead_in(driven, player, awaited, pace.patience_ns, notes)
        _start_nodes(driven, awaited.intersection(found.operational()), notes)
    began_ns = runtime.now_ns()
    player.start(began_ns)
    while not player.is_over():
        for bus, frame in player.take(runtime.now_ns()):
            driven.send(bus, frame)
        due_ns = player.next_deadline_ns()
        if due_ns is not None:
            left_s = max(0, due_ns - runtime.now_ns()) / 1e9
            runtime.wait_until(_changed(player, due_ns), left_s)
    runtime.wait_until(never, max(0, end_ns - steps[-1].end_ns) / 1e9 + _TAIL_S)
    from_ns = (begin_ns, began_ns + 1) if awaited else (0, 0)
    strangers = frozenset(present or ()) - {*found.running(), *found.nodes(), *described}
    if strangers:
        notes.append(f"not in the recording, so not compared: {_listed(strangers)}")
    _note_silent(player.silent, notes)
    return HostReplay(player, Reading(names, side, strangers, from_ns), notes)


def _side_of(
    found: HostSurvey,
    host_nodes: Collection[int],
    present: Collection[tuple[str, int]] | None,
    notes: list[str],
) -> HostSide:
    """Return the criterion for frames of the host, and note its node-IDs and missing devices."""
    own = [node for _, node in found.hosts_own(present)]
    nodes = frozenset((*host_nodes, *own))
    if not found.by_direction():
        notes.extend(
            f"node {node} is taken as the host's own: it sends only heartbeats, and no device has "
            "this node-ID"
            for node in sorted(nodes - {*host_nodes})
        )
    missing = [] if present is None else [one for one in found.nodes() if one not in present]
    missing = [(bus, node) for bus, node in missing if node not in nodes]
    if missing:
        listed = _listed(missing)
        notes.append(f"the rig lacks recorded devices, which count as disagreement: {listed}")
    return HostSide(found.by_direction(), nodes)


def _listener(names: RecordedNames, buses: Sequence[str]) -> Listener:
    """Return a listener that knows the nodes of these buses."""
    decoders = {}
    for bus in buses:
        nodes = {node: name for (where, node), name in names.nodes.items() if where == bus}
        objects = {node: one for (where, node), one in names.objects.items() if where == bus}
        decoders[bus] = CanopenDecoder(nodes, objects)
    return Listener(decoders)


def _lengths(driven: Driven) -> Callable[[str, bytes], int]:
    """Return a function that gives the duration of a frame on a bus [ns]."""
    bits_ns = {bus: driven.bit_times_ns(bus) for bus in driven.buses}

    def length_ns(bus: str, frame: bytes) -> int:
        bit_ns, data_bit_ns = bits_ns.get(bus, (1000, 1000))
        if len(frame) > FRAME_BYTES and not data_bit_ns:
            raise ValueError("a classical bus does not carry CAN FD frames")
        return duration_ns(frame, bit_ns, data_bit_ns)

    return length_ns


def _used_by(steps: Sequence[HostStep], driven: Driven, recording: Path) -> list[str]:
    """Return the buses and lines that the host uses, if all are there."""
    if all(step.is_free for step in steps):
        what = "holds only heartbeats of a host" if steps else "holds no frame of a host"
        raise RigError(recording, what, "give a recording with commands to devices")
    used = list(dict.fromkeys(step.bus for step in steps))
    for bus in used:
        if bus not in (*driven.buses, *driven.lines):
            known = ", ".join((*driven.buses, *driven.lines))
            problem = (
                f"the recorded host sends on {bus!r}, but {driven.what} has no such bus or line"
            )
            raise RigError(recording, problem, f"available: {known}")
    return used


def _to_boot(
    found: HostSurvey, reset: bool, side: HostSide, present: Collection[tuple[str, int]] | None
) -> set[tuple[str, int]]:
    """Return the devices that must boot before the host, since they ran in the recording.

    Devices of a rig boot at its start, others only after a reset.
    """
    if present is None and not reset:
        return set()
    running = {place for place in found.running() if place[1] not in side.nodes}
    if present is None:
        return running
    # All of a rig boot at its start, also those that the recording does not know.
    return set(present) if running.intersection(present) else set()


def _wait_once_for_missing(
    steps: Sequence[HostStep], present: Collection[tuple[str, int]] | None, buses: Sequence[str]
) -> None:
    """Drop all waits but the first one for each device that the rig lacks."""
    if present is None:
        return
    gone: set[tuple[str, int]] = set()
    for step in steps:
        waits, step.waits = step.waits, []
        for one in waits:
            place = one.subject[:2]
            is_missing = place[0] in buses and place not in present
            if is_missing and place in gone:
                continue
            if is_missing:
                gone.add(place)
            step.waits.append(one)


def _without_beginning(steps: Sequence[HostStep]) -> int:
    """Drop the reports before the host's first frame, and return the start of that frame [ns]."""
    first = next((step for step in steps if not step.is_free), steps[0])
    first.waits = []
    return min(first.start_ns, steps[0].start_ns)


def _lead_in(
    driven: Driven,
    player: HostPlayer,
    awaited: set[tuple[str, int]],
    patience_ns: int,
    notes: list[str],
) -> None:
    """Wait until these devices have booted, at most as long as the player is patient."""
    began_ns = driven.runtime.now_ns()
    driven.runtime.wait_until(lambda: awaited <= player.booted, patience_ns / 1e9)
    took_s = (driven.runtime.now_ns() - began_ns) / 1e9
    note = f"the recording begins after its devices had booted; the host waited {took_s:.3f} s"
    silent = sorted(awaited - player.booted)
    if silent:
        note += f", but {_listed(silent)} did not boot within the patience"
    notes.append(note)


def _start_nodes(driven: Driven, nodes: set[tuple[str, int]], notes: list[str]) -> None:
    """Start devices that were operational when the recording began."""
    if not nodes:
        return
    for bus, node in sorted(nodes):
        driven.send(bus, classic(0, bytes((_NMT_START, node))))
    driven.runtime.wait_until(never, _STARTED_S)
    notes.append(f"operational when the recording began, so started by NMT: {_listed(nodes)}")


def _note_silent(subjects: Collection[Subject], notes: list[str]) -> None:
    """Note the subjects that were awaited without patience."""
    if subjects:
        listed = ", ".join(f"{bus} node {node}: {what}" for bus, node, what in sorted(subjects))
        notes.append(
            f"silent during {IN_VAIN_MAX} waits in a row, so awaited without patience from then "
            f"on: {listed}"
        )


def _listed(nodes: Iterable[tuple[str, int]]) -> str:
    return ", ".join(f"{bus} node {node}" for bus, node in sorted(nodes))


def _changed(player: HostPlayer, due_ns: int) -> Callable[[], bool]:
    return lambda: player.has_news and player.next_deadline_ns() != due_ns


@final
class DrivenRig:
    """The buses and lines of an open rig."""

    def __init__(self, rig: "Rig") -> None:
        self.runtime: Runtime = rig.runtime
        self.buses: Sequence[str] = rig.world.bus_names()
        self.lines: Sequence[str] = rig.world.line_names()
        self.what: str = str(rig.description.source.path)
        self._rig = rig
        self._rests: dict[str, bytearray] = {}  # of incomplete answers, by line

    def bit_times_ns(self, bus: str) -> tuple[int, int]:
        """Return the bit times [ns] of a bus: nominal, and in the CAN FD data phase.

        The latter is 0 on a classical bus.
        """
        found = self._rig.world.bus(bus)
        return found.bit_ns, found.data_bit_ns

    def send(self, bus: str, frame: bytes) -> None:
        """Queue the frame on a bus, or send it on a line."""
        if bus in self.lines:
            line = self._rig.line(bus)
            if line.framing == "rtu":  # an incomplete answer cannot be part of a later one
                self._rests.setdefault(bus, bytearray()).clear()
            line.send(frame)
        else:
            self.runtime.send(self._rig.bus(bus), frame)

    def listen(self, bus: str, player: HostPlayer, opening: bytes | None = None) -> None:
        """Connect the player to a bus or line, from its own frame `opening` on."""
        if bus in self.lines:
            self._listen_to_line(bus, player)
            return

        def hear(frame: bytes, time_ns: int, transmitted: bool) -> None:
            player.heard(bus, frame, time_ns, transmitted)

        self.runtime.listen(self._rig.bus(bus), ReceiveQueue(hear, opening).heard)

    def _listen_to_line(self, name: str, player: HostPlayer) -> None:
        line = self._rig.line(name)
        if line.framing == "serial":
            line.listen(lambda data, time_ns: player.answered(name, unit_of(data), time_ns))
            return
        rest = self._rests.setdefault(name, bytearray())
        is_tcp = line.framing == "tcp"
        unit_at = 6 if is_tcp else 0

        def hear(data: bytes, time_ns: int) -> None:
            rest.extend(data)
            while (size := answer_size(bytes(rest), is_tcp)) is not None and len(rest) >= size:
                if size > unit_at:
                    player.answered(name, rest[unit_at], time_ns)
                del rest[:size]

        line.listen(hear)


def compared(
    recording: Path,
    live: Path,
    pairs: list[tuple[int, int]],
    tolerance: Tolerance,
    reading: Reading | None = None,
) -> tuple[list[ObjectFidelity], list[Difference]]:
    """Compare the live devices with the recorded ones: fidelity by object, and differences.

    Args:
        recording: the recording of the host.
        live: the recording of its replay.
        pairs: (recorded time, live time) of frames in both [ns].
        tolerance: the tolerances of motion.
        reading: how to read both; None: whole, each with its own names.

    Raises:
        TraceError: one of the files cannot be read.
    """
    reading = reading or Reading()
    side = reading.side or HostSide(by_direction=False)
    foreign = reading.side is None or side.by_direction
    sides = side, side if reading.side is None else replace(side, by_direction=True)
    first, second = (
        told_by_nodes(
            meaning_in(
                *(path, "replay", reading.names, _reports(side, reading, from_ns)),
                _description(recording, live) if side.by_direction else None,
            ),
            foreign,
        )
        for path, side, from_ns in zip((recording, live), sides, reading.from_ns, strict=True)
    )
    if pairs:
        first = retimed(first, pairs)
    return fidelity(first, second, tolerance), differences(first, second, tolerance)


def _description(recording: Path, live: Path) -> Describe | None:
    """Return what describes drives with protocols of their own, by the rig of one of the files."""
    attachments: list[Attachment] = []
    for path in (recording, live):
        with read_trace(path) as trace:
            attachments += trace.attachments
    return description_for(attachments, None, (), partial(print, file=sys.stderr))


def _reports(side: HostSide, reading: Reading, from_ns: int) -> Callable[[Line], bool]:
    """Return a function that selects the messages of known devices, from a time on [ns]."""

    def is_report(line: Line) -> bool:
        if line.time_ns < from_ns:
            return False
        if line.said is None or line.identifier is None:  # not a frame of a CAN bus
            return line.message is None or line.direction is Direction.RECEIVED
        is_stranger = (line.place, line.node) in reading.strangers
        return not is_stranger and not side.sent(line.said, line.direction)

    return is_report
