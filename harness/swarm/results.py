"""Result files of a campaign: a folder with its plan and its rows.

Rows are only appended. Folders of one plan merge by copying their files together: a row that is
there twice counts once, and a last line that was cut is absent. Once a program has shown that it
keeps state, rows of worlds that ran alone are in files of another name, and only these count.
"""

import json
from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.lanes import Lane, file_of, lane_of
from motorhil.harness.swarm.plan import Plan, plan_from
from motorhil.harness.swarm.row import Row, row_from

PLAN: Final = "plan.json"
ROWS: Final = "rows"
ALONE: Final = "alone"
_FREE: Final = "free some space, then resume with --resume"
_LOWEST: Final = -2
"""Below all seeds."""


@final
class Results:
    """The folder of a campaign.

    Attributes:
        folder: the folder.
        rows: all rows by seed.
        is_alone: True if each world has a process of its own, because the program keeps state.
    """

    def __init__(
        self, folder: Path, rows: dict[int, Row], together: dict[int, Row] | None = None
    ) -> None:
        self.folder = folder
        self.rows: dict[int, Row] = rows
        self.is_alone: bool = together is not None
        self._together: dict[int, Row] = together or {}
        self._sort()

    @property
    def shown_by(self) -> int | None:
        """A seed whose row depended on the worlds before it; None if none is known."""
        both = self._together.items()
        return next((seed for seed, row in both if self.rows.get(seed, row) != row), None)

    def begin_alone(self, shown: Row, part: tuple[int, int]) -> None:
        """Drop all rows; those that follow are of worlds that ran alone.

        Args:
            shown: a row that depended on the worlds before it.
            part: the part of the campaign.

        Raises:
            RigError: the file cannot be written.
        """
        path = self.folder / file_of(ALONE, part)
        try:
            path.touch()  # from now on, rows in other files do not count
        except OSError as error:
            raise RigError(path, f"cannot be written: {error.strerror}", _FREE) from None
        self.append([shown], part)
        self._together, self.rows, self.is_alone = self.rows, {}, True
        self._sort()

    def _sort(self) -> None:
        self._seeds: dict[int, list[int]] = {}
        self._lanes: dict[int, tuple[int, Lane]] = {}
        for seed in sorted(self.rows):
            self._seeds.setdefault(lane_of(seed), []).append(seed)

    def missing(self, seeds: Iterable[int]) -> list[int]:
        """Return those seeds that have no row."""
        return [seed for seed in seeds if seed not in self.rows]

    def lane(self, number: int, before: int) -> Lane:
        """Return what the worlds of a lane met, up to a seed; later seeds cost only what is new."""
        known, lane = self._lanes.get(number, (_LOWEST, Lane()))
        if known > before:
            known, lane = _LOWEST, Lane()
        seeds = self._seeds.get(number, [])
        for seed in seeds[bisect_left(seeds, known) : bisect_left(seeds, before)]:
            lane.learn(self.rows[seed])
        self._lanes[number] = before, lane
        return lane

    def append(self, rows: Iterable[Row], part: tuple[int, int] = (1, 1)) -> None:
        """Add rows to the file of a part.

        Raises:
            RigError: the file cannot be written; what was written before is whole.
        """
        new = {row.seed: row for row in rows if row.seed not in self.rows}
        path = self.folder / file_of(ALONE if self.is_alone else ROWS, part)
        try:
            with path.open("ab", buffering=0) as file:
                whole = file.tell()
                left = b"".join(row.as_line().encode() + b"\n" for row in new.values())
                try:
                    while left:
                        left = left[file.write(left) :]
                except OSError:
                    file.truncate(whole)
                    raise
        except OSError as error:
            raise RigError(path, f"cannot be written: {error.strerror}", _FREE) from None
        self.rows.update(new)
        for seed in new:
            number = lane_of(seed)
            insort(self._seeds.setdefault(number, []), seed)
            if seed < self._lanes.get(number, (_LOWEST,))[0]:
                del self._lanes[number]


def require_new(folder: Path) -> None:
    """Raise RigError if the folder has the results of a campaign."""
    if (folder / PLAN).exists():
        raise RigError(folder, "has results already", "add --resume, or name another folder: -o")


def create(folder: Path, plan: Plan) -> Results:
    """Return an empty folder of a campaign.

    Raises:
        RigError: it has results already, or cannot be written.
    """
    require_new(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / PLAN).write_text(json.dumps(plan.as_table(), indent=1) + "\n")
    except OSError as error:
        raise RigError(folder, f"cannot be written: {error.strerror}", "use another -o") from None
    return Results(folder, {})


def open_results(folder: Path, *, repairs: bool = True) -> tuple[Plan, Results]:
    """Return the plan and the results of a folder.

    Args:
        folder: the folder of the campaign.
        repairs: whether a last line that was cut is removed; not while another process writes.

    Raises:
        RigError: it has none, or results that contradict each other.
    """
    path = folder / PLAN
    try:
        plan = plan_from(json.loads(path.read_text()))
    except FileNotFoundError:
        raise RigError(folder, f"has no {PLAN}", "name the folder of a campaign") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RigError(path, f"is no plan of a campaign: {error}", "use another folder") from None
    together = _rows_of(folder, ROWS, repairs)
    if any(folder.glob(f"{ALONE}*.jsonl")):
        return plan, Results(folder, _rows_of(folder, ALONE, repairs), together)
    return plan, Results(folder, together)


def _rows_of(folder: Path, kind: str, repairs: bool) -> dict[int, Row]:
    """Return the rows of all files of a kind."""
    rows: dict[int, Row] = {}
    for file in sorted(folder.glob(f"{kind}*.jsonl")):
        for row in _rows_in(file, repairs):
            other = rows.setdefault(row.seed, row)
            if other != row:
                what = f"seed {row.seed} has two results: {other.result.value}, {row.result.value}"
                raise RigError(file, what, "remove the file of another plan")
    return rows


def _rows_in(file: Path, repairs: bool) -> Iterator[Row]:
    *lines, rest = file.read_bytes().split(b"\n")
    if rest and repairs:  # a last line that was cut: remove it, so that the next one is whole
        with file.open("r+b") as writable:
            writable.truncate(file.stat().st_size - len(rest))
    for number, line in enumerate(lines, 1):
        try:
            yield row_from(line)
        except ValueError as error:
            raise RigError(file, str(error), "remove the line", line=number) from None
