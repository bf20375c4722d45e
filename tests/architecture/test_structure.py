import ast

import pytest

from tests.architecture.structure import (
    MODULES_IN_A_FOLDER,
    code_lines,
    cycles,
    import_graph,
    imported,
    kind_in,
    kinds,
    main,
    overridden,
    single_importers,
    wide_folders,
)
from tests.benchmarks.shares import LAYERS
from tests.support.checkout import CHECKOUT, PACKAGES, sources

TESTS = CHECKOUT / "tests"
FUNCTION_LINES = 60
REASON = "the function is long on purpose:"

# Tests here run on the wall clock, or measure it: that is what they are for.
OF_THE_WALL = ("wall", "vcan", "benchmarks", "programs")
# These read a clock: the first two bound `realtime` below, the others wait for other programs.
READ_A_CLOCK = (
    "tests/unit/harness/rig/test_rig.py",
    "tests/unit/harness/cli/test_run.py",
    "tests/support/modbus/served.py",
    "tests/crosscheck/modbus/test_modbus_clients.py",
    "tests/properties/fuzz/__main__.py",
    "tests/attack/campaign.py",
    "tests/architecture/quick.py",
    "tests/architecture/test_quick.py",
)
# Sleeping in virtual time is under test here; conftest.py fails tests that sleep on the wall.
OF_VIRTUAL_SLEEP = "tests/unit/harness/virtual_time/stdlib/"


def names():
    return [path.relative_to(CHECKOUT).as_posix() for path in sources()]


def test_folders_hold_few_modules():
    tests = [path.relative_to(CHECKOUT).as_posix() for path in TESTS.rglob("*.py")]
    assert len(tests) > 500
    assert wide_folders([*names(), *tests]) == []


@pytest.mark.parametrize("count", [MODULES_IN_A_FOLDER, MODULES_IN_A_FOLDER + 1])
def test_wide_folder_is_found(count):
    files = [f"harness/new/m{number}.py" for number in range(count)]
    assert bool(wide_folders([*files, "harness/new/__init__.py"])) is (count > MODULES_IN_A_FOLDER)


def test_imports_make_no_cycle():
    assert cycles(import_graph()) == []


def test_cycle_of_type_only_import_is_found():
    known = {"motorhil.a", "motorhil.b", "motorhil.c"}
    texts = {
        "motorhil.a": "if TYPE_CHECKING:\n    from motorhil.b import B",
        "motorhil.b": "def late():\n    from motorhil import c",
        "motorhil.c": "import motorhil.a",
    }
    graph = {name: imported(text, known) for name, text in texts.items()}
    assert cycles(graph) == [sorted(known)]
    graph["motorhil.c"] = set()
    assert cycles(graph) == []


def test_single_importer_of_the_same_folder_is_found():
    graph = {"m.a.x": {"m.a.y"}, "m.a.y": set(), "m.b.z": {"m.a.x"}}
    assert single_importers(graph) == ["m.a.y <- m.a.x"]


def test_code_lines_leave_out_docstrings_and_comments():
    assert code_lines('"""Module.\n\nMore."""\n\n# why\nx = 1\ny = (\n    2\n)\n') == 4


def long_functions(path, text):
    """Return the functions that are longer than allowed, without a reason in their docstring."""
    found = []
    rows = text.splitlines()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = function_lines(node, rows)
            words = " ".join((ast.get_docstring(node) or "").lower().split())
            if lines > FUNCTION_LINES and REASON not in words:
                found.append(f"{path}:{node.lineno}: {node.name} has {lines} lines")
    return found


def function_lines(node, rows):
    """Return the lines of a function that are neither its docstring nor empty."""
    lines = rows[node.lineno - 1 : node.end_lineno]
    first = node.body[0]
    if ast.get_docstring(node) is not None:
        del lines[first.lineno - node.lineno : first.end_lineno - node.lineno + 1]
    return sum(1 for line in lines if line.strip())


def test_functions_are_short_or_say_why_not():
    found = []
    for path in sources():
        found += long_functions(path.relative_to(CHECKOUT).as_posix(), path.read_text())
    assert found == []


@pytest.mark.parametrize("lines", [FUNCTION_LINES, FUNCTION_LINES + 1])
def test_long_function_is_found(lines):
    body = "    x = 1\n\n" * (lines - 1)
    text = f'def f():\n    """One.\n\n    More.\n    """\n{body}'
    assert bool(long_functions("m.py", text)) is (lines > FUNCTION_LINES)
    reasoned = text.replace("More.", "The function is long\n    on purpose: the weather.")
    assert long_functions("m.py", reasoned) == []


def uses_of_time(text):
    """Return the calls of something called sleep, and the imports of modules that tell the time."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name == "sleep":
                found.append("sleep")
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module]
        found += [name for name in modules if name in ("time", "datetime")]
    return found


def virtual_time_tests():
    for path in sorted(TESTS.rglob("*.py")):
        name = path.relative_to(CHECKOUT).as_posix()
        is_virtual = name.startswith(OF_VIRTUAL_SLEEP)
        if (
            not set(OF_THE_WALL) & set(path.parts)
            and path.name != "error_bus.py"
            and not is_virtual
        ):
            yield name, path.read_text()


def test_tests_neither_sleep_nor_read_a_clock():
    found = []
    for name, text in virtual_time_tests():
        uses = uses_of_time(text)
        if name in READ_A_CLOCK:
            assert uses == ["time"], f"{name}: take it off the list, or do not sleep"
            continue
        found += [f"{name}: {use}" for use in uses]
    assert found == []


@pytest.mark.parametrize(
    "text",
    ["import time", "from time import sleep as nap", "def f(x):\n    x.sleep(1)", "sleep(1)"],
)
def test_sleep_and_clock_are_found(text):
    assert uses_of_time(text)


def test_all_four_packages_are_read():
    assert {path.relative_to(CHECKOUT).parts[0] for path in sources()} == set(PACKAGES)


def test_layers_of_the_profile_have_sources():
    files = [f"/{name}" for name in names()]
    ours = [
        part
        for _, parts in LAYERS
        for part in parts
        if part.startswith(("/emulators/", "/harness/"))
    ]
    assert [part for part in ours if not any(part in file for file in files)] == []


HOST = '''"""A drive."""

from motorhil.motorapi.api import CanHardware, CanMotor, text
from motorhil.motorapi.errors import MotorError
from motorhil_mine.frames import FRAME


class Hardware(CanHardware):
    """Hardware."""

    def _begin(self):
        """Begin."""

    def own(self):
        """Do what no base does."""


class Special(Hardware):
    """Hardware of a kind."""

    def _knows(self):
        return True


class Motor(CanMotor):
    """A motor."""

    def _latest(self):
        return None

    def __repr__(self):
        return ""
'''
EMULATED = '''"""A drive."""

from motorhil.emulators.api import MotorDrive, text


class Drive(MotorDrive):
    """A drive."""

    def boot(self, now_ns): ...
'''


@pytest.fixture
def kind(tmp_path):
    for name, text in (("host", HOST), ("emulated", EMULATED)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "drive.py").write_text(text)
    return kind_in(tmp_path / "host", tmp_path / "emulated", "mine")


def test_concepts_are_names_and_overridden_methods(kind):
    assert sorted(kind.names) == ["CanHardware", "CanMotor", "MotorDrive", "text"]
    assert sorted(kind.hooks) == ["_begin", "_knows", "_latest", "boot"]
    assert kind.internal == {"motorhil.motorapi.errors"}


def test_row_has_files_lines_and_concepts(kind):
    host = len([one for one in HOST.splitlines() if one and '"""' not in one])
    assert kind.row() == (2, host, 3, host + 3, 1, 4, 4)


def test_method_of_a_class_of_its_own_is_no_hook():
    text = "class One:\n    def boot(self): ...\nclass Two(One):\n    def boot(self): ...\n"
    assert overridden([ast.parse(text)]) == frozenset()


def test_kinds_but_dryve_import_the_interfaces_only():
    internal = {name: kind.internal for name, kind in kinds().items() if kind.internal}
    assert set(internal) == {"dryve"}  # a CiA 402 drive behind a gateway
    assert all(".canopen." in one or ".cia402." in one for one in internal["dryve"])


def test_table_of_a_folder_has_one_row(kind, tmp_path, capsys):
    main([str(tmp_path / "host")])
    head, row = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ["kind", "files", "host"]
    assert row.split()[:2] == ["host", "1"]
