"""Sizes of modules and functions, and tests without sleep or clock."""

import ast

import pytest

from tests.architecture.checkout import CHECKOUT, PACKAGES, sources

MODULE_LINES = 400
FUNCTION_LINES = 60
REASON = ("one function, and long, because", "one module, and long, because")

# Tests in these folders run in wall time, or measure it.
OF_THE_WALL = ("wall", "vcan", "benchmarks")
# These files read a clock. The first two check that `realtime` is no faster than wall time, a lower
# bound; the others wait for other programs with an upper bound.
READ_A_CLOCK = (
    "tests/harness/test_rig.py",
    "tests/harness/test_cli_run.py",
    "tests/crosscheck/modbus_served.py",
    "tests/crosscheck/test_modbus_clients.py",
    "tests/fuzz/__main__.py",
)
# These tests sleep in virtual time; conftest.py fails tests that sleep in wall time.
OF_VIRTUAL_SLEEP = "tests/harness/virtual_program/"


def too_long(path, text):
    """Return modules and functions that are too long without a reason in their docstring."""
    tree = ast.parse(text)
    found = []
    if len(text.splitlines()) > MODULE_LINES and not has_reason(tree):
        found.append(f"{path}: {len(text.splitlines())} lines")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = code_lines(node, text)
            if lines > FUNCTION_LINES and not has_reason(node):
                found.append(f"{path}:{node.lineno}: {node.name} has {lines} lines")
    return found


def has_reason(node):
    words = " ".join((ast.get_docstring(node) or "").lower().split())
    return any(reason in words for reason in REASON)


def code_lines(node, text):
    """Return the number of lines of the function without its docstring and empty lines."""
    lines = text.splitlines()[node.lineno - 1 : node.end_lineno]
    first = node.body[0]
    if ast.get_docstring(node) is not None:
        del lines[first.lineno - node.lineno : first.end_lineno - node.lineno + 1]
    return sum(1 for line in lines if line.strip())


def uses_of_time(text):
    """Return calls of functions named sleep, and imports of clock modules."""
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
    for path in sorted((CHECKOUT / "tests").rglob("*.py")):
        name = path.relative_to(CHECKOUT).as_posix()
        is_virtual = name.startswith(OF_VIRTUAL_SLEEP)
        if name.split("/")[1] not in OF_THE_WALL and "bench" not in path.stem and not is_virtual:
            yield name, path.read_text()


def test_modules_and_functions_are_short_or_give_a_reason():
    found = []
    for path in sources():
        found += too_long(path.relative_to(CHECKOUT).as_posix(), path.read_text())
    assert found == []


def test_tests_neither_sleep_nor_read_a_clock():
    found = []
    for name, text in virtual_time_tests():
        uses = uses_of_time(text)
        if name in READ_A_CLOCK:
            assert uses == ["time"], f"{name}: take it off the list, or do not sleep"
            continue
        found += [f"{name}: {use}" for use in uses]
    assert found == []


@pytest.mark.parametrize("lines", [MODULE_LINES, MODULE_LINES + 1])
def test_too_long_module_is_found(lines):
    assert bool(too_long("m.py", "x = 1\n" * lines)) is (lines > MODULE_LINES)


@pytest.mark.parametrize("lines", [FUNCTION_LINES, FUNCTION_LINES + 1])
def test_too_long_function_is_found_without_its_docstring(lines):
    body = "    x = 1\n\n" * (lines - 1)
    text = f'def f():\n    """One.\n\n    More.\n    """\n{body}'
    assert bool(too_long("m.py", text)) is (lines > FUNCTION_LINES)
    reasoned = text.replace("More.", "One function, and long,\n    because of the weather.")
    assert too_long("m.py", reasoned) == []


@pytest.mark.parametrize(
    "text",
    ["import time", "from time import sleep as nap", "def f(x):\n    x.sleep(1)", "sleep(1)"],
)
def test_sleep_and_clocks_are_found(text):
    assert uses_of_time(text)


def test_all_four_packages_are_checked():
    assert {path.relative_to(CHECKOUT).parts[0] for path in sources()} == set(PACKAGES)
