"""Settings every test shares: Hypothesis is repeatable here and in CI alike."""

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

import emulators
from harness.build_info import cores_are_compiled
from tests.dissector import collect_sent, complaints, tshark

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


def pytest_configure() -> None:
    """Tests that are to judge the compiled cores (make test-compiled) have not got others."""
    if os.environ.get("MOTORHIL_COMPILED") == "1" and not cores_are_compiled():
        raise pytest.UsageError(f"the cores in {emulators.__file__} are not compiled")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With several workers (`make test`) what takes long or waits begins first, file by file.

    First the compiled build and what is run in it, then what goes by the wall: while it waits, the
    other workers work.
    """
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
    """With MOTORHIL_REQUIRE=vcan,data,... a test with one of these marks may not be skipped."""
    report = yield
    if report.skipped and any(item.get_closest_marker(name) for name in REQUIRED):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"MOTORHIL_REQUIRE={','.join(REQUIRED)}, but {reason}"
    return report


DISSECTED: dict[str, str] = {}
"""By worker: what came of the frames that its nodes sent."""


@pytest.fixture(scope="session", autouse=True)
def every_frame_sent_is_canopen(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Generator[None]:
    """Wireshark reads what emulated nodes have sent in this session (`tests/dissector.py`)."""
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
        pytest.fail(f"{len(wrong)} frames sent are no good CANopen:\n" + "\n".join(wrong[:20]))


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """What a worker says of its frames is told at the end."""
    output: dict[str, str] = getattr(node, "workeroutput", {})
    if "dissected" in output:
        DISSECTED[node.gateway.id] = output["dissected"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What a test that passed tells people: how many of its own ran, and were skipped, on vcan."""
    for worker, told in DISSECTED.items():
        terminalreporter.write_line(f"CANopen dissector ({worker}): {told}")
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == "on real vcan":
                terminalreporter.write_line(f"{name}: {value}")


@pytest.fixture(scope="session", autouse=True)
def own_locks(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Locks between processes of this run are not those of the next, nor of real motors."""
    os.environ["MOTORHIL_LOCK_DIR"] = str(tmp_path_factory.mktemp("locks"))


@pytest.fixture(scope="session", autouse=True)
def own_width() -> None:
    """Help and tables are as wide as where there is no terminal, whoever runs this."""
    os.environ["COLUMNS"] = "80"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of third-party data beside the checkout; without it, a skip that says so."""
    folder = Path(os.environ.get("MOTORHIL_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no third-party data at {folder}: set MOTORHIL_SHARED to run this")
    return folder
