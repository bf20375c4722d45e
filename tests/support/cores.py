"""Which tests meet the compiled cores, the pure ones, or both.

`make test` compiles the cores and runs the tests on them, because they are what ships. A second run
tests the sources: `--cores pure`. Without a compiler the sources meet all tests. The mark `pure`
names a test that only pure cores can pass, with the reason.

Tests of a folder of the packages meet the sources if setup.py compiles modules of this folder. All
other modules are the same in both runs.
"""

import ast
from collections.abc import Iterable
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Final

import pytest

from motorhil.harness.version import cores_are_compiled
from tests.support.checkout import CHECKOUT

OF_THE_SOURCES: Final = ("architecture", "conformance/mutants", "system/build")
# Tests through all compiled modules.
BOTH: Final = (
    *("properties", "conformance/test_kinds.py", "conformance/test_kinds_endings.py"),
    *("conformance/test_kinds_shared.py", "crosscheck/canopen/test_canopen_client.py"),
    "crosscheck/canopen/test_canopen_base_node_402.py",
)
# These call interpreted code, or repeat at length what other tests cover.
COMPILED_ALONE: Final = (
    *(
        "unit/motorapi/runtime/test_wall_*.py",
        "unit/harness/shared_time",
        "unit/harness/python_can",
        "unit/traces/mcap/test_re*.py",
    ),
    *("properties/test_sharing*.py", "properties/test_skew*.py"),
    *("properties/test_formats*.py", "properties/test_d[ae]*.py", "properties/fuzz/*.py"),
    "architecture/test_pages.py",  # commands of users, mostly simulations
)
_MARK: Final = "mark.pure("
_TESTS: Final = CHECKOUT / "tests"


def _is_in(path: Path, places: Iterable[str]) -> bool:
    name = path.relative_to(_TESTS).as_posix()
    return any(name == one or fnmatch(name, one) or fnmatch(name, f"{one}/*") for one in places)


@cache
def compiled_modules() -> frozenset[str]:
    """Return the modules that setup.py compiles, without running it."""
    named: dict[str, tuple[str, ...]] = {}
    for node in ast.parse((CHECKOUT / "setup.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            (name,) = node.targets
            named[ast.unparse(name)] = ast.literal_eval(node.value)
    found = {path for pattern in named["COMPILED"] for path in CHECKOUT.glob(pattern)}
    names = {path.relative_to(CHECKOUT).as_posix() for path in found if path.name != "__init__.py"}
    return frozenset(names - {*named["READ_AT_START"], *named["RARE"]})


@cache
def tests_compiled_modules(folder: Path) -> bool:
    """Return True if the modules that these tests are of, by the name of their folder, compile."""
    place = folder.relative_to(_TESTS).as_posix().removeprefix("unit/")
    return any(Path(name).parent.as_posix() == place for name in compiled_modules())


def meets_sources(path: Path) -> bool:
    """Return True if all tests of this file run on the pure cores, beside the compiled ones."""
    if _is_in(path, COMPILED_ALONE):
        return False
    return _is_in(path, (*OF_THE_SOURCES, *BOTH)) or tests_compiled_modules(path.parent)


def leave_out(path: Path, cores: str) -> bool:
    """Return True if no test of this file belongs to a run of `--cores`."""
    if path.suffix != ".py" or not path.name.startswith("test_"):
        return False
    if cores == "compiled":
        return _is_in(path, OF_THE_SOURCES) and not _is_in(path, COMPILED_ALONE)
    return not meets_sources(path) and _MARK not in path.read_text(encoding="utf-8")


def choose(items: Iterable[pytest.Item], cores: str | None) -> list[pytest.Item]:
    """Return the tests of a run of `--cores`; without it, skip those that need pure cores."""
    kept: list[pytest.Item] = []
    for item in items:
        mark = item.get_closest_marker("pure")
        if cores == "pure" and mark is None and not meets_sources(item.path):
            continue
        if cores == "compiled" and mark is not None:
            continue
        if mark is not None and cores_are_compiled():
            item.add_marker(pytest.mark.skip(reason=mark.args[0]))
        kept.append(item)
    return kept
