"""Import contracts of pyproject.toml: all kept, and each can break."""

import json
import shutil
import subprocess
import sys
import tomllib

import pytest

from tests.support.checkout import CHECKOUT, PACKAGES

# (contract, file of the planted line, the line, import-linter's message)
PLANTS = [
    (
        "islands",
        "traces/digest.py",
        "import motorhil.emulators.simulation.world",
        "motorhil.traces.digest -> motorhil.emulators.simulation.world",
    ),
    (
        "islands",
        "motorapi/model.py",
        "import motorhil.traces.digest",
        "motorhil.motorapi.model -> motorhil.traces.digest",
    ),
    (
        "islands",
        "emulators/cia402/objects/units.py",
        "def late():\n    import motorhil.motorapi.model",
        "motorhil.emulators.cia402.objects.units -> motorhil.motorapi.model",
    ),
    (
        "islands-below",
        "emulators/simulation/world.py",
        "import motorhil.harness.virtual_time.runtime",
        "world -> motorhil.harness.virtual_time.runtime",
    ),
    (
        "emulators",
        "emulators/can/bus/bus.py",
        "import motorhil.emulators.gateways.loop",
        "can.bus.bus -> motorhil.emulators.gateways.loop",
    ),
    (
        "emulators",
        "emulators/canopen/sync.py",
        "import motorhil.emulators.cia402.drive",
        "canopen.sync -> motorhil.emulators.cia402.drive",
    ),
    ("emulators", "emulators/novelty.py", "", "novelty"),
    (
        "motorapi",
        "motorapi/motor.py",
        "import motorhil.motorapi.adaptations.cia402.motor",
        "motorhil.motorapi.motor -> motorhil.motorapi.adaptations.cia402.motor",
    ),
    (
        "motorapi",
        "motorapi/locking/process_lock.py",
        "import motorhil.motorapi.ownership.ownership",
        "locking.process_lock -> motorhil.motorapi.ownership.ownership",
    ),
    ("motorapi", "motorapi/novelty.py", "", "novelty"),
    (
        "adaptations",
        "motorapi/adaptations/ideal/motor.py",
        "import motorhil.motorapi.adaptations.cia402.csp",
        "ideal.motor -> motorhil.motorapi.adaptations.cia402.csp",
    ),
    (
        "adaptations",
        "motorapi/adaptations/oriental_az/hardware.py",
        "from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor",
        "oriental_az.hardware -> motorhil.motorapi.adaptations.leadshine.hardware",
    ),
    (
        "adaptations",
        "motorapi/adaptations/canopen/emcy.py",
        "import motorhil.motorapi.adaptations.cia402.objects",
        "canopen.emcy -> motorhil.motorapi.adaptations.cia402.objects",
    ),
    (
        "adaptations",
        "motorapi/adaptations/host_servo/node.py",
        "import motorhil.motorapi.adaptations.cia402.node",
        "host_servo.node -> motorhil.motorapi.adaptations.cia402.node",
    ),
    ("adaptations", "motorapi/adaptations/novelty.py", "", "novelty"),
    (
        "kinds",
        "motorapi/adaptations/mit/motor.py",
        "from motorhil.motorapi.motor import Motor",
        "mit.motor -> motorhil.motorapi.motor",
    ),
    (
        "kinds",
        "motorapi/adaptations/vesc/motor.py",
        "import motorhil.motorapi.api.can_drive",
        "vesc.motor -> motorhil.motorapi.api.can_drive",
    ),
    (
        "kinds",
        "motorapi/adaptations/dryve/hardware.py",
        "import motorhil.motorapi.adaptations.modbus.unit",
        "dryve.hardware -> motorhil.motorapi.adaptations.modbus.unit",
    ),
    (
        "kinds",
        "emulators/rmd/drive.py",
        "from motorhil.emulators.firmware import axis",
        "rmd.drive -> motorhil.emulators.firmware.axis",
    ),
    (
        "kinds",
        "emulators/moteus/drive.py",
        "import motorhil.settings",
        "moteus.drive -> motorhil.settings",
    ),
    (
        "names-for-applications",
        "motorapi/adaptations/rmd/motor.py",
        "from motorhil.motorapi import Motor",
        "rmd.motor -> motorhil.motorapi",
    ),
    (
        "modbus-without-can",
        "motorapi/adaptations/modbus/client.py",
        "import motorhil.motorapi.adaptations.canopen.bus",
        "modbus.client -> motorhil.motorapi.adaptations.canopen.bus",
    ),
    (
        "traces",
        "traces/mcap/writer.py",
        "import motorhil.traces.decoding.canopen",
        "mcap.writer -> motorhil.traces.decoding.canopen",
    ),
    ("traces", "traces/novelty.py", "", "novelty"),
    (
        "harness",
        "harness/rig/rig.py",
        "import motorhil.harness.cli.main",
        "rig.rig -> motorhil.harness.cli.main",
    ),
    (
        "cores",
        "emulators/simulation/event_queue.py",
        "import time",
        "motorhil.emulators.simulation.event_queue -> time",
    ),
    ("cores", "emulators/cia402/drive.py", "from os import environ", "cia402.drive -> os"),
    ("cores", "emulators/firmware/servo.py", "import random", "firmware.servo -> random"),
    ("cores", "emulators/canopen/sync.py", "import threading", "canopen.sync -> threading"),
    ("cores", "emulators/plant/dc_motor.py", "import asyncio", "plant.dc_motor -> asyncio"),
    (
        "cores",
        "emulators/simulation/world.py",
        "import selectors, select",
        "simulation.world -> selectors",
    ),
    (
        "emulators-from-the-standards",
        "emulators/canopen/files/eds.py",
        "from canopen import objectdictionary",
        "motorhil.emulators.canopen.files.eds -> canopen",
    ),
    ("traces-alone", "traces/mcap/writer.py", "from time import time", "mcap.writer -> time"),
    ("mcap-in-tests", "traces/mcap/reader.py", "import mcap.reader", "mcap.reader -> mcap"),
    ("mcap-in-tests", "harness/report/page.py", "import mcap", "report.page -> mcap"),
    ("view-cores", "harness/view/session.py", "import time", "view.session -> time"),
    ("hands-in-time", "harness/hands/hands.py", "import time", "hands.hands -> time"),
    ("view-cores", "harness/view/stream.py", "import threading", "view.stream -> threading"),
    ("waiting", "motorapi/motor.py", "import time", "motorhil.motorapi.motor -> time"),
    (
        "waiting",
        "motorapi/ownership/physical_motor.py",
        "import fcntl",
        "ownership.physical_motor -> fcntl",
    ),
    (
        "waiting",
        "motorapi/adaptations/canopen/sdo.py",
        "import threading",
        "adaptations.canopen.sdo -> threading",
    ),
    ("host-libraries", "motorapi/group.py", "import canopen", "motorhil.motorapi.group -> canopen"),
    (
        "bounds",
        "motorapi/synchronization/can_response_time.py",
        "import motorhil.motorapi.runtime.api",
        "can_response_time -> motorhil.motorapi.runtime.api",
    ),
    (
        "pure-harness",
        "harness/report/collect.py",
        "import threading",
        "report.collect -> threading",
    ),
    (
        "clauses",
        "harness/conformance/clauses/identity.py",
        "import motorhil.harness.rig.rig",
        "clauses.identity -> motorhil.harness.rig.rig",
    ),
    (
        "drive-clauses",
        "harness/conformance/drives/clauses/power.py",
        "import motorhil.emulators.cia402.state_machine",
        "clauses.power -> motorhil.emulators.cia402.state_machine",
    ),
    (
        "oracles-alone",
        "harness/oracles/facts.py",
        "import motorhil.motorapi.model",
        "oracles.facts -> motorhil.motorapi.model",
    ),
    (
        "judges",
        "harness/sharing_tests/linearizability.py",
        "import hypothesis",
        "sharing_tests.linearizability -> hypothesis",
    ),
]


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Return import-linter's results for the unchanged sources and for each plant."""
    copy = tmp_path_factory.mktemp("copy")
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for name in PACKAGES:
        shutil.copytree(CHECKOUT / name, copy / name, ignore=ignored)
    shutil.copytree(CHECKOUT / "motorhil", copy / "motorhil", symlinks=True, ignore=ignored)
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
