"""The emulated VESC, driven by pybldc, and the packets of our adaptation beside those of pybldc.

pybldc is another implementation of packets over CAN. It is GPL-3, so that it runs in a process of
its own, and talks frames through pipes.
"""

import subprocess
import sys
from pathlib import Path

import can
import pytest

from motorhil.emulators.vesc.drive import build
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from tests.support.can.bench import EXTENDED, CanBench
from tests.support.checkout import CHECKOUT

pytest.importorskip("pybldc", reason="pybldc is not installed")

HOST = CHECKOUT / "tests" / "support" / "programs" / "pybldc_host.py"
NODE = 23


def run(*verb):
    """Run pybldc against the drive; return the drive, all frames to it, and pybldc's verdicts."""
    bench = CanBench(build, node_id=NODE)
    frames, verdicts = [], []
    command = [sys.executable, "-W", "ignore", str(HOST), str(NODE), *verb]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=HOST.parent
    ) as host:
        for line in host.stdout:
            can_id, _, data = line.strip().partition(" ")
            if len(can_id) != 8:
                verdicts.append(line.strip())
                continue
            frames.append((int(can_id, 16), data))
            for number, answer in bench.run(1).ask(*frames[-1], flags=EXTENDED):
                host.stdin.write(f"{number:08X} {answer}\n")
                host.stdin.flush()
    assert host.returncode == 0
    return bench, frames, verdicts


def test_pybldc_hears_the_answer_to_its_ping():
    _, frames, verdicts = run("ping")
    assert frames == [(0x1117, "FD")]
    assert verdicts == ["pong"]


def test_pybldc_hears_the_answer_to_a_short_packet():
    short = bytes((50, 0, 0, 0x80)).hex()
    bench, _, verdicts = run("send", short + "00", "320000800000")
    assert bench.events == []
    assert verdicts == ["answer", "sent"]


@pytest.mark.parametrize("length", [7, 8, 19, 258, 259, 260, 265, 266, 301, 511, 512])
def test_packet_of_pybldc_arrives_whole(length):
    # COMM_SET_DUTY with padding: obeyed if, and only if, all fragments and the CRC are right.
    packet = (
        bytes((5,)) + (20_000).to_bytes(4, "big") + bytes(i * 7 & 0xFF for i in range(length - 5))
    )
    bench, frames, _ = run("send", packet.hex())
    assert bench.true("mode") == 4
    assert bench.events == []
    assert frames[-1][0] == 0x717
    assert any(can_id == 0x617 for can_id, _ in frames) == (length > 259)


def test_reset_of_pybldc_restarts_the_drive():
    bench, frames, _ = run("send", "1D")
    assert frames == [(0x817, "FD001D")]
    assert bench.run(600).heard[-1][0] == 501.0  # boot notice, 500 ms after the reset


OWN = f"""
bus.can0.bitrate_bit_s = 500_000
[controller.left]
kind = "vesc"
bus = "can0"
node_id = {NODE}
status_1 = 25
plant.preset = "wheel_60w"
[motor.left]
adaptation = "vesc"
controller = "left"
host_id = 253
[motor.left.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
gear_ratio = 1.0
"""


def packets_of_ours():
    """Return the short packets that our adaptation sends to its drive, by their payload."""
    rig = Rig(parse_rig(Source(Path("rig.toml"), OWN), installed_plugins()), seed=1)
    with rig, can.Bus(interface="emulated", channel="can0") as bus:
        rig.motors["left"].enable()
        rig.runtime.run_for(0.2)
        found = {}
        while (one := bus.recv(0)) is not None:
            if one.arbitration_id == 8 << 8 | NODE:
                data = bytes(one.data).hex().upper()
                found[data[4:]] = (one.arbitration_id, data)
        return found


def test_packets_of_ours_are_those_of_pybldc():
    ours = packets_of_ours()
    assert set(ours) == {"00", "3200008000", "1E"}  # FW_VERSION, the fault alone, ALIVE
    for payload, (can_id, data) in ours.items():
        _, frames, _ = run("send", payload)
        told_id, told = frames[0]
        assert (can_id, data[:2], data[4:]) == (told_id, told[:2], told[4:])
        assert (data[2:4], told[2:4]) == ("02" if payload == "1E" else "00", "00")  # no answer
