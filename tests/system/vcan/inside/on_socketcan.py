"""Tests on real vcan interfaces; `tests/system/vcan/test_on_vcan.py` runs them."""

import os
import subprocess
import sys
from pathlib import Path

import can
import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.motorapi import WallRuntime
from motorhil.traces.semantics.ownership import Ended, read_ownership

MOTORHIL = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)
RIG = str(EXAMPLES / "two_wheels.toml")
ROVER = str(EXAMPLES / "rover.toml")
PROGRAMS = Path(__file__).parents[3] / "support" / "programs"
SCRIPT = (str(PROGRAMS / "patient_wheels.py"), str(EXAMPLES / "wheel_model.toml"))
REACHED = "1.000\n2.000 2.000\n"  # the paper on Algorithms 1 and 2


def motorhil(*words):
    return subprocess.run(
        [*MOTORHIL, *words], capture_output=True, text=True, timeout=100, check=False
    )


def frame(can_id, data):
    return can_id.to_bytes(4, "little") + bytes([len(data), 0, 0, 0]) + data.ljust(8, b"\0")


def test_virtual_time_script_runs_on_vcan(tmp_path):
    """The owners of the motors are found by their locks, as vcan carries no notices."""
    record = tmp_path / "run.mcap"
    command = ("serve", RIG, "--on", "vcan0", "-o", str(record), "--", sys.executable, *SCRIPT)
    served = motorhil(*command)
    assert (served.returncode, served.stderr, served.stdout) == (0, "", REACHED)
    owned = read_ownership(record)
    assert owned.contradictions == ()
    assert list(owned.tenures) == ["left", "right"]
    for tenures in owned.tenures.values():
        assert {(one.program, one.looked) for one in tenures} == {("patient_wheels.py", True)}
        assert any(one.owner.startswith("start() of ") for one in tenures)
        assert any(one.ended is Ended.RELEASED for one in tenures)


def test_ci_job_gets_the_interfaces_it_names(tmp_path):
    shown = "import os; print(os.environ['CAN_INTERFACE'], os.environ['MOTORHIL_CHANNEL_CAN0'])"
    helper = ("bash", str(EXAMPLES / "ci" / "vcan-or-hub"), RIG, "--on", "can0=vcan9")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        [*helper, "--", sys.executable, "-c", shown],
        env={**os.environ, "PATH": path, "CI_SUMMARY": str(tmp_path / "summary")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "socketcan vcan9\n"), done.stderr
    assert done.stderr.startswith("Virtual CAN: vcan9 of this machine's kernel, ")
    assert (tmp_path / "summary").read_text() == done.stderr


def test_own_frames_are_confirmed_once_carried():
    """On vcan is_rx is False for all frames; own ones are still distinguished."""
    heard = []
    runtime = WallRuntime()
    with (
        can.Bus(interface="socketcan", channel="vcan0") as bus,
        can.Bus(interface="socketcan", channel="vcan0") as other,
    ):
        runtime.listen(bus, lambda data, time_ns, own: heard.append((data, own)))
        runtime.send(bus, frame(0x123, b"\x01"))
        assert runtime.wait_until(lambda: len(heard) == 1, 5.0)
        other.send(can.Message(arbitration_id=0x123, data=b"\x02", is_extended_id=False))
        assert runtime.wait_until(lambda: len(heard) == 2, 5.0)
        runtime.close()
    assert heard == [(frame(0x123, b"\x01"), True), (frame(0x123, b"\x02"), False)]


def test_two_buses_on_two_interfaces():
    program = """
import can
for channel in ("vcan0", "vcan1"):
    with can.Bus(interface="socketcan", channel=channel) as bus:
        bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4000100000000000"),
                             is_extended_id=False))
        answers = iter(lambda: bus.recv(5.0), None)
        print(channel, next(m for m in answers if m.arbitration_id == 0x581).data.hex())
"""
    served = motorhil(
        "serve", ROVER, "--on", "vcan0", "--on", "can1=vcan1", "--", sys.executable, "-c", program
    )
    assert (served.returncode, served.stderr) == (0, "")
    first, second = served.stdout.splitlines()
    assert first.startswith("vcan0 43001000")  # 1000h:00, four bytes expedited
    assert second == first.replace("vcan0", "vcan1")


@pytest.mark.parametrize("missing", ["vcan7", "nonsense"])
def test_missing_interface_is_one_line_with_the_remedy(missing):
    served = motorhil("serve", RIG, "--on", missing)
    assert served.returncode == 2
    assert served.stderr.count("\n") == 1
    assert f"ip link add dev {missing} type vcan" in served.stderr
