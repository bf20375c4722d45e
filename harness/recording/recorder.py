"""Recorder of a rig: taps for a world, and samples of motors.

All data arrive with their time (`frame`, `truth`, `event`); the recorder reads no clock. Frames
only become a tuple in a list, and are packed in bulk four times per second.

A rig at rest causes no work. A motor is sampled after a frame of its drive, and then every period
as long as it changes. The rest of a chunk is written when its second is over. For both, the
recorder must be called at certain times: see `connect`.

So a channel is silent while its values stay the same. When they change after such a pause, the old
value is recorded again before the new one. A plot then shows a step and not a ramp.
"""

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, final

from motorhil.harness.version import source_digest, version, version_of
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.chunk import Entry
from motorhil.traces.mcap.writer import CHUNK_NS, TraceWriter
from motorhil.traces.protobuf import Message, Value, encode
from motorhil.traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    MODBUS_ADU,
    SERIAL_DATA,
    Direction,
    JointStateEncoder,
    Level,
    Schema,
    TruthEncoder,
    encode_log,
    truth_message,
)

PERIOD_NS: Final = 20_000_000
_HAND_OVER_NS: Final = CHUNK_NS // 4  # how long frames wait to be packed in bulk, at most
_NEVER: Final = 1 << 62

Reading = tuple[float | None, float | None, float | None]
"""Position [rad or m], velocity [rad/s or m/s], torque or force [N·m or N]; None if unknown."""


def run_metadata(
    *, seed: int, rig_digest: str, command_line: Sequence[str]
) -> dict[str, dict[str, str]]:
    """Return metadata of the run for the recording; its digest does not include them."""
    versions = {"motorhil": version(), "python": sys.version.split()[0], "source": source_digest()}
    for name in ("python-can", "canopen", "pymodbus", "zstandard"):
        versions[name] = version_of(name) or "absent"
    run = {"seed": str(seed), "rig_digest": rig_digest, "command_line": " ".join(command_line)}
    return {"run": run, "versions": versions}


@final
class _Motor:
    """A motor that is sampled while it changes."""

    def __init__(
        self, number: int, name: str, channel: int, read: Callable[[], Reading | None]
    ) -> None:
        self.number = number
        self.channel = channel
        self.read = read
        self.encoder = JointStateEncoder(name)
        self.active = True
        self.always = False
        self.has_position = False  # until then, units may become known between two equal frames
        self.payload = b""
        self.sampled_ns = 0


@final
class _Source:
    """A sender on a bus, and the motors whose state its frames carry."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.motors: list[_Motor] = []
        self.last = b""  # its last frame; a repetition brings no news about a motor


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
    """One recording in progress. Times must not decrease from call to call.

    An error (TraceError) is raised once, by the call that caused it. From then on nothing is
    recorded, `error` holds the reason, and the run continues undisturbed.
    """

    def __init__(
        self,
        writer: TraceWriter,
        kinds: Mapping[str, str] | None = None,
        period_ns: int = PERIOD_NS,
        lines: Collection[str] = (),
        plain: Collection[str] = (),
    ) -> None:
        """Record to `writer`, which the recorder closes at the end.

        Args:
            writer: the file.
            kinds: kind of each controller by name; other senders are applications.
            period_ns: sampling period of motors while they change [ns]; the controllers' snapshots
                are
                expected at the same period.
            lines: names of the buses that are lines.
            plain: those of them that are not Modbus lines.
        """
        self.error: TraceError | None = None
        self._writer = writer
        self._chunk_ns = writer.chunk_ns
        self._wait_ns = min(_HAND_OVER_NS, writer.chunk_ns)
        self._kinds: dict[str, str] = dict(kinds or {})
        self._period_ns = period_ns
        self._lines = tuple(lines)
        self._plain = frozenset(plain)
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
        """Record a complete Linux can_frame or canfd_frame of `sender` on `bus`."""
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
        """Record a complete ADU of `sender` on a Modbus line, or its bytes on another line."""
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
        if line in self._plain:
            self.message(now_ns, f"/serial/{line}", SERIAL_DATA, values)
        else:
            if start_ns == end_ns:
                values["tcp"] = True
            self.message(now_ns, f"/modbus/{line}", MODBUS_ADU, values)
        source = self._sources.get((line, sender))
        for motor in () if source is None else source.motors:
            if not motor.active:
                self._wake(motor, now_ns)

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Record a controller's snapshot if it differs from the one before in any bit."""
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
        """Record an event; `level` is "debug", "info", "warning", "error" or "fatal"."""
        number = Level.__members__.get(level.upper(), Level.UNKNOWN)
        self._add(time_ns, self._channel("/events", LOG), encode_log(time_ns, number, text, source))

    def message(
        self, time_ns: int, topic: str, message: Message, values: Mapping[str, Value]
    ) -> None:
        """Record a rare message, such as MOTOR_LOCK or GROUP_SYNC.

        Raises:
            ValueError: the values do not fit the message.
        """
        self._add(time_ns, self._channel(topic, message), encode(message, values))

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Record a table of strings, which is no message: the digest does not include it."""
        if self.error is not None:
            return
        try:
            self._writer.add_metadata(name, values)
        except TraceError as error:
            self.error = error
            raise

    def flush(self) -> None:
        """Write everything so far, for readers of a recording whose time stands still."""
        self._write(None)
        if self.error is not None:
            return
        try:
            self._writer.flush()
        except TraceError as error:
            self.error = error
            raise

    def watch_motor(
        self,
        name: str,
        read: Callable[[], Reading | None],
        heard: Collection[tuple[str, str]] = (),
    ) -> None:
        """Sample the state of this motor from the next period on.

        Args:
            name: name of the motor.
            read: returns what the application knows of the motor without querying it; None: nothing
                yet.
            heard: (bus, sender) of the frames that can change it. Without any, it is sampled every
                period, even at rest.
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
        """Set the alarm function; its owner calls `poll` at the time last given (None: never).

        On an event queue: `recorder.connect(queue.alarm(recorder.poll).set)`. Without it, call
        `poll` once per period.
        """
        self._set_alarm = set_alarm
        self._arm()

    def poll(self, now_ns: int) -> None:
        """Sample motors that are due at `now_ns`, and write seconds that are over."""
        if now_ns >= self._sample_ns:
            self._sample(now_ns)
        if now_ns >= self._due_ns:
            self._write(now_ns)
            self._unwritten = False
        self._arm()

    def close(self, now_ns: int | None = None) -> None:
        """Complete the file; closing it again has no effect.

        Args:
            now_ns: the time [ns]; changed motors are then sampled once more.

        Raises:
            TraceError: the file cannot be completed.
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
        """Append an encoded message after the frames before it."""
        if time_ns >= self._hand_over_ns:
            self._hand_over(time_ns)
        self._pending.append((-channel, time_ns, payload))

    def _hand_over(self, time_ns: int) -> None:
        """Pass pending messages to the writer, and start a new second if one has begun."""
        self._write(time_ns)
        self._hand_over_ns = (time_ns // self._wait_ns + 1) * self._wait_ns
        if time_ns >= self._due_ns:
            self._due_ns = (time_ns // self._chunk_ns + 1) * self._chunk_ns
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
        """Set the alarm to the next time when work is due."""
        if self._set_alarm is not None:
            next_ns = min(self._sample_ns, self._due_ns if self._unwritten else _NEVER)
            self._set_alarm(None if next_ns == _NEVER else next_ns)

    def _wake(self, motor: _Motor, time_ns: int) -> None:
        """Sample the motor at the start of the next period."""
        motor.active = True
        self._active.append(motor)
        if self._sample_ns == _NEVER:
            self._sample_ns = (time_ns // self._period_ns + 1) * self._period_ns
            self._arm()

    def _sample(self, now_ns: int) -> None:
        """Sample all active motors; those that changed remain active."""
        again: list[_Motor] = []
        if self.error is not None:
            self._active.clear()
        self._active.sort(key=_number_of)  # makes the order independent of when they woke
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
        """Return the number of the channel, which is created on first use."""
        number = self._channels.get(topic)
        if number is None:
            number = self._channels[topic] = self._new_channel(topic, message)
        return number

    def _new_channel(self, topic: str, message: Message) -> int:
        """Create a channel and return its number; 0, which takes no data, after an error."""
        if self.error is not None:
            return 0
        try:
            return self._writer.channel(topic, Schema.of(message))
        except TraceError as error:
            self.error = error
            raise

    def _add_source(self, bus: str, sender: str) -> _Source:
        if bus in self._lines:
            source = self._sources[bus, sender] = _Source(0)  # its ADUs are ordinary messages
            return source
        direction = Direction.RECEIVED if sender in self._kinds else Direction.TRANSMITTED
        channel = self._channel(f"/can/{bus}", CAN_FRAME)
        number = self._writer.source(channel, sender, direction) if channel else 0
        source = self._sources[bus, sender] = _Source(number)
        return source

    def _add_truth(self, controller: str, keys: tuple[str, ...]) -> _Truth:
        """Create a channel for snapshots with these keys; number a kind's further sets of keys."""
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
