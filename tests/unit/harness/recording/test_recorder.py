import io
import math
import struct

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.recording.recorder import Recorder, run_metadata
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import GROUP_SYNC, MOTOR_LOCK

MS = 1_000_000
SECOND = 1_000_000_000
PERIOD = 20 * MS


def can_frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


class Bench:
    """A recorder on an event queue; its file is read back by mcap's own reader."""

    def __init__(self, kinds=None):
        self.file = io.BytesIO()
        self.queue = EventQueue()
        self.polls = []
        self.recorder = Recorder(TraceWriter(self.file), kinds or {"left": "cia402"})
        self.recorder.connect(self.queue.alarm(self._poll).set)

    def _poll(self, now_ns):
        self.polls.append(now_ns)
        self.recorder.poll(now_ns)

    def frame_at(self, time_ns, sender="left", data=None):
        """Record a frame; without `data`, each frame has new contents."""
        self.queue.run_until(time_ns)
        data = struct.pack("<Q", time_ns) if data is None else data
        self.recorder.frame("can0", time_ns, sender, can_frame(0x181, data))

    def messages(self, topic=None):
        """Return (log time, message) from mcap's own reader, in the order in the file."""
        self.recorder.close()
        self.file.seek(0)
        reader = make_reader(self.file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=topic, log_time_order=False)
        return [(one.message.log_time, one.decoded_message) for one in decoded]


def test_frames_of_all_buses_have_sender_and_direction():
    bench = Bench({"left": "cia402"})
    bench.recorder.frame("can0", 5, "host", can_frame(0x601, b"\x40"))
    bench.recorder.frame("can1", 6, "left", can_frame(0x581, b"\x43"))
    bench.recorder.frame("can0", 7, "host-2", can_frame(0x80))
    everything = bench.messages()
    assert [(t, m.id, m.sender, m.direction) for t, m in everything] == [
        (5, 0x601, "host", 2),
        (6, 0x581, "left", 1),
        (7, 0x80, "host-2", 2),
    ]
    assert [m.sender for _, m in bench.messages("/can/can1")] == ["left"]


def test_messages_are_in_the_order_of_arrival():
    bench = Bench()
    recorder = bench.recorder
    recorder.frame("can0", 1, "left", can_frame(1))
    recorder.event(1, "warning", "left", "heartbeat lost")
    recorder.truth(1, "left", {"position_rad": 0.5})
    recorder.frame("can0", 1, "left", can_frame(2))
    recorder.message(2, "/motor/left/lock", MOTOR_LOCK, {"action": 1, "owner": "a"})
    recorder.message(3, "/group/drive/sync", GROUP_SYNC, {"phase": 1, "skew_s": 1e-4})
    names = [type(message).__name__ for _, message in bench.messages()]
    assert names == ["CanFrame", "Log", "cia402", "CanFrame", "MotorLock", "GroupSync"]


def test_ten_thousand_frames_keep_their_order_in_batches():
    bench = Bench()
    for number in range(10_000):
        bench.recorder.frame("can0", number * 1000, "left", can_frame(number % 0x800))
    assert [(t, m.id) for t, m in bench.messages()] == [
        (number * 1000, number % 0x800) for number in range(10_000)
    ]


def test_events_have_level_source_and_text():
    bench = Bench()
    for level in ("debug", "info", "warning", "error", "fatal", "odd"):
        bench.recorder.event(7, level, "left", f"an {level}")
    events = [message for _, message in bench.messages("/events")]
    assert [event.level for event in events] == [1, 2, 3, 4, 5, 0]
    assert (events[0].name, events[0].message) == ("left", "an debug")
    assert events[0].timestamp.nanos == 7


# ----------------------------------------------------------------------- snapshots of controllers


def test_truth_is_recorded_only_on_change():
    bench = Bench()
    for number, position in enumerate([0.0, 0.0, 0.5, 0.5, 0.25]):
        bench.recorder.truth(number * PERIOD, "left", {"position_rad": position, "state": 3})
    found = [(t // PERIOD, m.position_rad) for t, m in bench.messages("/controller/left/truth")]
    assert found == [(0, 0.0), (2, 0.0), (2, 0.5), (4, 0.5), (4, 0.25)]


def test_truth_after_a_pause_is_recorded_as_a_step():
    bench = Bench()
    samples = [(0, 1.0), (1, 2.0), (2, 3.0), (50, 4.0), (51, 5.0)]
    for number, value in samples:
        bench.recorder.truth(number * PERIOD, "left", {"x": value})
    found = [(t // PERIOD, m.x) for t, m in bench.messages("/controller/left/truth")]
    assert found == [(0, 1.0), (1, 2.0), (2, 3.0), (50, 3.0), (50, 4.0), (51, 5.0)]


def test_constant_nan_truth_is_recorded_once():
    bench = Bench()
    for number in range(5):
        bench.recorder.truth(number * PERIOD, "left", {"x": float("nan")})
    found = bench.messages("/controller/left/truth")
    assert len(found) == 1
    assert math.isnan(found[0][1].x)


def test_controllers_of_one_kind_share_a_schema():
    bench = Bench({"a": "cia402", "b": "cia402", "c": "cia402", "d": "my-io"})
    for name, keys in (("a", "xy"), ("b", "xy"), ("c", "xyz"), ("d", "q"), ("c", "xyz")):
        bench.recorder.truth(1, name, dict.fromkeys(keys, 1.0))
    bench.recorder.close()
    bench.file.seek(0)
    summary = make_reader(bench.file).get_summary()
    schemas = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert schemas == {
        "/controller/a/truth": "motorhil.truth.cia402",
        "/controller/b/truth": "motorhil.truth.cia402",
        "/controller/c/truth": "motorhil.truth.cia402_2",
        "/controller/d/truth": "motorhil.truth.my_io",
    }
    assert len(summary.schemas) == 3


def test_controller_with_changing_quantities_keeps_its_topic():
    bench = Bench()
    for number in range(6):
        values = {"x": float(number)} if number % 2 else {"x": float(number), "y": 0.5}
        bench.recorder.truth(number, "left", values)
    found = bench.messages("/controller/left/truth")
    assert [message.x for _, message in found] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert len({type(message) for _, message in found}) == 2
    bench.file.seek(0)
    assert len(make_reader(bench.file).get_summary().channels) == 2


# -------------------------------------------------------------------------- states of motors


class Motor:
    def __init__(self):
        self.reading = (0.0, 0.0, 0.0)
        self.reads = 0

    def read(self):
        self.reads += 1
        return self.reading


def motor_bench():
    bench, motor = Bench(), Motor()
    bench.recorder.watch_motor("m", motor.read, heard=[("can0", "left")])
    return bench, motor


def states(bench):
    return [(t, m.position) for t, m in bench.messages("/motor/m/state")]


def test_motor_is_sampled_every_period_while_it_changes():
    bench, motor = motor_bench()
    bench.queue.run_until(5 * MS)
    for number in range(1, 4):
        bench.frame_at(number * PERIOD - 1)
        motor.reading = (number / 8, 0.5, -0.25)
    bench.queue.run_until(SECOND)
    found = bench.messages("/motor/m/state")
    assert [t for t, _ in found] == [0, PERIOD, 2 * PERIOD, 3 * PERIOD]
    _, last = found[-1]
    values = (last.name, last.position, last.velocity, last.effort)
    assert values == ("m", 0.375, 0.5, -0.25)


def test_motor_at_rest_is_sampled_only_after_its_frames():
    bench, motor = motor_bench()
    bench.queue.run_until(PERIOD)
    reads = motor.reads
    bench.queue.run_until(3600 * SECOND)
    assert motor.reads == reads
    bench.frame_at(3600 * SECOND + 1, sender="right")  # a frame of another drive
    bench.queue.run_until(3601 * SECOND)
    assert motor.reads == reads
    bench.frame_at(3601 * SECOND + 1)
    bench.queue.run_until(3602 * SECOND)
    assert motor.reads == reads + 1  # sampled once, unchanged
    assert states(bench) == [(0, 0.0)]


def test_repeated_frame_does_not_wake_a_known_motor():
    bench, motor = motor_bench()
    motor.reading = (None, 0.0, 0.0)
    bench.queue.run_until(SECOND)
    woken = []
    for second, data in enumerate([b"1", b"1", b"1", b"1", b"2", b"1", b"1"], start=1):
        if second == 3:
            motor.reading = (0.0, 0.0, 0.0)  # its units are known by now
        reads = motor.reads
        bench.frame_at(second * SECOND + 1, data=data)
        bench.queue.run_until((second + 1) * SECOND)
        woken.append(motor.reads > reads)
    assert woken == [True, True, True, False, True, True, False]


def test_motor_moving_after_a_pause_shows_a_step():
    bench, motor = motor_bench()
    bench.queue.run_until(10 * SECOND)
    motor.reading = (1.0, 0.0, 0.0)
    bench.frame_at(10 * SECOND + 1)
    bench.queue.run_until(11 * SECOND)
    at = 10 * SECOND + PERIOD
    assert states(bench) == [(0, 0.0), (at, 0.0), (at, 1.0)]


def test_unknown_quantities_of_a_motor_are_not_recorded():
    bench, motor = motor_bench()
    motor.reading = None
    bench.queue.run_until(MS)
    motor.reading = (1.0, None, None)
    bench.frame_at(PERIOD + 1)
    bench.queue.run_until(SECOND)
    found = [m for _, m in bench.messages("/motor/m/state")]
    assert [(m.position, m.HasField("velocity"), m.HasField("effort")) for m in found] == [
        (1.0, False, False)
    ]


def test_motor_without_known_frames_is_sampled_every_period():
    bench, motor = Bench(), Motor()
    bench.recorder.watch_motor("m", motor.read)
    bench.queue.run_until(SECOND)
    assert motor.reads == 51
    assert states(bench) == [(0, 0.0)]


def test_motors_are_sampled_in_the_rigs_order():
    bench = Bench({"a": "x", "b": "x"})
    motors = {name: Motor() for name in "ab"}
    for name, motor in motors.items():
        bench.recorder.watch_motor(name, motor.read, heard=[("can0", name)])
    bench.queue.run_until(SECOND)
    for name in "ba":
        motors[name].reading = (1.0, 0.0, 0.0)
        bench.frame_at(SECOND + (1 if name == "b" else 2), sender=name)
    bench.queue.run_until(2 * SECOND)
    joints = [m for t, m in bench.messages() if t == SECOND + PERIOD and m.position == 1.0]
    assert [m.name for m in joints] == ["a", "b"]


def test_last_state_is_recorded_at_the_end_of_the_run():
    bench, motor = motor_bench()
    bench.queue.run_until(PERIOD)
    motor.reading = (1.0, 0.0, 0.0)
    bench.frame_at(PERIOD + 1)
    bench.recorder.close(PERIOD + 2)
    assert states(bench)[-1] == (PERIOD + 2, 1.0)


# ----------------------------------------------------------------------------- time and faults


def test_second_is_written_when_it_is_over():
    bench = Bench()
    bench.frame_at(10 * MS)
    before = len(bench.file.getvalue())
    bench.queue.run_until(SECOND - 1)
    assert len(bench.file.getvalue()) == before
    bench.queue.run_until(SECOND)
    assert len(bench.file.getvalue()) > before


def test_rig_at_rest_causes_no_polls():
    bench, _ = motor_bench()
    for time_ns in (MS, 2 * MS):
        bench.frame_at(time_ns)
    bench.queue.run_until(2 * SECOND)
    assert bench.queue.next_time_ns() is None
    polls = len(bench.polls)
    assert polls <= 4  # first sample, sample after the frames, end of the second
    bench.queue.run_until(3600 * SECOND)
    assert len(bench.polls) == polls
    bench.frame_at(3600 * SECOND + 5 * MS)
    bench.queue.run_until(7200 * SECOND)
    assert bench.polls[polls:] == [3600 * SECOND + PERIOD, 3601 * SECOND]


def test_chunks_need_at_most_one_poll_per_second():
    bench = Bench()
    for number in range(1000):
        bench.frame_at(number * 10 * MS)
    assert bench.polls == [SECOND * number for number in range(1, 10)]


class FullDisk(io.BytesIO):
    name = "full.mcap"

    def __init__(self, room):
        super().__init__()
        self.room = room

    def write(self, data):
        if self.tell() + len(data) > self.room:
            raise OSError(28, "No space left on device")
        return super().write(data)


def test_full_disk_is_raised_once_and_the_run_continues(tmp_path):
    disk, motor, queue = FullDisk(60_000), Motor(), EventQueue()
    recorder = Recorder(TraceWriter(disk))
    recorder.connect(queue.alarm(recorder.poll).set)
    recorder.watch_motor("m", motor.read, heard=[("can0", "left")])
    told = []
    for number in range(20_000):
        try:
            queue.run_until(number * MS)
            recorder.frame(
                "can0", number * MS, "left", can_frame(0x181, struct.pack("<q", -number))
            )
        except TraceError as error:
            told.append(error)
    assert len(told) == 1
    assert told[0] is recorder.error
    assert str(told[0]).startswith("full.mcap: cannot be written: no space left on device")
    recorder.frame("can9", 21 * SECOND, "new", can_frame(1))
    recorder.truth(21 * SECOND, "left", {"x": 1.0})
    recorder.event(21 * SECOND, "info", "a", "b")
    recorder.poll(30 * SECOND)
    recorder.close(31 * SECOND)
    (tmp_path / "a.mcap").write_bytes(disk.getvalue())
    with read_trace(tmp_path / "a.mcap") as trace:
        times = [t for c, t, _ in trace.messages() if c.topic == "/can/can0"]
    assert times == [number * MS for number in range(len(times))]
    assert times


def test_closing_twice_has_no_further_effect():
    bench = Bench()
    bench.frame_at(1)
    bench.recorder.close()
    size = len(bench.file.getvalue())
    bench.recorder.close(5)
    assert len(bench.file.getvalue()) == size


def test_run_metadata_has_seed_rig_command_and_versions():
    tables = run_metadata(seed=7, rig_digest="abc", command_line=["motorhil", "run", "r.toml"])
    assert tables["run"] == {
        "seed": "7",
        "rig_digest": "abc",
        "command_line": "motorhil run r.toml",
    }
    assert set(tables["versions"]) >= {"motorhil", "python", "python-can", "canopen", "zstandard"}


@pytest.mark.parametrize("step_ns", [700_000, 333_333])
def test_two_recorders_with_the_same_input_write_the_same(step_ns):
    def run():
        bench, motor = motor_bench()
        for number in range(3000):
            motor.reading = (math.sin(number / 100), 0.0, 0.0)
            bench.frame_at(number * step_ns)
        bench.recorder.close(3000 * step_ns)
        return bench.file.getvalue()

    assert run() == run()
