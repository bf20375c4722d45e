"""Import contracts of pyproject.toml: all kept, and each can break."""

import json
import shutil
import subprocess
import sys
import tomllib

import pytest

from tests.architecture.checkout import CHECKOUT, PACKAGES

# (contract, file of the planted line, the line, import-linter's message)
PLANTS = [
    (
        "analysis",
        "harness/analysis/message.py",
        "import harness.analysis.advice",
        "analysis.message -> harness.analysis.advice",
    ),
    ("analysis", "harness/analysis/novelty.py", "", "novelty"),
    (
        "analysis-alone",
        "harness/analysis/response_time.py",
        "import emulators.can.frame_length",
        "analysis.response_time -> emulators.can.frame_length",
    ),
    (
        "conformance",
        "harness/conformance/run.py",
        "import harness.conformance.run",
        "conformance.claims -> harness.conformance.run",
    ),
    (
        "clauses",
        "harness/conformance/clauses/identity.py",
        "import harness.rig.rig",
        "clauses.identity -> harness.rig.rig",
    ),
    ("islands", "traces/digest.py", "import emulators.simulation.world", "traces.digest -> emulators.simulation.world"),
    ("islands", "motorapi/model.py", "import traces.digest", "motorapi.model -> traces.digest"),
    (
        "islands",
        "emulators/cia402/objects/units.py",
        "def late():\n    import motorapi.model",
        "emulators.cia402.objects.units -> motorapi.model",
    ),
    ("islands-below", "emulators/simulation/world.py", "import harness.virtual_time.runtime", "world -> harness.virtual_time.runtime"),
    (
        "emulators-layers",
        "emulators/can/bus/bus.py",
        "import emulators.gateways.loop",
        "emulators.can.bus.bus -> emulators.gateways.loop",
    ),
    ("emulators-layers", "emulators/novelty.py", "", "novelty"),
    (
        "modbus",
        "emulators/modbus/server.py",
        "import emulators.modbus.tcp",
        "emulators.modbus.server -> emulators.modbus.tcp",
    ),
    ("modbus", "emulators/modbus/novelty.py", "", "novelty"),
    (
        "plant",
        "emulators/plant/nonlinear.py",
        "import emulators.plant.dc_motor",
        "plant.extras -> emulators.plant.dc_motor",
    ),
    (
        "firmware",
        "emulators/firmware/servo.py",
        "import emulators.firmware.axis",
        "firmware.servo -> emulators.firmware.axis",
    ),
    (
        "canopen",
        "emulators/canopen/sync.py",
        "import emulators.canopen.node",
        "canopen.sync -> emulators.canopen.node",
    ),
    (
        "cia402",
        "emulators/cia402/modes/base.py",
        "import emulators.cia402.power_drive",
        "cia402.mode -> emulators.cia402.power_drive",
    ),
    ("cia402", "emulators/cia402/novelty.py", "", "novelty"),
    ("cores", "emulators/simulation/event_queue.py", "import time", "emulators.simulation.event_queue -> time"),
    ("cores", "emulators/cia402/drive.py", "from os import environ", "cia402.drive -> os"),
    ("cores", "emulators/firmware/servo.py", "import random", "emulators.firmware.servo -> random"),
    ("cores", "emulators/can/bus/fault_plan.py", "import random", "emulators.can.bus.fault_plan -> random"),
    ("cores", "emulators/canopen/sync.py", "import threading", "canopen.sync -> threading"),
    ("cores", "emulators/simulation/ownership_notice.py", "import socket", "emulators.simulation.ownership_notice -> socket"),
    ("cores", "emulators/plant/dc_motor.py", "import asyncio", "plant.dc_motor -> asyncio"),
    ("cores", "emulators/simulation/world.py", "import selectors, select", "emulators.simulation.world -> selectors"),
    (
        "emulators-from-the-standards",
        "emulators/canopen/files/eds.py",
        "from canopen import objectdictionary",
        "emulators.canopen.files.eds -> canopen",
    ),
    ("traces-alone", "traces/mcap/writer.py", "from time import time", "traces.mcap.writer -> time"),
    ("traces-alone", "traces/mcap/reader.py", "import mcap.reader", "traces.mcap.reader -> mcap"),
    ("waiting", "motorapi/motor.py", "import time", "motorapi.motor -> time"),
    ("waiting", "motorapi/ownership/physical_motor.py", "import fcntl", "motorapi.ownership.physical_motor -> fcntl"),
    (
        "waiting",
        "motorapi/adaptations/canopen/sdo.py",
        "import threading",
        "motorapi.adaptations.canopen.sdo -> threading",
    ),
    (
        "adaptations",
        "motorapi/motor.py",
        "import motorapi.adaptations.cia402.motor",
        "motorapi.motor -> motorapi.adaptations.cia402.motor",
    ),
    (
        "locks",
        "motorapi/locking/lock_status.py",
        "import motorapi.locking.process_lock",
        "motorapi.locking.lock_status -> motorapi.locking.process_lock",
    ),
    (
        "locks",
        "motorapi/locking/process_lock.py",
        "import motorapi.ownership.ownership",
        "motorapi.locking.process_lock -> motorapi.ownership.ownership",
    ),
    (
        "bounds",
        "motorapi/synchronization/can_response_time.py",
        "import motorapi.runtime.api",
        "motorapi.synchronization.can_response_time -> motorapi.runtime.api",
    ),
    ("bounds", "motorapi/synchronization/skew.py", "import motorapi.group", "skew -> motorapi.group"),
    (
        "functions",
        "motorapi/functions/polynomial_math.py",
        "import motorapi.functions.sampled",
        "motorapi.functions.polynomial_math -> motorapi.functions.sampled",
    ),
    ("functions", "motorapi/functions/novelty.py", "", "novelty"),
    (
        "what-not-how",
        "motorapi/planning/limits.py",
        "import motorapi.ownership.physical_motor",
        "motorapi.planning.limits -> motorapi.ownership.physical_motor",
    ),
    (
        "what-not-how",
        "motorapi/functions/waves.py",
        "import motorapi.device",
        "motorapi.device -> motorapi.runtime.api",
    ),
    (
        "kinds",
        "motorapi/adaptations/host_servo/node.py",
        "import motorapi.adaptations.cia402.hardware",
        "software_node -> motorapi.adaptations.cia402.hardware",
    ),
    (
        "kinds",
        "motorapi/adaptations/ideal/motor.py",
        "import motorapi.adaptations.cia402.csp",
        "ideal_motor -> motorapi.adaptations.cia402.csp",
    ),
    (
        "modbus-kinds",
        "motorapi/adaptations/oriental_az/hardware.py",
        "from motorapi.adaptations.leadshine.hardware import LeadshineHwMotor",
        "oriental_hardware -> motorapi.adaptations.leadshine.hardware",
    ),
    (
        "modbus-without-can",
        "motorapi/adaptations/modbus/client.py",
        "import motorapi.adaptations.canopen.bus",
        "modbus_line -> motorapi.adaptations.canopen.bus",
    ),
    ("host-libraries", "motorapi/group.py", "import canopen", "motorapi.group -> canopen"),
    (
        "host-libraries",
        "motorapi/generation/trapezoid.py",
        "import numpy",
        "motorapi.generation.trapezoid -> numpy",
    ),
    ("harness-edges", "harness/recording/recorder.py", "import time", "harness.recording.recorder -> time"),
    ("harness-edges", "harness/virtual_time/runtime.py", "import random", "harness.virtual_time.runtime -> random"),
    (
        "report",
        "harness/report/collect.py",
        "import harness.report.document",
        "harness.report.collect -> harness.report.document",
    ),
    ("report", "harness/report/novelty.py", "", "novelty"),
    (
        "replay",
        "harness/replay/device_node.py",
        "import harness.replay.verdict",
        "harness.replay.device_node -> harness.replay.verdict",
    ),
    ("replay", "harness/replay/novelty.py", "", "novelty"),
    (
        "players",
        "harness/replay/host.py",
        "import motorapi.runtime.api",
        "harness.replay.host -> motorapi.runtime.api",
    ),
    (
        "virtual-program",
        "harness/virtual_time/stdlib/threads.py",
        "import harness.virtual_time.stdlib.threads",
        "harness.virtual_time.stdlib.threads -> harness.virtual_time.stdlib.threads",
    ),
    ("virtual-program", "harness/virtual_time/stdlib/novelty.py", "", "novelty"),
    (
        "oracles",
        "harness/oracles/state_machine.py",
        "import harness.oracles.motion",
        "harness.oracles.state_machine -> harness.oracles.motion",
    ),
    ("oracles", "harness/oracles/novelty.py", "", "novelty"),
    (
        "oracles-alone",
        "harness/oracles/facts.py",
        "import motorapi.model",
        "harness.oracles.facts -> motorapi.model",
    ),
    (
        "judges",
        "harness/sharing_tests/linearizability.py",
        "import hypothesis",
        "harness.sharing_tests.linearizability -> hypothesis",
    ),
    (
        "judges",
        "harness/sharing_tests/history.py",
        "import motorapi.errors",
        "history -> motorapi.errors",
    ),
]


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Return import-linter's results for the unchanged sources and for each plant."""
    copy = tmp_path_factory.mktemp("copy")
    for name in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(CHECKOUT / name, copy / name, ignore=ignored)
    shutil.copy(CHECKOUT / "pyproject.toml", copy)
    plants = [("", "emulators/__init__.py", ""), *(plant[:3] for plant in PLANTS)]
    done = subprocess.run(
        [sys.executable, "-m", "tests.architecture.lint_plants", str(copy)],
        input=json.dumps(plants),
        capture_output=True,
        text=True,
        cwd=CHECKOUT,
        check=True,
    )
    return json.loads(done.stdout)


def test_every_contract_is_kept(told):
    kept, printed = told[0]
    assert kept, printed


@pytest.mark.parametrize("number", range(len(PLANTS)), ids=[f"{p[0]}-{p[1]}" for p in PLANTS])
def test_planted_import_breaks_its_contract(told, number):
    kept, printed = told[number + 1]
    assert not kept
    assert PLANTS[number][3] in " ".join(printed.split())


def test_every_contract_has_a_plant():
    written = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    ids = [contract["id"] for contract in written["tool"]["importlinter"]["contracts"]]
    assert sorted(ids) == sorted({plant[0] for plant in PLANTS})
