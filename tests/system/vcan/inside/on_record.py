"""Recording of real SocketCAN interfaces, and replay to them."""

import fcntl
import socket
import struct
import subprocess
import sys
from contextlib import contextmanager

import can

from motorhil.harness.cli.main import main
from motorhil.harness.recording.socketcan import SocketCanTap
from motorhil.harness.recording.sources import parse_place
from motorhil.traces.can_frame import ERR, classic, flexible
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import record_frames, recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import Direction

MOTORHIL = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)


@contextmanager
def recording(*words):
    command = [*MOTORHIL, "record", *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert "recording" in process.stderr.readline()
        try:
            yield process
        finally:
            process.kill()


def recorded(path):
    with read_trace(path) as trace:
        assert trace.cut is None
        return list(recorded_frames(trace, Findings()))


def test_fd_and_error_frames_keep_the_kernels_stamps(tmp_path):
    file = tmp_path / "run.mcap"
    with (
        can.Bus(interface="socketcan", channel="vcan0", fd=True) as first,
        can.Bus(interface="socketcan", channel="vcan1", fd=True) as second,
        can.Bus(interface="socketcan", channel="vcan0", fd=True) as witness,
        recording("--on", "vcan0", "--on", "arm=vcan1", "-o", str(file)) as process,
    ):
        stamps = []
        for number in range(100):
            first.send(can.Message(arbitration_id=number, data=b"\1", is_extended_id=False))
            stamps.append(witness.recv(5.0).timestamp)
            second.send(can.Message(arbitration_id=number, data=bytes(64), is_fd=True))
        error = struct.pack("<IB3x8s", ERR | 0x40, 8, bytes(8))
        first.socket.send(error)
        process.send_signal(2)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert "101 frames of vcan0, 100 of arm in" in out
    frames = recorded(file)
    times = [frame.time_ns for frame in frames]
    assert times == sorted(times)
    mine = [frame for frame in frames if frame.bus == "vcan0"]
    assert [frame.frame[0] for frame in mine[:-1]] == list(range(100))
    assert mine[-1].frame == error
    for frame, stamp_s in zip(mine[:-1], stamps, strict=True):
        assert abs(frame.time_ns - stamp_s * 1e9) < 500  # the resolution of a float
    assert {len(frame.frame) for frame in frames if frame.bus == "arm"} == {72}
    assert {frame.direction for frame in frames} == {Direction.TRANSMITTED}  # by this host


def test_losses_of_a_full_socket_are_counted():
    tap = SocketCanTap(parse_place("vcan0"))
    tap._socket.setsockopt(socket.SOL_SOCKET, 33, 1)  # SO_RCVBUFFORCE: the minimum
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        message = can.Message(arbitration_id=1, is_extended_id=False)
        for _ in range(200):
            bus.send(message)
        heard = 0
        while part := tap.read(0):
            heard += len(part)
        bus.send(message)
        assert len(tap.read(0)) == 1
    tap.close()
    assert 0 < heard < 200
    assert tap.dropped == 200 - heard


def test_missing_or_down_interface_is_one_line_with_remedy(capsys, tmp_path):
    words = ("-o", str(tmp_path / "run.mcap"))
    assert main(["record", "--on", "vcan7", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "no such device" in err
    assert "ip link add dev vcan7 type vcan" in err


def switch(interface, up):
    """Set the interface up or down (SIOCSIFFLAGS, IFF_UP)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", interface.encode(), int(up)))


def test_interface_that_goes_down_is_reported_and_read_again(capsys, tmp_path):
    file = tmp_path / "run.mcap"
    try:
        with (
            can.Bus(interface="socketcan", channel="vcan1") as bus,
            recording("--on", "vcan1", "-o", str(file)) as process,
        ):
            message = can.Message(arbitration_id=1, is_extended_id=False)
            bus.send(message)
            switch("vcan1", up=False)
            assert main(["record", "--on", "vcan1", "-o", str(tmp_path / "no.mcap")]) == 2
            assert "ip link set up vcan1" in capsys.readouterr().err
            assert "network is down" in process.stderr.readline()
            switch("vcan1", up=True)
            with can.Bus(interface="socketcan", channel="vcan1") as another:
                another.send(message)
            process.send_signal(2)
            out, _ = process.communicate(timeout=60)
    finally:
        switch("vcan1", up=True)
    assert "2 frames of vcan1" in out
    assert len(recorded(file)) == 2


def test_replayed_recording_is_unchanged(capsys, tmp_path):
    path, again = str(tmp_path / "first.mcap"), str(tmp_path / "again.mcap")
    frames = [Frame(k * 1_000_000, "arm", classic(k % 2048, bytes(k % 9))) for k in range(1500)]
    frames += [Frame(2_000_000_000, "arm", flexible(k, 1, bytes(48))) for k in range(20)]
    record_frames(path, frames, {})
    with recording("--on", "vcan0", "-o", again) as process:
        for speed in ("10", "max"):
            assert main(["replay", path, "--as", "traffic", "--on", "vcan0", "--speed", speed]) == 0
        process.send_signal(2)
        out, _ = process.communicate(timeout=60)
    assert "none lost" in out
    assert [frame.frame for frame in recorded(again)] == 2 * [frame.frame for frame in frames]
    assert "1520 frames of arm to vcan0 in" in capsys.readouterr().out
