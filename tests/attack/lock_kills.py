"""Processes that share a lock and are killed and paused at random, also while they hold it.

The history of all of them must be that of a lock with one owner at a time, first come, first
served, whose token grows with every owner; and the work continues after every death.
"""

from collections import Counter
from random import Random
from typing import Final

from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.harness.sharing_tests.processes import Plan, run
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


def attack(plan: Plan) -> Done:
    """Carry out the plan and judge its history."""
    outcome = run(plan)
    outcome.require_sound()
    killed = outcome.counts.get("killed", 0)
    if outcome.counts.get("killed at the end", 0):
        raise SharingViolated("a worker did not end when it was told to")
    if killed and not outcome.taken_after_last_kill:
        raise SharingViolated("nobody has taken the lock after the last kill")
    return Done(killed + outcome.counts.get("paused", 0), b"", Counter(outcome.reached()))


def begin(seed: int) -> Attempt:
    """Return the attempts: one episode each."""
    return lambda number: attack(plan_of(f"{seed}:{number}"))


LOCKS: Final = Attack("locks", "kills and pauses", begin)
