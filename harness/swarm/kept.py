"""Kept failures: for each cause a fragment, a test that repeats it, its row and its recording."""

import hashlib
import os
import re
import shlex
from pathlib import Path
from textwrap import wrap
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.plan import FUNCTION, PROGRAMS, PYTEST, Plan, Program
from motorhil.harness.swarm.report.sentences import story
from motorhil.harness.swarm.row import Row, row_from
from motorhil.harness.swarm.worlds.disturbance import fragment
from motorhil.harness.swarm.worlds.shrinking import cause_of

FOLDER: Final = "failures"
_NAME_MAX: Final = 48
_COLUMNS: Final = 88
"""Width of a generated test: the usual one of ruff and black."""


@final
@frozen
class Kept:
    """A failure in files.

    Attributes:
        row: the failure.
        fragment: the file of its world.
        test: the test that repeats it.
        record: its recording; None if it is not there.
    """

    row: Row
    fragment: Path
    test: Path
    record: Path | None = None

    @property
    def cause(self) -> str:
        """Oracle, rule and role."""
        return cause_of(self.row)


def name_of(row: Row) -> str:
    """Return a file name for the cause of a failure."""
    cause = cause_of(row)
    words = re.sub(r"[^a-z0-9]+", "_", cause.lower()).strip("_")[:_NAME_MAX].rstrip("_")
    return f"{words}_{hashlib.sha256(cause.encode()).hexdigest()[:6]}"


def record_of(row: Row, folder: Path) -> Path:
    """Return the file for the recording of a failure; make its folder.

    Raises:
        RigError: the folder cannot be made.
    """
    home = folder / FOLDER
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RigError(home, f"cannot be made: {error.strerror}", "use another -o") from None
    return home / f"{name_of(row)}.mcap"


def keep(row: Row, plan: Plan, folder: Path) -> Kept:
    """Write the fragment, the test and the row of a failure.

    Raises:
        RigError: they cannot be written.
    """
    record = record_of(row, folder)
    path, test = _fragment_and_test(record)
    head = [f"# {line}" for line in (story(row), f"again: {command(row, plan, path)}")]
    try:
        path.write_text("\n".join([*head, "", fragment(row.world)]), encoding="utf-8")
        test.write_text(_test(row, plan, path), encoding="utf-8")
        record.with_suffix(".json").write_text(row.as_line() + "\n", encoding="utf-8")
    except OSError as error:
        what = f"cannot be written: {error.strerror}"
        raise RigError(record.parent, what, "free some space") from None
    return Kept(row, path, test, record if record.exists() else None)


def kept_in(folder: Path) -> list[Kept]:
    """Return the failures that a folder keeps.

    Raises:
        RigError: one of them cannot be read.
    """
    found = []
    for file in sorted((folder / FOLDER).glob("*.json")):
        try:
            row = row_from(file.read_bytes())
        except (OSError, ValueError) as error:
            raise RigError(file, f"cannot be read: {error}", "remove the file") from None
        record = file.with_suffix(".mcap")
        paths = _fragment_and_test(record)
        found.append(Kept(row, *paths, record if record.exists() else None))
    return found


def _fragment_and_test(record: Path) -> tuple[Path, Path]:
    return record.with_suffix(".toml"), record.with_name(f"test_{record.stem}.py")


def command(row: Row, plan: Plan, world: Path) -> str:
    """Return the command that repeats a failure."""
    options = ["--seed", str(abs(row.seed)), "--world", str(world)]
    program = plan.program
    if program.kind == PROGRAMS:
        words = ["motorhil", "run", plan.rig, *options]
    elif program.kind == PYTEST:
        words = ["pytest", program.name, "--rig", plan.rig, *options, *program.words]
    elif program.kind == FUNCTION:
        words = ["motorhil", "swarm", plan.rig, program.name, *options]
    else:
        words = ["motorhil", "run", plan.rig, program.name, *options]
        words += ["--", *program.words] if program.words else []
    return shlex.join(words)


# --- the test ------------------------------------------------------------------------------------


def _test(row: Row, plan: Plan, path: Path) -> str:
    """Return a test as ruff formats it; a comma after each last argument keeps one a line."""
    home = path.parent
    told = story(row).replace('"""', "'''")
    raw = "r" if "\\" in told else ""
    text = "\n".join(wrap(told, _COLUMNS, break_long_words=False))
    words = ", ".join(map(_quoted, plan.program.words))
    return f'''{raw}"""Repeat a failure of a swarm.

{text}
"""

from pathlib import Path

from motorhil.harness.swarm.repeat import assert_holds

HERE = Path(__file__).parent
RIG = {_path(Path(plan.rig), home)}
WORLD = HERE / {_quoted(path.name)}


def test_{path.stem}() -> None:
    assert_holds(
        RIG,
        {_quoted(plan.program.kind)},
        {_program(plan.program, home)},
        [{words}],
        seed={row.seed},
        world=WORLD,
    )
'''


def _program(program: Program, home: Path) -> str:
    """Return the program of a test as Python: a file below the test's folder, or a name."""
    file, _, rest = program.name.partition("::")
    if program.kind == FUNCTION:
        return _quoted(program.name)
    path = _path(Path(file), home)
    return f"str({path}) + {_quoted(f'::{rest}')}" if rest else f"str({path})"


def _path(path: Path, home: Path) -> str:
    """Return a path as Python: from the test's folder if both have a parent but the root."""
    there, here = path.resolve(), home.resolve()
    if os.path.commonpath((there, here)) == "/":
        return f"Path({_quoted(str(there))})"
    return f"HERE / {_quoted(os.path.relpath(there, here))}"


def _quoted(text: str) -> str:
    """Return a text as Python, in double quotes where it has none."""
    written = repr(text)
    return written if '"' in written else f'"{written[1:-1]}"'
