"""Messages on the buses: count, period, jitter, and the latest data with changed bytes."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.report.buses import Traffic
from motorhil.harness.report.document import Json

if TYPE_CHECKING:
    from numpy import int64
    from numpy.typing import NDArray

_HEAD: Final = 8  # of a Linux can_frame and canfd_frame: identifier, length, flags


@final
@dataclass(slots=True)
class Identifier:
    """One kind of message on one bus.

    Attributes:
        count: number of messages.
        last_ns: time of the latest one [ns].
        period_ns: mean distance of the latest messages [ns]; None: fewer than two.
        shortest_ns, longest_ns: of all distances between two messages [ns].
        data: content of the latest message.
        changed: bits of the bytes that differ from the content before.
        frame: the latest message as a frame; empty: unknown.
    """

    count: int = 0
    last_ns: int = 0
    period_ns: float | None = None
    shortest_ns: int = 0
    longest_ns: int = 0
    data: bytes = b""
    changed: int = 0
    frame: bytes = b""


@final
class IdentifierTable:
    """The messages of all buses, by bus and label."""

    def __init__(self) -> None:
        self._rows: dict[str, list[Identifier]] = {}
        self._changed: dict[str, set[int]] = {}

    def count(
        self, traffic: Traffic, fresh: Traffic, contents: dict[int, bytes] | None = None
    ) -> None:
        """Take the latest messages of a bus.

        Args:
            traffic: all of its traffic, with the labels.
            fresh: its entries since the last call, all of them single messages.
            contents: the latest frame of each label; None: unknown.
        """
        import numpy as np

        rows = self._rows.setdefault(traffic.name, [])
        rows += [Identifier() for _ in range(len(traffic.labels) - len(rows))]
        times, keys, _, _ = fresh.arrays()
        if not len(times):
            return
        order = np.argsort(keys, kind="stable")
        keys, times = keys[order], times[order]
        starts = np.flatnonzero(np.diff(keys, prepend=keys[0] - 1))
        ends = np.append(starts[1:], len(keys))
        changed = self._changed.setdefault(traffic.name, set())
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            key = int(keys[start])
            _count(rows[key], times[start:end])
            changed.add(key)
            if contents is not None and key in contents:
                rows[key].frame = contents[key]

    def take(self, traffics: list[Traffic], every: bool) -> list[Json]:
        """Return the rows with new messages since the last call, or all, in order of priority."""
        told: list[Json] = []
        for traffic in traffics:
            rows = self._rows.get(traffic.name, [])
            changed = self._changed.pop(traffic.name, set())
            for key in changed:
                _compare(rows[key])
            keys = range(len(rows)) if every else changed
            ranked = sorted(keys, key=lambda key: (traffic.ranks[key], key))
            told += [self._told(traffic, key, rows[key]) for key in ranked]
        return told

    def _told(self, traffic: Traffic, key: int, row: Identifier) -> Json:
        return {
            "bus": traffic.name,
            "label": traffic.labels[key],
            "name": traffic.names[key],
            "rank": traffic.ranks[key],
            "count": row.count,
            "last_s": row.last_ns / 1e9,
            "period_s": None if row.period_ns is None else row.period_ns / 1e9,
            "jitter_s": (row.longest_ns - row.shortest_ns) / 1e9,
            "data": row.data.hex(" ").upper(),
            "changed": row.changed,
        }


def _count(row: Identifier, times: "NDArray[int64]") -> None:
    """Count messages with these times [ns]."""
    import numpy as np

    distances = np.diff(times, prepend=row.last_ns) if row.count else np.diff(times)
    if len(distances):
        low, high = int(distances.min()), int(distances.max())
        is_first = row.period_ns is None
        row.shortest_ns = low if is_first else min(row.shortest_ns, low)
        row.longest_ns = max(row.longest_ns, high)
        row.period_ns = float(distances.mean())
    row.count += len(times)
    row.last_ns = int(times[-1])


def _compare(row: Identifier) -> None:
    """Take the content of the latest frame, and note which bytes have changed."""
    data = row.frame[_HEAD : _HEAD + row.frame[4]] if row.frame else b""
    row.changed = 0
    for place, byte in enumerate(data if row.data else b""):
        if place >= len(row.data) or row.data[place] != byte:
            row.changed |= 1 << place
    row.data = data
