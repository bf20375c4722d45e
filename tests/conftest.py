"""Settings every test shares: Hypothesis is repeatable here and in CI alike."""

import os
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import emulators
from harness.build_info import cores_are_compiled

settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    print_blob=True,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("nightly", deadline=None, print_blob=True, max_examples=5000)
settings.load_profile(os.environ.get("MOTORHIL_HYPOTHESIS", "ci"))


def pytest_configure() -> None:
    """Tests that are to judge the compiled cores (make test-compiled) have not got others."""
    if os.environ.get("MOTORHIL_COMPILED") == "1" and not cores_are_compiled():
        raise pytest.UsageError(f"the cores in {emulators.__file__} are not compiled")


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
