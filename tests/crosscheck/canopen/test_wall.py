"""canopen as its users run it, with a served drive.

The client is unmodified. The test writes what BaseNode402 cannot do (bits 4 to 6 of pp).
"""

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402, State402

from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.harness.rig.config.scaffold import EXAMPLES

pytestmark = pytest.mark.wall

MOTORHIL = (
    sys.executable,
    "-c",
    "import sys; from motorhil.harness.cli.main import main; sys.exit(main())",
)
RIG = str(EXAMPLES / "two_wheels.toml")


class PatientNode402(BaseNode402):
    """A BaseNode402 with long timeouts, for a slow machine."""

    TIMEOUT_SWITCH_STATE_FINAL = 20.0
    TIMEOUT_SWITCH_STATE_SINGLE = 10.0
    TIMEOUT_CHECK_TPDO = 10.0
    TIMEOUT_SWITCH_OP_MODE = 10.0


@contextlib.contextmanager
def connected(path: Path) -> Iterator[tuple[canopen.Network, PatientNode402]]:
    """Yield a client of node 1 of the rig that another process serves at `path`."""
    with subprocess.Popen(
        [*MOTORHIL, "serve", RIG, "--socket", str(path)], stdout=subprocess.PIPE, text=True
    ) as server:
        network = canopen.Network()
        network.NOTIFIER_CYCLE = 0.1  # duration of disconnecting
        try:
            assert server.stdout is not None
            server.stdout.readline()  # printed when it is ready
            network.connect(interface="emulated", channel=str(path))
            node = network.add_node(PatientNode402(1, str(OWN_EDS)))
            node.sdo.RESPONSE_TIMEOUT = 10.0
            yield network, node
        finally:
            network.disconnect()
            server.terminate()
            server.communicate(timeout=60)
    assert server.returncode == 0


def wait_for(node: BaseNode402, done: Callable[[], object]) -> None:
    """Wait for TPDOs, each of them every 5 ms, until the condition holds."""
    for _ in range(4000):
        if done():
            return
        assert node.tpdo[1].wait_for_reception(10.0) is not None
    raise AssertionError(f"statusword {node.statusword:04X}h")


def booted(node: BaseNode402) -> None:
    """Reset the node and wait for its boot-up; the one at power-on may have been too early."""
    for _ in range(10):
        node.nmt.state = "RESET"
        with contextlib.suppress(canopen.nmt.NmtError):  # too slow to receive it: again
            node.nmt.wait_for_bootup(2)
            return
    raise AssertionError("no boot-up after ten resets")


def test_bring_up_pp_pv_homing_fault_and_nmt_work(tmp_path):
    with connected(tmp_path / "hub") as (network, node):
        booted(node)
        for number in (1, 2):
            node.sdo[0x1800 + number - 1][5].raw = 5
        node.nmt.state = "OPERATIONAL"
        node.setup_402_state_machine()
        node.op_mode = "PROFILED POSITION"
        node.state = "OPERATION ENABLED"

        for target, extra, demand in ((9_000, 0, 9_000), (-500, 0x20, -500), (200, 0x40, -300)):
            node.sdo[0x607A].raw = target
            node.controlword = State402.CW_OPERATION_ENABLED | 0x10 | extra
            wait_for(node, lambda: node.statusword & 0x1000)
            assert not node.statusword & 0x0400
            node.controlword = State402.CW_OPERATION_ENABLED
            wait_for(node, lambda: node.statusword & 0x1400 == 0x0400)
            assert node.sdo[0x6062].raw == demand

        node.op_mode = "PROFILED VELOCITY"  # its RPDO 2 also sets controlword 0
        node.state = "OPERATION ENABLED"
        node.sdo[0x60FF].raw = -25_000
        wait_for(node, lambda: node.statusword & 0x1400 == 0x0400)
        assert node.sdo[0x606C].raw == pytest.approx(-25_000, abs=2_000)
        node.sdo[0x60FF].raw = 0
        wait_for(node, lambda: node.statusword & 0x1000)

        for method in (35, 37):
            node.sdo[0x6098].raw = method
            assert node.homing(timeout=20)
            assert node.sdo[0x6064].raw == 0
            node.controlword = State402.CW_OPERATION_ENABLED  # BaseNode402 leaves bit 4 set

        # BaseNode402 may have used a statusword older than its RPDO 2.
        for _ in range(2):
            assert node.tpdo[1].wait_for_reception(10.0) is not None
        node.state = "OPERATION ENABLED"
        node.sdo[0x1016][1].raw = 0x7E_0032  # it watches node 126, 50 ms; we send only one
        node.sdo[0x1029][1].raw = 1
        network.send_message(0x77E, b"\x05")
        wait_for(node, node.is_faulted)
        assert [(one.code, one.register, one.data[0]) for one in node.emcy.active] == [
            (0x8130, 0x11, 126)
        ]
        node.sdo[0x1016][1].raw = 0
        node.reset_from_fault()
        assert node.state == "OPERATION ENABLED"
        assert node.emcy.active == []

        node.sdo[0x1017].raw = 20
        for name in ("STOPPED", "PRE-OPERATIONAL", "OPERATIONAL"):
            node.nmt.state = name
            assert node.nmt.wait_for_heartbeat(10) == name
        node.nmt.state = "RESET"
        node.nmt.wait_for_bootup(20)
        assert node.sdo[0x6041].raw == 0x0250
