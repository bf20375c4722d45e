"""Every module is compiled, or listed here with the reason why it is interpreted.

A new module of a folder that setup.py names by glob is compiled. Any other new module fails here
until it is listed below or in setup.py.
"""

import ast
import re
import runpy
import tomllib
from enum import Enum
from importlib import import_module

from tests.support.checkout import CHECKOUT, PACKAGES
from tests.support.cores import COMPILED_ALONE, compiled_modules, meets_sources

EAGER = re.compile(r"@dataclass\((?!.*init=False).*frozen=True")
INTERPRETED = {
    "read once, when a rig opens": (
        "emulators/canopen/files/eds.py",
        "emulators/canopen/files/parameter_storage.py",
        "emulators/cia401/settings.py",
        "emulators/cia402/settings.py",
        "emulators/firmware/servo_tables.py",
        "emulators/leadshine_pr/registers.py",
        "emulators/leadshine_pr/settings.py",
        "emulators/modbus/settings.py",
        "emulators/oriental_az/registers.py",
        "emulators/oriental_az/settings.py",
        "motorapi/adaptations/canopen/settings.py",
        "motorapi/adaptations/host_servo/settings.py",
        "emulators/plant/presets.py",
        "motorapi/adaptations/canopen/pdo_setup.py",
        "motorapi/adaptations/cia402/bringup.py",
        "motorapi/adaptations/canopen/object_access.py",
        "motorapi/adaptations/cia402/parameters.py",
        "motorapi/adaptations/host_servo/occupation.py",
        "harness/rig/acts.py",
        "harness/rig/bus_load.py",
        "harness/rig/faults.py",
        "harness/rig/fragment.py",
        "harness/rig/lines.py",
        "harness/rig/names.py",
        "harness/rig/nonvolatile.py",
        "harness/rig/plugins.py",
        "harness/rig/reading.py",
        "harness/rig/rig.py",
        "harness/rig/script.py",
        "harness/python_can/hardware_names.py",
        "harness/shared_time/binaries.py",
        "harness/shared_time/programs.py",
        "harness/shared_time/remote_rig.py",
        "harness/shared_time/site/sitecustomize.py",
        "harness/shared_time/unmodified.py",
    ),
    "messages that a run may not have at all": (
        "emulators/canopen/lss.py",
        "emulators/simulation/ownership_notice.py",
        "harness/python_can/messages.py",
        "motorapi/adaptations/canopen/errors.py",
        "traces/errors.py",
    ),
    "a command at a time, not a frame": (
        "motorapi/adaptations/canopen/bus_load.py",
        "motorapi/adaptations/canopen/objects.py",
        "motorapi/adaptations/canopen/sdo.py",
        "motorapi/runtime/turn_lock.py",
        "motorapi/adaptations/cia402/sync_start.py",
        "motorapi/adaptations/canopen/sync.py",
        "motorapi/adaptations/cia402/controlword.py",
        "motorapi/adaptations/cia402/motion.py",
        "motorapi/adaptations/cia402/node_sharing.py",
        "motorapi/adaptations/cia402/profile.py",
        "motorapi/adaptations/host_servo/node.py",
    ),
    "derives from interpreted classes, or is derived from; referred to weakly": (
        "motorapi/adaptations/canopen/bus.py",
        "motorapi/adaptations/host_servo/hardware.py",
        "harness/python_can/bus.py",
        "harness/python_can/line.py",
        "motorapi/adaptations/cia402/hardware.py",
        "motorapi/adaptations/cia402/motor.py",
        "motorapi/adaptations/host_servo/motor.py",
    ),
    "one addition for each frame, called by interpreted modules": (
        "harness/python_can/send_limit.py",
    ),
    "waits for wall time, sockets or files": (
        "emulators/gateways/hub.py",
        "emulators/gateways/modbus_pty.py",
        "emulators/gateways/socketcan.py",
        "harness/python_can/hub_client.py",
        "harness/recording/loop.py",
        "harness/recording/socketcan.py",
        "harness/shared_time/remote_world.py",
        "harness/shared_time/shared_clock.py",
        "harness/virtual_time/interrupts.py",
        "harness/virtual_time/standstill.py",
        "motorapi/runtime/byte_streams.py",
        "motorapi/runtime/can_sources.py",
        "motorapi/runtime/wall.py",
    ),
    "works on recordings, a chunk at a time": (
        "harness/recording/conversion.py",
        "harness/recording/dbc.py",
        "harness/recording/decoders.py",
        "harness/recording/ownership.py",
        "harness/recording/sources.py",
        "harness/recording/writer.py",
        "traces/api.py",
        "traces/columns.py",
        "traces/digest.py",
        "traces/files.py",
        "traces/layout.py",
        "traces/mcap/reader.py",
        "traces/mcap/records.py",
        "traces/mcap/recovery.py",
        "traces/mcap/writer.py",
    ),
}
# Folders without a compiled module: settings, the motor interface, all tools.
# The folders of the kinds of drives that have none are taken from the entry points.
FOLDERS = (
    *("emulators", "emulators/settings"),
    *("harness", "harness/analysis", "harness/cli", "harness/conformance"),
    *("harness/conformance/benches", "harness/conformance/clauses"),
    *("harness/conformance/clauses/failures", "harness/conformance/clauses/groups"),
    "harness/conformance/clauses/motion",
    *("harness/conformance/drives", "harness/conformance/drives/clauses"),
    "harness/conformance/drives/clauses/communication",
    *("harness/conformance/verdicts", "harness/examples", "harness/examples/new_drive"),
    *("harness/oracles", "harness/oracles/drives"),
    *("harness/pytest_plugin", "harness/replay", "harness/report", "harness/rig/config"),
    "harness/hands",
    "harness/identification",
    *("harness/sharing_tests", "harness/swarm", "harness/swarm/worlds"),
    "harness/virtual_time/stdlib",
    "harness/view",
    "harness/swarm/report",
    *("motorapi", "motorapi/adaptations", "motorapi/adaptations/modbus", "motorapi/api"),
    *("motorapi/functions", "motorapi/generation"),
    *("motorapi/locking", "motorapi/ownership", "motorapi/planning", "motorapi/synchronization"),
    *("traces/decoding", "traces/exchange", "traces/formats", "traces/semantics"),
)
_PLUGINS = ("motorhil.adaptations", "motorhil.controllers")


def kinds(compiled_modules):
    """Return the folders of the kinds of drives without a compiled module."""
    points = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["entry-points"]
    targets = [target for group in _PLUGINS for target in points[group].values()]
    folders = {target.split(".", 1)[1].rpartition(".")[0].replace(".", "/") for target in targets}
    return folders - {name.rpartition("/")[0] for name in compiled_modules}


def compiled(monkeypatch):
    """Return the modules that setup.py compiles."""
    monkeypatch.chdir(CHECKOUT)
    names = runpy.run_path("setup.py")["hot_modules"]()
    return {name.removeprefix("motorhil/") for name in names}


def test_interpreted_modules_are_listed_with_a_reason(monkeypatch):
    modules = {
        path.relative_to(CHECKOUT).as_posix()
        for package in PACKAGES
        for path in (CHECKOUT / package).rglob("*.py")
        if path.name != "__init__.py"
    }
    hot = compiled(monkeypatch)
    plain = {*FOLDERS, *kinds(hot)}
    found = {name for name in modules - hot if name.rpartition("/")[0] not in plain}
    listed = [name for names in INTERPRETED.values() for name in names]
    assert sorted(found) == sorted(listed)


def test_folders_listed_as_interpreted_have_no_compiled_module(monkeypatch):
    folders = {name.rpartition("/")[0] for name in compiled(monkeypatch)}
    assert folders.isdisjoint(FOLDERS)


def test_tests_of_each_folder_with_compiled_modules_meet_the_sources(monkeypatch):
    names = compiled(monkeypatch)
    assert compiled_modules() == names
    left_out = []
    for folder in {name.rpartition("/")[0] for name in names}:
        tests = sorted((CHECKOUT / "tests" / "unit" / folder).glob("test_*.py"))
        assert tests, f"tests/unit/{folder}: modules of {folder} are compiled"
        if not any(map(meets_sources, tests)):
            left_out.append(f"unit/{folder}")
    assert {*left_out} <= {*COMPILED_ALONE}


def interpreted_bases(names):
    """Yield the compiled classes whose interpreted base keeps fields: a compiled class overlays
    them with its own. Enumerations are not compiled, and mypyc knows exceptions.
    """
    for name in sorted(names):
        module = import_module("motorhil." + name.removesuffix(".py").replace("/", "."))
        tree = ast.parse((CHECKOUT / name).read_text())
        stated = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
        for one in vars(module).values():
            if not isinstance(one, type) or issubclass(one, Enum | BaseException):
                continue
            if one.__module__ != module.__name__ or one.__name__ not in stated:
                continue
            for base in one.__mro__[1:-1]:
                file = base.__module__.removeprefix("motorhil.").replace(".", "/") + ".py"
                has_fields = base.__weakrefoffset__ or base.__dictoffset__
                if has_fields and file not in names:
                    yield f"{name}: {one.__name__}({base.__name__})"


def test_compiled_class_has_no_interpreted_base_with_fields(monkeypatch):
    assert list(interpreted_bases(compiled(monkeypatch))) == []


def test_compiled_modules_hide_no_error_by_from_none(monkeypatch):
    """Mypyc prints it nevertheless, as if the handler had failed."""
    hiding = [
        f"{name}:{node.lineno}"
        for name in sorted(compiled(monkeypatch))
        for node in ast.walk(ast.parse((CHECKOUT / name).read_text()))
        if isinstance(node, ast.Raise) and isinstance(node.cause, ast.Constant)
    ]
    assert hiding == []


def test_compiled_modules_have_no_class_that_mypyc_leaves_interpreted(monkeypatch):
    """To mypyc a class with a decorator that it does not know is an ordinary Python class."""
    names = sorted(compiled(monkeypatch))
    assert [name for name in names if "motorhil.frozen" in (CHECKOUT / name).read_text()] == []


def test_frozen_dataclasses_of_interpreted_modules_compile_late(monkeypatch):
    """Third parties have the standard library alone: kinds, examples, judges of histories."""
    hot = compiled(monkeypatch)
    exempt = {
        *kinds(hot),
        "harness/examples",
        "harness/examples/new_drive",
        "harness/sharing_tests",
    }
    found = [
        name
        for package in PACKAGES
        for path in (CHECKOUT / package).rglob("*.py")
        for name in [path.relative_to(CHECKOUT).as_posix()]
        if name not in hot and name.rpartition("/")[0] not in exempt
        if EAGER.search(path.read_text())
    ]
    assert found == []
