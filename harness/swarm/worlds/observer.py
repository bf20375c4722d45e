"""Observer of one run: which events met which states.

An event is a fault that strikes, a stimulus, or a report of a controller, without its numbers. A
state is that of the controllers concerned, with the event before, or the place in the program that
waits meanwhile. Pairs of both are the coverage of a campaign. Places are read from the stack when
an event occurs, so frames cost nothing.
"""

import inspect
import re
import sysconfig
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.rig.script import is_own_file

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig
    from motorhil.harness.swarm.worlds.disturbance import World

_NUMBER: Final = re.compile(r"-?\b\d+(\.\d+)?(e[+-]?\d+)?\b")
_FAULT: Final = re.compile(r"(?P<kind>[a-z]+) \d+: (?P<what>[^0-9]*?) ?(?P<id>[0-9A-F]+)?h?")
_PLACES: Final = 2
_STDLIB: Final = (sysconfig.get_paths()["stdlib"], "<frozen")
_AT_REST: Final = 1e-3  # [rad/s or m/s]
_VELOCITIES: Final = ("velocity_rad_s", "velocity_m_s")
_NOTHING: Final = "the start"


@final
@dataclass(frozen=True, slots=True)
class Event:
    """An event of a run.

    Attributes:
        time_ns: its time [ns].
        what: its class, without numbers.
        state: the state in which it occurred.
    """

    time_ns: int
    what: str
    state: str


@final
class Observer:
    """The events of an open rig, from now on.

    Attributes:
        events: all events, in order.
        pairs: each (state, event) that was met, in order of the first time.
    """

    def __init__(self, rig: "Rig") -> None:
        self.events: list[Event] = []
        self.pairs: dict[str, None] = {}
        self._rig = rig
        self._on_bus: dict[str, list[str]] = {name: [] for name in rig.description.buses}
        for one in rig.description.controllers.values():
            self._on_bus[one.bus].append(one.name)
        rig.world.tap_events(self._take)

    def before(self, time_ns: int) -> Event | None:
        """Return the last event up to a time, or None."""
        earlier = [one for one in self.events if one.time_ns <= time_ns]
        return earlier[-1] if earlier else None

    def acts(self, world: "World") -> Counter[str]:
        """Return the kinds of a world's disturbances, and how often each has struck.

        A rule of a bus or line counts what it has done. A change of an input has struck if its time
        has come. All others hold from the beginning, and have struck once.
        """
        end_s = self._rig.runtime.now_ns() / 1e9
        fired = self._rig.faults.fired()
        counts: Counter[str] = Counter()
        numbers: Counter[str] = Counter()
        for one in world:
            numbers[one.kind] += 1
            at_s = one.get("at_s")
            count = int(not isinstance(at_s, float) or at_s <= end_s)
            counts[one.kind] += fired.get(f"{one.kind} {numbers[one.kind]}", count)
        return counts

    def _take(self, time_ns: int, level: str, name: str, text: str) -> None:
        concerned = self._on_bus.get(name, [name])
        what = event_class(text)
        last = self.events[-1].what if self.events else _NOTHING
        states = {self._state(one) for one in concerned}
        state = "/".join(sorted(states))
        self.events.append(Event(time_ns, what, state))
        self.pairs[f"{state} after {last} | {what}"] = None
        self.pairs[f"{state} at {place()} | {what}"] = None

    def _state(self, name: str) -> str:
        if name not in self._rig.description.controllers:
            return "-"
        return state_class(self._rig.world.snapshot(name))


def acts_of(world: "World", observers: Iterable[Observer]) -> tuple[tuple[str, int], ...]:
    """Return the kinds of a world's disturbances, and how often each has struck in all rigs."""
    counts: Counter[str] = Counter({one.kind: 0 for one in world})
    for one in observers:
        counts.update(one.acts(world))
    return tuple(counts.items())


def place() -> str:
    """Return where the program is: its innermost lines, up to two, as function:line."""
    lines: list[str] = []
    frame: FrameType | None = inspect.currentframe()
    while frame is not None and len(lines) < _PLACES:
        code = frame.f_code
        if not is_own_file(code.co_filename) and not code.co_filename.startswith(_STDLIB):
            lines.append(f"{code.co_name}:{frame.f_lineno}")
        frame = frame.f_back
    return " < ".join(lines) or "-"


def state_class(truth: Mapping[str, float]) -> str:
    """Return the class of a controller's true state: its number, and whether it moves."""
    number = truth.get("state")
    moves = any(abs(truth.get(key, 0.0)) > _AT_REST for key in _VELOCITIES)
    return f"{'-' if number is None else int(number)}{'m' if moves else ''}"


def event_class(text: str) -> str:
    """Return the class of an event: its text without numbers of nodes and values."""
    found = _FAULT.fullmatch(text)
    if found is None:
        return _NUMBER.sub("#", text)
    identifier = found["id"]
    if identifier is None:
        return f"{found['kind']}: {found['what']}"
    number = int(identifier, 16)
    function = number & ~0x7F if number <= 0x7FF else number >> 8
    return f"{found['kind']} {function:X}h"
