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
    """With several workers (`make test`) the two long groups begin at once, each on one worker.

    One is the compiled build and what is run in it, one is all that goes by the wall: nothing there
    runs beside another of its kind.
    """
    if not hasattr(config, "workerinput"):
        return
    long = {"compiled": ("compiled",), "wall": ("wall", "vcan")}
    groups: dict[str, list[pytest.Item]] = {name: [] for name in (*long, "")}
    for item in items:
        group = next(
            (g for g, marks in long.items() if any(map(item.get_closest_marker, marks))), ""
        )
        if group:
            item.add_marker(pytest.mark.xdist_group(group))
        groups[group].append(item)
    items[:] = [item for group in groups.values() for item in group]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Each worker has a group, or a file: what a file makes for all its tests is made once."""
    from xdist.scheduler import LoadGroupScheduling

    class Scheduling(LoadGroupScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return str(super()._split_scope(nodeid)).split("::")[0]

    config.option.loadscopereorder = False  # the long ones first
    return Scheduling(config, log)


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


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of third-party data beside the checkout; without it, a skip that says so."""
    folder = Path(os.environ.get("MOTORHIL_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no third-party data at {folder}: set MOTORHIL_SHARED to run this")
    return folder
