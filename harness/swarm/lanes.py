"""Lanes: the order of worlds in a campaign, and the guidance by what earlier ones met.

A seed belongs to the lane seed % LANES. Within a lane worlds run one after the other; every second
one mutates an earlier world of its lane that met something new. So a world depends on the plan and
the seeds below it in its lane, never on how a campaign was divided, interrupted or resumed.
"""

from collections.abc import Iterable
from random import Random
from typing import Final, final

from motorhil.harness.rig.config.worlds import SwarmTable
from motorhil.harness.swarm.row import CANARY, Row
from motorhil.harness.swarm.worlds.disturbance import World
from motorhil.harness.swarm.worlds.drawing import Parent, drawn, mutated
from motorhil.harness.swarm.worlds.profile import Profile

LANES: Final = 16
_CORPUS_MAX: Final = 256
_PICKS: Final = 3
_CHECKED: Final = 4
"""The last world of every batch of that number runs alone as well."""
_CHECKED_EARLY: Final = (LANES, LANES + LANES // 2)
"""Seeds that show in a short campaign whether the program keeps state."""
_FRESH: Final = 4
"""One of that many rounds draws anew; the others mutate earlier worlds."""


def lane_of(seed: int) -> int:
    """Return the lane of a seed."""
    return 0 if seed == CANARY else seed % LANES


def batch_of(seed: int, size: int) -> int:
    """Return the number of a seed's batch in its lane; a batch has that many worlds at most."""
    return seed // LANES // size


def is_checked(seed: int, size: int) -> bool:
    """Return True if a world that passes in its batch runs alone as well."""
    is_last = seed // LANES % size == size - 1
    return seed in _CHECKED_EARLY or (is_last and batch_of(seed, size) % _CHECKED == 0)


def file_of(kind: str, part: tuple[int, int]) -> str:
    """Return the name of a result file of part K of N, so that folders of all parts merge."""
    number, count = part
    return f"{kind}.jsonl" if count == 1 else f"{kind}-{number}-of-{count}.jsonl"


@final
class Lane:
    """Pairs that the worlds of a lane have met so far, and the worlds that met them.

    Attributes:
        seen: (state, event) pairs that were met.
        corpus: worlds that met a new pair, the oldest first.
    """

    def __init__(self, seen: Iterable[str] = (), corpus: Iterable[Parent] = ()) -> None:
        self.seen: dict[str, None] = dict.fromkeys(seen)
        self.corpus: list[Parent] = list(corpus)[-_CORPUS_MAX:]

    def learn(self, row: Row) -> None:
        """Take the result of the lane's next world."""
        new = [pair for pair in row.new if pair not in self.seen]
        if new and row.seed != CANARY:
            self.seen.update(dict.fromkeys(new))
            if row.world:
                reached = sum(count > 0 for _, count in row.met)
                self.corpus.append(Parent(row.world, row.reactions, reached))
                del self.corpus[:-_CORPUS_MAX]

    def world(self, seed: int, profile: Profile, table: SwarmTable, guided: bool = True) -> World:
        """Return the world of a seed, the next one of this lane."""
        random = Random(f"world {seed}")
        if guided and self.corpus and (seed // LANES) % _FRESH:
            return mutated(self._parent(random), random, profile, table)
        return drawn(random, profile, table)

    def _parent(self, random: Random) -> Parent:
        """Return a world to mutate: rather a late one, which met what is rare.

        Of some, take the one that has reached most conditions of `sometimes`: the program itself
        tells by them which of its parts are rarely tested. Then a small one is better.
        """
        count = len(self.corpus)
        picks = [self.corpus[int(count * random.random() ** 0.5)] for _ in range(_PICKS)]
        return max(picks, key=lambda one: (one.reached, -len(one.world)))
