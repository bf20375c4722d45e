"""Processes that share a lock and are killed and paused at random, also while they hold it.

The history of all of them must be that of a lock with one owner at a time, first come, first
served, whose token grows with every owner; and the work continues after every death.
"""

from collections import Counter
from functools import partial
from pathlib import Path
from random import Random
from tempfile import gettempdir
from typing import Final

from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.harness.sharing_tests.processes import Outcome, Plan, run
from tests.attack.campaign import Attack, Attempt, Done

EPISODE_S: Final = 3.0
KILL_PERIODS_S: Final = (0.005, 0.02, 0.05)


def plan_of(seed: str, seconds: float = EPISODE_S, plant: str = "") -> Plan:
    """Return the plan of an episode; `plant` as in `Plan`."""
    dice = Random(seed)
    return Plan(
        seconds=seconds,
        workers=dice.choice((3, 5, 8)),
        kill_period_s=dice.choice(KILL_PERIODS_S),
        kill_inside=dice.random() < 0.5,
        pause_period_s=dice.choice((0.0, 0.05, 0.2)),
        pause_s=dice.choice((0.005, 0.03)),
        pause_inside=dice.random() < 0.5,
        seed=dice.getrandbits(31),
        plant=plant,
        facts={
            "inside_s": dice.choice((0.0, 0.0005, 0.005)),
            "lease_s": dice.choice((0.0, 0.0, 0.002)),
            "take_over": dice.choice((0.0, 0.0, 0.3)),
        },
    )


def attack(plan: Plan, kept: Path) -> Done:
    """Carry out the plan and judge its history; write a violated one to the file `kept`."""
    outcome = run(plan)
    try:
        return _judge(outcome)
    except SharingViolated:
        outcome.save(kept)
        print(f"judge again: python -m motorhil.harness.sharing_tests.processes {kept}")
        raise


def _judge(outcome: Outcome) -> Done:
    outcome.require_sound()
    killed = outcome.counts.get("killed", 0)
    if outcome.counts.get("killed at the end", 0):
        raise SharingViolated("a worker did not end when it was told to")
    if killed and not outcome.taken_after_last_kill:
        raise SharingViolated("nobody has taken the lock after the last kill")
    return Done(killed + outcome.counts.get("paused", 0), b"", Counter(outcome.reached()))


def begin(seed: int, folder: Path | None = None) -> Attempt:
    """Return the attempts, one episode each; violated histories are written to the folder."""
    there = Path(gettempdir()) if folder is None else folder

    def attempt(number: int) -> Done:
        return attack(plan_of(f"{seed}:{number}"), there / f"locks-{seed}-{number}.history")

    return attempt


def locks_kept_in(folder: Path) -> Attack:
    """Return the attack that writes violated histories to this folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return Attack("locks", "kills and pauses", partial(begin, folder=folder))


LOCKS: Final = Attack("locks", "kills and pauses", begin)
