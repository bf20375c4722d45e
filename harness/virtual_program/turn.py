"""Whose turn it is: the party that runs here, and what it costs to look at things without waiting.

All that stands in for the standard library asks `party_here` first. A thread that is no party (a
test runner's, a library's in C) gets the wall's clocks and plain locks, as does who calls from the
packages in `OUTSIDE`: this project's own, and what runs and measures tests.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread
from typing import Final, final

from harness.parties import VirtualParty
from harness.virtual_time import VirtualRuntime
from motorapi.errors import UsageError

OUTSIDE: Final = frozenset(
    {
        *("harness", "motorapi", "emulators", "traces"),
        *("_pytest", "pytest", "pytest_timeout", "pluggy", "xdist", "execnet", "hypothesis"),
        *("coverage", "subprocess"),
    }
)
_LOOK_NS: Final = 1_000
_SPIN_LOOK_NS: Final = 10_000
_BILL_NS: Final = 1_000_000
_SPIN_BILLS: Final = 10
_TOLD_BILLS: Final = 1_000


@final
class Program:
    """What runs in virtual time: its runtime, and how far its clocks are ahead of it.

    A look (at a clock, an event, a lock that is taken) lets a clock be 1 us ahead, and no time
    pass; at a party's thousandth look it waits until time has come there. So a program that looks
    until something changes gets there, and others have their turns meanwhile.
    """

    def __init__(self, runtime: VirtualRuntime) -> None:
        self.runtime = runtime
        self.ahead_ns = 0  # what a clock has said last
        self.parties: list[VirtualParty] = []  # its threads that had not ended when the last began
        self._bills = 0  # one after another, with nothing else in between
        self._paid_ns = -1
        self._told: list[VirtualParty] = []

    def add(self, party: VirtualParty) -> None:
        """A thread that has begun is the program's."""
        self.parties = [other for other in self.parties if not other.finished]
        self.parties.append(party)
        self.runtime.enrol(party)

    def look(self, party: VirtualParty) -> int:
        """What a clock says [ns], a little more at each look; that may take a wait."""
        now_ns = self.runtime.queue.now_ns
        step_ns = _LOOK_NS if self._bills < _SPIN_BILLS else _SPIN_LOOK_NS
        self.ahead_ns = max(now_ns, self.ahead_ns) + step_ns
        if party.looked_ns != now_ns:
            party.looked_ns, party.owed_ns = now_ns, 0
        party.owed_ns += step_ns
        party.read_ns = self.ahead_ns
        if party.owed_ns >= _BILL_NS and not self.runtime.is_in_callback():
            self._pay(party)
        return party.read_ns

    def from_now_s(self, party: VirtualParty, duration_s: float) -> float:
        """How long it waits in the rig [s]: by the clock it looked at last, no less than asked."""
        return duration_s + max(0, party.read_ns - self.runtime.queue.now_ns) / 1e9

    def _pay(self, party: VirtualParty) -> None:
        queue = self.runtime.queue
        self._bills = self._bills + 1 if queue.now_ns == self._paid_ns else 0
        if self._bills >= _TOLD_BILLS and party not in self._told:
            self._told.append(party)
            print(
                f"{whereabouts(party)}: it looks again and again without sleeping, and each look "
                f"lets {_SPIN_LOOK_NS / 1e3:g} us pass; a time.sleep() there makes it faster",
                file=sys.stderr,
            )
        self.runtime.run_for((self.ahead_ns - queue.now_ns) / 1e9)
        self._paid_ns = queue.now_ns


@final
class _Stage:
    """What is on: at most one program, and whether its parties are treated as such just now."""

    program: Program | None = None
    is_on_wall = False


def program_here() -> Program | None:
    """The program of which this thread is a party; None if it is none's."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is None:
        return None
    return program


def party_here() -> VirtualParty | None:
    """The party that this thread is; None: the wall's clocks and locks are its own."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall:
        return None
    return program.runtime.party_of_thread()


def caller_is_outside(depth: int) -> bool:
    """Whether the function so many calls up belongs to the packages in `OUTSIDE`."""
    name = sys._getframe(depth).f_globals.get("__name__", "")  # noqa: SLF001 -- no other is as fast
    return isinstance(name, str) and name.partition(".")[0] in OUTSIDE


def refuse_foreign(what: str) -> None:
    """A thread that is no party has no turn in a program that is on.

    Raises:
        UsageError: this thread is such a one.
    """
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is not None:
        return
    raise UsageError(
        f"thread {current_thread().name!r} would {what}: it was not started by Python's threading "
        "while the program ran, so only the wall knows when; start it with threading.Thread, or "
        "run the program on the wall's clock: motorhil serve RIG -- python SCRIPT"
    )


@contextmanager
def on_wall() -> Iterator[None]:
    """Within it nobody is a party: what waits, waits in the operating system, and not for long."""
    before, _Stage.is_on_wall = _Stage.is_on_wall, True
    try:
        yield
    finally:
        _Stage.is_on_wall = before


@contextmanager
def program_on(runtime: VirtualRuntime) -> Iterator[Program]:
    """Within it the parties of this runtime are a program's.

    Raises:
        UsageError: another program is on in this process.
    """
    if _Stage.program is not None:
        raise UsageError(
            "a program runs in virtual time in this process already: one rig's clock at a time; "
            "leave its in_virtual_time first"
        )
    program = _Stage.program = Program(runtime)
    runtime.whereabouts, named = whereabouts, runtime.whereabouts
    runtime.on_poll = lambda: _poll(program)
    try:
        yield program
    finally:
        _Stage.program = None
        runtime.on_poll, runtime.whereabouts = None, named


def _poll(program: Program) -> None:
    party = program.runtime.party_of_thread()
    if party is not None:
        program.look(party)


def whereabouts(party: VirtualParty) -> str:
    """Who it is, and where in its own code: "worker (robot.py:12, in Queue.get)"."""
    frame = sys._current_frames().get(party.ident)  # noqa: SLF001 -- documented, for this
    told = [party.name]
    within = ""
    while frame is not None:
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package not in OUTSIDE and package not in sys.stdlib_module_names:
            told.append(f" ({frame.f_code.co_filename}:{frame.f_lineno}{within})")
            break
        if package not in OUTSIDE:
            within = f", in {frame.f_code.co_qualname}"
        frame = frame.f_back
    if party.held_up_by not in (None, party):  # it takes a condition's lock from itself
        told.append(f", held up by {party.held_up_by.name}")
    return "".join(told)
