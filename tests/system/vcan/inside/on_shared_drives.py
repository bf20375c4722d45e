"""Drives on a real SocketCAN interface, shared by programs; one is killed."""

import signal
import subprocess

import can

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.sharing_tests.processes import Plan, run
from tests.support.line_programs import LONG_S
from tests.support.served_hub import SERVE


def await_boot():
    """Wait until node 1 answers."""
    ask = can.Message(
        arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False
    )
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        for _ in range(round(LONG_S / 0.1)):
            bus.send(ask)
            answer = bus.recv(timeout=0.1)
            while answer is not None:
                if answer.arbitration_id == 0x581:
                    return
                answer = bus.recv(timeout=0.1)
    raise AssertionError("node 1 never answered")


def on_vcan(**plan):
    facts = {
        "interface": "socketcan",
        "channel": "vcan0",
        "model": str(EXAMPLES / "wheel_model.toml"),
        "node_ids": [1, 2],
    }
    facts |= plan.pop("facts")
    command = [*SERVE, "serve", str(EXAMPLES / "two_wheels.toml"), "--on", "can0=vcan0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        try:
            assert server.stdout.readline().startswith(b"can0: ")
            await_boot()
            outcome = run(Plan(facts=facts, **plan))
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(LONG_S)
    print(outcome.table())
    outcome.require_sound()
    return outcome


def test_motor_has_one_owner_at_a_time_despite_a_kill():
    outcome = on_vcan(
        work="motorhil.harness.sharing_tests.workers:work_motor",
        workers=2,
        seconds=10.0,  # a machine in a machine is slow: some seconds until all are connected
        kill_period_s=6.0,
        facts={},
    )
    assert outcome.counts["killed"] == 1
    assert outcome.reached()["command: done"] >= 1


def test_two_groups_in_opposite_orders_end_every_round():
    outcome = on_vcan(
        work="motorhil.harness.sharing_tests.workers:work_groups",
        workers=2,
        seconds=60.0,
        facts={"rounds": 20, "move_every": 20},
    )
    assert outcome.reached()["read: done"] == 40
