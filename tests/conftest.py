"""Settings of all tests; Hypothesis is repeatable here and in CI alike."""

import gc
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers
from hypothesis.internal.constants_ast import Constants

from motorhil import emulators
from motorhil.__main__ import ALLOCATIONS
from motorhil.compiled import PURE, is_current
from motorhil.harness.version import cores_are_compiled
from tests.support.checkout import CHECKOUT, CORES
from tests.support.cores import choose, leave_out
from tests.support.dissector import collect_sent, complaints, tshark
from tests.support.forking.client import forking

# Examples must not depend on which modules other tests of the same process have imported.
providers._get_local_constants = Constants

settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    print_blob=True,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("brief", settings.get_profile("ci"), max_examples=15)
settings.register_profile("nightly", deadline=None, print_blob=True, max_examples=5000)
settings.load_profile(os.environ.get("MOTORHIL_HYPOTHESIS", "ci"))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that divides the tests between two runs."""
    told = "run the tests that `make test` runs on these cores (tests/support/cores.py)"
    parser.addoption("--cores", choices=("compiled", "pure"), help=told)


def pytest_configure(config: pytest.Config) -> None:
    """Refuse to test pure cores when compiled ones are required, and the reverse."""
    cores = config.getoption("cores")
    if cores is not None and cores != ("compiled" if cores_are_compiled() else "pure"):
        raise pytest.UsageError(f"the cores in {emulators.__file__} are not {cores}")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the files that the run of the other cores tries."""
    cores = config.getoption("cores")
    return True if cores is not None and leave_out(collection_path, cores) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep modules and tests out of garbage collections, which take a seventh of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(ALLOCATIONS)
        gc.enable()


NIGHTLY = os.environ.get("MOTORHIL_HYPOTHESIS") == "nightly"


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(name: str, obj: object) -> list[pytest.Item] | None:
    """Leave repetition to `make nightly` before its thousands of parameters become tests."""
    if NIGHTLY or not name.startswith("test"):
        return None
    repeats = any(mark.name == "nightly" for mark in getattr(obj, "pytestmark", ()))
    return [] if repeats else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave single parameters to `make nightly`, and order tests for the workers of `make test`.

    The tests of builds come first, then wall-time tests: while they wait, other workers work.
    """
    items[:] = choose(items, config.getoption("cores"))
    if not NIGHTLY:
        repeated = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=repeated)
        items[:] = [item for item in items if not item.get_closest_marker("nightly")]
    if not hasattr(config, "workerinput"):
        return
    first = {"compiled": 0, "wall": 1, "vcan": 1}
    turns = {item.path: 2 for item in items}
    for item in items:
        marks = [turn for mark, turn in first.items() if item.get_closest_marker(mark)]
        turns[item.path] = min([turns[item.path], *marks])
    items.sort(key=lambda item: turns[item.path])


REQUIRED = [name for name in os.environ.get("MOTORHIL_REQUIRE", "").split(",") if name]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Fail skipped tests with a mark that MOTORHIL_REQUIRE=vcan,data,... lists."""
    report = yield
    if report.skipped and any(item.get_closest_marker(name) for name in REQUIRED):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"MOTORHIL_REQUIRE={','.join(REQUIRED)}, but {reason}"
    return report


DISSECTED: dict[str, str] = {}
"""Dissector results by worker, for the frames that its nodes sent."""


@pytest.fixture(scope="session", autouse=True)
def every_frame_sent_is_canopen(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Generator[None]:
    """Check with Wireshark the frames that emulated nodes sent in this session."""
    sent: set[bytes] = set()
    end = collect_sent(sent)
    yield
    end()
    if not sent:
        return
    program = tshark()
    wrong = complaints(program, sent, tmp_path_factory.mktemp("sent")) if program else []
    told = f"{len(sent)} different frames read" if program else "tshark is not installed: none read"
    config = request.config
    if hasattr(config, "workeroutput"):
        config.workeroutput["dissected"] = told
    else:
        DISSECTED["this process"] = told
    if wrong:
        pytest.fail(f"{len(wrong)} frames sent are not valid CANopen:\n" + "\n".join(wrong[:20]))


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Collect a worker's dissector result for the summary."""
    output: dict[str, str] = getattr(node, "workeroutput", {})
    if "dissected" in output:
        DISSECTED[node.gateway.id] = output["dissected"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print dissector results, and the numbers of tests run and skipped on vcan."""
    for worker, told in DISSECTED.items():
        terminalreporter.write_line(f"CANopen dissector ({worker}): {told}")
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == "on real vcan":
                terminalreporter.write_line(f"{name}: {value}")


@pytest.fixture(scope="session", autouse=True)
def own_locks(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give this run its own lock folder, apart from other runs and real motors."""
    os.environ["MOTORHIL_LOCK_DIR"] = str(tmp_path_factory.mktemp("locks"))


@pytest.fixture(scope="session", autouse=True)
def own_cores(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Run the programs of tests on the cores of this process.

    Python would look in the current folder first, where the sources are. The command of this
    checkout takes what was compiled from its sources, if that is current.
    """
    os.environ[PURE] = "0" if is_current(CHECKOUT) else "1"
    os.environ["PYTHONPATH"] = os.pathsep.join(map(str, (CORES, CHECKOUT)))
    os.chdir(tmp_path_factory.mktemp("current"))


@pytest.fixture(scope="session", autouse=True)
def forked_programs(own_cores: None, own_locks: None, own_width: None) -> Generator[None]:
    """Start the Python programs of tests by fork, after what their environment depends on."""
    with forking():
        yield


@pytest.fixture(scope="session", autouse=True)
def own_width() -> None:
    """Fix the width of help texts and tables, independent of the terminal."""
    os.environ["COLUMNS"] = "80"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of third-party data beside the checkout; skip if it is missing."""
    folder = Path(os.environ.get("MOTORHIL_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no third-party data at {folder}: set MOTORHIL_SHARED to run this")
    return folder
