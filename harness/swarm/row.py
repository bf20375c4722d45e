"""Row: the result of one world, a line of a result file."""

import json
from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from typing import Any, Final, TypeVar, final

from motorhil.frozen import frozen
from motorhil.harness.swarm.worlds.disturbance import World, from_table
from motorhil.harness.swarm.worlds.marks import Traffic, traffic_from

T = TypeVar("T")
CANARY: Final = -1
"""The seed of the world with a planted defect."""


@final
class Result(Enum):
    """The result of a world."""

    PASSED = "pass"
    FAILED = "fail"
    TIMEOUT = "timeout"  # counts as a failure
    KILLED = "killed"  # neither: something outside ended the run, such as a lack of memory
    CANCELLED = "cancelled"  # not counted: the world cannot exist


@final
@frozen
class Row:
    """The result of one world.

    Attributes:
        seed: its seed.
        result: its result.
        oracle: id of the oracle that was broken first; "assert", "always", "exception", "exit".
        signature: oracle, rule, role, state and last fault; equal for failures of one kind.
        text: the failure in a sentence.
        at_ns: time of the first violation [ns].
        end_ns: duration of the run [ns].
        digest: of the record's messages.
        fired: number of events of its disturbances.
        ended_by: name of an allowed error that ended the program, or "".
        new: (state, event) pairs that no earlier world of its lane has met.
        met: conditions of `sometimes` that were true, and those that never were, with 0.
        acts: kinds of its disturbances, and how often each struck.
        world: its disturbances, if it failed or met something new; else ().
        reactions: traffic of the run, with marks soon after disturbances, if it met something new.
    """

    seed: int
    result: Result
    oracle: str = ""
    signature: str = ""
    text: str = ""
    at_ns: int = 0
    end_ns: int = 0
    digest: str = ""
    fired: int = 0
    ended_by: str = ""
    new: tuple[str, ...] = ()
    met: tuple[tuple[str, int], ...] = ()
    acts: tuple[tuple[str, int], ...] = ()
    world: World = ()
    reactions: tuple[Traffic, ...] = ()

    @property
    def is_bad(self) -> bool:
        """True if the world is a failure."""
        return self.result in (Result.FAILED, Result.TIMEOUT)

    def as_line(self) -> str:
        """Return it as a line of JSON, without what is empty."""
        table: dict[str, object] = {}
        for key in _FIELDS:
            value = getattr(self, key)
            if value or key == "seed":
                table[key] = value
        table["result"] = self.result.value
        for key, counts in (("met", self.met), ("acts", self.acts)):
            if counts:
                table[key] = dict(counts)
        if self.world:
            table["world"] = [one.as_table() for one in self.world]
        if self.reactions:
            table["reactions"] = [one.as_row() for one in self.reactions]
        return json.dumps(table, separators=(",", ":"), ensure_ascii=False)


_FIELDS: Final = tuple(one.name for one in fields(Row))


_REPEATED: Final = ("oracle", "signature", "text", "ended_by")
_SHARED: Final[dict[Any, Any]] = {}
"""Values of earlier rows: a campaign keeps all rows, and most of their values repeat."""
_SHARED_MAX: Final = 10_000


def _once(value: T) -> T:
    """Return an equal value of an earlier row, if there is one."""
    if len(_SHARED) >= _SHARED_MAX:
        _SHARED.clear()
    found: T = _SHARED.setdefault(value, value)
    return found


def row_from(line: str | bytes) -> Row:
    """Return the row of a line.

    Raises:
        ValueError: it is no row.
    """
    try:
        table: dict[str, Any] = json.loads(line)
        table["result"] = Result(table["result"])
        table["new"] = tuple(table.get("new", ()))
        for key in ("met", "acts"):
            counts: Mapping[str, int] = table.get(key, {})
            table[key] = _once(tuple(_once(one) for one in counts.items()))
        for key in _REPEATED:
            if key in table:
                table[key] = _once(table[key])
        table["world"] = tuple(from_table(one) for one in table.get("world", ()))
        table["reactions"] = tuple(map(traffic_from, table.get("reactions", ())))
        return Row(**table)
    except (ValueError, TypeError, KeyError, AttributeError, AssertionError) as error:
        raise ValueError(f"no row of a campaign: {error}") from None
