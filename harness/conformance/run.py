"""Checks of clauses in this process, each on a new bench.

A check that never ends, or that ends the process, is handled by `Supervisor`. After a check the
process is searched for leaks: threads, buses, descriptors and processes left behind. No library
records where a thread was started or a bus was opened; inside `watched` both calls record their
callers. Places in the code are reported as "file:line".
"""

import gc
import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Final, final

import can

from motorhil.harness.conformance import clause
from motorhil.harness.conformance.bench import Opener
from motorhil.harness.conformance.clause import Clause, NotApplicable, Result, Verdict, Violated
from motorhil.harness.conformance.diagnosis import diagnose
from motorhil.harness.conformance.observation import Observation
from motorhil.harness.conformance.rig_bench import RigBench, TimeIsUp
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED, Capability, Facts
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorError,
    MotorModel,
    PluginError,
    Setpoint,
    SyncLevel,
    Trajectory,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.hooks import MotorHooks
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_status import look

if TYPE_CHECKING:
    from motorhil.harness.conformance.bench import RigProtocol


_OPTIONAL: Final = ("hypothesis",)  # that some clauses need and motorhil does not
_MODES: Final = {
    Capability.POSITION_SET_POINT: (ControlMode.SETPOINT, ControlVariable.POSITION),
    Capability.VELOCITY_SET_POINT: (ControlMode.SETPOINT, ControlVariable.VELOCITY),
    Capability.TORQUE_SET_POINT: (ControlMode.SETPOINT, ControlVariable.TORQUE),
    Capability.CURRENT_SET_POINT: (ControlMode.SETPOINT, ControlVariable.CURRENT),
    Capability.POSITION_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.POSITION),
    Capability.VELOCITY_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.VELOCITY),
    Capability.TORQUE_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.TORQUE),
}
_SLOW: Final = (Capability.COMPLEX_POSITION, Capability.COMPLEX_VELOCITY)
"""Capabilities whose check imports numpy, which takes longer than the first verdicts."""
_OPEN: Final = "_open_low_level"
_READINGS: Final = {
    Capability.MEASURED_TORQUE: Motor.torque,
    Capability.MEASURED_FOLLOWING_ERROR: Motor.following_error,
}
_SETTLE_S: Final = 0.25
_POLL_S: Final = 0.01
_DESCRIPTORS: Final = Path("/proc/self/fd")
_TASKS: Final = Path("/proc/self/task")
_HERE: Final = Path(__file__).parent
_CLAUSES: Final = (str(_HERE / "clauses"), str(_HERE / "drives" / "clauses"))
_SHARED: Final = (str(clause.__file__), os.path.join(_CLAUSES[0], "helpers.py"))
"""Files whose functions raise for their callers; a place in the calling clause is preferred."""

Line = tuple[str, int]
"""(file, line)."""


@final
class Claims:
    """The capability claims of a bench's motors, read when needed on separate benches.

    Connecting sends frames. Every clause must begin in the same way, whatever was asked before.
    """

    def __init__(self, open_bench: Opener) -> None:
        self._open = open_bench
        self._known: dict[Capability, str] = {}

    def why_not(self, capability: Capability) -> str:
        """Return the reason why a capability is not claimed; "" if it is claimed.

        Raises:
            MotorError: the motor cannot be reached.
        """
        if capability not in self._known:
            found: dict[Capability, str] = {}
            with self._open() as bench:
                bench.motor.logical.hooks.connect()  # what its drive lacks, it does not claim
                for one in dict.fromkeys((*_READINGS, *Capability)):  # reading shows more units
                    if (one in _SLOW) is not (capability in _SLOW):
                        continue
                    try:
                        found[one] = _why_not(bench.motor, bench.facts, one)
                    except (Exception, SystemExit):
                        if one is capability:  # clauses that need another one report its error
                            raise
            self._known.update(found)
        return self._known[capability]


def _why_not(motor: Motor, facts: Facts, capability: Capability) -> str:
    if capability in facts.without:
        return f"not claimed by the rig: {facts.without[capability]}"
    if capability not in facts.claims and not _claims(motor, capability):
        return f"the adaptation does not claim {capability.value}"
    return ""


def _claims(motor: Motor, capability: Capability) -> bool:
    if capability in _MODES:
        mode, variable = _MODES[capability]
        if not motor.logical.hooks.supports(mode, variable):
            return False
        if mode is ControlMode.TRAJECTORY:
            return _accepts(motor, variable, TrapezoidalTrajectory(0.0, duration_s=1.0))
        return _accepts(motor, variable, Setpoint(0.0, variable is ControlVariable.POSITION))
    if capability in _READINGS:
        return _reads(_READINGS[capability], motor)
    if capability is Capability.LOW_LEVEL:
        return getattr(type(motor), _OPEN) is not getattr(MotorHooks, _OPEN)
    if capability is Capability.COMMON_TRIGGER:
        return motor.logical.hooks.sync_offer().level >= SyncLevel.TRIGGERED
    if capability is Capability.COMPLEX_POSITION:
        return _takes_functions(motor, ControlVariable.POSITION)
    if capability is Capability.COMPLEX_VELOCITY:
        return _takes_functions(motor, ControlVariable.VELOCITY)
    if capability is Capability.LIMITED_SET_POINT:
        return _takes_limits(motor)
    return True  # faults, and what only the rig can know: claimed unless it is in `without`


def _reads(read: Callable[[Motor], float], motor: Motor) -> bool:
    try:
        read(motor)
    except UnsupportedError:
        return False
    return True


def _takes_functions(motor: Motor, variable: ControlVariable) -> bool:
    """Return whether the motor accepts complex trajectories; keep the motor's settings."""
    if not motor.logical.hooks.supports(ControlMode.TRAJECTORY, variable):
        return False
    from motorhil.motorapi.functions import Polynomial

    still = ComplexTrajectory(Polynomial((0.0,)).restricted(0.0, 1.0), relative=True)
    return _accepts(motor, variable, still)


def _takes_limits(motor: Motor) -> bool:
    if not motor.logical.hooks.supports(ControlMode.SETPOINT, ControlVariable.POSITION):
        return False
    slow = DerivativeLimits(first=0.5 * motor.model.velocity_max)
    return _accepts(motor, ControlVariable.POSITION, Setpoint(0.0, True, slow))


def _accepts(motor: Motor, variable: ControlVariable, command: Setpoint | Trajectory) -> bool:
    try:
        motor.logical.hooks.check_command(variable, command)
    except UnsupportedError:
        return False
    return True


def home_of(module: str) -> str:
    """Return the top-level package folder of a loaded module, or its file if it has no package."""
    parts = module.split(".")
    package = sys.modules.get(".".join(parts[: 2 if parts[0] == "motorhil" else 1]))
    file: str | None = getattr(package, "__file__", None)
    if file is None:
        return ""
    return os.path.dirname(file) + os.sep if hasattr(package, "__path__") else file


def raised_at(error: BaseException, home: str | tuple[str, ...] = "") -> str:
    """Return where the error or its cause was raised: the last line in `home`, or the last line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return place_in(list(_lines_of(error.__traceback__)), home)


def called_at(frame: FrameType | None) -> str:
    """Return the current place of a frame."""
    return "" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"


def place_in(lines: Sequence[Line], home: str | tuple[str, ...] = "") -> str:
    """Return the last line that is in `home`, or the last line of all; "" if there is none.

    The outermost line is the first.
    """
    lines = [line for line in lines if line[0] not in _SHARED] or lines
    own = [line for line in lines if home and line[0].startswith(home)]
    chosen = own or lines
    return f"{chosen[-1][0]}:{chosen[-1][1]}" if chosen else ""


def _lines_of(traceback: TracebackType | None) -> Iterable[Line]:
    while traceback is not None:
        yield traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
        traceback = traceback.tb_next


@final
class Watch:
    """Compares resources before and after a clause; use it through `watched`."""

    def __init__(self) -> None:
        self._threads = _thread_ids()
        self._descriptors = _descriptors()
        self._children = _children()
        self._folder = os.getcwd()
        self.started: dict[int | None, str] = {}
        self.opened: list[tuple[can.BusABC, str]] = []

    def left(self) -> list[str]:
        """Return descriptions of new resources; shut down new buses, kill new processes."""
        buses = list(self._open_buses())
        end_s = time.monotonic() + _SETTLE_S
        while self._is_ending() and time.monotonic() < end_s:
            time.sleep(_POLL_S)  # a thread needs a moment to end
        self.opened.clear()
        return [
            *map(self._thread, self._new_threads()),
            *buses,
            *self._new_descriptors(),
            *self._new_children(),
            *self._new_folder(),
        ]

    def _is_ending(self) -> bool:
        """Return whether new threads exist, or descriptors that a thread may still close."""
        return bool(self._new_threads() or set(_descriptors()) - set(self._descriptors))

    def _new_threads(self) -> list[int]:
        return sorted(_thread_ids() - self._threads - {threading.get_ident()})

    def _thread(self, ident: int) -> str:
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        frame = sys._current_frames().get(ident)  # noqa: SLF001 -- documented, despite its name
        at = self.started.get(ident) or called_at(frame)
        return f"thread {names.get(ident, 'without a name')!r}, started at {at}"

    def _open_buses(self) -> Iterator[str]:
        for bus, at in self.opened:
            if not getattr(bus, "_is_shutdown", True):
                yield f"a bus not shut down ({bus.channel_info}), opened at {at}"
                with suppress(Exception):
                    bus.shutdown()

    def _new_descriptors(self) -> Iterator[str]:
        if set(_descriptors()) - set(self._descriptors):
            gc.collect()  # closes what is no longer referenced
        for number, target in _descriptors().items():
            if self._descriptors.get(number) != target:
                yield _lock_held(target) or f"a descriptor not closed ({target})"

    def _new_children(self) -> Iterator[str]:
        for pid in sorted(_children() - self._children):
            yield f"a process ({_program(pid)})"
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)

    def _new_folder(self) -> Iterator[str]:
        now = os.getcwd()
        if now != self._folder:
            os.chdir(self._folder)  # relative paths of others start here
            yield f"another current folder ({now})"


@contextmanager
def watched() -> Iterator[Watch]:
    """Record where threads are started and buses are opened within the block."""
    watch = Watch()
    thread: Any = threading.Thread
    bus: Any = can.BusABC
    start, open_ = thread.start, bus.__init__

    def start_noted(self: threading.Thread) -> None:
        here = inspect.currentframe()
        at = called_at(here and here.f_back)
        start(self)
        watch.started[self.ident] = at

    def open_noted(self: can.BusABC, *args: Any, **kwargs: Any) -> None:
        watch.opened.append((self, _opened_at()))
        open_(self, *args, **kwargs)

    thread.start, bus.__init__ = start_noted, open_noted
    try:
        yield watch
    finally:
        thread.start, bus.__init__ = start, open_


def _opened_at() -> str:
    """Return where a bus was opened: the first caller outside constructors and python-can."""
    frame = inspect.currentframe()
    for _ in range(2):
        frame = None if frame is None else frame.f_back
    own = os.path.dirname(can.__file__) + os.sep
    while frame is not None and (
        frame.f_code.co_name == "__init__" or frame.f_code.co_filename.startswith(own)
    ):
        frame = frame.f_back
    return called_at(frame)


def _thread_ids() -> set[int]:
    """Return all threads, also those that the threading module has not started."""
    return set(sys._current_frames())  # noqa: SLF001 -- documented, despite its name


def _descriptors() -> dict[int, str]:
    """Return the targets of all open descriptors of this process."""
    found = {}
    for entry in _DESCRIPTORS.iterdir():
        with suppress(OSError):  # the listing's own descriptor is closed by now
            found[int(entry.name)] = os.readlink(entry)
    return found


def _lock_held(target: str) -> str:
    """Describe a lock file held by this process; "" if it is not a lock file, or free."""
    folder, name = os.path.split(target)
    with suppress(UsageError):
        directory = LockDirectory()
        holder = look(directory, name).holder if str(directory.path) == folder else None
        if holder is not None and holder.record is not None and holder.record.pid == os.getpid():
            return f"an inter-process lock not released ({name}, for {holder.record.purpose})"
    return ""


def _program(pid: int) -> str:
    """Return the command line of a process, or its name if it has ended."""
    words = b""
    end_s = time.monotonic() + _POLL_S
    with suppress(OSError):
        while not words and time.monotonic() < end_s:  # empty while the process starts
            words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").strip()
        words = words or Path(f"/proc/{pid}/comm").read_bytes().strip()
    return words.decode(errors="replace")


def _children() -> set[int]:
    """Return the process ids of all child processes."""
    pids: set[int] = set()
    for task in _TASKS.iterdir():
        with suppress(OSError):
            pids.update(map(int, (task / "children").read_text().split()))
    return pids


def run_clauses(clauses: Iterable[Clause], open_bench: Opener) -> Iterator[Verdict]:
    """Yield the verdict of each clause as soon as it is known."""
    claims = Claims(open_bench)
    for one in clauses:
        yield run_clause(one, open_bench, claims)


def run_clause(
    one: Clause, open_bench: Opener, claims: Claims | None = None, home: str = ""
) -> Verdict:
    """Return the verdict of one clause.

    Args:
        one: the clause.
        open_bench: switches on a bench for it.
        claims: the claims of the motors of such benches.
        home: the adaptation's folder, whose lines are preferred (`home_of`).

    Raises:
        RigError: the rig file cannot be used.
    """
    with watched() as watch:
        verdict = _checked(one, open_bench, claims or Claims(open_bench), _Judge(one, home))
        left = "; ".join(watch.left())
    if left and verdict.result is Result.PASSED:
        return replace(verdict, result=Result.LEFT_BEHIND, seen=left)
    if left:
        seen = f"{verdict.seen}; and left behind: {left}".lstrip("; ")
        return replace(verdict, seen=seen)
    return verdict


def _checked(one: Clause, open_bench: Opener, claims: Claims, judge: "_Judge") -> Verdict:
    """Return the verdict; keep no reference to the bench."""
    time_ns, name = 0, ""
    try:
        _require_claimed(one, claims)
        with open_bench() as bench:
            judge.facts = bench.facts
            name = bench.name if isinstance(bench, RigBench) else ""
            try:
                _require_able(one, bench)
                one.check(bench)
                verdict = Verdict(one.id, Result.PASSED)
            except BaseException as error:
                if isinstance(error, LimitError):  # asking for a motor connects it
                    judge.models = tuple(motor.model for motor in bench.motors)
                verdict = judge.verdict(error)
                if not verdict.result.is_good:
                    seen = bench.observation if isinstance(bench, RigBench) else None
                    if seen is not None:
                        seen.look(bench.runtime.now_ns())
                    verdict = judge.diagnosed(verdict, error, seen)
            time_ns = bench.runtime.now_ns()
    except BaseException as error:  # while the bench was switched on or off
        verdict = judge.verdict(error)
        if not verdict.result.is_good:
            verdict = judge.diagnosed(verdict, error, None)
    return replace(verdict, time_ns=time_ns, bench=name)


def _require_claimed(one: Clause, claims: Claims) -> None:
    for capability in one.needs:
        why_not = claims.why_not(capability)
        if why_not:
            raise NotApplicable(why_not)


def _require_able(one: Clause, bench: "RigProtocol") -> None:
    for ability in one.bench:
        if ability not in bench.abilities:
            raise NotApplicable(f"the bench cannot {ability.value}")


@final
class _Judge:
    """Derives a verdict from the error that ended a check."""

    def __init__(self, one: Clause, home: str) -> None:
        self._one = one
        self._home = home
        self.facts: Facts = NOTHING_DECLARED
        self.models: tuple[MotorModel, ...] = ()

    def verdict(self, error: BaseException) -> Verdict:
        """Return the verdict for this error.

        Raises:
            KeyboardInterrupt, RigError: the error itself.
        """
        if isinstance(error, RigError) and not isinstance(error, BrokenPluginError):
            raise error
        if isinstance(error, KeyboardInterrupt):
            raise error
        if isinstance(error, NotApplicable):
            return Verdict(self._one.id, Result.NOT_APPLICABLE, f"{error}")
        if isinstance(error, ModuleNotFoundError) and error.name in _OPTIONAL:
            why = f"{error.name} is not installed; pip install {error.name}"
            return Verdict(self._one.id, Result.NOT_APPLICABLE, why)
        if isinstance(error, LimitError) and self._is_no_room(error):
            why = f"no room for this move: {error}; a shorter long_move may fit"
            return Verdict(self._one.id, Result.NOT_APPLICABLE, why)
        place = raised_at(error, self._home)
        if isinstance(error, Violated):
            place = raised_at(error, _CLAUSES)  # in the clause, not in a shared function
            return Verdict(self._one.id, Result.FAILED, f"{error}", place)
        if isinstance(error, TimeIsUp):
            return Verdict(self._one.id, Result.HUNG, f"{error}", place)
        if isinstance(error, UnsupportedError):
            for claimed in self._one.needs:
                if claimed in self.facts.claims:
                    seen = f"{claimed.value}: claimed by the rig, refused by the motor: {error}"
                    at = self.facts.claimed_at.get(claimed, place)
                    return Verdict(self._one.id, Result.FAILED, seen, at)
        if isinstance(error, RigError) and error.__cause__ is None:
            place = ""  # the message has the rig's line; the kit's line does not help
        seen = f"{error}" if isinstance(error, RigError) else f"{type(error).__name__}: {error}"
        if isinstance(error, MotorError) and not isinstance(error, PluginError):
            return Verdict(self._one.id, Result.FAILED, f"raised {seen}", place)
        return Verdict(self._one.id, Result.CRASHED, seen, place)

    def diagnosed(
        self, verdict: Verdict, error: BaseException, observation: Observation | None
    ) -> Verdict:
        """Return the verdict with a diagnosis."""
        diagnosis = diagnose(self._one, error, verdict.seen, self._home, observation)
        return replace(verdict, diagnosis=diagnosis)

    def _is_no_room(self, error: LimitError) -> bool:
        """Return whether the clause has asked for a position that the motors' models forbid."""
        return any(
            error.unit == model.unit
            and (
                (model.position_min is not None and error.value < model.position_min)
                or (model.position_max is not None and error.value > model.position_max)
            )
            for model in self.models
        )
