"""Pairs of random programs that share a rig's time, in processes of their own.

Their record must be that of the same programs as parties of one process, byte for byte. One of them
may die at any step, or at any moment of the wall clock. The run must name it, and must end. The
other program must continue as in the model. No process and no lock may remain.
"""

import json
import os
import signal
import subprocess
import tempfile
import threading
import weakref
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, Final, final
from unittest.mock import patch

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time import programs
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.forking.client import executing, forking
from tests.support.programs.scripted import program as scripted
from tests.support.programs.scripted.parties import Parties

STEPS_MAX: Final = 9
PATIENCE_S: Final = 60.0
"""The longest run on the wall clock; it takes less than a second."""
EXECUTED: Final = 0.05
"""The share of pairs whose programs are executed, which takes a second; others are forked."""
LATE_S: Final = 0.05
"""How long the first program is stopped in some runs, so that it joins last."""
KILLED: Final = 0.5
"""The share of pairs that run once more, with a kill at a moment of the wall clock."""
KILL_S: Final = 0.3
"""The latest moment of that kill, from the start."""
_TIMES_S: Final = (0.0, 1e-4, 1e-4, 3e-4, 1e-3, 1e-3, 5e-3)
_FIRST_IDS: Final = {"one": 0x150, "two": 0x1D0}  # of no drive of the rig
_OTHER: Final = {"one": "two", "two": "one"}
_MOTORS: Final = {"one": "left", "two": "right"}
_SILENT: Final = """\
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }
"""
_WAYS: Final = ("SIGKILL", "SIGTERM", "exit", "raise")
_STATUS: Final = {
    "SIGKILL": "ended by SIGKILL",
    "SIGTERM": "ended by SIGTERM",
    "exit": "exit status 7",
    "raise": "exit status 1",
}
_NOTHING: Final = "nothing can end the wait"
_LEFT: Final = "has left the rig: its connection has ended"

_POPEN: Final = subprocess.Popen

Step = list[Any]
Disturb = Callable[[list[Any]], None]


@final
@dataclass(frozen=True)
class Pair:
    """Two programs, and the end of one of them.

    Attributes:
        plans: by name, as `scripted.program` reads them.
        rig: the rig without its programs.
        may_leave: the programs that may.
        is_shared: True if both use one motor, which hardware objects of one process cannot.
        killed: the program that the other one kills, or "".
        is_late: True if the first one joins last.
    """

    plans: dict[str, dict[str, Any]]
    rig: str
    may_leave: tuple[str, ...] = ()
    is_shared: bool = False
    killed: str = ""
    is_late: bool = False

    @property
    def dying(self) -> str:
        """The program that ends itself, or ""."""
        return next((name for name, plan in self.plans.items() if plan["die_at"] is not None), "")


def _step(dice: Random, name: str, depth: int) -> Step:
    time_s = dice.choice(_TIMES_S)
    own, others = (_FIRST_IDS[one] for one in (name, _OTHER[name]))
    steps: list[Callable[[], Step]] = [
        lambda: ["sleep", time_s],
        lambda: ["run_for", time_s],
        lambda: ["clock"],
        lambda: ["send", own + dice.randrange(4), dice.choice((1, 1, 2, 20))],
        lambda: ["receive", time_s],
        lambda: ["receive", dice.choice((0.0, 1e-2))],
        lambda: ["echo", others + dice.randrange(4)],
        lambda: ["every", dice.choice((1e-4, 3e-4, 1e-3)), dice.randint(1, 5), own + 0x40],
        lambda: ["periodic", dice.choice((3e-4, 1e-3)), dice.choice((1e-3, 5e-3)), own + 0x41],
        lambda: ["mutex", dice.randrange(2), time_s, dice.choice(_TIMES_S)],
        lambda: ["put", dice.randrange(2), dice.randrange(9)],
        lambda: ["get", dice.randrange(2), time_s],
        lambda: ["signal", dice.randrange(2)],
        lambda: ["gather", [dice.choice(_TIMES_S) for _ in range(dice.randint(1, 4))]],
        lambda: ["wait", dice.randrange(2), time_s],
        lambda: ["lock", dice.choice("ab"), dice.choice((0.0, 1e-3, 1.0)), time_s, own + 0x42],
        lambda: ["lock", dice.choice("ab"), 1.0, dice.choice(_TIMES_S), own + 0x42],
        lambda: ["thread", _steps(dice, name, depth + 1)],
        lambda: ["thread", _steps(dice, name, depth + 1)],
    ]
    return dice.choice(steps if depth < 2 else steps[:-2])()


def _steps(dice: Random, name: str, depth: int = 0) -> list[Step]:
    return [_step(dice, name, depth) for _ in range(dice.randint(2, STEPS_MAX - 3 * depth))]


def _size(steps: list[Step]) -> int:
    return sum(1 + (_size(step[1]) if step[0] == "thread" else 0) for step in steps)


def pair_of(seed: str) -> Pair:
    """Return the pair of a seed."""
    dice = Random(seed)
    plans: dict[str, dict[str, Any]] = {}
    kind = dice.choice(("bus", "bus", "bus", "motors", "motors", "shared"))
    is_patient = dice.random() < 0.3
    for name in ("one", "two"):
        steps = _steps(dice, name)
        for _ in range(0 if kind == "bus" else dice.randint(1, 2)):
            motor = _MOTORS[name] if kind == "motors" else dice.choice(("left", "right"))
            target = dice.uniform(-0.3, 0.3)
            step: Step = ["reserve", motor, dice.choice((0.1, 10.0)), target]
            if kind == "motors":
                step = ["move", motor, target]
                if dice.random() < 0.4:
                    step = ["turn", motor, target, dice.uniform(0.01, 0.2)]
            steps.insert(dice.randint(0, len(steps)), step)
        steps += [["lock", key, 30.0, 0.0, 0x7F] for key in "ab"]
        if kind == "bus" and is_patient:
            steps.append(["farewell", *(_FIRST_IDS[one] + 0x43 for one in (name, _OTHER[name]))])
        plans[name] = {"steps": steps, "die_at": None, "how": ""}
    victim = dice.choice(("one", "two"))
    killed = ""
    fate = dice.random()
    if fate < 0.5:
        plans[victim]["die_at"] = dice.randrange(_size(plans[victim]["steps"]))
        plans[victim]["how"] = dice.choice(_WAYS)
    elif fate < 0.65:
        killed = victim
        number = dice.choice((signal.SIGKILL, signal.SIGTERM))
        steps = plans[_OTHER[victim]]["steps"]
        steps.insert(dice.randint(0, len(steps)), ["kill", victim, int(number)])
    rig = _SILENT
    if kind != "bus":
        rig = (EXAMPLES / "two_wheels.toml").read_text()
        rig = rig.replace('"wheel_model.toml"', f'"{EXAMPLES / "wheel_model.toml"}"')
    may_leave = tuple(name for name in plans if dice.random() < 0.3)
    return Pair(plans, rig, may_leave, kind == "shared", killed, dice.random() < 0.5)


@final
@dataclass
class Run:
    """The outcome of a run.

    Attributes:
        record: the recording.
        lines: the output of the programs, and what was told of them.
        wrong: what was wrong with the end of each program.
    """

    record: Path
    lines: list[str] = field(default_factory=list)
    wrong: dict[str, str] = field(default_factory=dict)

    @property
    def steps(self) -> list[str]:
        """The lines of the programs' own steps."""
        return [line for line in self.lines if ": @ " in line]

    def has_ended(self, name: str) -> bool:
        """Return whether the program has carried out its last step."""
        return any(line.startswith(f"{name}: @ end ") for line in self.lines)

    @cached_property
    def messages(self) -> list[tuple[str, int, bytes]]:
        """The record without what differs by design: names of processes, and notes of a death."""
        with read_trace(self.record) as trace:
            return [
                (channel.topic, time_ns, payload)
                for channel, time_ns, payload in trace.messages()
                if not channel.topic.endswith("/lock") and _LEFT.encode() not in payload
            ]


def as_parties(pair: Pair, folder: Path) -> Run:
    """Run the programs as parties of this process."""
    (folder / "model.toml").write_text(pair.rig)
    run = Run(folder / "model.mcap")
    with Rig.open(folder / "model.toml", record=run.record) as rig:
        parties = Parties(rig, pair.plans)
        parties.wait()
    run.lines = parties.lines
    return run


def _go_on(fd: int) -> None:
    """Let a stopped process go on, if it still lives."""
    with suppress(ProcessLookupError):
        signal.pidfd_send_signal(fd, signal.SIGCONT)
    os.close(fd)


@final
class Starter:
    """Start of the programs of a run, in the place of subprocess.Popen.

    Args:
        count: how many there will be.
        disturb: called with the processes once the last one is started.
        is_late: True if the first one joins last.
    """

    def __init__(self, count: int, disturb: Disturb, is_late: bool) -> None:
        self.processes: list[Any] = []
        self.has_hung: bool = False
        self._is_late = is_late
        self._count = count
        self._disturb = disturb
        self._timer = threading.Timer(PATIENCE_S, self._end)

    def __call__(self, *words: Any, **facts: Any) -> object:
        """Start a program."""
        process: Any = _POPEN(*words, **facts)
        self.processes.append(process)
        if self._is_late and len(self.processes) == 1:
            os.kill(process.pid, signal.SIGSTOP)
            threading.Timer(LATE_S, _go_on, (os.pidfd_open(process.pid),)).start()
        if len(self.processes) == self._count:
            self._timer.start()
            self._disturb(self.processes)
        return process

    def _end(self) -> None:
        self.has_hung = True
        for one in self.processes:
            with suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)

    def require_end(self) -> None:
        """Raise AssertionError if the run took too long, or a process of it remains."""
        self._timer.cancel()
        assert not self.has_hung, f"the run has not ended within {PATIENCE_S:g} s"
        for number, one in enumerate(self.processes):
            with suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
                raise AssertionError(f"a process of program {number} remains")


def as_processes(pair: Pair, folder: Path, name: str, disturb: Disturb = lambda _: None) -> Run:
    """Run the programs in processes.

    Args:
        pair: the programs.
        folder: of the rig and the record.
        name: of the record.
        disturb: called as soon as all programs are started.

    Raises:
        AssertionError: the run does not end, or something of it remains.
        RigError: a program has not joined.
    """
    text = pair.rig
    script = Path(scripted.__file__)
    for program in pair.plans:
        may_leave = str(program in pair.may_leave).lower()
        text += f"\n[program.{program}]\nmay_leave = {may_leave}\n"
        text += f'command = ["python", "{script}", "plan.json", "{program}"]\n'
    (folder / "rig.toml").write_text(text)
    (folder / "plan.json").write_text(json.dumps(pair.plans))
    for pid in folder.glob(f"{scripted.PIDS}*"):
        pid.unlink()
    run = Run(folder / f"{name}.mcap")
    starter = Starter(len(pair.plans), disturb, pair.is_late)
    with TemporaryDirectory(dir=folder) as temporary, patch.object(tempfile, "tempdir", temporary):
        try:
            with (
                patch.object(subprocess, "Popen", starter),
                Rig.open(folder / "rig.toml", record=run.record) as rig,
            ):
                run.wrong = programs.run_programs(rig, run.lines.append)
        finally:
            starter.require_end()
        remains = os.listdir(temporary)
        assert not remains, f"{remains} remains"
    return run


# ---- the judge ---------------------------------------------------------------------------------


def _require_told(pair: Pair, run: Run, ends: dict[str, str]) -> None:
    """Compare what is told of the ends with the ways of the programs' ends, by name."""
    wrong = {name: end for name, end in ends.items() if name not in pair.may_leave}
    assert run.wrong == wrong, f"told {run.wrong}; expected {wrong}"
    left = [f"program {name}: {_LEFT}" for name, end in ends.items() if end != _STATUS["raise"]]
    told = [line for line in run.lines if line.startswith("program ")]
    assert told == left, f"told {told}; expected {left}"
    with read_trace(run.record) as trace:
        noted = [payload for *_, payload in trace.messages() if _LEFT.encode() in payload]
    assert len(noted) == len(left), f"{len(noted)} deaths in the record; expected {len(left)}"


def _ends_of(pair: Pair, model: Run) -> dict[str, str]:
    """Return what is wrong with the end of each program of the model, by name."""
    ends: dict[str, str] = {}
    for name, plan in pair.plans.items():
        dies = any(line.startswith(f"{name}: @ dies ") for line in model.lines)
        if dies and plan["how"] != "raise":
            ends[name] = _STATUS[plan["how"]]
        elif not model.has_ended(name):
            ends[name] = _STATUS[_signal_of(pair).name if name == pair.killed else "raise"]
    return ends


def _signal_of(pair: Pair) -> signal.Signals:
    steps = pair.plans[_OTHER[pair.killed]]["steps"]
    return next(signal.Signals(step[2]) for step in steps if step[0] == "kill")


def require_model(pair: Pair, run: Run, model: Run) -> None:
    """Compare a run with the model: each program's output, and the record byte for byte."""
    _require_equal("lines", run.steps, model.steps)
    _require_equal("messages", run.messages, model.messages)
    _require_told(pair, run, _ends_of(pair, model))


def _require_equal(what: str, found: list[Any], expected: list[Any]) -> None:
    for number, (one, other) in enumerate(zip(found, expected, strict=False)):
        assert one == other, f"{what}: {number}: {one!r}; the model has {other!r}"
    assert len(found) == len(expected), f"{len(found)} {what}; the model has {len(expected)}"


def _without_death(pair: Pair) -> Pair:
    plans = {name: {**plan, "die_at": None} for name, plan in pair.plans.items()}
    for plan in plans.values():
        plan["steps"] = [step for step in plan["steps"] if step[0] != "kill"]
    return replace(pair, plans=plans, killed="")


def require_survivor(pair: Pair, run: Run, victim: str, number: signal.Signals) -> str:
    """Judge a run whose victim was killed at a moment of the wall clock; return what happened."""
    other, has_left = _OTHER[victim], f"program {victim}: {_LEFT}" in run.lines
    assert has_left or run.has_ended(victim), f"the death of {victim} is not told"
    ends = {victim: _STATUS[number.name]} if has_left else {}
    if not run.has_ended(other):  # it waits for a farewell that never came, or a thread had it
        told = [line for line in run.lines if line.startswith(other) and _NOTHING in line]
        assert told, f"the end of {other} is not told"
        ends[other] = _STATUS["raise"]
    if not has_left and victim in run.wrong:  # it was on its way out
        ends[victim] = _STATUS[number.name]
        assert run.wrong == ends, f"told {run.wrong}; expected {ends}"
        return "killed after it left"
    _require_told(pair, run, ends)
    return "killed" if has_left else "killed after its end"


@final
class Pairs:
    """The attempts of a seed."""

    def __init__(self, seed: int) -> None:
        self._seed: Final = seed
        stack = ExitStack()
        stack.enter_context(forking())
        self._keep: Final = TemporaryDirectory(prefix="motorhil-attack-")
        stack.callback(self._keep.cleanup)
        weakref.finalize(self, stack.close)

    def attempt(self, number: int) -> Done:
        """Run a pair in every way, and judge."""
        seed = f"{self._seed}:{number}"
        dice = Random(f"{seed}:fate")
        is_executed = dice.random() < EXECUTED
        with executing() if is_executed else nullcontext():
            done = self._attempt(pair_of(seed), dice)
        done.reached["executed" if is_executed else "forked"] += 1
        return done

    def _attempt(self, pair: Pair, dice: Random) -> Done:
        folder = Path(self._keep.name)
        reached = Counter[str]()
        run = as_processes(pair, folder, "run")
        if pair.is_shared:
            again = as_processes(pair, folder, "again")
            _require_equal("lines", again.lines, run.lines)
            assert digest(again.record) == digest(run.record), "another digest"
            reached["a motor shared"] += 1
        else:
            require_model(pair, run, as_parties(pair, folder))
        reached["messages"] += len(run.messages)
        reached.update(f"step {line.split()[2]}" for line in run.steps)
        if pair.dying:
            reached[f"died by {pair.plans[pair.dying]['how']}"] += 1
        if dice.random() < KILLED:
            reached[self._kill(pair, folder, dice)] += 1
        return Done(1, digest(run.record).encode(), reached)

    @staticmethod
    def _kill(pair: Pair, folder: Path, dice: Random) -> str:
        pair = _without_death(pair)
        victim = dice.choice(("one", "two"))
        number = dice.choice((signal.SIGKILL, signal.SIGTERM))
        after_s = dice.uniform(0.0, KILL_S)

        def disturb(processes: list[Any]) -> None:
            one = processes[list(pair.plans).index(victim)]
            fd = os.pidfd_open(one.pid)

            def kill() -> None:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(fd, number)
                os.close(fd)

            threading.Timer(after_s, kill).start()

        try:
            run = as_processes(pair, folder, "killed", disturb)
        except RigError as error:
            if f"program {victim}: ended before it joined" not in str(error):
                raise
            return "killed before it joined"
        return require_survivor(pair, run, victim, number)


def begin(seed: int) -> Attempt:
    """Return the attempts: one pair each."""
    return Pairs(seed).attempt


PAIRS: Final = Attack("pairs", "pairs", begin)
