"""Turns what happens in a rig into a recording: taps for a world, and samples of motors.

The recorder is told everything (`frame`, `truth`, `event`) with its time and asks no clock. Frames
only become a tuple in a list; they are packed in bulk, four times a second.

A rig at rest makes no work: a motor is looked at after a frame of its drive has passed, and again
every period as long as it changes. What a chunk still holds is written when its second is over.
For both the recorder needs to be called at certain times: see `connect`.

A channel is therefore silent while its values stay the same. When they change after such a pause,
the old value is recorded once more before the new one, so that a plot shows a step, not a ramp.
"""

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, final

from harness.build_info import source_digest, version, version_of
from traces.chunk import Entry
from traces.errors import TraceError
from traces.fields import JointStateEncoder, TruthEncoder, encode_log
from traces.protobuf import Message, Value, encode
from traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    MODBUS_ADU,
    Direction,
    Level,
    Schema,
    truth_message,
)
from traces.writer import CHUNK_NS, TraceWriter

PERIOD_NS: Final = 20_000_000
_HAND_OVER_NS: Final = CHUNK_NS // 4  # how long frames wait to be packed in bulk; divides a second
_NEVER: Final = 1 << 62

Reading = tuple[float | None, float | None, float | None]
"""Position [rad or m], velocity [per second], torque or force [N·m or N]; None: not known."""


def run_metadata(
    *, seed: int, rig_digest: str, command_line: Sequence[str]
) -> dict[str, dict[str, str]]:
    """What a recording says about the run that made it; no part of its digest."""
    versions = {"motorhil": version(), "python": sys.version.split()[0], "source": source_digest()}
    for name in ("python-can", "canopen", "pymodbus", "zstandard"):
        versions[name] = version_of(name) or "absent"
    run = {"seed": str(seed), "rig_digest": rig_digest, "command_line": " ".join(command_line)}
    return {"run": run, "versions": versions}


@final
class _Motor:
    """A motor that is looked at while something happens to it."""

    def __init__(
        self, number: int, name: str, channel: int, read: Callable[[], Reading | None]
    ) -> None:
        self.number = number
        self.channel = channel
        self.read = read
        self.encoder = JointStateEncoder(name)
        self.active = True
        self.always = False
        self.has_position = False  # until then its units may become known between two equal frames
        self.payload = b""
        self.sampled_ns = 0


@final
class _Source:
    """A sender on a bus, and the motors whose state its frames carry."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.motors: list[_Motor] = []
        self.last = b""  # of its frames; the same again tells nothing of a motor


@final
class _Truth:
    """A controller whose snapshots are recorded."""

    def __init__(self, channel: int, message: Message, keys: tuple[str, ...]) -> None:
        self.channel = channel
        self.keys = keys
        self.encoder = TruthEncoder(message)
        self.payload = b""
        self.sampled_ns = 0


@final
class Recorder:
    """One recording being made. Times must not decrease from call to call.

    An error (TraceError) is raised once, by whatever call met it; from then on nothing is recorded,
    `error` says why, and the rest of the run is not disturbed.
    """

    def __init__(
        self,
        writer: TraceWriter,
        kinds: Mapping[str, str] | None = None,
        period_ns: int = PERIOD_NS,
        lines: Collection[str] = (),
    ) -> None:
        """What is recorded goes to `writer`, which the recorder closes in the end.

        Args:
            writer: the file.
            kinds: controllers by name, and of which kind each is; other senders are applications.
            period_ns: how often motors are looked at while they change [ns]; the controllers'
                truth is expected at the same period.
            lines: names of those buses that are lines and speak Modbus.
        """
        self.error: TraceError | None = None
        self._writer = writer
        self._kinds: dict[str, str] = dict(kinds or {})
        self._period_ns = period_ns
        self._lines = tuple(lines)
        self._pending: list[Entry] = []
        self._hand_over_ns = 0
        self._due_ns = 0
        self._unwritten = False
        self._closed = False
        self._channels: dict[str, int] = {}
        self._sources: dict[tuple[str, str], _Source] = {}
        self._motor_count = 0
        self._active: list[_Motor] = []
        self._sample_ns = _NEVER
        self._truths: dict[str, _Truth] = {}
        self._all_truths: dict[tuple[str, tuple[str, ...]], _Truth] = {}
        self._keys_of_kind: dict[str, tuple[str, ...]] = {}
        self._set_alarm: Callable[[int | None], None] | None = None

    # ----------------------------------------------------------------------------------- taps

    def frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        """A Linux can_frame or canfd_frame of `sender` was complete on `bus`."""
        try:
            source = self._sources[bus, sender]
        except KeyError:
            source = self._add_source(bus, sender)
        if time_ns >= self._hand_over_ns:
            self._hand_over(time_ns)
        self._pending.append((source.number, time_ns, frame))
        tells_more = frame != source.last
        source.last = frame
        for motor in source.motors:
            if not motor.active and (tells_more or not motor.has_position):
                self._wake(motor, time_ns)

    def adu(
        self,
        line: str,
        now_ns: int,
        start_ns: int,
        end_ns: int,
        sender: str,
        data: bytes,
        spoiled: bool,
    ) -> None:
        """An ADU of `sender` was complete on a line that speaks Modbus."""
        received = sender in self._kinds or sender == line  # the line's own gateway
        values: dict[str, Value] = {
            "direction": Direction.RECEIVED if received else Direction.TRANSMITTED,
            "sender": sender,
            "start_ns": start_ns,
            "end_ns": end_ns,
            "data": data,
        }
        if spoiled:
            values["spoiled"] = True
        if start_ns == end_ns:
            values["tcp"] = True
        self.message(now_ns, f"/modbus/{line}", MODBUS_ADU, values)
        source = self._sources.get((line, sender))
        for motor in () if source is None else source.motors:
            if not motor.active:
                self._wake(motor, now_ns)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """A controller's snapshot; recorded if it is not the one before, bit for bit."""
        known = self._truths.get(controller)
        if known is None or known.keys != tuple(values):
            known = self._add_truth(controller, tuple(values))
        payload = known.encoder.encode(values.values())
        if payload == known.payload:
            return
        if known.payload and time_ns - known.sampled_ns > self._period_ns:
            self._add(time_ns, known.channel, known.payload)
        self._add(time_ns, known.channel, payload)
        known.payload = payload
        known.sampled_ns = time_ns

    def event(self, time_ns: int, level: str, source: str, text: str) -> None:
        """Something happened; `level` is "debug", "info", "warning", "error" or "fatal"."""
        number = Level.__members__.get(level.upper(), Level.UNKNOWN)
        self._add(time_ns, self._channel("/events", LOG), encode_log(time_ns, number, text, source))

    def message(
        self, time_ns: int, topic: str, message: Message, values: Mapping[str, Value]
    ) -> None:
        """A rare message: locks (`traces.schema.MOTOR_LOCK`), groups (`GROUP_SYNC`).

        Raises:
            ValueError: the values do not fit the message.
        """
        self._add(time_ns, self._channel(topic, message), encode(message, values))

    def watch_motor(
        self,
        name: str,
        read: Callable[[], Reading | None],
        heard: Collection[tuple[str, str]] = (),
    ) -> None:
        """The state of this motor is sampled, from the next period on.

        Args:
            name: of the motor.
            read: what the application can know of it now, without asking it; None: nothing yet.
            heard: (bus, sender) of the frames that can change it. Without any, it is looked at
                every period, at rest too.
        """
        channel = self._channel(f"/motor/{name}/state", JOINT_STATE)
        motor = _Motor(self._motor_count, name, channel, read)
        motor.always = not heard
        self._motor_count += 1
        self._active.append(motor)
        for bus, sender in heard:
            source = self._sources.get((bus, sender)) or self._add_source(bus, sender)
            source.motors.append(motor)
        self._sample_ns = 0  # now
        self._arm()

    # ------------------------------------------------------------------------------------ time

    def connect(self, set_alarm: Callable[[int | None], None]) -> None:
        """Whoever owns the time calls `poll` at the time last given to `set_alarm` (None: never).

        On an event queue: `recorder.connect(queue.alarm(recorder.poll).set)`. Without it, call
        `poll` once a period.
        """
        self._set_alarm = set_alarm
        self._arm()

    def poll(self, now_ns: int) -> None:
        """It is `now_ns`: motors that are due are sampled, seconds that are over are written."""
        if now_ns >= self._sample_ns:
            self._sample(now_ns)
        if now_ns >= self._due_ns:
            self._write(now_ns)
            self._unwritten = False
        self._arm()

    def close(self, now_ns: int | None = None) -> None:
        """The file is complete; closing again does nothing.

        Args:
            now_ns: the time; motors are then sampled once more, if something happened to them.

        Raises:
            TraceError: it cannot be completed.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if now_ns is not None:
                self._sample(now_ns)
            self._write(None)
        finally:
            self._writer.close()

    # ---------------------------------------------------------------------------------- inside

    def _add(self, time_ns: int, channel: int, payload: bytes) -> None:
        """An encoded message takes its place behind the frames before it."""
        if time_ns >= self._hand_over_ns:
            self._hand_over(time_ns)
        self._pending.append((-channel, time_ns, payload))

    def _hand_over(self, time_ns: int) -> None:
        """What is pending is with the writer; a new second has begun, if it has."""
        self._write(time_ns)
        self._hand_over_ns = (time_ns // _HAND_OVER_NS + 1) * _HAND_OVER_NS
        if time_ns >= self._due_ns:
            self._due_ns = (time_ns // CHUNK_NS + 1) * CHUNK_NS
            self._unwritten = True
            self._arm()

    def _write(self, now_ns: int | None) -> None:
        pending = self._pending
        self._pending = []
        if self.error is not None:
            return
        try:
            self._writer.extend(pending)
            if now_ns is not None:
                self._writer.advance(now_ns)
        except TraceError as error:
            self.error = error
            raise

    def _arm(self) -> None:
        """The alarm is set to when there is next something to do."""
        if self._set_alarm is not None:
            next_ns = min(self._sample_ns, self._due_ns if self._unwritten else _NEVER)
            self._set_alarm(None if next_ns == _NEVER else next_ns)

    def _wake(self, motor: _Motor, time_ns: int) -> None:
        """The motor is looked at when the next period begins."""
        motor.active = True
        self._active.append(motor)
        if self._sample_ns == _NEVER:
            self._sample_ns = (time_ns // self._period_ns + 1) * self._period_ns
            self._arm()

    def _sample(self, now_ns: int) -> None:
        """All motors that something happened to; those that changed are looked at again."""
        again: list[_Motor] = []
        if self.error is not None:
            self._active.clear()
        self._active.sort(key=_number_of)  # not in the order in which they woke
        for motor in self._active:
            reading = motor.read()
            payload = b""
            if reading is not None:
                payload = motor.encoder.encode(reading[0], reading[1], reading[2])
                motor.has_position = reading[0] is not None
            if payload and payload != motor.payload:
                if motor.payload and now_ns - motor.sampled_ns > self._period_ns:
                    self._add(now_ns, motor.channel, motor.payload)
                self._add(now_ns, motor.channel, payload)
                motor.payload = payload
                motor.sampled_ns = now_ns
                again.append(motor)
            elif motor.always:
                again.append(motor)
            else:
                motor.active = False
        self._active = again
        self._sample_ns = (now_ns // self._period_ns + 1) * self._period_ns if again else _NEVER

    def _channel(self, topic: str, message: Message) -> int:
        """The number of the channel, which is made when it is first used."""
        number = self._channels.get(topic)
        if number is None:
            number = self._channels[topic] = self._new_channel(topic, message)
        return number

    def _new_channel(self, topic: str, message: Message) -> int:
        """The number of a new channel; 0, which nothing is written to, after an error."""
        if self.error is not None:
            return 0
        try:
            return self._writer.channel(topic, Schema.of(message))
        except TraceError as error:
            self.error = error
            raise

    def _add_source(self, bus: str, sender: str) -> _Source:
        if bus in self._lines:
            source = self._sources[bus, sender] = _Source(0)  # its ADUs are messages like others
            return source
        direction = Direction.RECEIVED if sender in self._kinds else Direction.TRANSMITTED
        channel = self._channel(f"/can/{bus}", CAN_FRAME)
        number = self._writer.source(channel, sender, direction) if channel else 0
        source = self._sources[bus, sender] = _Source(number)
        return source

    def _add_truth(self, controller: str, keys: tuple[str, ...]) -> _Truth:
        """A channel for snapshots with these keys; a kind with several sets of keys is numbered."""
        truth = self._all_truths.get((controller, keys))
        if truth is None:
            kind = wanted = self._kinds.get(controller, "controller")
            number = 1
            while self._keys_of_kind.get(kind, keys) != keys:
                number += 1
                kind = f"{wanted}_{number}"
            self._keys_of_kind[kind] = keys
            message = truth_message(kind, keys)
            channel = self._new_channel(f"/controller/{controller}/truth", message)
            truth = self._all_truths[controller, keys] = _Truth(channel, message, keys)
        self._truths[controller] = truth
        return truth


def _number_of(motor: _Motor) -> int:
    return motor.number
