"""A table of figures that is kept in the repository, and tells what has moved since.

Machines differ in speed. So times and rates are compared in units of an interpreted loop, which
runs before and after the benchmarks; ratios, counts and sizes are compared as they are. A figure
has moved if it lies further from the kept one than the noise that was seen when it was kept.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

TABLE = Path(__file__).with_name("kept.tsv")
TIMES = ("us", "ms", "s")
RATES = ("x real time", "1/s", "requests/s", "1/h")
_HEAD = "name\tunit\tfigure\tleast\tmost"
_LEAST = 0.05  # noise that is always allowed, as a share
_LOOPS = 300_000
_ROUNDS = 7

Figure = tuple[str, float, str]


@dataclass(frozen=True)
class Kept:
    """A figure of the table.

    unit: as the benchmark gives it.
    figure: the middle one of several runs, scaled to a machine of speed 1.
    least, most: of these runs, scaled alike.
    """

    unit: str
    figure: float
    least: float
    most: float

    def moved(self, figure: float) -> float | None:
        """Return by which share a scaled figure lies beyond the noise of this one, or None."""
        if not self.figure:
            return None if not figure else float("inf")
        change = figure / self.figure - 1.0
        noise = max(_LEAST, 2.0 * (self.most - self.least) / abs(self.figure))
        return change if abs(change) > noise else None


def loop_ms() -> float:
    """Return the CPU time of an interpreted loop [ms], the best of several runs."""

    def once() -> float:
        total, table = 0, {}
        begun = time.process_time()
        for number in range(_LOOPS):
            total += number & 7
            table[number & 255] = (total, number)
        return (time.process_time() - begun) * 1e3

    return min(once() for _ in range(_ROUNDS))


def scaled(figure: float, unit: str, loop: float) -> float:
    """Return a figure as a machine would give it on which the loop takes 10 ms."""
    if unit in TIMES:
        return figure * 10.0 / loop
    return figure * loop / 10.0 if unit in RATES else figure


def named(figures: Iterable[Figure]) -> Iterator[Figure]:
    """Yield figures with whole names: one that begins with spaces belongs to the one before.

    Raises:
        ValueError: two figures have one name, so that a table could not tell them apart.
    """
    head = ""
    told: set[str] = set()
    for name, figure, unit in figures:
        if not name.startswith(" "):
            head = name
        whole = name if name == head else f"{head}: {name.strip()}"
        if whole in told:
            raise ValueError(f"figure {whole!r}: told twice; expected a name of its own")
        told.add(whole)
        yield whole, figure, unit


def read(path: Path = TABLE) -> dict[str, Kept]:
    """Return the kept figures by name, none if there is no table."""
    if not path.exists():
        return {}
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == _HEAD, f"{path}:1: {lines[0]!r}; expected {_HEAD!r}"
    rows = (line.split("\t") for line in lines[1:])
    return {name: Kept(unit, *map(float, numbers)) for name, unit, *numbers in rows}


def kept_of(unit: str, runs: list[float]) -> Kept:
    """Return the row of a figure that was measured in several runs, scaled."""
    return Kept(unit, sorted(runs)[len(runs) // 2], min(runs), max(runs))


def write(table: Mapping[str, Kept], about: str, path: Path = TABLE) -> None:
    """Write the table, with a line about the source that was measured last."""
    lines = [f"# {about}", "# scaled to a machine on which kept.loop_ms() is 10", _HEAD]
    for name, one in table.items():
        numbers = (f"{x:.5g}" for x in (one.figure, one.least, one.most))
        lines.append("\t".join([name, one.unit, *numbers]))
    path.write_text("\n".join(lines) + "\n")


def told(kept: Kept | None, figure: float, unit: str) -> str:
    """Return what a line says of a scaled figure beside the kept one."""
    if kept is None or kept.unit != unit:
        return "new"
    change = kept.moved(figure)
    if change is None:
        return ""
    if unit not in (*TIMES, *RATES):
        return f"moved {change:+.0%}"
    return f"moved {change:+.0%} {'better' if (change < 0.0) == (unit in TIMES) else 'worse'}"
