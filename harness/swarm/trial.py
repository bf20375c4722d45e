"""Trial: one world, run in this process, judged."""

import hashlib
import os
import random
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.oracles.base import Verdict, Violation
from motorhil.harness.oracles.facts import Facts, subjects_in
from motorhil.harness.oracles.judge import judge
from motorhil.harness.oracles.limits import VelocityLimit
from motorhil.harness.rig.config.rig_file import Known, RigDescription, read_rig
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.config.worlds import UNDECLARED
from motorhil.harness.rig.fragment import read_fragment
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.recording import files_of
from motorhil.harness.rig.rig import Rig
from motorhil.harness.rig.script import (
    Script,
    exit_status,
    is_own_file,
    read_script,
    run_script,
)
from motorhil.harness.swarm import properties
from motorhil.harness.swarm.child import call_forked
from motorhil.harness.swarm.plan import FUNCTION, PROGRAMS, PYTEST, SCRIPT, Plan
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from
from motorhil.harness.swarm.worlds.disturbance import World, fragment, kinds_in
from motorhil.harness.swarm.worlds.fairness import fair, is_pushed_out
from motorhil.harness.swarm.worlds.observer import Observer, acts_of
from motorhil.harness.swarm.worlds.profile import Profile, Profiler
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.records import Attachment

_TEXT_MAX: Final = 300
_SUFFIX: Final = ".mcap"
_RECORD: Final = f"run{_SUFFIX}"
_WARM_S: Final = 0.1
_LATE: Final = "still runs"
_RAISED: Final = re.compile(r"(?:[\w.]+\.)?(\w+)(?::|$)")
"""The last line of a traceback."""
_STDLIB: Final = (sysconfig.get_path("stdlib") + os.sep, "<frozen")
_INSTALLED: Final = f"{os.sep}site-packages{os.sep}"
_PYTEST: Final = f"{os.sep}_pytest{os.sep}"


@final
@frozen
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
    with TemporaryDirectory(prefix="motorhil-world-") as name:
        passing = Path(name)
        trial = _Trial(plan, seed, (), record or passing / _RECORD, file)
        if plan.program.kind != PYTEST:
            return trial.run(passing)
        ended = call_forked(lambda: trial.run(passing).as_line(), plan.wall_s)  # of any session
        if ended.text is None:
            return Row(seed, Result.TIMEOUT if ended.is_late else Result.KILLED)
        return row_from(ended.text)


def profiled(plan: Plan, seed: int, passing: Path) -> tuple[Row, Profile | None]:
    """Run the undisturbed world; return its row, and what it looks like unless it failed."""
    trial = _Trial(plan, seed, (), passing / _RECORD)
    row = trial.run(passing, profiles=True)
    return row, trial.profile


def warm(plan: Plan, passing: Path) -> None:
    """Import what a run needs, and run it until Python has specialised its code.

    The program itself is not imported. Errors are not told: the first world has them too.
    """
    program = plan.program
    folder = passing
    if program.kind == FUNCTION:
        add_current_folder()
    elif program.kind == SCRIPT:
        folder = Path(program.name).resolve().parent  # plugins are searched along sys.path
    nothing = Script(_RECORD, b"", str(folder))
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
    if plan.program.kind == PYTEST:
        from motorhil.harness.swarm.pytest_run import warm_pytest

        warm_pytest(passing)


@cache
def _plugins() -> Known:
    """Return the plugins that are installed; a process looks once."""
    return installed_plugins()


def _described(plan: Plan, world: Path | None) -> RigDescription:
    return read_rig(Path(plan.rig), _plugins(), None if world is None else read_fragment(world))


@final
@dataclass(slots=True)
class _Run:
    """One rig of a trial: its observers and its failures."""

    rig: Rig
    observer: Observer
    profiler: Profiler | None
    failures: list[Failure] = field(default_factory=list)
    end_ns: int = 0
    digest: str = ""


@final
class _Trial:
    """One run: of a program with one rig, or of tests with one after the other."""

    def __init__(
        self, plan: Plan, seed: int, world: World, record: Path, file: Path | None = None
    ) -> None:
        self.profile: Profile | None = None
        self._plan = plan
        self._seed = seed
        self._world = world
        self._file = file
        self._record = record
        self._profiles = False
        self._runs: list[_Run] = []
        self._refused = ""
        self._outside: list[Failure] = []  # before the first rig
        self._ended_by = ""
        self._lost: NoRecord | None = None

    def run(self, passing: Path, profiles: bool = False) -> Row:
        """Run it, and judge it."""
        self._profiles = profiles
        properties.forget()
        world = self._written(passing)
        if self._plan.program.kind == PYTEST:
            self._run_tests(passing, world)
        else:
            self._run_rig(world)
        if self._lost is not None:
            raise self._lost
        if self._refused:
            return Row(self._seed, Result.CANCELLED, text=self._refused[:_TEXT_MAX])
        return self._row()

    def _written(self, passing: Path) -> Path | None:
        """Return the fragment of the world, or None if nothing disturbs it."""
        if not self._world:
            return self._file
        path = passing / f"world-{self._seed}.toml"
        try:
            path.write_text(fragment(self._world))
        except OSError as error:
            what = f"cannot be written: {error.strerror}"
            raise NoRecord(f"{path}: {what}; free some space") from None
        return path

    def _row(self) -> Row:
        runs = self._runs
        digests = [one.digest for one in runs]
        row = Row(
            self._seed,
            Result.PASSED,
            end_ns=sum(one.end_ns for one in runs),
            digest=(digests[0] if len(digests) == 1 else _joined(digests))[:16],
            fired=sum(len(one.observer.events) for one in runs),
            ended_by=self._ended_by,
            new=tuple(dict.fromkeys(pair for one in runs for pair in one.observer.pairs)),
            met=tuple(properties.met().items()),
            acts=acts_of(self._world, [one.observer for one in runs]),
            world=self._world,
            reactions=runs[0].observer.reactions() if runs else (),
        )
        failed = next((one for one in runs if one.failures), None)
        failures = self._outside if failed is None else failed.failures
        if not failures:
            return row
        first = min(failures, key=lambda one: one.time_ns)
        if self._seed == CANARY:
            first = replace(first, text=", ".join(sorted({one.oracle for one in failures})))
        return replace(
            row,
            result=Result.TIMEOUT if first.rule == _LATE else Result.FAILED,
            oracle=first.oracle,
            signature=_signature(first, None if failed is None else failed.observer),
            text=first.text[:_TEXT_MAX],
            at_ns=first.time_ns,
        )

    # --- rigs ------------------------------------------------------------------------------------

    def opened(self, rig: Rig) -> None:
        """Watch a rig that is open at time 0."""
        run = _Run(rig, Observer(rig), Profiler(rig) if self._profiles else None)
        self._runs.append(run)
        end_ns = self._plan.end_ns(rig.description.world.swarm)

        def end(now_ns: int) -> None:
            text = f"still runs after {end_ns / 1e9:g} s; expected an end; see end_s of [swarm]"
            run.failures.append(Failure(end_ns, "end", _LATE, "", text))
            rig.runtime.interrupt()

        rig.runtime.queue.alarm(end).set(end_ns)

    def refused(self, error: RigError) -> None:
        """Take the reason why the world cannot exist."""
        path = Path(error.file)
        if path.suffix == _SUFFIX and path != Path(self._plan.rig):
            raise NoRecord(str(error)) from None
        self._refused = self._refused or str(error)

    def closed(self, rig: Rig, record: Path) -> None:
        """Judge the record of a rig."""
        if rig.recording is not None and rig.recording.error is not None:
            raise NoRecord(str(rig.recording.error))
        run = next(one for one in self._runs if one.rig is rig)
        run.end_ns = rig.runtime.now_ns()
        if self._seed == CANARY:
            self._plant()
        run.failures += self._judged(rig.description, record)
        run.digest = digest(record)
        if run.profiler is not None:
            profile = run.profiler.profile()
            if self.profile is None or profile.end_ns > self.profile.end_ns:
                self.profile = profile
        if record.parent != self._record.parent and not any(
            one.failures for one in self._runs[:-1]
        ):
            copyfile(record, self._record)

    def _plant(self) -> None:
        """Break a promise of the program."""
        try:
            properties.always(False, "the canary is found")
        except properties.PropertyViolated as error:
            self.raised(error)

    # --- the run ---------------------------------------------------------------------------------

    def _run_rig(self, world: Path | None) -> None:
        """Run the program with its rig."""
        try:
            description = _described(self._plan, world)
            rig = Rig(description, seed=abs(self._seed), record=self._record, doubts=False)
        except RigError as error:
            self.refused(error)
            return
        process = os.getpid()
        self.opened(rig)
        try:
            with rig:
                self._run_program(rig)
                if os.getpid() != process:  # the program forked, and this is the copy
                    os._exit(0)
        except KeyboardInterrupt as error:
            if not self._runs[-1].failures:
                self.raised(error)
        except TraceError as error:
            raise NoRecord(str(error)) from None
        except Exception as error:  # of the rig's end, such as that of a party without a join
            self.raised(error)
        self.closed(rig, self._record)

    def _run_program(self, rig: Rig) -> None:
        program = self._plan.program
        status = 0
        if program.kind == PROGRAMS:
            self._run_programs(rig)
        elif program.kind == FUNCTION:
            status = self._call(program.name, rig)
        else:
            script = read_script(program.name)
            status = run_script(rig, script, program.words, lambda error, _: self.raised(error))
        if status and not self._runs[-1].failures and not self._ended_by:
            text = f"exit status {status}; expected 0"
            failure = Failure(rig.runtime.now_ns(), "exit", text, "", text)
            self._runs[-1].failures.append(failure)

    def _run_programs(self, rig: Rig) -> None:
        """Run the programs of the rig; each that ends badly is a failure, or an allowed error."""
        from motorhil.harness.shared_time.programs import run_programs

        last: dict[str, str] = {}

        def tell(line: str) -> None:
            name, _, text = line.partition(": ")
            last[name] = text or last.get(name, "")

        swarm = rig.description.world.swarm
        is_disturbed = bool(self._world or self._file)
        for name, reason in run_programs(rig, tell).items():
            raised = _RAISED.match(last.get(name, ""))
            if is_disturbed and raised is not None and raised[1] in swarm.allowed_errors:
                self._ended_by = self._ended_by or raised[1]
                continue
            rule = raised[1] if raised is not None else reason
            text = f"program {name}: {reason}: {last.get(name, '')}".rstrip(": ")
            failure = Failure(rig.runtime.now_ns(), "exit", rule, name, text)
            self._runs[-1].failures.append(failure)

    def _run_tests(self, passing: Path, world: Path | None) -> None:
        from motorhil.harness.swarm.pytest_run import run_pytest

        plan, seed = self._plan, abs(self._seed)
        name, words = plan.program.name, plan.program.words
        problem = run_pytest(name, words, plan.rig, seed, world, passing, self)
        if not problem and not self._runs and not self._outside:
            problem = f"{name} opens no rig; a test has {plan.rig} as `rig` or by `open_rig`"
        self._refused = self._refused or problem

    def _call(self, target: str, rig: Rig) -> int:
        """Call a function of the application; return its exit status, 0 unless it calls exit."""
        chance = random.getstate()
        random.seed(f"{abs(self._seed)}:program")  # as that of a script
        try:
            _function(target)(rig)
        except SystemExit as leaving:
            return exit_status(leaving)
        except Exception as error:
            self.raised(error)
        finally:
            random.setstate(chance)
        return 0

    def raised(self, error: BaseException) -> None:
        """Take an exception that ended the program, or one of its threads."""
        kinds = [kind.__name__ for kind in type(error).__mro__]
        name = type(error).__name__
        if isinstance(error, NoRecord):
            self._lost = error
            return
        run = self._runs[-1] if self._runs else None
        allowed = UNDECLARED if run is None else run.rig.description.world.swarm
        is_allowed = any(one in kinds for one in allowed.allowed_errors)
        if (self._world or self._file) and (is_allowed or is_pushed_out(error, self._kinds())):
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
        failures = self._outside if run is None else run.failures
        now_ns = 0 if run is None else run.rig.runtime.now_ns()
        failures.append(Failure(now_ns, oracle, rule, "", text))

    def _kinds(self) -> Collection[str]:
        """Return the kinds of disturbances of the world."""
        if self._file is not None:
            return kinds_in(read_fragment(self._file).text)
        return {one.kind for one in self._world}

    # --- judgement -------------------------------------------------------------------------------

    def _judged(self, description: RigDescription, record: Path) -> Iterator[Failure]:
        """Yield the promises that a record shows broken."""
        asked = self._plan.oracles or description.world.swarm.oracles
        only = asked or fair(self._kinds())
        facts = Facts()
        if self._seed == CANARY:
            facts, only = _at_rest(description), (*only, VelocityLimit.id)
        for finding in judge(record, facts, only=only):
            first = finding.first
            if finding.verdict is Verdict.BROKEN and first is not None:
                rule = _without_names(first.text, description)
                role = _role(first, description)
                yield Failure(first.time_ns, finding.oracle, rule, role, str(first))


def _joined(digests: Sequence[str]) -> str:
    """Return one digest of several, in their order."""
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()


def _at_rest(description: RigDescription) -> Facts:
    """Return limits that any motion breaks: the canary's second defect."""
    files = [Attachment(name, kind, 0, data) for name, kind, data in files_of(description)]
    return Facts(
        {
            name: replace(one, limits={f"velocity_max_{one.unit or 'rad'}_s": 0.0})
            for name, one in subjects_in(files).items()
        }
    )


def add_current_folder() -> None:
    """Find modules in the current folder; each change of sys.path costs a search of plugins."""
    if "" not in sys.path:
        sys.path.insert(0, "")


def _function(target: str) -> Callable[[Rig], object]:
    module, _, name = target.partition(":")
    add_current_folder()
    function: Callable[[Rig], object] = getattr(import_module(module), name)
    return function


def _place(error: BaseException) -> str:
    """Return file and line of the innermost frame that is the application's.

    An installed application has its files among the libraries: those count if no others are there.
    """
    frames = traceback.extract_tb(error.__traceback__)
    others = [one for one in frames if not is_own_file(one.filename)]
    others = [one for one in others if _PYTEST not in one.filename]
    own = [one for one in others if not one.filename.startswith(_STDLIB)]
    own = [one for one in own if _INSTALLED not in one.filename] or own or others
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


def _signature(failure: Failure, observer: Observer | None) -> str:
    event = None if observer is None else observer.before(failure.time_ns)
    state = "-" if event is None else event.state
    last = "undisturbed" if event is None else event.what
    return " | ".join((failure.oracle, failure.rule, failure.role or "-", state, last))
