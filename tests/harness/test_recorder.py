import io
import math
import struct

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from emulators.event_queue import EventQueue
from harness.recorder import Recorder, run_metadata
from traces.errors import TraceError
from traces.reader import read_trace
from traces.schema import GROUP_SYNC, MOTOR_LOCK
from traces.writer import TraceWriter

MS = 1_000_000
SECOND = 1_000_000_000
PERIOD = 20 * MS


def can_frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


class Bench:
    """A recorder on an event queue, and what mcap's own reader finds in its file."""

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
        """Each frame tells something new, unless its data are given."""
        self.queue.run_until(time_ns)
        data = struct.pack("<Q", time_ns) if data is None else data
        self.recorder.frame("can0", time_ns, sender, can_frame(0x181, data))

    def messages(self, topic=None):
        """(log time, message) by mcap's own reader, in the order in the file."""
        self.recorder.close()
        self.file.seek(0)
        reader = make_reader(self.file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=topic, log_time_order=False)
        return [(one.message.log_time, one.decoded_message) for one in decoded]


def test_frames_of_all_buses_are_recorded_with_who_sent_them_and_which_way():
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


def test_everything_is_in_the_order_in_which_it_was_told():
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


def test_ten_thousand_frames_keep_their_order_through_all_batches():
    bench = Bench()
    for number in range(10_000):
        bench.recorder.frame("can0", number * 1000, "left", can_frame(number % 0x800))
    assert [(t, m.id) for t, m in bench.messages()] == [
        (number * 1000, number % 0x800) for number in range(10_000)
    ]


def test_events_have_a_level_a_source_and_words():
    bench = Bench()
    for level in ("debug", "info", "warning", "error", "fatal", "odd"):
        bench.recorder.event(7, level, "left", f"an {level}")
    events = [message for _, message in bench.messages("/events")]
    assert [event.level for event in events] == [1, 2, 3, 4, 5, 0]
    assert (events[0].name, events[0].message) == ("left", "an debug")
    assert events[0].timestamp.nanos == 7


# ------------------------------------------------------------------------ the controllers' truth


def test_truth_is_recorded_with_a_field_a_quantity_and_only_when_it_changes():
    bench = Bench()
    for number, position in enumerate([0.0, 0.0, 0.5, 0.5, 0.25]):
        bench.recorder.truth(number * PERIOD, "left", {"position_rad": position, "state": 3})
    found = [(t // PERIOD, m.position_rad) for t, m in bench.messages("/controller/left/truth")]
    assert found == [(0, 0.0), (2, 0.0), (2, 0.5), (4, 0.5), (4, 0.25)]


def test_after_a_pause_the_old_value_is_told_once_more_so_that_a_plot_shows_a_step():
    bench = Bench()
    samples = [(0, 1.0), (1, 2.0), (2, 3.0), (50, 4.0), (51, 5.0)]
    for number, value in samples:
        bench.recorder.truth(number * PERIOD, "left", {"x": value})
    found = [(t // PERIOD, m.x) for t, m in bench.messages("/controller/left/truth")]
    assert found == [(0, 1.0), (1, 2.0), (2, 3.0), (50, 3.0), (50, 4.0), (51, 5.0)]


def test_a_truth_that_is_no_number_does_not_make_a_rig_busy_for_ever():
    bench = Bench()
    for number in range(5):
        bench.recorder.truth(number * PERIOD, "left", {"x": float("nan")})
    found = bench.messages("/controller/left/truth")
    assert len(found) == 1
    assert math.isnan(found[0][1].x)


def test_controllers_of_one_kind_share_a_schema_and_other_quantities_have_their_own():
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


def test_a_controller_whose_quantities_come_and_go_keeps_its_topic():
    bench = Bench()
    for number in range(6):
        values = {"x": float(number)} if number % 2 else {"x": float(number), "y": 0.5}
        bench.recorder.truth(number, "left", values)
    found = bench.messages("/controller/left/truth")
    assert [message.x for _, message in found] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert len({type(message) for _, message in found}) == 2
    bench.file.seek(0)
    assert len(make_reader(bench.file).get_summary().channels) == 2


# -------------------------------------------------------------------------- the motors' state


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


def test_a_motor_is_sampled_at_once_and_then_every_period_while_it_changes():
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


def test_a_motor_at_rest_is_not_looked_at_until_a_frame_of_its_drive_passes():
    bench, motor = motor_bench()
    bench.queue.run_until(PERIOD)
    reads = motor.reads
    bench.queue.run_until(3600 * SECOND)
    assert motor.reads == reads
    bench.frame_at(3600 * SECOND + 1, sender="right")  # somebody else's
    bench.queue.run_until(3601 * SECOND)
    assert motor.reads == reads
    bench.frame_at(3601 * SECOND + 1)
    bench.queue.run_until(3602 * SECOND)
    assert motor.reads == reads + 1  # looked at once, found unchanged
    assert states(bench) == [(0, 0.0)]


def test_a_frame_told_twice_in_a_row_wakes_nobody_once_the_position_is_known():
    bench, motor = motor_bench()
    motor.reading = (None, 0.0, 0.0)
    bench.queue.run_until(SECOND)
    woken = []
    for second, data in enumerate([b"1", b"1", b"1", b"1", b"2", b"1", b"1"], start=1):
        if second == 3:
            motor.reading = (0.0, 0.0, 0.0)  # its units have become known meanwhile
        reads = motor.reads
        bench.frame_at(second * SECOND + 1, data=data)
        bench.queue.run_until((second + 1) * SECOND)
        woken.append(motor.reads > reads)
    assert woken == [True, True, True, False, True, True, False]


def test_a_motor_that_moves_after_a_pause_shows_a_step():
    bench, motor = motor_bench()
    bench.queue.run_until(10 * SECOND)
    motor.reading = (1.0, 0.0, 0.0)
    bench.frame_at(10 * SECOND + 1)
    bench.queue.run_until(11 * SECOND)
    at = 10 * SECOND + PERIOD
    assert states(bench) == [(0, 0.0), (at, 0.0), (at, 1.0)]


def test_what_is_not_known_of_a_motor_is_not_recorded():
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


def test_a_motor_without_known_frames_is_looked_at_every_period():
    bench, motor = Bench(), Motor()
    bench.recorder.watch_motor("m", motor.read)
    bench.queue.run_until(SECOND)
    assert motor.reads == 51
    assert states(bench) == [(0, 0.0)]


def test_motors_are_sampled_in_the_rigs_order_whichever_woke_first():
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


def test_the_last_state_is_recorded_when_the_run_ends_between_two_periods():
    bench, motor = motor_bench()
    bench.queue.run_until(PERIOD)
    motor.reading = (1.0, 0.0, 0.0)
    bench.frame_at(PERIOD + 1)
    bench.recorder.close(PERIOD + 2)
    assert states(bench)[-1] == (PERIOD + 2, 1.0)


# ----------------------------------------------------------------------------- time and faults


def test_a_second_is_in_the_file_when_it_is_over_although_nothing_more_happens():
    bench = Bench()
    bench.frame_at(10 * MS)
    before = len(bench.file.getvalue())
    bench.queue.run_until(SECOND - 1)
    assert len(bench.file.getvalue()) == before
    bench.queue.run_until(SECOND)
    assert len(bench.file.getvalue()) > before


def test_a_rig_at_rest_asks_for_nothing():
    bench, _ = motor_bench()
    for time_ns in (MS, 2 * MS):
        bench.frame_at(time_ns)
    bench.queue.run_until(2 * SECOND)
    assert bench.queue.next_time_ns() is None
    polls = len(bench.polls)
    assert polls <= 4  # first sample, the sample after the frames, the second that ended
    bench.queue.run_until(3600 * SECOND)
    assert len(bench.polls) == polls
    bench.frame_at(3600 * SECOND + 5 * MS)
    bench.queue.run_until(7200 * SECOND)
    assert bench.polls[polls:] == [3600 * SECOND + PERIOD, 3601 * SECOND]


def test_recording_asks_for_at_most_one_call_a_second_for_its_chunks():
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


def test_a_full_disk_is_told_once_and_the_rest_of_the_run_is_not_disturbed(tmp_path):
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


def test_closing_twice_is_closing_once():
    bench = Bench()
    bench.frame_at(1)
    bench.recorder.close()
    size = len(bench.file.getvalue())
    bench.recorder.close(5)
    assert len(bench.file.getvalue()) == size


def test_metadata_of_a_run_tells_seed_rig_command_and_versions():
    tables = run_metadata(seed=7, rig_digest="abc", command_line=["motorhil", "run", "r.toml"])
    assert tables["run"] == {
        "seed": "7",
        "rig_digest": "abc",
        "command_line": "motorhil run r.toml",
    }
    assert set(tables["versions"]) >= {"motorhil", "python", "python-can", "canopen", "zstandard"}


@pytest.mark.parametrize("step_ns", [700_000, 333_333])
def test_two_recorders_told_the_same_write_the_same_messages(step_ns):
    def run():
        bench, motor = motor_bench()
        for number in range(3000):
            motor.reading = (math.sin(number / 100), 0.0, 0.0)
            bench.frame_at(number * step_ns)
        bench.recorder.close(3000 * step_ns)
        return bench.file.getvalue()

    assert run() == run()
