"""`motorhil serve` in a separate process, on the wall clock."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import decode_can_frame

pytestmark = pytest.mark.wall

MOTORHIL = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)
RIG = str(EXAMPLES / "two_wheels.toml")
PROGRAMS = Path(__file__).parents[2] / "support" / "programs"
SCRIPT = (str(PROGRAMS / "patient_wheels.py"), str(EXAMPLES / "wheel_model.toml"))
GOLDEN = Path(__file__).parents[3] / "traces" / "golden"
REACHED = "1.000\n2.000 2.000\n"  # the paper on Algorithms 1 and 2


def motorhil(*words, **options):
    return subprocess.run(
        [*MOTORHIL, *words],
        **{"capture_output": True, "text": True, "timeout": 200, "check": False, **options},
    )


def one_line(text):
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    assert "Traceback" not in text
    return lines[0]


def test_real_hardware_script_runs_unchanged_beside_serve(tmp_path):
    record = tmp_path / "run.mcap"
    done = motorhil("serve", RIG, "-o", str(record), "--", sys.executable, *SCRIPT)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", REACHED)
    assert motorhil("run", RIG, *SCRIPT).stdout == REACHED
    with read_trace(record) as trace:
        topics = {channel.topic for channel, _, _ in trace.messages()}
    assert {"/can/can0", "/controller/left/truth"} <= topics


def test_recording_replaces_the_drives_in_real_time(tmp_path):
    """Recorded in virtual time, served to a separate process in wall time."""
    record = tmp_path / "bench.mcap"
    assert motorhil("run", RIG, "-o", str(record), *SCRIPT).stdout == REACHED
    done = motorhil("serve", str(record), "--", sys.executable, *SCRIPT)
    assert (done.returncode, done.stdout) == (0, REACHED), done.stderr
    assert "2 recorded controllers: " in done.stderr
    assert "commands, all answered as recorded" in done.stderr


def test_replayed_host_moves_served_drives_equally(tmp_path):
    """The drives have booted long before, so it resets them first. One bus has two names here."""
    record, again = tmp_path / "bench.mcap", tmp_path / "again.mcap"
    assert motorhil("run", RIG, "-o", str(record), *SCRIPT).stdout == REACHED
    hub = tmp_path / "hub"
    words = ("replay", str(record), "--as", "host", "--on", f"can0={hub}", "--reset")
    done = motorhil(
        *("serve", RIG, "--socket", str(hub), "--"), *MOTORHIL, *words, "-o", str(again)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 differences, 0 times waited in vain" in done.stdout
    with read_trace(again) as trace:
        assert {channel.topic for channel, _, _ in trace.messages()} == {"/can/can0"}


@pytest.mark.parametrize(
    "words", [("--on", "/nowhere/hub"), ("--on", "can7=vcan7"), ("--on", "vcan77"), ("--on", "=x")]
)
def test_unreachable_bus_of_a_replayed_host_is_one_line(tmp_path, words):
    record = str(GOLDEN / "cia402.mcap")
    done = motorhil("replay", record, "--as", "host", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line(done.stderr).startswith("motorhil replay: --on ")


@pytest.mark.parametrize(
    ("ending", "status"), [("sys.exit(3)", 3), ("os.kill(os.getpid(), 9)", 137)]
)
def test_exit_status_of_the_command_is_passed_on(ending, status):
    done = motorhil("serve", RIG, "--", sys.executable, "-c", f"import os, sys; {ending}")
    assert (done.returncode, done.stderr) == (status, "")


def test_command_gets_the_place_of_each_bus(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text("bus.can0.bitrate_bit_s = 1_000_000\nbus.arm-1.bitrate_bit_s = 500_000\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import can, os\n"
        "for name in ('MOTORHIL_CHANNEL_CAN0', 'MOTORHIL_CHANNEL_ARM_1', 'CAN_CHANNEL'):\n"
        "    with can.Bus(interface='emulated', channel=os.environ[name]) as bus:\n"
        "        print(bus._hub.bus)\n"
    )
    done = motorhil("serve", str(rig), "--", sys.executable, str(script))
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "can0\narm-1\ncan0\n")


def test_missing_command_is_one_line():
    done = motorhil("serve", RIG, "--", "no-such-command-at-all")
    assert done.returncode == 127
    assert "no-such-command-at-all: No such file" in one_line(done.stderr)


def test_used_path_is_one_line_and_the_first_hub_continues(tmp_path):
    path = tmp_path / "hub"
    inner = [*MOTORHIL, "serve", RIG, "--socket", str(path)]
    done = motorhil("serve", RIG, "--socket", str(path), "--", *inner)
    assert done.returncode == 2
    assert f"{path}: in use by a running hub" in one_line(done.stderr)
    assert not path.exists()


@pytest.mark.parametrize(
    ("on", "reason"),
    [
        ("can7=vcan0", "no bus 'can7'; it has can0"),
        ("no-such-if0", "no-such-if0"),
        ("can0=", "--on can0=: names no interface; write --on can0=vcan0"),
    ],
)
def test_absent_bus_or_interface_is_one_line_with_a_remedy(on, reason):
    done = motorhil("serve", RIG, "--on", on)
    assert done.returncode == 2
    assert reason in one_line(done.stderr)


def test_two_dashes_without_a_command_are_one_line():
    done = motorhil("serve", RIG, "--")
    assert done.returncode == 2
    assert one_line(done.stderr) == ("motorhil serve: no command after --; name one, or omit --")


def test_invalid_seed_is_wrong_usage():
    done = motorhil("serve", RIG, "--seed", "-1", "--", "true")
    assert done.returncode == 2
    assert "argument --seed: invalid seed (0 to 4294967295) value: '-1'" in done.stderr


def test_signal_stops_serve_and_leaves_no_socket(tmp_path):
    path = tmp_path / "hub"
    record = tmp_path / "run.mcap"
    with subprocess.Popen(
        [*MOTORHIL, "serve", RIG, "--socket", str(path), "-o", str(record)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as server:
        assert str(path) in server.stdout.readline()  # it prints the place, once it exists
        with can.Bus(interface="emulated", channel=str(path)) as client:
            assert client.recv(20.0)  # a drive has booted
            server.send_signal(signal.SIGTERM)
            _, errors = server.communicate(timeout=60)
    assert server.returncode == 0
    assert "Traceback" not in errors
    assert not path.exists()
    with read_trace(record) as trace:
        assert trace.cut is None
        assert list(trace.messages())


def test_stopping_the_server_ends_the_command_too(tmp_path):
    ready = tmp_path / "ready"
    os.mkfifo(ready)
    program = f"import signal; open({str(ready)!r}, 'w').write('up'); signal.pause()"
    with subprocess.Popen([*MOTORHIL, "serve", RIG, "--", sys.executable, "-c", program]) as server:
        assert ready.read_text() == "up"
        server.send_signal(signal.SIGTERM)
        assert server.wait(60) == 128 + signal.SIGTERM


def test_killed_hub_leaves_a_readable_record(tmp_path):
    path = tmp_path / "hub"
    record = tmp_path / "run.mcap"
    command = [*MOTORHIL, "serve", RIG, "--socket", str(path), "-o", str(record)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        server.stdout.readline()
        client = subprocess.run(
            [sys.executable, *SCRIPT],
            env={**os.environ, "CAN_INTERFACE": "emulated", "CAN_CHANNEL": str(path)},
            check=False,
            timeout=200,
        )
        server.kill()
    assert client.returncode == 0
    with read_trace(record) as trace:
        times_ns = [time_ns for _, time_ns, _ in trace.messages()]
    assert len(times_ns) > 100
    assert Path(path).exists()  # as a killed process leaves it; the next hub takes it over
    again = motorhil("serve", RIG, "--socket", str(path), "--", sys.executable, "-c", "pass")
    assert (again.returncode, again.stderr) == (0, "")


def test_threads_that_share_a_drive_do_not_interfere():
    script = str(PROGRAMS / "threaded_wheels.py")
    done = motorhil("serve", RIG, "--", sys.executable, script, SCRIPT[1])
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "0.24 12 ['done']\n"  # 4 threads, 3 moves of 0.02 rad


def test_terminated_replay_leaves_no_folder(tmp_path):
    record = str(GOLDEN / "cia402.mcap")
    left = tmp_path / "left"
    left.mkdir()
    with subprocess.Popen(
        [*MOTORHIL, "replay", record, "--as", "host", "--realtime"],
        env={**os.environ, "TMPDIR": str(left)},
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while not list(left.glob("motorhil-*/live.mcap")):
            assert process.poll() is None
        process.terminate()
        _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert "Traceback" not in err
    assert list(left.iterdir()) == []


def test_command_starts_when_the_drives_have_booted(tmp_path):
    record = tmp_path / "boot.mcap"
    assert motorhil("serve", RIG, "-o", str(record), "--", "true").returncode == 0
    with read_trace(record) as trace:
        heard = [
            int.from_bytes(decode_can_frame(data).frame[:4], "little")
            for channel, _, data in trace.messages()
            if "can" in channel.topic
        ]
    assert {0x701, 0x702} <= set(heard)


def test_address_that_others_reach_is_announced(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text('[rig]\n[bus.line]\nkind = "modbus_tcp"\n')
    options = ("--modbus-tcp", "127.0.0.1:0", "--any-address")
    done = motorhil("serve", str(rig), *options, "--", "true")
    told = one_line(done.stderr)
    assert told.startswith("motorhil serve: line: whoever reaches 127.0.0.1:")
    assert told.endswith("can move the motors; Modbus has no passwords")
