"""Trial: one world, run in this process, judged."""

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, final

from motorhil.harness.oracles.base import Verdict, Violation
from motorhil.harness.oracles.facts import Facts, subjects_in
from motorhil.harness.oracles.judge import IDS, judge
from motorhil.harness.oracles.limits import VelocityLimit
from motorhil.harness.rig.config.rig_file import Known, RigDescription, read_rig
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.recording import files_of
from motorhil.harness.rig.rig import Rig, installed_plugins
from motorhil.harness.rig.script import (
    Script,
    exit_status,
    is_own_file,
    read_script,
    run_script,
)
from motorhil.harness.swarm import properties
from motorhil.harness.swarm.plan import FUNCTION, Plan
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.worlds.disturbance import World, fragment
from motorhil.harness.swarm.worlds.fairness import fair
from motorhil.harness.swarm.worlds.observer import Observer
from motorhil.harness.swarm.worlds.profile import Profile, Profiler
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.records import Attachment

_TEXT_MAX: Final = 300
_RECORD: Final = "run.mcap"
_WARM_S: Final = 0.1


@final
@dataclass(frozen=True, slots=True)
class Failure:
    """Something that a run did wrong.

    Attributes:
        time_ns: when [ns].
        oracle: who saw it.
        rule: what was broken, without numbers and names.
        role: the kind of the motor or controller concerned, or "".
        text: the failure in a sentence.
    """

    time_ns: int
    oracle: str
    rule: str
    role: str
    text: str


class NoRecord(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """The record of a run could not be written; the run says nothing about the program."""


def tried(plan: Plan, seed: int, world: World, passing: Path, record: Path | None = None) -> Row:
    """Run the world and return its row; pairs are not yet compared with earlier worlds.

    Args:
        plan: the campaign.
        seed: the world's seed, and the rig's.
        world: its disturbances.
        passing: a folder for files that the caller removes.
        record: where the record stays; None: in that folder.

    Raises:
        NoRecord: the record cannot be written.
    """
    return _Trial(plan, seed, world, record or passing / _RECORD).run(passing)


def tried_in(plan: Plan, seed: int, file: Path, record: Path | None = None) -> Row:
    """Run the world of a fragment, as `tried` does; allowed errors may end the program."""
    with TemporaryDirectory(prefix="motorhil-swarm-") as name:
        passing = Path(name)
        return _Trial(plan, seed, (), record or passing / _RECORD, file).run(passing)


def profiled(plan: Plan, seed: int, passing: Path) -> tuple[Row, Profile | None]:
    """Run the undisturbed world; return its row, and what it looks like unless it failed."""
    trial = _Trial(plan, seed, (), passing / _RECORD)
    row = trial.run(passing, profiles=True)
    return row, trial.profile


def warm(plan: Plan, passing: Path) -> None:
    """Import what a run needs, and run it until Python has specialised its code.

    The program itself is not imported. Errors are not told: the first world has them too.
    """
    nothing = Script(_RECORD, b"", str(passing))
    with suppress(Exception):
        with Rig(_described(plan, None), record=passing / _RECORD, doubts=False) as rig:
            Observer(rig)
            rig.build_motors()
            run_script(rig, nothing, ())
            for motor in rig.motors.values():
                with suppress(Exception):
                    motor.enable()
                    rig.runtime.run_for(_WARM_S)
                    motor.disable()
        judge(passing / _RECORD, Facts())
        digest(passing / _RECORD)


@cache
def _plugins() -> Known:
    """Return the plugins that are installed; a process looks once."""
    return installed_plugins()


def _described(plan: Plan, world: Path | None) -> RigDescription:
    return read_rig(Path(plan.rig), _plugins(), world)


@final
class _Trial:
    """One run."""

    def __init__(
        self, plan: Plan, seed: int, world: World, record: Path, file: Path | None = None
    ) -> None:
        self.profile: Profile | None = None
        self._plan = plan
        self._seed = seed
        self._world = world
        self._file = file
        self._record = record
        self._failures: list[Failure] = []
        self._ended_by = ""

    def run(self, passing: Path, profiles: bool = False) -> Row:
        """Run it, and judge it."""
        try:
            rig = self._opened(passing)
        except RigError as error:
            if Path(error.file) == self._record:
                raise NoRecord(str(error)) from None
            return Row(self._seed, Result.CANCELLED, text=str(error)[:_TEXT_MAX])
        return self._judged(rig, profiles)

    def _opened(self, passing: Path) -> Rig:
        world = self._file
        if self._world:
            world = passing / f"world-{self._seed}.toml"
            try:
                world.write_text(fragment(self._world))
            except OSError as error:
                what = f"cannot be written: {error.strerror}"
                raise NoRecord(f"{world}: {what}; free some space") from None
        description = _described(self._plan, world)
        return Rig(description, seed=abs(self._seed), record=self._record, doubts=False)

    def _judged(self, rig: Rig, profiles: bool) -> Row:
        properties.forget()
        observer = Observer(rig)
        profiler = Profiler(rig) if profiles else None
        end_ns = self._plan.end_ns(rig.description.world.swarm)
        is_late = self._run(rig, end_ns)
        if rig.recording is not None and rig.recording.error is not None:
            raise NoRecord(str(rig.recording.error))
        if profiler is not None:
            self.profile = profiler.profile()
        ended_ns = rig.runtime.now_ns()
        self._judge(rig.description)
        row = Row(
            self._seed,
            Result.PASSED,
            end_ns=ended_ns,
            digest=digest(self._record)[:16],
            fired=len(observer.events),
            ended_by=self._ended_by,
            new=tuple(observer.pairs),
            met=tuple(properties.met().items()),
            world=self._world,
        )
        if is_late:
            text = f"still runs after {end_ns / 1e9:g} s; expected an end; see end_s of [swarm]"
            self._failures.append(Failure(end_ns, "end", "still runs", "", text))
        if not self._failures:
            return row
        first = min(self._failures, key=lambda one: one.time_ns)
        if self._seed == CANARY:
            first = replace(first, text=", ".join(sorted({one.oracle for one in self._failures})))
        return replace(
            row,
            result=Result.TIMEOUT if is_late and first.oracle == "end" else Result.FAILED,
            oracle=first.oracle,
            signature=_signature(first, observer),
            text=first.text[:_TEXT_MAX],
            at_ns=first.time_ns,
        )

    # --- the run ---------------------------------------------------------------------------------

    def _run(self, rig: Rig, end_ns: int) -> bool:
        """Run the program; return True if it had to be ended."""
        process = os.getpid()
        alarm = rig.runtime.queue.alarm(lambda now_ns: _interrupt(rig))
        alarm.set(end_ns)
        try:
            with rig:
                self._run_program(rig)
                if os.getpid() != process:  # the program forked, and this is the copy
                    os._exit(0)
                if self._seed == CANARY:
                    self._plant(rig)
        except KeyboardInterrupt:
            return rig.runtime.now_ns() >= end_ns
        except TraceError as error:
            raise NoRecord(str(error)) from None
        except Exception as error:  # of the rig's end, such as that of a party without a join
            self._raised(error, rig)
        return False

    def _run_program(self, rig: Rig) -> None:
        program = self._plan.program
        if program.kind == FUNCTION:
            status = self._call(program.name, rig)
        else:
            script = read_script(program.name)
            status = run_script(
                rig, script, program.words, lambda error, _: self._raised(error, rig)
            )
        if status and not self._failures and not self._ended_by:
            text = f"exit status {status}; expected 0"
            self._failures.append(Failure(rig.runtime.now_ns(), "exit", text, "", text))

    def _call(self, target: str, rig: Rig) -> int:
        """Call a function of the application; return its exit status, 0 unless it calls exit."""
        try:
            _function(target)(rig)
        except SystemExit as leaving:
            return exit_status(leaving)
        except Exception as error:
            self._raised(error, rig)
        return 0

    def _plant(self, rig: Rig) -> None:
        """Break a promise of the program."""
        try:
            properties.always(False, "the canary is found")
        except properties.PropertyViolated as error:
            self._raised(error, rig)

    def _raised(self, error: BaseException, rig: Rig) -> None:
        """Take an exception that ended the program, or one of its threads."""
        kinds = [kind.__name__ for kind in type(error).__mro__]
        name = type(error).__name__
        allowed = rig.description.world.swarm.allowed_errors
        if (self._world or self._file) and any(one in kinds for one in allowed):
            self._ended_by = self._ended_by or name
            return
        place = _place(error)
        message = str(error).partition("\n")[0]
        oracle, rule = "exception", f"{name} at {place}"
        if isinstance(error, properties.PropertyViolated):
            oracle, rule = "always", message
        elif isinstance(error, AssertionError):
            oracle, rule = "assert", f"assert at {place}"
        text = f"{name}: {message} ({place})"
        self._failures.append(Failure(rig.runtime.now_ns(), oracle, rule, "", text))

    # --- judgement -------------------------------------------------------------------------------

    def _judge(self, description: RigDescription) -> None:
        only = self._plan.oracles or description.world.swarm.oracles or fair(self._world)
        facts = Facts()
        if self._seed == CANARY:
            facts, only = _at_rest(description), (*only, VelocityLimit.id)
        for finding in judge(self._record, facts, only=only):
            first = finding.first
            if finding.verdict is Verdict.BROKEN and first is not None:
                rule = _without_names(first.text, description)
                role = _role(first, description)
                failure = Failure(first.time_ns, finding.oracle, rule, role, str(first))
                self._failures.append(failure)


def _interrupt(rig: Rig) -> None:
    rig.runtime.interrupt()


def _at_rest(description: RigDescription) -> Facts:
    """Return limits that any motion breaks: the canary's second defect."""
    files = [Attachment(name, kind, 0, data) for name, kind, data in files_of(description)]
    return Facts(
        {
            name: replace(one, limits={f"velocity_max_{one.unit or 'rad'}_s": 0.0})
            for name, one in subjects_in(files).items()
        }
    )


def _function(target: str) -> Callable[[Rig], object]:
    module, _, name = target.partition(":")
    sys.path.insert(0, "")
    function: Callable[[Rig], object] = getattr(import_module(module), name)
    return function


def _place(error: BaseException) -> str:
    """Return file and line of the innermost frame that is the application's."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not is_own_file(frame.filename)]
    if not own:
        return "?"
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}"


def _without_names(text: str, description: RigDescription) -> str:
    words = []
    names = {*description.motors, *description.controllers, *description.buses}
    for word in text.split(" "):
        bare = word.strip(",.;:()")
        words.append("#" if bare in names or any(c.isdigit() for c in bare) else word)
    return " ".join(words)


def _role(violation: Violation, description: RigDescription) -> str:
    """Return the adaptation of the motor concerned, or the kind of the controller."""
    motor = description.motors.get(violation.motor)
    if motor is not None:
        return motor.adaptation
    place = (violation.bus, violation.node)
    for one in description.controllers.values():
        if (one.bus, one.node_id) == place:
            return one.kind
    return ""


def _signature(failure: Failure, observer: Observer) -> str:
    event = observer.before(failure.time_ns)
    state = "-" if event is None else event.state
    last = "undisturbed" if event is None else event.what
    return " | ".join((failure.oracle, failure.rule, failure.role or "-", state, last))


def oracles_known(names: Sequence[str]) -> list[str]:
    """Return those names that are no oracle's."""
    return [name for name in names if name not in IDS]
