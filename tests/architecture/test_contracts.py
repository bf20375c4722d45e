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
        "import harness.analysis.margins",
        "analysis.message -> harness.analysis.margins",
    ),
    ("analysis", "harness/analysis/novelty.py", "", "novelty"),
    (
        "analysis-alone",
        "harness/analysis/response_time.py",
        "import emulators.media.can_bits",
        "analysis.response_time -> emulators.media.can_bits",
    ),
    (
        "conformance",
        "harness/conformance/claims.py",
        "import harness.conformance.run",
        "conformance.claims -> harness.conformance.run",
    ),
    (
        "clauses",
        "harness/conformance/clauses/identity.py",
        "import harness.rig",
        "clauses.identity -> harness.rig",
    ),
    ("islands", "traces/digest.py", "import emulators.world", "traces.digest -> emulators.world"),
    ("islands", "motorapi/model.py", "import traces.digest", "motorapi.model -> traces.digest"),
    (
        "islands",
        "emulators/cia402/units.py",
        "def late():\n    import motorapi.model",
        "emulators.cia402.units -> motorapi.model",
    ),
    ("islands-below", "emulators/world.py", "import harness.pace", "world -> harness.pace"),
    (
        "emulators-layers",
        "emulators/media/can_bus.py",
        "import emulators.serve",
        "emulators.media.can_bus -> emulators.serve",
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
        "emulators/plant/extras.py",
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
        "emulators/cia402/mode.py",
        "import emulators.cia402.power_drive",
        "cia402.mode -> emulators.cia402.power_drive",
    ),
    ("cia402", "emulators/cia402/novelty.py", "", "novelty"),
    ("cores", "emulators/event_queue.py", "import time", "emulators.event_queue -> time"),
    ("cores", "emulators/cia402/drive.py", "from os import environ", "cia402.drive -> os"),
    ("cores", "emulators/firmware/servo.py", "import random", "emulators.firmware.servo -> random"),
    ("cores", "emulators/media/faults.py", "import random", "emulators.media.faults -> random"),
    ("cores", "emulators/canopen/sync.py", "import threading", "canopen.sync -> threading"),
    ("cores", "emulators/hub_protocol.py", "import socket", "emulators.hub_protocol -> socket"),
    ("cores", "emulators/plant/dc_motor.py", "import asyncio", "plant.dc_motor -> asyncio"),
    ("cores", "emulators/world.py", "import selectors, select", "emulators.world -> selectors"),
    (
        "emulators-from-the-standards",
        "emulators/canopen/eds.py",
        "from canopen import objectdictionary",
        "emulators.canopen.eds -> canopen",
    ),
    ("traces-alone", "traces/writer.py", "from time import time", "traces.writer -> time"),
    ("traces-alone", "traces/reader.py", "import mcap.reader", "traces.reader -> mcap"),
    ("waiting", "motorapi/motor.py", "import time", "motorapi.motor -> time"),
    ("waiting", "motorapi/sharing.py", "import fcntl", "motorapi.sharing -> fcntl"),
    (
        "waiting",
        "motorapi/adaptations/sdo_channel.py",
        "import threading",
        "motorapi.adaptations.sdo_channel -> threading",
    ),
    (
        "adaptations",
        "motorapi/motor.py",
        "import motorapi.adaptations.cia402",
        "motorapi.motor -> motorapi.adaptations.cia402",
    ),
    (
        "locks",
        "motorapi/lock_reader.py",
        "import motorapi.process_lock",
        "motorapi.lock_reader -> motorapi.process_lock",
    ),
    (
        "locks",
        "motorapi/process_lock.py",
        "import motorapi.ownership",
        "motorapi.process_lock -> motorapi.ownership",
    ),
    (
        "bounds",
        "motorapi/bus_timing.py",
        "import motorapi.runtime",
        "motorapi.bus_timing -> motorapi.runtime",
    ),
    ("bounds", "motorapi/skew.py", "import motorapi.capability", "skew -> motorapi.capability"),
    (
        "functions",
        "motorapi/functions/exact.py",
        "import motorapi.functions.sampled",
        "motorapi.functions.exact -> motorapi.functions.sampled",
    ),
    ("functions", "motorapi/functions/novelty.py", "", "novelty"),
    (
        "what-not-how",
        "motorapi/limits.py",
        "import motorapi.sharing",
        "motorapi.limits -> motorapi.sharing",
    ),
    (
        "what-not-how",
        "motorapi/functions/waves.py",
        "import motorapi.device",
        "motorapi.device -> motorapi.runtime",
    ),
    (
        "kinds",
        "motorapi/adaptations/software_node.py",
        "import motorapi.adaptations.cia402_hardware",
        "software_node -> motorapi.adaptations.cia402_hardware",
    ),
    (
        "kinds",
        "motorapi/adaptations/ideal_motor.py",
        "import motorapi.adaptations.streamed_motion",
        "ideal_motor -> motorapi.adaptations.streamed_motion",
    ),
    (
        "modbus-kinds",
        "motorapi/adaptations/oriental_hardware.py",
        "from motorapi.adaptations.leadshine_hardware import LeadshineHwMotor",
        "oriental_hardware -> motorapi.adaptations.leadshine_hardware",
    ),
    (
        "modbus-without-can",
        "motorapi/adaptations/modbus_line.py",
        "import motorapi.adaptations.canopen_link",
        "modbus_line -> motorapi.adaptations.canopen_link",
    ),
    ("host-libraries", "motorapi/group.py", "import canopen", "motorapi.group -> canopen"),
    (
        "host-libraries",
        "motorapi/generation/rest_to_rest.py",
        "import numpy",
        "motorapi.generation.rest_to_rest -> numpy",
    ),
    ("harness-edges", "harness/recorder.py", "import time", "harness.recorder -> time"),
    ("harness-edges", "harness/virtual_time.py", "import random", "harness.virtual_time -> random"),
    (
        "report",
        "harness/report/collect.py",
        "import harness.report.document",
        "harness.report.collect -> harness.report.document",
    ),
    ("report", "harness/report/novelty.py", "", "novelty"),
    (
        "replay",
        "harness/replay/recorded_node.py",
        "import harness.replay.verdict",
        "harness.replay.recorded_node -> harness.replay.verdict",
    ),
    ("replay", "harness/replay/novelty.py", "", "novelty"),
    (
        "players",
        "harness/replay/host_player.py",
        "import motorapi.runtime",
        "harness.replay.host_player -> motorapi.runtime",
    ),
    (
        "virtual-program",
        "harness/virtual_program/turn.py",
        "import harness.virtual_program.locks",
        "harness.virtual_program.turn -> harness.virtual_program.locks",
    ),
    ("virtual-program", "harness/virtual_program/novelty.py", "", "novelty"),
    (
        "oracles",
        "harness/oracles/pds.py",
        "import harness.oracles.motion",
        "harness.oracles.pds -> harness.oracles.motion",
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
        "harness/sharing/linearizability.py",
        "import hypothesis",
        "harness.sharing.linearizability -> hypothesis",
    ),
    (
        "judges",
        "harness/sharing/history.py",
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
