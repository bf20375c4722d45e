"""`motorhil record` in a separate process, with all kinds of ends."""

import json
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager

import can
import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.recording.loop import RecordingLoop
from motorhil.harness.recording.sources import PythonCanTap, parse_place
from motorhil.harness.recording.writer import Pump, Series, opener
from motorhil.traces.can_frame import classic
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import record_frames, recorded_frames
from motorhil.traces.mcap.reader import read_trace
from tests.system.wall.hub.test_hub import serving

pytestmark = pytest.mark.wall

MOTORHIL = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)
COUNT = 200  # a socket buffers 278 such frames for a recorder without CPU time


@pytest.fixture
def hub(tmp_path):
    path = str(tmp_path / "hub")
    with serving(path):
        yield path


@contextmanager
def recording(*words):
    """Start the command, wait until it records, and kill it at the end if it still runs."""
    pipe = subprocess.PIPE
    command = [*MOTORHIL, "record", *words]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert "recording" in process.stderr.readline()
        try:
            yield process
        finally:
            process.kill()


def send(channel, count=COUNT, first=0):
    """Wait until `count` frames have been on the bus."""
    with can.Bus(interface="emulated", channel=channel, receive_own_messages=True) as bus:
        for number in range(first, first + count):
            data = number.to_bytes(2, "big")
            bus.send(can.Message(arbitration_id=0x123, data=data, is_extended_id=False))
        for _ in range(count):
            assert bus.recv(30.0) is not None


def numbers(path, bus="can0"):
    with read_trace(path) as trace:
        return [
            int.from_bytes(frame.frame[8:10], "big")
            for frame in recorded_frames(trace, Findings())
            if frame.bus == bus
        ]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_file_with_all_frames(hub, tmp_path, number):
    file = tmp_path / "run.mcap"
    with recording("--on", hub, "--on", f"arm={hub}#can1", "-o", str(file)) as process:
        send(hub)
        send(hub + "#can1", 5)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert f"{COUNT} frames of can0, 5 of arm in" in out
    assert "none lost" in out
    assert numbers(file) == list(range(COUNT))
    assert numbers(file, "arm") == list(range(5))
    with read_trace(file) as trace:
        assert trace.cut is None
        assert trace.metadata["frames"] == {"can0": str(COUNT), "arm": "5"}
        assert trace.metadata["clocks"]["can0"] == "the hub's"
        assert trace.span_ns()[1] < 1e11  # the hub's time, not the world's


def test_frames_held_back_by_a_hub_are_recorded_at_the_end(hub, tmp_path):
    file = tmp_path / "run.mcap"
    with recording("--on", hub, "-o", str(file)) as process:
        process.send_signal(signal.SIGSTOP)
        send(hub, 4 * COUNT)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGCONT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert "none lost" in out
    assert numbers(file) == list(range(4 * COUNT))


def test_killed_recorder_leaves_all_but_the_last_second(hub, tmp_path):
    file = tmp_path / "run.mcap"
    with recording("--on", hub, "-o", str(file)) as process:
        send(hub)
        first = 0
        while len(numbers(file)) < COUNT:  # once the second of their arrival is over
            first += 1
            send(hub, 1, COUNT + first)
        process.kill()
        process.communicate()
    with read_trace(file) as trace:
        assert trace.cut is not None
    found = numbers(file)
    assert len(found) >= COUNT
    assert found[:COUNT] == list(range(COUNT))


def test_lost_hub_ends_the_recording_with_a_message(tmp_path):
    path, file = str(tmp_path / "hub"), tmp_path / "run.mcap"
    with ExitStack() as hub:
        hub.enter_context(serving(path))
        with recording("--on", path, "-o", str(file)) as process:
            send(path)
            hub.close()
            out, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "the hub has closed the connection" in err
    assert f"{COUNT} frames of can0" in out
    assert numbers(file) == list(range(COUNT))
    with read_trace(file) as trace:
        assert trace.cut is None


def test_rotation_and_machine_readable_summary(hub, tmp_path):
    file = tmp_path / "run.mcap"
    words = ("--on", hub, "-o", str(file), "--rotate-s", "0.01", "--json")
    with recording(*words) as process:
        send(hub)  # 200 frames of 63 bits and more at 1 Mbit/s take 12 ms at least
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    told = json.loads(out)
    assert told["buses"] == {"can0": {"frames": COUNT, "lost": 0}}
    assert told["files"][0] == str(tmp_path / "run-0001.mcap")
    assert len(told["files"]) > 1
    assert [n for path in told["files"] for n in numbers(path)] == list(range(COUNT))


def test_any_python_can_interface_keeps_its_own_stamps(tmp_path):
    tap = PythonCanTap(parse_place("virtual:record"), {})
    file = str(tmp_path / "run.mcap")
    pump = Pump(["bench"], Series(file, opener(["bench"], {}, compact=False)))
    stamps = [1_700_000_000.0 + k / 8 for k in range(20)]  # eighths: exact in a float
    with can.Bus(interface="virtual", channel="record", preserve_timestamps=True) as bus:
        for number, stamp in enumerate(stamps):
            bus.send(
                can.Message(
                    arbitration_id=0x1234,
                    is_extended_id=True,
                    data=number.to_bytes(2, "big"),
                    timestamp=stamp,
                )
            )
    tap._moved_ns = 0  # the stamps are far from our clock
    loop = RecordingLoop([tap], pump, own_times=False)
    loop.run(lambda: pump.frames == [20], 10.0, lambda now_ns: None)
    pump.close({})
    tap.close()
    assert numbers(file, "bench") == list(range(20))
    with read_trace(file) as trace:
        assert [t for _, t, _ in trace.messages()] == [round(s * 1e9) for s in stamps]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--on", "/nowhere/hub"), "no hub answers here"),
        (("--on", "nonsense:1"), "has no interface 'nonsense'; available:"),
        (("--on", "a b"), "names no bus"),
        (("--on", "virtual:1", "--on", "virtual:1"), "is named twice"),
        (("--on", "a=virtual:1", "--on", "a=virtual:2"), "the name a is used already, by a="),
    ],
)
def test_unrecordable_bus_is_one_line_and_no_file(capsys, tmp_path, words, told):
    file = tmp_path / "run.mcap"
    assert main(["record", *words, "-o", str(file)]) == 2
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1
    assert not file.exists()


def test_file_that_would_be_overwritten_is_refused(capsys, tmp_path):
    file = tmp_path / "precious.mcap"
    file.write_text("dear diary")
    for force in ((), ("--force",)):
        assert main(["record", "--on", "virtual:1", "-o", str(file), *force]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert file.read_text() == "dear diary"
    assert main(["record", "--on", "virtual:1", "-o", str(tmp_path / "no" / "a.mcap")]) == 2
    assert "mkdir -p" in capsys.readouterr().err


def test_full_disk_is_one_line_and_the_summary(capsys):
    assert main(["record", "--on", "virtual:1", "-o", "/dev/full", "--duration", "0.1"]) == 2
    said = capsys.readouterr()
    assert "cannot be written: no space left on device" in said.err
    assert "Traceback" not in said.err


@pytest.mark.parametrize("speed", ["1", "max"])
def test_recording_sent_to_a_hub_is_on_its_bus_in_order(hub, tmp_path, capsys, speed):
    sent = [Frame(k * 100_000, "can0", classic(0x123, k.to_bytes(2, "big"))) for k in range(COUNT)]
    path, file = str(tmp_path / "sent.mcap"), tmp_path / "run.mcap"
    record_frames(path, sent, {})
    with recording("--on", hub, "-o", str(file)) as process:
        words = ["replay", path, "--as", "traffic", "--on", hub, "--speed", speed, "--json"]
        assert main(words) == 0
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    told = json.loads(capsys.readouterr().out)
    assert told["sent"] == {"can0": COUNT}
    assert numbers(file) == list(range(COUNT))
