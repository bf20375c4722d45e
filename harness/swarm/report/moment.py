"""The moment of a failure in its recording: curves of the motors, and the messages around it."""

import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.recording.conversion import open_recording
from motorhil.harness.report.collect import collect
from motorhil.harness.report.motors import Line, Motor, motors_of
from motorhil.harness.report.series import extremes
from motorhil.harness.rig.config.toml import one_line
from motorhil.traces.decoding.events import Kind
from motorhil.traces.decoding.narrative import Story
from motorhil.traces.errors import TraceError

_NS: Final = 1e9
_BEFORE_S: Final = 1.0
_AFTER_S: Final = 0.25
_MESSAGES: Final = 8
_MESSAGES_AFTER: Final = 2
_MOTORS: Final = 2
_POINTS: Final = 300
_LEFT_OUT: Final = (Kind.SYNC, Kind.TIME, Kind.HEARTBEAT, Kind.TPDO)
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")
_ROLES: Final = {"demand": "demand", "target": "target", "actual": "told", "truth": "truth"}
Curves = dict[str, tuple[tuple[float, float], ...]]


@final
@frozen
class Moment:
    """The moment of a failure.

    Attributes:
        motors: by motor and unit, its position: "demand", "target", "told", "truth".
        messages: the last messages before it and the first ones after it, as sentences.
    """

    motors: tuple[tuple[str, Curves], ...]
    messages: tuple[str, ...]


def moment_of(record: Path, at_ns: int, about: str) -> Moment:
    """Return the moment of a failure; empty without a readable recording.

    Args:
        record: the recording.
        at_ns: when it failed [ns].
        about: the failure in a sentence; motors that it names come first.
    """
    try:
        return _read(record, record.stat().st_mtime_ns, at_ns, about)
    except (OSError, TraceError):
        return Moment((), ())


@lru_cache(maxsize=256)
def _read(record: Path, changed_ns: int, at_ns: int, about: str) -> Moment:
    with open_recording(record) as trace:
        found = collect(trace)
        motors = [one for one in motors_of(found) if any(plot.lines for plot in one.plots)]
    motors.sort(key=lambda one: one.name not in about)
    named = [one for one in motors if one.name in about]
    begin_ns = found.begin_ns
    shown = []
    for motor in (named or motors)[:_MOTORS]:
        unit, curves = _curves(motor, begin_ns, at_ns)
        if curves:
            shown.append((f"position of {motor.name} [{unit}]", curves))
    with open_recording(record) as trace:
        messages = tuple(_messages(Story(trace), at_ns))
    return Moment(tuple(shown), messages)


def _curves(motor: Motor, begin_ns: int, at_ns: int) -> tuple[str, Curves]:
    """Return the unit and the curves of a motor's position around a moment."""
    for plot in motor.plots:
        if plot.quantity == "position" and plot.lines:
            curves: Curves = {}
            for line in plot.lines:
                points = _around(line, begin_ns, at_ns)
                if points:
                    curves.setdefault(_ROLES[line.role], points)
            return plot.unit, curves
    return "", {}


def _around(line: Line, begin_ns: int, at_ns: int) -> tuple[tuple[float, float], ...]:
    low = at_ns - begin_ns - _BEFORE_S * _NS
    high = at_ns - begin_ns + _AFTER_S * _NS
    inside = (line.times_ns >= low) & (line.times_ns <= high)
    times, values = extremes(line.times_ns[inside], line.values[inside], _POINTS)
    return tuple(
        ((int(time_ns) + begin_ns) / _NS, float(value))
        for time_ns, value in zip(times, values, strict=True)
        if value == value  # NaN: there was none
    )


def _messages(story: Story, at_ns: int) -> Iterator[str]:
    """Yield the messages around a moment; of similar ones in a row the last."""
    before: list[str] = []
    after: list[str] = []
    last = ""
    for line in story.lines(max(0, at_ns - round(_BEFORE_S * _NS)), at_ns + round(_AFTER_S * _NS)):
        if line.said is not None and line.said.kind in _LEFT_OUT:
            continue
        text = one_line(f"{line.time_ns / _NS:.6f} s  {line.place}  {line.text}")
        words = _NUMBER.sub("#", line.text)
        part = before if line.time_ns <= at_ns else after
        part[len(part) - (words == last and bool(part)) :] = [text]
        last = words
        if len(after) == _MESSAGES_AFTER:
            break
    yield from before[-_MESSAGES:]
    yield from after
