"""A page of the live view in Python: whole pictures and news, as `growth.js` takes them."""

import base64
import json
import struct
import zlib


def opened(event):
    """Return the document of an event, and a reader of its arrays."""
    data = zlib.decompress(base64.b64decode(event.data))
    size = int.from_bytes(data[:4], "little")
    return json.loads(data[4 : 4 + size]), Arrays(data[4 + size :])


class Arrays:
    """The packed arrays, decoded with plain Python integers."""

    def __init__(self, data):
        self.bytes = data

    def whole(self, told):
        size, count, at = int(told["type"][1:]) // 8, told["count"], told["offset"]
        planes = [self.bytes[at + n * count : at + (n + 1) * count] for n in range(size)]
        return [int.from_bytes(bytes(parts), "little") for parts in zip(*planes, strict=True)]

    def seconds(self, told, tick_s):
        found, total = [], 0
        for step in self.whole(told):
            total = total + step if told.get("delta") else step
            found.append(total * tick_s)
        return found

    def numbers(self, told):
        raw = self.whole(told)
        return [told["base"] + struct.unpack("<f", struct.pack("<I", one))[0] for one in raw]


class Page:
    """All that a page has after its events.

    Attributes:
        lines: points [s, value] by motor, quantity and name.
        loads: sum of weights and number of messages, by bus and label.
        bars: [from, to, word, text, waits] by title and row.
        incidents: [s, severity, kind, place, text].
        kinds: the kinds of the events, in order.
    """

    def __init__(self):
        self.kinds = []
        self.messages = 0

    def take(self, event):
        told, arrays = opened(event)
        self.kinds.append(event.kind)
        self.position = event.position
        tick_s = told["time"]["tick_s"]
        if event.kind == "whole":
            self._whole(told, arrays, tick_s)
        else:
            self._more(told, arrays, tick_s)
        self.span = told["time"]["span"] * tick_s
        self.messages = told["messages"]
        self.presence = {row["name"]: row for row in told.get("presence", ())} or self.presence
        return self

    def places(self):
        """Return the numbers of motor, plot and line, in the order of `lines`."""
        return list(self._places)

    def _whole(self, told, arrays, tick_s):
        self.presence = {}
        self._places, self.lines, self.loads, self.bars = {}, {}, {}, {}
        for m, motor in enumerate(told["motors"]):
            for p, plot in enumerate(motor["plots"]):
                for n, line in enumerate(plot["lines"]):
                    name = motor["name"], plot["quantity"], line["name"]
                    self._places[m, p, n] = name
                    self.lines[name] = points(line, arrays, tick_s)
        self._buses = [(one["name"], one["labels"]) for one in told["traffic"]]
        for number, one in enumerate(told["traffic"]):
            self._load({**one, "at": number}, arrays)
        for timeline in told["timelines"]:
            for row in timeline["rows"]:
                self.bars[timeline["title"], row["name"]] = bars(row, timeline, arrays, tick_s)
        self._kinds = told["incidents"]["kinds"]
        self.incidents = self._listed(told["incidents"], tick_s)

    def _more(self, told, arrays, tick_s):
        until = self.span
        span = told["time"]["span"] * tick_s
        for one in told["lines"]:
            fresh, name = points(one, arrays, tick_s), self._places[tuple(one["at"])]
            early = fresh[0][0] - 2 * tick_s
            self.lines[name] = [point for point in self.lines[name] if point[0] < early] + fresh
        for one in told["traffic"]:
            self._load(one, arrays)
        for row in self.bars.values():
            for bar in row[-8:]:
                bar[1] = span if bar[1] >= until - 2 * tick_s else bar[1]
        for timeline in told["timelines"]:
            for row in timeline["rows"]:
                fresh = bars(row, timeline, arrays, tick_s)
                key = timeline["title"], row["name"]
                self.bars[key] = replaced(self.bars[key], fresh, until - 2 * tick_s)
        if "incidents" in told:
            self.incidents += self._listed(told["incidents"], tick_s)

    def _load(self, told, arrays):
        bus, labels = self._buses[told["at"]]
        columns = (arrays.whole(told[key]) for key in ("key", "weight", "count"))
        for key, weight, count in zip(*columns, strict=True):
            sums = self.loads.setdefault((bus, labels[key]), [0, 0])
            sums[0] += weight
            sums[1] += count

    def _listed(self, told, tick_s):
        return [
            [ticks * tick_s, severity, told["kinds"][kind], *rest]
            for ticks, severity, kind, *rest in told["list"]
        ]


def points(line, arrays, tick_s):
    times, values = arrays.seconds(line["t"], tick_s), arrays.numbers(line["v"])
    return [list(point) for point in zip(times, values, strict=True)]


def bars(row, timeline, arrays, tick_s):
    columns = (
        arrays.seconds(row["from"], tick_s),
        arrays.seconds(row["to"], tick_s),
        [timeline["words"][word] for word in arrays.whole(row["word"])],
        [row["texts"][text] for text in arrays.whole(row["text"])],
        arrays.whole(row["waits"]),
    )
    return [list(bar) for bar in zip(*columns, strict=True)]


def replaced(known, fresh, early):
    """Return a row with new bars in place of those that were open at `early`."""
    kept = []
    for bar in known:
        following = next((one for one in fresh if one[4] == bar[4]), None)
        if bar[1] < early:
            kept.append(bar)
        elif following is not None and bar[0] < following[0] - 1e-6:
            if following[2] == bar[2]:
                following[0] = bar[0]
            else:
                kept.append([bar[0], following[0], *bar[2:]])
    return sorted(kept + fresh, key=lambda one: (one[0], one[4]))
