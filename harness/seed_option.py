"""The option --seed, the same for every verb that has it."""

import argparse
from typing import Final

from harness.settings import SEED_MAX


def add_seed(parser: argparse.ArgumentParser) -> None:
    """`--seed N` is understood: a number a rig may have, else None."""
    parser.add_argument("--seed", type=seed, metavar="N", help="instead of the rig's own seed")


def seed(text: str) -> int:
    """For argparse's `type`: a seed.

    Raises:
        ValueError: it is none.
    """
    value = int(text, 0)
    if not 0 <= value <= SEED_MAX:
        raise ValueError
    return value


_NAME: Final = f"seed (0 to {SEED_MAX})"
seed.__name__ = _NAME  # what argparse calls it when it is none
