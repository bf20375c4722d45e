"""Option --seed, the same for every verb that has it."""

import argparse
from typing import Final

from harness.settings import SEED_MAX


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add `--seed N`, a seed that a rig may have; None by default."""
    parser.add_argument("--seed", type=seed, metavar="N", help="overrides the rig's own seed")


def seed(text: str) -> int:
    """Read a seed, for argparse's `type`.

    Raises:
        ValueError: the text is not a seed.
    """
    value = int(text, 0)
    if not 0 <= value <= SEED_MAX:
        raise ValueError
    return value


_NAME: Final = f"seed (0 to {SEED_MAX})"
seed.__name__ = _NAME  # argparse uses it in the error for an invalid value
