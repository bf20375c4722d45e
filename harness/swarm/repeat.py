"""Repetition of a kept failure, as a test."""

from collections.abc import Sequence
from pathlib import Path

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.plan import WALL_S, Program, plan_of
from motorhil.harness.swarm.row import Result
from motorhil.harness.swarm.trial import tried_in


def assert_holds(
    rig: Path, kind: str, program: str, words: Sequence[str] = (), *, seed: int, world: Path
) -> None:
    """Run a program in a world; fail if an oracle or the program itself is broken again.

    Args:
        rig: the rig file.
        kind: "script", "function", "pytest", or "programs" for those of the rig.
        program: a file, "package.module:function", a node id, or the rig file.
        words: arguments of the program.
        seed: the world's seed.
        world: the fragment of the world.

    Raises:
        AssertionError: it is broken again; with the failure in a sentence.
        RigError: the rig or the fragment cannot be used.
    """
    plan = plan_of(rig, Program(kind, program, tuple(words)), (), WALL_S)
    row = tried_in(plan, seed, world)
    if row.result is Result.CANCELLED:
        raise RigError(world, row.text)
    assert not row.is_bad, f"{row.oracle} at {row.at_ns / 1e9:.6f} s: {row.text}"
