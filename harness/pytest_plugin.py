"""The pytest plugin `motorhil`: rigs for tests, and a record of each that failed.

    def test_the_wheel_turns(motor):  # pytest --rig=wheels/rig.toml
        motor.set_setpoint(1.0)
        ...

pytest loads it wherever motorhil is installed. So it is small, and loads the rest when a test asks
for a rig; and an option that another plugin or a conftest.py has as well is theirs: ours is then
called by its long name alone (`--motorhil-seed`).
"""

import os
from argparse import ArgumentTypeError
from collections.abc import Generator, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    from harness.pytest_rigs import RecordOfTest, RigOfTest
    from harness.rig import Rig
    from motorapi.group import MotorGroup
    from motorapi.motor import Motor

OPENED: Final[pytest.StashKey["RigOfTest"]] = pytest.StashKey()
"""Of a test: the rig that was opened for it."""
OWN_NAMES: Final = pytest.StashKey[dict[str, str]]()
"""Of the configuration: what each option is called here."""
_MADE: Final = pytest.StashKey[Path]()

_MARK: Final = (
    'rig("FILE", seed=N, motor="NAME", group="NAME"): the rig of a test, from the test\'s folder; '
    "what is left out is said by a mark further out, the command line, or the rig"
)
_RIG_HELP: Final = "of fixture `rig`: a rig file (TOML), or a recording, which then stands in"
_RECORDS: Final = "out"


def _seed(text: str) -> int:
    from harness.seed_option import seed

    try:
        return seed(text)
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is no {seed.__name__}") from None


def _level(text: str) -> int:
    from harness.verbs.conform import level_of

    return level_of(text)


_OPTIONS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("rig", {"metavar": "FILE", "help": _RIG_HELP}),
    ("seed", {"metavar": "N", "type": _seed, "help": "instead of every rig's own seed"}),
    (
        "record-dir",
        {
            "metavar": "DIR",
            "help": "where a test that fails leaves its record (MCAP); "
            f"default: {_RECORDS}, beside pytest's ini file if there is one",
        },
    ),
    ("realtime", {"action": "store_true", "help": "rigs are no faster than the wall clock"}),
    (
        "adaptation",
        {
            "metavar": "NAME",
            "help": "check whether it keeps its promises on --rig: a test for each clause of the "
            "conformance kit; NAME or package.module:function",
        },
    ),
    ("level", {"metavar": "L3", "type": _level, "help": "all clauses of the kit up to this level"}),
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """`motorhil_rig` may stand in pytest's ini file."""
    parser.addini("motorhil_rig", f"{_RIG_HELP}; where neither mark nor command line names one")


@pytest.hookimpl(wrapper=True)
def pytest_load_initial_conftests(
    early_config: pytest.Config, parser: pytest.Parser, args: list[str]
) -> Generator[None]:
    """Our options are known: last of all, when others and conftest.py have theirs.

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
    except pytest.UsageError:  # it is known, and no 0
        return False


def option(config: pytest.Config, name: str) -> Any:
    """What our option was given, or its default; None where our options came too late."""
    return config.getoption(f"motorhil_{name.replace('-', '_')}", None)


def record_folder(config: pytest.Config) -> Path:
    """Where tests that fail leave their records."""
    here = config.invocation_params.dir
    named = option(config, "record-dir")
    if named is None and config.inipath is not None:
        return config.inipath.parent / _RECORDS
    return here / (named or _RECORDS)


def shortened(text: str, config: pytest.Config) -> str:
    """The text; what lies in the folder that pytest was called in is named from there."""
    return text.replace(f"{config.invocation_params.dir}{os.sep}", "")


def pytest_configure(config: pytest.Config) -> None:
    """What the command line names is there.

    Raises:
        pytest.UsageError: rig or adaptation cannot be used; with file, line and remedy.
    """
    config.addinivalue_line("markers", _MARK)
    if not record_folder(config).exists():
        config.stash[_MADE] = record_folder(config)
    if option(config, "rig") is not None:
        from harness.pytest_rigs import require_rig

        require_rig(config, option(config, "rig"))
    if option(config, "adaptation") is not None:
        from harness.pytest_clauses import collect_clauses

        collect_clauses(config)


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Which rig the command line names; and whose `--seed` is another's, since that surprises."""
    if option(config, "rig") is None:
        return []
    seed = option(config, "seed")
    lines = [f"motorhil: rig {option(config, 'rig')}, seed {'its own' if seed is None else seed}"]
    names = config.stash.get(OWN_NAMES, {})
    lines += [f"motorhil: --{n} is not ours here; {o} is" for n, o in names.items() if o[2:] != n]
    return lines


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A test that failed with a rig tells where its record is, and how it is repeated."""
    opened = item.stash.get(OPENED, None)
    if opened is not None and call.excinfo is not None:
        opened.shorten(call.excinfo)
    report = yield
    if opened is not None:
        opened.hear(report)
    return report


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Nothing is left of tests that passed, and a record of the one that was interrupted."""
    for item in getattr(session, "items", ()):
        opened = item.stash.get(OPENED, None)
        if opened is not None:
            opened.interrupt()
    folder = session.config.stash.get(_MADE, None)
    if folder is not None and not hasattr(session.config, "workerinput"):
        from contextlib import suppress

        with suppress(OSError):  # it was never made, or holds something
            folder.rmdir()


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> "Iterator[Rig]":
    """The test's own rig, open, at time 0, recorded; within it `can.Bus()` joins its first bus."""
    from harness.pytest_rigs import opened_for

    with opened_for(request) as opened:
        yield opened.rig


@pytest.fixture
def motor(request: pytest.FixtureRequest, rig: "Rig") -> "Motor":
    """The rig's first motor; or the one that a mark, or an indirect parameter, names."""
    opened = request.node.stash[OPENED]
    return opened.named("motor", rig.motors, getattr(request, "param", None))  # type: ignore[no-any-return] # a node's stash is not typed


@pytest.fixture
def group(request: pytest.FixtureRequest, rig: "Rig") -> "MotorGroup":
    """The rig's first group; or the one that a mark, or an indirect parameter, names."""
    opened = request.node.stash[OPENED]
    return opened.named("group", rig.groups, getattr(request, "param", None))  # type: ignore[no-any-return] # likewise


@pytest.fixture
def recording(request: pytest.FixtureRequest, rig: "Rig") -> "RecordOfTest":
    """The test's record: `complete()` closes the rig, and it can be read; `keep()` lets it stay."""
    opened = request.node.stash[OPENED]
    return opened.record  # type: ignore[no-any-return] # likewise


@pytest.fixture
def virtual_time(request: pytest.FixtureRequest, rig: "Rig") -> None:
    """`time`, `threading` and `queue` go by the rig from now on: for code that knows no rig.

    A test, or all of a suite, has it by `@pytest.mark.usefixtures("virtual_time")`, or by
    `usefixtures = virtual_time` in pytest's ini file.
    """
    request.node.stash[OPENED].enter_virtual_time()
