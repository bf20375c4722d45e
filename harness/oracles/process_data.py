"""Oracle of the times at which nodes send their TPDOs.

Source: CiA 301: PDO communication parameter 1800h: transmission type, inhibit time, event timer.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import MS, Axis, Oracle, RecordingContext, Violation, forget

_FIRST: Final = 0x1800
_TPDOS: Final = 16
_TYPE, _INHIBIT, _TIMER = 2, 3, 5
_EVENT_DRIVEN: Final = (254, 255)
_SYNCHRONOUS: Final = range(1, 241)
_START: Final = 1
_OPERATIONAL: Final = 5
_SYNC_NS: Final = 200 * MS
"""A synchronous TPDO comes within a cycle; no host's cycle is that long."""
_SLACK_NS: Final = 3 * MS
_LATE: Final = 1.5
_COUNTED: Final = 3
_Key = tuple[str, int, int]


@final
@dataclass(slots=True)
class _Series:
    """The TPDOs of one number since the last change of their conditions.

    Attributes:
        last_ns: the last one; None: none.
        since_ns: the last one, or the start of the time for which it is awaited.
        count, syncs: numbers of TPDOs after the first, and of SYNCs since that one.
    """

    last_ns: int | None = None
    since_ns: int | None = None
    count: int = 0
    syncs: int = 0


@final
class TpdoTimes(Oracle):
    """The oracle `tpdo-times`."""

    id = "tpdo-times"
    promise = (
        "TPDOs keep their inhibit time and their event timer; synchronous ones follow a SYNC, "
        "each after as many as their type says"
    )
    source = "CiA 301, PDO communication parameter 1800h, sub-indices 2, 3 and 5"
    needs = "no TPDO with a known transmission type (1800h:2) was heard"
    objects: ClassVar[Mapping[int, bool]] = {_FIRST + number: False for number in range(_TPDOS)}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._series: dict[_Key, _Series] = {}
        self._sync_ns: dict[str, int] = {}
        self._started: dict[tuple[str, int | None], bool] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a parameter; a written one changes the conditions."""
        bus, node, _ = axis.place
        key = (bus, node, index - _FIRST + 1)
        if is_written or key not in self._series:
            is_on = self._is_started(bus, node) and not self._is_off(axis, key[2])
            self._series[key] = _Series(since_ns=time_ns if is_on else None)

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget a node that has booted."""
        self._started[bus, node] = False
        self._forget(bus, node)

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Take a command, which starts or ends the TPDOs."""
        if node is None:
            forget(self._started, bus, None)
        self._started[bus, node] = command == _START
        self._forget(bus, node)
        for bus_of, node_of, number in self._series:
            axis = self.context.axis((bus_of, node_of, 1))
            is_meant = bus_of == bus and node in (None, node_of)
            if is_meant and command == _START and not self._is_off(axis, number):
                self._series[bus_of, node_of, number].since_ns = time_ns

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Take the state of a node that has left operational by itself."""
        if state != _OPERATIONAL:
            self._forget(bus, node)

    def sync(self, time_ns: int, bus: str, identifier: int) -> None:
        """Count a SYNC."""
        self._sync_ns[bus] = time_ns
        for key, series in self._series.items():
            if key[0] == bus:
                series.syncs += 1

    def tpdo(self, time_ns: int, bus: str, node: int, number: int) -> None:
        """Examine a TPDO."""
        series = self._series.get((bus, node, number))
        if series is None:
            series = self._series[bus, node, number] = _Series()
        axis = self.context.axis((bus, node, 1))
        kind = self._parameter(axis, number, _TYPE)
        last_ns, series.last_ns = series.last_ns, time_ns
        since_ns, series.since_ns = series.since_ns, time_ns
        if last_ns is None:
            series.count = series.syncs = 0
        else:
            series.count += 1
        if kind is None or not self.examine(time_ns, bus):
            return
        if kind in _EVENT_DRIVEN:
            self._driven(time_ns, axis, number, last_ns, since_ns)
        elif kind in _SYNCHRONOUS:
            self._synchronous(time_ns, axis, number, kind, series)

    def end(self, time_ns: int) -> None:
        """Examine the time since the last TPDOs."""
        for (bus, node, number), series in list(self._series.items()):
            axis = self.context.axis((bus, node, 1))
            if self._parameter(axis, number, _TYPE) in _EVENT_DRIVEN:
                self._awaited(time_ns, axis, number, series.since_ns)

    def _driven(
        self, time_ns: int, axis: Axis, number: int, last_ns: int | None, since_ns: int | None
    ) -> None:
        inhibit_ns = (self._parameter(axis, number, _INHIBIT) or 0) * MS // 10
        gap_ns = inhibit_ns if last_ns is None else time_ns - last_ns
        if 2 * gap_ns < inhibit_ns and inhibit_ns - gap_ns > _SLACK_NS:
            numbers = (gap_ns / 1e6, inhibit_ns / 1e6, "ms")
            text = f"TPDO {number} again within its inhibit time"
            self.absent(axis.violation(time_ns, text, *numbers))
        self._awaited(time_ns, axis, number, since_ns)

    def _awaited(self, time_ns: int, axis: Axis, number: int, since_ns: int | None) -> None:
        timer_ms = self._parameter(axis, number, _TIMER)
        if not timer_ms or since_ns is None or not self._is_started(*axis.place[:2]):
            return
        limit_ns = int(_LATE * timer_ms * MS) + 20 * MS
        if time_ns - since_ns > limit_ns:
            numbers = ((time_ns - since_ns) / 1e6, limit_ns / 1e6, "ms")
            self.absent(axis.violation(time_ns, f"TPDO {number} later than its timer", *numbers))

    def _synchronous(
        self, time_ns: int, axis: Axis, number: int, kind: int, series: _Series
    ) -> None:
        sync_ns = self._sync_ns.get(axis.place[0])
        found: Violation | None = None
        if sync_ns is None or time_ns - sync_ns > _SYNC_NS:
            found = axis.violation(time_ns, f"TPDO {number} of type {kind} without a SYNC")
        elif series.count >= _COUNTED and series.syncs < (kind - 0.5) * series.count:
            text = f"TPDO {number} of type {kind}: {series.count} in {series.syncs} SYNCs"
            found = axis.violation(time_ns, text)
        if found is not None:
            self.absent(found)

    def _parameter(self, axis: Axis, number: int, subindex: int) -> int | None:
        return axis.objects.get((_FIRST + number - 1, subindex))

    def _is_off(self, axis: Axis, number: int) -> bool:
        """Return True unless the TPDO is known to be sent."""
        identifier = self._parameter(axis, number, 1)
        return identifier is None or bool(identifier & 0x8000_0000)

    def _is_started(self, bus: str, node: int) -> bool:
        return self._started.get((bus, node), self._started.get((bus, None), False))

    def _forget(self, bus: str, node: int | None) -> None:
        for key in self._series:
            if key[0] == bus and node in (None, key[1]):
                self._series[key] = _Series()
