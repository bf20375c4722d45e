"""Layouts for Foxglove and Lichtblick, made for one recording.

Plots refer to fields by message paths, `/topic.field`. A topic with characters other than letters,
digits, "_", "-" and "/" is quoted. Source: Foxglove's documentation of layouts, message path
syntax, and the panels Plot, StateTransitions, RosOut and Tab.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Final

from motorhil.traces.decoding.attached_rig import facts_of
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    JOINT_STATE,
    LOG,
    MOTOR_LOCK,
    truth_message_of,
)

Json = dict[str, object]
_PLAIN_TOPIC: Final = re.compile(r"[A-Za-z0-9_/-]+")
_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442")
_MOTORS_MAX: Final = 7
"""Lines that can be distinguished by colour in one plot; more motors get another tab."""


def layout_of(trace: Trace) -> Json:
    """Return the layout of a recording, ready for JSON.

    All messages are read once, since channels may start late in a file.

    Raises:
        TraceError: the recording is damaged.
    """
    schemas: dict[str, str] = {}
    fields: dict[str, list[str]] = {}
    for channel, _, _ in trace.messages():
        if channel.topic in schemas or channel.schema is None:
            continue
        schemas[channel.topic] = channel.schema.name
        message = truth_message_of(channel.schema)
        if message is not None:
            fields[channel.topic] = [field.name for field in message.fields]
    order = {name: place for place, name in enumerate(facts_of(trace.attachments).motors)}
    topics = sorted(schemas, key=lambda topic: (order.get(_name(topic), len(order)), topic))
    panels = _Panels()
    tabs: list[tuple[str, object]] = []
    states = [topic for topic in topics if schemas[topic] == JOINT_STATE.name]
    for title, group in _groups(states):
        panel = panels.plot(f"{title}, position", [(t, "position") for t in group])
        tabs.append((f"{title} position", panel))
    for title, group in _groups([topic for topic in topics if topic in fields]):
        parts = [
            panels.plot(f"{title}, {key}", [(t, key) for t in group if key in fields[t]])
            for key in ("velocity_rad_s", "following_error_inc", "torque_n_m")
            if any(key in fields[t] for t in group)
        ]
        if parts:
            tabs.append((f"{title} truth", _stack(parts)))
    groups = [topic for topic in topics if schemas[topic] == GROUP_SYNC.name]
    if groups:
        paths = [(t, key) for t in groups for key in ("skew_s", "predicted_skew_s")]
        tabs.append(("group skew", panels.plot("group skew", paths)))
    drives = [(topic, "state") for topic in topics if "state" in fields.get(topic, ())]
    locks = [(topic, "action") for topic in topics if schemas[topic] == MOTOR_LOCK.name]
    below: list[object] = []
    if drives:
        below.append(panels.states("PDS FSA (0 to 7)", drives))
    if locks:
        below.append(panels.states("locks", locks))
    if any(schemas[topic] == LOG.name for topic in topics):
        log = next(topic for topic in topics if schemas[topic] == LOG.name)
        below.append(panels.log(log))
    below += [panels.raw(topic) for topic in topics if schemas[topic] == CAN_FRAME.name]
    if tabs:
        below.insert(0, panels.tab(tabs))
    if not below:
        below.append(panels.raw(topics[0] if topics else ""))
    return {
        "configById": panels.configurations,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _stack(below),
    }


class _Panels:
    """Panel configurations by number, so that a recording always gives the same layout."""

    def __init__(self) -> None:
        self.configurations: dict[str, Json] = {}

    def plot(self, title: str, paths: list[tuple[str, str]]) -> str:
        lines: list[Json] = []
        for number, (topic, key) in enumerate(paths):
            lines.append(
                {
                    "value": path_of(topic, key),
                    "label": f"{_name(topic)} {key}",
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                    "color": _COLOURS[number % len(_COLOURS)],
                }
            )
        return self._add(
            "Plot",
            {
                "title": title,
                "foxglovePanelTitle": title,
                "paths": lines,
                "isSynced": True,
                "showLegend": True,
                "legendDisplay": "left",
                "showXAxisLabels": True,
                "showYAxisLabels": True,
                "xAxisVal": "timestamp",
            },
        )

    def states(self, title: str, paths: list[tuple[str, str]]) -> str:
        lines = [
            {
                "value": path_of(topic, key),
                "label": _name(topic),
                "timestampMethod": "receiveTime",
            }
            for topic, key in paths
        ]
        config: Json = {"foxglovePanelTitle": title, "paths": lines, "isSynced": True}
        return self._add("StateTransitions", config)

    def log(self, topic: str) -> str:
        config: Json = {"searchTerms": [], "minLogLevel": 1, "topicToRender": topic}
        return self._add("RosOut", config)

    def raw(self, topic: str) -> str:
        config: Json = {
            "topicPath": path_of(topic) if topic else "",
            "diffEnabled": False,
            "diffMethod": "custom",
            "diffTopicPath": "",
            "showFullMessageForDiff": False,
        }
        return self._add("RawMessages", config)

    def tab(self, tabs: list[tuple[str, object]]) -> str:
        told = [{"title": title, "layout": layout} for title, layout in tabs]
        return self._add("Tab", {"activeTabIdx": 0, "tabs": told})

    def _add(self, kind: str, config: Json) -> str:
        name = f"{kind}!motorhil{len(self.configurations) + 1}"
        self.configurations[name] = config
        return name


def path_of(topic: str, field: str = "") -> str:
    """Return a message path: the topic, quoted if necessary, and a field of its messages."""
    if not _PLAIN_TOPIC.fullmatch(topic):
        escaped = topic.replace("\\", "\\\\").replace('"', '\\"')
        topic = f'"{escaped}"'
    return f"{topic}.{field}" if field else topic


def _groups(topics: list[str]) -> Iterable[tuple[str, list[str]]]:
    """Yield motors grouped by the start of their names, at most a plot's capacity each."""
    found: dict[str, list[str]] = {}
    for topic in topics:
        found.setdefault(re.split(r"[_0-9-]", _name(topic))[0] or "motors", []).append(topic)
    alone = [stem for stem, own in found.items() if len(own) == 1]
    if len(alone) > 1:  # such as "pan" and "tilt"
        together = [found.pop(stem)[0] for stem in alone]
        found[", ".join(alone[:3]) + (" and others" if len(alone) > 3 else "")] = together
    for stem, own in found.items():
        for start in range(0, len(own), _MOTORS_MAX):
            more = f" {start // _MOTORS_MAX + 1}" if len(own) > _MOTORS_MAX else ""
            yield stem + more, own[start : start + _MOTORS_MAX]


def _name(topic: str) -> str:
    parts = topic.strip("/").split("/")
    return "/".join(parts[1:-1]) if len(parts) > 2 else parts[-1]


def _stack(parts: Sequence[object]) -> object:
    """Return the panels stacked with equal heights."""
    if len(parts) == 1:
        return parts[0]
    return {
        "direction": "column",
        "first": parts[0],
        "second": _stack(parts[1:]),
        "splitPercentage": round(100 / len(parts), 1),
    }
