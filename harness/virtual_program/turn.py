"""The party whose turn it is, and the cost of polling clocks.

All stand-ins for the standard library call `party_here` first. A thread that is not a party (a test
runner's, a C library's) gets the wall clocks and plain locks. So do callers from the packages in
`OUTSIDE`: this project's own, and those that run and measure tests.
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
    """A program in virtual time: its runtime, and the lead of its clocks.

    A look at a clock, an event or a taken lock advances the clock by 1 us, and lets no time pass.
    At its thousandth look a party waits until time has caught up. So a program that polls until
    something changes makes progress, and other parties have their turns meanwhile.
    """

    def __init__(self, runtime: VirtualRuntime) -> None:
        self.runtime = runtime
        self.ahead_ns = 0  # the last value of a clock
        self.parties: list[VirtualParty] = []  # running threads when the last was added
        self._bills = 0  # consecutive waits for time to catch up, with nothing in between
        self._paid_ns = -1
        self._told: list[VirtualParty] = []

    def add(self, party: VirtualParty) -> None:
        """Add a started thread to the program."""
        self.parties = [other for other in self.parties if not other.finished]
        self.parties.append(party)
        self.runtime.enrol(party)

    def look(self, party: VirtualParty) -> int:
        """Return the value of a clock [ns], a little more at each look; this may wait."""
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
        """Return the wait in the rig's time [s] until `duration_s` after the party's last look."""
        return duration_s + max(0, party.read_ns - self.runtime.queue.now_ns) / 1e9

    def _pay(self, party: VirtualParty) -> None:
        queue = self.runtime.queue
        self._bills = self._bills + 1 if queue.now_ns == self._paid_ns else 0
        if self._bills >= _TOLD_BILLS and party not in self._told:
            self._told.append(party)
            print(
                f"{whereabouts(party)}: polls without sleeping; each poll "
                f"takes {_SPIN_LOOK_NS / 1e3:g} us of the rig's time; add a time.sleep()",
                file=sys.stderr,
            )
        self.runtime.run_for((self.ahead_ns - queue.now_ns) / 1e9)
        self._paid_ns = queue.now_ns


@final
class _Stage:
    """The active program, and whether its parties currently use the wall clock."""

    program: Program | None = None
    is_on_wall = False


def program_here() -> Program | None:
    """Return the program of which this thread is a party, or None."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is None:
        return None
    return program


def party_here() -> VirtualParty | None:
    """Return the party of this thread; None if it uses the wall's clocks and locks."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall:
        return None
    return program.runtime.party_of_thread()


def caller_is_outside(depth: int) -> bool:
    """Return whether the function `depth` calls up belongs to the packages in `OUTSIDE`."""
    name = sys._getframe(depth).f_globals.get("__name__", "")  # noqa: SLF001 -- no other is as fast
    return isinstance(name, str) and name.partition(".")[0] in OUTSIDE


def refuse_foreign(what: str) -> None:
    """Refuse an operation of a thread that is not a party of the active program.

    Raises:
        UsageError: this thread is not a party.
    """
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is not None:
        return
    raise UsageError(
        f"thread {current_thread().name!r} cannot {what}: it was not started by Python's threading "
        "while the program ran, so it has no virtual time; start it with threading.Thread, or "
        "run the program in wall time: motorhil serve RIG -- python SCRIPT"
    )


@contextmanager
def on_wall() -> Iterator[None]:
    """Treat no thread as a party within the block; waits are short and in wall time."""
    before, _Stage.is_on_wall = _Stage.is_on_wall, True
    try:
        yield
    finally:
        _Stage.is_on_wall = before


@contextmanager
def program_on(runtime: VirtualRuntime) -> Iterator[Program]:
    """Activate a program for the parties of this runtime within the block.

    Raises:
        UsageError: another program is active in this process.
    """
    if _Stage.program is not None:
        raise UsageError(
            "another program of this process is already in virtual time; "
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
    """Return a party's name and place in its own code: "worker (robot.py:12, in Queue.get)"."""
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
    if party.held_up_by not in (None, party):  # a party takes a condition's lock from itself
        told.append(f", held up by {party.held_up_by.name}")
    return "".join(told)
