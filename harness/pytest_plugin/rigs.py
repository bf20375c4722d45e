"""The rig of one test: choice, record and failure report."""

import hashlib
import os
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar, final

import pytest

from motorhil.harness.pytest_plugin.options import (
    OPENED,
    OWN_NAMES,
    option,
    record_folder,
    shortened,
)
from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.replay.verdict import summary, unanswered
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.names import NoSuchName
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.rig import Rig
from motorhil.harness.rig.script import is_on_purpose, is_own_file
from motorhil.harness.swarm.pytest_run import WATCHER, Watcher
from motorhil.traces.errors import TraceError

T = TypeVar("T")

_KEYS: Final = ("seed", "motor", "group")
_NAME_MAX: Final = 120
_NO_RIG: Final = (
    'no rig given; say --rig=FILE, @pytest.mark.rig("FILE"), or motorhil_rig = "FILE" in '
    "pytest's ini file (motorhil new DIR writes a rig)"
)


def require_rig(config: pytest.Config, name: str) -> None:
    """Check that the rig of the command line can be used.

    Raises:
        pytest.UsageError: the rig cannot be used; with file, line and remedy.
    """
    try:
        describe(config.invocation_params.dir / name)
    except RigError as error:
        raise pytest.UsageError(shortened(str(error), config)) from None


@contextmanager
def opened_for(request: pytest.FixtureRequest) -> Iterator["RigOfTest"]:
    """Open the rig of a test for the block; report its errors in one line."""
    try:
        opened = RigOfTest(request.node, getattr(request, "param", None))
    except RigError as error:
        raise _failure(str(error), request.config) from None
    request.node.stash[OPENED] = opened
    yield opened
    opened.close()


@contextmanager
def opened_for_example(item: pytest.Item, seed: int | None) -> Iterator[Rig]:
    """Open the rig of a test for one of its examples, and keep the record if it fails."""
    try:
        opened = RigOfTest(item, None, seed)
    except RigError as error:
        raise _failure(str(error), item.config) from None
    try:
        yield opened.rig
        opened.close()
    except BaseException:
        opened.close_failed()
        item.stash[OPENED] = opened
        raise
    opened.record.path.unlink(missing_ok=True)


def _failure(text: str, config: pytest.Config) -> BaseException:
    """Return an exception that fails the test with this text and without a traceback."""
    return pytest.fail.Exception(shortened(text, config), pytrace=False)


@final
class RecordOfTest(os.PathLike[str]):
    """The path of a test's record, which is being written.

    Attributes:
        path: where the record is.
        kept: True if the record is kept even if the test passes.
    """

    def __init__(self, opened: "RigOfTest", path: Path) -> None:
        self.path = path
        self.kept: bool = False
        self._opened = opened

    def __fspath__(self) -> str:
        return str(self.path)

    def keep(self) -> None:
        """Keep the record even if the test passes."""
        self.kept = True

    def complete(self) -> Path:
        """Close the rig and return the path of the record, which can then be read."""
        self._opened.close()
        return self.path


@final
class RigOfTest:
    """The rig of one test, and its failure report.

    Attributes:
        rig: the rig, open until `close`.
        record: the record of the test.

    Raises:
        RigError: no rig is given, or it cannot be used.
    """

    def __init__(self, item: pytest.Item, parameter: object, own_seed: int | None = None) -> None:
        self._item = item
        self._config = item.config
        self._marked = _marked(item)
        seed = option(item.config, "seed")
        if seed is None:
            seed = self._marked.get("seed") if own_seed is None else own_seed
        name = re.sub(r"[^\w.-]+", "-", item.nodeid)[-_NAME_MAX:].strip("-")
        digest = hashlib.sha256(item.nodeid.encode()).hexdigest()[:6]
        folder = record_folder(item.config)
        self._kept = folder / f"{name}-{digest}.mcap"
        self._failed = self._is_closed = self._is_reported = self._is_over = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RigError(
                folder, f"cannot be created: {error.strerror}", "name another with --record-dir"
            ) from None
        part = folder / f"{self._kept.stem}.{os.getpid()}.part.mcap"
        self.record: RecordOfTest = RecordOfTest(self, part)
        with ExitStack() as stack:
            path, self._path_options = self._path(parameter)
            stack.callback(self.record.path.unlink, missing_ok=True)
            self.rig: Rig = self._open(path, seed)
            stack.pop_all()
            stack.enter_context(self.rig)
            stack.enter_context(bus_settings(self.rig.description.buses))
            self._stack = stack.pop_all()

    def _open(self, path: Path, seed: int | None) -> Rig:
        """Open the rig; in the world of --world if it is the rig of --rig, or none is given."""
        realtime = bool(option(self._config, "realtime"))
        watcher: Watcher | None = self._config.pluginmanager.get_plugin(WATCHER)
        here = self._config.invocation_params.dir
        given, world = option(self._config, "rig"), option(self._config, "world")
        is_other = given is not None and (here / given).resolve() != path.resolve()
        if is_other:
            world = watcher = None
        if world is not None:
            self._path_options += [f"{self._config.stash[OWN_NAMES]['world']}={world}"]
        place = None if world is None else here / world
        try:
            rig = Rig.open(path, seed, realtime, self.record.path, place)
        except RigError as error:
            if watcher is not None:
                watcher.refused(error)
            raise
        if watcher is not None:
            watcher.opened(rig)
        self._watcher = watcher
        return rig

    def _path(self, parameter: object) -> tuple[Path, list[str]]:
        """Return the rig's path, and the command-line words that select the same rig again."""
        beside = self._item.path.parent
        named = parameter if parameter is not None else self._marked.get("rig")
        if isinstance(named, str | os.PathLike):
            return beside / named, []
        given = option(self._config, "rig")
        if given is not None:
            own = self._config.stash[OWN_NAMES]["rig"]
            return self._config.invocation_params.dir / given, [f"{own}={given}"]
        ini = self._config.getini("motorhil_rig")
        if not ini:
            raise RigError(self._item.nodeid, _NO_RIG)
        place = self._config.inipath
        return (self._config.rootpath if place is None else place.parent) / ini, []

    def named(self, what: str, things: Mapping[str, T], parameter: object) -> T:
        """Return the motor or group of the test: by parameter, by mark, or the rig's first."""
        name = self._marked.get(what) if parameter is None else parameter
        try:
            if name is None and not things:
                raise NoSuchName(f"this rig has no {what}")
            return things[next(iter(things)) if name is None else str(name)]
        except (RigError, NoSuchName) as error:
            raise _failure(str(error), self._config) from None

    def enter_virtual_time(self) -> None:
        """Run this thread and those it starts in the rig's time until `close`."""
        from motorhil.harness.virtual_time.stdlib.install import in_virtual_time

        self._stack.enter_context(in_virtual_time(self.rig))

    def close(self) -> None:
        """Close the rig and complete the record; fail the test if that is not possible."""
        if self._is_closed:
            return
        self._is_closed = True
        self.rig.take_forgotten()  # a test may end where it likes
        try:
            self._stack.close()
        except (RigError, TraceError) as error:
            raise _failure(str(error), self._config) from None
        finally:
            if self._watcher is not None:
                self._watcher.closed(self.rig, self.record.path)
        if unanswered(self.rig):
            raise _failure("\n".join(summary(self.rig)), self._config)

    def close_failed(self) -> None:
        """Close the rig of a failed example; its record replaces that of the one before.

        Hypothesis discards some examples by an exception. If the test passes, its end removes the
        record.
        """
        with suppress(RigError, TraceError, pytest.fail.Exception):
            self.close()  # the example's own error is told
        with suppress(FileNotFoundError):
            self.record.path.replace(self._kept)
        self.record.path = self._kept

    # --- report --------------------------------------------------------------------------------

    def shorten(self, raised: pytest.ExceptionInfo[BaseException]) -> None:
        """End the traceback of a deliberate error in the test's own line."""
        if self._config.option.fulltrace or not is_on_purpose(raised.value):
            return
        last, line = None, raised.value.__traceback__
        while line is not None:
            if not is_own_file(line.tb_frame.f_code.co_filename):
                last = line
            line = line.tb_next
        if last is not None:
            last.tb_next = None

    def take_report(self, report: pytest.TestReport) -> None:
        """Process the report of a test phase; on a failure, add where the record is."""
        if report.failed:
            self._failed = True
            if not self._is_reported:
                self._is_reported = True
                report.sections.append(("motorhil", "\n".join(self._failure_lines())))
        if report.when == "teardown":
            self._end()

    def interrupt(self) -> None:
        """Keep the record of a test that was interrupted at the end of the session."""
        if not self._is_over:
            self._failed = True
            self._end()
            reporter = self._config.pluginmanager.get_plugin("terminalreporter")
            if reporter is not None:
                reporter.ensure_newline()
                reporter.write_line(f"motorhil: interrupted: {'; '.join(self._failure_lines())}")

    def _end(self) -> None:
        """Move the record to its final place, or delete it."""
        self._is_over = True
        if self.record.kept or self._failed:
            with suppress(FileNotFoundError):  # never begun, or deleted by the test
                self.record.path.replace(self._kept)
            self.record.path = self._kept
        else:
            self.record.path.unlink(missing_ok=True)

    def _failure_lines(self) -> Iterator[str]:
        here = self._config.invocation_params.dir
        record = self._kept
        if record.is_relative_to(here):
            record = record.relative_to(here)
        now_s = self.rig.runtime.now_ns() / 1e9
        yield f"record: {shlex.quote(str(record))}, seed {self.rig.seed}, failed at {now_s:.6f} s"
        yield from (f"note:   {note}" for note in (*self.rig.notes, *self.rig.take_forgotten()))
        yield f"look:   motorhil show {shlex.quote(str(record))} --last 1"
        yield f"again:  {self._repeat_command()}"

    def _repeat_command(self) -> str:
        """Return the command that repeats only this test."""
        config = self._config
        names = config.stash[OWN_NAMES]
        words = ["pytest"]
        if config.option.inifilename:
            words += ["-c", str(config.option.inifilename)]
        if config.option.rootdir:
            words.append(f"--rootdir={config.option.rootdir}")
        for setting in config.option.override_ini or ():
            words += ["-o", setting]
        words += [*self._path_options, f"{names['seed']}={self.rig.seed}"]
        if option(config, "record-dir"):
            words.append(f"{names['record-dir']}={option(config, 'record-dir')}")
        if option(config, "realtime"):
            words.append(names["realtime"])
        file, separator, names_in_it = self._item.nodeid.partition("::")
        place = os.path.relpath(config.rootpath / file, config.invocation_params.dir)
        return shlex.join([*words, f"{place}{separator}{names_in_it}"])


def _marked(item: pytest.Item) -> dict[str, object]:
    """Return the arguments of the test's marks; the innermost mark counts.

    Raises:
        RigError: a mark has an argument that it does not support.
    """
    found: dict[str, object] = {}
    for mark in item.iter_markers("rig"):
        settings = dict(mark.kwargs)
        unknown = [name for name in settings if name not in _KEYS]
        if unknown or len(mark.args) > 1:
            raise RigError(
                item.nodeid,
                f"@pytest.mark.rig takes one file, and {', '.join(_KEYS)}; not "
                + (unknown[0] if unknown else f"{len(mark.args)} files"),
                'write @pytest.mark.rig("FILE", seed=N)',
            )
        if mark.args:
            settings["rig"] = mark.args[0]
        found = {**settings, **found}
    return found
