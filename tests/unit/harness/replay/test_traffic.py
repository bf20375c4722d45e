"""Traffic replay in virtual time: the schedule, to the nanosecond."""

import json
import random
import struct
from fractions import Fraction
from itertools import pairwise

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.cli.main import main
from motorhil.harness.replay.frames import (
    STRAY_NS,
    STUCK_S,
    Choice,
    Lateness,
    Pauses,
    SendError,
    TrafficReplay,
    refuse_long,
    survey,
)
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.traces.can_frame import ERR, flexible
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import record_frames, recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import Direction
from tests.support.recordings.written import can_frame

S = 1_000_000_000
MS = 1_000_000
BEGIN = 1_763_000_000 * S + 17  # a recording in wall time
RIG = str(EXAMPLES / "two_wheels.toml")
DELAYS = st.lists(st.integers(0, 2_000) | st.integers(0, 10**12), min_size=1, max_size=200)


class Told:
    """A sink that takes every frame and notes the time."""

    name = "told"

    def __init__(self, runtime=None, carries_fd=False):
        self.carries_fd = carries_fd
        self.sent = []
        self.ready = True
        self._runtime = runtime

    def send(self, frame):
        self.sent.append((self._runtime.now_ns() if self._runtime else 0, frame))

    def is_ready(self):
        return self.ready

    def is_empty(self):
        return True


@pytest.fixture
def runtime():
    runtime = VirtualRuntime(EventQueue())
    runtime.run_for(0.123456789)  # the replay begins at an arbitrary time
    yield runtime
    runtime.close()


def an_hour():
    """Yield frames of one hour: 16 per second at random times with a fixed seed."""
    draw = random.Random("an hour")
    time_ns = BEGIN
    for number in range(3600 * 16):
        yield Frame(time_ns, "can0", can_frame(0x100 + number % 8, struct.pack("<I", number)))
        time_ns += draw.randrange(1, 2 * S // 16)


@pytest.mark.parametrize("speed", [Fraction(1), Fraction(3), Fraction(1, 7)])
def test_schedule_after_an_hour_has_no_drift(runtime, speed):
    began = runtime.now_ns()
    frames = list(an_hour())
    sink = Told(runtime)
    done = TrafficReplay({"can0": sink}, runtime, frames[0].time_ns, speed).run(frames)
    assert [frame for _, frame in sink.sent] == [frame.frame for frame in frames]
    worst = max(
        abs(at - began - (frame.time_ns - BEGIN) / speed)
        for (at, _), frame in zip(sink.sent, frames, strict=True)
    )
    assert worst < 1  # ns; and the hour is one hour
    assert 0.98 * 3600 * S < (sink.sent[-1][0] - began) * speed < 1.02 * 3600 * S
    assert done.late.worst_ns == 0
    assert done.late.count == len(frames) == done.sent["can0"]


def test_max_speed_sends_without_waiting(runtime):
    sink = Told(runtime)
    frames = list(an_hour())[:1000]
    began = runtime.now_ns()
    done = TrafficReplay({"can0": sink}, runtime, BEGIN, None).run(frames)
    assert {at for at, _ in sink.sent} == {began}
    assert done.sent == {"can0": 1000}


def test_late_frames_are_sent_at_once_without_shift(runtime):
    """A bus that is not ready delays due frames; later frames are on time again."""
    sink = Told(runtime)
    frames = [Frame(BEGIN + k * 10 * MS, "can0", can_frame(k)) for k in range(10)]

    def hold(time_ns, number):
        if number == 2:
            sink.ready = False
            runtime.spawn("release", lambda: (runtime.run_for(0.045), setattr(sink, "ready", True)))

    began = runtime.now_ns()
    done = TrafficReplay({"can0": sink}, runtime, BEGIN).run(frames, hold)
    at = [(time_ns - began) // MS for time_ns, _ in sink.sent]
    assert at == [0, 10, 20, 65, 65, 65, 65, 70, 80, 90]
    assert done.late.worst_ns == 35 * MS
    assert done.late.last_ns == 0
    assert done.late.quantile_ns(0.5) == 0


def test_stuck_bus_is_reported_by_name(runtime):
    sink = Told(runtime)
    sink.ready = False
    replay = TrafficReplay({"can0": sink}, runtime, BEGIN)
    with pytest.raises(SendError, match="told: has taken no frame for 2 s"):
        replay.run([Frame(BEGIN, "can0", can_frame(1))])
    assert replay.done.sent == {}
    assert STUCK_S == 2.0


def test_backward_stamps_keep_file_order(runtime):
    times = [5 * MS, 3 * MS, 9 * MS, 8 * MS]
    frames = [Frame(BEGIN + t, "can0", can_frame(k)) for k, t in enumerate(times)]
    sink = Told(runtime)
    began = runtime.now_ns()
    TrafficReplay({"can0": sink}, runtime, survey(frames).first_ns).run(frames)
    assert [frame[0] for _, frame in sink.sent] == [0, 1, 2, 3]
    assert [(at - began) // MS for at, _ in sink.sent] == [2, 2, 6, 6]


def refusal(*stamps_ns, longest_s=86_400.0):
    """Return the message about these stamps on one bus, or ""."""
    pauses = Pauses()
    for stamp_ns in stamps_ns:
        pauses.take("can0", stamp_ns)
    try:
        pauses.refuse("it.log", longest_s)
    except TraceError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("side", [1, -1])
def test_stamp_apart_from_both_neighbours_is_refused(side):
    near, far = BEGIN + side * STRAY_NS, BEGIN + side * (STRAY_NS + 1)
    assert refusal(BEGIN, near, BEGIN) == ""
    word = "after" if side > 0 else "before"
    assert f"is 60 s {word} both its neighbours; expected at most 60 s" in refusal(
        BEGIN, far, BEGIN
    )
    assert refusal(BEGIN, far, far) == ""  # a rest, or a clock that was set


@pytest.mark.parametrize(
    "stamps_s", [(0, 30_000, 30_001), (0, 86_400), (86_400, 0, 1), (0, 80_000, 80_001, 160_000)]
)
def test_pauses_of_up_to_a_day_are_replayed(stamps_s):
    assert refusal(*(BEGIN + stamp_s * S for stamp_s in stamps_s)) == ""


def test_pause_before_the_first_frame_counts():
    """A later frame has the earliest stamp; the replay begins with that."""
    told = refusal(BEGIN, BEGIN - 86_400 * S - 1, BEGIN - 86_400 * S)
    assert "is 86400 s before the first of the recording; expected at most 86400 s" in told


def test_stamps_are_compared_on_their_own_bus():
    pauses = Pauses()
    for number in range(6):  # two recorders whose clocks are an hour apart
        pauses.take(f"can{number % 2}", BEGIN + number % 2 * 3600 * S + number)
    pauses.refuse("it.log", 86_400.0)


def test_choice_by_identifier_excludes_error_frames():
    error = Frame(BEGIN, "can0", struct.pack("<IB3x8s", ERR | 0x204, 8, bytes(8)))
    plain = Frame(BEGIN, "can0", struct.pack("<IB3x8s", 0x204, 8, bytes(8)))
    assert list(Choice(identifiers=(0x204,)).of([error, plain])) == [plain]


def test_error_frames_are_counted_but_not_sent(runtime):
    sink = Told(runtime)
    error = struct.pack("<IB3x8s", ERR | 0x40, 8, bytes(8))
    frames = [
        Frame(BEGIN, "can0", can_frame(1)),
        Frame(BEGIN + 1, "can0", error),
        Frame(BEGIN + 2, "can1", can_frame(2)),
    ]
    done = TrafficReplay({"can0": sink}, runtime, BEGIN).run(frames)
    assert [frame for _, frame in sink.sent] == [can_frame(1)]
    assert (done.sent, done.errors) == ({"can0": 1}, {"can0": 1})
    found = survey(frames)
    assert (found.frames, found.error_frames) == ({"can0": 2, "can1": 1}, {"can0": 1})
    assert (found.first_ns, found.span_ns) == (BEGIN, 2)


def test_can_fd_frames_for_classical_bus_are_refused():
    frames = [Frame(BEGIN, "can0", flexible(1, 0, bytes(12))), Frame(BEGIN, "can0", can_frame(1))]
    found = survey(frames)
    with pytest.raises(SendError, match=r"told: 1 frames of can0 are CAN FD.*nothing was sent"):
        refuse_long(found, {"can0": Told()})
    refuse_long(found, {"can0": Told(carries_fd=True)})
    refuse_long(found, {})  # that bus has no sink


def test_choice_filters_by_bus_identifier_node_and_time():
    frames = [
        Frame(0, "can0", can_frame(0x000, b"\1\0")),  # NMT to all nodes: start
        Frame(1, "can0", can_frame(0x701, b"\5")),
        Frame(2, "can0", can_frame(0x182, b"\5")),
        Frame(3, "can1", can_frame(0x701, b"\5")),
        Frame(4, "can0", can_frame(0x602, bytes.fromhex("2300180190010000"))),  # TPDO 1: 190h
        Frame(5, "can0", can_frame(0x582, bytes.fromhex("6000180100000000"))),
        Frame(6, "can0", can_frame(0x190, b"\5")),
    ]

    def times(**choice):
        return [frame.time_ns for frame in Choice(**choice).of(frames)]

    assert times() == [0, 1, 2, 3, 4, 5, 6]
    assert times(buses=("can1",)) == [3]
    assert times(identifiers=(0x701, 0x182)) == [1, 2, 3]
    assert times(from_ns=2, to_ns=4) == [2, 3]
    assert times(nodes=(1,)) == [0, 1, 3]
    assert times(nodes=(2,), from_ns=1) == [2, 4, 5, 6]


# --- the verb


def recording(tmp_path, frames):
    path = str(tmp_path / "recorded.mcap")
    record_frames(path, frames, {})
    return path


def test_as_traffic_on_rig_keeps_times(capsys, tmp_path):
    frames = [Frame(BEGIN + k * MS, "arm", can_frame(0x123, bytes(8))) for k in range(1000)]
    path, live = recording(tmp_path, frames), str(tmp_path / "live.mcap")
    words = ("replay", path, "--as", "traffic", "--rig", RIG, "--on", "arm=can0", "-o", live)
    assert main(words) == 0
    told = capsys.readouterr().out
    assert told.startswith("1000 frames of arm to can0 in 0.999")
    assert told.endswith(
        "late: median 0.000 ms, 99 % 0.000 ms, worst 0.000 ms, at the end 0.000 ms\n"
    )
    with read_trace(live) as trace:
        mine = [f for f in recorded_frames(trace, Findings()) if f.frame == frames[0].frame]
    assert len(mine) == 1000
    steps = {after.time_ns - before.time_ns for before, after in pairwise(mine)}
    assert steps == {MS}
    assert {frame.direction for frame in mine} == {Direction.TRANSMITTED}


def test_as_traffic_at_max_speed_fills_bus_in_order(capsys, tmp_path):
    data = [struct.pack("<Q", k) for k in range(500)]
    frames = [Frame(k * MS, "can0", can_frame(0x123, one)) for k, one in enumerate(data)]
    path = recording(tmp_path, frames)
    words = ["replay", path, "--as", "traffic", "--speed", "max", "--json"]
    heard, kept = [], []
    opened = Rig.open

    def listening(*args, **options):
        rig = opened(*args, **options)
        kept.append(rig.bus("can0"))
        rig.runtime.listen(kept[0], lambda frame, time_ns, own: heard.append(frame))
        return rig

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Rig, "open", listening)
        assert main([*words, "--rig", RIG]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [frame[8:] for frame in heard if frame[:4] == b"\x23\x01\0\0"] == data
    assert told["sent"] == {"can0": 500}
    assert told["took_ns"] < 500 * 160_000  # 8 data bytes: 111 to 135 bits at 1 Mbit/s
    assert told["recorded_ns"] == 499 * MS


def test_as_traffic_sends_to_python_can_interface(capsys, tmp_path):
    frames = [
        Frame(BEGIN, "can0", can_frame(0x123, b"\1")),
        Frame(BEGIN + 1, "can0", flexible(0x9234_5678, 1, bytes(64))),
    ]
    path = recording(tmp_path, frames)
    words = ("replay", path, "--as", "traffic", "--on", "virtual:traffic", "--speed", "max")
    with can.Bus(interface="virtual", channel="traffic") as bus:
        assert main(words) == 2
        assert "1 frames of can0 are CAN FD" in capsys.readouterr().err
        assert bus.recv(0) is None
        assert main((*words, "--fd")) == 0
        heard = [bus.recv(1), bus.recv(1)]
    assert heard[0].equals(
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\1"),
        timestamp_delta=None,
        check_channel=False,
        check_direction=False,
    )
    assert (heard[1].is_fd, heard[1].bitrate_switch, len(heard[1].data)) == (True, True, 64)
    assert heard[1].arbitration_id == 0x1234_5678


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "no destination given: name a bus with --on can0=vcan0"),
        (("--on", "virtual:1"), "the recording has frames of can0, can1; write --on can0=WHERE"),
        (("--on", "can7=virtual:1"), "the recording has frames of can0, can1"),
        (("--on", "can0=virtual:1", "--on", "can0=virtual:2"), "can0 has a destination already"),
        (("--on", "can0=vcan7"), "--on can0=vcan7: SocketCAN interface vcan7: "),
        (
            ("--on", "can0=hub.sock"),
            "or, for the socket of a hub, write a path with a slash: ./hub",
        ),
        (("--on", "can0=/nowhere/hub"), "no hub answers here"),
        (("--bus", "can9", "--on", "virtual:1"), "holds no CAN frame to send"),
        (("--rig", RIG, "--on", "can0=can7"), "can7"),
    ],
)
def test_as_traffic_unusable_destination_is_one_line_error(capsys, tmp_path, words, told):
    frames = [Frame(BEGIN, "can0", can_frame(1)), Frame(BEGIN, "can1", can_frame(1))]
    path = recording(tmp_path, frames)
    assert main(["replay", path, "--as", "traffic", *words]) == 2
    said = capsys.readouterr()
    assert told in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_as_traffic_reports_buses_without_destination(capsys, tmp_path):
    frames = [Frame(BEGIN, "can0", can_frame(1)), Frame(BEGIN, "can1", can_frame(1))]
    path = recording(tmp_path, frames)
    assert main(["replay", path, "--as", "traffic", "--on", "can0=virtual:1"]) == 0
    said = capsys.readouterr()
    assert "1 frames of can1 are not sent" in said.err
    assert said.out.startswith("1 frames of can0 to can0=virtual:1")


@pytest.mark.parametrize("speed", ["0", "-1", "fast", "nan"])
def test_speed_option_needs_positive_number_or_max(capsys, tmp_path, speed):
    path = recording(tmp_path, [Frame(0, "can0", can_frame(1))])
    assert main(["replay", path, "--as", "traffic", f"--speed={speed}"]) == 2
    assert "is not a number from 0.001 to 1e+06, nor max" in capsys.readouterr().err
    assert main(["replay", path, "--as", "host", "--speed", "max"]) == 2
    assert "give a number" in capsys.readouterr().err


@given(DELAYS, st.sampled_from([0.01, 0.5, 0.99, 1.0]))
def test_quantile_is_at_most_a_32nd_too_large(delays, share):
    late = Lateness()
    for delay in delays:
        late.add(delay)
    exact = next(d for k, d in enumerate(sorted(delays), 1) if k >= share * len(delays))
    assert exact <= late.quantile_ns(share) <= exact + exact / 32
    assert (late.count, late.worst_ns, late.last_ns) == (len(delays), max(delays), delays[-1])


def test_lateness_without_delays_is_zero():
    late = Lateness()
    assert (late.quantile_ns(0.5), late.worst_ns, late.last_ns) == (0, 0, 0)
    late.add(-5)
    assert (late.count, late.worst_ns, late.quantile_ns(1.0)) == (1, 0, 0)


def test_table_size_is_bounded():
    late = Lateness()
    for delay in range(0, 10_000_000, 97):
        late.add(delay)
    assert len(late._counts) < 700
