"""Observer of one run: which events met which states.

An event is a fault that strikes, a stimulus, or a report of a controller, without its numbers. A
state is that of the controllers concerned, with the event before, or the place in the program that
waits meanwhile. Soon after a disturbance, a command of the program is an event too: its reaction.
Pairs of both are the coverage of a campaign. Places are read from the stack when an event occurs.
"""

import inspect
import os
import re
import sysconfig
from collections import Counter
from collections.abc import Iterable, Mapping
from types import FrameType
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.script import is_own_file
from motorhil.harness.swarm.worlds.marks import Marks, Traffic

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig
    from motorhil.harness.swarm.worlds.disturbance import World

_NUMBER: Final = re.compile(r"-?\b\d+(\.\d+)?(e[+-]?\d+)?\b")
_FAULT: Final = re.compile(r"(?P<kind>[a-z]+) \d+: (?P<what>[^0-9]*?) ?(?P<id>[0-9A-F]+)?h?")
_ADU: Final = re.compile(
    r"(?P<kind>[a-z]+) \d+: [a-z]+ [0-9A-F]{2} (?P<function>[0-9A-F]{2})(?: [0-9A-F]{2})*"
)
"""A fault on a line, with the bytes that it strikes: server address, function code, data."""
_DISTURBED: Final = re.compile(r"((?:stimulus )?[a-z]+)[ \d_a-z]*[:=]")
_PLACES: Final = 2
_STDLIB: Final = (sysconfig.get_paths()["stdlib"], "<frozen")
_INSTALLED: Final = f"{os.sep}site-packages{os.sep}"
_AT_REST: Final = 1e-3  # [rad/s or m/s]
_VELOCITIES: Final = ("velocity_rad_s", "velocity_m_s")
_NOTHING: Final = "the start"
_REACTING_NS: Final = 2_000_000_000
"""Commands this long after a disturbance are reactions to it."""


@final
@frozen
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
        self._struck = ""  # the kind of the last disturbance
        self._struck_ns: int | None = None  # the first disturbance
        self._reacts_until_ns = 0
        self._rig = rig
        self._on_bus: dict[str, list[str]] = {name: [] for name in rig.description.buses}
        for one in rig.description.controllers.values():
            self._on_bus[one.bus].append(one.name)
        rig.world.tap_events(self._take)
        self._marks = Marks(rig.world, rig.description.controllers, self._command)

    def reactions(self) -> tuple[Traffic, ...]:
        """Return the streams with marks soon after disturbances; () if none has struck."""
        if self._struck_ns is None:
            return ()
        streams = self._marks.traffic(self._struck_ns, self._reacts_until_ns)
        return tuple(one for one in streams if one.marks)

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
        disturbed = _DISTURBED.match(text)
        if disturbed is not None:
            self._struck = disturbed[1]
            self._struck_ns = time_ns if self._struck_ns is None else self._struck_ns
            self._reacts_until_ns = time_ns + _REACTING_NS

    def _command(self, identifier: int | None, time_ns: int) -> None:
        if time_ns <= self._reacts_until_ns:
            what = "request" if identifier is None else f"command {_function(identifier):X}h"
            self.pairs[f"{self._struck} at {place(1, False)} | {what}"] = None

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


def place(count: int = _PLACES, with_lines: bool = True) -> str:
    """Return where the program is: its innermost functions, up to a number, with their lines.

    Libraries that are installed count only if nothing else is on the stack.
    """
    own: list[str] = []
    installed: list[str] = []
    frame: FrameType | None = inspect.currentframe()
    while frame is not None and len(own) < count:
        code = frame.f_code
        if not is_own_file(code.co_filename) and not code.co_filename.startswith(_STDLIB):
            found = installed if _INSTALLED in code.co_filename else own
            found.append(f"{code.co_name}:{frame.f_lineno}" if with_lines else code.co_name)
        frame = frame.f_back
    return " < ".join(own or installed[:count]) or "-"


def state_class(truth: Mapping[str, float]) -> str:
    """Return the class of a controller's true state: its number, and whether it moves."""
    number = truth.get("state")
    moves = any(abs(truth.get(key, 0.0)) > _AT_REST for key in _VELOCITIES)
    return f"{'-' if number is None else int(number)}{'m' if moves else ''}"


def event_class(text: str) -> str:
    """Return the class of an event: its text without numbers of nodes and values."""
    on_line = _ADU.fullmatch(text)
    if on_line is not None:
        return f"{on_line['kind']} request {on_line['function']}h"
    found = _FAULT.fullmatch(text)
    if found is None:
        return _NUMBER.sub("#", text)
    identifier = found["id"]
    if identifier is None:
        return f"{found['kind']}: {found['what']}"
    return f"{found['kind']} {_function(int(identifier, 16)):X}h"


def _function(identifier: int) -> int:
    """Return the part of an identifier that is the same for all nodes."""
    return identifier & ~0x7F if identifier <= 0x7FF else identifier >> 8
