"""Progress of a campaign on the wall clock: when it began, what was asked, when each row came.

Times are kept beside the rows, in files of their own: rows are the same on each machine, times are
not. The files of several machines merge by copying, as those of rows do.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, TextIO, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.lanes import LANES, file_of
from motorhil.harness.swarm.row import Row

TIMES: Final = "times*.jsonl"
_STEPS: Final = 60


@final
@frozen
class Progress:
    """Progress of a campaign.

    Attributes:
        asked: number of worlds asked for.
        begun_s: when it began [s of the Unix epoch]; None if there are no times.
        last_s: when the last row came [s of the Unix epoch].
        took_s: duration until the last row, without pauses between an end and a new beginning [s].
        is_over: True if each machine has told its end.
        rate: (time without pauses [s], worlds per second) over the campaign.
        seen_s: by seed, when its row came, without pauses [s].
    """

    asked: int = 0
    begun_s: float | None = None
    last_s: float = 0.0
    took_s: float = 0.0
    is_over: bool = True
    rate: tuple[tuple[float, float], ...] = ()
    seen_s: Mapping[int, float] | None = None

    def seen(self, rows: Iterable[Row]) -> float | None:
        """Return when the first of some rows came, without pauses [s]; None if it is unknown."""
        known = self.seen_s or {}
        return min((known[row.seed] for row in rows if row.seed in known), default=None)

    @property
    def mean(self) -> float | None:
        """Worlds per second over the campaign; None if it is unknown."""
        return len(self.seen_s) / self.took_s if self.seen_s and self.took_s > 0.0 else None


@final
class Times:
    """The file of times that a running campaign writes.

    Args:
        folder: the folder of the campaign.
        part: (K, N) of the seeds.
        first: first seed asked for.
        seeds: number of seeds asked for.
        at_s: now [s of the Unix epoch].

    Raises:
        RigError: the file cannot be written.
    """

    def __init__(
        self, folder: Path, part: tuple[int, int], first: int, seeds: int, at_s: float
    ) -> None:
        self._path = folder / file_of("times", part)
        self._write({"at": at_s, "first": first, "asked": seeds, "part": part})

    def take(self, rows: Iterable[Row], at_s: float) -> None:
        """Add the rows of a chunk."""
        self._write({"at": at_s, "seeds": [row.seed for row in rows]})

    def end(self, at_s: float) -> None:
        """Add the end."""
        self._write({"at": at_s, "ended": True})

    def _write(self, table: Mapping[str, object]) -> None:
        try:
            with self._path.open("a", encoding="utf-8") as file:
                _add(file, table)
        except OSError as error:
            what = f"cannot be written: {error.strerror}"
            raise RigError(self._path, what, "free some space") from None


def _add(file: TextIO, table: Mapping[str, object]) -> None:
    file.write(json.dumps(table, separators=(",", ":")) + "\n")


def progress_in(folder: Path) -> Progress:
    """Return the progress of a campaign, as far as its folder has times."""
    came: list[tuple[float, list[int]]] = []
    ranges: dict[int, list[tuple[int, int]]] = {lane: [] for lane in range(LANES)}
    begun: list[float] = []
    is_over = True
    for file in sorted(folder.glob(TIMES)):
        runs = False
        for table in _tables_in(file):
            if "asked" in table:
                number, count = table["part"]
                for lane in range(number - 1, LANES, count):
                    ranges[lane].append((table["first"], table["first"] + table["asked"]))
                begun.append(table["at"])
            came.append((table["at"], table.get("seeds", [])))
            runs = "ended" not in table
        is_over = is_over and not runs
    if not begun:
        return Progress()
    came.sort(key=lambda one: one[0])
    seen_s: dict[int, float] = {}
    took_s, before_s = 0.0, came[0][0]
    counts: list[tuple[float, int]] = []
    for at_s, seeds in came:
        took_s += at_s - before_s if seeds else 0.0
        before_s = at_s
        counts.append((took_s, sum(seed not in seen_s for seed in seeds)))
        for seed in seeds:
            seen_s.setdefault(seed, took_s)
    rate = _rate(counts, took_s)
    asked = sum(_union(lane, some) for lane, some in ranges.items())
    return Progress(asked, min(begun), before_s, took_s, is_over, rate, seen_s)


def _tables_in(file: Path) -> Iterable[dict[str, Any]]:
    """Return the whole lines of a file; the last one may be cut."""
    tables = []
    for line in file.read_bytes().split(b"\n"):
        try:
            table = json.loads(line)
            float(table["at"])
        except (ValueError, KeyError, TypeError):
            continue
        tables.append(table)
    return tables


def _union(lane: int, ranges: list[tuple[int, int]]) -> int:
    """Return the number of a lane's seeds in some ranges, each counted once."""
    count, end = 0, 0
    for low, high in sorted(ranges):
        count += len(range(_first(lane, max(low, end)), high, LANES))
        end = max(end, high)
    return count


def _first(lane: int, low: int) -> int:
    """Return the lowest seed of a lane from `low` on."""
    return low + (lane - low) % LANES


def _rate(counts: list[tuple[float, int]], took_s: float) -> tuple[tuple[float, float], ...]:
    """Return worlds per second in equal steps of time."""
    if took_s <= 0.0:
        return ()
    rows = [one for one in counts if one[1]]
    steps = max(1, min(_STEPS, len(rows) // 4))
    width_s = took_s / steps
    sums = [0] * steps
    for at_s, count in rows:
        sums[min(steps - 1, int(at_s / width_s))] += count
    middle = [((place + 0.5) * width_s, total / width_s) for place, total in enumerate(sums)]
    return ((0.0, middle[0][1]), *middle, (took_s, middle[-1][1]))
