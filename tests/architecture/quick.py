"""Selection of the tests that a change in the working tree can break.

python -m tests.architecture.quick [--base REV] [--seconds N] [--list] [PYTEST ARGUMENT ...]

The rule: a test module is selected if it imports a changed module, directly or through others. Type
imports count, and so do the conftest.py above it (of the uppermost, only itself). A changed file
that is not a module counts as a change of every module that names it. Modules with the shortest
chain of imports run first, until the time is up. Tests with a mark of SLOW run in `make test` only.
Changed means: different from the merge base with `main`, or new.
"""

import argparse
import os
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.architecture.structure import imported, module_name
from tests.support.checkout import CHECKOUT, sources

SLOW = ("compiled", "vcan", "wall")
EVERY_TEST = "tests.conftest"
DEADLINE = "MOTORHIL_QUICK_DEADLINE_S"
NOTHING_SELECTED = 5  # pytest's exit status


def git(*words: str) -> list[str]:
    """Return the lines that git prints."""
    done = subprocess.run(["git", *words], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def changed_files(base: str | None) -> list[str]:
    """Return the files that differ from the merge base with main (or `base`), and new files."""
    (start,) = git("merge-base", "HEAD", base or "main")[:1]
    new = git("ls-files", "--others", "--exclude-standard")
    return sorted({*git("diff", "--name-only", start), *new})


def test_graph() -> dict[str, tuple[Path, set[str]]]:
    """Return file and imports of every module of the product and of the tests, by name."""
    files = {module_name(path): path for path in sources()}
    for path in sorted((CHECKOUT / "tests").rglob("*.py")):
        files[module_name(path).removeprefix("motorhil.")] = path
    graph = {name: (path, imported(path.read_text(), files)) for name, path in files.items()}
    for name, (_, found) in graph.items():
        parts = name.split(".")
        above = (".".join([*parts[:count], "conftest"]) for count in range(1, len(parts)))
        found.update(conftest for conftest in above if conftest in graph and conftest != name)
    graph[EVERY_TEST][1].clear()
    return graph


def changed_modules(files: Iterable[str], graph: Mapping[str, tuple[Path, set[str]]]) -> set[str]:
    """Return the changed modules, and those that name a changed file of another kind."""
    names = {path.relative_to(CHECKOUT).as_posix(): name for name, (path, _) in graph.items()}
    others = {Path(file).name for file in files if file not in names and not file.endswith(".py")}
    named = {
        name
        for name, (path, _) in graph.items()
        if others and any(other in path.read_text() for other in others)
    }
    return named | {names[file] for file in files if file in names}


def distances(changed: Iterable[str], imports: Mapping[str, set[str]]) -> dict[str, int]:
    """Return the length of the shortest chain of imports from each module to a changed one."""
    importers: dict[str, list[str]] = defaultdict(list)
    for name, others in imports.items():
        for other in others:
            importers[other].append(name)
    found = dict.fromkeys(sorted(changed), 0)
    queue = deque(found)
    while queue:
        name = queue.popleft()
        for importer in sorted(importers[name]):
            if importer not in found:
                found[importer] = found[name] + 1
                queue.append(importer)
    return found


def selected(files: Iterable[str]) -> list[tuple[int, str]]:
    """Return distance and path of every test module that these changes can break, nearest first."""
    graph = test_graph()
    far = distances(
        changed_modules(list(files), graph), {name: of for name, (_, of) in graph.items()}
    )
    places = {name: path.relative_to(CHECKOUT).as_posix() for name, (path, _) in graph.items()}
    return sorted(
        (distance, places[name])
        for name, distance in far.items()
        if name.startswith("tests.") and name.rpartition(".")[2].startswith("test_")
    )


# --- as a plugin of pytest

LEFT: list[str] = []
"""Tests that were not run, because the time was up; one entry for each worker in the controller."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    """Leave out every test that would begin after the deadline."""
    if time.time() < float(os.environ.get(DEADLINE, "inf")):
        return None
    LEFT.append(item.nodeid)
    return True


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the number of tests left out to the controller."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["left"] = LEFT


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Collect the tests that a worker left out."""
    LEFT.extend(getattr(node, "workeroutput", {}).get("left", []))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of tests left out, and the first of them."""
    if LEFT:
        told = f"time is up: {len(LEFT)} tests were not run, the nearest {LEFT[0]}"
        terminalreporter.write_line(f"{told}; make test runs all")


# --- as a program


def styled(files: Iterable[str]) -> int:
    """Check the style of the changed modules; return the exit status."""
    modules = [file for file in files if file.endswith(".py") and (CHECKOUT / file).exists()]
    ruff = (str(Path(sys.executable).with_name("ruff")),)
    commands = [(*ruff, "check", *modules), (*ruff, "format", "--check", *modules)]
    if not modules:
        return 0
    return max(subprocess.run(command, cwd=CHECKOUT).returncode for command in commands)


def main() -> int:
    """Check the changed files and run the selected tests."""
    parser = argparse.ArgumentParser(prog="python -m tests.architecture.quick")
    parser.add_argument("--base", metavar="REV", help="compare with this revision (default: main)")
    parser.add_argument("--seconds", type=float, default=60.0, help="time for tests (default: 60)")
    parser.add_argument("--list", action="store_true", help="print the selection, and run nothing")
    options, words = parser.parse_known_args()
    files = changed_files(options.base)
    chosen = selected(files)
    print(f"{len(files)} changed files can break {len(chosen)} test modules")
    if options.list:
        print("".join(f"{distance} {place}\n" for distance, place in chosen), end="")
        return 0
    if not any(file.endswith(".py") for file in files) and not chosen:
        return 0
    wrong = styled(files)
    if not chosen:
        return wrong
    command = [sys.executable, "-m", "pytest", "-p", "tests.architecture.quick"]
    command += ["-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    command += ["-m", " and ".join(f"not {mark}" for mark in SLOW), *words]
    command += [place for _, place in chosen]
    deadline = {DEADLINE: str(time.time() + options.seconds)}
    done = subprocess.run(command, cwd=CHECKOUT, env={**os.environ, **deadline})
    return wrong or (0 if done.returncode == NOTHING_SELECTED else done.returncode)


if __name__ == "__main__":
    sys.exit(main())
