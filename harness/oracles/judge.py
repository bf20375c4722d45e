"""Judgement of a recording by every oracle, in one pass.

    from motorhil.harness.oracles.judge import judge

    for finding in judge("run.mcap"):
        print(finding.oracle, finding.verdict.value, finding.looked, finding.first)

Memory grows with nodes, motors and identifiers, not with time. Each message is read once. For motor
ownership the messages are read twice, and only if ownership is recorded.
"""

import os
from collections.abc import Callable, Collection, Mapping
from typing import Final, final

from motorhil.harness.oracles import ownership
from motorhil.harness.oracles.arrival import Arrival
from motorhil.harness.oracles.base import Finding, Oracle, RecordingContext, Verdict, hooks
from motorhil.harness.oracles.bus import BusListener
from motorhil.harness.oracles.commands import CommandsObeyed, ModeSigns
from motorhil.harness.oracles.drives.listener import DriveListener
from motorhil.harness.oracles.drives.rules import DRIVE_ORACLES
from motorhil.harness.oracles.facts import Facts, subjects_in
from motorhil.harness.oracles.limits import (
    AccelerationLimit,
    PositionLimit,
    TorqueLimit,
    VelocityLimit,
)
from motorhil.harness.oracles.motion import AtRest, Following, TorqueOff
from motorhil.harness.oracles.network import (
    Answers,
    BootUps,
    Confinement,
    FaultsReported,
    Heartbeats,
    OneSender,
    SyncPeriod,
)
from motorhil.harness.oracles.process_data import TpdoTimes
from motorhil.harness.oracles.seen import Incidents, Seen
from motorhil.harness.oracles.services import ErrorsListed, NmtStates, Refusals
from motorhil.harness.oracles.state_machine import StateMachine
from motorhil.traces.decoding.attached_rig import controllers_in, names_of
from motorhil.traces.formats.frames import Findings as Reading
from motorhil.traces.formats.registry import Source, open_source
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.mcap.records import Channel
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    JOINT_STATE,
    LOG,
    MOTOR_LOCK,
    SERIAL_DATA,
    DoublesDecoder,
    FrameDecoder,
    Level,
    LockAction,
    TruthDecoder,
    truth_message_of,
)

ORACLES: Final[tuple[type[Oracle], ...]] = (
    *(PositionLimit, VelocityLimit, AccelerationLimit, TorqueLimit),
    *(StateMachine, AtRest, Following, TorqueOff, FaultsReported),
    *(CommandsObeyed, ModeSigns, Arrival),
    *(SyncPeriod, Heartbeats, Answers, OneSender, BootUps, Confinement),
    *(NmtStates, Refusals, ErrorsListed, TpdoTimes),
    *DRIVE_ORACLES,
)
CATALOGUE: Final = (
    *((one.id, one.promise, one.source, one.needs) for one in ORACLES),
    (ownership.ID, ownership.PROMISE, ownership.SOURCE, ownership.NEEDS),
)
"""Id, promise, source, and the reason why it may be unable to judge."""
IDS: Final = tuple(row[0] for row in CATALOGUE)
_LOST: Final = "frames were lost here"  # as written by `motorhil record`
_START: Final = 1  # of GROUP_SYNC's phases
_ACTIONS: Final[dict[object, LockAction]] = {action.value: action for action in LockAction}
_BACKWARD: Final = "its times go backwards"
_Handler = Callable[[int, bytes], None]


def judge(
    recording: str | os.PathLike[str] | Source | Trace,
    facts: Facts | None = None,
    *,
    only: Collection[str] = (),
    from_ns: int | None = None,
    to_ns: int | None = None,
    note: Callable[[str], None] | None = None,
    seen: Seen | None = None,
) -> list[Finding]:
    """Return the findings of all oracles in the order of IDS.

    A truncated recording is judged as far as it is readable.

    Args:
        recording: an MCAP file, or a file in any format that `motorhil.traces.formats.registry`
        reads.
        facts: facts beyond those of the recording's own rig.
        only: ids of oracles; empty: all.
        from_ns: events from this time on are judged; earlier ones are still decoded [ns].
        to_ns: events before this time are judged [ns].
        note: called at the end with each remark about skipped data.
        seen: filled with faults, limits and alarms that the recording shows, whatever the verdict.

    Raises:
        TraceError: it cannot be read, has an unknown format, or is damaged.
    """
    facts = Facts() if facts is None else facts
    if isinstance(recording, Trace):
        return _judge_trace(recording, facts, only, (from_ns, to_ns), note, seen)
    source = recording if isinstance(recording, Source) else open_source(recording)
    if source.format == "mcap":
        with read_trace(source.path, source.memory_max) as trace:
            return _judge_trace(trace, facts, only, (from_ns, to_ns), note, seen)
    names, drives = names_of(facts.attachments), controllers_in(facts.attachments)
    context = RecordingContext(facts, names, from_ns, to_ns, drives)
    pass_ = Pass(context, only, None if seen is None else Incidents(context))
    pass_.frames_of(source)
    pass_.report_unjudged(note)
    pass_.saw(seen)
    return pass_.findings(None, from_ns, to_ns)


def is_sound(findings: Collection[Finding]) -> bool:
    """Return True if something was judged and nothing was broken."""
    verdicts = [finding.verdict for finding in findings]
    return Verdict.HELD in verdicts and Verdict.BROKEN not in verdicts


def _judge_trace(
    trace: Trace,
    facts: Facts,
    only: Collection[str],
    span_ns: tuple[int | None, int | None],
    note: Callable[[str], None] | None,
    seen: Seen | None,
) -> list[Finding]:
    from_ns, to_ns = span_ns
    own = subjects_in(trace.attachments)
    files = [*trace.attachments, *facts.attachments]
    context = RecordingContext(
        facts.with_more(own), names_of(files), from_ns, to_ns, controllers_in(files)
    )
    pass_ = Pass(context, only, None if seen is None else Incidents(context))
    pass_.messages_of(trace, to_ns)
    pass_.report_unjudged(note)
    if seen is not None:
        seen.motors.update(own)
    pass_.saw(seen)
    return pass_.findings(trace, from_ns, to_ns)


@final
class Pass:
    """Dispatcher of messages to the oracles."""

    def __init__(
        self, context: RecordingContext, only: Collection[str], incidents: Incidents | None = None
    ) -> None:
        self._context = context
        self._only = only
        self._judges = [one(context) for one in ORACLES if not only or one.id in only]
        self._incidents = incidents
        self._oracles = self._judges if incidents is None else [*self._judges, incidents]
        self._on_motion = hooks(self._oracles, "motion")
        self._on_truth = hooks(self._oracles, "truth")
        self._motors: set[str] = set()  # with a state of their own in the recording
        self._buses: dict[str, BusListener] = {}
        self._drives: dict[str, DriveListener] = {}
        self._handlers: dict[int, _Handler | None] = {}
        self._last_ns = 0

    def take_frame(self, time_ns: int, bus: str, frame: bytes, sender: str) -> None:
        """Take a frame from any source."""
        is_known = self._drives_on(bus).take_frame(time_ns, frame, sender)
        self._listener(bus).take(time_ns, frame, sender, is_known=is_known)
        self._last_ns = max(self._last_ns, time_ns)

    def take_bytes(self, time_ns: int, line: str, data: bytes, sender: str) -> None:
        """Take what one sender sent on a serial line without a pause."""
        self._drives_on(line).take_bytes(time_ns, data, sender)
        self._last_ns = max(self._last_ns, time_ns)

    def frames_of(self, source: Source) -> None:
        """Take all frames of a file in a foreign format."""
        reading = Reading()
        for time_ns, bus, frame, _, sender in source.frames(reading):
            self.take_frame(time_ns, bus, frame, sender)
        self.imported(source.format)
        gaps = self._context.gaps
        if reading.problems:
            gaps[f"{len(reading.problems)} of its lines could not be read"] = None
        if reading.backward:
            gaps[_BACKWARD] = None
        if reading.unstamped:
            gaps["its frames have no times"] = None

    def messages_of(self, trace: Trace, to_ns: int | None) -> None:
        """Take all messages of a recording, up to a time."""
        messages = trace.messages(None, None, to_ns)
        for channel, time_ns, payload in messages:
            if channel.number in self._handlers:
                handler = self._handlers[channel.number]
            else:
                handler = self._handlers[channel.number] = self._handler(channel)
            if time_ns >= self._last_ns:
                self._last_ns = time_ns
            elif channel.topic.startswith("/can/"):
                self._context.gaps[_BACKWARD] = None
            if handler is not None:
                try:
                    handler(time_ns, payload)
                except ValueError:
                    self._context.gaps["some of its messages could not be read"] = None
        if "run" not in trace.metadata and "record" not in trace.metadata:
            self.imported(trace.metadata.get("convert", {}).get("format", trace.library))

    def findings(
        self, trace: Trace | None, from_ns: int | None, to_ns: int | None
    ) -> list[Finding]:
        """Return the findings of all oracles."""
        for drives in self._drives.values():
            drives.end(self._last_ns)
        for oracle in self._oracles:
            oracle.end(self._last_ns)
        found = [oracle.finding() for oracle in self._judges]
        if not self._only or ownership.ID in self._only:
            motors = self._context.facts.motors.values()
            places = {one.name: one.place[:2] for one in motors if one.place is not None}
            found.append(ownership.judge_ownership(trace, places, from_ns, to_ns))
        return found

    def report_unjudged(self, note: Callable[[str], None] | None) -> None:
        """Report frames that no oracle has examined."""
        for bus, listener in self._buses.items():
            if note is not None and listener.fd_frames:
                note(f"{listener.fd_frames} CAN FD frames of {bus} are not judged")

    def saw(self, seen: Seen | None) -> None:
        """Fill in what the recording showed."""
        if seen is not None and self._incidents is not None:
            seen.incidents = self._incidents.incidents()
            seen.places.update(self._context.seen_nodes)
            seen.motors |= self._motors

    def imported(self, origin: str) -> None:
        """Note that a foreign recording may be incomplete."""
        if not self._context.facts.is_complete:
            what = f"nothing shows that this recording ({origin or 'of another writer'}) has every"
            self._context.gaps[f"{what} frame; --complete asserts it"] = None

    # --------------------------------------------------------------------------- dispatch

    def _listener(self, bus: str) -> BusListener:
        listener = self._buses.get(bus)
        if listener is None:
            others = [one for one in self._oracles if type(one) not in DRIVE_ORACLES]
            listener = self._buses[bus] = BusListener(bus, self._context, others)
        return listener

    def _drives_on(self, bus: str) -> DriveListener:
        listener = self._drives.get(bus)
        if listener is None:
            listener = self._drives[bus] = DriveListener(bus, self._context, self._oracles)
        return listener

    def _handler(self, channel: Channel) -> _Handler | None:
        schema = channel.schema
        if schema is None or channel.encoding != "protobuf":
            return None
        parts = channel.topic.strip("/").split("/")
        if schema.name == CAN_FRAME.name:
            return self._frames(channel.topic.removeprefix("/can/"))
        if schema.name == SERIAL_DATA.name and len(parts) > 1:
            return self._bytes(parts[1])
        if schema.name == JOINT_STATE.name and len(parts) == 3:
            self._motors.add(parts[1])
            states = DoublesDecoder(JOINT_STATE)
            return lambda time_ns, payload: self._motion(parts[1], time_ns, states.decode(payload))
        if schema.name == MOTOR_LOCK.name and len(parts) == 3:
            return lambda time_ns, payload: self._lock(parts[1], time_ns, payload)
        if schema.name == GROUP_SYNC.name:
            return self._group
        if schema.name == LOG.name:
            return self._event
        message = truth_message_of(schema)
        if message is None or len(parts) < 2:
            return None
        reader = TruthDecoder(message)
        return lambda time_ns, payload: self._truth(parts[1], time_ns, reader.decode(payload))

    def _frames(self, bus: str) -> _Handler:
        take, decode_frame = self._listener(bus).take, FrameDecoder().decode
        drives = self._drives_on(bus)

        def frame(time_ns: int, payload: bytes) -> None:
            data, _, sender = decode_frame(payload)
            take(time_ns, data, sender)

        def drive_frame(time_ns: int, payload: bytes) -> None:
            data, _, sender = decode_frame(payload)
            is_known = drives.take_frame(time_ns, data, sender)
            take(time_ns, data, sender, is_known=is_known)

        return drive_frame if drives.count else frame

    def _bytes(self, line: str) -> _Handler:
        def data(time_ns: int, payload: bytes) -> None:
            fields = decode(SERIAL_DATA, payload)
            content = fields.get("data", b"")
            if isinstance(content, bytes) and not fields.get("spoiled"):
                self.take_bytes(time_ns, line, content, str(fields.get("sender", "")))

        return data

    def _motion(self, motor: str, time_ns: int, values: Mapping[str, float]) -> None:
        for hook in self._on_motion:
            hook(time_ns, motor, values)

    def _truth(self, controller: str, time_ns: int, values: Mapping[str, float]) -> None:
        for hook in self._on_truth:
            hook(time_ns, controller, values)

    def _lock(self, motor: str, time_ns: int, payload: bytes) -> None:
        action = _ACTIONS.get(decode(MOTOR_LOCK, payload).get("action", 0), LockAction.UNKNOWN)
        for oracle in self._oracles:
            oracle.lock(time_ns, motor, action)

    def _group(self, time_ns: int, payload: bytes) -> None:
        values = decode(GROUP_SYNC, payload)
        names = values.get("motor", [])
        motors = [str(name) for name in names] if isinstance(names, list | tuple) else []
        for oracle in self._oracles:
            oracle.group(time_ns, motors, values.get("phase") == _START)

    def _event(self, time_ns: int, payload: bytes) -> None:
        values = decode(LOG, payload)
        text = str(values.get("message", ""))
        if text.endswith(_LOST):
            self._context.gaps["frames were lost while it was recorded"] = None
        elif self._incidents is not None and values.get("level") == Level.ERROR:
            self._incidents.event(time_ns, str(values.get("name", "")), text)
