"""State of one live view: messages in, events for pages out. Reads no clock.

The caller feeds messages as they come, and asks for an event from time to time. Each event has the
position of the record after it (see `stream`), so equal positions mean equal pictures.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import field
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.report.collect import BOUND, Collector, Findings
from motorhil.harness.report.document import Json
from motorhil.harness.report.incidents import Severity
from motorhil.harness.view.identifiers import IdentifierTable
from motorhil.harness.view.increments import Increments, packed
from motorhil.harness.view.presence import latest_faults, presence_of
from motorhil.harness.view.stream import Event, Stream
from motorhil.traces.decoding.narrative import Describe
from motorhil.traces.mcap.reader import TraceMessage
from motorhil.traces.mcap.records import Attachment

PERIOD_NS: Final = 100_000_000
"""Least time between two events [ns], unless a fault is in the news."""
TABLES_NS: Final = 500_000_000
"""Least time between two updates of the tables of motors and messages [ns]."""
_SCALES_NS: Final = 1_000_000_000
_NEVER: Final = -(1 << 62)


@final
@frozen
class Subject:
    """Facts of a record that are known before its messages.

    Attributes:
        title: title of the page.
        attachments: the files in the record.
        begin_ns: log time from which the times of the page count [ns].
        bitrates, data_bitrates: bit rates of CAN buses that override the record's [bit/s].
        describe: returns the message in a frame; None: nothing does.
        facts: lines of the page's head.
    """

    title: str
    attachments: Sequence[Attachment] = ()
    begin_ns: int = 0
    in_order: bool = False
    bitrates: dict[str, int] = field(default_factory=dict)
    data_bitrates: dict[str, int] = field(default_factory=dict)
    describe: Describe | None = None
    facts: tuple[tuple[str, str], ...] = ()


@final
class Session:
    """One live view.

    Attributes:
        stream: the events so far.
        is_over: True if the record is complete.
    """

    def __init__(self, subject: Subject) -> None:
        """Begin with an empty picture."""
        self.stream: Stream = Stream()
        self.is_over: bool = False
        self._subject = subject
        self._collector = Collector(
            subject.attachments, subject.begin_ns, subject.in_order, subject.describe
        )
        self._found.rig.bitrates.update(subject.bitrates)
        self._found.rig.data_bitrates.update(subject.data_bitrates)
        self._increments = Increments()
        self._identifiers = IdentifierTable()
        self._faults: dict[str, str] = {}
        self._crc = 0
        self._bounded = 0
        self._incidents = 0
        self._event_ns = self._tables_ns = self._scales_ns = _NEVER

    @property
    def _found(self) -> Findings:
        return self._collector.found

    @property
    def position(self) -> str:
        """The number of messages so far and the CRC of their contents."""
        return f"{self._collector.count}-{self._crc:08x}"

    def feed(self, messages: Iterable[TraceMessage]) -> int:
        """Take these messages; return their number."""
        return self._collector.feed(self._counting(messages))

    def is_due(self, now_ns: int) -> bool:
        """Return True if an event is due at this time of any steady clock [ns]."""
        if self.position == self.stream.position:
            return False
        if now_ns - self._event_ns >= PERIOD_NS:
            return True
        fresh = self._found.incidents.since(self._incidents)
        return any(one.severity is Severity.ERROR for one in fresh)

    def advance(self, now_ns: int) -> None:
        """Append an event with the news to the stream, if there are any."""
        if self.position == self.stream.position:
            return
        self._collector.settle()
        if now_ns - self._scales_ns >= _SCALES_NS:
            self._scales_ns = now_ns
            self._increments.rescale(self._found)
        self._count()
        told = self._increments.more(self._found) if self.stream.position else None
        if told is None:
            document, packer = self._increments.whole(self._found)
            kind = "whole"
            document |= self._head()
        else:
            document, packer = told
            kind = "more"
        if kind == "whole" or now_ns - self._tables_ns >= TABLES_NS or self._is_alarming():
            self._tables_ns = now_ns
            document |= self._tables(every=kind == "whole")
        self._incidents = self._found.incidents.counts.total()
        self._event_ns = now_ns
        document["messages"] = self._collector.count
        self.stream.append(Event(self.position, kind, packed(document, packer)))
        if self._collector.count - self._bounded >= BOUND:
            self._bounded = self._collector.count
            self._collector.bound()

    def whole(self, now_ns: int) -> Event:
        """Return the whole picture for a new page; the events after it continue it."""
        self.advance(now_ns)
        document, packer = self._increments.again(self._found)
        document |= self._head() | self._tables(every=True)
        document["messages"] = self._collector.count
        return Event(self.position, "whole", packed(document, packer))

    def stretch(self, from_s: float, to_s: float) -> str:
        """Return all points between two times of the page [s], as the text of an event."""
        self._collector.settle()
        longest_s = (self._found.end_ns - self._found.begin_ns) / 1e9
        times = (round(min(max(one, 0.0), longest_s) * 1e9) for one in (from_s, to_s))
        return packed(*self._increments.stretch(self._found, *times))

    def finish(self, now_ns: int) -> None:
        """End the picture: the record is complete."""
        if not self.is_over:
            self._collector.end()
            self.advance(now_ns)
            self.is_over = True

    # ---------------------------------------------------------------------------------- inside

    def _counting(self, messages: Iterable[TraceMessage]) -> Iterator[TraceMessage]:
        for message in messages:
            self._crc = zlib.crc32(message[2], self._crc)
            yield message

    def _head(self) -> Json:
        facts = [[name, value] for name, value in self._subject.facts]
        if self._found.rig.name:
            facts.insert(0, ["rig", self._found.rig.name])
        return {"title": self._subject.title, "facts": facts, "notes": []}

    def _is_alarming(self) -> bool:
        fresh = self._found.incidents.since(self._incidents)
        return any(one.severity is not Severity.INFO for one in fresh)

    def _count(self) -> None:
        """Count the new messages of each bus for the table."""
        for traffic in self._found.traffics():
            fresh = self._increments.fresh(traffic)
            bus = self._found.buses.get(traffic.name)
            self._identifiers.count(traffic, fresh, None if bus is None else bus.contents)

    def _tables(self, every: bool) -> Json:
        """Return the rows of motors and nodes, and those of messages that have changed."""
        found = self._found
        now_ns = found.end_ns - found.begin_ns
        rows = presence_of(found, self._increments.motors, self._increments.owners, now_ns)
        fresh = found.incidents.kept() if every else found.incidents.since(self._incidents)
        self._faults |= latest_faults(found, fresh, rows)
        for row in rows:
            row["fault"] = self._faults.get(str(row["name"]), "")
        return {"presence": rows, "identifiers": self._identifiers.take(found.traffics(), every)}
