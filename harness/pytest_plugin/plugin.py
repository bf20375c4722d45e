"""pytest plugin `motorhil`: rigs for tests, records of failed tests.

    def test_the_wheel_turns(motor):  # pytest --rig=wheels/rig.toml
        motor.set_setpoint(1.0)
        ...

pytest loads it wherever motorhil is installed. So it is small and imports the rest when a test uses
a rig. An option that another plugin or a conftest.py also defines is left to them; ours then has
only its long name (`--motorhil-seed`).
"""

from argparse import ArgumentTypeError
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from motorhil.harness.pytest_plugin.options import (
    CURRENT,
    OPENED,
    OWN_NAMES,
    RECORDS,
    option,
    record_folder,
)

if TYPE_CHECKING:
    from motorhil.harness.pytest_plugin.rigs import RecordOfTest
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi.group import MotorGroup
    from motorhil.motorapi.motor import Motor

_MADE: Final = pytest.StashKey[Path]()

_MARK: Final = (
    'rig("FILE", seed=N, motor="NAME", group="NAME"): the rig of a test, relative to the test\'s '
    "folder; omitted values come from an outer mark, the command line, or the rig"
)
_RIG_HELP: Final = "for fixture `rig`: a rig file (TOML), or a recording that replaces the devices"


def _seed(text: str) -> int:
    from motorhil.harness.cli.options import seed

    try:
        return seed(text)
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not a {seed.__name__}") from None


def _level(text: str) -> int:
    from motorhil.harness.cli.conform import level_of

    return level_of(text)


_OPTIONS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("rig", {"metavar": "FILE", "help": _RIG_HELP}),
    ("seed", {"metavar": "N", "type": _seed, "help": "instead of every rig's own seed"}),
    (
        "world",
        {
            "metavar": "FILE",
            "help": "add to the rig the disturbances of a fragment of `motorhil swarm`",
        },
    ),
    (
        "record-dir",
        {
            "metavar": "DIR",
            "help": f"folder for the record (MCAP) of a test that fails; default: {RECORDS}, "
            "next to pytest's ini file if there is one",
        },
    ),
    ("realtime", {"action": "store_true", "help": "run rigs no faster than the wall clock"}),
    (
        "adaptation",
        {
            "metavar": "NAME",
            "help": "check an adaptation on --rig, with one test per clause of the conformance "
            "kit; NAME or package.module:function",
        },
    ),
    (
        "level",
        {"metavar": "L3", "type": _level, "help": "run all clauses of the kit up to this level"},
    ),
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the ini option `motorhil_rig`."""
    parser.addini(
        "motorhil_rig", f"{_RIG_HELP}; used if neither a mark nor the command line names one"
    )


@pytest.hookimpl(wrapper=True)
def pytest_load_initial_conftests(
    early_config: pytest.Config, parser: pytest.Parser, args: list[str]
) -> Generator[None]:
    """Register our options last, after those of other plugins and of conftest.py.

    Until then pytest takes `x.toml` of `--rig x.toml` for a folder of tests.
    """
    words = {f"--{prefix}{name}" for name, _ in _OPTIONS for prefix in ("", "motorhil-")}
    named = early_config.known_args_namespace.file_or_dir
    for word, value in pairwise(args):
        if word in words and value in named:
            named.remove(value)
    try:
        return (yield)
    finally:
        group = parser.getgroup("motorhil", "motors on emulated drives")
        names = early_config.stash[OWN_NAMES] = {}
        for name, attributes in _OPTIONS:
            long = f"--motorhil-{name}"
            both = [f"--{name}", long] if _is_free(parser, f"--{name}") else [long]
            names[name] = both[0]
            group.addoption(*both, dest=f"motorhil_{name.replace('-', '_')}", **attributes)


def _is_free(parser: pytest.Parser, word: str) -> bool:
    try:
        return bool(parser.parse_known_and_unknown_args([f"{word}=0"])[1])
    except pytest.UsageError:  # the option is known, and 0 is not valid for it
        return False


def pytest_configure(config: pytest.Config) -> None:
    """Check the rig and the adaptation of the command line.

    Raises:
        pytest.UsageError: the rig or the adaptation cannot be used; with file, line and remedy.
    """
    config.addinivalue_line("markers", _MARK)
    if not record_folder(config).exists():
        config.stash[_MADE] = record_folder(config)
    if option(config, "rig") is not None:
        from motorhil.harness.pytest_plugin.rigs import require_rig

        require_rig(config, option(config, "rig"))
    if option(config, "adaptation") is not None:
        from motorhil.harness.pytest_plugin.clauses import collect_clauses

        collect_clauses(config)


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Return header lines: the rig, its seed, and options whose short name another plugin owns."""
    if option(config, "rig") is None:
        return []
    seed = option(config, "seed")
    lines = [f"motorhil: rig {option(config, 'rig')}, seed {'its own' if seed is None else seed}"]
    names = config.stash.get(OWN_NAMES, {})
    lines += [
        f"motorhil: --{n} belongs to another plugin; use {o}"
        for n, o in names.items()
        if o[2:] != n
    ]
    return lines


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> None:
    """Remember the test that runs, for fixtures of a whole session."""
    item.config.stash[CURRENT] = item


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the record's path and the command that repeats the test to a failed test's report."""
    opened = item.stash.get(OPENED, None)
    if opened is not None and call.excinfo is not None:
        opened.shorten(call.excinfo)
    report = yield
    if opened is not None:
        opened.take_report(report)
    return report


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Remove what passed tests left; keep the record of a test that was interrupted."""
    for item in getattr(session, "items", ()):
        opened = item.stash.get(OPENED, None)
        if opened is not None:
            opened.interrupt()
    folder = session.config.stash.get(_MADE, None)
    if folder is not None and not hasattr(session.config, "workerinput"):
        from contextlib import suppress

        with suppress(OSError):  # never created, or not empty
            folder.rmdir()


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> "Iterator[Rig]":
    """Yield the test's rig, open at time 0 and recorded; `can.Bus()` joins its first bus."""
    from motorhil.harness.pytest_plugin.rigs import opened_for

    with opened_for(request) as opened:
        yield opened.rig


@pytest.fixture(scope="session")
def open_rig(request: pytest.FixtureRequest) -> "Callable[..., AbstractContextManager[Rig]]":
    """Return a function that opens the test's rig afresh, for each example of Hypothesis.

    `with open_rig() as rig:` opens the rig that the fixture `rig` would open; `open_rig(seed=N)`
    replaces its seed, unless --seed does. The record of the last example that failed is kept.
    """
    from motorhil.harness.pytest_plugin.rigs import opened_for_example

    def opened(seed: int | None = None) -> "AbstractContextManager[Rig]":
        return opened_for_example(request.config.stash[CURRENT], seed)

    return opened


@pytest.fixture
def motor(request: pytest.FixtureRequest, rig: "Rig") -> "Motor":
    """Return the rig's first motor, or the one named by a mark or an indirect parameter."""
    opened = request.node.stash[OPENED]
    return opened.named("motor", rig.motors, getattr(request, "param", None))  # type: ignore[no-any-return] # a node's stash is not typed


@pytest.fixture
def group(request: pytest.FixtureRequest, rig: "Rig") -> "MotorGroup":
    """Return the rig's first group, or the one named by a mark or an indirect parameter."""
    opened = request.node.stash[OPENED]
    return opened.named("group", rig.groups, getattr(request, "param", None))  # type: ignore[no-any-return] # likewise


@pytest.fixture
def recording(request: pytest.FixtureRequest, rig: "Rig") -> "RecordOfTest":
    """Return the test's record: `complete()` closes the rig for reading it; `keep()` keeps it."""
    opened = request.node.stash[OPENED]
    return opened.record  # type: ignore[no-any-return] # likewise


@pytest.fixture
def virtual_time(request: pytest.FixtureRequest, rig: "Rig") -> None:
    """Let `time`, `threading` and `queue` use the rig's time, for code that knows no rig.

    A test or a suite uses it by `@pytest.mark.usefixtures("virtual_time")`, or by `usefixtures =
    virtual_time` in pytest's ini file.
    """
    request.node.stash[OPENED].enter_virtual_time()
