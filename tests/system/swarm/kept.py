"""Worlds that have failed once, in `kept.toml`: correct programs pass them for ever."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

KEPT = Path(__file__).with_name("kept.toml")


@dataclass(frozen=True)
class KeptWorld:
    """A world that has failed.

    program: name of the correct program that failed, or of the defect.
    seed: of the rig.
    cause: why it failed then; the cause of a defect, or "" if the world must pass.
    because: what was wrong, in a sentence.
    fragment: the world, as TOML.
    """

    program: str
    seed: int
    cause: str
    because: str
    fragment: str


def kept_worlds():
    """Return all kept worlds."""
    return [KeptWorld(**table) for table in tomllib.loads(KEPT.read_text())["world"]]


def keep(one: KeptWorld):
    """Append a world to the file."""
    text = (
        f'\n[[world]]\nprogram = "{one.program}"\nseed = {one.seed}\ncause = "{one.cause}"\n'
        f"because = '''{one.because}'''\nfragment = '''\n{one.fragment}'''\n"
    )
    KEPT.write_text(KEPT.read_text() + text)
