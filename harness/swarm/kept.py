"""Kept failures: a fragment per cause, a test that repeats it, and the command that shows it."""

import hashlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.plan import FUNCTION, PYTEST, Plan
from motorhil.harness.swarm.row import Row
from motorhil.harness.swarm.worlds.disturbance import fragment
from motorhil.harness.swarm.worlds.shrinking import cause_of

FOLDER: Final = "failures"
_NAME_MAX: Final = 48


@final
@dataclass(frozen=True, slots=True)
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


def name_of(row: Row) -> str:
    """Return a file name for the cause of a failure."""
    cause = cause_of(row)
    words = re.sub(r"[^a-z0-9]+", "_", cause.lower()).strip("_")[:_NAME_MAX].rstrip("_")
    return f"{words}_{hashlib.sha256(cause.encode()).hexdigest()[:6]}"


def keep(row: Row, plan: Plan, folder: Path) -> Kept:
    """Write the fragment and the test of a failure.

    Raises:
        RigError: they cannot be written.
    """
    home = folder / FOLDER
    path, test = home / f"{name_of(row)}.toml", home / f"test_{name_of(row)}.py"
    head = [f"# {line}" for line in (story(row), f"again: {command(row, plan, path)}")]
    try:
        home.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([*head, "", fragment(row.world)]))
        test.write_text(_test(row, plan, path))
    except OSError as error:
        raise RigError(home, f"cannot be written: {error.strerror}", "free some space") from None
    return Kept(row, path, test)


def story(row: Row) -> str:
    """Return in a sentence what happened in the world of a failure."""
    acts = ", ".join(_acts(row)) or "nothing disturbs it"
    return f"World {row.seed}: {acts}; then at {row.at_ns / 1e9:.6f} s {row.text}"


def _acts(row: Row) -> Iterator[str]:
    for one in row.world:
        values = ", ".join(f"{key} {_shown(key, value)}" for key, value in one.values)
        yield f"{one.kind} on {one.on} ({values})" if one.on else f"{one.kind} ({values})"


def _shown(key: str, value: object) -> str:
    if isinstance(value, int) and key in ("identifier", "code"):
        return f"{value:X}h"
    return f"{value}"


def command(row: Row, plan: Plan, world: Path) -> str:
    """Return the command that repeats a failure."""
    options = ["--seed", str(abs(row.seed)), "--world", str(world)]
    program = plan.program
    if program.kind == PYTEST:
        words = ["pytest", program.name, "--rig", plan.rig, *options, *program.words]
    elif program.kind == FUNCTION:
        words = ["motorhil", "swarm", plan.rig, program.name, *options]
    else:
        words = ["motorhil", "run", plan.rig, program.name, *options]
        words += ["--", *program.words] if program.words else []
    return shlex.join(words)


def _test(row: Row, plan: Plan, path: Path) -> str:
    program = plan.program
    words = ", ".join(map(repr, program.words))
    rig = str(Path(plan.rig).resolve())
    name = program.name if program.kind != "script" else str(Path(program.name).resolve())
    return f'''"""{story(row)}"""

from pathlib import Path

from motorhil.harness.swarm.repeat import assert_holds

RIG = Path({rig!r})
WORLD = Path(__file__).with_name({path.name!r})


def test_world_{abs(row.seed)}() -> None:
    assert_holds(RIG, {program.kind!r}, {name!r}, [{words}], seed={row.seed}, world=WORLD)
'''
