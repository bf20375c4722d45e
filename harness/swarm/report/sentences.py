"""Sentences about disturbances and failures."""

import re
from collections.abc import Callable, Mapping
from typing import Final

from motorhil.harness.rig.config.toml import one_line
from motorhil.harness.swarm.row import CANARY, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance, World

_ORDINALS: Final = (
    *("first", "second", "third", "fourth", "fifth"),
    *("sixth", "seventh", "eighth", "ninth", "tenth"),
)
_TIME: Final = re.compile(r"\d+\.\d{9} s:? ")
_STEPS: Final = ((0.9995, 1.0, "s"), (0.9995e-3, 1e3, "ms"), (0.0, 1e6, "µs"))


def story(row: Row) -> str:
    """Return in a sentence, on one line, what happened in the world of a failure."""
    name = "The canary" if row.seed == CANARY else f"World {row.seed}"
    return line_of(f"{name}: {told(row.world)}; {failed(row)}")


def failed(row: Row) -> str:
    """Return when a world failed, and how, on one line."""
    return line_of(f"at {row.at_ns / 1e9:.6f} s {_TIME.sub('', row.text, count=1)}")


def told(world: World) -> str:
    """Return what disturbs a world."""
    if not world:
        return "nothing disturbs it"
    *others, last = map(sentence, world)
    return f"{', '.join(others)}, and {last}" if others else last


def sentence(one: Disturbance) -> str:
    """Return what a disturbance does, as a part of a sentence."""
    write = _SENTENCES.get(one.kind)
    try:
        if write is not None:
            return write(one)
    except (KeyError, AssertionError):  # it was written by hand, or by another version
        pass
    values = ", ".join(f"{key} {value}" for key, value in one.values)
    return f"{one.kind}{f' on {one.on}' if one.on else ''}{f' ({values})' if values else ''}"


def line_of(text: str) -> str:
    """Return a text on one line, without characters that control a terminal."""
    return one_line(" ".join(text.split()))


def duration(time_s: float) -> str:
    """Return a duration with three digits, in s, ms or µs."""
    _, factor, unit = next(step for step in _STEPS if abs(time_s) >= step[0])
    return f"{time_s * factor:.3g} {unit}"


# --- kinds ---------------------------------------------------------------------------------------


def _ordinal(number: int) -> str:
    if number <= len(_ORDINALS):
        return _ORDINALS[number - 1]
    ending = "th" if number % 100 in (11, 12, 13) else _ENDINGS.get(number % 10, "th")
    return f"{number}{ending}"


_ENDINGS: Final = {1: "st", 2: "nd", 3: "rd"}


def _frames(one: Disturbance, does: str, do: str) -> str:
    """Return which frames are hit: "the second frame 581h of left is lost".

    They are named by their number, or by the time from which on they are hit.
    """
    identifier = one.get("identifier")
    what = "transmission" if identifier is None else "frame"
    name = "" if identifier is None else f" {int(one.number('identifier')):X}h"
    place = f"{name} of {one.get('sender')}" + (f" on {one.on}" if identifier is None else "")
    count = int(one.number("limit"))
    if one.get("from_s") is not None:
        begins = f"{one.number('from_s'):.7g} s"
        if count == 1:
            return f"the first {what}{place} from {begins} on {does}"
        return f"{count} {what}s{place} from {begins} on {do}"
    first = int(one.number("skip")) + 1
    if count == 1:
        return f"the {_ordinal(first)} {what}{place} {does}"
    return f"the {_ordinal(first)} to {_ordinal(first + count - 1)} {what}s{place} {do}"


def _hit(does: str, do: str) -> Callable[[Disturbance], str]:
    return lambda one: _frames(one, does, do)


def _delay(one: Disturbance) -> str:
    late = duration(one.number("delay_s"))
    return _frames(one, f"comes {late} late", f"come {late} late")


def _error(one: Disturbance) -> str:
    kind = "an error in its last bit" if one.get("error") == "last" else f"a {one.get('error')}"
    if one.get("error") == "ack":
        kind = "no acknowledgement"
    elif one.get("error") != "last":
        kind += " error"
    return _frames(one, f"meets {kind}", f"meet {kind}")


def _truncate(one: Disturbance) -> str:
    count = int(one.number("after"))
    cut = f"cut after {count} byte{'s' if count > 1 else ''}"
    return _frames(one, f"is {cut}", f"are {cut}")


def _when(one: Disturbance) -> str:
    begins = f"{one.number('at_s'):.7g} s"
    if one.get("for_s") is None:
        return f"from {begins} on"
    return f"from {begins} for {duration(one.number('for_s'))}"


def _clock(one: Disturbance) -> str:
    ppm = one.number("ppm")
    return f"the clock of {one.on} is {abs(ppm):g} ppm {'slow' if ppm < 0.0 else 'fast'}"


_SENTENCES: Final[Mapping[str, Callable[[Disturbance], str]]] = {
    "drop": _hit("is lost", "are lost"),
    "lose": _hit("is lost", "are lost"),
    "duplicate": _hit("comes twice", "come twice"),
    "corrupt": _hit("has a wrong bit", "have a wrong bit"),
    "delay": _delay,
    "error": _error,
    "truncate": _truncate,
    "cut": lambda one: f"{one.get('node')} is cut off {one.on} {_when(one)}",
    "noise": lambda one: (
        f"noise inverts bits on {one.on} {_when(one)} (bit error rate {one.number('rate'):g})"
    ),
    "load": lambda one: f"{one.number('value'):g} N m load {one.on} {_when(one)}",
    "stall": lambda one: f"{one.number('value'):g} N m stall {one.on} {_when(one)}",
    "heat": lambda one: f"{one.on} has {one.number('value'):g} °C {_when(one)}",
    "supply": lambda one: f"the supply of {one.on} is {one.number('value'):g} V {_when(one)}",
    "power": lambda one: f"{one.on} has no power {_when(one)}",
    "fault": lambda one: (
        f"{one.on} has fault {int(one.number('code')):X}h at {one.number('at_s'):.7g} s"
    ),
    "quirk": lambda one: f"{one.on} has the quirk {one.get('name')}",
    "clock": _clock,
    "plant": lambda one: f"{one.get('key')} of {one.on} is {one.number('value'):g}",
    "kill": lambda one: f"program {one.on} is killed at {one.number('at_s'):.7g} s",
    "interleaving": lambda one: f"the parties take turns by seed {one.get('seed')}",
}
