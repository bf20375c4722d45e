"""Oracle of the SYNC period: within bounds, and without missing SYNCs.

Source: CiA 301, SYNC protocol, communication cycle period 1006h.
"""

from collections.abc import Mapping
from typing import ClassVar, Final, final

from harness.oracles.finding import Violation
from harness.oracles.oracle import Oracle
from harness.oracles.scene import Axis, Scene

_SAMPLES: Final = 64
_REGULAR: Final = 0.8
JITTER_SHARE: Final = 0.25
"""The allowed share of the period; nodes' synchronous window (1007h) is rarely wider."""
_MISSED_MAX: Final = 3
_ON_GRID: Final = 0.1


@final
class _Series:
    """SYNCs of one identifier on one bus. period_ns: None: not learned yet, 0: not cyclic."""

    def __init__(self) -> None:
        self.last_ns = -1
        self.period_ns: int | None = None
        self.intervals: list[tuple[int, int]] = []  # time, interval; bounded


@final
class SyncPeriod(Oracle):
    """The oracle `sync-period`."""

    id = "sync-period"
    promise = "Cyclic SYNCs come at their period, within a quarter of it, and none is missing"
    source = "CiA 301, SYNC protocol, communication cycle period 1006h"
    needs = "no cyclic SYNC was heard"
    objects: ClassVar[Mapping[int, bool]] = {0x1006: False}

    def __init__(self, scene: Scene) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(scene)
        self._series: dict[tuple[str, int], _Series] = {}
        self._told_us: dict[str, int] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """Take a communication cycle period [us]."""
        if value:
            self._told_us[axis.place[0]] = value

    def sync(self, time_ns: int, bus: str, identifier: int) -> None:
        """Examine the distance to the previous SYNC."""
        series = self._series.get((bus, identifier))
        if series is None:
            series = self._series[bus, identifier] = _Series()
        interval_ns, first = time_ns - series.last_ns, series.last_ns < 0
        series.last_ns = time_ns
        if first:
            return
        if series.period_ns is None:
            series.intervals.append((time_ns, interval_ns))
            if len(series.intervals) >= _SAMPLES:
                self._learn(bus, series)
        elif series.period_ns:
            self._judge(time_ns, bus, interval_ns, series.period_ns)

    def end(self, time_ns: int) -> None:
        """Examine the series that were too short so far."""
        for (bus, _), series in self._series.items():
            if series.period_ns is None and len(series.intervals) >= 8:
                self._learn(bus, series)

    def _learn(self, bus: str, series: _Series) -> None:
        """Set the period if most intervals are similar, and judge the kept intervals."""
        intervals = sorted(interval for _, interval in series.intervals)
        median = intervals[len(intervals) // 2]
        alike = sum(abs(one - median) <= JITTER_SHARE * median for one in intervals)
        kept, series.intervals = series.intervals, []
        if median <= 0 or alike < _REGULAR * len(kept):
            series.period_ns = 0 if median > 0 else None
            self.cannot(f"the SYNCs of {bus} are not cyclic")
            return
        series.period_ns = median
        told_ns = self._told_us.get(bus, 0) * 1000
        if told_ns and abs(told_ns - median) > _ON_GRID * told_ns:
            text = "the SYNC period differs from 1006h"
            numbers = (median / 1e6, told_ns / 1e6, "ms")
            self.absent(Violation(kept[0][0], text, bus, 0, 1, "", *numbers))
        for time_ns, interval_ns in kept:
            self._judge(time_ns, bus, interval_ns, median)

    def _judge(self, time_ns: int, bus: str, interval_ns: int, period_ns: int) -> None:
        share = interval_ns / period_ns
        if share > _MISSED_MAX + _ON_GRID or not self.look(time_ns, bus):
            return  # stopped and started again
        if abs(share - 1) <= JITTER_SHARE:
            return
        nearest = round(share)
        if nearest > 1 and abs(share - nearest) > _ON_GRID:
            return  # started again
        text = f"{nearest - 1} SYNC missing" if nearest > 1 else "SYNC out of its time"
        numbers = (interval_ns / 1e6, period_ns / 1e6, "ms")
        self.absent(Violation(time_ns, text, bus, 0, 1, "", *numbers))
