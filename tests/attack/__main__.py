"""Attacks on the project, as programs: `make fuzz`, `make nightly`.

python -m tests.attack [ATTACK ...] [--seed N] [--seconds S | --count N] [--first N] [--verb VERB]
    [--keep FOLDER]

Without a name, all attacks run, each for `--seconds`. Exit status: 0 nothing was found, 1 something
was, 2 wrong usage, 130 interrupted.
"""

import argparse
import sys
from importlib import import_module
from pathlib import Path
from typing import Final

from motorhil.harness.cli.main import INTERRUPTED
from tests.attack.campaign import Attack, Campaign

ATTACKS: Final = {
    "drive": "controllers",
    "frames": "controllers",
    "lies": "lying_medium",
    "files": "damaged_files",
    "locks": "lock_kills",
    "schedules": "lock_schedules",
    "recordings": "recorder_kills",
    "pairs": "program_pairs",
    "hours": "growth",
    "rigs": "growth",
}
"""The module of each attack, whose constant has the name of the attack in capitals."""


def attack_named(name: str) -> Attack:
    """Return the attack."""
    module = import_module(f"tests.attack.{ATTACKS[name]}")
    found: Attack = getattr(module, name.upper())
    return found


def main() -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack")
    parser.add_argument("attacks", nargs="*", metavar="ATTACK", help=", ".join(ATTACKS))
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="default 1")
    parser.add_argument("--seconds", type=float, default=30.0, metavar="S", help="default 30")
    parser.add_argument("--count", type=int, metavar="N", help="this many units, whatever the time")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="begin at this attempt")
    parser.add_argument("--verb", metavar="VERB", help="only this verb of the command line (files)")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for histories of locks")
    options = parser.parse_args()
    unknown = [name for name in options.attacks if name not in ATTACKS]
    if unknown:
        parser.error(f"unknown attack {unknown[0]!r}; expected {', '.join(ATTACKS)}")
    failed = False
    for name in options.attacks or ATTACKS:
        attack = attack_named(name)
        if options.verb is not None and name == "files":
            attack = import_module(f"tests.attack.{ATTACKS[name]}").files_through(options.verb)
        if options.keep is not None and name == "locks":
            attack = import_module(f"tests.attack.{ATTACKS[name]}").locks_kept_in(options.keep)
        campaign = Campaign(attack, options.seed)
        try:
            campaign.run(options.seconds, options.count, options.first)
        except KeyboardInterrupt:
            print(campaign.summary())
            return INTERRUPTED
        print(campaign.summary(), flush=True)
        failed = failed or bool(campaign.findings)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
