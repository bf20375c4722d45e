"""Oracles of CANopen and CAN rules that hold for any node.

Heartbeats, answers, boot-ups and identifiers; the SYNC period, within bounds and without missing
SYNCs; the states that CAN controllers report (fault confinement).

Source: CiA 301: NMT error control, SYNC protocol, communication cycle period 1006h; ISO 11898-1,
fault confinement.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import MS, Axis, Oracle, RecordingContext, Violation, forget
from motorhil.traces.decoding.can_errors import BusError, ControllerState
from motorhil.traces.decoding.canopen import place_text
from motorhil.traces.decoding.events import DecodedEvent, Kind

_Node = tuple[str, int]
_S: Final = 1_000_000_000
ANSWER_NS: Final = 1 * _S
"""The time allowed for an answer; hosts give up after 0.3 to 1 s (CiA 301 names no time)."""
_RESET_NS: Final = 10 * _S
_CERTAIN: Final = 10
_SAMPLES: Final = 8
_LATE: Final = 1.5
_RESETS: Final = (0x81, 0x82)
_STOP: Final = 0x02
_UNTIL_END: Final = "until the recording ends"
_ASKED_MAX: Final = 16
_TIMED_OUT: Final = 0x0504_0000
_INVALID: Final = 0x8000_0000
_NODE_FUNCTIONS: Final = (1, 3, 5, 7, 9, 11, 14)  # functions: EMCY, TPDOs, SDO answers, heartbeat
_HEARTBEAT: Final = 14

_SYNC_SAMPLES: Final = 64
_REGULAR: Final = 0.8
JITTER_SHARE: Final = 0.25
"""The allowed share of the period; nodes' synchronous window (1007h) is rarely wider."""
_MISSED_MAX: Final = 3
_ON_GRID: Final = 0.1

_WARNING: Final = 96
_PASSIVE: Final = 128
_COUNTER_MAX: Final = 255  # a message has 8 bits for a counter
_ORDER: Final = (
    *(ControllerState.ACTIVE, ControllerState.WARNING),
    *(ControllerState.PASSIVE, ControllerState.BUS_OFF),
)
_RANGES: Final = {  # of the greater counter
    ControllerState.ACTIVE: (0, _WARNING - 1),
    ControllerState.WARNING: (_WARNING, _PASSIVE - 1),
    ControllerState.PASSIVE: (_PASSIVE, _COUNTER_MAX),
    ControllerState.BUS_OFF: (_COUNTER_MAX, _COUNTER_MAX),
    ControllerState.RESTARTED: (0, 0),
}
_DRIVERS: Final = "hardware drivers report counters in different ways"


@final
@dataclass(slots=True)
class _Beat:
    """Heartbeat of one node; period_ns 0: not known yet."""

    last_ns: int
    period_ns: int = 0
    least: list[int] = field(default_factory=list)


@final
class Heartbeats(Oracle):
    """The oracle `heartbeat-kept`."""

    id = "heartbeat-kept"
    promise = "A node that has begun to send heartbeats continues with its period until it is reset"
    source = "CiA 301, heartbeat protocol, 1017h producer heartbeat time"
    needs = "no node sent enough heartbeats to determine its period, and no 1017h was heard"
    objects: ClassVar[Mapping[int, bool]] = {0x1017: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._beats: dict[_Node, _Beat] = {}
        self._declared_ms: dict[_Node, int] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a written period; 0 ends the heartbeats."""
        node = axis.place[:2]
        if self._declared_ms.get(node) != value:
            self._declared_ms[node] = value
            self._beats.pop(node, None)

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the node's heartbeat after its boot-up."""
        self._beats.pop((bus, node), None)
        self._declared_ms.pop((bus, node), None)

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Forget the heartbeats of reset nodes, which may be silent for a while."""
        if command in _RESETS:
            forget(self._beats, bus, node)

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Examine the distance to the previous heartbeat."""
        beat = self._beats.get((bus, node))
        if beat is None:
            self._beats[bus, node] = _Beat(time_ns)
            return
        gap_ns, beat.last_ns = time_ns - beat.last_ns, time_ns
        if not beat.period_ns:
            self._learn(bus, node, beat, gap_ns)
        if beat.period_ns and gap_ns > 0 and self.examine(time_ns, bus):
            self._judge(time_ns, bus, node, beat, gap_ns, "since the previous heartbeat")

    def _learn(self, bus: str, node: int, beat: _Beat, gap_ns: int) -> None:
        """Set the period from 1017h, otherwise from the median of the first distances."""
        declared_ms = self._declared_ms.get((bus, node))
        if declared_ms:
            beat.period_ns = declared_ms * MS
            return
        beat.least.append(gap_ns)
        if len(beat.least) >= _SAMPLES:
            beat.period_ns = sorted(beat.least)[_SAMPLES // 2]
            beat.least.clear()

    def _judge(
        self, time_ns: int, bus: str, node: int, beat: _Beat, gap_ns: int, since: str
    ) -> None:
        limit_ns = int(_LATE * beat.period_ns) + 20 * MS
        if gap_ns <= limit_ns:
            return
        is_end = since == _UNTIL_END
        if self.context.is_program(bus, node) and (is_end or gap_ns > _CERTAIN * beat.period_ns):
            self.cannot(
                f"{bus} node {node} sent heartbeats alone, as a program does, and may have ended"
            )
            return
        text = f"no heartbeat {since}, {gap_ns / 1e9:.3f} s"
        numbers = (gap_ns / 1e6, limit_ns / 1e6, "ms")
        found = self.context.violation_of(time_ns, text, (bus, node), *numbers)
        # So many lost frames while other nodes were heard are not plausible as gaps of the
        # recording.
        certain = gap_ns > _CERTAIN * beat.period_ns and self._others_continued(bus, time_ns, beat)
        (self.broken if certain else self.absent)(found)

    def _others_continued(self, bus: str, time_ns: int, beat: _Beat) -> bool:
        """Return True if other nodes were heard throughout."""
        return any(
            place[0] == bus and other is not beat and other.last_ns >= time_ns - 2 * beat.period_ns
            for place, other in self._beats.items()
        )

    def end(self, time_ns: int) -> None:
        """Examine the nodes that have stopped sending."""
        for (bus, node), beat in self._beats.items():
            if beat.period_ns and self.context.judges(time_ns):
                gap_ns = time_ns - beat.last_ns
                self._judge(time_ns, bus, node, beat, gap_ns, _UNTIL_END)


@final
class Answers(Oracle):
    """The oracle `sdo-answered`."""

    id = "sdo-answered"
    promise = "A present node answers each SDO request, with data, a confirmation or an abort"
    source = "CiA 301, SDO protocols: each service is confirmed"
    needs = "no SDO request to a node that had been heard before"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._open: dict[_Node, dict[bytes, int]] = {}  # objects with their request times

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Take a request, an answer, or an abort; only the start of a transfer names its object."""
        assert event.node is not None
        node = (bus, event.node)
        if node in self._open:
            self._expire(time_ns, node)
        if len(data) != 8 or event.index is None:
            return
        place, is_abort = data[1:4], data[0] == 0x80
        if event.kind is Kind.SDO_RESPONSE:
            if self._open.get(node, {}).pop(place, None) is not None:
                self.examine(time_ns, bus)
        elif is_abort:
            begun_ns = self._open.get(node, {}).pop(place, None)
            timed_out = int.from_bytes(data[4:8], "little") == _TIMED_OUT
            if begun_ns is not None and timed_out and self.examine(time_ns, bus):
                self.broken(self._violation(time_ns, node, place, begun_ns, "the client gave up"))
        elif data[0] >> 5 in (1, 2):
            if node not in self.context.seen_nodes:
                self.cannot(f"{bus} node {event.node} received a request, but was never heard")
                return
            asked = self._open.setdefault(node, {})
            if len(asked) < _ASKED_MAX:
                asked.setdefault(place, time_ns)

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the open requests to the node."""
        self._open.pop((bus, node), None)

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Forget open requests, since a reset or stopped node does not answer."""
        forget(self._open, bus, node)

    def end(self, time_ns: int) -> None:
        """Examine the last requests."""
        for node in list(self._open):
            self._expire(time_ns, node)

    def _expire(self, time_ns: int, node: _Node) -> None:
        asked = self._open[node]
        for place, begun_ns in list(asked.items()):
            if time_ns - begun_ns > ANSWER_NS:
                del asked[place]
                if self.examine(begun_ns, node[0]):
                    what = f"no answer within {ANSWER_NS / 1e9:g} s"
                    self.absent(self._violation(begun_ns, node, place, begun_ns, what))

    def _violation(
        self, time_ns: int, node: _Node, place: bytes, begun_ns: int, what: str
    ) -> Violation:
        at = place_text(int.from_bytes(place[:2], "little"), place[2])
        text = f"SDO of {at}, asked at {begun_ns / 1e9:.6f} s: {what}"
        return self.context.violation_of(time_ns, text, node)


@final
class BootUps(Oracle):
    """The oracle `no-reboot`."""

    id = "no-reboot"
    promise = "A node that was present boots again only after an NMT reset"
    source = "CiA 301, boot-up protocol, NMT services reset node and reset communication"
    needs = "no CANopen node was heard"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._reset_ns: dict[tuple[str, int | None], int] = {}

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Take the time of a reset."""
        if command in _RESETS:
            self._reset_ns[bus, node] = time_ns

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Examine a boot-up; a node that is not in `heard` boots for the first time."""
        if not self.examine(time_ns, bus) or (bus, node) not in self.context.seen_nodes:
            return
        reset_ns = max(self._reset_ns.get((bus, one), -_RESET_NS - 1) for one in (node, None))
        if time_ns - reset_ns > _RESET_NS:
            text = "booted again without an NMT reset"
            self.absent(self.context.violation_of(time_ns, text, (bus, node)))

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Count a node that is present and did not boot."""
        self.examine(time_ns, bus)


@final
class OneSender(Oracle):
    """The oracle `one-sender`."""

    id = "one-sender"
    promise = "A message of one node (TPDO, EMCY, SDO answer, heartbeat) has only one sender"
    source = "CiA 301, pre-defined connection set; ISO 11898-1: an identifier has one sender"
    needs = "the recording does not name the senders of its frames"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._before: dict[tuple[str, int], dict[str, None]] = {}

    def sender(self, time_ns: int, bus: str, identifier: int, before: str, now: str) -> None:
        """Examine a change of sender; the return of an earlier sender proves two senders."""
        if identifier >> 7 not in _NODE_FUNCTIONS or not identifier & 0x7F:
            return
        node = identifier & 0x7F
        if identifier >> 7 == _HEARTBEAT and self.context.is_program(bus, node):
            return  # programs of one host share its node-ID
        if not self.examine(time_ns, bus) or not before:
            return
        known = self._before.setdefault((bus, identifier), {})
        known[before] = None
        if now in known:
            text = f"{identifier:03X}h is sent by {before} and by {now}"
            self.broken(self.context.violation_of(time_ns, text, (bus, node)))


@final
class FaultsReported(Oracle):
    """The oracle `fault-told`."""

    id = "fault-told"
    promise = "A drive that sends EMCYs sends one with its error code when it enters a fault"
    source = "CiA 301, EMCY; CiA 402-2, fault reaction active and fault"
    needs = "no drive that sends EMCYs (optional in CiA 301) entered a fault"
    objects: ClassVar[Mapping[int, bool]] = {0x6041: False, 0x1014: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._last_ns: dict[_Node, int] = {}
        self._ever: dict[_Node, None] = {}
        self._was_fault: dict[tuple[str, int, int], bool] = {}
        self._waiting: list[Violation] = []

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Take the state of nodes: a stopped one sends no EMCY, and says nothing of that."""
        if command == _STOP:
            forget(self._ever, bus, node)

    def emergency(self, time_ns: int, bus: str, node: int, code: int, register: int) -> None:
        """Settle all waiting faults of the node with an EMCY that has an error code."""
        self._ever[bus, node] = None
        if code:
            self._last_ns[bus, node] = time_ns
            self._settle(time_ns, (bus, node))

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a statusword, or take 1014h: EMCYs enabled with their default identifier."""
        bus, node, _ = axis.place
        if index == 0x1014:
            if value & _INVALID or value & 0x7FF != 0x80 + node:
                self._ever.pop((bus, node), None)
            else:
                self._ever[bus, node] = None
            return
        if is_written:
            return
        self._settle(time_ns, None)
        is_fault = value & 0x4F in (0x0F, 0x08)
        was = self._was_fault.get(axis.place)
        self._was_fault[axis.place] = is_fault
        if was is False and is_fault:
            if time_ns - self._last_ns.get((bus, node), -_S - 1) <= _S:
                self.examine(time_ns, bus)
            else:
                text = f"a fault (statusword {value:04X}h) without an EMCY within 1 s"
                self._waiting.append(axis.violation(time_ns, text))

    def end(self, time_ns: int) -> None:
        """Settle the faults that still wait."""
        self._settle(time_ns, None)

    def _settle(self, time_ns: int, settled: _Node | None) -> None:
        """Settle the faults of node `settled`, and those that have waited long enough."""
        for one in list(self._waiting):
            node = (one.bus, one.node)
            late = time_ns - one.time_ns > _S
            if late or node == settled:
                self._waiting.remove(one)
                if node in self._ever and self.examine(one.time_ns, one.bus) and late:
                    self.absent(one)


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

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._series: dict[tuple[str, int], _Series] = {}
        self._declared_us: dict[str, int] = {}

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a communication cycle period [us]."""
        if value:
            self._declared_us[axis.place[0]] = value

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
            if len(series.intervals) >= _SYNC_SAMPLES:
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
        declared_ns = self._declared_us.get(bus, 0) * 1000
        if declared_ns and abs(declared_ns - median) > _ON_GRID * declared_ns:
            text = "the SYNC period differs from 1006h"
            numbers = (median / 1e6, declared_ns / 1e6, "ms")
            self.absent(Violation(kept[0][0], text, bus, 0, 1, "", *numbers))
        for time_ns, interval_ns in kept:
            self._judge(time_ns, bus, interval_ns, median)

    def _judge(self, time_ns: int, bus: str, interval_ns: int, period_ns: int) -> None:
        share = interval_ns / period_ns
        if share > _MISSED_MAX + _ON_GRID or not self.examine(time_ns, bus):
            return  # stopped and started again
        if abs(share - 1) <= JITTER_SHARE:
            return
        nearest = round(share)
        if nearest > 1 and abs(share - nearest) > _ON_GRID:
            return  # started again
        text = f"{nearest - 1} SYNC missing" if nearest > 1 else "SYNC out of its time"
        numbers = (interval_ns / 1e6, period_ns / 1e6, "ms")
        self.absent(Violation(time_ns, text, bus, 0, 1, "", *numbers))


@final
class Confinement(Oracle):
    """The oracle `error-states`."""

    id = "error-states"
    promise = (
        "The states of a CAN controller follow one another as its counters allow: active, "
        "warning (96), passive (128), bus-off, restarted; in bus-off it sends nothing"
    )
    source = "ISO 11898-1, fault confinement; linux/can/error.h"
    needs = "the recording has no error message (SocketCAN error frame) with a controller state"
    needs_canopen = False

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._states: dict[tuple[str, str], ControllerState] = {}

    def error(self, time_ns: int, bus: str, sender: str, error: BusError) -> None:
        """Compare the state with its counters and with the previous state.

        Counters without a state may be ahead of the next message, which has the state.
        """
        if error.state is None:
            return
        self.examine(time_ns, bus)
        key = (bus, sender)
        before = self._states.get(key)
        if error.counters is not None:
            self._counters(time_ns, key, error.text, error.state, error.counters)
        if before is not None and not _may_follow(before, error.state):
            text = f"{error.state.value}{error.counted}, but was {before.value}"
            self.absent(self._violation(time_ns, key, text))
        is_new = error.state is ControllerState.RESTARTED
        self._states[key] = ControllerState.ACTIVE if is_new else error.state

    def sent_while_off(self, time_ns: int, bus: str, sender: str, identifier: int) -> None:
        """Report a frame sent in bus-off."""
        text = f"sends {identifier & 0x1FFF_FFFF:X}h while it is bus-off"
        self.broken(self._violation(time_ns, (bus, sender), text))

    def _counters(
        self,
        time_ns: int,
        key: tuple[str, str],
        text: str,
        state: ControllerState,
        counters: tuple[int, int],
    ) -> None:
        low, high = _RANGES[state]
        if low <= max(counters) <= high:
            return
        tec, rec = counters
        text = f"{text} (TEC {tec}, REC {rec}): the greater counter should be {low} to {high}"
        violation = self._violation(time_ns, key, text)
        if key[1]:
            self.broken(violation)
        else:
            self.doubt(violation, _DRIVERS)

    def _violation(self, time_ns: int, key: tuple[str, str], text: str) -> Violation:
        bus, sender = key
        names = self.context.names.nodes
        node = next((n for (b, n), name in names.items() if (b, name) == key), 0)
        whose = f"the CAN controller of {sender}" if sender else "the CAN controller"
        return Violation(time_ns, f"{whose}: {text}", bus, node)


def _may_follow(before: ControllerState, state: ControllerState) -> bool:
    """Return True if no state is skipped; counters rise by 8 at most, and fall by 1 or to 127."""
    if state is ControllerState.RESTARTED:
        return before is ControllerState.BUS_OFF
    if before is ControllerState.BUS_OFF:
        return state is ControllerState.ACTIVE
    return abs(_ORDER.index(state) - _ORDER.index(before)) <= 1
